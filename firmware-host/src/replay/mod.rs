//! Scripted runs: the tracker against frame-by-frame expectations, with the network replaced by maps
//! from a file.
//!
//! A script is JSON: a list of runs (or `{"runs": [..]}`), each with the picture's size, the first
//! box and the frames. Pictures are recipe images ([`tsda_runtime::probe::recipe_image`]) of the
//! run's size; the maps are tensors `<run>.f<frame>.scores` `(F, F)` and `.ltrb` `(4, F, F)` of a
//! safetensors file. Everything a frame states is compared ([`report`]); `docs/parity.md` lists the
//! fields. A list of crops with their pixels ([`patches`]) is recognised by its content.

mod engine;
mod error;
mod fields;
mod patches;
pub mod report;
mod run;
mod script;
pub mod tensors;
#[cfg(test)]
mod tests;

pub use error::ReplayError;
pub use report::{Report, RunReport, Violation};

use serde_json::Value;
use std::path::Path;
use tensors::Tensors;

/// Largest difference of positions and boxes, in pixels.
pub const POSITION_TOLERANCE: f64 = 1e-3;
/// Largest difference of resampled pixels, in grey levels.
pub const GREY_TOLERANCE: f64 = 0.02;
/// Largest difference of scales, relative where they are above 1.
pub const SCALE_TOLERANCE: f64 = 1e-5;
/// Largest difference of labels.
pub const LABEL_TOLERANCE: f64 = 2e-5;
/// Largest difference of scores, which are only read.
pub const SCORE_TOLERANCE: f64 = 1e-6;

/// Replays a script. `maps` is the safetensors file; the script's own name with that extension when
/// not given.
///
/// # Errors
/// When a file cannot be read, a field is not what it should be or a map is missing; differences are
/// in the report.
pub fn replay(script: &Path, maps: Option<&Path>) -> Result<Report, ReplayError> {
    let read = |source| ReplayError::Read { path: script.into(), source };
    let text = std::fs::read(script).map_err(read)?;
    let value: Value = serde_json::from_slice(&text).map_err(|e| ReplayError::Json {
        path: script.into(),
        line: e.line(),
        column: e.column(),
        detail: e.to_string(),
    })?;
    if value.get(0).is_some_and(|case| case.get("pixels_at_yxc").is_some()) {
        return Err(ReplayError::Field {
            path: script.into(),
            at: "the list".into(),
            detail: "these are training crops, which the trainer cuts: `cargo test -p \
                     tsda-trainer crop` compares them"
                .into(),
        });
    }
    if patches::is_list(&value) {
        return patches::replay(&value, script);
    }
    let script = script::Script::read(&value, script)?;
    let beside = script.path.with_extension("safetensors");
    let tensors = Tensors::read(maps.unwrap_or(&beside))?;
    run::replay(&script, &tensors)
}
