//! Histograms of scores and of the time a frame takes.

use serde::{Deserialize, Serialize};

use crate::metrics::frame_errors;
use crate::protocol::SequenceResult;

/// Bins of the score histogram over `[0, 1]`.
const SCORE_BINS: usize = 20;
/// Bins of the time histogram per decade, and decades from 0.1 ms.
const BINS_PER_DECADE: i32 = 10;
const DECADES: i32 = 5;

/// Confidences of predicted frames by what became of them; the frame that starts a run is left out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoreHistogram {
    /// Ends of the bins, one more than there are bins: 0, 0.05 .. 1. What lies beyond counts in the
    /// first or last bin.
    pub edges: Vec<f64>,
    /// Frames with IoU above 0.5, by bin.
    pub on_target: Vec<u64>,
    /// Frames with IoU at most 0.5, by bin.
    pub off_target: Vec<u64>,
    /// Frames in which the target is absent or not annotated, by bin.
    pub absent: Vec<u64>,
}

impl ScoreHistogram {
    /// Of any number of results; `None` without a frame.
    pub fn of<'a>(results: impl IntoIterator<Item = &'a SequenceResult>) -> Option<Self> {
        let edges: Vec<f64> = (0..=SCORE_BINS).map(|i| i as f64 / SCORE_BINS as f64).collect();
        let empty = vec![0; SCORE_BINS];
        let mut histogram =
            Self { edges, on_target: empty.clone(), off_target: empty.clone(), absent: empty };
        let mut any = false;
        for r in results {
            let frames = r.truth.iter().zip(&r.predicted).zip(&r.confidence);
            for ((truth, predicted), score) in frames.skip(1).filter(|(_, s)| !s.is_nan()) {
                let bin = (f64::from(*score) * SCORE_BINS as f64).max(0.0) as usize;
                let bin = bin.min(SCORE_BINS - 1);
                let counts = match truth {
                    None => &mut histogram.absent,
                    Some(t) if frame_errors(*t, *predicted).iou > 0.5 => &mut histogram.on_target,
                    Some(_) => &mut histogram.off_target,
                };
                counts[bin] += 1;
                any = true;
            }
        }
        any.then_some(histogram)
    }
}

/// Milliseconds inside the tracker per frame; frames that start a run only count in
/// `mean_start`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LatencyHistogram {
    /// Ends of the bins in milliseconds, one more than there are bins: 0.1 to 10,000, ten per
    /// decade. What lies beyond counts in the first or last bin.
    pub edges: Vec<f64>,
    /// Frames by bin.
    pub counts: Vec<u64>,
    /// Frames.
    pub frames: u64,
    /// Mean.
    pub mean: f64,
    /// Median (a time that was measured, the lower one of two).
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
    /// 99th percentile.
    pub p99: f64,
    /// The slowest.
    pub max: f64,
    /// Mean of the frames that start a run.
    pub mean_start: f64,
}

impl LatencyHistogram {
    /// Of any number of results; `None` where no frame was timed.
    pub fn of<'a>(results: impl IntoIterator<Item = &'a SequenceResult> + Clone) -> Option<Self> {
        let timed = results.into_iter().map(|r| &r.milliseconds).filter(|t| !t.is_empty());
        let (mut times, mut starts) = (Vec::new(), Vec::new());
        for t in timed {
            starts.push(f64::from(t[0]));
            times.extend(t[1..].iter().map(|ms| f64::from(*ms)));
        }
        if times.is_empty() {
            return None;
        }
        times.sort_by(f64::total_cmp);
        let bins = BINS_PER_DECADE * DECADES;
        let edges: Vec<f64> = (0..=bins)
            .map(|i| 10f64.powf(f64::from(i - BINS_PER_DECADE) / f64::from(BINS_PER_DECADE)))
            .collect();
        let mut counts = vec![0; bins as usize];
        for ms in &times {
            let above = edges.partition_point(|edge| edge <= ms);
            counts[above.saturating_sub(1).min(bins as usize - 1)] += 1;
        }
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
        let n = times.len();
        let rank = |share: f64| times[((share * n as f64).ceil() as usize).clamp(1, n) - 1];
        Some(Self {
            edges,
            counts,
            frames: n as u64,
            mean: mean(&times),
            p50: rank(0.5),
            p95: rank(0.95),
            p99: rank(0.99),
            max: rank(1.0),
            mean_start: mean(&starts),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tsda_runtime::{BBox, Modality};

    fn result(scores: &[f32], milliseconds: &[f32]) -> SequenceResult {
        let b = BBox::new(10.0, 10.0, 20.0, 20.0);
        let n = scores.len();
        SequenceResult {
            sequence: "s".into(),
            target: 0,
            start: 0,
            modalities: vec![Modality::Rgb; n],
            truth: (0..n).map(|i| (i % 3 != 0).then_some(b)).collect(),
            predicted: (0..n).map(|i| if i % 3 == 1 { b } else { BBox::default() }).collect(),
            confidence: scores.to_vec(),
            milliseconds: milliseconds.to_vec(),
        }
    }

    #[test]
    fn scores_by_what_became_of_the_frame() {
        let r = result(&[1.0, 0.97, 0.5, 0.05, 2.0, -1.0, f32::NAN], &[]);
        let h = ScoreHistogram::of([&r]).unwrap();
        let filled = |counts: &[u64]| -> Vec<(usize, u64)> {
            counts.iter().copied().enumerate().filter(|(_, n)| *n > 0).collect()
        };
        assert_eq!((h.edges.len(), h.edges[20]), (21, 1.0));
        assert_eq!(filled(&h.on_target), [(19, 2)]);
        assert_eq!(filled(&h.off_target), [(0, 1), (10, 1)]);
        assert_eq!(filled(&h.absent), [(1, 1)]);
        assert_eq!(ScoreHistogram::of([&result(&[1.0], &[])]), None);
    }

    #[test]
    fn times_leave_the_start_out() {
        let timed = result(&[1.0; 6], &[500.0, 1.0, 2.0, 3.0, 4.0, 20_000.0]);
        let h = LatencyHistogram::of([&timed, &result(&[1.0; 6], &[])]).unwrap();
        assert_eq!(
            (h.frames, h.p50, h.p95, h.max, h.mean_start),
            (5, 3.0, 20_000.0, 20_000.0, 500.0)
        );
        assert_eq!((h.mean, h.counts.iter().sum::<u64>(), h.counts[49]), (4002.0, 5, 1));
        assert_eq!((h.edges.len(), h.counts[10]), (51, 1), "1 ms begins the second decade");
        assert_eq!(LatencyHistogram::of([&result(&[1.0; 6], &[])]), None);
        assert_eq!(LatencyHistogram::of([&result(&[1.0], &[5.0])]), None);
    }
}
