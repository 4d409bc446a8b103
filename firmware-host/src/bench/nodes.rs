//! What every step of the native engine's graphs takes by itself.

use crate::error::HostError;
use crate::model;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use tsda_runtime::Engine as _;
use tsda_runtime::engine::{AnyEngine, EngineChoice};
use tsda_runtime::probe::crop_input;

/// One step.
#[derive(Clone, Debug, Serialize)]
pub struct Step {
    /// Graph of the bundle.
    pub graph: String,
    /// Kind of kernel.
    pub kind: &'static str,
    /// Node of the graph, the first one where several are joined.
    pub node: String,
    /// Floating-point operations in millions, about.
    pub mega_operations: f64,
    /// Microseconds, the shortest of all runs, by the clock on one thread.
    pub wall_us: f64,
}

/// All steps of a frame with all template slots, and of a memory write.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Name of the bundle's preset.
    pub preset: String,
    /// Instruction set of the kernels.
    pub isa: &'static str,
    /// Runs of which the shortest counts.
    pub runs: usize,
    /// In the order they run, graph by graph.
    pub steps: Vec<Step>,
}

/// Measures a bundle; without a path, the embedded one.
///
/// # Errors
/// When the bundle cannot be loaded, or the engine is not the native one.
pub fn measure(
    bundle: Option<&Path>,
    choice: &EngineChoice,
    runs: usize,
) -> Result<Report, HostError> {
    let file = model::load(bundle)?;
    let bundle = file.bundle()?;
    let AnyEngine::Native(mut engine) = model::engine(&file, &bundle, choice)? else {
        let reason = format!("`{choice}` does not tell what its steps take, only `native` does");
        return Err(HostError::Argument { what: "--engine".into(), reason });
    };
    let manifest = bundle.manifest();
    crop_input(&manifest.spec, 0, engine.crop_mut());
    let step = |s: tsda_runtime::engine::native::StepTime| Step {
        graph: s.graph,
        kind: s.kind,
        node: s.node,
        mega_operations: s.operations as f64 / 1e6,
        wall_us: s.time.as_secs_f64() * 1e6,
    };
    Ok(Report {
        preset: manifest.name.into(),
        isa: engine.plan_summary().isa,
        runs,
        steps: engine.step_times(runs).into_iter().map(step).collect(),
    })
}

/// Operations per nanosecond.
fn rate(mega: f64, us: f64) -> f64 {
    if us > 0.0 { mega * 1e3 / us } else { 0.0 }
}

impl Report {
    /// For people: every step, then each graph by kind.
    pub fn table(&self) -> String {
        let mut out = format!(
            "{}: native, {}, one thread, shortest of {} runs\n",
            self.preset, self.isa, self.runs
        );
        for steps in self.steps.chunk_by(|a, b| a.graph == b.graph) {
            let total: f64 = steps.iter().map(|s| s.wall_us).sum();
            let share = |us: f64| 100.0 * us / total.max(f64::MIN_POSITIVE);
            let mut kinds: BTreeMap<&str, (usize, f64, f64)> = BTreeMap::new();
            let _ = writeln!(
                out,
                "\n{:<18}{:>9}{:>7}{:>10}{:>8}  node",
                steps[0].graph, "us", "%", "M ops", "G/s"
            );
            for s in steps {
                let kind = kinds.entry(s.kind).or_default();
                *kind = (kind.0 + 1, kind.1 + s.wall_us, kind.2 + s.mega_operations);
                let _ = writeln!(
                    out,
                    "  {:<16}{:>9.1}{:>7.1}{:>10.3}{:>8.1}  {}",
                    s.kind,
                    s.wall_us,
                    share(s.wall_us),
                    s.mega_operations,
                    rate(s.mega_operations, s.wall_us),
                    s.node
                );
            }
            let mut kinds: Vec<_> = kinds.into_iter().collect();
            kinds.sort_by(|a, b| b.1.1.total_cmp(&a.1.1));
            let _ = writeln!(out, "  all: {total:.1} us");
            for (kind, (count, us, mega)) in kinds {
                let _ = writeln!(
                    out,
                    "  {kind:<16}{us:>9.1}{:>7.1}{mega:>10.3}{:>8.1}  {count} steps",
                    share(us),
                    rate(mega, us)
                );
            }
        }
        out
    }
}
