//! One PNG per frame.

use super::overlay::{Limits, Overlay};
use crate::error::HostError;
use crate::output::PartDir;
use crate::picture::Picture;
use crate::track::{Sink, Step};
use image::ImageEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use std::io::Write;
use std::path::Path;
use tsda_runtime::{BBox, FrameView};

/// Encodes an RGB picture.
pub(super) fn encode(picture: &Picture, out: impl Write) -> image::ImageResult<()> {
    PngEncoder::new_with_quality(out, CompressionType::Fast, FilterType::Adaptive).write_image(
        &picture.data,
        picture.width as u32,
        picture.height as u32,
        image::ExtendedColorType::Rgb8,
    )
}

/// A folder with `000000.png`, `000001.png`, ...
#[derive(Debug)]
pub struct PngFolder {
    dir: PartDir,
    overlay: Overlay,
}

impl PngFolder {
    /// Starts filling a folder.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn create(path: &Path, total: Option<usize>) -> Result<Self, HostError> {
        let overlay = Overlay::new(Limits { min: 320, max: 4096 }, total);
        Ok(Self { dir: PartDir::create(path)?, overlay })
    }
}

impl Sink for PngFolder {
    fn frame(
        &mut self,
        view: &FrameView<'_>,
        step: &Step,
        truth: Option<BBox>,
    ) -> Result<(), HostError> {
        let picture = self.overlay.draw(view, step, truth);
        let place = self.dir.place(&format!("{:06}.png", step.frame));
        let mut bytes = Vec::new();
        encode(picture, &mut bytes)
            .map_err(|e| HostError::Encode { path: place.clone(), reason: e.to_string() })?;
        std::fs::write(&place, bytes).map_err(|source| HostError::Write { path: place, source })
    }

    fn finish(self: Box<Self>) -> Result<(), HostError> {
        self.dir.commit()
    }
}
