//! From scores to probabilities: a logistic map fitted to what a tracker did (docs/metrics.md).
//!
//! A pair is a frame's score and whether its box was right: the target was visible and overlapped
//! by at least [`RIGHT_IOU`]. The fit is Platt's, with regularised targets, so that a set without a
//! single error does not end in certainty. How well it transfers is measured by cross-validation
//! over whole sequences: every pair is judged by a map that has seen nothing of its sequence.

use crate::presence::{Observation, Truth};
use serde::Serialize;
use tsda_runtime::bundle::ScoreCalibration;

/// Overlap from which a box counts as right.
pub const RIGHT_IOU: f32 = 0.5;

/// Folds of the cross-validation, fewer when there are fewer sequences.
pub const FOLDS: usize = 5;

/// Bins of the expected calibration error.
pub const BINS: usize = 10;

/// A score and whether the box that came with it was right.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Highest value of the score map.
    pub score: f32,
    /// Target visible and overlapped by at least [`RIGHT_IOU`].
    pub right: bool,
}

/// Pairs that no map can be fitted to.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrateError {
    /// One of the two outcomes never happens.
    #[error(
        "{right} right and {wrong} wrong boxes: both are needed; add sequences, for instance some \
         in which the target disappears"
    )]
    OneSided {
        /// Right boxes.
        right: usize,
        /// Wrong ones.
        wrong: usize,
    },
    /// A score is not a number.
    #[error("sequence {sequence}, pair {pair}: the score is {score}, not a finite number")]
    Score {
        /// Number of the sequence, from 0.
        sequence: usize,
        /// Number of the pair within it, from 0.
        pair: usize,
        /// The score.
        score: f32,
    },
    /// Higher scores do not go with better boxes.
    #[error(
        "the fitted slope is {slope}: higher scores do not go with better boxes in these \
         sequences, so they cannot be turned into a probability"
    )]
    Slope {
        /// The slope.
        slope: f64,
    },
}

/// How good probabilities are; both figures are 0 at best.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Reliability {
    /// Mean squared difference between probability and outcome (Brier score).
    pub brier: f64,
    /// Expected calibration error: mean difference between probability and share of right boxes in
    /// [`BINS`] bins of equal width, weighted by their pairs.
    pub ece: f64,
}

/// A fitted map and how good it is on sequences it has not seen.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Calibration {
    /// Slope of the map, fitted to all pairs.
    pub slope: f32,
    /// Its bias.
    pub bias: f32,
    /// Pairs.
    pub pairs: usize,
    /// Pairs with a right box.
    pub right: usize,
    /// Sequences.
    pub sequences: usize,
    /// Folds of the cross-validation; 0 when there are too few sequences for one.
    pub folds: usize,
    /// The score itself, cut to `[0, 1]`, taken as the probability.
    pub before: Reliability,
    /// Cross-validated; missing when `folds` is 0.
    pub after: Option<Reliability>,
}

impl Calibration {
    /// The map as bundles hold it.
    pub const fn map(&self) -> ScoreCalibration {
        ScoreCalibration { slope: self.slope, bias: self.bias }
    }
}

/// The pairs of one run; the first frame, which is given, and frames without annotation are left
/// out.
pub fn pairs(run: &Observation) -> Vec<Pair> {
    let seen = run.frames.iter().skip(1);
    seen.filter_map(|f| {
        let right = match f.truth {
            Truth::Visible(b) => f.predicted.iou(&b) >= RIGHT_IOU,
            Truth::Absent => false,
            Truth::Unknown => return None,
        };
        Some(Pair { score: f.score, right })
    })
    .collect()
}

/// Fits the map to the pairs of several sequences. Runs that share material (several targets or
/// protocols of one sequence) belong into one entry, or the cross-validation sees what it should
/// not.
///
/// # Errors
/// When there is no right or no wrong box, a score is not finite, or the map would fall.
pub fn calibrate(sequences: &[Vec<Pair>]) -> Result<Calibration, CalibrateError> {
    for (sequence, pairs) in sequences.iter().enumerate() {
        if let Some((pair, p)) = pairs.iter().enumerate().find(|(_, p)| !p.score.is_finite()) {
            return Err(CalibrateError::Score { sequence, pair, score: p.score });
        }
    }
    let all: Vec<Pair> = sequences.iter().flatten().copied().collect();
    let map = fit(&all)?;
    let before = reliability(all.iter().map(|p| (f64::from(p.score.clamp(0.0, 1.0)), p.right)));
    let folds = FOLDS.min(sequences.len());
    let after = if folds >= 2 { cross_validate(sequences, folds) } else { None };
    Ok(Calibration {
        slope: map.slope,
        bias: map.bias,
        pairs: all.len(),
        right: all.iter().filter(|p| p.right).count(),
        sequences: sequences.len(),
        folds: if after.is_some() { folds } else { 0 },
        before,
        after,
    })
}

/// `None` when what is left of some fold cannot be fitted.
fn cross_validate(sequences: &[Vec<Pair>], folds: usize) -> Option<Reliability> {
    let mut judged = Vec::new();
    for fold in 0..folds {
        let (mut seen, mut held_out) = (Vec::new(), Vec::new());
        for (i, pairs) in sequences.iter().enumerate() {
            if i % folds == fold { &mut held_out } else { &mut seen }.extend_from_slice(pairs);
        }
        let map = fit(&seen).ok()?;
        judged.extend(held_out.iter().map(|p| (f64::from(map.probability(p.score)), p.right)));
    }
    Some(reliability(judged))
}

/// Platt's fit: maximum likelihood of `1 / (1 + exp(-(slope * score + bias)))` for targets
/// `(n_right + 1) / (n_right + 2)` and `1 / (n_wrong + 2)`.
///
/// # Errors
/// When one of the outcomes is missing or the slope comes out negative.
pub fn fit(pairs: &[Pair]) -> Result<ScoreCalibration, CalibrateError> {
    let right = pairs.iter().filter(|p| p.right).count();
    let wrong = pairs.len() - right;
    if right == 0 || wrong == 0 {
        return Err(CalibrateError::OneSided { right, wrong });
    }
    let high = (right as f64 + 1.0) / (right as f64 + 2.0);
    let low = 1.0 / (wrong as f64 + 2.0);
    let points: Vec<(f64, f64)> =
        pairs.iter().map(|p| (f64::from(p.score), if p.right { high } else { low })).collect();

    // The loss is convex; Newton's step, halved until the loss falls, ends at its only minimum.
    let (mut slope, mut bias) = (0.0, ((right as f64 + 1.0) / (wrong as f64 + 1.0)).ln());
    let mut current = loss(&points, slope, bias);
    for _ in 0..100 {
        // Gradient, and the Hessian with a ridge that keeps it invertible when all scores agree.
        let (mut gs, mut gb, mut ss, mut sb, mut bb) = (0.0, 0.0, 1e-12, 0.0, 1e-12);
        for &(x, t) in &points {
            let p = 1.0 / (1.0 + (-(slope * x + bias)).exp());
            let w = p * (1.0 - p);
            gs += (p - t) * x;
            gb += p - t;
            ss += w * x * x;
            sb += w * x;
            bb += w;
        }
        if gs.abs() < 1e-9 && gb.abs() < 1e-9 {
            break;
        }
        let det = ss * bb - sb * sb;
        let (ds, db) = (-(bb * gs - sb * gb) / det, -(ss * gb - sb * gs) / det);
        let downhill = gs * ds + gb * db;
        let mut step = 1.0;
        let mut moved = false;
        while step > 1e-10 {
            let (s, b) = (slope + step * ds, bias + step * db);
            let next = loss(&points, s, b);
            if next < current + 1e-4 * step * downhill {
                (slope, bias, current, moved) = (s, b, next, true);
                break;
            }
            step *= 0.5;
        }
        if !moved {
            break;
        }
    }
    let map = ScoreCalibration { slope: slope as f32, bias: bias as f32 };
    if map.validate().is_err() {
        return Err(CalibrateError::Slope { slope });
    }
    Ok(map)
}

/// Negative log-likelihood, written so that no exponential overflows.
fn loss(points: &[(f64, f64)], slope: f64, bias: f64) -> f64 {
    points
        .iter()
        .map(|&(x, t)| {
            let z = slope * x + bias;
            let soft = z.max(0.0) + (-z.abs()).exp().ln_1p();
            soft - t * z
        })
        .sum()
}

/// Brier score and expected calibration error of probabilities; zeros when there are none.
pub fn reliability(judged: impl IntoIterator<Item = (f64, bool)>) -> Reliability {
    let (mut squares, mut n) = (0.0, 0usize);
    let mut bins = [(0.0f64, 0usize); BINS];
    for (p, right) in judged {
        let outcome = f64::from(u8::from(right));
        squares += (p - outcome) * (p - outcome);
        let bin = ((p * BINS as f64) as usize).min(BINS - 1);
        // Their difference is all that counts, so one sum does.
        bins[bin].0 += p - outcome;
        bins[bin].1 += 1;
        n += 1;
    }
    if n == 0 {
        return Reliability::default();
    }
    let off: f64 = bins.iter().map(|(sum, _)| sum.abs()).sum();
    Reliability { brier: squares / n as f64, ece: off / n as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::SplitMix;
    use proptest::prelude::*;

    fn pair(score: f32, right: bool) -> Pair {
        Pair { score, right }
    }

    #[test]
    fn two_points_are_met_exactly() {
        // Two scores with 3 right of 4 and 1 right of 4: the maximum likelihood meets the
        // regularised shares. Targets: right 5/6, wrong 1/6; at score 1 the mean target is
        // (3 * 5/6 + 1/6) / 4 = 2/3, at score 0 it is 1/3.
        let mut pairs = Vec::new();
        for (score, right) in [(1.0, 3), (0.0, 1)] {
            pairs.extend((0..4).map(|i| pair(score, i < right)));
        }
        let map = fit(&pairs).unwrap();
        assert!((f64::from(map.probability(1.0)) - 2.0 / 3.0).abs() < 1e-6, "{map:?}");
        assert!((f64::from(map.probability(0.0)) - 1.0 / 3.0).abs() < 1e-6, "{map:?}");
    }

    #[test]
    fn separable_pairs_stay_short_of_certainty() {
        let pairs: Vec<_> = (0..20).map(|i| pair(i as f32 * 0.05, i >= 10)).collect();
        let map = fit(&pairs).unwrap();
        assert!(map.slope.is_finite() && map.probability(1.0) < 0.999, "{map:?}");
    }

    #[test]
    fn what_cannot_be_fitted_is_said() {
        let e = calibrate(&[vec![pair(0.5, true)]]).unwrap_err();
        assert_eq!(e, CalibrateError::OneSided { right: 1, wrong: 0 });
        assert!(matches!(calibrate(&[]), Err(CalibrateError::OneSided { .. })));
        let falling = [pair(0.9, false), pair(0.8, false), pair(0.1, true), pair(0.2, true)];
        assert!(matches!(fit(&falling), Err(CalibrateError::Slope { slope }) if slope < 0.0));
        let nan = calibrate(&[vec![], vec![pair(0.5, true), pair(f32::NAN, false)]]).unwrap_err();
        assert!(nan.to_string().contains("sequence 1, pair 1"), "{nan}");
    }

    #[test]
    fn reliability_by_hand() {
        // 0.75: two of four right, off by 0.25. 0.25: none of one right, off by 0.25.
        let judged = [(0.75, true), (0.75, true), (0.75, false), (0.75, false), (0.25, false)];
        let r = reliability(judged);
        assert!((r.ece - 0.25).abs() < 1e-12);
        let brier = (2.0 * 0.0625 + 2.0 * 0.5625 + 0.0625) / 5.0;
        assert!((r.brier - brier).abs() < 1e-12);
        assert_eq!(reliability([]), Reliability::default());
        assert_eq!(reliability([(1.0, true), (0.0, false)]), Reliability::default());
    }

    #[test]
    fn a_known_map_is_found_again_and_helps_on_sequences_not_seen() {
        let truth = ScoreCalibration { slope: 8.0, bias: -5.0 };
        let mut rng = SplitMix::new(&[3]);
        let sequences: Vec<Vec<Pair>> = (0..10)
            .map(|_| {
                let mut unit = || rng.uniform(0.0, 1.0) as f32;
                let mut draw = || {
                    let score = unit();
                    pair(score, unit() < truth.probability(score))
                };
                (0..400).map(|_| draw()).collect()
            })
            .collect();
        let c = calibrate(&sequences).unwrap();
        assert!((c.slope - 8.0).abs() < 0.8 && (c.bias + 5.0).abs() < 0.6, "{c:?}");
        let after = c.after.unwrap();
        assert!(after.ece < 0.03 && c.before.ece > 0.08 && after.brier < c.before.brier, "{c:?}");
        assert_eq!((c.folds, c.sequences, c.pairs), (5, 10, 4000));
        // One sequence alone: a map, but nothing to check it with.
        let alone = calibrate(&sequences[..1]).unwrap();
        assert_eq!((alone.folds, alone.after), (0, None));
    }

    proptest! {
        #[test]
        fn a_fit_is_a_rising_map_or_an_error(
            pairs in proptest::collection::vec((-2f32..3.0, any::<bool>()), 0..60),
        ) {
            let pairs: Vec<_> = pairs.into_iter().map(|(s, r)| pair(s, r)).collect();
            if let Ok(map) = fit(&pairs) {
                prop_assert!(map.slope > 0.0 && map.bias.is_finite());
            }
        }
    }
}
