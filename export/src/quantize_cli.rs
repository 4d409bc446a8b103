//! `tsda-export quantize`.

use anyhow::Context as _;
use clap::{Args, ValueEnum};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use tsda_export::files;
use tsda_export::quantize::{QuantizeOptions, quantize};
use tsda_runtime::bundle::{BundleFile, Numbers};

/// Arguments of `tsda-export quantize`.
#[derive(Args)]
pub(crate) struct QuantizeArgs {
    /// The bundle, of 32-bit floats.
    bundle: PathBuf,
    /// The narrow bundle to write.
    #[arg(long, value_name = "FILE.tsda")]
    out: PathBuf,
    /// Numbers of the weights; with int8 the activations of those products are bytes too.
    #[arg(long, value_enum, default_value_t = Kind::Int8)]
    weights: Kind,
    /// Data to measure ranges of activations on: KIND:PATH[@split] as for `tsda eval`, or a folder
    /// of pairs. Best of the training split.
    #[arg(long, value_name = "DATA")]
    calib: Option<String>,
    /// Frames of it to track.
    #[arg(long, default_value_t = 400, value_parser = clap::value_parser!(u32).range(1..))]
    frames: u32,
    /// A product that stays in floats: name of its node or layer; may be repeated.
    #[arg(long, value_name = "NODE")]
    keep: Vec<String>,
    /// Data to measure the loss on, as KIND:PATH[@split]; may be repeated. Goes into the manifest.
    #[arg(long, value_name = "DATA")]
    measure: Vec<String>,
    /// What was done, as JSON; - for standard output, which then holds nothing else.
    #[arg(long, value_name = "FILE|-")]
    json: Option<PathBuf>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Kind {
    /// Products in 8 bits, everything else in floats.
    Int8,
    /// Weights as 16-bit floats, expanded when they are loaded.
    F16,
    /// Both.
    Int8F16,
}

impl Kind {
    const fn numbers(self) -> Numbers {
        match self {
            Self::Int8 => Numbers::Int8,
            Self::F16 => Numbers::Half,
            Self::Int8F16 => Numbers::Int8Half,
        }
    }
}

pub(crate) fn run(args: &QuantizeArgs) -> anyhow::Result<ExitCode> {
    let options = QuantizeOptions {
        numbers: args.weights.numbers(),
        calib: args.calib.clone(),
        frames: args.frames as usize,
        keep: args.keep.clone(),
        measure: args.measure.clone(),
        ..QuantizeOptions::default()
    };
    let report = rewrite(&args.bundle, &args.out, &options)?;
    let to_standard_output = args.json.as_deref() == Some(Path::new("-"));
    if let Some(path) = &args.json {
        let json = format!("{}\n", serde_json::to_string_pretty(&report)?);
        if to_standard_output {
            print!("{json}");
        } else {
            files::write(path, json.as_bytes())?;
        }
    }
    if !to_standard_output {
        print!("{report}");
        println!("bundle: {}", args.out.display());
    }
    Ok(ExitCode::SUCCESS)
}

/// Makes the bundle `from` narrower and writes it to `to`, which may be the same file.
pub(crate) fn rewrite(
    from: &Path,
    to: &Path,
    options: &QuantizeOptions,
) -> anyhow::Result<tsda_export::quantize::QuantizeReport> {
    let file = BundleFile::open(from)?;
    let mut progress = |text: &str| eprintln!("tsda-export: {text}");
    let (bytes, report) = quantize(&file.bundle()?, options, &mut progress)
        .with_context(|| format!("{}", from.display()))?;
    files::write(to, &bytes)?;
    Ok(report)
}
