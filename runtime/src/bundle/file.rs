//! A bundle read from a file.

use super::{Bundle, BundleError};
use crate::system::Mapping;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Files from this size on are mapped rather than read: the engines pack weights in their own way, and
/// there need not be two copies of many.
const MAPPED_FROM: u64 = 32 << 20;

/// A verified bundle file, in memory.
#[derive(Clone, Debug)]
pub struct BundleFile {
    path: PathBuf,
    bytes: Bytes,
}

#[derive(Clone, Debug)]
enum Bytes {
    Owned(Vec<u8>),
    Static(&'static [u8]),
    Mapped(Arc<Mapping>),
}

impl Bytes {
    fn read(path: &Path) -> std::io::Result<Self> {
        let mut file = File::open(path)?;
        if file.metadata()?.len() >= MAPPED_FROM
            && let Ok(map) = Mapping::new(&file)
        {
            return Ok(Self::Mapped(Arc::new(map)));
        }
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        Ok(Self::Owned(bytes))
    }

    fn as_slice(&self) -> &[u8] {
        match self {
            Self::Owned(bytes) => bytes,
            Self::Static(bytes) => bytes,
            Self::Mapped(map) => map.bytes(),
        }
    }
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
    /// Reads the file and verifies all of it. Large files are mapped; replace them by renaming
    /// ([`Mapping`]).
    ///
    /// # Errors
    /// When the file cannot be read or is no usable bundle; both name the file.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, BundleFileError> {
        let path = path.as_ref().to_path_buf();
        match Bytes::read(&path) {
            Ok(bytes) => Self::verified(path, bytes),
            Err(source) => Err(BundleFileError::Io { path, source }),
        }
    }

    /// Takes bytes that are already in memory; `path` serves for messages only.
    ///
    /// # Errors
    /// When the bytes are no usable bundle.
    pub fn from_bytes(path: impl Into<PathBuf>, bytes: Vec<u8>) -> Result<Self, BundleFileError> {
        Self::verified(path.into(), Bytes::Owned(bytes))
    }

    /// Takes bytes that are part of the program; `path` serves for messages only.
    ///
    /// # Errors
    /// When the bytes are no usable bundle.
    pub fn from_static(
        path: impl Into<PathBuf>,
        bytes: &'static [u8],
    ) -> Result<Self, BundleFileError> {
        Self::verified(path.into(), Bytes::Static(bytes))
    }

    fn verified(path: PathBuf, bytes: Bytes) -> Result<Self, BundleFileError> {
        let file = Self { path, bytes };
        file.bundle()?;
        Ok(file)
    }

    /// The bundle, borrowed from this file. Verifies again, which takes milliseconds.
    ///
    /// # Errors
    /// None after a successful [`Self::open`]; the signature keeps the way free of panics.
    pub fn bundle(&self) -> Result<Bundle<'_>, BundleFileError> {
        let mut bundle = Bundle::parse(self.bytes())
            .map_err(|source| BundleFileError::Bundle { path: self.path.clone(), source })?;
        if let Bytes::Mapped(map) = &self.bytes {
            // The check has read all of it.
            map.release(map.bytes());
            bundle.mapping = Some(Arc::clone(map));
        }
        Ok(bundle)
    }

    /// All of it, as it stands in the file.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.as_slice()
    }

    /// Where it was read from.
    pub fn path(&self) -> &Path {
        &self.path
    }
}
