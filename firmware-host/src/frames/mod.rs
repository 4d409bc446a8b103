//! Where frames come from: folders of pictures, lists that mix two sensors, raw video on a pipe.

mod decode;
mod folder;
mod init;
mod modality;
mod natural;
mod y4m;

pub use decode::Decoded;
pub use folder::{Listed, PictureFiles};
pub use init::{find_init, parse_box, read_boxes};
pub use modality::looks_grey;
pub use natural::natural_cmp;
pub(crate) use y4m::yuv_to_rgb;
pub use y4m::{Y4m, Y4mHeader};

use std::path::PathBuf;
use tsda_runtime::{FrameError, FrameView, Modality};

/// One frame, valid until the next is asked for.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    /// 0-based.
    pub index: usize,
    /// File, or `frame 12` of a stream.
    pub name: &'a str,
    /// Sensor, given or inferred.
    pub modality: Modality,
    /// The pixels.
    pub view: FrameView<'a>,
}

/// Frames one after the other. The buffer of a frame is reused for the next.
pub trait FrameSource {
    /// Number of frames, when it is known beforehand.
    fn len_hint(&self) -> Option<usize>;

    /// The next frame; `None` after the last.
    ///
    /// # Errors
    /// Names the file, or the frame of the stream, that cannot be read.
    fn next_frame(&mut self) -> Result<Option<Frame<'_>>, SourceError>;
}

/// Frames that cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SourceError {
    /// A file or folder could not be read.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A folder or list without frames.
    #[error("{}: {reason}", path.display())]
    NoFrames {
        /// The folder or list.
        path: PathBuf,
        /// What was looked for and what to do.
        reason: String,
    },
    /// A picture that cannot be decoded.
    #[error("{}: not a picture that can be read: {reason}", path.display())]
    Decode {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        reason: String,
    },
    /// A picture of unusable size.
    #[error("{name}: {source}")]
    Frame {
        /// File or frame of the stream.
        name: String,
        /// What is wrong with it.
        source: FrameError,
    },
    /// A line of a list or of a box file.
    #[error("{}, line {line}: {reason}", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// 1-based.
        line: usize,
        /// What is wrong and what was expected.
        reason: String,
    },
    /// A Y4M stream that does not say what it should.
    #[error("{name}, {place}: {reason}")]
    Y4m {
        /// `stdin` or the file.
        name: String,
        /// `header` or `frame 12`.
        place: String,
        /// What is wrong and what was expected.
        reason: String,
    },
}

#[cfg(test)]
mod tests;
