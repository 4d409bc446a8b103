//! Pictures as messages carry them: a path, raw pixels, or an encoded file.

use super::base64::{self, Base64Error};
use super::region::shortened;
use crate::frames::{Decoded, SourceError};
use crate::picture::Picture;
use std::path::{Path, PathBuf};
use tsda_runtime::FrameError;

/// Pixels of an `image:` argument.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MemoryFormat {
    /// Three bytes: R, G, B.
    Rgb,
    /// One byte.
    Gray8,
    /// Two bytes, little endian.
    Gray16,
}

impl MemoryFormat {
    /// Bytes of one pixel.
    pub const fn bytes(self) -> usize {
        match self {
            Self::Rgb => 3,
            Self::Gray8 => 1,
            Self::Gray16 => 2,
        }
    }

    fn parse(word: &str) -> Option<Self> {
        match word {
            "rgb" => Some(Self::Rgb),
            "gray8" => Some(Self::Gray8),
            "gray16" => Some(Self::Gray16),
            _ => None,
        }
    }
}

/// One picture of a message, not decoded yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ImageArg<'a> {
    /// `file://` and a path, or a bare path.
    Path(PathBuf),
    /// `image:W;H;FORMAT;BASE64`.
    Memory {
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
        /// What a pixel is.
        format: MemoryFormat,
        /// Base64 of the pixels, row by row.
        pixels: &'a str,
    },
    /// `data:image/jpeg;BASE64`.
    Buffer {
        /// Base64 of an encoded picture.
        file: &'a str,
    },
}

/// A picture that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// A kind of argument that was not offered.
    #[error("\"{text}\": pictures at a URL are not fetched; send a path, memory or buffer picture")]
    Url {
        /// What was found, shortened.
        text: String,
    },
    /// No text at all.
    #[error("the picture is an empty text")]
    Empty,
    /// An `image:` argument that does not say what it should.
    #[error(
        "memory picture: {what} \"{text}\"; expected image:WIDTH;HEIGHT;rgb|gray8|gray16;BASE64"
    )]
    Memory {
        /// What is wrong.
        what: &'static str,
        /// What was found, shortened.
        text: String,
    },
    /// Too many or too few pixels.
    #[error(
        "memory picture of {width} x {height} pixels of {each} bytes has {len} bytes instead of {needed}"
    )]
    Pixels {
        /// Width announced.
        width: usize,
        /// Height announced.
        height: usize,
        /// Bytes per pixel.
        each: usize,
        /// Bytes that came.
        len: usize,
        /// Bytes announced.
        needed: usize,
    },
    /// A `data:` argument that does not say what it should.
    #[error("buffer picture \"{text}\": expected data:image/jpeg;BASE64 or data:image/png;BASE64")]
    Buffer {
        /// What was found, shortened.
        text: String,
    },
    /// Text that is no base64.
    #[error(transparent)]
    Base64(#[from] Base64Error),
    /// A file that cannot be read or decoded.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// A picture of unusable size.
    #[error(transparent)]
    Frame(#[from] FrameError),
}

/// What decoding errors call a picture that came inside a message.
const BUFFER_NAME: &str = "buffer picture";

impl<'a> ImageArg<'a> {
    /// Reads the argument; no pixel is touched.
    ///
    /// # Errors
    /// When its header is wrong, or it is a URL.
    pub fn parse(text: &'a str) -> Result<Self, ImageError> {
        if text.is_empty() {
            return Err(ImageError::Empty);
        }
        if let Some(rest) = text.strip_prefix("image:") {
            return Self::memory(rest);
        }
        if let Some(rest) = text.strip_prefix("data:") {
            return Self::buffer(rest).ok_or(ImageError::Buffer { text: shortened(text) });
        }
        // Seven bytes, whatever follows; nothing is percent-encoded.
        let path = text.strip_prefix("file://").unwrap_or(text);
        if path.is_empty() {
            return Err(ImageError::Empty);
        }
        if path.len() == text.len() && has_scheme(text) {
            return Err(ImageError::Url { text: shortened(text) });
        }
        Ok(Self::Path(PathBuf::from(path)))
    }

    fn memory(rest: &'a str) -> Result<Self, ImageError> {
        let bad = |what, text: &str| ImageError::Memory { what, text: shortened(text) };
        let mut parts = rest.splitn(4, ';');
        let mut next = || parts.next().ok_or_else(|| bad("too few parts in", rest));
        let side = |word: &str| {
            word.parse::<usize>()
                .ok()
                .filter(|&n| n > 0)
                .ok_or_else(|| bad("a side is not a number of pixels:", word))
        };
        let (width, height) = (side(next()?)?, side(next()?)?);
        let word = next()?;
        let format = MemoryFormat::parse(word).ok_or_else(|| bad("unknown format", word))?;
        let pixels = next()?;
        // Compared before anything is allocated: the header may claim what it likes.
        let symbols = base64::unpadded(pixels).len();
        let len = base64::decoded_len(symbols);
        let needed = width
            .checked_mul(height)
            .and_then(|n| n.checked_mul(format.bytes()))
            .unwrap_or(usize::MAX);
        if len != needed {
            return Err(ImageError::Pixels { width, height, each: format.bytes(), len, needed });
        }
        Ok(Self::Memory { width, height, format, pixels })
    }

    fn buffer(rest: &'a str) -> Option<Self> {
        let (mime, file) = rest.split_once(';')?;
        // The protocol's text shows the marker of data URLs, its library never writes it.
        let file = file.strip_prefix("base64").map_or(file, |f| f.trim_start_matches([';', ',']));
        (mime.starts_with("image/") && !file.is_empty()).then_some(Self::Buffer { file })
    }

    /// The picture.
    ///
    /// # Errors
    /// When the file cannot be read or the bytes are no picture.
    pub fn decode(&self) -> Result<Decoded, ImageError> {
        match self {
            Self::Path(path) => Ok(Decoded::open(path)?),
            Self::Buffer { file } => {
                Ok(Decoded::from_bytes(&base64::decode(file)?, Path::new(BUFFER_NAME))?)
            }
            Self::Memory { width, height, format, pixels } => {
                let (width, height, data) = (*width, *height, base64::decode(pixels)?);
                Ok(match format {
                    MemoryFormat::Gray16 => Decoded::sixteen(width, height, data)?,
                    MemoryFormat::Gray8 | MemoryFormat::Rgb => {
                        Decoded::Eight(Picture { width, height, channels: format.bytes(), data })
                    }
                })
            }
        }
    }

    /// Width and height, without decoding the pixels.
    ///
    /// # Errors
    /// When the file cannot be read or does not begin like a picture.
    pub fn size(&self) -> Result<(usize, usize), ImageError> {
        match self {
            Self::Path(path) => Ok(Decoded::size_of_file(path)?),
            Self::Buffer { file } => {
                Ok(Decoded::size_of_bytes(&base64::decode(file)?, Path::new(BUFFER_NAME))?)
            }
            Self::Memory { width, height, .. } => Ok((*width, *height)),
        }
    }
}

/// Does it begin like a URL? One letter before the colon is a drive.
fn has_scheme(text: &str) -> bool {
    text.split_once(':').is_some_and(|(scheme, _)| {
        scheme.len() > 1
            && scheme.starts_with(|c: char| c.is_ascii_alphabetic())
            && scheme.bytes().all(|b| b.is_ascii_alphanumeric() || b"+-.".contains(&b))
    })
}
