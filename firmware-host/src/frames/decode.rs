//! Picture files into memory.

use super::{SourceError, modality};
use crate::picture::Picture;
use image::{DynamicImage, ImageReader};
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
        let io = |source| SourceError::Io { path: path.to_path_buf(), source };
        let bad = |reason: String| SourceError::Decode { path: path.to_path_buf(), reason };
        let bytes = std::fs::read(path).map_err(io)?;
        if bytes.is_empty() {
            return Err(bad("the file is empty".into()));
        }
        let image = ImageReader::new(std::io::Cursor::new(&bytes))
            .with_guessed_format()
            .map_err(io)?
            .decode()
            .map_err(|e| bad(e.to_string()))?;
        Self::from_image(image)
            .map_err(|source| SourceError::Frame { name: path.display().to_string(), source })
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

/// First and last percentile of the raw values: a few dead or burning pixels do not set the scale.
fn shown_range(raw: &[u16]) -> (u16, u16) {
    let mut sample: Vec<u16> = raw.iter().step_by((raw.len() / 20_000).max(1)).copied().collect();
    sample.sort_unstable();
    let at = |share: usize| sample.get(sample.len() * share / 100).copied().unwrap_or(0);
    let (low, high) = (at(1), at(99));
    if high > low { (low, high) } else { (low.min(u16::MAX - 1), low.max(1).saturating_add(1)) }
}
