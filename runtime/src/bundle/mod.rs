//! The bundle `<name>.tsda`: one file with everything a board needs.
//!
//! ```text
//! 0   8 bytes   magic "TSDA\r\n\x1a\n"
//! 8   u32 LE    format version
//! 12  u32 LE    length of the manifest in bytes
//! 16  u32 LE    CRC-32 of the manifest
//! 20  u32 LE    CRC-32 of bytes 0..20
//! 24  manifest  postcard, see [`Manifest`]; in version 2 with a [`Precision`] behind it
//! ..  sections  each at a multiple of 64 bytes from the start of the file, zero-padded between;
//!               offset, length and CRC-32 stand in the manifest
//! ```
//!
//! Strict on purpose, so that no altered byte goes unnoticed: the sections stand in the table in
//! the order of their offsets, every byte between two parts is zero, and the file ends where its
//! last section does.

#[cfg(feature = "std")]
mod encode;
#[cfg(feature = "std")]
mod file;
mod manifest;
#[cfg(all(test, feature = "std"))]
mod tests;

#[cfg(feature = "std")]
pub use encode::{EncodeError, encode};
#[cfg(feature = "std")]
pub use file::{BundleFile, BundleFileError};
pub use manifest::{
    Figure, Loss, Manifest, Numbers, Precision, Provenance, ScoreCalibration, Section, SectionKind,
    TrainedOn,
};

use crate::spec::SpecError;

/// First eight bytes of every bundle. Line-ending and end-of-file bytes in it catch text-mode
/// transfers.
pub const MAGIC: [u8; 8] = *b"TSDA\r\n\x1a\n";
/// The newest format version this crate reads. Bundles with neither a [`Precision`] nor a
/// [`MotionPrior`](crate::MotionPrior) are written as version 1, which older programs read too.
pub const VERSION: u32 = 2;
/// The version of bundles without either.
pub const PLAIN_VERSION: u32 = 1;
/// Bytes before the manifest.
pub const HEADER_LEN: usize = 24;
/// Sections start at multiples of this.
pub const ALIGN: usize = 64;
/// File name under which ONNX graphs refer to the weights section (external data).
pub const WEIGHTS_FILE: &str = "weights.bin";

/// The next multiple of [`ALIGN`] that is not below `n`; `None` when it does not fit.
pub const fn align_up(n: u64) -> Option<u64> {
    n.checked_next_multiple_of(ALIGN as u64)
}

/// CRC-32 (IEEE) as used everywhere in the bundle.
pub fn crc32(bytes: &[u8]) -> u32 {
    crc32fast::hash(bytes)
}

/// The first [`HEADER_LEN`] bytes of a bundle of version [`PLAIN_VERSION`] whose encoded manifest is
/// `manifest`. `None` when the manifest is longer than 4 GiB.
pub fn header(manifest: &[u8]) -> Option<[u8; HEADER_LEN]> {
    header_of(PLAIN_VERSION, manifest)
}

/// As [`header`], for a format version.
pub fn header_of(version: u32, manifest: &[u8]) -> Option<[u8; HEADER_LEN]> {
    let mut out = [0; HEADER_LEN];
    out[..8].copy_from_slice(&MAGIC);
    out[8..12].copy_from_slice(&version.to_le_bytes());
    out[12..16].copy_from_slice(&u32::try_from(manifest.len()).ok()?.to_le_bytes());
    out[16..20].copy_from_slice(&crc32(manifest).to_le_bytes());
    let crc = crc32(&out[..20]);
    out[20..].copy_from_slice(&crc.to_le_bytes());
    Some(out)
}

/// A part of the file, for messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Part {
    /// The first [`HEADER_LEN`] bytes.
    Header,
    /// The postcard manifest.
    Manifest,
    /// A section.
    Section(SectionKind),
}

impl core::fmt::Display for Part {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Header => f.write_str("header"),
            Self::Manifest => f.write_str("manifest"),
            Self::Section(kind) => write!(f, "section {kind}"),
        }
    }
}

/// Bytes that are not a usable bundle.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BundleError {
    /// The first eight bytes are not [`MAGIC`].
    #[error(
        "not a .tsda bundle: its first bytes are not the bundle signature; was it copied in text \
         mode, or is it another kind of file?"
    )]
    Magic,
    /// Made by a newer program.
    #[error(
        "bundle format version {found} is newer than version {VERSION}, the newest this program \
         reads; update the program or export the bundle again"
    )]
    Newer {
        /// Version in the file.
        found: u32,
    },
    /// A version that never existed.
    #[error("bundle format version {found} does not exist; the file is damaged, copy it again")]
    Version {
        /// Version in the file.
        found: u32,
    },
    /// The file ends too early.
    #[error(
        "bundle is truncated in its {part}: {needed} bytes are needed, the file has {len}; copy it again"
    )]
    Truncated {
        /// Where the bytes end.
        part: Part,
        /// Length the file must at least have.
        needed: u64,
        /// Its length.
        len: u64,
    },
    /// A checksum does not match.
    #[error("bundle is altered in its {part}: the checksum does not match; copy it again")]
    Checksum {
        /// The part with the wrong bytes.
        part: Part,
    },
    /// The manifest is intact but does not decode: written by an incompatible program.
    #[error("bundle manifest cannot be decoded ({0}); export the bundle again")]
    Decode(postcard::Error),
    /// The network specification or the thresholds are out of range.
    #[error("bundle manifest: {0}; export the bundle again")]
    Spec(#[from] SpecError),
    /// The table of contents contradicts itself.
    #[error("bundle section {kind}: {reason}; export the bundle again")]
    Table {
        /// The section.
        kind: SectionKind,
        /// What is wrong with its entry.
        reason: &'static str,
    },
    /// Bytes that belong to no part and are not zero.
    #[error("bundle is altered before byte {end}: padding is not zero; copy it again")]
    Padding {
        /// End of the padding, in bytes from the start of the file.
        end: u64,
    },
    /// More bytes than the table of contents accounts for.
    #[error(
        "bundle ends at byte {end} by its table of contents, but the file has {len} bytes; copy it again"
    )]
    Trailing {
        /// End of the last part.
        end: u64,
        /// Length of the file.
        len: u64,
    },
    /// A section that is needed is not there.
    #[error("bundle has no section {0}; export it again with a current tsda-export")]
    Missing(SectionKind),
}

/// A verified bundle: everything in it can be read without further checks of its bytes.
#[derive(Clone, Debug)]
pub struct Bundle<'a> {
    bytes: &'a [u8],
    manifest: Manifest<'a>,
    /// What the bytes are a part of, when they are that of a mapped file.
    #[cfg(feature = "std")]
    mapping: Option<std::sync::Arc<crate::system::Mapping>>,
}

impl<'a> Bundle<'a> {
    /// Reads and verifies a whole bundle: signature, version, all checksums, specification, table of
    /// contents. Nothing is copied but the manifest's numbers.
    ///
    /// # Errors
    /// The first thing that is wrong, with the part of the file it was found in.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, BundleError> {
        let len = bytes.len() as u64;
        let known = bytes.len().min(MAGIC.len());
        if bytes[..known] != MAGIC[..known] {
            return Err(BundleError::Magic);
        }
        let truncated = |part, needed| BundleError::Truncated { part, needed, len };
        let Some((header, rest)) = bytes.split_first_chunk::<HEADER_LEN>() else {
            return Err(truncated(Part::Header, HEADER_LEN as u64));
        };
        let word =
            |i: usize| u32::from_le_bytes([header[i], header[i + 1], header[i + 2], header[i + 3]]);
        let (version, manifest_len) = (word(8), word(12));
        if version > VERSION {
            return Err(BundleError::Newer { found: version });
        }
        if crc32(&header[..20]) != word(20) {
            return Err(BundleError::Checksum { part: Part::Header });
        }
        if version == 0 {
            return Err(BundleError::Version { found: version });
        }
        let manifest_end = HEADER_LEN as u64 + u64::from(manifest_len);
        let raw = usize::try_from(manifest_len)
            .ok()
            .and_then(|n| rest.get(..n))
            .ok_or(truncated(Part::Manifest, manifest_end))?;
        if crc32(raw) != word(16) {
            return Err(BundleError::Checksum { part: Part::Manifest });
        }
        let (mut manifest, mut unread): (Manifest<'a>, _) =
            postcard::take_from_bytes(raw).map_err(BundleError::Decode)?;
        if version > PLAIN_VERSION {
            let (trailer, rest): (manifest::Trailer<'a>, _) =
                postcard::take_from_bytes(unread).map_err(BundleError::Decode)?;
            (manifest.precision, manifest.motion) = (trailer.precision, trailer.motion);
            unread = rest;
        }
        if !unread.is_empty() {
            return Err(BundleError::Decode(postcard::Error::SerdeDeCustom));
        }
        manifest.spec.validate()?;
        manifest.tracker.validate()?;
        if let Some(calibration) = &manifest.calibration {
            calibration.validate()?;
        }
        if let Some(motion) = &manifest.motion {
            motion.validate()?;
        }
        check_sections(bytes, &manifest.sections, manifest_end)?;
        Ok(Self {
            bytes,
            manifest,
            #[cfg(feature = "std")]
            mapping: None,
        })
    }

    /// The mapped file that the bytes are a part of, if they are.
    #[cfg(feature = "native")]
    pub(crate) fn mapping(&self) -> Option<std::sync::Arc<crate::system::Mapping>> {
        self.mapping.clone()
    }

    /// What the bundle says about itself.
    pub const fn manifest(&self) -> &Manifest<'a> {
        &self.manifest
    }

    /// Bytes of a section, if the bundle has it.
    pub fn section(&self, kind: SectionKind) -> Option<&'a [u8]> {
        let entry = self.manifest.sections.iter().find(|s| s.kind == kind)?;
        // In range: `parse` checked the whole table.
        let start = usize::try_from(entry.offset).ok()?;
        let len = usize::try_from(entry.length).ok()?;
        self.bytes.get(start..start.checked_add(len)?)
    }

    /// Bytes of a section that must be there.
    ///
    /// # Errors
    /// [`BundleError::Missing`].
    pub fn require(&self, kind: SectionKind) -> Result<&'a [u8], BundleError> {
        self.section(kind).ok_or(BundleError::Missing(kind))
    }

    /// Numbers of templates for which there is a predict graph ([`SectionKind::PredictOnnx`]), in
    /// file order.
    pub fn predict_kinds(&self) -> impl Iterator<Item = u8> + '_ {
        self.manifest.sections.iter().filter_map(|s| match s.kind {
            SectionKind::PredictOnnx(templates) => Some(templates),
            _ => None,
        })
    }

    /// The sections in file order.
    pub fn sections(&self) -> impl Iterator<Item = (SectionKind, &'a [u8])> + '_ {
        self.manifest.sections.iter().filter_map(|s| Some((s.kind, self.section(s.kind)?)))
    }

    /// The whole file.
    pub const fn bytes(&self) -> &'a [u8] {
        self.bytes
    }
}

/// Walks the table of contents in file order; afterwards every byte of the file is accounted for.
fn check_sections(bytes: &[u8], sections: &[Section], mut end: u64) -> Result<(), BundleError> {
    let len = bytes.len() as u64;
    let slice = |from: u64, to: u64| -> Option<&[u8]> {
        bytes.get(usize::try_from(from).ok()?..usize::try_from(to).ok()?)
    };
    for (i, s) in sections.iter().enumerate() {
        let table = |reason| BundleError::Table { kind: s.kind, reason };
        if sections[..i].iter().any(|other| other.kind == s.kind) {
            return Err(table("it is listed twice"));
        }
        if !s.offset.is_multiple_of(ALIGN as u64) {
            return Err(table("its offset is not a multiple of 64"));
        }
        if s.offset < end {
            return Err(table("it overlaps the part before it"));
        }
        let stop = s.offset.checked_add(s.length).ok_or(table("its end is beyond 64 bits"))?;
        let part = Part::Section(s.kind);
        let (Some(padding), Some(body)) = (slice(end, s.offset), slice(s.offset, stop)) else {
            return Err(BundleError::Truncated { part, needed: stop, len });
        };
        if padding.iter().any(|&b| b != 0) {
            return Err(BundleError::Padding { end: s.offset });
        }
        if crc32(body) != s.crc {
            return Err(BundleError::Checksum { part });
        }
        end = stop;
    }
    if end != len {
        return Err(BundleError::Trailing { end, len });
    }
    Ok(())
}
