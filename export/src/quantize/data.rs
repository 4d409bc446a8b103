//! Material to calibrate and to measure on.

use super::QuantizeError;
use std::path::Path;
use tsda_eval::dataset::{self, Dataset};

/// Opens `KIND:PATH[@split]`. Pairs are read as clips made from stills (`pseudo:`), and so is a
/// folder without a kind.
///
/// # Errors
/// When there is nothing, or nothing with a box.
pub fn open(text: &str) -> Result<Dataset, QuantizeError> {
    let whole = match text.strip_prefix("pairs:") {
        Some(rest) => format!("pseudo:{rest}"),
        None if !text.contains(':') || Path::new(text).is_dir() => format!("pseudo:{text}"),
        None => text.to_owned(),
    };
    let unusable = |reason: String| QuantizeError::Data { data: text.into(), reason };
    let data = dataset::open(&whole).map_err(|e| unusable(e.to_string()))?;
    if data.sequences.is_empty() {
        return Err(unusable("it holds no sequence".into()));
    }
    Ok(Dataset { name: portable(text), sequences: data.sequences })
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
