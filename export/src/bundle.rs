//! Writing bundles; the layout is described in [`tsda_runtime::bundle`].

use crate::files::{self, FileError};
use std::path::Path;
use tsda_runtime::bundle::{self, BundleError, EncodeError, Manifest, SectionKind};

/// A bundle that could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WriteError {
    /// What goes in does not make a bundle.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// The bytes cannot be read back.
    #[error("the bundle would not be readable: {0}")]
    Unreadable(#[from] BundleError),
    /// The file cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
}

/// The bytes of a bundle. `manifest.sections` is filled in here; the result has been read back.
///
/// # Errors
/// When there are too many sections, the manifest is out of range or a kind comes twice.
pub fn encode(
    manifest: &Manifest<'_>,
    sections: &[(SectionKind, Vec<u8>)],
) -> Result<Vec<u8>, WriteError> {
    let sections: Vec<(SectionKind, &[u8])> =
        sections.iter().map(|(kind, body)| (*kind, body.as_slice())).collect();
    Ok(bundle::encode(manifest, &sections)?)
}

/// Writes a bundle; returns its size in bytes. An older file of this name stays until the new one
/// is complete.
///
/// # Errors
/// As [`encode`], or when the file cannot be written.
pub fn write(
    path: &Path,
    manifest: &Manifest<'_>,
    sections: &[(SectionKind, Vec<u8>)],
) -> Result<u64, WriteError> {
    let bytes = encode(manifest, sections)?;
    files::write(path, &bytes)?;
    Ok(bytes.len() as u64)
}
