//! Boxes and sensors: the two words every crate shares.

use serde::{Deserialize, Serialize};

/// Which kind of sensor a picture came from. Nothing in the network depends on it; protocols,
/// samplers and logs do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Modality {
    /// Visible light, three channels.
    Rgb,
    /// Long-wave infrared, one channel (replicated to three for the network).
    Thermal,
}

impl Modality {
    /// The other sensor.
    pub const fn other(self) -> Self {
        match self {
            Self::Rgb => Self::Thermal,
            Self::Thermal => Self::Rgb,
        }
    }

    /// Lower-case name as used in configurations and results.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Rgb => "rgb",
            Self::Thermal => "thermal",
        }
    }
}

impl core::fmt::Display for Modality {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.as_str())
    }
}

/// Axis-aligned box in pixels, origin at the top-left corner of the picture, continuous edges:
/// the box covers `[x, x + w) x [y, y + h)`, and a picture of width `W` covers `[0, W)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BBox {
    /// Left edge.
    pub x: f32,
    /// Top edge.
    pub y: f32,
    /// Width.
    pub w: f32,
    /// Height.
    pub h: f32,
}

impl BBox {
    /// A box from its left, top, width and height.
    pub const fn new(x: f32, y: f32, w: f32, h: f32) -> Self {
        Self { x, y, w, h }
    }

    /// All four numbers finite and both sides longer than zero.
    pub fn is_valid(&self) -> bool {
        self.x.is_finite()
            && self.y.is_finite()
            && self.w.is_finite()
            && self.h.is_finite()
            && self.w > 0.0
            && self.h > 0.0
    }

    /// Right edge, `x + w`.
    pub fn right(&self) -> f32 {
        self.x + self.w
    }

    /// Bottom edge, `y + h`.
    pub fn bottom(&self) -> f32 {
        self.y + self.h
    }

    /// Centre `(x, y)` between the continuous edges.
    pub fn centre(&self) -> (f32, f32) {
        (self.x + self.w * 0.5, self.y + self.h * 0.5)
    }

    /// Area in square pixels; zero when a side is not positive.
    pub fn area(&self) -> f32 {
        if self.w > 0.0 && self.h > 0.0 { self.w * self.h } else { 0.0 }
    }

    /// Intersection over union with continuous edges, in `[0, 1]`; 0 when either box is empty.
    pub fn iou(&self, other: &Self) -> f32 {
        let w = self.right().min(other.right()) - self.x.max(other.x);
        let h = self.bottom().min(other.bottom()) - self.y.max(other.y);
        if w <= 0.0 || h <= 0.0 {
            return 0.0;
        }
        let inter = w * h;
        let union = self.area() + other.area() - inter;
        if union > 0.0 { inter / union } else { 0.0 }
    }

    /// Does any part of the box lie inside a picture of this size?
    pub fn overlaps_image(&self, width: usize, height: usize) -> bool {
        self.x < width as f32 && self.y < height as f32 && self.right() > 0.0 && self.bottom() > 0.0
    }
}

/// A position or offset, vertical first: the order of the specification's image quantities.
/// Positions of the tracker are pixel-**centre** coordinates: pixel 0 is at 0, its left edge at -0.5
/// (spec 3).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Yx {
    /// Vertical, downwards.
    pub y: f32,
    /// Horizontal, to the right.
    pub x: f32,
}

impl Yx {
    /// From vertical and horizontal.
    pub const fn new(y: f32, x: f32) -> Self {
        Self { y, x }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn boxes() -> impl Strategy<Value = BBox> {
        (-50f32..50.0, -50f32..50.0, 0.1f32..80.0, 0.1f32..80.0)
            .prop_map(|(x, y, w, h)| BBox::new(x, y, w, h))
    }

    proptest! {
        #[test]
        fn iou_is_symmetric_bounded_and_one_on_itself(a in boxes(), b in boxes()) {
            prop_assert!((a.iou(&b) - b.iou(&a)).abs() < 1e-5);
            prop_assert!((0.0..=1.0 + 1e-5).contains(&a.iou(&b)));
            prop_assert!((a.iou(&a) - 1.0).abs() < 1e-3);
        }

        #[test]
        fn iou_does_not_move_with_the_picture(a in boxes(), b in boxes(), d in -20f32..20.0) {
            let shift = |v: BBox| BBox::new(v.x + d, v.y - d, v.w, v.h);
            prop_assert!((a.iou(&b) - shift(a).iou(&shift(b))).abs() < 1e-3);
        }
    }

    #[test]
    fn known_overlaps() {
        let a = BBox::new(0.0, 0.0, 10.0, 10.0);
        for (b, want) in [
            (BBox::new(5.0, 0.0, 10.0, 10.0), 50.0 / 150.0),
            (BBox::new(10.0, 0.0, 10.0, 10.0), 0.0),
            (BBox::new(2.0, 2.0, 5.0, 5.0), 0.25),
            (BBox::new(0.0, 0.0, 0.0, 0.0), 0.0),
        ] {
            assert!((a.iou(&b) - want).abs() < 1e-6, "{b:?}");
        }
    }

    #[test]
    fn only_finite_boxes_with_area_are_valid() {
        assert!(BBox::new(-3.0, 2.0, 1.0, 1.0).is_valid());
        for b in [
            BBox::new(0.0, 0.0, 0.0, 1.0),
            BBox::new(0.0, 0.0, 1.0, -1.0),
            BBox::new(f32::NAN, 0.0, 1.0, 1.0),
            BBox::new(0.0, 0.0, f32::INFINITY, 1.0),
        ] {
            assert!(!b.is_valid(), "{b:?}");
        }
    }
}
