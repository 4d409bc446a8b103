//! What `tsda eval` writes about a whole run: several trackers, several protocols, one dataset.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::attributes::Attributes;
use crate::dataset::{Dataset, Severity};
use crate::evaluate::{Evaluation, Failure};
use crate::metrics::Convention;
use crate::report_data::{
    DataOptions, EvaluationScoreError, LeftOut, ProtocolData, ReportData, TrackerData,
};
use crate::summary::{Summary, SummaryError};
use crate::truth::TruthSet;

/// Version of [`RunSummary`]; raised when a reader of the old one would go wrong.
pub const RUN_SUMMARY_VERSION: u32 = 1;

/// `summary.json`: figures of the tracker evaluated, directly, and of the baselines beside it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunSummary {
    /// [`RUN_SUMMARY_VERSION`] of the writer.
    pub version: u32,
    /// Tracker, dataset and protocols.
    #[serde(flatten)]
    pub main: Summary,
    /// [Fingerprint](crate::fingerprint) of the bundle.
    pub bundle: String,
    /// The engine and its options.
    pub engine: String,
    /// What the tracker was told beside that, such as the scan for a lost target.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub settings: String,
    /// Fingerprint of the dataset.
    pub dataset_hash: String,
    /// Sequences tracked at a time in the last run; frame rates depend on it.
    pub jobs: usize,
    /// Sequences that failed, under any protocol and of any tracker, and those that could not be
    /// opened.
    pub failures: usize,
    /// Sequences that could not be opened.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub broken: Vec<Failure>,
    /// What is wrong with files of sequences that could be used all the same.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// Other trackers.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub baselines: Vec<Summary>,
}

/// What is the same for all of a run.
#[derive(Clone, Debug, Default)]
pub struct RunContext {
    /// Fingerprint of the bundle.
    pub bundle: String,
    /// The engine and its options.
    pub engine: String,
    /// What the tracker was told beside that.
    pub settings: String,
    /// Fingerprint of the dataset.
    pub dataset_hash: String,
    /// Sequences tracked at a time.
    pub jobs: usize,
    /// Sequences that could not be opened.
    pub broken: Vec<Failure>,
}

/// A run that cannot be summed up.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunSummaryError {
    /// Evaluations that do not go together.
    #[error(transparent)]
    Summary(#[from] SummaryError),
    /// A result that does not fit its truth.
    #[error(transparent)]
    Score(#[from] EvaluationScoreError),
}

/// Rules of the benchmark that a dataset (`KIND[/option..]:PATH`) is of; our own for others.
pub fn convention_of(dataset: &str) -> Convention {
    let kind = dataset.split([':', '/']).next().unwrap_or_default();
    kind.parse().unwrap_or_default()
}

/// Files named by `(tracker, protocol, label)`, relative to the report.
pub type RecordOf<'a> = dyn Fn(&str, &str, &str) -> Option<String> + 'a;

/// Sums up what trackers did: one list per tracker, the one evaluated first, each with one
/// evaluation per protocol in the same order.
///
/// All averages under a protocol run over the same targets: what failed for one tracker is left out
/// for all.
///
/// # Errors
/// When there is nothing, lists do not go together, or a result does not fit its truth.
pub fn sum_up(
    dataset: &Dataset,
    mut trackers: Vec<Vec<Evaluation>>,
    options: DataOptions,
    context: RunContext,
    record: &RecordOf<'_>,
) -> Result<(RunSummary, ReportData), RunSummaryError> {
    let attributes = Attributes::of_dataset(dataset);
    let convention = options.convention;
    let mut report = ReportData::new(&dataset.name, convention, options.hold);
    let mut figures: Vec<BTreeMap<String, TrackerData>> = vec![BTreeMap::new(); trackers.len()];
    let mut gone: BTreeMap<String, Vec<LeftOut>> = BTreeMap::new();
    for i in 0..trackers.first().map_or(0, Vec::len) {
        let mut left_out = Vec::new();
        let mut labels = BTreeSet::new();
        for failure in trackers
            .iter()
            .filter_map(|t| t.get(i))
            .flat_map(|e| e.failed.iter().map(|f| (e.tracker.clone(), f)))
        {
            let (tracker, f) = failure;
            labels.insert(f.sequence.clone());
            left_out.push(LeftOut {
                sequence: f.sequence.clone(),
                tracker: Some(tracker),
                reason: f.reason.clone(),
            });
        }
        for evaluation in trackers.iter_mut().filter_map(|t| t.get_mut(i)) {
            evaluation.leave_out(&labels);
        }
        let Some(protocol) = trackers.first().and_then(|t| t.get(i)).map(|e| e.protocol) else {
            continue;
        };
        let name = protocol.to_string();
        gone.insert(name.clone(), left_out.clone());
        let truth = TruthSet::of_dataset(dataset, convention, Some(protocol));
        let mut data = Vec::new();
        for (n, evaluation) in trackers.iter().enumerate() {
            let Some(evaluation) = evaluation.get(i) else { continue };
            let record = |label: &str| record(&evaluation.tracker, &name, label);
            let (tracker, without) =
                TrackerData::of_run(evaluation, &truth, &attributes, options, &record)?;
            if n == 0 {
                left_out.extend(evaluation.skipped.iter().map(|s| LeftOut {
                    sequence: s.sequence.clone(),
                    tracker: None,
                    reason: s.reason.clone(),
                }));
                left_out.extend(without);
            }
            figures[n].insert(name.clone(), tracker.clone());
            data.push(tracker);
        }
        report.protocols.push(ProtocolData::new(convention, Some(name), data, left_out));
    }

    let mut summaries = Vec::new();
    for (evaluations, figures) in trackers.iter().zip(&figures) {
        let mut summary = Summary::of(evaluations)?;
        for (protocol, data) in figures {
            if let Some(p) = summary.protocols.get_mut(protocol) {
                p.add(data, convention);
                // What failed for another tracker is in none of these averages either.
                let others = gone.get(protocol).into_iter().flatten();
                let others = others.filter(|l| l.tracker.as_ref() != Some(&summary.tracker));
                p.left_out.extend(others.cloned());
            }
        }
        summaries.push(summary);
    }
    let failed = trackers.iter().flatten().map(|e| e.failed.len()).sum::<usize>();
    let mut summaries = summaries.into_iter();
    let main = summaries.next().ok_or(SummaryError::Empty)?;
    let summary = RunSummary {
        version: RUN_SUMMARY_VERSION,
        main,
        bundle: context.bundle,
        engine: context.engine,
        settings: context.settings,
        dataset_hash: context.dataset_hash,
        jobs: context.jobs,
        failures: failed + context.broken.len(),
        broken: context.broken,
        warnings: warnings(dataset),
        baselines: summaries.collect(),
    };
    Ok((summary, report))
}

/// What loaders found broken in sequences that can be used all the same.
fn warnings(dataset: &Dataset) -> Vec<String> {
    let notes = dataset.sequences.iter().flat_map(|s| s.notes().iter().map(move |n| (s.id(), n)));
    notes
        .filter(|(_, n)| n.severity == Severity::Broken)
        .map(|(id, n)| format!("sequence {id}: {n}"))
        .collect()
}

impl RunSummary {
    /// All trackers, the one evaluated first.
    pub fn summaries(&self) -> Vec<Summary> {
        [&self.main].into_iter().chain(&self.baselines).cloned().collect()
    }

    /// Did any target come to its end, of the tracker evaluated?
    pub fn any_result(&self) -> bool {
        self.main.protocols.values().any(|p| !p.targets.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn conventions_by_kind() {
        for (dataset, want) in [
            ("lasher:data/LasHeR@test", Convention::Lasher),
            ("gtot:x", Convention::Gtot),
            ("otb/thermal:x", Convention::Otb),
            ("got10k:x", Convention::Got10k),
            ("pseudo:x/lasher", Convention::Tsda),
            ("vtuav/interpolated:x", Convention::Tsda),
        ] {
            assert_eq!(convention_of(dataset), want, "{dataset}");
        }
    }
}
