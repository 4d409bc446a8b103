//! Decoded pictures that the host owns.

use tsda_runtime::{FrameError, FrameView, PixelFormat};

/// An 8-bit picture, rows tightly packed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
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
    /// Makes this a black picture of the given shape, keeping the buffer.
    pub fn reset(&mut self, width: usize, height: usize, channels: usize) {
        (self.width, self.height, self.channels) = (width, height, channels);
        self.data.clear();
        self.data.resize(width * height * channels, 0);
    }

    /// The picture as the tracker reads it.
    ///
    /// # Errors
    /// When a side is zero or the buffer too short.
    pub fn view(&self) -> Result<FrameView<'_>, FrameError> {
        let format = if self.channels == 1 { PixelFormat::Gray8 } else { PixelFormat::Rgb8 };
        FrameView::new(&self.data, self.width, self.height, self.width * self.channels, format)
    }

    /// Red, green, blue of a pixel.
    pub fn rgb(&self, x: usize, y: usize) -> [u8; 3] {
        let i = (y * self.width + x) * self.channels;
        if self.channels == 1 {
            [self.data[i]; 3]
        } else {
            [self.data[i], self.data[i + 1], self.data[i + 2]]
        }
    }
}
