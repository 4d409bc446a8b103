//! Do the engines compute what the trainer's network computed?

use tsda_runtime::bundle::{Bundle, BundleError, SectionKind};
use tsda_runtime::engine::EngineChoice;
use tsda_runtime::engine::any::OpenError;
use tsda_runtime::probe::{self, Probe, ProbeError, stage_times};
use tsda_runtime::{Engine, EngineError};

/// Calls of each graph that are timed.
const REPETITIONS: usize = 10;

/// A bundle that could not be checked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckError {
    /// The bundle lacks a section.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// The stored outputs cannot be used, or an engine failed on them.
    #[error(transparent)]
    Probe(#[from] ProbeError),
    /// An engine is missing or cannot load the bundle.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// An engine failed while it was timed.
    #[error(transparent)]
    Engine(#[from] EngineError),
}

/// Largest absolute difference of one output of one engine.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Name of the engine.
    pub engine: String,
    /// `predict1` and so on.
    pub graph: String,
    /// `scores` or `ltrb`.
    pub tensor: &'static str,
    /// Over all cells; infinite where an engine computed no number.
    pub max: f32,
}

/// How long one call takes, in milliseconds; the best of a few.
#[derive(Clone, Debug, PartialEq)]
pub struct Timing {
    /// Name of the engine.
    pub engine: String,
    /// The graph.
    pub graph: String,
    /// Milliseconds.
    pub ms: f64,
}

/// An engine that was not checked.
#[derive(Debug)]
pub struct Unchecked {
    /// Name of the engine.
    pub engine: String,
    /// Why.
    pub error: CheckError,
    /// The engine is not on this machine and nobody asked for it: no failure.
    pub unasked: bool,
}

/// What [`check`] found.
#[derive(Debug, Default)]
pub struct CheckReport {
    /// Per engine, graph and tensor.
    pub differences: Vec<Difference>,
    /// Per engine and graph.
    pub timings: Vec<Timing>,
    /// Engines without figures.
    pub unchecked: Vec<Unchecked>,
}

impl CheckReport {
    /// Largest difference of all; infinite when an engine failed or none was checked.
    pub fn max(&self) -> f32 {
        if self.failure().is_some() || self.differences.is_empty() {
            return f32::INFINITY;
        }
        self.differences.iter().fold(0.0, |max, d| max.max(d.max))
    }

    /// The first engine that should have been checked and was not.
    pub fn failure(&self) -> Option<&Unchecked> {
        self.unchecked.iter().find(|u| !u.unasked)
    }
}

impl std::fmt::Display for CheckReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "{:<8} {:<10} {:<8} {:>14}", "engine", "graph", "tensor", "max abs diff")?;
        for Difference { engine, graph, tensor, max } in &self.differences {
            writeln!(f, "{engine:<8} {graph:<10} {tensor:<8} {max:>14.3e}")?;
        }
        writeln!(f)?;
        writeln!(f, "{:<8} {:<10} {:>12}", "engine", "graph", "ms per call")?;
        for Timing { engine, graph, ms } in &self.timings {
            writeln!(f, "{engine:<8} {graph:<10} {ms:>12.2}")?;
        }
        for Unchecked { engine, error, unasked } in &self.unchecked {
            writeln!(
                f,
                "{engine:<8} {}: {error}",
                if *unasked { "not checked" } else { "FAILED" }
            )?;
        }
        Ok(())
    }
}

/// Runs every engine compiled in over the stored probe. The probe's expected outputs are those of
/// the trainer's own network, computed when the bundle was built. ONNX Runtime is left out, with a
/// remark in the report, where there is no library and no variable names one.
///
/// # Errors
/// When the bundle has no probe. Engines that fail and large differences are no error: the report
/// tells.
pub fn check(bundle: &Bundle<'_>) -> Result<CheckReport, CheckError> {
    check_on(bundle, None)
}

/// As [`check`], on one engine only. That engine has to be there.
///
/// # Errors
/// As [`check`].
pub fn check_on(
    bundle: &Bundle<'_>,
    only: Option<&EngineChoice>,
) -> Result<CheckReport, CheckError> {
    let probe = Probe::parse(bundle.require(SectionKind::Probe)?, &bundle.manifest().spec)?;
    let mut report = CheckReport::default();
    let choices = only.map_or_else(EngineChoice::compiled, |choice| vec![choice.clone()]);
    for choice in choices {
        if let Err(error) = run(&choice, bundle, &probe, &mut report) {
            let absent = matches!(&error, CheckError::Open(e) if e.is_unasked());
            let unasked = absent && only.is_none();
            report.unchecked.push(Unchecked { engine: choice.to_string(), error, unasked });
        }
    }
    Ok(report)
}

fn run(
    choice: &EngineChoice,
    bundle: &Bundle<'_>,
    probe: &Probe<'_>,
    report: &mut CheckReport,
) -> Result<(), CheckError> {
    let mut engine = choice.open(bundle)?;
    let name = engine.name();
    for diff in probe::run(&mut engine, probe)?.diffs {
        for (tensor, max) in [("scores", diff.scores), ("ltrb", diff.ltrb)] {
            let graph = format!("predict{}", diff.templates);
            report.differences.push(Difference { engine: name.into(), graph, tensor, max });
        }
    }
    for time in stage_times(&mut engine, REPETITIONS)? {
        let (graph, ms) = (time.graph, time.best_ms);
        report.timings.push(Timing { engine: name.into(), graph, ms });
    }
    Ok(())
}
