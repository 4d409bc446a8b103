//! Scores and times of single frames, from files beside the results.
//!
//! Beside `<sequence>.txt` (or `<sequence>_001.txt` of GOT-10k folders) may lie
//!
//! | file | one line per frame |
//! |---|---|
//! | `<sequence>_score.txt`, `_scores.txt`, `_confidence.txt`, `_confidence.value` | the tracker's score |
//! | `<sequence>_time.txt`, `_times.txt`, `_time.value` | seconds |
//!
//! Without those, `<sequence>.json` as `tsda eval` writes it ([`Record`]) gives both.
//!
//! An empty line or NaN says nothing about its frame; the line of the initial frame may be missing.
//! Everything is optional: what is absent is left out of the report.

use std::path::{Path, PathBuf};

use crate::boxes::read_text;
use crate::dataset::DatasetError;
use crate::metrics::recovery::RECOVERED_IOU;
use crate::report_data::TrackerData;
use crate::results::ResultFolder;
use crate::store::Record;

const SCORES: [&str; 4] = ["_score.txt", "_scores.txt", "_confidence.txt", "_confidence.value"];
const RECORD: [&str; 1] = [".json"];
const TIMES: [&str; 3] = ["_time.txt", "_times.txt", "_time.value"];

/// Single frames of one tracker under one protocol; the initial frames are left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Samples {
    /// Scores of boxes with an IoU of at least 0.5.
    pub right: Vec<f64>,
    /// Scores of boxes with less.
    pub wrong: Vec<f64>,
    /// Scores of frames without the target.
    pub absent: Vec<f64>,
    /// Milliseconds per frame.
    pub milliseconds: Vec<f64>,
}

impl Samples {
    /// Reads what lies beside the results of the tracker's sequences. Right and wrong need the
    /// overlap of every frame ([`crate::report_data::DataOptions::frames`]).
    ///
    /// # Errors
    /// When a file is there but cannot be read, a line is no number, or there are not as many lines
    /// as frames.
    pub fn read(folder: &ResultFolder, tracker: &TrackerData) -> Result<Self, DatasetError> {
        let prefix = folder.prefix(tracker.sequences.keys().map(String::as_str));
        let mut samples = Self::default();
        for (name, data) in &tracker.sequences {
            // Overlaps are those of the first repetition.
            let Some(result) = folder.files(&prefix, name).into_iter().next() else { continue };
            let (scores, times) = (beside(&result, &SCORES), beside(&result, &TIMES));
            if scores.is_none() && times.is_none() {
                if let Some(path) = beside(&result, &RECORD) {
                    samples.add_record(&path, &data.iou)?;
                }
                continue;
            }
            if let Some(path) = scores
                && !data.iou.is_empty()
            {
                samples.add_scores(&numbers(&path, data.iou.len())?, &data.iou);
            }
            if let Some(path) = times {
                let frames = if data.iou.is_empty() { line_count(&path)? } else { data.iou.len() };
                let seconds = numbers(&path, frames)?;
                let times = seconds.iter().skip(1).flatten().filter(|s| **s >= 0.0);
                samples.milliseconds.extend(times.map(|s| 1e3 * s));
            }
        }
        Ok(samples)
    }

    /// One score per frame with its overlap; the initial frame is left out.
    fn add_scores(&mut self, scores: &[Option<f64>], iou: &[Option<f64>]) {
        for (score, iou) in scores.iter().zip(iou).skip(1) {
            let Some(score) = score else { continue };
            match iou {
                Some(v) if *v >= RECOVERED_IOU => self.right.push(*score),
                Some(_) => self.wrong.push(*score),
                None => self.absent.push(*score),
            }
        }
    }

    fn add_record(&mut self, path: &Path, iou: &[Option<f64>]) -> Result<(), DatasetError> {
        let wrong = |reason: String| DatasetError::Format { path: path.into(), line: None, reason };
        let record: Record = serde_json::from_str(&read_text(path)?)
            .map_err(|e| wrong(format!("not a record of tsda eval: {e}")))?;
        if !iou.is_empty() {
            // Overlaps may count from the sequence's first frame, records count from the start.
            let (frames, before) = (iou.len(), iou.len().saturating_sub(record.scores.len()));
            if record.scores.len() > frames || (before != 0 && before != record.start) {
                let scores = record.scores.len();
                return Err(wrong(format!("{scores} scores for results of {frames} frames")));
            }
            let scores: Vec<_> = record.scores.iter().map(|s| s.map(f64::from)).collect();
            self.add_scores(&scores, &iou[before..]);
        }
        let times = record.milliseconds.iter().skip(1).map(|ms| f64::from(*ms));
        self.milliseconds.extend(times.filter(|ms| *ms >= 0.0));
        Ok(())
    }

    /// Probability that a right box has a higher score than a wrong one (area under the ROC curve,
    /// ties count half); `None` without one of either.
    pub fn auroc(&self) -> Option<f64> {
        if self.right.is_empty() || self.wrong.is_empty() {
            return None;
        }
        let mut all: Vec<(f64, bool)> = self.right.iter().map(|s| (*s, true)).collect();
        all.extend(self.wrong.iter().map(|s| (*s, false)));
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (mut below, mut won) = (0.0, 0.0);
        for tie in all.chunk_by(|a, b| a.0 == b.0) {
            let right = tie.iter().filter(|s| s.1).count() as f64;
            let wrong = tie.len() as f64 - right;
            won += right * (below + wrong / 2.0);
            below += wrong;
        }
        Some(won / (self.right.len() as f64 * self.wrong.len() as f64))
    }

    /// Are there scores of frames with the target?
    pub fn has_scores(&self) -> bool {
        !self.right.is_empty() || !self.wrong.is_empty()
    }
}

/// Value below which the share `q` of `values` lies (nearest rank); `None` without any.
pub(super) fn quantile(values: &[f64], q: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let rank = (q * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied()
}

/// The first file that exists: after the result's own name, or the name without the repetition.
fn beside(result: &Path, suffixes: &[&str]) -> Option<PathBuf> {
    let stem = result.file_stem()?.to_str()?;
    let sequence = stem.rsplit_once('_').map(|(sequence, _)| sequence);
    let nested = result.parent()?.file_name()?.to_str();
    let stems = [Some(stem), sequence.filter(|s| Some(*s) == nested)];
    stems
        .into_iter()
        .flatten()
        .flat_map(|stem| suffixes.iter().map(move |suffix| format!("{stem}{suffix}")))
        .map(|name| result.with_file_name(name))
        .find(|path| path.is_file())
}

/// Lines of a file, without blank ones at its end.
fn line_count(path: &Path) -> Result<usize, DatasetError> {
    Ok(read_text(path)?.trim_end().lines().count())
}

/// One entry per frame.
fn numbers(path: &Path, frames: usize) -> Result<Vec<Option<f64>>, DatasetError> {
    let wrong = |line: usize, reason: String| DatasetError::Format {
        path: path.to_owned(),
        line: Some(line),
        reason,
    };
    let text = read_text(path)?;
    let mut values = Vec::with_capacity(frames);
    for (i, line) in text.trim_end().lines().enumerate() {
        let line = line.trim();
        values.push(match line.parse::<f64>() {
            Ok(v) => Some(v).filter(|v| v.is_finite()),
            Err(_) if line.is_empty() => None,
            Err(_) => {
                let found: String = line.chars().take(40).collect();
                return Err(wrong(i + 1, format!("'{found}' is no number")));
            }
        });
    }
    if values.len() + 1 == frames {
        values.insert(0, None);
    }
    if values.len() != frames {
        let found = values.len();
        let reason = format!("{found} lines for {frames} frames: one number per frame is needed");
        return Err(wrong(found.min(frames) + 1, reason));
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report_data::SequenceData;
    use std::collections::BTreeMap;

    fn tracker(iou: &[Option<f64>]) -> TrackerData {
        let data = SequenceData { iou: iou.to_vec(), ..SequenceData::default() };
        TrackerData {
            sequences: BTreeMap::from([("s".to_owned(), data)]),
            ..TrackerData::default()
        }
    }

    const IOU: [Option<f64>; 5] = [Some(1.0), Some(0.5), Some(0.4), None, Some(0.9)];

    fn read(files: &[(&str, &str)], iou: &[Option<f64>]) -> Result<Samples, DatasetError> {
        let dir = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        Samples::read(&ResultFolder::open(dir.path(), None).unwrap(), &tracker(iou))
    }

    #[test]
    fn frames_are_sorted_by_what_became_of_them() {
        let want = Samples {
            right: vec![0.8, 0.7],
            wrong: vec![0.3],
            absent: vec![0.1],
            milliseconds: vec![],
        };
        for text in ["1\n0.8\n0.3\n0.1\n0.7\n", "0.8\n0.3\n0.1\n0.7", "\n0.8\r\n0.3\n0.1\n0.7\n\n"]
        {
            let found = read(&[("s.txt", "0"), ("s_score.txt", text)], &IOU).unwrap();
            assert_eq!(found, want, "{text:?}");
        }
        let nested =
            read(&[("s/s_001.txt", "0"), ("s/s_time.txt", "9\n0.25\nnan\n0.5\n1\n")], &IOU);
        assert_eq!(nested.unwrap().milliseconds, [250.0, 500.0, 1000.0]);
        assert_eq!(read(&[("s.txt", "0")], &IOU).unwrap(), Samples::default());
        // Without overlaps scores cannot be judged, times can be told.
        let blind = read(&[("s.txt", "0"), ("s_score.txt", "1"), ("s_time.txt", "1\n2\n")], &[]);
        assert_eq!(blind.unwrap(), Samples { milliseconds: vec![2000.0], ..Samples::default() });
    }

    #[test]
    fn what_does_not_fit_is_named() {
        for (text, words) in [
            ("1\n2\nx\n4\n5\n", ["s_score.txt, line 3", "'x' is no number"]),
            ("1\n2\n3\n", ["s_score.txt, line 4", "3 lines for 5 frames"]),
            ("1\n2\n3\n4\n5\n6\n", ["s_score.txt, line 6", "6 lines for 5 frames"]),
        ] {
            let e = read(&[("s.txt", "0"), ("s_score.txt", text)], &IOU).unwrap_err().to_string();
            assert!(words.iter().all(|w| e.contains(w)), "{e}");
        }
    }

    #[test]
    fn areas_and_quantiles() {
        let of = |right: &[f64], wrong: &[f64]| {
            Samples { right: right.into(), wrong: wrong.into(), ..Samples::default() }.auroc()
        };
        assert_eq!(of(&[0.9, 0.8], &[0.1]), Some(1.0));
        assert_eq!(of(&[0.5], &[0.5, 0.7]), Some(0.25));
        assert_eq!(of(&[0.5], &[]), None);
        let values = [4.0, 1.0, 3.0, 2.0];
        assert_eq!((quantile(&values, 0.5), quantile(&values, 0.95)), (Some(2.0), Some(4.0)));
        assert_eq!((quantile(&values, 0.0), quantile(&[], 0.5)), (Some(1.0), None));
    }
}
