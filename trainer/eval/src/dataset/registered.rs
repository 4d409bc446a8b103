//! Bringing an RGB camera to the pixel grid of a thermal one by an affine map.
//!
//! Anti-UAV's two cameras differ in resolution and view and come without calibration, but both
//! boxes of the same drone are annotated. Those are point pairs: [`Affine::fit`] finds the map that
//! takes the centres of the RGB boxes to the centres of the thermal ones, robustly (a few frames
//! are annotated badly). The drone is far away, so one map per clip is enough; where it hardly
//! moved, only scale (from the box sizes) and shift are determined.

use std::path::{Path, PathBuf};

use serde::Serialize;
use tsda_runtime::{BBox, Modality};

use super::clip::ClipSequence;
use super::text::read_numbers;
use super::{DatasetError, Note, Picture, Sequence};

/// How positions in the RGB picture relate to the thermal one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Registration {
    /// Same place, up to the few pixels the benchmark's own alignment leaves.
    #[default]
    Aligned,
    /// This map takes pixels of RGB to pixels of thermal.
    Affine(Affine),
    /// Nothing is known: boxes of one sensor say nothing about the other.
    Unknown,
}

/// `(x, y) -> (a x + b y + c, d x + e y + f)`, in continuous pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Affine {
    /// `[[a, b, c], [d, e, f]]`.
    pub rows: [[f64; 3]; 2],
}

/// What [`Affine::fit`] found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// The map.
    pub affine: Affine,
    /// Median distance of mapped and true centres, in target pixels.
    pub residual: f64,
    /// All six numbers were determined, not only scale and shift.
    pub full: bool,
}

/// Fewest pairs of boxes a map is fitted to.
pub const LEAST_PAIRS: usize = 8;
/// Spread of the centres across their main direction, in source pixels, below which only scale and
/// shift are fitted.
const LEAST_SPREAD: f64 = 15.0;
/// Rounds of reweighting.
const ROUNDS: usize = 12;

/// A centre in the source picture and the same one in the target picture.
type PointPair = [(f64, f64); 2];

impl Affine {
    /// Where a point goes.
    pub fn apply(&self, (x, y): (f64, f64)) -> (f64, f64) {
        let [[a, b, c], [d, e, f]] = self.rows;
        (a * x + b * y + c, d * x + e * y + f)
    }

    /// The smallest upright box around the mapped corners.
    pub fn map_box(&self, bbox: BBox) -> BBox {
        let [x, y, r, b] = [bbox.x, bbox.y, bbox.x + bbox.w, bbox.y + bbox.h].map(f64::from);
        let corners = [(x, y), (r, y), (x, b), (r, b)].map(|p| self.apply(p));
        let low = corners.iter().fold((f64::MAX, f64::MAX), |m, p| (m.0.min(p.0), m.1.min(p.1)));
        let high = corners.iter().fold((f64::MIN, f64::MIN), |m, p| (m.0.max(p.0), m.1.max(p.1)));
        let (w, h) = (high.0 - low.0, high.1 - low.1);
        BBox::new(low.0 as f32, low.1 as f32, w as f32, h as f32)
    }

    /// The way back; `None` when the map is flat.
    pub fn inverse(&self) -> Option<Self> {
        let [[a, b, c], [d, e, f]] = self.rows;
        let det = a * e - b * d;
        if !det.is_finite() || det.abs() < 1e-9 {
            return None;
        }
        let (ia, ib, id, ie) = (e / det, -b / det, -d / det, a / det);
        Some(Self { rows: [[ia, ib, -(ia * c + ib * f)], [id, ie, -(id * c + ie * f)]] })
    }

    /// The map that takes the first box of each pair to the second, see the module. `None` for
    /// fewer than [`LEAST_PAIRS`] pairs or boxes that determine nothing.
    pub fn fit(pairs: &[(BBox, BBox)]) -> Option<Fit> {
        let usable: Vec<&(BBox, BBox)> =
            pairs.iter().filter(|(a, b)| a.is_valid() && b.is_valid()).collect();
        if usable.len() < LEAST_PAIRS {
            return None;
        }
        let centre = |b: &BBox| (f64::from(b.x + b.w / 2.0), f64::from(b.y + b.h / 2.0));
        let points: Vec<PointPair> = usable.iter().map(|(a, b)| [centre(a), centre(b)]).collect();
        let scale = median(usable.iter().map(|(a, b)| f64::from(b.area() / a.area()).sqrt()))?;
        let shift = |pick: fn((f64, f64)) -> f64| {
            median(points.iter().map(|[p, q]| pick(*q) - scale * pick(*p)))
        };
        let simple = Self { rows: [[scale, 0.0, shift(|p| p.0)?], [0.0, scale, shift(|p| p.1)?]] };
        let full = (spread(&points) >= LEAST_SPREAD).then(|| refine(simple, &points)).flatten();
        let affine = full.unwrap_or(simple);
        affine.inverse()?;
        let residual = median(distances(&affine, &points).into_iter())?;
        Some(Fit { affine, residual, full: full.is_some() })
    }
}

fn distances(affine: &Affine, points: &[PointPair]) -> Vec<f64> {
    let distance = |[p, q]: &PointPair| {
        let m = affine.apply(*p);
        (m.0 - q.0).hypot(m.1 - q.1)
    };
    points.iter().map(distance).collect()
}

fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.filter(|v| v.is_finite()).collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Standard deviation of the source points across their main direction.
fn spread(points: &[PointPair]) -> f64 {
    let n = points.len() as f64;
    let mean = |pick: fn(&(f64, f64)) -> f64| points.iter().map(|[p, _]| pick(p)).sum::<f64>() / n;
    let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
    let sum = |f: &dyn Fn(f64, f64) -> f64| {
        points.iter().map(|[p, _]| f(p.0 - mx, p.1 - my)).sum::<f64>() / n
    };
    let (xx, yy, xy) = (sum(&|x, _| x * x), sum(&|_, y| y * y), sum(&|x, y| x * y));
    let half = (xx + yy) / 2.0;
    (half - ((xx - yy) / 2.0).hypot(xy)).max(0.0).sqrt()
}

/// Least squares with weights that fall off with the distance (Cauchy), in units of the median
/// distance but at least one pixel.
fn refine(start: Affine, points: &[PointPair]) -> Option<Affine> {
    let mut affine = start;
    for _ in 0..ROUNDS {
        let distances = distances(&affine, points);
        let unit = median(distances.iter().copied())?.max(1.0);
        let weights: Vec<f64> =
            distances.iter().map(|d| 1.0 / (1.0 + (d / (2.0 * unit)).powi(2))).collect();
        affine = least_squares(points, &weights)?;
    }
    Some(affine)
}

fn least_squares(points: &[PointPair], weights: &[f64]) -> Option<Affine> {
    // Around the centre the equations are well conditioned and the shift drops out.
    let total: f64 = weights.iter().sum();
    let mean = |pick: &dyn Fn(&PointPair) -> f64| {
        points.iter().zip(weights).map(|(p, w)| w * pick(p)).sum::<f64>() / total
    };
    let (mx, my) = (mean(&|p| p[0].0), mean(&|p| p[0].1));
    let (mu, mv) = (mean(&|p| p[1].0), mean(&|p| p[1].1));
    let sum = |pick: &dyn Fn(f64, f64, f64, f64) -> f64| {
        mean(&|[p, q]| pick(p.0 - mx, p.1 - my, q.0 - mu, q.1 - mv))
    };
    let (xx, yy, xy) =
        (sum(&|x, _, _, _| x * x), sum(&|_, y, _, _| y * y), sum(&|x, y, _, _| x * y));
    let det = xx * yy - xy * xy;
    if !det.is_finite() || det <= 1e-9 * xx * yy {
        return None;
    }
    let row = |xt: f64, yt: f64, m: f64| {
        let (a, b) = ((xt * yy - yt * xy) / det, (yt * xx - xt * xy) / det);
        [a, b, m - a * mx - b * my]
    };
    let u = row(sum(&|x, _, u, _| x * u), sum(&|_, y, u, _| y * u), mu);
    let v = row(sum(&|x, _, _, v| x * v), sum(&|_, y, _, v| y * v), mv);
    Some(Affine { rows: [u, v] })
}

/// Reads `a b c d e f` (see [`Affine`]) from a text file.
///
/// # Errors
/// When it cannot be read, or does not hold six numbers of a map that can be inverted.
pub(crate) fn read_affine(path: &Path) -> Result<Affine, DatasetError> {
    let numbers = read_numbers(path)?;
    let affine = match numbers[..] {
        [a, b, c, d, e, f] => Some(Affine { rows: [[a, b, c], [d, e, f]] }),
        _ => None,
    };
    affine.filter(|a| a.inverse().is_some()).ok_or_else(|| DatasetError::Format {
        path: path.to_owned(),
        line: None,
        reason: format!(
            "expected the six numbers a b tx c d ty of a map from RGB to thermal that can be \
             inverted, found {numbers:?}"
        ),
    })
}

/// A clip of two cameras with RGB warped onto the thermal frame: one pixel grid, one size, RGB
/// boxes mapped along. Where RGB does not reach, it is black.
#[derive(Clone, Debug)]
pub struct RegisteredClip {
    clip: ClipSequence,
    affine: Affine,
    inverse: Affine,
    size: (usize, usize),
    notes: Vec<Note>,
}

impl RegisteredClip {
    /// Uses the map that came with the clip, or fits one to the boxes of its first target.
    ///
    /// # Errors
    /// When a sensor is missing, too few frames have both boxes, or the thermal frame's size cannot
    /// be read.
    pub fn new(clip: ClipSequence) -> Result<Self, DatasetError> {
        let fail =
            |reason: String| DatasetError::Registration { sequence: clip.id().to_owned(), reason };
        if clip.modalities().len() != 2 {
            return Err(fail("it needs both sensors".into()));
        }
        let mut notes = clip.notes().to_vec();
        let affine = match clip.registration() {
            Registration::Affine(affine) => affine,
            Registration::Aligned | Registration::Unknown => {
                let both = |f| {
                    let of = |m| clip.truth(0, f, m);
                    of(Modality::Rgb).zip(of(Modality::Thermal))
                };
                let pairs: Vec<(BBox, BBox)> = (0..clip.frames()).filter_map(both).collect();
                let fit = Affine::fit(&pairs).ok_or_else(|| {
                    fail(format!(
                        "{} frames have a box in both sensors, {LEAST_PAIRS} are needed; put the \
                         six numbers of the map into registration.txt",
                        pairs.len()
                    ))
                })?;
                let what = if fit.full { "affine map" } else { "scale and shift" };
                let text = format!(
                    "{what} fitted to {} frames, median residual {:.1} px",
                    pairs.len(),
                    fit.residual
                );
                notes.push(Note::quirk(clip.dir(), text));
                fit.affine
            }
        };
        let inverse = affine.inverse().ok_or_else(|| fail("its map cannot be inverted".into()))?;
        let size = clip.resolution(Modality::Thermal)?;
        Ok(Self { clip, affine, inverse, size, notes })
    }

    /// The map from RGB to thermal pixels.
    pub const fn affine(&self) -> Affine {
        self.affine
    }

    fn mapped(&self, bbox: BBox, modality: Modality) -> BBox {
        match modality {
            Modality::Rgb if bbox.is_valid() => self.affine.map_box(bbox),
            _ => bbox,
        }
    }
}

impl Sequence for RegisteredClip {
    fn id(&self) -> &str {
        self.clip.id()
    }

    fn frames(&self) -> usize {
        self.clip.frames()
    }

    fn modalities(&self) -> &[Modality] {
        self.clip.modalities()
    }

    fn targets(&self) -> usize {
        self.clip.targets()
    }

    fn truth(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox> {
        self.clip.truth(target, frame, modality).map(|b| self.mapped(b, modality))
    }

    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        let picture = self.clip.picture(frame, modality)?;
        Ok(match modality {
            Modality::Rgb => warp(&picture, &self.inverse, self.size),
            Modality::Thermal => picture,
        })
    }

    fn annotated(&self, target: usize, frame: usize, modality: Modality) -> bool {
        self.clip.annotated(target, frame, modality)
    }

    fn truth_row(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox> {
        self.clip.truth_row(target, frame, modality).map(|b| self.mapped(b, modality))
    }

    fn attributes(&self) -> &[String] {
        self.clip.attributes()
    }

    fn frame_attributes(&self, frame: usize) -> Vec<&str> {
        self.clip.frame_attributes(frame)
    }

    fn notes(&self) -> &[Note] {
        &self.notes
    }

    fn picture_path(&self, frame: usize, modality: Modality) -> Option<PathBuf> {
        self.clip.picture_path(frame, modality)
    }

    fn resolution(&self, _modality: Modality) -> Result<(usize, usize), DatasetError> {
        Ok(self.size)
    }
}

/// Samples `source` at `to_source` of every pixel of a picture of `size`; black outside. A map that
/// shrinks averages over the pixels it skips.
fn warp(source: &Picture, to_source: &Affine, (width, height): (usize, usize)) -> Picture {
    let [[a, b, _], [d, e, _]] = to_source.rows;
    let step = a.hypot(d).max(b.hypot(e));
    // One sample per source pixel, within reason.
    let samples = step.round().clamp(1.0, 8.0) as usize;
    let c = source.channels;
    let mut data = vec![0u8; width * height * c];
    let mut sums = vec![0f64; c];
    for y in 0..height {
        for x in 0..width {
            sums.fill(0.0);
            let mut hits = 0usize;
            for i in 0..samples * samples {
                let part = |k: usize| (k as f64 + 0.5) / samples as f64;
                let at = (x as f64 + part(i % samples), y as f64 + part(i / samples));
                hits += usize::from(add_sample(source, to_source.apply(at), &mut sums));
            }
            if hits > 0 {
                let out = (y * width + x) * c;
                for (slot, sum) in data[out..out + c].iter_mut().zip(&sums) {
                    *slot = (sum / hits as f64 + 0.5).clamp(0.0, 255.0) as u8;
                }
            }
        }
    }
    Picture { width, height, channels: c, data }
}

/// Adds the bilinear value at a continuous position; `false` outside the picture.
fn add_sample(source: &Picture, (x, y): (f64, f64), sums: &mut [f64]) -> bool {
    let (w, h) = (source.width, source.height);
    // Pixel i covers i to i + 1.
    if !(x >= 0.0 && y >= 0.0 && x < w as f64 && y < h as f64) {
        return false;
    }
    let axis = |at: f64, n: usize| {
        let at = (at - 0.5).clamp(0.0, (n - 1) as f64);
        let low = at as usize;
        (low, (low + 1).min(n - 1), at - low as f64)
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (axis(x, w), axis(y, h));
    for (k, sum) in sums.iter_mut().enumerate() {
        let value = |x: usize, y: usize| f64::from(source.data[(y * w + x) * source.channels + k]);
        let above = value(x0, y0) * (1.0 - fx) + value(x1, y0) * fx;
        let below = value(x0, y1) * (1.0 - fx) + value(x1, y1) * fx;
        *sum += above * (1.0 - fy) + below * fy;
    }
    true
}

#[cfg(test)]
#[path = "registered_tests.rs"]
mod tests;
