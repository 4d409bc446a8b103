//! The model to track with: a bundle file, or the one built into the program.

use crate::error::HostError;
use std::path::Path;
use tsda_runtime::Tracker;
use tsda_runtime::bundle::{Bundle, BundleFile};
use tsda_runtime::engine::{AnyEngine, EngineChoice};

/// `models/nano.tsda` of the repository at build time.
static EMBEDDED: Option<&[u8]> = include!(concat!(env!("OUT_DIR"), "/embedded.rs"));

/// Name of the embedded model in messages.
pub const EMBEDDED_NAME: &str = "embedded nano.tsda";

/// The bytes of the embedded model, when this build has one.
pub fn embedded() -> Option<&'static [u8]> {
    EMBEDDED
}

/// Reads and verifies a bundle; without a path, the embedded one.
///
/// # Errors
/// When the file is missing, damaged or newer than this program, or nothing is embedded.
pub fn load(path: Option<&Path>) -> Result<BundleFile, HostError> {
    match path {
        Some(path) => Ok(BundleFile::open(path)?),
        None => {
            let bytes = EMBEDDED.ok_or(HostError::NoEmbeddedModel)?;
            Ok(BundleFile::from_static(EMBEDDED_NAME, bytes)?)
        }
    }
}

/// A tracker on the default engine, with the thresholds the bundle was tuned with.
///
/// # Errors
/// When the engine cannot be built from the bundle's graphs.
pub fn tracker(file: &BundleFile) -> Result<Tracker<AnyEngine>, HostError> {
    tracker_on(file, &EngineChoice::default())
}

/// A tracker on an engine, with the thresholds, calibration and motion prior of the bundle.
///
/// # Errors
/// When the engine is not there on this machine or cannot be built from the bundle's graphs.
pub fn tracker_on(
    file: &BundleFile,
    choice: &EngineChoice,
) -> Result<Tracker<AnyEngine>, HostError> {
    let bundle = file.bundle()?;
    Tracker::from_manifest(engine(file, &bundle, choice)?, bundle.manifest())
        .map_err(|source| HostError::Tracker { frame: 0, source: Box::new(source) })
}

/// An engine for a bundle.
///
/// # Errors
/// When it is not there on this machine or cannot be built from the bundle's graphs.
pub fn engine(
    file: &BundleFile,
    bundle: &Bundle<'_>,
    choice: &EngineChoice,
) -> Result<AnyEngine, HostError> {
    choice.open(bundle).map_err(|source| HostError::Engine {
        bundle: file.path().to_path_buf(),
        source: Box::new(source),
    })
}
