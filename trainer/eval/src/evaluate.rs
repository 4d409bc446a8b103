//! Running one tracker over a whole dataset, several sequences at a time.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crate::dataset::{Dataset, Sequence};
use crate::metrics::{FirstFrame, Scores};
use crate::protocol::{
    EvalError, Protocol, SequenceResult, TrackerError, TrackerUnderTest, run, start_frame,
};

/// How to evaluate.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Sequences tracked at a time, each with a tracker of its own; 0 counts as 1. Results do not
    /// depend on it; the frame rate does.
    pub threads: usize,
    /// How the first frame enters the figures.
    pub first_frame: FirstFrame,
}

impl Default for Options {
    fn default() -> Self {
        Self { threads: 1, first_frame: FirstFrame::default() }
    }
}

/// Told after every finished target, from the thread that finished it.
#[derive(Clone, Copy, Debug)]
pub struct Progress<'a> {
    /// Targets finished so far.
    pub done: usize,
    /// Targets in all.
    pub total: usize,
    /// What was just finished.
    pub result: &'a SequenceResult,
    /// Its figures.
    pub scores: Scores,
}

/// Results of one tracker under one protocol.
#[derive(Clone, Debug)]
pub struct Evaluation {
    /// The tracker's name.
    pub tracker: String,
    /// The dataset's name.
    pub dataset: String,
    /// The protocol.
    pub protocol: Protocol,
    /// How the first frame entered `scores`.
    pub first_frame: FirstFrame,
    /// Every target, in the order of the dataset.
    pub results: Vec<SequenceResult>,
    /// Figures of `results`.
    pub scores: Vec<Scores>,
    /// Sequences left out: they lack a sensor of the protocol or have no target.
    pub skipped: Vec<String>,
}

/// Where a thread leaves what became of one target.
type Slot = Mutex<Option<Result<(SequenceResult, Scores), EvalError>>>;

/// Runs trackers made by `make_tracker` over every target of the dataset that `protocol` can run
/// on. Each thread makes one tracker and uses it for all its sequences.
///
/// # Errors
/// The first failure in the order of the dataset; the others are stopped. Also when nothing can be
/// run at all.
pub fn evaluate(
    dataset: &Dataset,
    protocol: Protocol,
    make_tracker: &(dyn Fn() -> Result<Box<dyn TrackerUnderTest>, TrackerError> + Sync),
    options: Options,
    progress: &(dyn Fn(Progress<'_>) + Sync),
) -> Result<Evaluation, EvalError> {
    let mut skipped = Vec::new();
    let mut jobs: Vec<(&dyn Sequence, usize)> = Vec::new();
    for sequence in &dataset.sequences {
        let sequence = sequence.as_ref();
        let before = jobs.len();
        if protocol.needs().iter().all(|m| sequence.modalities().contains(m)) {
            let targets = 0..sequence.targets();
            jobs.extend(
                targets
                    .filter(|&t| start_frame(sequence, t, protocol).is_some())
                    .map(|t| (sequence, t)),
            );
        }
        if jobs.len() == before {
            skipped.push(sequence.id().to_owned());
        }
    }
    if jobs.is_empty() {
        return Err(EvalError::Empty { dataset: dataset.name.clone(), protocol });
    }

    let next = AtomicUsize::new(0);
    let done = AtomicUsize::new(0);
    let stop = AtomicBool::new(false);
    let name = Mutex::new(None);
    let slots: Vec<Slot> = jobs.iter().map(|_| Mutex::new(None)).collect();
    let work = || {
        let mut tracker = match make_tracker() {
            Ok(tracker) => tracker,
            Err(e) => {
                stop.store(true, Ordering::Relaxed);
                return Some(EvalError::MakeTracker(e));
            }
        };
        if let Ok(mut name) = name.lock() {
            *name = Some(tracker.name().to_owned());
        }
        while !stop.load(Ordering::Relaxed) {
            let i = next.fetch_add(1, Ordering::Relaxed);
            let Some(&(sequence, target)) = jobs.get(i) else { break };
            let outcome = one(sequence, target, protocol, tracker.as_mut(), options.first_frame);
            match &outcome {
                Ok((result, scores)) => {
                    let done = done.fetch_add(1, Ordering::Relaxed) + 1;
                    progress(Progress { done, total: jobs.len(), result, scores: *scores });
                }
                Err(_) => stop.store(true, Ordering::Relaxed),
            }
            if let Ok(mut slot) = slots[i].lock() {
                *slot = Some(outcome);
            }
        }
        None
    };
    let threads = options.threads.clamp(1, jobs.len());
    let unmade = std::thread::scope(|scope| {
        let others: Vec<_> = (1..threads).map(|_| scope.spawn(work)).collect();
        let mut unmade = work();
        for other in others {
            match other.join() {
                Ok(e) => unmade = unmade.take().or(e),
                // A panic in a tracker is a bug there: let it come through with its message.
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        unmade
    });
    if let Some(e) = unmade {
        return Err(e);
    }

    let mut results = Vec::with_capacity(jobs.len());
    let mut scores = Vec::with_capacity(jobs.len());
    for slot in slots {
        // A slot stays empty only behind a failure, which stands in an earlier one or is met later.
        if let Some(outcome) = slot.into_inner().unwrap_or_else(|p| p.into_inner()) {
            let (result, score) = outcome?;
            results.push(result);
            scores.push(score);
        }
    }
    let tracker = name.into_inner().unwrap_or_else(|p| p.into_inner()).unwrap_or_default();
    Ok(Evaluation {
        tracker,
        dataset: dataset.name.clone(),
        protocol,
        first_frame: options.first_frame,
        results,
        scores,
        skipped,
    })
}

fn one(
    sequence: &dyn Sequence,
    target: usize,
    protocol: Protocol,
    tracker: &mut dyn TrackerUnderTest,
    first: FirstFrame,
) -> Result<(SequenceResult, Scores), EvalError> {
    let result = run(sequence, target, protocol, tracker)?;
    match result.scores(first) {
        Ok(scores) => Ok((result, scores)),
        Err(source) => Err(EvalError::Length { sequence: result.sequence, source }),
    }
}
