//! A bundle's parts as plain files.

use crate::files::{self, FileError};
use std::path::{Path, PathBuf};
use tsda_runtime::bundle::{Bundle, SectionKind};

/// A bundle that could not be unpacked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum UnpackError {
    /// A file or the folder cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The manifest has no readable form.
    #[error("the manifest cannot be written as JSON: {0}")]
    Manifest(#[from] serde_json::Error),
}

/// Writes the ONNX graphs, their weights (as `weights.bin`, where ONNX Runtime finds it), the
/// manifest (`manifest.json`), the training configuration (`config.toml`), the model card
/// (`card.md`) and the probe. Returns the files in the order they were written.
///
/// # Errors
/// When a file cannot be written; those before it are whole.
pub fn unpack(bundle: &Bundle<'_>, dir: &Path) -> Result<Vec<PathBuf>, UnpackError> {
    std::fs::create_dir_all(dir).map_err(|source| FileError {
        action: "create folder",
        path: dir.into(),
        source,
    })?;
    let manifest = bundle.manifest();
    let mut written = Vec::new();
    let mut write = |name: &str, bytes: &[u8]| {
        let path = dir.join(name);
        files::write(&path, bytes)?;
        written.push(path);
        Ok::<(), FileError>(())
    };
    // Weights before the graphs that need them.
    let weights_first = |kind: &SectionKind| *kind != SectionKind::Weights;
    let mut kinds: Vec<SectionKind> = manifest.sections.iter().map(|s| s.kind).collect();
    kinds.sort_by_key(weights_first);
    for kind in kinds {
        if let Some(bytes) = bundle.section(kind) {
            write(&kind.to_string(), bytes)?;
        }
    }
    write("config.toml", manifest.provenance.config.as_bytes())?;
    write("card.md", manifest.card.as_bytes())?;
    let mut json = serde_json::to_value(manifest)?;
    // Card and configuration have files of their own.
    if let Some(fields) = json.as_object_mut() {
        fields.insert("card".into(), "card.md".into());
        if let Some(provenance) = fields.get_mut("provenance").and_then(|p| p.as_object_mut()) {
            provenance.insert("config".into(), "config.toml".into());
        }
    }
    write("manifest.json", format!("{}\n", serde_json::to_string_pretty(&json)?).as_bytes())?;
    Ok(written)
}
