//! Accuracy of one tracking result against the truth, and averages over many.
//!
//! | figure | per frame | over frames |
//! |---|---|---|
//! | [`Scores::sr50`] | IoU of continuous boxes **strictly above** 0.5 | share of frames |
//! | [`Scores::auc`] | IoU strictly above t, t = 0, 0.05 .. 1 | mean of the 21 shares; 20/21 at best |
//! | [`Scores::pr20`] | distance of the centres `x + (w - 1) / 2` at most 20 px | share of frames |
//! | [`Scores::npr`] | that offset over the true width and height, norm at most 0.2 | share of frames |
//! | [`Scores::mean_iou`] | IoU | mean |
//!
//! These are the definitions of the LasHeR and OTB toolkits, checked against figures computed by
//! them, with two deliberate differences: predictions are not rounded to whole pixels, and **frames
//! in which the target is absent are left out** (the LasHeR toolkit counts them as failures in the
//! success rate and as successes in the precisions). The frame the tracker was initialised with
//! says nothing about it; [`FirstFrame`] says how it enters.
//!
//! A prediction without area has IoU 0; one that is not finite misses by an infinite distance.
//!
//! Figures that equal a benchmark's own toolkit, with its rounding, its thresholds and its peculiar
//! treatment of absent targets, come from [`convention`] and [`score()`]; time to recover after a
//! sensor switch from [`recovery`]; the VOT overlap from [`overlap`].

pub mod convention;
pub mod overlap;
pub mod recovery;
pub mod score;

pub use convention::{Averaging, Convention};
pub use recovery::{Recovery, SwitchRecovery};
pub use score::{Curves, Figures, Lengths, Row, Score, ScoreError, ScoreOptions, Truth, score};

use serde::{Deserialize, Serialize};
use tsda_runtime::BBox;

/// Points of the success curve.
pub const SUCCESS_POINTS: usize = 21;

/// How the frame that the tracker was initialised with enters the figures.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FirstFrame {
    /// Left out: the figures speak of predictions only.
    #[default]
    Excluded,
    /// Counted, with the truth in place of the prediction, as the LasHeR and OTB toolkits do.
    Truth,
}

/// Errors of one frame in which the target is visible.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameErrors {
    /// Intersection over union.
    pub iou: f64,
    /// Distance of the centres in pixels.
    pub centre: f64,
    /// Distance of the centres, x over the true width and y over the true height.
    pub normalised: f64,
}

/// Compares one prediction with the truth.
pub fn frame_errors(truth: BBox, predicted: BBox) -> FrameErrors {
    let [tx, ty, tw, th] = wide(truth);
    let [px, py, pw, ph] = wide(predicted);
    let inter_w = (tx + tw).min(px + pw) - tx.max(px);
    let inter_h = (ty + th).min(py + ph) - ty.max(py);
    let iou = if predicted.is_valid() && inter_w > 0.0 && inter_h > 0.0 {
        let inter = inter_w * inter_h;
        inter / (tw * th + pw * ph - inter)
    } else {
        0.0
    };
    let dx = (px + (pw - 1.0) / 2.0) - (tx + (tw - 1.0) / 2.0);
    let dy = (py + (ph - 1.0) / 2.0) - (ty + (th - 1.0) / 2.0);
    let finite = |d: f64| if d.is_finite() { d } else { f64::INFINITY };
    FrameErrors { iou, centre: finite(dx.hypot(dy)), normalised: finite((dx / tw).hypot(dy / th)) }
}

/// Single precision decides `> 0.5` wrongly on boxes of whole pixels now and then.
fn wide(b: BBox) -> [f64; 4] {
    [b.x, b.y, b.w, b.h].map(f64::from)
}

/// Figures of one result or an average of several, each in `[0, 1]`, higher is better; see the
/// module for the definitions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Success rate at IoU 0.5.
    pub sr50: f64,
    /// Area under the success curve (21 points).
    pub auc: f64,
    /// Precision at 20 px.
    pub pr20: f64,
    /// Normalised precision at 0.2.
    pub npr: f64,
    /// Mean intersection over union.
    pub mean_iou: f64,
    /// Frames that count; with 0 the other figures are 0 and mean nothing.
    pub frames: usize,
}

impl Scores {
    /// Figures over the given frames.
    pub fn of(errors: &[FrameErrors]) -> Self {
        let n = errors.len();
        if n == 0 {
            return Self::default();
        }
        let share = |hit: &dyn Fn(&FrameErrors) -> bool| {
            errors.iter().filter(|e| hit(e)).count() as f64 / n as f64
        };
        Self {
            sr50: share(&|e| e.iou > 0.5),
            auc: success_curve(errors).iter().sum::<f64>() / SUCCESS_POINTS as f64,
            pr20: share(&|e| e.centre <= 20.0),
            npr: share(&|e| e.normalised <= 0.2),
            mean_iou: errors.iter().map(|e| e.iou).sum::<f64>() / n as f64,
            frames: n,
        }
    }

    /// Average in which every result counts the same; those without frames are left out.
    /// `frames` is the sum.
    pub fn mean<'a>(results: impl IntoIterator<Item = &'a Self>) -> Self {
        Self::weighted(results, |_| 1.0)
    }

    /// Average in which every frame counts the same, as if all results were one.
    pub fn pooled<'a>(results: impl IntoIterator<Item = &'a Self>) -> Self {
        // Every figure is a mean over frames, so weighting by frames is exact.
        Self::weighted(results, |s| s.frames as f64)
    }

    fn weighted<'a>(
        results: impl IntoIterator<Item = &'a Self>,
        weight: impl Fn(&Self) -> f64,
    ) -> Self {
        let mut sum = Self::default();
        let mut total = 0.0;
        for s in results.into_iter().filter(|s| s.frames > 0) {
            let w = weight(s);
            sum.sr50 += w * s.sr50;
            sum.auc += w * s.auc;
            sum.pr20 += w * s.pr20;
            sum.npr += w * s.npr;
            sum.mean_iou += w * s.mean_iou;
            sum.frames += s.frames;
            total += w;
        }
        if total > 0.0 {
            for v in [&mut sum.sr50, &mut sum.auc, &mut sum.pr20, &mut sum.npr, &mut sum.mean_iou] {
                *v /= total;
            }
        }
        sum
    }
}

/// Share of frames with IoU strictly above 0, 0.05 .. 1; zeros without frames.
pub fn success_curve(errors: &[FrameErrors]) -> [f64; SUCCESS_POINTS] {
    let mut curve = [0.0; SUCCESS_POINTS];
    if errors.is_empty() {
        return curve;
    }
    for (i, point) in curve.iter_mut().enumerate() {
        // Division gives the doubles nearest to 0.05, 0.1 ..; multiples of 0.05 lie beside some.
        let threshold = i as f64 / (SUCCESS_POINTS - 1) as f64;
        let hits = errors.iter().filter(|e| e.iou > threshold).count();
        *point = hits as f64 / errors.len() as f64;
    }
    curve
}

/// A result that does not fit its truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{predicted} predicted boxes for {truth} frames of truth: one box per frame is needed")]
pub struct LengthMismatch {
    /// Boxes given.
    pub predicted: usize,
    /// Frames of truth.
    pub truth: usize,
}

/// Errors of every frame that counts: those with a truth box; the first as `first` says.
///
/// # Errors
/// When the lengths differ.
pub fn errors(
    truth: &[Option<BBox>],
    predicted: &[BBox],
    first: FirstFrame,
) -> Result<Vec<FrameErrors>, LengthMismatch> {
    if truth.len() != predicted.len() {
        return Err(LengthMismatch { predicted: predicted.len(), truth: truth.len() });
    }
    let frames = truth.iter().zip(predicted).enumerate();
    Ok(frames
        .filter_map(|(i, (t, p))| {
            let t = (*t)?;
            match (i, first) {
                (0, FirstFrame::Excluded) => None,
                (0, FirstFrame::Truth) => Some(frame_errors(t, t)),
                _ => Some(frame_errors(t, *p)),
            }
        })
        .collect())
}

/// Figures of one result; frame 0 of both slices is the one the tracker was initialised with.
///
/// # Errors
/// When the lengths differ.
pub fn measure(
    truth: &[Option<BBox>],
    predicted: &[BBox],
    first: FirstFrame,
) -> Result<Scores, LengthMismatch> {
    Ok(Scores::of(&errors(truth, predicted, first)?))
}

#[cfg(test)]
mod tests;
