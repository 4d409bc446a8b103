//! Writing bundles; the layout is described in [`tsda_runtime::bundle`].

use crate::files::{self, FileError};
use std::path::Path;
use tsda_runtime::bundle::{
    self, Bundle, BundleError, HEADER_LEN, Manifest, Section, SectionKind, align_up, crc32,
};

/// A bundle that could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WriteError {
    /// More sections than a manifest holds.
    #[error("{0} sections do not fit into a bundle; 16 do")]
    Sections(usize),
    /// The manifest does not encode or is too long.
    #[error("the manifest cannot be encoded: {0}")]
    Manifest(String),
    /// The reader refuses what would be written, so it is not written.
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
    let mut manifest = manifest.clone();
    // Offsets follow the manifest, whose length depends on the digits of the offsets: leave more
    // room until it fits. Offsets grow with the room and have at most ten bytes each, so this ends.
    let mut room = 0;
    let encoded = loop {
        place(&mut manifest, sections, room)?;
        let encoded =
            postcard::to_stdvec(&manifest).map_err(|e| WriteError::Manifest(e.to_string()))?;
        if encoded.len() <= room {
            break encoded;
        }
        room = encoded.len();
    };
    let header = bundle::header(&encoded)
        .ok_or_else(|| WriteError::Manifest("it is longer than 4 GiB".into()))?;
    let mut bytes = header.to_vec();
    bytes.extend_from_slice(&encoded);
    for (entry, (_, body)) in manifest.sections.iter().zip(sections) {
        bytes.resize(entry.offset as usize, 0);
        bytes.extend_from_slice(body);
    }
    Bundle::parse(&bytes)?;
    Ok(bytes)
}

/// Fills the table of contents for a manifest of up to `room` bytes.
fn place(
    manifest: &mut Manifest<'_>,
    sections: &[(SectionKind, Vec<u8>)],
    room: usize,
) -> Result<(), WriteError> {
    manifest.sections.clear();
    let mut end = (HEADER_LEN + room) as u64;
    for (kind, body) in sections {
        let offset = align_up(end).ok_or_else(|| WriteError::Manifest("it is too long".into()))?;
        let length = body.len() as u64;
        let section = Section { kind: *kind, offset, length, crc: crc32(body) };
        manifest.sections.push(section).map_err(|_| WriteError::Sections(sections.len()))?;
        end = offset + length;
    }
    Ok(())
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
