//! What a tracker has to beat: a box that never moves, and template matching without update.

use tsda_runtime::{BBox, Modality};

use crate::dataset::Picture;
use crate::protocol::{TrackerError, TrackerUnderTest};

/// Answers the first box for ever.
#[derive(Clone, Debug, Default)]
pub struct StaticBox {
    bbox: Option<BBox>,
}

impl TrackerUnderTest for StaticBox {
    fn name(&self) -> &str {
        "static box"
    }

    fn timed(&self) -> bool {
        false
    }

    fn init(&mut self, _: &Picture, bbox: BBox, _: Modality) -> Result<(), TrackerError> {
        self.bbox = Some(bbox);
        Ok(())
    }

    fn update(&mut self, _: &Picture, _: Modality) -> Result<(BBox, f32), TrackerError> {
        self.bbox.map(|b| (b, 1.0)).ok_or_else(not_initialised)
    }
}

fn not_initialised() -> TrackerError {
    TrackerError::new("update before init: give the first frame with its box first")
}

/// What a [`TemplateMatcher`] compares.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MatchOn {
    /// Grey values: the classic; fails where hot is not bright.
    Grey,
    /// Gradient magnitude: outlines are more alike between sensors than brightness is.
    Gradient,
}

/// Normalised cross-correlation with the first frame's template, never updated.
///
/// The search area has `search_factor` times the side `sqrt(w h)` of the last box, like the
/// networks'; three sizes are tried. Everything is resampled so that the target covers about
/// 20 x 20 pixels.
#[derive(Clone, Debug)]
pub struct TemplateMatcher {
    on: MatchOn,
    search_factor: f64,
    state: Option<Matching>,
}

#[derive(Clone, Debug)]
struct Matching {
    template: Template,
    bbox: BBox,
}

/// Zero-mean, unit-length template on the working grid.
#[derive(Clone, Debug)]
struct Template {
    values: Vec<f32>,
    width: usize,
    height: usize,
}

/// Geometric mean of the target's sides on the working grid.
const GRID: f64 = 20.0;
/// Size of the search areas tried, relative to the last box.
const SIZES: [f64; 3] = [1.0, 0.95, 1.05];
/// Offsets at the rim of the search area count this much less than those in the middle: a target
/// rarely jumps, and look-alikes stand around it.
const MOTION: f32 = 0.6;
/// A change of size must pay: other sizes count a little less.
const CHANGE_WEIGHT: f32 = 0.985;

impl TemplateMatcher {
    /// A matcher with the nano network's search factor of 4.
    pub fn new(on: MatchOn) -> Self {
        Self { on, search_factor: 4.0, state: None }
    }

    fn feature(&self, patch: Patch) -> Patch {
        match self.on {
            MatchOn::Grey => patch,
            MatchOn::Gradient => patch.gradient(),
        }
    }
}

impl TrackerUnderTest for TemplateMatcher {
    fn name(&self) -> &str {
        match self.on {
            MatchOn::Grey => "template matcher (grey)",
            MatchOn::Gradient => "template matcher (gradient)",
        }
    }

    fn init(&mut self, frame: &Picture, bbox: BBox, _: Modality) -> Result<(), TrackerError> {
        if !bbox.is_valid() {
            return Err(TrackerError::new(format!("first box {bbox:?} has no area")));
        }
        let step = sides(bbox) / GRID;
        // Very long targets would leave the grid: at least 4, at most 3 grids wide.
        let cells = |side: f32| ((f64::from(side) / step).round() as usize).clamp(4, 60);
        let (width, height) = (cells(bbox.w), cells(bbox.h));
        let (cx, cy) = bbox.centre();
        // One cell more on every side, so that gradients at the rim see the neighbours.
        let patch = Patch::cut(frame, (cx.into(), cy.into()), step, width + 2, height + 2);
        let patch = self.feature(patch);
        let mut values = Vec::with_capacity(width * height);
        for y in 1..=height {
            let row = y * patch.width;
            values.extend_from_slice(&patch.values[row + 1..row + 1 + width]);
        }
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        values.iter_mut().for_each(|v| *v -= mean);
        let length = values.iter().map(|v| v * v).sum::<f32>().sqrt();
        if length > 1e-6 {
            values.iter_mut().for_each(|v| *v /= length);
        }
        self.state = Some(Matching { template: Template { values, width, height }, bbox });
        Ok(())
    }

    fn update(&mut self, frame: &Picture, _: Modality) -> Result<(BBox, f32), TrackerError> {
        let Some(Matching { template, bbox }) = &self.state else {
            return Err(not_initialised());
        };
        let (cx, cy) = bbox.centre();
        let side = (self.search_factor * GRID).round() as usize;
        let mut best: Option<(f32, f32, BBox)> = None;
        for size in SIZES {
            let step = sides(*bbox) * size / GRID;
            let (width, height) = (side.max(template.width), side.max(template.height));
            let patch = Patch::cut(frame, (cx.into(), cy.into()), step, width, height);
            let peak = correlate(&self.feature(patch), template, MOTION);
            let weight = if size == 1.0 { 1.0 } else { CHANGE_WEIGHT };
            if best.is_none_or(|(b, _, _)| peak.value * weight > b) {
                let dx = peak.x - (width - template.width) as f64 / 2.0;
                let dy = peak.y - (height - template.height) as f64 / 2.0;
                let (w, h) = (f64::from(bbox.w) * size, f64::from(bbox.h) * size);
                let found = BBox::new(
                    (f64::from(cx) + dx * step - w / 2.0) as f32,
                    (f64::from(cy) + dy * step - h / 2.0) as f32,
                    w as f32,
                    h as f32,
                );
                best = Some((peak.value * weight, peak.value, found));
            }
        }
        let (score, mut found) = best.map_or((0.0, *bbox), |(_, value, b)| (value, b));
        // Outside the picture there is nothing to match: keep the centre inside.
        let (fx, fy) = found.centre();
        found.x += fx.clamp(0.0, frame.width as f32) - fx;
        found.y += fy.clamp(0.0, frame.height as f32) - fy;
        // Nor may the size drift away over hundreds of frames without structure.
        if !(4.0..=4.0 * frame.width.max(frame.height) as f64).contains(&sides(found)) {
            (found.w, found.h) = (bbox.w, bbox.h);
        }
        if let Some(state) = &mut self.state {
            state.bbox = found;
        }
        Ok((found, score))
    }
}

fn sides(b: BBox) -> f64 {
    (f64::from(b.w) * f64::from(b.h)).sqrt()
}

/// A resampled grey patch.
struct Patch {
    values: Vec<f32>,
    width: usize,
    height: usize,
}

impl Patch {
    /// Cuts `width x height` cells of `step` pixels around `centre` (pixels, continuous edges).
    /// Each cell averages the pixels it covers (bilinear between few samples, which keeps shrunk
    /// targets free of aliasing); beyond the picture its rim is repeated.
    fn cut(picture: &Picture, centre: (f64, f64), step: f64, width: usize, height: usize) -> Self {
        let samples = (step.round() as usize).clamp(1, 8);
        let axis = |n: usize, middle: f64, limit: usize| -> Vec<(usize, usize, f32)> {
            let begin = middle - step * n as f64 / 2.0;
            (0..n * samples)
                .map(|i| {
                    let at = begin + (i as f64 + 0.5) * step / samples as f64 - 0.5;
                    let at = at.clamp(0.0, (limit.max(1) - 1) as f64);
                    let low = at.floor() as usize;
                    (low, (low + 1).min(limit.max(1) - 1), (at - low as f64) as f32)
                })
                .collect()
        };
        let columns = axis(width, centre.0, picture.width);
        let rows = axis(height, centre.1, picture.height);
        let grey = |x: usize, y: usize| -> f32 {
            let i = (y * picture.width + x) * picture.channels;
            match picture.data.get(i..i + picture.channels) {
                Some(&[r, g, b]) => {
                    0.299 * f32::from(r) + 0.587 * f32::from(g) + 0.114 * f32::from(b)
                }
                Some(&[v, ..]) => f32::from(v),
                _ => 0.0,
            }
        };
        let mut values = vec![0.0f32; width * height];
        for (j, &(y0, y1, fy)) in rows.iter().enumerate() {
            for (i, &(x0, x1, fx)) in columns.iter().enumerate() {
                let above = grey(x0, y0) * (1.0 - fx) + grey(x1, y0) * fx;
                let below = grey(x0, y1) * (1.0 - fx) + grey(x1, y1) * fx;
                values[j / samples * width + i / samples] += above * (1.0 - fy) + below * fy;
            }
        }
        let share = 1.0 / (samples * samples) as f32;
        values.iter_mut().for_each(|v| *v *= share);
        Self { values, width, height }
    }

    /// Magnitude of central differences; the rim repeats its neighbours.
    fn gradient(self) -> Self {
        let (w, h) = (self.width, self.height);
        let at = |x: usize, y: usize| self.values[y * w + x];
        let mut values = Vec::with_capacity(self.values.len());
        for y in 0..h {
            for x in 0..w {
                let dx = at((x + 1).min(w - 1), y) - at(x.saturating_sub(1), y);
                let dy = at(x, (y + 1).min(h - 1)) - at(x, y.saturating_sub(1));
                values.push(dx.hypot(dy));
            }
        }
        Self { values, width: w, height: h }
    }
}

/// Highest normalised cross-correlation and the offset of the template's corner, refined to parts
/// of a cell.
struct Peak {
    value: f32,
    x: f64,
    y: f64,
}

/// Weights along one axis of the offsets: 1 in the middle, `1 - share` at the ends.
fn prior(n: usize, share: f32) -> Vec<f32> {
    (0..n)
        .map(|i| {
            let turn = std::f32::consts::TAU * (i as f32 + 0.5) / n as f32;
            1.0 - share * (0.5 + 0.5 * turn.cos())
        })
        .collect()
}

fn correlate(patch: &Patch, template: &Template, motion: f32) -> Peak {
    let (nx, ny) = (patch.width + 1 - template.width, patch.height + 1 - template.height);
    let area = (template.width * template.height) as f64;
    // Sums over windows of values and squares, from integral images.
    let stride = patch.width + 1;
    let mut sums = vec![[0.0f64; 2]; stride * (patch.height + 1)];
    for y in 0..patch.height {
        let mut run = [0.0f64; 2];
        for x in 0..patch.width {
            let v = f64::from(patch.values[y * patch.width + x]);
            run[0] += v;
            run[1] += v * v;
            let above = sums[y * stride + x + 1];
            sums[(y + 1) * stride + x + 1] = [run[0] + above[0], run[1] + above[1]];
        }
    }
    let (columns, rows) = (prior(nx, motion), prior(ny, motion));
    let mut scores = vec![0.0f32; nx * ny];
    let mut best = (f32::NEG_INFINITY, 0, 0);
    for y in 0..ny {
        for x in 0..nx {
            let corner = |dx: usize, dy: usize| sums[(y + dy) * stride + x + dx];
            let (a, b) = (corner(0, 0), corner(template.width, 0));
            let (c, d) = (corner(0, template.height), corner(template.width, template.height));
            let sum = d[0] - b[0] - c[0] + a[0];
            let spread = (d[1] - b[1] - c[1] + a[1]) - sum * sum / area;
            // The template has zero mean, so the window's mean need not be subtracted.
            let mut dot = 0.0f32;
            for (row, t) in template.values.chunks_exact(template.width).enumerate() {
                let from = (y + row) * patch.width + x;
                let p = &patch.values[from..from + template.width];
                dot += p.iter().zip(t).map(|(p, t)| p * t).sum::<f32>();
            }
            // Windows without structure correlate with nothing.
            let score = if spread > area { dot / spread.sqrt() as f32 } else { 0.0 };
            let score = score * columns[x] * rows[y];
            scores[y * nx + x] = score;
            if score > best.0 {
                best = (score, x, y);
            }
        }
    }
    let (value, x, y) = best;
    let along = |before: Option<f32>, after: Option<f32>| match (before, after) {
        (Some(a), Some(b)) => {
            let curve = a - 2.0 * value + b;
            if curve < -1e-9 { f64::from((0.5 * (a - b) / curve).clamp(-0.5, 0.5)) } else { 0.0 }
        }
        _ => 0.0,
    };
    let score = |x: Option<usize>, y: Option<usize>| match (x, y) {
        (Some(x), Some(y)) if x < nx && y < ny => Some(scores[y * nx + x]),
        _ => None,
    };
    Peak {
        value,
        x: x as f64 + along(score(x.checked_sub(1), Some(y)), score(Some(x + 1), Some(y))),
        y: y as f64 + along(score(Some(x), y.checked_sub(1)), score(Some(x), Some(y + 1))),
    }
}

#[cfg(test)]
#[path = "baselines_tests.rs"]
mod tests;
