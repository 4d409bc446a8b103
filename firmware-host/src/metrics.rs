//! The three figures the demo prints. Definitions are those of `tsda-eval` (checked in a test where
//! that crate is compiled in): the first frame is left out, so are frames without truth.

use crate::track::Step;
use std::ops::Range;
use tsda_runtime::{BBox, Modality};

/// Figures over some frames, each in `[0, 1]`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Figures {
    /// Frames that count.
    pub frames: usize,
    /// Share of frames with IoU above 0.5.
    pub sr50: f64,
    /// Share of frames whose centre is at most 20 pixels off.
    pub pr20: f64,
    /// Mean IoU.
    pub mean_iou: f64,
}

impl Figures {
    /// Over pairs of truth and prediction.
    pub fn of(pairs: impl IntoIterator<Item = (BBox, BBox)>) -> Self {
        let mut figures = Self::default();
        for (truth, found) in pairs {
            let iou = if found.is_valid() { f64::from(truth.iou(&found)) } else { 0.0 };
            let centre = |b: BBox| {
                (
                    f64::from(b.x) + (f64::from(b.w) - 1.0) / 2.0,
                    f64::from(b.y) + (f64::from(b.h) - 1.0) / 2.0,
                )
            };
            let ((tx, ty), (fx, fy)) = (centre(truth), centre(found));
            let off = (tx - fx).hypot(ty - fy);
            figures.frames += 1;
            figures.mean_iou += iou;
            figures.sr50 += f64::from(u8::from(iou > 0.5));
            figures.pr20 += f64::from(u8::from(off <= 20.0));
        }
        if figures.frames > 0 {
            let n = figures.frames as f64;
            figures.sr50 /= n;
            figures.pr20 /= n;
            figures.mean_iou /= n;
        }
        figures
    }
}

/// A stretch of frames from one sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Segment {
    /// The sensor.
    pub modality: Modality,
    /// Its frames.
    pub frames: Range<usize>,
    /// Figures over those with truth.
    pub figures: Figures,
}

/// Cuts a track where the sensor changes.
pub fn segments(steps: &[Step], truth: &[Option<BBox>]) -> Vec<Segment> {
    let mut segments = Vec::new();
    let mut start = 0;
    while let Some(first) = steps.get(start) {
        let len = steps[start..].iter().take_while(|s| s.modality == first.modality).count();
        let frames = start..start + len;
        let figures = over(steps, truth, frames.clone());
        segments.push(Segment { modality: first.modality, frames, figures });
        start += len;
    }
    segments
}

/// Figures over a range of frames; frame 0 does not count.
pub fn over(steps: &[Step], truth: &[Option<BBox>], frames: Range<usize>) -> Figures {
    Figures::of(
        frames
            .filter(|&i| i > 0)
            .filter_map(|i| Some((truth.get(i).copied().flatten()?, steps.get(i)?.bbox))),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use tsda_runtime::TrackState;

    fn step(frame: usize, modality: Modality, bbox: BBox) -> Step {
        Step {
            frame,
            name: String::new(),
            modality,
            bbox,
            score: 1.0,
            confidence: None,
            state: TrackState::Tracking,
            ms: 0.0,
        }
    }

    #[test]
    fn segments_follow_the_sensor_and_skip_what_does_not_count() {
        let b = BBox::new(0.0, 0.0, 10.0, 10.0);
        let far = BBox::new(50.0, 0.0, 10.0, 10.0);
        let steps = [
            step(0, Modality::Rgb, far),
            step(1, Modality::Rgb, b),
            step(2, Modality::Rgb, far),
            step(3, Modality::Thermal, b),
        ];
        let truth = [Some(b), Some(b), Some(b), None];
        let segments = segments(&steps, &truth);
        assert_eq!(segments.len(), 2);
        assert_eq!((segments[0].frames.clone(), segments[1].frames.clone()), (0..3, 3..4));
        let figures = segments[0].figures;
        assert_eq!((figures.frames, figures.sr50, figures.pr20), (2, 0.5, 0.5));
        assert_eq!(segments[1].figures.frames, 0);
    }

    #[cfg(feature = "eval")]
    #[test]
    fn the_figures_are_those_of_the_evaluation() {
        let truth = BBox::new(10.0, 20.0, 30.0, 40.0);
        let pairs: Vec<(BBox, BBox)> = (0..40)
            .map(|i| {
                let i = i as f32;
                (truth, BBox::new(10.0 + i, 20.0 - 0.5 * i, 30.0 + 0.3 * i, 40.0))
            })
            .collect();
        let errors: Vec<_> =
            pairs.iter().map(|(t, p)| tsda_eval::metrics::frame_errors(*t, *p)).collect();
        let want = tsda_eval::metrics::Scores::of(&errors);
        let found = Figures::of(pairs);
        assert!((found.sr50 - want.sr50).abs() < 1e-9 && (found.pr20 - want.pr20).abs() < 1e-9);
        assert!((found.mean_iou - want.mean_iou).abs() < 1e-5);
        assert!(want.sr50 > 0.0 && want.sr50 < 1.0 && want.pr20 > 0.0 && want.pr20 < 1.0);
    }
}
