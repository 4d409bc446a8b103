//! The parent of the workers: starts one per engine and number of threads, and lets them take turns.

use super::report::{Figures, Report, Row};
use super::{Answer, Loaded, Round, crops};
use crate::error::HostError;
use crate::model;
use std::io::{BufRead, BufReader, Lines, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use tsda_runtime::engine::EngineChoice;

/// Rounds that the frames are divided into.
const ROUNDS: usize = 10;

/// What to measure.
#[derive(Debug)]
pub struct Plan<'a> {
    /// Bundle; without it, the embedded one.
    pub bundle: Option<&'a Path>,
    /// Engines.
    pub engines: &'a [EngineChoice],
    /// Numbers of threads, each with every engine.
    pub threads: &'a [usize],
    /// Frames per engine.
    pub frames: usize,
    /// Set from outside to stop.
    pub stop: &'a AtomicBool,
}

/// A worker process; ended when dropped.
struct Worker {
    name: String,
    child: Child,
    requests: Option<ChildStdin>,
    answers: Lines<BufReader<ChildStdout>>,
}

impl Worker {
    fn start(name: String, program: &Path, bundle: Option<&Path>) -> Result<Self, HostError> {
        let mut command = Command::new(program);
        command.args(["bench", "--worker", &name]);
        if let Some(path) = bundle {
            command.arg("--bundle").arg(path);
        }
        let failed = |reason: String| HostError::Bench { engine: name.clone(), reason };
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|e| failed(format!("{} cannot be started: {e}", program.display())))?;
        let (Some(requests), Some(answers)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(failed("its process has no pipes".into()));
        };
        let answers = BufReader::new(answers).lines();
        Ok(Self { name, child, requests: Some(requests), answers })
    }

    fn failed(&self, reason: impl core::fmt::Display) -> HostError {
        HostError::Bench { engine: self.name.clone(), reason: reason.to_string() }
    }

    fn answer(&mut self) -> Result<Answer, HostError> {
        match self.answers.next() {
            Some(Ok(line)) => serde_json::from_str(&line).map_err(|e| self.failed(e)),
            Some(Err(e)) => Err(self.failed(e)),
            None => {
                let ended = self.child.wait().map_err(|e| self.failed(e))?;
                Err(self.failed(format_args!("its process ended early: {ended}")))
            }
        }
    }

    fn round(&mut self, frames: usize) -> Result<Round, HostError> {
        if let Some(requests) = &mut self.requests {
            // A worker that is gone says why when its answer is read.
            let _ = writeln!(requests, "{frames}").and_then(|()| requests.flush());
        }
        match self.answer()? {
            Answer::Round(round) if round.frames.len() == frames => Ok(round),
            other => Err(self.failed(format_args!("it answered {other:?} to a round"))),
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        // End of input lets it leave by itself; one that hangs or is in a frame is ended.
        self.requests = None;
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Measures; `progress` hears of every round.
///
/// # Errors
/// When a bundle cannot be used, a worker fails in a frame, or the run was interrupted. Engines that
/// are not there are rows of the report.
pub fn run(plan: &Plan<'_>, mut progress: impl FnMut(usize, usize)) -> Result<Report, HostError> {
    let program: PathBuf = std::env::current_exe().map_err(|e| HostError::Bench {
        engine: "all".into(),
        reason: format!("this program does not know where it lies: {e}"),
    })?;
    // Verified here already, so that a bad bundle is one message and not one per engine.
    let (bundle, crops) = {
        let file = model::load(plan.bundle)?;
        let manifest = file.bundle()?.manifest().spec;
        (file.path().display().to_string(), crops::measure(&manifest)?)
    };
    let mut rows = Vec::new();
    let mut running: Vec<(usize, Worker, Loaded, Vec<Round>)> = Vec::new();
    for engine in plan.engines {
        for &threads in plan.threads {
            let mut row =
                Row { engine: engine.to_string(), threads, unavailable: None, figures: None };
            match engine.clone().with_threads(threads) {
                Err(e) => row.unavailable = Some(e.to_string()),
                Ok(choice) => {
                    let mut worker = Worker::start(choice.to_string(), &program, plan.bundle)?;
                    match worker.answer()? {
                        Answer::Unavailable(reason) => row.unavailable = Some(reason),
                        Answer::Loaded(loaded) => {
                            running.push((rows.len(), worker, loaded, Vec::new()));
                        }
                        other @ Answer::Round(_) => {
                            return Err(worker.failed(format_args!("it began with {other:?}")));
                        }
                    }
                }
            }
            rows.push(row);
        }
    }
    let rounds = ROUNDS.min(plan.frames);
    for round in 0..rounds {
        let frames = plan.frames * (round + 1) / rounds - plan.frames * round / rounds;
        for (_, worker, _, done) in &mut running {
            if plan.stop.load(Ordering::Relaxed) {
                return Err(HostError::Interrupted);
            }
            done.push(worker.round(frames)?);
        }
        progress(round + 1, rounds);
    }
    for (index, _, loaded, done) in &running {
        rows[*index].figures = Some(Figures::new(loaded, done));
    }
    let mut report = Report {
        bundle,
        cpu: processor(),
        cores: std::thread::available_parallelism().map_or(1, usize::from),
        isa: Some(tsda_runtime::engine::native::Isa::best().name()),
        debug_build: cfg!(debug_assertions),
        frames: plan.frames,
        engines: rows,
        crops,
    };
    report.compare();
    Ok(report)
}

/// Model of the processor, as the system names it.
fn processor() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let line = info.lines().find(|l| l.starts_with("model name") || l.starts_with("Model"));
    let name = line.and_then(|l| l.split_once(':')).map_or("", |(_, name)| name.trim());
    if name.is_empty() { std::env::consts::ARCH.into() } else { name.into() }
}
