//! Picture files into memory.

use super::{SourceError, modality};
use crate::picture::Picture;
use image::{DynamicImage, ImageReader};
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;
use tsda_runtime::{FrameView, Modality, PixelFormat};

/// A decoded picture file: 8 bit, or raw 16-bit thermal with the range to show.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Decoded {
    /// 8 bit, 1 or 3 channels.
    Eight(Picture),
    /// 16 bit, one channel, little endian.
    Sixteen {
        /// Pixels per row.
        width: usize,
        /// Rows.
        height: usize,
        /// Raw value shown as black.
        low: u16,
        /// Raw value shown as white.
        high: u16,
        /// `2 * width * height` bytes.
        data: Vec<u8>,
    },
}

impl Decoded {
    /// Reads and decodes a file; the format is told from its content, not its name.
    ///
    /// # Errors
    /// Names the file when it cannot be read, is no picture, or is damaged.
    pub fn open(path: &Path) -> Result<Self, SourceError> {
        let bytes = std::fs::read(path)
            .map_err(|source| SourceError::Io { path: path.to_path_buf(), source })?;
        Self::from_bytes(&bytes, path)
    }

    /// Decodes the content of a picture file; errors call it `name`.
    ///
    /// # Errors
    /// When it is no picture, or damaged.
    pub fn from_bytes(bytes: &[u8], name: &Path) -> Result<Self, SourceError> {
        let bad = |reason: String| SourceError::Decode { path: name.to_path_buf(), reason };
        let image = reader(Cursor::new(bytes), name)?.decode().map_err(|e| bad(e.to_string()))?;
        Self::from_image(image)
            .map_err(|source| SourceError::Frame { name: name.display().to_string(), source })
    }

    /// A raw 16-bit picture of `2 * width * height` bytes, little endian.
    ///
    /// # Errors
    /// When a side is zero or the buffer too short.
    pub fn sixteen(
        width: usize,
        height: usize,
        data: Vec<u8>,
    ) -> Result<Self, tsda_runtime::FrameError> {
        let (values, _) = data.as_chunks::<2>();
        let raw: Vec<u16> = values.iter().map(|v| u16::from_le_bytes(*v)).collect();
        let (low, high) = shown_range(&raw);
        let decoded = Self::Sixteen { width, height, low, high, data };
        decoded.view()?;
        Ok(decoded)
    }

    /// Width and height of a picture file, read from its header.
    ///
    /// # Errors
    /// Names the file when it cannot be read or does not begin like a picture.
    pub fn size_of_file(path: &Path) -> Result<(usize, usize), SourceError> {
        let file = File::open(path)
            .map_err(|source| SourceError::Io { path: path.to_path_buf(), source })?;
        size(reader(BufReader::new(file), path)?, path)
    }

    /// Width and height of the content of a picture file; errors call it `name`.
    ///
    /// # Errors
    /// When it does not begin like a picture.
    pub fn size_of_bytes(bytes: &[u8], name: &Path) -> Result<(usize, usize), SourceError> {
        size(reader(Cursor::new(bytes), name)?, name)
    }

    fn from_image(image: DynamicImage) -> Result<Self, tsda_runtime::FrameError> {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let decoded = match image {
            DynamicImage::ImageLuma16(grey) => {
                let (low, high) = shown_range(grey.as_raw());
                let data = grey.as_raw().iter().flat_map(|v| v.to_le_bytes()).collect();
                Self::Sixteen { width, height, low, high, data }
            }
            DynamicImage::ImageLuma8(grey) => {
                Self::Eight(Picture { width, height, channels: 1, data: grey.into_raw() })
            }
            image @ (DynamicImage::ImageLumaA8(_) | DynamicImage::ImageLumaA16(_)) => {
                let data = image.into_luma8().into_raw();
                Self::Eight(Picture { width, height, channels: 1, data })
            }
            image => {
                let data = image.into_rgb8().into_raw();
                Self::Eight(Picture { width, height, channels: 3, data })
            }
        };
        decoded.view()?;
        Ok(decoded)
    }

    /// The picture as the tracker reads it; no pixel is copied.
    ///
    /// # Errors
    /// When a side is zero.
    pub fn view(&self) -> Result<FrameView<'_>, tsda_runtime::FrameError> {
        match self {
            Self::Eight(picture) => picture.view(),
            Self::Sixteen { width, height, low, high, data } => FrameView::new(
                data,
                *width,
                *height,
                width * 2,
                PixelFormat::Y16 { low: *low, high: *high },
            ),
        }
    }

    /// Sensor by path, else by pixels.
    pub(super) fn modality(&self, path: &Path) -> Modality {
        modality::from_path(path).unwrap_or_else(|| match self {
            Self::Eight(picture) => modality::from_pixels(picture),
            Self::Sixteen { .. } => Modality::Thermal,
        })
    }
}

/// A reader for the format that the content shows.
fn reader<R: BufRead + Seek>(mut input: R, name: &Path) -> Result<ImageReader<R>, SourceError> {
    let io = |source| SourceError::Io { path: name.to_path_buf(), source };
    if input.fill_buf().map_err(io)?.is_empty() {
        let reason = "the file is empty".into();
        return Err(SourceError::Decode { path: name.to_path_buf(), reason });
    }
    ImageReader::new(input).with_guessed_format().map_err(io)
}

fn size<R: BufRead + Seek>(
    reader: ImageReader<R>,
    name: &Path,
) -> Result<(usize, usize), SourceError> {
    let (width, height) = reader
        .into_dimensions()
        .map_err(|e| SourceError::Decode { path: name.to_path_buf(), reason: e.to_string() })?;
    Ok((width as usize, height as usize))
}

/// First and last percentile of the raw values: a few dead or burning pixels do not set the scale.
fn shown_range(raw: &[u16]) -> (u16, u16) {
    let mut sample: Vec<u16> = raw.iter().step_by((raw.len() / 20_000).max(1)).copied().collect();
    sample.sort_unstable();
    let at = |share: usize| sample.get(sample.len() * share / 100).copied().unwrap_or(0);
    let (low, high) = (at(1), at(99));
    if high > low { (low, high) } else { (low.min(u16::MAX - 1), low.max(1).saturating_add(1)) }
}
