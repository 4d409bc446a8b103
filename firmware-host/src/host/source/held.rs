//! A picture kept by the host, in any format.

use tsda_runtime::{FrameError, FrameView, PixelFormat};

/// Bytes and how to read them.
#[derive(Clone, Debug)]
pub struct Held {
    data: Vec<u8>,
    width: usize,
    height: usize,
    stride: usize,
    format: PixelFormat,
}

impl Held {
    /// No picture yet.
    pub const fn empty() -> Self {
        Self { data: Vec::new(), width: 0, height: 0, stride: 0, format: PixelFormat::Gray8 }
    }

    /// A copy of a view.
    pub fn of(view: &FrameView<'_>) -> Self {
        let mut held = Self::empty();
        held.hold(view);
        held
    }

    /// Becomes a copy of a view; the buffer grows once.
    pub fn hold(&mut self, view: &FrameView<'_>) {
        self.data.clear();
        self.data.extend_from_slice(view.data());
        (self.width, self.height) = (view.width(), view.height());
        (self.stride, self.format) = (view.stride(), view.format());
    }

    /// Every byte becomes this.
    pub fn fill(&mut self, byte: u8) {
        self.data.fill(byte);
    }

    /// An 8-bit grey picture as 16-bit words: `offset + value * step`.
    pub fn widen(&mut self, offset: u16, step: u16) {
        let words: Vec<u8> = (0..self.height)
            .flat_map(|y| &self.data[y * self.stride..][..self.width])
            .flat_map(|v| (offset.saturating_add(step.saturating_mul(u16::from(*v)))).to_le_bytes())
            .collect();
        self.data = words;
        self.stride = self.width * 2;
        self.format = PixelFormat::Y16 { low: 0, high: u16::MAX };
    }

    /// The picture.
    ///
    /// # Errors
    /// When it was never filled.
    pub fn view(&self) -> Result<FrameView<'_>, FrameError> {
        FrameView::new(&self.data, self.width, self.height, self.stride, self.format)
    }
}
