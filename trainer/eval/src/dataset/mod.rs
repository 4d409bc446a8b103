//! Dataset loaders behind one trait.
//!
//! [`open()`] reads `kind:path[@split]` texts as they stand in configurations and on command lines
//! and hands out [`Sequence`]s; [`scan`] does the same but keeps going past what is broken, and
//! [`check()`] counts and tests what it found. One module per family of layouts:
//!
//! | module | benchmarks |
//! |---|---|
//! | [`lasher`] | LasHeR |
//! | [`rgbt`] | RGBT234, RGBT210, GTOT |
//! | [`antiuav`] | Anti-UAV (RGB-T, thermal only), registered on demand ([`registered`]) |
//! | [`vtuav`] | VTUAV |
//! | [`single`] | OTB and GOT-10k style folders of one sensor |
//! | [`stills`] | COCO annotation files, plain lists of stills with boxes |
//! | [`sequences`], [`pairs`] | LasHeR-like clips and registered still pairs with an `index.json` |
//!
//! All loaders keep to the same rules. The two sensors are paired by sorted position, never by
//! name, and cut to the shorter one. Boxes come out as `x, y, w, h`, 0-based continuous pixels of
//! the picture they were drawn in, whatever the file holds. A frame is *absent* when the annotation
//! says so and *not annotated* when it says nothing. What does not fit but can be lived with is a
//! [`Note`]; what cannot is a [`DatasetError`] with file and line.

pub mod antiuav;
pub mod check;
mod clip;
pub mod lasher;
mod layout;
mod note;
mod open;
pub mod pairs;
mod parallel;
mod picture;
pub mod registered;
pub mod rgbt;
pub mod sequences;
pub mod single;
pub mod stills;
#[cfg(test)]
pub(crate) mod testing;
mod text;
mod tree;
pub mod vtuav;

pub use check::{CheckOptions, CheckReport, Decode, Finding, check};
pub use clip::ClipSequence;
pub use note::{Note, Severity};
pub use open::{
    Dataset, KINDS, Kind, OpenError, Scan, Split, UnknownSplit, kind_of, open, scan, scan_with,
};
pub use picture::{decode_picture, natural_cmp, picture_size};
pub use registered::{Affine, Registration};
pub use text::read_boxes;

use std::path::PathBuf;

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

/// A clip (or a still) of one or two sensors with the boxes of one or more targets.
///
/// Frames and targets are 0-based. What goes beyond boxes has defaults that fit material with one
/// complete annotation: every frame annotated, no attributes, both sensors on one pixel grid.
pub trait Sequence: Send + Sync {
    /// Name, unique in its dataset.
    fn id(&self) -> &str;

    /// Frames; 1 for a still.
    fn frames(&self) -> usize;

    /// Sensors present.
    fn modalities(&self) -> &[Modality];

    /// Annotated targets; 0 for unlabelled material.
    fn targets(&self) -> usize;

    /// Box of `target` in `frame`, in pixels of this sensor; `None` when absent or not annotated.
    fn truth(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox>;

    /// Decodes one frame of one sensor.
    ///
    /// # Errors
    /// Names the file that could not be read and why.
    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError>;

    /// Does the annotation say anything about `target` in this frame, be it that it is absent?
    /// VTUAV, for one, only speaks of every tenth frame.
    fn annotated(&self, target: usize, frame: usize, modality: Modality) -> bool {
        target < self.targets() && frame < self.frames() && self.modalities().contains(&modality)
    }

    /// Does the annotation say that `target` cannot be seen in this frame?
    fn absent(&self, target: usize, frame: usize, modality: Modality) -> bool {
        self.annotated(target, frame, modality) && self.truth(target, frame, modality).is_none()
    }

    /// The annotated row as it stands, also where it has no area (`0,0,0,0`, NaN) or the frame is
    /// marked absent; for metrics that treat such rows in a way of their own. Same coordinates as
    /// [`Self::truth`].
    fn truth_row(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox> {
        self.truth(target, frame, modality)
    }

    /// Visible share of the target in `[0, 1]`, where the annotation grades it (GOT-10k).
    fn visibility(&self, _target: usize, _frame: usize, _modality: Modality) -> Option<f32> {
        None
    }

    /// Challenge attributes of the whole sequence, by the codes of its benchmark (`TC`, `LI`, ..).
    fn attributes(&self) -> &[String] {
        &[]
    }

    /// Attributes of one frame (`cut_by_image`).
    fn frame_attributes(&self, _frame: usize) -> Vec<&str> {
        Vec::new()
    }

    /// What did not fit and was dealt with, or is broken but not fatal.
    fn notes(&self) -> &[Note] {
        &[]
    }

    /// How positions in the RGB picture relate to the thermal one.
    fn registration(&self) -> Registration {
        Registration::Aligned
    }

    /// File that [`Self::picture`] decodes, where there is one per frame.
    fn picture_path(&self, _frame: usize, _modality: Modality) -> Option<PathBuf> {
        None
    }

    /// `(width, height)` of the sensor's first frame, from its header where that is enough. The
    /// two sensors may differ.
    ///
    /// # Errors
    /// When the first frame is missing or cannot be read.
    fn resolution(&self, modality: Modality) -> Result<(usize, usize), DatasetError> {
        match self.picture_path(0, modality) {
            Some(path) => picture_size(&path),
            None => self.picture(0, modality).map(|p| (p.width, p.height)),
        }
    }
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
    /// The two sensors of a sequence cannot be brought to one pixel grid.
    #[error("sequence {sequence}: cannot register RGB to thermal: {reason}")]
    Registration {
        /// The sequence.
        sequence: String,
        /// Why, and what to do.
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
