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

/// Overlap of two boxes as the VOT toolkit counts it (0.7.4 and 0.9.0 alike): sides are rounded to
/// whole pixels, the pixels of both are drawn into the smallest canvas that holds them, cut to the
/// picture where its size is given, and counted. 0 for NaN, and where no pixel is drawn.
///
/// Two of its habits are kept, because published figures contain them:
///
/// - a canvas that is one pixel wide or high counts as two empty regions, which agree: 1; when only
///   cutting made it so, 0;
/// - without a picture, a canvas that begins left of or above 0 loses as many pixels on its far side:
///   boxes are drawn up to the canvas's last *coordinate*, taken for an index. One that ends below
///   0, too, counts that index from the far side.
pub fn vot_overlap(truth: Row, predicted: Row, image: Option<(u32, u32)>) -> f64 {
    if truth.iter().chain(&predicted).any(|v| !v.is_finite()) {
        return 0.0;
    }
    // Single precision decides which way a side of almost half a pixel is rounded.
    let boxes = [truth, predicted].map(|r| r.map(|v| f64::from((v as f32).round_ties_even())));
    let axis = |first: usize, image: Option<u32>| {
        Canvas::new(boxes.map(|r| [r[first], r[first + 2]]), image.map(f64::from))
    };
    let (x, y) = (axis(0, image.map(|i| i.0)), axis(1, image.map(|i| i.1)));
    if x.thin || y.thin {
        return 1.0;
    }
    if x.thin_after_cut || y.thin_after_cut {
        return 0.0;
    }
    let area = |i: usize| length(x.spans[i]) * length(y.spans[i]);
    let inter = length(common(x.spans)) * length(common(y.spans));
    let union = area(0) + area(1) - inter;
    if union > 0.0 { inter / union } else { 0.0 }
}

/// One axis of the VOT toolkit's canvas: where two boxes are drawn on it.
struct Canvas {
    /// First pixel drawn and first one after them, counted from the canvas's first.
    spans: [[f64; 2]; 2],
    /// Not more than one pixel.
    thin: bool,
    thin_after_cut: bool,
}

impl Canvas {
    /// For whole `[start, length]` of both boxes and the picture's length.
    fn new(boxes: [[f64; 2]; 2], image: Option<f64>) -> Self {
        let last = |[start, length]: [f64; 2]| start + length - 1.0;
        let (low, high) = (boxes[0][0].min(boxes[1][0]), last(boxes[0]).max(last(boxes[1])));
        let thin = low >= high;
        let (low, high) = image.map_or((low, high), |image| (low.max(0.0), high.min(image - 1.0)));
        let size = high - low + 1.0;
        let span = |b: [f64; 2]| {
            let start = (b[0] - low).max(0.0);
            let mut end = (last(b) - low).min(high) + 1.0;
            if low < 0.0 && end < 0.0 {
                end += size;
            }
            // What ends before the canvas is not drawn, and gets no pixels by the wrapped index.
            let end = if last(b) < low { start } else { end.min(size) };
            [start, end]
        };
        Self { spans: boxes.map(span), thin, thin_after_cut: low >= high }
    }
}

fn length([start, end]: [f64; 2]) -> f64 {
    (end - start).max(0.0)
}

fn common([a, b]: [[f64; 2]; 2]) -> [f64; 2] {
    [a[0].max(b[0]), a[1].min(b[1])]
}
