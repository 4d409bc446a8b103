//! Running one tracker over a whole dataset, several sequences at a time.
//!
//! [`evaluate()`] keeps everything in memory and gives up at the first failure. [`evaluate_all`]
//! goes on past failures, lists them, keeps finished sequences in a [`ResultStore`] and takes up
//! those of an earlier run.

use std::any::Any;
use std::ops::ControlFlow;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use serde::{Deserialize, Serialize};

use crate::dataset::{Dataset, DatasetError, Sequence};
use crate::metrics::{FirstFrame, Scores};
use crate::protocol::{
    EvalError, Protocol, SequenceResult, TrackerError, TrackerUnderTest, label, run_watched,
    start_frame,
};
use crate::store::ResultStore;

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

/// Looks on while [`evaluate_all`] works; called from several threads.
pub trait Observer: Sync {
    /// Before anything is tracked: targets and frames in all, and how many of them are there from
    /// an earlier run.
    fn planned(&self, _all: Extent, _kept: Extent) {}
    /// After every frame.
    fn frame(&self) {}
    /// After every finished target, those of an earlier run left out.
    fn finished(&self, _progress: Progress<'_>) {}
    /// After every target that failed.
    fn failed(&self, _failure: &Failure) {}
    /// Asked after every frame: is the work to end?
    fn stop(&self) -> bool {
        false
    }
}

/// An amount of work.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Extent {
    /// Targets.
    pub targets: usize,
    /// Frames.
    pub frames: usize,
}

/// A target that could not be tracked to its end.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// The sequence, or `sequence#target`; empty when it could not even be opened.
    pub sequence: String,
    /// Frame of the sequence, 0-based, where one can be named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<usize>,
    /// File at fault.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub path: Option<PathBuf>,
    /// 1-based line of that file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub line: Option<usize>,
    /// The whole message.
    pub reason: String,
}

impl Failure {
    fn of(label: String, error: &EvalError) -> Self {
        let failure = match error {
            EvalError::Frame { frame, source, .. } => {
                Self { frame: Some(*frame), ..Self::of_dataset(source) }
            }
            EvalError::Tracker { frame, .. } => Self { frame: Some(*frame), ..Self::default() },
            _ => Self::default(),
        };
        Self { sequence: label, reason: error.to_string(), ..failure }
    }

    /// Of a sequence that could not be opened.
    pub fn of_dataset(error: &DatasetError) -> Self {
        let (path, line) = match error {
            DatasetError::Io { path, .. } | DatasetError::Picture { path, .. } => {
                (Some(path), None)
            }
            DatasetError::Format { path, line, .. } => (Some(path), *line),
            _ => (None, None),
        };
        Self { path: path.cloned(), line, reason: error.to_string(), ..Self::default() }
    }
}

/// A sequence or target that a protocol cannot run on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Skipped {
    /// The sequence, or `sequence#target`.
    pub sequence: String,
    /// Why.
    pub reason: String,
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
    /// Left out: they lack a sensor of the protocol or have no target.
    pub skipped: Vec<Skipped>,
    /// Tried and failed, in the order of the dataset.
    pub failed: Vec<Failure>,
}

impl Evaluation {
    /// Takes the targets with these [labels](SequenceResult::label) out of results and scores.
    pub fn leave_out(&mut self, labels: &std::collections::BTreeSet<String>) {
        let keep: Vec<bool> = self.results.iter().map(|r| !labels.contains(&r.label())).collect();
        let mut flags = keep.iter();
        self.results.retain(|_| flags.next().copied().unwrap_or(true));
        let mut flags = keep.iter();
        self.scores.retain(|_| flags.next().copied().unwrap_or(true));
    }
}

/// One target to track.
struct Job<'a> {
    sequence: &'a dyn Sequence,
    target: usize,
    frames: usize,
}

/// What `protocol` can run on, in the order of the dataset, and what it cannot.
fn jobs(dataset: &Dataset, protocol: Protocol) -> (Vec<Job<'_>>, Vec<Skipped>) {
    let (mut jobs, mut skipped) = (Vec::new(), Vec::new());
    for sequence in &dataset.sequences {
        let sequence = sequence.as_ref();
        let mut skip = |sequence: String, reason| skipped.push(Skipped { sequence, reason });
        let lacks = protocol.needs().iter().find(|m| !sequence.modalities().contains(m));
        if let Some(modality) = lacks {
            skip(sequence.id().to_owned(), format!("no {modality} frames"));
        } else if sequence.frames() == 0 {
            skip(sequence.id().to_owned(), "no frames".into());
        } else if sequence.targets() == 0 {
            skip(sequence.id().to_owned(), "no boxes".into());
        } else {
            for target in 0..sequence.targets() {
                match start_frame(sequence, target, protocol) {
                    Some(start) => {
                        let frames = sequence.frames() - start;
                        jobs.push(Job { sequence, target, frames });
                    }
                    None => {
                        let reason = format!("no {} box to start from", protocol.modality(0));
                        skip(label(sequence.id(), target), reason);
                    }
                }
            }
        }
    }
    (jobs, skipped)
}

/// Is there anything in the dataset that `protocol` can run on?
pub fn can_run(dataset: &Dataset, protocol: Protocol) -> bool {
    !jobs(dataset, protocol).0.is_empty()
}

/// A sentence for people when `protocol` switches between the sensors, but no run of it is long
/// enough to come back to RGB: its figures are those of `rgb2t` then.
pub fn never_switches(dataset: &Dataset, protocol: Protocol) -> Option<String> {
    let Protocol::Switch { every } = protocol else { return None };
    let longest = jobs(dataset, protocol).0.iter().map(|j| j.frames).max()?;
    // Frame 0 is RGB, 1 to `every` thermal, the next one RGB again.
    (longest <= every.saturating_add(1)).then(|| {
        format!(
            "{protocol}: the longest sequence has {longest} frames, so the sensor never changes back \
             and the figures are those of rgb2t; a smaller N, such as switch:{}, does change",
            (longest / 3).max(1)
        )
    })
}

/// Makes a tracker for one thread.
pub type MakeTracker<'a> = dyn Fn() -> Result<Box<dyn TrackerUnderTest>, TrackerError> + Sync + 'a;

/// Runs trackers made by `make_tracker` over every target of the dataset that `protocol` can run
/// on. Each thread makes one tracker and uses it for all its sequences.
///
/// # Errors
/// The first failure in the order of the dataset; the others are stopped. Also when nothing can be
/// run at all.
pub fn evaluate(
    dataset: &Dataset,
    protocol: Protocol,
    make_tracker: &MakeTracker<'_>,
    options: Options,
    progress: &(dyn Fn(Progress<'_>) + Sync),
) -> Result<Evaluation, EvalError> {
    struct Tell<'a>(&'a (dyn Fn(Progress<'_>) + Sync), AtomicBool);
    impl Observer for Tell<'_> {
        fn finished(&self, progress: Progress<'_>) {
            (self.0)(progress);
        }
        fn failed(&self, _: &Failure) {
            self.1.store(true, Ordering::Relaxed);
        }
        fn stop(&self) -> bool {
            self.1.load(Ordering::Relaxed)
        }
    }
    let observer = Tell(progress, AtomicBool::new(false));
    let outcome = work(dataset, protocol, make_tracker, options, None, &observer)?;
    match outcome.first_error {
        Some(e) => Err(e),
        None => Ok(outcome.evaluation),
    }
}

/// As [`evaluate()`], but a target that fails is listed and the others go on; finished ones are
/// kept in `store`, and those that are in it already are not tracked again.
///
/// # Errors
/// When nothing can be run at all, no tracker can be made, a result cannot be kept, or the
/// observer asked to stop. What is finished by then stays in the store.
pub fn evaluate_all(
    dataset: &Dataset,
    protocol: Protocol,
    make_tracker: &MakeTracker<'_>,
    options: Options,
    store: Option<&ResultStore>,
    observer: &dyn Observer,
) -> Result<Evaluation, EvalError> {
    let outcome = work(dataset, protocol, make_tracker, options, store, observer)?;
    if outcome.finished < outcome.total && observer.stop() {
        let (finished, total) = (outcome.evaluation.results.len(), outcome.total);
        return Err(EvalError::Interrupted { protocol, finished, total });
    }
    Ok(outcome.evaluation)
}

struct Outcome {
    evaluation: Evaluation,
    /// Targets that came to an end, be it a failure.
    finished: usize,
    total: usize,
    first_error: Option<EvalError>,
}

/// Where a thread leaves what became of one target.
type Slot = Mutex<Option<Result<(SequenceResult, Scores), EvalError>>>;

fn work(
    dataset: &Dataset,
    protocol: Protocol,
    make_tracker: &MakeTracker<'_>,
    options: Options,
    store: Option<&ResultStore>,
    observer: &dyn Observer,
) -> Result<Outcome, EvalError> {
    let (jobs, skipped) = jobs(dataset, protocol);
    if jobs.is_empty() {
        return Err(EvalError::Empty { dataset: dataset.name.clone(), protocol });
    }
    let total = jobs.len();
    let slots: Vec<Slot> = jobs.iter().map(|_| Mutex::new(None)).collect();
    let mut open = Vec::with_capacity(total);
    let mut kept = Extent::default();
    for (i, job) in jobs.iter().enumerate() {
        match store.and_then(|s| s.load(job.sequence, job.target, protocol)) {
            Some(result) => {
                kept.targets += 1;
                kept.frames += job.frames;
                put(&slots[i], scored(result, options.first_frame));
            }
            None => open.push(i),
        }
    }
    let frames = jobs.iter().map(|j| j.frames).sum();
    observer.planned(Extent { targets: total, frames }, kept);

    let next = AtomicUsize::new(0);
    let done = AtomicUsize::new(kept.targets);
    // Something none of the threads can get past.
    let fatal: Mutex<Option<EvalError>> = Mutex::new(None);
    let dead = AtomicBool::new(false);
    let give_up = |e: EvalError| {
        dead.store(true, Ordering::Relaxed);
        fatal.lock().unwrap_or_else(|p| p.into_inner()).get_or_insert(e);
    };
    let name = Mutex::new(store.map(|s| s.manifest().tracker.clone()));
    let stopped = || dead.load(Ordering::Relaxed) || observer.stop();
    let worker = || {
        let mut spare: Option<Box<dyn TrackerUnderTest>> = None;
        while !stopped() {
            let Some(&i) = open.get(next.fetch_add(1, Ordering::Relaxed)) else { break };
            let mut tracker = match spare.take().map_or_else(make_tracker, Ok) {
                Ok(tracker) => tracker,
                Err(e) => return give_up(EvalError::MakeTracker(e)),
            };
            name.lock()
                .unwrap_or_else(|p| p.into_inner())
                .get_or_insert_with(|| tracker.name().to_owned());
            let watch = || {
                observer.frame();
                if stopped() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
            };
            let job = &jobs[i];
            // The tracker is thrown away after a panic, and nothing else is half changed by one.
            let run = catch_unwind(AssertUnwindSafe(|| {
                run_watched(job.sequence, job.target, protocol, tracker.as_mut(), watch)
            }));
            let outcome = match run {
                Ok(Ok(Some(result))) => {
                    spare = Some(tracker);
                    scored(result, options.first_frame)
                }
                Ok(Ok(None)) => return,
                Ok(Err(e)) => {
                    spare = Some(tracker);
                    Err(e)
                }
                Err(panic) => Err(EvalError::Panicked {
                    sequence: job.sequence.id().to_owned(),
                    message: panic_message(panic.as_ref()),
                }),
            };
            match &outcome {
                Ok((result, scores)) => {
                    if let Some(Err(e)) = store.map(|s| s.save(result)) {
                        return give_up(e.into());
                    }
                    let done = done.fetch_add(1, Ordering::Relaxed) + 1;
                    observer.finished(Progress { done, total, result, scores: *scores });
                }
                Err(e) => {
                    observer.failed(&Failure::of(label(job.sequence.id(), job.target), e));
                }
            }
            put(&slots[i], outcome);
        }
    };
    std::thread::scope(|scope| {
        let threads = options.threads.clamp(1, open.len().max(1));
        let others: Vec<_> = (1..threads).map(|_| scope.spawn(worker)).collect();
        worker();
        for other in others {
            if let Err(panic) = other.join() {
                // Only an observer's own panic gets here.
                std::panic::resume_unwind(panic);
            }
        }
    });
    if let Some(e) = fatal.into_inner().unwrap_or_else(|p| p.into_inner()) {
        return Err(e);
    }

    let mut evaluation = Evaluation {
        tracker: name.into_inner().unwrap_or_else(|p| p.into_inner()).unwrap_or_default(),
        dataset: dataset.name.clone(),
        protocol,
        first_frame: options.first_frame,
        results: Vec::with_capacity(total),
        scores: Vec::with_capacity(total),
        skipped,
        failed: Vec::new(),
    };
    let mut first_error = None;
    for (slot, job) in slots.into_iter().zip(&jobs) {
        match slot.into_inner().unwrap_or_else(|p| p.into_inner()) {
            Some(Ok((result, scores))) => {
                evaluation.results.push(result);
                evaluation.scores.push(scores);
            }
            Some(Err(e)) => {
                let label = label(job.sequence.id(), job.target);
                evaluation.failed.push(Failure::of(label, &e));
                first_error.get_or_insert(e);
            }
            // Stopped before its turn.
            None => {}
        }
    }
    let finished = evaluation.results.len() + evaluation.failed.len();
    Ok(Outcome { evaluation, finished, total, first_error })
}

fn put(slot: &Slot, outcome: Result<(SequenceResult, Scores), EvalError>) {
    *slot.lock().unwrap_or_else(|p| p.into_inner()) = Some(outcome);
}

fn scored(
    result: SequenceResult,
    first: FirstFrame,
) -> Result<(SequenceResult, Scores), EvalError> {
    match result.scores(first) {
        Ok(scores) => Ok((result, scores)),
        Err(source) => Err(EvalError::Length { sequence: result.sequence, source }),
    }
}

fn panic_message(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    let text = text.or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("without a message").to_owned()
}

#[cfg(test)]
#[path = "evaluate_tests.rs"]
mod tests;
