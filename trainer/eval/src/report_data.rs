//! Everything a report shows, as plain data: curves and figures per protocol and tracker, per
//! attribute and number of switches, per sequence. Serialised as `comparison.json` and read back by
//! whatever draws it.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};
use tsda_runtime::Modality;

use crate::attributes::Attributes;
use crate::distribution::{LatencyHistogram, ScoreHistogram};
use crate::evaluate::Evaluation;
use crate::metrics::recovery::{self, DEFAULT_HOLD};
use crate::metrics::score::row;
use crate::metrics::{
    Convention, Figures, Recovery, Row, Score, ScoreError, ScoreOptions, SwitchRecovery, Truth,
    frame_errors, score,
};
use crate::protocol::frame_rate;
use crate::truth::TruthSet;

/// Version of the layout; raised when a reader of the old one would go wrong.
pub const REPORT_VERSION: u32 = 1;

/// Results of several trackers on one dataset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReportData {
    /// [`REPORT_VERSION`] of the writer.
    pub version: u32,
    /// The dataset's name.
    pub dataset: String,
    /// Whose rules the figures follow.
    pub convention: Convention,
    /// Thresholds of the curves.
    pub thresholds: Thresholds,
    /// Frames in a row that make a recovery.
    pub hold: usize,
    /// One entry per protocol.
    pub protocols: Vec<ProtocolData>,
}

/// Thresholds of the curves, common to all trackers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Thresholds {
    /// Overlap.
    pub success: Vec<f64>,
    /// Pixels.
    pub precision: Vec<f64>,
    /// Fraction of the target's size.
    pub normalised_precision: Vec<f64>,
}

impl Thresholds {
    /// Those of a convention.
    pub fn of(convention: Convention) -> Self {
        Self {
            success: convention.success_thresholds(),
            precision: convention.precision_thresholds(),
            normalised_precision: convention.normalised_thresholds(),
        }
    }
}

/// All trackers under one protocol.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ProtocolData {
    /// `rgb2t`, `switch:20` ..; `None` for results as they were found.
    pub protocol: Option<String>,
    /// Sequences every average runs over.
    pub sequences: Vec<String>,
    /// Sequences left out of the averages, and why.
    pub left_out: Vec<LeftOut>,
    /// The trackers, in the order given.
    pub trackers: Vec<TrackerData>,
    /// Per figure (JSON key), the trackers whose overall value is the best at the precision shown.
    pub best: BTreeMap<String, Vec<String>>,
}

/// A sequence that is in no average.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeftOut {
    /// The sequence.
    pub sequence: String,
    /// The tracker whose result is missing or incomplete; `None`: it has no truth.
    pub tracker: Option<String>,
    /// Why.
    pub reason: String,
}

/// One tracker under one protocol.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TrackerData {
    /// Its name.
    pub tracker: String,
    /// Average over the sequences, with curves.
    pub overall: Score,
    /// Frames per second inside the tracker, where known.
    pub fps: Option<f64>,
    /// Confidences, where known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scores: Option<ScoreHistogram>,
    /// Time per frame, where known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latencies_ms: Option<LatencyHistogram>,
    /// Per attribute, by name.
    pub attributes: Vec<GroupData>,
    /// Per number of sensor switches, ascending.
    pub switches: Vec<GroupData>,
    /// Recovery over all switches.
    pub recovery: Option<Recovery>,
    /// Per sequence.
    pub sequences: BTreeMap<String, SequenceData>,
}

/// An average over some of the sequences.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GroupData {
    /// Attribute, or range of switches (`0`, `1`, `2`, `3`, `4-7`, `8-15`, ..).
    pub group: String,
    /// Sequences in it.
    pub sequences: usize,
    /// Their average.
    #[serde(flatten)]
    pub figures: Figures,
    /// Their recovery after switches.
    pub recovery: Option<Recovery>,
}

/// One tracker on one sequence.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SequenceData {
    /// Figures and curves.
    #[serde(flatten)]
    pub score: Score,
    /// Attributes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub attributes: Vec<String>,
    /// Number of sensor switches, where sensors are known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub switches: Option<usize>,
    /// What became of each switch.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub recoveries: Vec<SwitchRecovery>,
    /// Overlap of every frame to four decimals, `None` where the target is absent; only where
    /// asked for ([`DataOptions::frames`]).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub iou: Vec<Option<f64>>,
    /// Frame of the sequence that the run started with; entry 0 of every list is of this frame.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub start: usize,
    /// Frames per second inside the tracker, where known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fps: Option<f64>,
    /// Mean confidence of predicted frames, where known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_score: Option<f64>,
    /// File with boxes, scores and times of every frame ([`crate::store::Record`]), relative to the
    /// report's folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub record: Option<String>,
    /// Predicted boxes that are not finite.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub nan: usize,
    /// Predicted boxes beyond the truth, left out.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub cut: usize,
}

// serde asks for a reference.
#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_zero(n: &usize) -> bool {
    *n == 0
}

/// What goes into the data.
#[derive(Clone, Copy, Debug)]
pub struct DataOptions {
    /// Whose rules.
    pub convention: Convention,
    /// Rounding and lengths.
    pub score: ScoreOptions,
    /// Frames in a row that make a recovery.
    pub hold: usize,
    /// Keep the overlap of every frame (for pictures of failures; makes the file large).
    pub frames: bool,
}

impl Default for DataOptions {
    fn default() -> Self {
        Self {
            convention: Convention::default(),
            score: ScoreOptions::default(),
            hold: DEFAULT_HOLD,
            frames: false,
        }
    }
}

impl SequenceData {
    /// Scores one result; sensors, where known, give switches and recoveries.
    ///
    /// # Errors
    /// When truth and prediction do not fit together or the convention.
    pub fn of(
        truth: Truth<'_>,
        predicted: &[Row],
        modalities: Option<&[Modality]>,
        options: DataOptions,
    ) -> Result<Self, ScoreError> {
        let score = score(options.convention, truth, predicted, options.score)?;
        let frames = truth.visible.len().min(predicted.len());
        let mut data = Self {
            score,
            nan: predicted.iter().filter(|r| r.iter().any(|v| !v.is_finite())).count(),
            cut: predicted.len() - frames,
            ..Self::default()
        };
        if modalities.is_none() && !options.frames {
            return Ok(data);
        }
        // Recovery and pictures look at the boxes themselves, not at a toolkit's view of them.
        let overlap = |i: usize, rows: &[Row]| {
            let t = crate::metrics::score::bbox(rows[i]);
            let p = crate::metrics::score::bbox(predicted[i]);
            t.is_valid().then(|| frame_errors(t, p).iou)
        };
        let iou: Vec<Option<f64>> = (0..frames)
            .map(|i| {
                let one = overlap(i, truth.visible);
                let other = truth.infrared.and_then(|rows| overlap(i, rows));
                match (one, other) {
                    (Some(a), Some(b)) => Some(a.max(b)),
                    (a, b) => a.or(b),
                }
            })
            .collect();
        if let Some(modalities) = modalities {
            data.switches = Some(recovery::switches(&modalities[..frames.min(modalities.len())]));
            data.recoveries = recovery::recoveries(&iou, modalities, options.hold);
        }
        if options.frames {
            data.iou = iou.iter().map(|v| v.map(|v| (v * 1e4).round() / 1e4)).collect();
        }
        Ok(data)
    }

    /// As if repetitions of one sequence were one result.
    pub fn merge(repetitions: Vec<Self>) -> Self {
        let score = Score::pooled(repetitions.iter().map(|r| &r.score));
        let (nan, cut) = repetitions.iter().fold((0, 0), |(n, c), r| (n + r.nan, c + r.cut));
        let recoveries = repetitions.iter().flat_map(|r| r.recoveries.iter().copied()).collect();
        match repetitions.into_iter().next() {
            Some(first) => Self { score, nan, cut, recoveries, ..first },
            None => Self::default(),
        }
    }
}

impl TrackerData {
    /// Averages sequences, overall, per attribute and per number of switches.
    pub fn of(
        tracker: &str,
        mut sequences: BTreeMap<String, SequenceData>,
        attributes: &Attributes,
        options: DataOptions,
    ) -> Self {
        for (name, data) in &mut sequences {
            data.attributes = attributes.of(name);
        }
        let group = |group: String, members: &[&SequenceData]| GroupData {
            group,
            sequences: members.len(),
            figures: Score::average(options.convention, members.iter().map(|m| &m.score)).figures,
            recovery: Recovery::of(members.iter().flat_map(|m| &m.recoveries), options.hold),
        };
        let mut by_attribute: BTreeMap<&str, Vec<&SequenceData>> = BTreeMap::new();
        let mut by_switches: BTreeMap<usize, Vec<&SequenceData>> = BTreeMap::new();
        for data in sequences.values() {
            for attribute in &data.attributes {
                by_attribute.entry(attribute).or_default().push(data);
            }
            if let Some(n) = data.switches {
                by_switches.entry(switch_group(n).0).or_default().push(data);
            }
        }
        Self {
            tracker: tracker.to_owned(),
            overall: Score::average(options.convention, sequences.values().map(|s| &s.score)),
            fps: None,
            scores: None,
            latencies_ms: None,
            attributes: by_attribute.iter().map(|(n, m)| group((*n).to_owned(), m)).collect(),
            switches: by_switches.iter().map(|(n, m)| group(switch_group(*n).1, m)).collect(),
            recovery: Recovery::of(sequences.values().flat_map(|s| &s.recoveries), options.hold),
            sequences,
        }
    }

    /// The data of an evaluation made by this program. Truth is that of the active sensor, so only
    /// conventions of one truth fit.
    ///
    /// # Errors
    /// When the convention takes two truths, or lists of a result made by hand differ in length.
    pub fn of_evaluation(
        evaluation: &Evaluation,
        attributes: &Attributes,
        options: DataOptions,
    ) -> Result<Self, ScoreError> {
        let mut sequences = BTreeMap::new();
        for result in &evaluation.results {
            let truth: Vec<Row> = result.truth.iter().map(|t| row(*t)).collect();
            let predicted: Vec<Row> = result.predicted.iter().map(|p| row(Some(*p))).collect();
            let sensors = Some(result.modalities.as_slice());
            let data = SequenceData::of(Truth::one(&truth), &predicted, sensors, options)?;
            sequences.insert(result.label(), data);
        }
        let mut data = Self::of(&evaluation.tracker, sequences, attributes, options);
        data.fps = frame_rate(&evaluation.results);
        Ok(data)
    }

    /// The data of an evaluation against `truth` (of the same dataset, protocol and convention),
    /// with histograms of scores and times. `record` names a result's file by its label. Results
    /// without truth in this convention are named in the second list.
    ///
    /// # Errors
    /// When a result does not fit its truth; names the sequence.
    pub fn of_run(
        evaluation: &Evaluation,
        truth: &TruthSet,
        attributes: &Attributes,
        options: DataOptions,
        record: &dyn Fn(&str) -> Option<String>,
    ) -> Result<(Self, Vec<LeftOut>), EvaluationScoreError> {
        let by_name: BTreeMap<&str, _> =
            truth.sequences.iter().map(|s| (s.name.as_str(), s)).collect();
        let (mut sequences, mut left_out) = (BTreeMap::new(), Vec::new());
        for result in &evaluation.results {
            let label = result.label();
            let Some(truth) = by_name.get(label.as_str()) else {
                let reason = format!("no truth of convention {}", options.convention);
                left_out.push(LeftOut { sequence: label, tracker: None, reason });
                continue;
            };
            let predicted: Vec<Row> = result.predicted.iter().map(|p| row(Some(*p))).collect();
            let sensors = Some(result.modalities.as_slice());
            let mut data = SequenceData::of(truth.as_truth(), &predicted, sensors, options)
                .map_err(|source| EvaluationScoreError { sequence: label.clone(), source })?;
            let scores = result.confidence.iter().skip(1).filter(|s| s.is_finite());
            let (sum, n) = scores.fold((0.0, 0), |(sum, n), s| (sum + f64::from(*s), n + 1));
            data.mean_score = (n > 0).then(|| sum / f64::from(n));
            data.start = result.start;
            data.fps = frame_rate([result]);
            data.record = record(&label);
            sequences.insert(label, data);
        }
        let mut data = Self::of(&evaluation.tracker, sequences, attributes, options);
        data.fps = frame_rate(&evaluation.results);
        data.scores = ScoreHistogram::of(&evaluation.results);
        data.latencies_ms = LatencyHistogram::of(&evaluation.results);
        Ok((data, left_out))
    }
}

/// A result that could not be scored.
#[derive(Debug, thiserror::Error)]
#[error("sequence {sequence}: {source}")]
pub struct EvaluationScoreError {
    /// The sequence.
    pub sequence: String,
    /// What does not fit.
    pub source: ScoreError,
}

/// Lower end and name of the group that `n` switches belong to: single numbers up to 3, then
/// doubling ranges.
fn switch_group(n: usize) -> (usize, String) {
    if n < 4 {
        return (n, n.to_string());
    }
    let low = 1 << n.ilog2();
    (low, format!("{low}-{}", 2 * low - 1))
}

impl ProtocolData {
    /// Puts trackers side by side; `sequences` are those the averages run over.
    pub fn new(
        convention: Convention,
        protocol: Option<String>,
        trackers: Vec<TrackerData>,
        left_out: Vec<LeftOut>,
    ) -> Self {
        let all: BTreeSet<&String> = trackers.iter().flat_map(|t| t.sequences.keys()).collect();
        let sequences = all.into_iter().cloned().collect();
        let overall: Vec<(&str, &Figures)> =
            trackers.iter().map(|t| (t.tracker.as_str(), &t.overall.figures)).collect();
        let best = best(convention, &overall)
            .into_iter()
            .map(|(key, names)| (key.to_owned(), names.into_iter().map(str::to_owned).collect()))
            .collect();
        Self { protocol, sequences, left_out, trackers, best }
    }
}

/// A figure as tables show it, in per cent.
pub fn shown(value: f64) -> String {
    format!("{:.1}", 100.0 * value)
}

/// Per column, the names whose value is the best at the precision shown; empty for a single one.
pub(crate) fn best<'a>(
    convention: Convention,
    rows: &[(&'a str, &Figures)],
) -> BTreeMap<&'static str, Vec<&'a str>> {
    let mut best = BTreeMap::new();
    if rows.len() < 2 {
        return best;
    }
    for (key, _, get) in Figures::columns(convention) {
        let top = shown(rows.iter().map(|(_, f)| get(f)).fold(f64::MIN, f64::max));
        let names = rows.iter().filter(|(_, f)| shown(get(f)) == top).map(|(n, _)| *n).collect();
        best.insert(key, names);
    }
    best
}

impl ReportData {
    /// Data of one dataset and convention, protocols still to be added.
    pub fn new(dataset: &str, convention: Convention, hold: usize) -> Self {
        Self {
            version: REPORT_VERSION,
            dataset: dataset.to_owned(),
            convention,
            thresholds: Thresholds::of(convention),
            hold,
            protocols: Vec::new(),
        }
    }
}

#[cfg(test)]
#[path = "report_data_tests.rs"]
mod tests;
