//! Folders of results of any tracker, scored against one truth.
//!
//! Every average runs over the same sequences for all trackers. A tracker that lacks a sequence, or
//! whose result ends early, is refused by default ([`CompareError::Incomplete`] lists everything
//! that is missing); with [`CompareOptions::partial`] such sequences are left out **for all
//! trackers** and listed in [`ProtocolData::left_out`].

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use crate::attributes::Attributes;
use crate::boxes::{self, Layout};
use crate::dataset::DatasetError;
use crate::metrics::ScoreError;
use crate::protocol::Protocol;
use crate::report_data::{
    DataOptions, LeftOut, ProtocolData, ReportData, SequenceData, TrackerData,
};
use crate::results::ResultFolder;
use crate::truth::{SequenceTruth, TruthSet};

/// How to compare.
#[derive(Clone, Copy, Debug, Default)]
pub struct CompareOptions {
    /// Convention, rounding, lengths, recovery.
    pub data: DataOptions,
    /// What the numbers in result files are.
    pub layout: Layout,
    /// Leave out what a tracker lacks instead of refusing.
    pub partial: bool,
}

/// Results that cannot be compared.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CompareError {
    /// A file could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A result does not fit its truth.
    #[error("{}{}: {source}", path.display(), .line.map(|l| format!(", line {l}")).unwrap_or_default())]
    Score {
        /// The result file.
        path: PathBuf,
        /// 1-based line at which truth and result part.
        line: Option<usize>,
        /// What does not fit.
        source: ScoreError,
    },
    /// Two trackers of one name.
    #[error("two trackers are named '{0}': name one of them, as in {0}=other")]
    SameName(String),
    /// Sequences are missing or end early.
    #[error("{}; leave them out for all trackers with --partial", list(.0))]
    Incomplete(Vec<LeftOut>),
    /// No sequence is there for all trackers.
    #[error("no sequence of {dataset} has a result of every tracker{}", hint(.missing))]
    Nothing {
        /// The dataset.
        dataset: String,
        /// What is missing.
        missing: Vec<LeftOut>,
    },
}

/// The first few of what is missing, and how many more.
fn list(missing: &[LeftOut]) -> String {
    const SHOWN: usize = 5;
    let mut parts: Vec<String> = missing
        .iter()
        .take(SHOWN)
        .map(|m| {
            format!("{}: {}: {}", m.tracker.as_deref().unwrap_or("truth"), m.sequence, m.reason)
        })
        .collect();
    if missing.len() > SHOWN {
        parts.push(format!("and {} more", missing.len() - SHOWN));
    }
    parts.join("; ")
}

fn hint(missing: &[LeftOut]) -> String {
    if missing.is_empty() { String::new() } else { format!(" ({})", list(missing)) }
}

/// A result read and scored, or why it cannot be.
enum Outcome {
    Scored(Box<SequenceData>),
    LeftOut(String),
}

/// Scores every tracker on every sequence and puts the averages side by side.
///
/// # Errors
/// When a file is malformed, a result does not fit its truth, or something is missing and
/// `options.partial` is not set.
pub fn compare(
    truth: &TruthSet,
    trackers: &[ResultFolder],
    attributes: &Attributes,
    protocol: Option<Protocol>,
    options: CompareOptions,
) -> Result<ReportData, CompareError> {
    let mut seen = BTreeSet::new();
    for tracker in trackers {
        if !seen.insert(&tracker.name) {
            return Err(CompareError::SameName(tracker.name.clone()));
        }
    }

    let mut left_out: Vec<LeftOut> = truth
        .skipped
        .iter()
        .map(|s| LeftOut { sequence: s.clone(), tracker: None, reason: "no truth".into() })
        .collect();
    let without_truth = left_out.len();
    let mut scored: Vec<BTreeMap<String, SequenceData>> = Vec::with_capacity(trackers.len());
    for tracker in trackers {
        let names = truth.sequences.iter().map(|s| s.name.as_str());
        let prefix = tracker.prefix(names);
        let mut sequences = BTreeMap::new();
        for sequence in &truth.sequences {
            match read_and_score(sequence, tracker, &prefix, options)? {
                Outcome::Scored(data) => {
                    sequences.insert(sequence.name.clone(), *data);
                }
                Outcome::LeftOut(reason) => left_out.push(LeftOut {
                    sequence: sequence.name.clone(),
                    tracker: Some(tracker.name.clone()),
                    reason,
                }),
            }
        }
        scored.push(sequences);
    }
    let missing = left_out.split_off(without_truth);
    if !missing.is_empty() && !options.partial {
        return Err(CompareError::Incomplete(missing));
    }
    let gone: BTreeSet<&str> = missing.iter().map(|m| m.sequence.as_str()).collect();
    for sequences in &mut scored {
        sequences.retain(|name, _| !gone.contains(name.as_str()));
    }
    if scored.iter().any(BTreeMap::is_empty) {
        return Err(CompareError::Nothing { dataset: truth.name.clone(), missing });
    }

    let convention = options.data.convention;
    let data = trackers
        .iter()
        .zip(scored)
        .map(|(t, sequences)| TrackerData::of(&t.name, sequences, attributes, options.data))
        .collect();
    left_out.extend(missing);
    let mut report = ReportData::new(&truth.name, convention, options.data.hold);
    let protocol = protocol.map(|p| p.to_string());
    report.protocols.push(ProtocolData::new(convention, protocol, data, left_out));
    Ok(report)
}

fn read_and_score(
    truth: &SequenceTruth,
    tracker: &ResultFolder,
    prefix: &str,
    options: CompareOptions,
) -> Result<Outcome, CompareError> {
    let files = tracker.files(prefix, &truth.name);
    if files.is_empty() {
        return Ok(Outcome::LeftOut("no result".into()));
    }
    let recorded = tracker.modalities(prefix, &truth.name)?;
    let modalities = recorded.as_deref().or(truth.modalities.as_deref());
    let mut repetitions = Vec::with_capacity(files.len());
    for path in files {
        let rows = boxes::read(&path, options.layout)?;
        if rows.len() == 1 && truth.visible.len() > 1 {
            return Ok(Outcome::LeftOut("the result holds the first box only".into()));
        }
        match SequenceData::of(truth.as_truth(), &rows, modalities, options.data) {
            Ok(data) => repetitions.push(data),
            Err(ScoreError::Length(e)) if e.predicted < e.truth => {
                let reason = format!("{} of {} frames", e.predicted, e.truth);
                return Ok(Outcome::LeftOut(reason));
            }
            Err(source) => {
                return Err(CompareError::Score { line: line_of(&source), path, source });
            }
        }
    }
    Ok(Outcome::Scored(Box::new(SequenceData::merge(repetitions))))
}

/// 1-based line of the result file at which truth and result part.
pub fn line_of(error: &ScoreError) -> Option<usize> {
    match error {
        ScoreError::Length(e) => Some(e.predicted.min(e.truth) + 1),
        _ => None,
    }
}

#[cfg(test)]
#[path = "compare_tests.rs"]
mod tests;
