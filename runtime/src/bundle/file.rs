//! A bundle read from a file.

use super::{Bundle, BundleError};
use std::path::{Path, PathBuf};

/// A verified bundle file, held in memory.
#[derive(Clone, Debug)]
pub struct BundleFile {
    path: PathBuf,
    bytes: Vec<u8>,
}

/// A bundle file that cannot be used; names the file.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BundleFileError {
    /// The file cannot be read.
    #[error("cannot read bundle {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file's bytes are no usable bundle.
    #[error("{}: {source}", path.display())]
    Bundle {
        /// The file.
        path: PathBuf,
        /// What is wrong with the bytes.
        source: BundleError,
    },
}

impl BundleFile {
    /// Reads the file and verifies all of it.
    ///
    /// # Errors
    /// When the file cannot be read or is no usable bundle; both name the file.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, BundleFileError> {
        let path = path.as_ref().to_path_buf();
        match std::fs::read(&path) {
            Ok(bytes) => Self::from_bytes(path, bytes),
            Err(source) => Err(BundleFileError::Io { path, source }),
        }
    }

    /// Takes bytes that are already in memory; `path` serves for messages only.
    ///
    /// # Errors
    /// When the bytes are no usable bundle.
    pub fn from_bytes(path: impl Into<PathBuf>, bytes: Vec<u8>) -> Result<Self, BundleFileError> {
        let file = Self { path: path.into(), bytes };
        file.bundle()?;
        Ok(file)
    }

    /// The bundle, borrowed from this file. Verifies again, which takes milliseconds.
    ///
    /// # Errors
    /// None after a successful [`Self::open`]; the signature keeps the way free of panics.
    pub fn bundle(&self) -> Result<Bundle<'_>, BundleFileError> {
        Bundle::parse(&self.bytes)
            .map_err(|source| BundleFileError::Bundle { path: self.path.clone(), source })
    }

    /// All of it, as it stands in the file.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Where it was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }
}
