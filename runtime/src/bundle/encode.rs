//! Putting a bundle together.

use super::manifest::Trailer;
use super::{
    Bundle, BundleError, HEADER_LEN, Manifest, PLAIN_VERSION, Section, SectionKind, VERSION,
    align_up, crc32, header_of,
};
use std::string::{String, ToString};
use std::vec::Vec;

/// What does not make a bundle.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// More sections than a manifest holds.
    #[error("{0} sections do not fit into a bundle; 16 do")]
    Sections(usize),
    /// The manifest does not encode or is too long.
    #[error("the manifest cannot be encoded: {0}")]
    Manifest(String),
    /// The reader refuses what would be written.
    #[error("the bundle would not be readable: {0}")]
    Unreadable(#[from] BundleError),
}

/// The bytes of a bundle. `manifest.sections` is filled in here; the result has been read back.
///
/// # Errors
/// When there are too many sections, the manifest is out of range or a kind comes twice.
pub fn encode(
    manifest: &Manifest<'_>,
    sections: &[(SectionKind, &[u8])],
) -> Result<Vec<u8>, EncodeError> {
    let mut manifest = manifest.clone();
    // Offsets follow the manifest, whose length depends on the digits of the offsets: leave more
    // room until it fits. Offsets grow with the room and have at most ten bytes each, so this ends.
    let trailer = (manifest.precision.is_some() || manifest.motion.is_some())
        .then(|| Trailer { precision: manifest.precision.clone(), motion: manifest.motion });
    let mut room = 0;
    let encoded = loop {
        place(&mut manifest, sections, room)?;
        let failed = |e: postcard::Error| EncodeError::Manifest(e.to_string());
        let mut encoded = postcard::to_stdvec(&manifest).map_err(failed)?;
        if let Some(trailer) = &trailer {
            encoded.extend(postcard::to_stdvec(trailer).map_err(failed)?);
        }
        if encoded.len() <= room {
            break encoded;
        }
        room = encoded.len();
    };
    let version = if trailer.is_some() { VERSION } else { PLAIN_VERSION };
    let head = header_of(version, &encoded)
        .ok_or_else(|| EncodeError::Manifest("it is longer than 4 GiB".into()))?;
    let mut bytes = head.to_vec();
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
    sections: &[(SectionKind, &[u8])],
    room: usize,
) -> Result<(), EncodeError> {
    manifest.sections.clear();
    let mut end = (HEADER_LEN + room) as u64;
    for (kind, body) in sections {
        let offset = align_up(end).ok_or_else(|| EncodeError::Manifest("it is too long".into()))?;
        let length = body.len() as u64;
        let section = Section { kind: *kind, offset, length, crc: crc32(body) };
        manifest.sections.push(section).map_err(|_| EncodeError::Sections(sections.len()))?;
        end = offset + length;
    }
    Ok(())
}
