//! How long a tracker needs after a sensor switch.
//!
//! A **switch** is a frame whose sensor differs from the frame before. Its **segment** runs up to
//! the next switch or the end, and only frames in which the target is visible count. The target is
//! **recovered** at the first of `hold` such frames in a row, all in the segment, with IoU at least
//! 0.5; the **recovery time** is the number of visible frames before it, 0 when the switch did no
//! harm. A segment with fewer than `hold` visible frames says nothing and is not judged.

use serde::{Deserialize, Serialize};
use tsda_runtime::Modality;

/// Least IoU of a frame that counts as on the target (inclusive, unlike the success rate's).
pub const RECOVERED_IOU: f64 = 0.5;

/// Frames in a row that make a recovery, unless stated otherwise.
pub const DEFAULT_HOLD: usize = 5;

/// What became of one switch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SwitchRecovery {
    /// First frame of the new sensor; frame 0 is the one the tracker was initialised with.
    pub frame: usize,
    /// The new sensor.
    pub to: Modality,
    /// Visible frames up to the next switch.
    pub visible: usize,
    /// Visible frames before the target was held again; `None`: not before the next switch.
    pub frames: Option<usize>,
}

/// Recovery over many switches.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Recovery {
    /// Switches that could be judged.
    pub switches: usize,
    /// Of these, recovered before the next switch.
    pub recovered: usize,
    /// Share of `recovered`; 0 without switches.
    pub rate: f64,
    /// Share of switches that did no harm (time 0).
    pub undisturbed: f64,
    /// Mean time of those recovered, in frames.
    pub mean_frames: Option<f64>,
    /// Median time of all, those not recovered being the slowest; `None` when it is one of them.
    pub median_frames: Option<f64>,
    /// Frames in a row that make a recovery.
    pub hold: usize,
}

/// Number of switches.
pub fn switches(modalities: &[Modality]) -> usize {
    modalities.windows(2).filter(|w| w[0] != w[1]).count()
}

/// Judges every switch of one result. `iou` has an entry per frame, `None` where the target is not
/// visible; frames beyond the shorter list are left out. A `hold` of 0 counts as 1.
pub fn recoveries(
    iou: &[Option<f64>],
    modalities: &[Modality],
    hold: usize,
) -> Vec<SwitchRecovery> {
    let hold = hold.max(1);
    let frames = iou.len().min(modalities.len());
    let starts: Vec<usize> = (1..frames).filter(|&i| modalities[i] != modalities[i - 1]).collect();
    let ends = starts.iter().skip(1).copied().chain([frames]);
    let mut judged = Vec::new();
    for (&frame, end) in starts.iter().zip(ends) {
        let visible: Vec<f64> = iou[frame..end].iter().flatten().copied().collect();
        if visible.len() >= hold {
            let held = |run: &[f64]| run.iter().all(|&v| v >= RECOVERED_IOU);
            judged.push(SwitchRecovery {
                frame,
                to: modalities[frame],
                visible: visible.len(),
                frames: visible.windows(hold).position(held),
            });
        }
    }
    judged
}

impl Recovery {
    /// Sums up switches of any number of sequences; `None` without any.
    pub fn of<'a>(
        switches: impl IntoIterator<Item = &'a SwitchRecovery>,
        hold: usize,
    ) -> Option<Self> {
        let mut times: Vec<Option<usize>> = switches.into_iter().map(|s| s.frames).collect();
        if times.is_empty() {
            return None;
        }
        // Those not recovered go last.
        times.sort_by_key(|t| t.unwrap_or(usize::MAX));
        let n = times.len();
        let recovered = times.iter().flatten().count();
        let undisturbed = times.iter().filter(|t| **t == Some(0)).count();
        let sum: usize = times.iter().flatten().sum();
        let middle = |i: usize| times[i].map(|t| t as f64);
        let median = match (middle((n - 1) / 2), middle(n / 2)) {
            (Some(a), Some(b)) => Some((a + b) / 2.0),
            _ => None,
        };
        Some(Self {
            switches: n,
            recovered,
            rate: recovered as f64 / n as f64,
            undisturbed: undisturbed as f64 / n as f64,
            mean_frames: (recovered > 0).then(|| sum as f64 / recovered as f64),
            median_frames: median,
            hold: hold.max(1),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Modality::{Rgb, Thermal};

    /// Letters: r/t frame of that sensor with the target held, R/T lost, - absent (sensor as before).
    fn clip(text: &str) -> (Vec<Option<f64>>, Vec<Modality>) {
        let mut modality = Rgb;
        text.chars()
            .map(|c| {
                modality = match c {
                    'r' | 'R' => Rgb,
                    't' | 'T' => Thermal,
                    _ => modality,
                };
                let iou = match c {
                    'r' | 't' => Some(0.5),
                    '-' => None,
                    _ => Some(0.499),
                };
                (iou, modality)
            })
            .unzip()
    }

    #[test]
    fn times_of_hand_made_clips() {
        for (text, hold, want) in [
            ("rrrr", 2, vec![]),
            ("rttt", 2, vec![Some(0)]),
            ("rTtt", 2, vec![Some(1)]),
            ("rTtTtt", 2, vec![Some(3)]),
            ("rTtTtT", 2, vec![None]),
            // The run must end before the next switch.
            ("rTTtrr", 2, vec![None, Some(0)]),
            // Absent frames neither count nor break a run.
            ("rT-t-t", 2, vec![Some(1)]),
            // Too short to be judged.
            ("rtrrr", 2, vec![Some(0)]),
            ("rtrrr", 0, vec![Some(0), Some(0)]),
        ] {
            let (iou, modalities) = clip(text);
            let found: Vec<_> =
                recoveries(&iou, &modalities, hold).iter().map(|r| r.frames).collect();
            assert_eq!(found, want, "{text} {hold}");
        }
        let (iou, modalities) = clip("rTtrr");
        assert_eq!(switches(&modalities), 2);
        let all = recoveries(&iou, &modalities, 1);
        let first = SwitchRecovery { frame: 1, to: Thermal, visible: 2, frames: Some(1) };
        assert_eq!((all[0], all[1].frame), (first, 3));
    }

    #[test]
    fn sums() {
        let at = |frames| SwitchRecovery { frame: 1, to: Rgb, visible: 9, frames };
        assert_eq!(Recovery::of(&[], 5), None);
        let r = Recovery::of(&[at(None), at(Some(4)), at(Some(0))], 5).unwrap();
        assert_eq!((r.switches, r.recovered, r.hold), (3, 2, 5));
        assert_eq!((r.mean_frames, r.median_frames), (Some(2.0), Some(4.0)));
        assert!((r.rate - 2.0 / 3.0).abs() < 1e-12 && (r.undisturbed - 1.0 / 3.0).abs() < 1e-12);
        let r = Recovery::of(&[at(None), at(Some(4))], 5).unwrap();
        assert_eq!((r.mean_frames, r.median_frames), (Some(4.0), None));
    }
}
