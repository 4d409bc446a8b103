//! `tsda calibrate`.

use super::presence::{RunsArgs, observe_all};
use crate::error::{EXIT_OK, HostError};
use crate::model;
use crate::output::write_file;
use clap::Args;
use std::collections::BTreeMap;
use std::path::PathBuf;
use tsda_eval::calibrate::{BINS, Calibration, Pair, RIGHT_IOU, calibrate, pairs};
use tsda_runtime::bundle::{Bundle, Manifest, encode};

/// Arguments of `tsda calibrate`.
#[derive(Debug, Args)]
pub struct CalibrateArgs {
    /// What is tracked, with what
    #[command(flatten)]
    pub runs: RunsArgs,
    /// Bundle to write: the same with the calibration in its manifest; may be the one read
    #[arg(long, value_name = "FILE.tsda")]
    pub out: PathBuf,
    /// Model card (Markdown) to put in the place of the bundle's own
    #[arg(long, value_name = "FILE.md")]
    pub card: Option<PathBuf>,
    /// The fit and how good it is, as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

pub(super) fn run(args: &CalibrateArgs) -> Result<u8, HostError> {
    let file = model::load(args.runs.bundle.as_deref())?;
    let card = match &args.card {
        Some(path) => Some(std::fs::read_to_string(path).map_err(|e| HostError::Argument {
            what: format!("--card {}", path.display()),
            reason: e.to_string(),
        })?),
        None => None,
    };
    let mut tracker = model::tracker_on(&file, &args.runs.engine.choice()?)?;
    // All protocols and targets of a sequence stay together, or the cross-validation would judge
    // by what it was fitted to.
    let mut by_sequence: BTreeMap<String, Vec<Pair>> = BTreeMap::new();
    for run in observe_all(&args.runs, &mut tracker)?.iter().flat_map(|p| &p.runs) {
        by_sequence.entry(run.sequence.clone()).or_default().extend(pairs(run));
    }
    let sequences: Vec<Vec<Pair>> = by_sequence.into_values().collect();
    let fit = calibrate(&sequences).map_err(|e| HostError::Argument {
        what: format!("--dataset {}", args.runs.dataset.join(" ")),
        reason: e.to_string(),
    })?;

    let bytes = rewritten(&file.bundle()?, &fit, card.as_deref())
        .map_err(|reason| HostError::Encode { path: args.out.clone(), reason })?;
    if let Some(path) = &args.json {
        let mut json = serde_json::to_vec_pretty(&fit)
            .map_err(|e| HostError::Encode { path: path.clone(), reason: e.to_string() })?;
        json.push(b'\n');
        write_file(path, &json)?;
    }
    write_file(&args.out, &bytes)?;
    print!("{}", report(&fit));
    println!("bundle: {}", args.out.display());
    Ok(EXIT_OK)
}

/// The same bundle with another calibration (and card); every section as it was.
fn rewritten(
    bundle: &Bundle<'_>,
    fit: &Calibration,
    card: Option<&str>,
) -> Result<Vec<u8>, String> {
    let old = bundle.manifest();
    let manifest =
        Manifest { calibration: Some(fit.map()), card: card.unwrap_or(old.card), ..old.clone() };
    let sections: Vec<_> = bundle.sections().collect();
    let bytes = encode(&manifest, &sections).map_err(|e| e.to_string())?;
    Ok(bytes)
}

fn report(fit: &Calibration) -> String {
    let mut text = format!(
        "pairs:  {} of {} sequences, {} with a right box (IoU at least {RIGHT_IOU})\n\
         map:    slope {:.4}, bias {:.4}\n\
         before: Brier score {:.4}, calibration error {:.4} ({BINS} bins; the score as it is)\n",
        fit.pairs, fit.sequences, fit.right, fit.slope, fit.bias, fit.before.brier, fit.before.ece
    );
    text += &match fit.after {
        Some(r) => format!(
            "after:  Brier score {:.4}, calibration error {:.4} (sequences held out, {} folds)\n",
            r.brier, r.ece, fit.folds
        ),
        None => {
            "after:  not judged; that takes several sequences with right and wrong boxes\n".into()
        }
    };
    text
}
