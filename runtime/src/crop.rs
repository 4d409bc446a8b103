//! Cutting the search area out of a picture, straight into the network's input (spec 3.3, 3.4).
//!
//! [`Window::new`] turns a position and a size into whole pixels and real-valued coordinates;
//! [`reference()`] reads just those pixels of the picture that the resampling needs, in its
//! own format, and writes normalised planes. Nothing is copied or converted as a whole, so the cost
//! follows the crop and not the sensor.
//!
//! Positions here are pixel-centre coordinates (vertical first), as everywhere in the tracker.

use crate::frame::FrameView;
use crate::geometry::{BBox, Yx};
use crate::spec::ModelSpec;

mod sample;

pub use sample::reference;

/// What happens when a crop reaches over the picture's edge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Border {
    /// The edge pixels are repeated; position and size stay. First template.
    Replicate,
    /// The crop shrinks by at most `max_scale_change` until its shorter overhang fits, then moves
    /// inside; what still hangs over is repeated edge. Search areas.
    InsideMajor {
        /// Largest factor by which it may shrink.
        max_scale_change: f32,
    },
    /// Like [`Self::InsideMajor`], but shrinks until both axes fit.
    Inside {
        /// Largest factor by which it may shrink.
        max_scale_change: f32,
    },
}

/// Corners of a crop in image pixels, real-valued: what crop coordinates are mapped back with.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Patch {
    /// Top-left corner.
    pub tl: Yx,
    /// Bottom-right corner.
    pub br: Yx,
}

impl Patch {
    /// Position of the crop's centre (pixel-centre coordinates).
    pub fn sample_pos(&self) -> Yx {
        Yx::new(0.5 * (self.tl.y + self.br.y - 1.0), 0.5 * (self.tl.x + self.br.x - 1.0))
    }

    /// Image pixels per crop pixel, geometric mean of both axes, for a crop of this side.
    pub fn sample_scale(&self, side: f32) -> f32 {
        libm::sqrtf((self.br.y - self.tl.y) / side * ((self.br.x - self.tl.x) / side))
    }

    /// A box in pixels of a crop of this side, mapped to image pixels (spec 3.5, step 4).
    pub fn to_image(&self, bbox: &BBox, side: f32) -> BBox {
        let x = |v: f32| v / side * (self.br.x - self.tl.x) + self.tl.x;
        let y = |v: f32| v / side * (self.br.y - self.tl.y) + self.tl.y;
        let (left, top) = (x(bbox.x), y(bbox.y));
        BBox::new(left, top, x(bbox.right()) - left, y(bbox.bottom()) - top)
    }
}

/// One axis of a [`Window`], in pixels of the decimated picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Axis {
    /// First picture row or column that the decimation keeps.
    offset: usize,
    /// Length of the decimated picture, at least 1.
    image: usize,
    /// First pixel of the window; may lie outside.
    start: i64,
    /// Pixels in the window, at least 1.
    len: usize,
}

/// Which pixels a crop is made from (spec 3.4).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    y: Axis,
    x: Axis,
    /// Only every n-th row and column is read.
    decimation: usize,
    /// Side of the output before any margin is cut off.
    side: usize,
    /// Margin left out on every side of the output.
    margin: usize,
    patch: Patch,
}

/// A crop that cannot be computed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CropError {
    /// Position or size is not a number, or the size not positive.
    #[error(
        "crop at y {y}, x {x} with a side of {size} pixels: all must be finite, the side positive"
    )]
    Position {
        /// Vertical position.
        y: f32,
        /// Horizontal position.
        x: f32,
        /// Side in image pixels.
        size: f32,
    },
    /// The output slice has the wrong length.
    #[error("crop output holds {len} numbers, {needed} are needed")]
    Output {
        /// Length given.
        len: usize,
        /// Length needed.
        needed: usize,
    },
}

/// Rounds to the nearest whole number, halves to the even one, as the reference does everywhere
/// (quirk Q8).
pub fn round_half_even(v: f32) -> f32 {
    libm::rintf(v)
}

impl Window {
    /// Plans a square crop: `size` image pixels around `pos`, resampled to `output` pixels.
    ///
    /// # Errors
    /// When position or size is not finite or the size not positive.
    pub fn new(
        frame: &FrameView<'_>,
        pos: Yx,
        size: f32,
        output: usize,
        border: Border,
    ) -> Result<Self, CropError> {
        if !(pos.y.is_finite() && pos.x.is_finite() && size.is_finite() && size > 0.0) {
            return Err(CropError::Position { y: pos.y, x: pos.x, size });
        }
        let (height, width) = (frame.height() as f32, frame.width() as f32);
        let limit = |ratio: f32, max: f32| libm::truncf(size / ratio.max(1.0).min(max.max(1.0)));
        let size = match border {
            Border::Replicate => size,
            Border::InsideMajor { max_scale_change } => {
                limit((size / height).min(size / width), max_scale_change)
            }
            Border::Inside { max_scale_change } => {
                limit((size / height).max(size / width), max_scale_change)
            }
        };
        let decimation = libm::truncf(size / output.max(1) as f32 - 0.1).max(1.0);
        // Half to even, then at least two pixels.
        let n = libm::truncf(round_half_even(size / decimation).max(2.0));
        let shift = border != Border::Replicate;
        let step = (decimation as usize).max(1);
        let (y, top, bottom) = axis(frame.height(), pos.y, step, n, shift);
        let (x, left, right) = axis(frame.width(), pos.x, step, n, shift);
        let patch = Patch {
            tl: Yx::new(decimation * top, decimation * left),
            br: Yx::new(decimation * bottom, decimation * right),
        };
        Ok(Self { y, x, decimation: step, side: output, margin: 0, patch })
    }

    /// The window of a tracker's search area (spec 3.5, step 1).
    ///
    /// # Errors
    /// See [`Self::new`].
    pub fn search(
        frame: &FrameView<'_>,
        pos: Yx,
        size: f32,
        spec: &ModelSpec,
        max_scale_change: f32,
    ) -> Result<Self, CropError> {
        Self::new(frame, pos, size, spec.crop_side(), Border::InsideMajor { max_scale_change })
    }

    /// The window of the first template (spec 3.3): twice the search area with repeated edges, of
    /// which only the middle is computed. `pos` is rounded half to even by the caller, `scale` is
    /// in image pixels per crop pixel.
    ///
    /// # Errors
    /// See [`Self::new`].
    pub fn first(
        frame: &FrameView<'_>,
        pos: Yx,
        scale: f32,
        spec: &ModelSpec,
    ) -> Result<Self, CropError> {
        let double = 2 * spec.crop_side();
        let window = Self::new(frame, pos, scale * double as f32, double, Border::Replicate)?;
        // The side is a multiple of 16, so half of it is whole.
        Ok(Self { margin: spec.crop_side() / 2, ..window })
    }

    /// Corners in image pixels (of the whole output, also when a margin is cut off).
    pub const fn patch(&self) -> Patch {
        self.patch
    }

    /// Side of the output in pixels.
    pub const fn output(&self) -> usize {
        self.side - 2 * self.margin
    }
}

/// Steps 3 to 7 of spec 3.4 for one axis: the whole-pixel window and the real-valued edges, all in
/// pixels of the decimated picture.
fn axis(image: usize, pos: f32, step: usize, n: f32, shift_inside: bool) -> (Axis, f32, f32) {
    let pos = libm::truncf(pos);
    let whole = to_int(pos);
    let stride = i64::try_from(step).unwrap_or(i64::MAX);
    // An offset beyond the picture would leave nothing; then its first pixel is kept.
    let offset = whole.rem_euclid(stride).min(image as i64 - 1);
    let image = (image - offset as usize).div_ceil(step);
    let p = if step == 1 { pos } else { ((whole - offset) / stride) as f32 };
    let mut low = p - (n - 1.0) * 0.5;
    let mut high = p + n * 0.5 + 1.0;
    if shift_inside {
        let side = image as f32;
        let shift = (-low).max(0.0) - (high - side).max(0.0);
        low += shift;
        high += shift;
        let out = libm::floorf(((-low).max(0.0) + (high - side).max(0.0)) * 0.5);
        if out > 0.0 {
            let shift = -low - out;
            low += shift;
            high += shift;
        }
    }
    // Toward zero on purpose (quirk Q7).
    let (start, end) = (to_int(libm::truncf(low)), to_int(libm::truncf(high)));
    let len = usize::try_from((end - start).max(1)).unwrap_or(usize::MAX);
    (Axis { offset: offset as usize, image, start, len }, low, high)
}

/// To a whole number, kept far from the ends of the type so that sums cannot overflow.
fn to_int(v: f32) -> i64 {
    (v as i64).clamp(-(1 << 40), 1 << 40)
}

/// Where one output coordinate reads: two coordinates and the weight of the second.
#[derive(Clone, Copy, Default)]
struct Tap {
    near: usize,
    far: usize,
    weight: f32,
}

impl Axis {
    fn tap(&self, output: usize, ratio: f32, step: usize) -> Tap {
        let source = (ratio * (output as f32 + 0.5) - 0.5).max(0.0);
        let index = (source as usize).min(self.len - 1);
        let pixel = |i: usize| {
            let inside = self.start.saturating_add_unsigned(i as u64);
            self.offset + step * inside.clamp(0, self.image as i64 - 1) as usize
        };
        let far = (index + 1).min(self.len - 1);
        Tap { near: pixel(index), far: pixel(far), weight: source - index as f32 }
    }
}

#[cfg(test)]
mod tests;
