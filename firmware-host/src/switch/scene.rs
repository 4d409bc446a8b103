//! What a picture looks like as a whole: brightness, contrast, and whether it changes at all.

use tsda_runtime::{FrameView, PixelFormat};

/// Samples per picture, across and down.
const GRID: (usize, usize) = (48, 36);

/// Statistics of one picture, from a grid of samples; levels are shares of the format's full scale.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Scene {
    /// Mean level, in `[0, 1]`.
    pub brightness: f32,
    /// Standard deviation of the level, in `[0, 0.5]`.
    pub contrast: f32,
    /// Share of samples at the bottom of the scale.
    pub dark: f32,
    /// Share of samples at the top of the scale.
    pub bright: f32,
    /// Equal for equal pictures; noise alone makes two pictures differ.
    pub digest: u64,
}

impl Scene {
    /// Looks at some two thousand pixels. `full` is the largest value of a 16-bit sensor (1023 for
    /// ten bits); other formats do not use it.
    pub fn measure(view: &FrameView<'_>, full: u16) -> Self {
        let (data, stride) = (view.data(), view.stride());
        let limited =
            matches!(view.format(), PixelFormat::Yuyv | PixelFormat::Uyvy | PixelFormat::Nv12);
        // Where limited-range luma is black and white.
        let (black, white) = match view.format() {
            PixelFormat::Y16 { .. } => (0.0, f32::from(full.max(1))),
            _ if limited => (16.0, 235.0),
            _ => (0.0, 255.0),
        };
        let (columns, rows) = (GRID.0.min(view.width()), GRID.1.min(view.height()));
        let (mut sum, mut squares, mut dark, mut bright) = (0f32, 0f32, 0u32, 0u32);
        let mut digest = 0xCBF2_9CE4_8422_2325u64;
        for r in 0..rows {
            let row = (2 * r + 1) * view.height() / (2 * rows) * stride;
            for c in 0..columns {
                let x = (2 * c + 1) * view.width() / (2 * columns);
                let raw = match view.format() {
                    PixelFormat::Rgb8 | PixelFormat::Bgr8 => u16::from(data[row + 3 * x + 1]),
                    PixelFormat::Y16 { .. } => {
                        u16::from_le_bytes([data[row + 2 * x], data[row + 2 * x + 1]])
                    }
                    PixelFormat::Yuyv => u16::from(data[row + 2 * x]),
                    PixelFormat::Uyvy => u16::from(data[row + 2 * x + 1]),
                    _ => u16::from(data[row + x]),
                };
                digest = (digest ^ u64::from(raw)).wrapping_mul(0x0100_0000_01B3);
                let level = ((f32::from(raw) - black) / (white - black)).clamp(0.0, 1.0);
                sum += level;
                squares += level * level;
                dark += u32::from(level <= 0.016);
                bright += u32::from(level >= 0.984);
            }
        }
        let n = (rows * columns) as f32;
        let brightness = sum / n;
        Self {
            brightness,
            contrast: (squares / n - brightness * brightness).max(0.0).sqrt(),
            dark: dark as f32 / n,
            bright: bright as f32 / n,
            digest,
        }
    }
}
