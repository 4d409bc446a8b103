//! The bundle `<name>.tsda`: one file with everything a board needs.
//!
//! ```text
//! 0   8 bytes   magic "TSDA\r\n\x1a\n"
//! 8   u32 LE    format version
//! 12  u32 LE    length of the manifest in bytes
//! 16  u32 LE    CRC-32 of the manifest
//! 20  u32 LE    CRC-32 of bytes 0..20
//! 24  manifest  postcard, see [`Manifest`]
//! ..  sections  each at a multiple of 64 bytes from the start of the file, zero-padded between;
//!               offset, length and CRC-32 stand in the manifest
//! ```

mod manifest;

pub use manifest::{
    Figure, Manifest, Provenance, ScoreCalibration, Section, SectionKind, TrainedOn,
};

/// First eight bytes of every bundle. Line-ending and end-of-file bytes in it catch text-mode
/// transfers.
pub const MAGIC: [u8; 8] = *b"TSDA\r\n\x1a\n";
/// Format version written by this crate, and the newest it reads.
pub const VERSION: u32 = 1;
/// Bytes before the manifest.
pub const HEADER_LEN: usize = 24;
/// Sections start at multiples of this.
pub const ALIGN: usize = 64;
/// File name under which ONNX graphs refer to the weights section (external data).
pub const WEIGHTS_FILE: &str = "weights.bin";
