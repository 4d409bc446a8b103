//! Dataset loaders behind one trait.
//!
//! [`open`] reads `kind:path[@split]` texts as they stand in configurations and on command lines;
//! [`pairs`] and [`sequences`] hold the loaders for registered stills and LasHeR-like clips.

mod open;
pub mod pairs;
mod picture;
pub mod sequences;

pub use open::{Dataset, OpenError, Split, UnknownSplit, open};
pub use picture::{decode_picture, natural_cmp};

use tsda_runtime::{BBox, FrameError, FrameView, Modality, PixelFormat};

/// A decoded 8-bit picture, rows tightly packed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// 1 (grey) or 3 (R, G, B).
    pub channels: usize,
    /// `width * height * channels` bytes.
    pub data: Vec<u8>,
}

impl Picture {
    /// The picture as the tracker reads it.
    ///
    /// # Errors
    /// When a side is zero or the buffer too short.
    pub fn view(&self) -> Result<FrameView<'_>, FrameError> {
        let format = if self.channels == 1 { PixelFormat::Gray8 } else { PixelFormat::Rgb8 };
        FrameView::new(&self.data, self.width, self.height, self.width * self.channels, format)
    }
}

/// A clip (or a still) of one or two registered sensors with the boxes of one or more targets.
pub trait Sequence: Send + Sync {
    /// Name, unique in its dataset.
    fn id(&self) -> &str;
    /// Frames; 1 for a still.
    fn frames(&self) -> usize;
    /// Sensors present.
    fn modalities(&self) -> &[Modality];
    /// Annotated targets; 0 for unlabelled material.
    fn targets(&self) -> usize;
    /// Box of `target` in `frame` of this sensor (0-based); `None` when absent or not annotated.
    fn truth(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox>;
    /// Decodes one frame of one sensor.
    ///
    /// # Errors
    /// Names the file that could not be read and why.
    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError>;
}

/// A dataset that cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// A file or folder could not be opened or read.
    #[error("cannot read {path}: {source}")]
    Io {
        /// The file or folder.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A picture could not be decoded.
    #[error("cannot decode picture {path}: {reason}")]
    Picture {
        /// The file.
        path: std::path::PathBuf,
        /// What the decoder said.
        reason: String,
    },
    /// An annotation or index file does not say what it should.
    #[error("{path}{}: {reason}", .line.map(|l| format!(", line {l}")).unwrap_or_default())]
    Format {
        /// The file.
        path: std::path::PathBuf,
        /// 1-based line, where one can be named.
        line: Option<usize>,
        /// What is wrong and what was expected.
        reason: String,
    },
    /// A frame or sensor that the sequence does not have.
    #[error("sequence {sequence} has no {modality} frame {frame}")]
    NoSuchFrame {
        /// The sequence.
        sequence: String,
        /// 0-based frame.
        frame: usize,
        /// The sensor.
        modality: Modality,
    },
}
