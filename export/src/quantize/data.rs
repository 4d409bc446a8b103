//! Material to calibrate and to measure on.

use super::QuantizeError;
use std::path::Path;
use std::str::FromStr as _;
use tsda_eval::dataset::pairs::PairsDataset;
use tsda_eval::dataset::{self, Dataset, Sequence, Split};
use tsda_eval::pseudo::{PseudoOptions, clips};

/// Opens `KIND:PATH[@split]`. Pairs are read as clips made from stills (`pseudo:`), and so is a
/// folder without a kind.
///
/// # Errors
/// When there is nothing, or nothing with a box.
pub fn open(text: &str) -> Result<Dataset, QuantizeError> {
    let unusable = |e: &dyn std::fmt::Display| QuantizeError::Data {
        data: text.into(),
        reason: e.to_string(),
    };
    let stills = text.strip_prefix("pseudo:").or(text.strip_prefix("pairs:"));
    let rest = match stills {
        Some(rest) => rest,
        None if Path::new(text).is_dir() => text,
        None => {
            let data = dataset::open(text).map_err(|e| unusable(&e))?;
            if data.sequences.is_empty() {
                return Err(unusable(&"it holds no sequence"));
            }
            return Ok(data);
        }
    };
    let (path, split) = match rest.rsplit_once('@') {
        Some((path, split)) if !split.contains(['/', '\\']) => {
            (path, Split::from_str(split).map_err(|e| unusable(&e))?)
        }
        _ => (rest, Split::All),
    };
    let pairs = PairsDataset::open(Path::new(path), split).map_err(|e| unusable(&e))?;
    let stills = pairs.pairs().iter().map(|p| p as &dyn Sequence);
    let clips = clips(stills, PseudoOptions::default()).map_err(|e| unusable(&e))?;
    if clips.is_empty() {
        return Err(unusable(&"no target of a size that clips can be made from"));
    }
    let sequences = clips.into_iter().map(|c| Box::new(c) as Box<dyn Sequence>).collect();
    Ok(Dataset { name: portable(text), sequences })
}

/// The text without the folders above the data: a bundle tells nothing about the machine it was
/// made on.
pub fn portable(text: &str) -> String {
    let (kind, rest) = match text.split_once(':') {
        Some((kind, rest)) => (format!("{kind}:"), rest),
        None => (String::new(), text),
    };
    let last = rest.trim_end_matches('/').rsplit('/').next().unwrap_or(rest);
    format!("{kind}{last}")
}
