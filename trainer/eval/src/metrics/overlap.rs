//! Per-frame comparison of two boxes in the arithmetic of each toolkit.

use super::FrameErrors;
use super::score::Row;

/// What `rgbt` 1.0.1 computes, operation by operation in single precision. `corner_centre`: the
/// centre is `x + w / 2` (GTOT) instead of `x + (w - 1) / 2`.
pub(super) fn single(truth: Row, predicted: Row, corner_centre: bool) -> FrameErrors {
    if truth.iter().chain(&predicted).any(|v| !v.is_finite()) {
        return FrameErrors::MISS;
    }
    let t = truth.map(|v| v as f32);
    let p = predicted.map(|v| v as f32);
    let iou = {
        let corners = |r: [f32; 4]| [r[0], r[1], r[2] + r[0] - 1.0, r[3] + r[1] - 1.0];
        let (a, b) = (corners(p), corners(t));
        let side =
            |low: usize, high: usize| (a[high].min(b[high]) - a[low].max(b[low]) + 1.0).max(0.0);
        let inter = side(0, 2) * side(1, 3);
        inter / (p[3] * p[2] + t[3] * t[2] - inter)
    };
    let pixel = if corner_centre { 0.0 } else { 1.0 };
    let centre = |r: [f32; 4]| [(r[2] - pixel) / 2.0 + r[0], (r[3] - pixel) / 2.0 + r[1]];
    let (pc, tc) = (centre(p), centre(t));
    let norm = |dx: f32, dy: f32| (dx * dx + dy * dy).sqrt();
    // The toolkit divides each centre before it subtracts, which decides offsets of exactly 0.2.
    let eps = 1e-8;
    let scaled = |c: [f32; 2]| [c[0] / (t[2] + eps), c[1] / (t[3] + eps)];
    let (ps, ts) = (scaled(pc), scaled(tc));
    FrameErrors {
        iou: f64::from(iou),
        centre: f64::from(norm(pc[0] - tc[0], pc[1] - tc[1])),
        normalised: f64::from(norm(ps[0] - ts[0], ps[1] - ts[1])),
    }
    .nan_is_miss()
}

/// What the GOT-10k toolkit computes, in double precision; `image` is its width and height, which
/// boxes are cut to.
pub(super) fn double(truth: Row, predicted: Row, image: Option<[f64; 2]>) -> FrameErrors {
    if truth.iter().chain(&predicted).any(|v| !v.is_finite()) {
        return FrameErrors::MISS;
    }
    let (mut a, mut b) = (predicted, truth);
    if let Some(size) = image {
        // The toolkit moves the corner inside and keeps the width, up to the border.
        for r in [&mut a, &mut b] {
            for axis in 0..2 {
                r[axis] = r[axis].clamp(0.0, size[axis]);
                r[axis + 2] = r[axis + 2].clamp(0.0, size[axis] - r[axis]);
            }
        }
    }
    let side = |axis: usize| {
        ((a[axis] + a[axis + 2]).min(b[axis] + b[axis + 2]) - a[axis].max(b[axis])).max(0.0)
    };
    let inter = side(0) * side(1);
    let union = a[2] * a[3] + b[2] * b[3] - inter;
    let centre = |r: Row| [r[0] + (r[2] - 1.0) / 2.0, r[1] + (r[3] - 1.0) / 2.0];
    let (pc, tc) = (centre(predicted), centre(truth));
    let (dx, dy) = (pc[0] - tc[0], pc[1] - tc[1]);
    let (nx, ny) = (dx / truth[2].max(1.0), dy / truth[3].max(1.0));
    FrameErrors {
        iou: (inter / (union + f64::EPSILON)).clamp(0.0, 1.0),
        centre: (dx * dx + dy * dy).sqrt(),
        normalised: (nx * nx + ny * ny).sqrt(),
    }
    .nan_is_miss()
}

impl FrameErrors {
    /// A frame outside every threshold.
    pub(super) const MISS: Self =
        Self { iou: 0.0, centre: f64::INFINITY, normalised: f64::INFINITY };

    /// NaN compares false with every threshold in the toolkits: a miss.
    fn nan_is_miss(self) -> Self {
        let or_miss = |v: f64, miss: f64| if v.is_nan() { miss } else { v };
        Self {
            iou: or_miss(self.iou, 0.0),
            centre: or_miss(self.centre, f64::INFINITY),
            normalised: or_miss(self.normalised, f64::INFINITY),
        }
    }

    /// The better of two truths, figure by figure.
    pub(super) fn better(self, other: Self) -> Self {
        Self {
            iou: self.iou.max(other.iou),
            centre: self.centre.min(other.centre),
            normalised: self.normalised.min(other.normalised),
        }
    }
}

/// Overlap of two boxes as the VOT toolkit counts it: both are set on the pixel grid (position and
/// size rounded), cut to the picture (without a size: to non-negative coordinates), and their
/// pixels compared. 0 for boxes without pixels or with NaN.
pub fn vot_overlap(truth: Row, predicted: Row, image: Option<(u32, u32)>) -> f64 {
    if truth.iter().chain(&predicted).any(|v| !v.is_finite()) {
        return 0.0;
    }
    let (width, height) =
        image.map_or((f64::INFINITY, f64::INFINITY), |(w, h)| (f64::from(w), f64::from(h)));
    let cut = |r: Row| {
        let r = r.map(f64::round_ties_even);
        let (x, y) = (r[0].clamp(0.0, width), r[1].clamp(0.0, height));
        [x, y, (r[0] + r[2]).clamp(x, width.max(x)), (r[1] + r[3]).clamp(y, height.max(y))]
    };
    let area = |r: Row| (r[2] - r[0]).max(0.0) * (r[3] - r[1]).max(0.0);
    let (a, b) = (cut(truth), cut(predicted));
    let inter = area([a[0].max(b[0]), a[1].max(b[1]), a[2].min(b[2]), a[3].min(b[3])]);
    let union = area(a) + area(b) - inter;
    if union > 0.0 { inter / union } else { 0.0 }
}
