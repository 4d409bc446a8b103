//! Does a tracker know when its target is gone, and does it find it again (docs/metrics.md)?

use serde::Serialize;
use tsda_runtime::{BBox, TrackState};

/// Overlap from which a returned target counts as found again.
pub const FOUND_IOU: f32 = 0.5;

/// What is known about the target in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Truth {
    /// It is here.
    Visible(BBox),
    /// It cannot be seen.
    Absent,
    /// Nothing is annotated, or too little of it is visible to say.
    Unknown,
}

/// One frame of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// What is known.
    pub truth: Truth,
    /// Box reported.
    pub predicted: BBox,
    /// Score reported.
    pub score: f32,
    /// State reported.
    pub state: TrackState,
    /// Whether the scan of a lost target's frame found this box.
    pub redetected: bool,
}

/// One run; frame 0 is the one the tracker was started with and enters no figure.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// Sequence, for reports.
    pub sequence: String,
    /// Its frames.
    pub frames: Vec<Frame>,
}

/// How an event that should follow a change came about.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Delay {
    /// Changes after which it could have come.
    pub changes: usize,
    /// Changes after which it came in time.
    pub came: usize,
    /// Mean frames until it came, over those after which it did; 0 is the very frame of the change.
    pub mean_frames: Option<f64>,
    /// Median over all changes (the lower one of two), those without it counting as slowest;
    /// missing when it falls on one of those.
    pub median_frames: Option<usize>,
}

impl Delay {
    fn of(mut delays: Vec<Option<usize>>) -> Self {
        let came: Vec<usize> = delays.iter().flatten().copied().collect();
        delays.sort_unstable_by_key(|d| d.unwrap_or(usize::MAX));
        let mean = came.iter().sum::<usize>() as f64 / came.len().max(1) as f64;
        Self {
            changes: delays.len(),
            came: came.len(),
            mean_frames: (!came.is_empty()).then_some(mean),
            median_frames: delays.get(delays.len().saturating_sub(1) / 2).copied().flatten(),
        }
    }
}

/// The figures of any number of runs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct PresenceSummary {
    /// Runs.
    pub sequences: usize,
    /// Frames in which the target is visible.
    pub visible: usize,
    /// Frames in which it is absent.
    pub absent: usize,
    /// Probability that a visible frame scores higher than an absent one, equal scores counting
    /// half; missing without frames of both kinds. 1 is best, 0.5 says nothing.
    pub auroc: Option<f64>,
    /// Share of absent frames reported as `Tracking`.
    pub false_lock_rate: Option<f64>,
    /// Share of absent frames reported with a box of this frame: `Tracking` or `Uncertain`.
    pub false_report_rate: Option<f64>,
    /// Share of visible frames reported as `Searching` or `Lost`.
    pub missed_rate: Option<f64>,
    /// From the first absent frame to the first reported as `Searching` or `Lost`, within the absence.
    /// Absences before which the tracker already did so are left out, here and in `lost`.
    pub noticed: Delay,
    /// From the first absent frame to the first reported as `Lost`; within the absence.
    pub lost: Delay,
    /// From the first frame the target is visible again to the first with a box of this frame and an
    /// overlap of at least [`FOUND_IOU`]; before the next absence.
    pub redetected: Delay,
    /// How many of these were found by the scan of the frame.
    pub found_by_scan: usize,
}

/// Computes all figures; absences are counted per run, everything else over all frames.
pub fn presence(runs: &[Observation]) -> PresenceSummary {
    let (mut with, mut without) = (Vec::new(), Vec::new());
    let (mut locks, mut reports, mut missed, mut found_by_scan) = (0usize, 0usize, 0usize, 0usize);
    let (mut noticed, mut lost, mut redetected) = (Vec::new(), Vec::new(), Vec::new());
    for run in runs {
        let frames = run.frames.get(1..).unwrap_or_default();
        for f in frames {
            match f.truth {
                Truth::Visible(_) => {
                    with.push(f.score);
                    missed += usize::from(!reported(f));
                }
                Truth::Absent => {
                    without.push(f.score);
                    locks += usize::from(f.state == TrackState::Tracking);
                    reports += usize::from(reported(f));
                }
                Truth::Unknown => {}
            }
        }
        for (gone, back, end) in absences(frames) {
            let absence = &frames[gone..back];
            // A tracker that was there before the target went has nothing to notice.
            let before = gone.checked_sub(1).and_then(|i| frames.get(i));
            if before.is_none_or(reported) {
                noticed.push(absence.iter().position(|f| !reported(f)));
            }
            if before.is_none_or(|f| f.state != TrackState::Lost) {
                lost.push(absence.iter().position(|f| f.state == TrackState::Lost));
            }
            if back < frames.len() {
                let found = frames[back..end].iter().position(found);
                // The scan may have found it while it was still half hidden; then the tracker just
                // goes on when it counts as visible.
                let since = frames[gone..back + found.map_or(0, |d| d + 1)].iter();
                found_by_scan +=
                    usize::from(found.is_some() && since.clone().any(|f| f.redetected));
                redetected.push(found);
            }
        }
    }
    let share = |n: usize, of: usize| (of > 0).then(|| n as f64 / of as f64);
    PresenceSummary {
        sequences: runs.len(),
        visible: with.len(),
        absent: without.len(),
        auroc: auroc(&with, &without),
        false_lock_rate: share(locks, without.len()),
        false_report_rate: share(reports, without.len()),
        missed_rate: share(missed, with.len()),
        noticed: Delay::of(noticed),
        lost: Delay::of(lost),
        redetected: Delay::of(redetected),
        found_by_scan,
    }
}

/// Whether the box is one of this frame.
fn reported(f: &Frame) -> bool {
    matches!(f.state, TrackState::Tracking | TrackState::Uncertain)
}

fn found(f: &Frame) -> bool {
    matches!(f.truth, Truth::Visible(b) if f.predicted.iou(&b) >= FOUND_IOU) && reported(f)
}

/// First absent frame, first visible frame after it (or the number of frames), and where the next
/// absence begins. Frames without annotation after the last absent one belong to the absence until
/// the target is known to be visible.
fn absences(frames: &[Frame]) -> Vec<(usize, usize, usize)> {
    let next = |from: usize, want: fn(&Frame) -> bool| {
        frames[from..].iter().position(want).map_or(frames.len(), |i| from + i)
    };
    let mut out = Vec::new();
    let mut gone = next(0, |f| f.truth == Truth::Absent);
    while gone < frames.len() {
        let back = next(gone, |f| matches!(f.truth, Truth::Visible(_)));
        let end = next(back, |f| f.truth == Truth::Absent);
        out.push((gone, back, end));
        gone = end;
    }
    out
}

/// Area under the receiver operating curve by ranks.
fn auroc(positive: &[f32], negative: &[f32]) -> Option<f64> {
    if positive.is_empty() || negative.is_empty() {
        return None;
    }
    let mut sorted = negative.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    let wins: f64 = positive
        .iter()
        .map(|p| {
            let below = sorted.partition_point(|n| n < p);
            let up_to = sorted.partition_point(|n| n <= p);
            0.5 * (below + up_to) as f64
        })
        .sum();
    Some(wins / (positive.len() as f64 * negative.len() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HERE: BBox = BBox::new(10.0, 10.0, 20.0, 20.0);
    const THERE: BBox = BBox::new(100.0, 10.0, 20.0, 20.0);

    /// One frame per letter of `truth` (v visible, a absent, ? unknown) and `states` (t, u, s, l; in
    /// capitals the box is right); scores in tenths.
    fn run(truth: &str, states: &str, scores: &str) -> Observation {
        let frames =
            truth.chars().zip(states.chars()).zip(scores.chars()).map(|((t, s), score)| Frame {
                truth: match t {
                    'v' => Truth::Visible(HERE),
                    'a' => Truth::Absent,
                    _ => Truth::Unknown,
                },
                predicted: if s.is_uppercase() { HERE } else { THERE },
                score: score.to_digit(10).unwrap() as f32 * 0.1,
                state: match s.to_ascii_lowercase() {
                    't' => TrackState::Tracking,
                    'u' | 'r' => TrackState::Uncertain,
                    's' => TrackState::Searching,
                    _ => TrackState::Lost,
                },
                redetected: s == 'R',
            });
        Observation { sequence: truth.into(), frames: frames.collect() }
    }

    #[test]
    fn one_absence_by_hand() {
        // Frame:   0123456789..
        let r = run("vvvaaaaa?vvvv", "TTTTtussLlSuT", "9876432115379");
        // State letters of the absence (frames 3-7): T t u s s, then unknown L, then visible.
        let s = presence(&[r]);
        assert_eq!((s.sequences, s.visible, s.absent), (1, 6, 5));
        assert_eq!(s.false_lock_rate, Some(2.0 / 5.0));
        assert_eq!(s.false_report_rate, Some(3.0 / 5.0));
        // Visible frames 9 (lost) and 10 (searching) of six.
        assert_eq!(s.missed_rate, Some(2.0 / 6.0));
        // s after T t u; lost in the unknown frame, the fifth after the first.
        assert_eq!((s.noticed.came, s.noticed.mean_frames), (1, Some(3.0)));
        assert_eq!((s.lost.came, s.lost.mean_frames), (1, Some(5.0)));
        // Back in frame 9: lost; 10 right place but searching; 11 reported, wrong; 12 right.
        assert_eq!((s.redetected.median_frames, s.found_by_scan), (Some(3), 0));
        // Visible scores 8 7 | 5 3 7 9, absent 6 4 3 2 1: wins of 8: 5, 7: 5, 5: 4, 3: 2.5, 7: 5, 9: 5.
        assert!((s.auroc.unwrap() - 26.5 / 30.0).abs() < 1e-9, "{s:?}");
    }

    #[test]
    fn what_does_not_happen_counts_as_slowest() {
        let never = run("vvaaavv", "TTtttss", "9999900");
        let scanned = run("vvaaavvv", "TTslllRT", "99000099");
        let open_end = run("vvaa", "TTsl", "9900");
        let s = presence(&[never.clone(), scanned, open_end]);
        assert_eq!((s.noticed.changes, s.noticed.came), (3, 2));
        assert_eq!(
            s.lost,
            Delay { changes: 3, came: 2, mean_frames: Some(1.0), median_frames: Some(1) }
        );
        // The one that ends absent has nothing to find; of the other two one is found, in frame 1.
        assert_eq!((s.redetected.changes, s.redetected.came, s.found_by_scan), (2, 1, 1));
        assert_eq!(s.redetected.median_frames, Some(1));
        let s = presence(&[never]);
        assert_eq!((s.redetected.mean_frames, s.redetected.median_frames), (None, None));
        assert_eq!(s.false_lock_rate, Some(1.0));
    }

    #[test]
    fn without_absences_there_is_nothing_to_say() {
        let s = presence(&[run("vvv", "TTT", "999")]);
        assert_eq!((s.auroc, s.false_lock_rate, s.missed_rate), (None, None, Some(0.0)));
        assert_eq!(s.lost, Delay::default());
        assert_eq!(presence(&[]), PresenceSummary::default());
        assert_eq!(presence(&[run("", "", "")]).visible, 0);
    }

    #[test]
    fn who_was_lost_before_the_target_went_is_not_credited() {
        let s = presence(&[run("vvaav", "TllTT", "90009"), run("vvaav", "TssLT", "90009")]);
        assert_eq!(s.noticed.changes, 0);
        assert_eq!((s.lost.changes, s.lost.mean_frames), (1, Some(1.0)));
        assert_eq!(s.redetected.came, 2);
    }

    #[test]
    fn several_absences_are_counted_one_by_one() {
        let s = presence(&[run("vavavv", "TsTsuT", "909098")]);
        assert_eq!(s.redetected.changes, 2);
        assert_eq!(s.redetected.mean_frames, Some(0.5));
        assert_eq!(s.noticed.mean_frames, Some(0.0));
    }
}
