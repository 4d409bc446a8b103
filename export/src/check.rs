//! Do the engines compute what the trainer's network computed?

use std::time::Instant;
use tsda_runtime::bundle::{Bundle, BundleError, SectionKind};
use tsda_runtime::engine::tract::TractEngine;
use tsda_runtime::probe::{self, Probe, ProbeError};
use tsda_runtime::{Engine, EngineError};

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
    /// An engine cannot load the bundle.
    #[error(transparent)]
    Engine(#[from] EngineError),
}

/// Largest absolute difference of one output of one engine.
#[derive(Clone, Debug, PartialEq)]
pub struct Difference {
    /// Name of the engine.
    pub engine: &'static str,
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
    pub engine: &'static str,
    /// The graph.
    pub graph: String,
    /// Milliseconds.
    pub ms: f64,
}

/// What [`check`] found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CheckReport {
    /// Per engine, graph and tensor.
    pub differences: Vec<Difference>,
    /// Per engine and graph.
    pub timings: Vec<Timing>,
}

impl CheckReport {
    /// Largest difference of all.
    pub fn max(&self) -> f32 {
        self.differences.iter().fold(0.0, |max, d| max.max(d.max))
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
        Ok(())
    }
}

/// Runs every engine compiled in over the stored probe. The probe's expected outputs are those of
/// the trainer's own network, computed when the bundle was built.
///
/// # Errors
/// When the bundle has no probe, or an engine cannot load or run it. Large differences are no
/// error: the report tells.
pub fn check(bundle: &Bundle<'_>) -> Result<CheckReport, CheckError> {
    let probe = Probe::parse(bundle.require(SectionKind::Probe)?, &bundle.manifest().spec)?;
    let mut report = CheckReport::default();
    run(&mut TractEngine::from_bundle(bundle)?, &probe, &mut report)?;
    #[cfg(feature = "ort")]
    run(&mut tsda_runtime::engine::ort::OrtEngine::from_bundle(bundle)?, &probe, &mut report)?;
    Ok(report)
}

fn run<E: Engine>(
    engine: &mut E,
    probe: &Probe<'_>,
    report: &mut CheckReport,
) -> Result<(), CheckError> {
    let name = engine.name();
    for diff in probe::run(engine, probe)?.diffs {
        for (tensor, max) in [("scores", diff.scores), ("ltrb", diff.ltrb)] {
            let graph = format!("predict{}", diff.templates);
            report.differences.push(Difference { engine: name, graph, tensor, max });
        }
    }
    // The probe left crop, label and all slots filled.
    let mut time = |graph: String, call: &mut dyn FnMut() -> Result<(), EngineError>| {
        let mut best = f64::INFINITY;
        for _ in 0..5 {
            let start = Instant::now();
            call()?;
            best = best.min(start.elapsed().as_secs_f64() * 1e3);
        }
        report.timings.push(Timing { engine: name, graph, ms: best });
        Ok::<(), EngineError>(())
    };
    time("features".into(), &mut || engine.features())?;
    time("template".into(), &mut || engine.write_template(0))?;
    for filled in 1..=probe.templates() {
        time(format!("predict{filled}"), &mut || engine.predict(filled).map(|_| ()))?;
    }
    Ok(())
}
