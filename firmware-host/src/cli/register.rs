//! `tsda register`: where a point of one sensor's picture lies in the other's.

use crate::error::{EXIT_OK, HostError};
use crate::frames::SourceError;
use crate::switch::{Homography, Pair};
use clap::Args;
use std::path::{Path, PathBuf};

/// Arguments of `tsda register`.
#[derive(Debug, Args)]
pub struct RegisterArgs {
    /// Text file, one pair of points per line: x y in the first picture, x y in the second; `#` for
    /// comments
    #[arg(long, value_name = "FILE")]
    pub pairs: PathBuf,
    /// Name of the first source
    #[arg(long, value_name = "NAME", default_value = "rgb")]
    pub from: String,
    /// Name of the second source
    #[arg(long, value_name = "NAME", default_value = "thermal")]
    pub to: String,
    /// Leave out pairs that do not agree with the others within so many pixels
    #[arg(long, value_name = "PIXELS")]
    pub robust: Option<f64>,
    /// Also write the lines for the configuration into a file
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

pub(super) fn run(args: &RegisterArgs) -> Result<u8, HostError> {
    let pairs = read(&args.pairs)?;
    let bad =
        |reason: String| HostError::Argument { what: args.pairs.display().to_string(), reason };
    let (found, used) = match args.robust {
        Some(tolerance) if tolerance.is_finite() && tolerance > 0.0 => {
            Homography::estimate_robust(&pairs, tolerance).map_err(|e| bad(e.to_string()))?
        }
        Some(tolerance) => {
            return Err(HostError::Argument {
                what: "--robust".into(),
                reason: format!("{tolerance} is no distance in pixels"),
            });
        }
        None => {
            let found = Homography::estimate(&pairs).map_err(|e| bad(e.to_string()))?;
            (found, vec![true; pairs.len()])
        }
    };
    let (mut squares, mut largest, mut count) = (0.0, 0f64, 0u32);
    println!("   x       y    ->    x'      y'   residual (pixels of {})", args.to);
    for (pair, used) in pairs.iter().zip(&used) {
        let residual = found.residual(pair);
        let ([x, y], [u, v]) = (pair.from, pair.to);
        let mark = if *used { "" } else { "  left out" };
        println!("{x:8.1} {y:8.1} {u:8.1} {v:8.1} {residual:8.3}{mark}");
        if *used {
            squares += residual * residual;
            largest = largest.max(residual);
            count += 1;
        }
    }
    let rms = (squares / f64::from(count.max(1))).sqrt();
    println!("{count} pairs used: {rms:.3} pixels root mean square, {largest:.3} largest");
    let rows = found.0.map(|r| format!("  [{:e}, {:e}, {:e}],\n", r[0], r[1], r[2])).concat();
    // Names are quoted the way TOML and JSON agree on.
    let (from, to) = (quoted(&args.from), quoted(&args.to));
    let text = format!("[[registration]]\nfrom = {from}\nto = {to}\nmatrix = [\n{rows}]\n");
    print!("{text}");
    if let Some(out) = &args.out {
        crate::output::write_file(out, text.as_bytes())?;
    }
    Ok(EXIT_OK)
}

fn quoted(name: &str) -> String {
    serde_json::Value::from(name).to_string()
}

fn read(path: &Path) -> Result<Vec<Pair>, HostError> {
    let text = std::fs::read_to_string(path)
        .map_err(|source| SourceError::Io { path: path.to_path_buf(), source })?;
    let mut pairs = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let bad =
            |reason: String| SourceError::Line { path: path.to_path_buf(), line: i + 1, reason };
        let line = line.split('#').next().unwrap_or_default();
        let mut numbers = Vec::with_capacity(4);
        for word in line.split([' ', '\t', ',', ';']).filter(|w| !w.is_empty()) {
            match word.parse::<f64>() {
                Ok(v) if v.is_finite() => numbers.push(v),
                _ => return Err(bad(format!("`{word}` is not a number")).into()),
            }
        }
        match numbers[..] {
            [] => {}
            [x, y, u, v] => pairs.push(Pair { from: [x, y], to: [u, v] }),
            _ => {
                let reason = format!("{} numbers found, expected four: x y x' y'", numbers.len());
                return Err(bad(reason).into());
            }
        }
    }
    Ok(pairs)
}
