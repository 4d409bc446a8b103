//! Figures of one tracker over protocols, as JSON, and a Markdown table of several trackers.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::evaluate::{Evaluation, Failure};
use crate::metrics::convention::Truths;
use crate::metrics::{Convention, Figures, FirstFrame, Recovery, Scores};
use crate::otb;
use crate::protocol::frame_rate;
use crate::report_data::{GroupData, LeftOut, TrackerData};

/// Everything a results file says about one tracker on one dataset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Tracker.
    pub tracker: String,
    /// Dataset, as it was named when opened.
    pub dataset: String,
    /// How the initial frame entered the figures.
    pub first_frame: FirstFrame,
    /// By protocol name (`rgb2t`, `t2rgb`, `switch:20`, ..).
    pub protocols: BTreeMap<String, ProtocolSummary>,
}

/// One protocol.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ProtocolSummary {
    /// Every target counts the same. Stands directly in the protocol's object.
    #[serde(flatten)]
    pub mean: Scores,
    /// Targets that count.
    pub sequences: usize,
    /// Frames per second inside the tracker, per thread, decoding and the initial frame left out;
    /// `None` for a tracker without work worth timing.
    pub fps: Option<f64>,
    /// Every frame counts the same.
    pub pooled: Scores,
    /// By target.
    pub targets: BTreeMap<String, Scores>,
    /// Sequences left out because they lack a sensor or a target.
    pub skipped: Vec<String>,
    /// Why, and what else is in no average.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub left_out: Vec<LeftOut>,
    /// Tried and failed.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub failed: Vec<Failure>,
    /// Figures by the rules of the dataset's benchmark.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub benchmark: Option<BenchmarkFigures>,
    /// By attribute, by those rules.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub attributes: Vec<GroupData>,
    /// By number of sensor switches, by those rules.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub switches: Vec<GroupData>,
    /// After sensor switches.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recovery: Option<Recovery>,
}

/// Figures by the rules of a benchmark.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BenchmarkFigures {
    /// Whose rules.
    pub convention: Convention,
    /// The figures; `pr5` of GTOT, `ao` and `sr75` of GOT-10k among them.
    #[serde(flatten)]
    pub figures: Figures,
    /// Precision against the better of two truths under its published name: at 20 px, of GTOT 5 px.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mpr: Option<f64>,
    /// Success against the better of two truths under its published name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub msr: Option<f64>,
}

impl BenchmarkFigures {
    /// Names figures as the papers of a benchmark do.
    pub fn new(convention: Convention, figures: Figures) -> Self {
        let two = convention.truths() == Truths::Two;
        Self {
            convention,
            figures,
            mpr: two.then(|| figures.pr5.unwrap_or(figures.scores.pr20)),
            msr: two.then_some(figures.scores.auc),
        }
    }
}

/// A summary that cannot be written, read or put together.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SummaryError {
    /// A file could not be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no summary.
    #[error("{path}: not a summary: {source}")]
    Json {
        /// The file.
        path: PathBuf,
        /// What does not fit.
        source: serde_json::Error,
    },
    /// Evaluations of different trackers, datasets or first-frame rules were mixed.
    #[error("cannot summarise '{found}' together with '{expected}': {what} differs")]
    Mixed {
        /// What differs.
        what: &'static str,
        /// Of the first evaluation.
        expected: String,
        /// Of the other one.
        found: String,
    },
    /// There was nothing to summarise.
    #[error("no evaluation to summarise")]
    Empty,
}

impl ProtocolSummary {
    /// Averages one evaluation.
    pub fn of(evaluation: &Evaluation) -> Self {
        Self {
            mean: Scores::mean(&evaluation.scores),
            sequences: evaluation.scores.iter().filter(|s| s.frames > 0).count(),
            fps: frame_rate(&evaluation.results),
            pooled: Scores::pooled(&evaluation.scores),
            targets: evaluation
                .results
                .iter()
                .map(crate::protocol::SequenceResult::label)
                .zip(evaluation.scores.iter().copied())
                .collect(),
            skipped: evaluation.skipped.iter().map(|s| s.sequence.clone()).collect(),
            left_out: evaluation
                .skipped
                .iter()
                .map(|s| LeftOut {
                    sequence: s.sequence.clone(),
                    tracker: None,
                    reason: s.reason.clone(),
                })
                .collect(),
            failed: evaluation.failed.clone(),
            benchmark: None,
            attributes: Vec::new(),
            switches: Vec::new(),
            recovery: None,
        }
    }

    /// Adds figures, tables and recovery of `data`, scored by the rules of `convention`.
    pub fn add(&mut self, data: &TrackerData, convention: Convention) {
        self.benchmark = Some(BenchmarkFigures::new(convention, data.overall.figures));
        self.attributes = data.attributes.clone();
        self.switches = data.switches.clone();
        self.recovery = data.recovery;
    }
}

impl Summary {
    /// Puts evaluations of one tracker on one dataset under several protocols together.
    ///
    /// # Errors
    /// When there are none, or they are not of one tracker, dataset and first-frame rule.
    pub fn of<'a>(
        evaluations: impl IntoIterator<Item = &'a Evaluation>,
    ) -> Result<Self, SummaryError> {
        let mut summary: Option<Self> = None;
        for e in evaluations {
            let s = summary.get_or_insert_with(|| Self {
                tracker: e.tracker.clone(),
                dataset: e.dataset.clone(),
                first_frame: e.first_frame,
                protocols: BTreeMap::new(),
            });
            for (what, expected, found) in [
                ("tracker", s.tracker.clone(), e.tracker.clone()),
                ("dataset", s.dataset.clone(), e.dataset.clone()),
                ("first frame", format!("{:?}", s.first_frame), format!("{:?}", e.first_frame)),
            ] {
                if expected != found {
                    return Err(SummaryError::Mixed { what, expected, found });
                }
            }
            s.protocols.insert(e.protocol.to_string(), ProtocolSummary::of(e));
        }
        summary.ok_or(SummaryError::Empty)
    }

    /// Writes the summary as JSON, whole or not at all.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write_json(&self, path: &Path) -> Result<(), SummaryError> {
        let mut bytes = serde_json::to_vec_pretty(self)
            .map_err(|source| SummaryError::Json { path: path.to_owned(), source })?;
        bytes.push(b'\n');
        otb::write_whole(path, &bytes)
            .map_err(|source| SummaryError::Io { path: path.to_owned(), source })
    }

    /// Reads what [`Self::write_json`] wrote.
    ///
    /// # Errors
    /// When the file cannot be read or is no summary.
    pub fn read_json(path: &Path) -> Result<Self, SummaryError> {
        let bytes = std::fs::read(path)
            .map_err(|source| SummaryError::Io { path: path.to_owned(), source })?;
        serde_json::from_slice(&bytes)
            .map_err(|source| SummaryError::Json { path: path.to_owned(), source })
    }
}

/// A Markdown table of several trackers, grouped by dataset and protocol; the best figure of each
/// group is bold (all equal ones, at the precision shown).
pub fn markdown(summaries: &[Summary]) -> String {
    type Column = (&'static str, fn(&Scores) -> f64);
    const COLUMNS: [Column; 5] = [
        ("SR@0.5", |s| s.sr50),
        ("AUC", |s| s.auc),
        ("PR@20", |s| s.pr20),
        ("NPR@0.2", |s| s.npr),
        ("mean IoU", |s| s.mean_iou),
    ];
    let mut groups: BTreeMap<(&str, &str), Vec<(&str, &ProtocolSummary)>> = BTreeMap::new();
    for s in summaries {
        for (protocol, figures) in &s.protocols {
            groups.entry((&s.dataset, protocol)).or_default().push((&s.tracker, figures));
        }
    }
    let mut text = String::from("| dataset | protocol | tracker |");
    for (name, _) in COLUMNS {
        let _ = write!(text, " {name} |");
    }
    text.push_str(" targets | frames | fps |\n|---|---|---|");
    text.push_str(&"---:|".repeat(COLUMNS.len() + 3));
    text.push('\n');
    // A pipe in a name would end its cell.
    let cell = |name: &str| name.replace('|', "\\|");
    for ((dataset, protocol), rows) in groups {
        let shown = |value: f64| format!("{:.1}", 100.0 * value);
        for (tracker, figures) in &rows {
            let _ = write!(text, "| {} | {} | {} |", cell(dataset), cell(protocol), cell(tracker));
            for (_, get) in COLUMNS {
                let value = shown(get(&figures.mean));
                let best = rows.iter().map(|(_, f)| get(&f.mean)).fold(f64::MIN, f64::max);
                if rows.len() > 1 && value == shown(best) {
                    let _ = write!(text, " **{value}** |");
                } else {
                    let _ = write!(text, " {value} |");
                }
            }
            let (n, frames) = (figures.sequences, figures.mean.frames);
            let fps = figures.fps.map_or("-".into(), |fps| format!("{fps:.0}"));
            let _ = writeln!(text, " {n} | {frames} | {fps} |");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn summary(tracker: &str, sr50: f64) -> Summary {
        let mean = Scores { sr50, auc: 0.25, pr20: 0.5, npr: 0.5, mean_iou: 0.5, frames: 59 };
        let figures = ProtocolSummary {
            mean,
            sequences: 1,
            fps: (tracker != "bad").then_some(30.25),
            pooled: mean,
            targets: BTreeMap::from([("a".to_owned(), mean)]),
            skipped: vec!["b".into()],
            left_out: Vec::new(),
            failed: vec![Failure { sequence: "c".into(), frame: Some(3), ..Failure::default() }],
            benchmark: Some(BenchmarkFigures::new(
                Convention::Gtot,
                Figures { scores: mean, pr5: Some(0.125), ..Figures::default() },
            )),
            attributes: Vec::new(),
            switches: Vec::new(),
            recovery: None,
        };
        Summary {
            tracker: tracker.into(),
            dataset: "set|1".into(),
            first_frame: FirstFrame::Excluded,
            protocols: BTreeMap::from([("rgb2t".to_owned(), figures)]),
        }
    }

    #[test]
    fn json_comes_back_and_shows_the_averages_directly() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("s.json");
        let s = summary("x", 0.5);
        s.write_json(&path).unwrap();
        assert_eq!(Summary::read_json(&path).unwrap(), s);
        let v: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
        assert_eq!(v["protocols"]["rgb2t"]["sr50"], 0.5);
        assert_eq!(v["first_frame"], "excluded");
        let benchmark = &v["protocols"]["rgb2t"]["benchmark"];
        assert_eq!((&benchmark["mpr"], &benchmark["msr"]), (&0.125.into(), &0.25.into()));
        assert_eq!(benchmark["convention"], "gtot");
        std::fs::write(&path, "{}").unwrap();
        assert!(Summary::read_json(&path).unwrap_err().to_string().contains("s.json"));
        assert!(s.write_json(&dir.path().join("no/s.json")).is_err());
    }

    #[test]
    fn the_table_marks_the_best_of_each_group() {
        let text = markdown(&[summary("good", 0.75), summary("bad", 0.1)]);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 4);
        assert_eq!(
            lines[2],
            "| set\\|1 | rgb2t | good | **75.0** | **25.0** | **50.0** | **50.0** | **50.0** \
             | 1 | 59 | 30 |"
        );
        assert!(lines[3].contains("| bad | 10.0 | **25.0** |"), "{}", lines[3]);
        assert!(lines[3].ends_with("| 59 | - |"), "a tracker that is not timed: {}", lines[3]);
        let columns = |l: &str| l.replace("\\|", "").matches('|').count();
        assert!(lines.iter().all(|l| columns(l) == columns(lines[0])));
    }

    #[test]
    fn nothing_makes_no_summary() {
        assert!(matches!(Summary::of([]), Err(SummaryError::Empty)));
    }
}
