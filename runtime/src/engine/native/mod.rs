//! The native engine: pure Rust, nothing allocated and no file touched once it is loaded.
//!
//! At load the graphs of a bundle are read ([`graph`]), joined into larger operators, and turned
//! into fixed lists of kernel calls ([`plan`]) over one arena and one block of packed weights; an
//! operator or a shape that is not supported is refused there, by name. A frame is then a walk
//! through such a list by one or more threads ([`kernels`]). How it is built and how to add to it:
//! `docs/native-engine.md`.

mod graph;
mod kernels;
mod plan;
mod proto;
mod session;
mod sync;
#[cfg(test)]
mod tests;

use super::{Engine, EngineError, Maps, Stage, TemplateInput};
use crate::bundle::{Bundle, SectionKind};
use crate::spec::ModelSpec;
use graph::Graph;
use kernels::Team;
use plan::{Base, Binding, Plan, Planner, StepLabel, View};
use std::ops::Range;
use std::time::Duration;

pub use kernels::Isa;
pub use plan::ProgramSummary;
pub use session::GraphSession;

const NAME: &str = "native";

/// Floats by which weights may grow where that saves time. Those that would go beyond are transformed
/// in every run: reading them in their larger form from memory takes no less.
const GROWTH: usize = 512 * 1024;

/// How to run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NativeOptions {
    /// Threads that work on a frame, the calling one included.
    pub threads: usize,
    /// Whether each thread, the calling one included, stays on a processor core of its own.
    pub pin: bool,
    /// Instruction set; `None` takes the best one of this processor.
    pub isa: Option<Isa>,
    /// Whether attention stays in floats where the products around it are of bytes.
    pub float_attention: bool,
    /// Whether 3 x 3 convolutions over floats stay what they are. Otherwise those of every pixel are
    /// computed with 16 multiplications in the place of 36 where that is less work in all.
    pub direct_convolution: bool,
}

impl NativeOptions {
    /// Most threads of one engine.
    pub const MAX_THREADS: usize = 64;
}

impl Default for NativeOptions {
    fn default() -> Self {
        Self {
            threads: 1,
            pin: false,
            isa: None,
            float_attention: false,
            direct_convolution: false,
        }
    }
}

/// What an engine consists of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanSummary {
    /// Instruction set of the kernels.
    pub isa: &'static str,
    /// Threads that work on a frame.
    pub threads: usize,
    /// Bytes of packed weights and other constants.
    pub weights: usize,
    /// Bytes of the arena.
    pub arena: usize,
    /// Bytes of the arena that live on between calls: inputs, feature, template slots, results.
    pub lasting: usize,
    /// One per graph.
    pub programs: Vec<ProgramSummary>,
}

impl core::fmt::Display for PlanSummary {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let mb = |bytes: usize| bytes as f64 / f64::from(1 << 20);
        writeln!(
            f,
            "native engine: {}, {} thread(s), weights {:.2} MB, arena {:.2} MB of which {:.2} MB \
             live on between calls",
            self.isa,
            self.threads,
            mb(self.weights),
            mb(self.arena),
            mb(self.lasting)
        )?;
        for p in &self.programs {
            writeln!(
                f,
                "  {:<16} {:>4} steps, {:>9.2} M operations, buffers {:.2} MB ({:.2} MB unshared)",
                p.name,
                p.steps,
                p.operations as f64 / 1e6,
                mb(p.buffers),
                mb(p.unshared)
            )?;
            for (kind, count, operations) in &p.kinds {
                writeln!(f, "    {kind:<24} {count:>4}, {:>9.2} M", *operations as f64 / 1e6)?;
            }
        }
        Ok(())
    }
}

/// A bundle's network, compiled for this processor.
#[derive(Debug)]
pub struct NativeEngine {
    spec: ModelSpec,
    team: Team,
    places: Places,
    programs: Programs,
    has_feature: bool,
    /// Which template slots have been written.
    filled: Vec<bool>,
    summary: PlanSummary,
    /// One per step of every program.
    labels: Vec<Box<[StepLabel]>>,
}

/// What one step of a graph takes; see [`NativeEngine::step_times`].
#[derive(Clone, Debug, PartialEq)]
pub struct StepTime {
    /// Graph, as the bundle names it.
    pub graph: String,
    /// Kind of kernel.
    pub kind: &'static str,
    /// Node of the graph; a node can be several steps, and a step several nodes under the name of
    /// the first one.
    pub node: String,
    /// Floating-point operations, about.
    pub operations: usize,
    /// The shortest of all runs, by the clock, on one thread.
    pub time: Duration,
}

/// Where inputs and results are in the arena.
#[derive(Debug)]
struct Places {
    crop: Range<usize>,
    label: Range<usize>,
    ltrb: Range<usize>,
    tokens: Range<usize>,
    /// One per slot.
    slots: Vec<usize>,
    scores: Range<usize>,
    ltrb_map: Range<usize>,
}

/// Indices of the programs.
#[derive(Debug)]
struct Programs {
    features: usize,
    template: usize,
    /// Of the graph for one template; those for more follow.
    predict: usize,
}

impl NativeEngine {
    /// Compiles the graphs of a bundle for one thread and the best instruction set.
    ///
    /// # Errors
    /// When a graph is missing, damaged, does not fit the specification, or has a node that is not
    /// supported; the message names graph and node.
    pub fn from_bundle(bundle: &Bundle<'_>) -> Result<Self, EngineError> {
        Self::with_options(bundle, NativeOptions::default())
    }

    /// Compiles the graphs of a bundle.
    ///
    /// # Errors
    /// As [`Self::from_bundle`]; also when the processor lacks the instruction set asked for, or the
    /// number of threads is not 1 to 64.
    pub fn with_options(bundle: &Bundle<'_>, options: NativeOptions) -> Result<Self, EngineError> {
        let threads = options.threads;
        let most = NativeOptions::MAX_THREADS;
        if !(1..=most).contains(&threads) {
            let message = format_args!("{threads} threads; 1 to {most} are possible");
            return Err(error(Stage::Load, message));
        }
        let isa = options.isa.unwrap_or_else(Isa::best);
        let Some(kernels) = isa.kernels() else {
            let message = format_args!("this processor has no {}", isa.name());
            return Err(error(Stage::Load, message));
        };
        let spec = bundle.manifest().spec;
        let graphs = Graphs::read(bundle, spec.templates)?;
        let weights = bundle.section(SectionKind::Weights).unwrap_or_default().len() / 4;
        let growth = (!options.direct_convolution).then_some(GROWTH);
        let mut planner =
            Planner::new(kernels, threads, weights + weights / 16, growth, bundle.mapping());
        if !options.float_attention {
            planner.narrow_attention();
        }
        let places = Self::lower(&mut planner, &spec, &graphs)?;
        let plan = planner.finish().map_err(|e| error(Stage::Load, format_args!("{e}")))?;
        drop(graphs);
        let Plan { programs, labels, mut summaries, weights, arena, lasting } = plan;
        summaries.retain(|s| s.steps > 0);
        let summary = PlanSummary {
            isa: isa.name(),
            threads,
            weights: 4 * weights.len(),
            arena: 4 * arena,
            lasting: 4 * lasting,
            programs: summaries,
        };
        let mut team = Team::new(arena, weights, programs, kernels, threads, options.pin)
            .map_err(|e| error(Stage::Load, format_args!("{e}")))?;
        // What depends on constants only.
        team.run(0);
        Ok(Self {
            spec,
            team,
            places,
            programs: Programs { features: 1, template: 2, predict: 3 },
            has_feature: false,
            filled: vec![false; spec.templates.into()],
            summary,
            labels,
        })
    }

    /// Sizes and contents of the plan, for `tsda info`.
    pub const fn plan_summary(&self) -> &PlanSummary {
        &self.summary
    }

    /// Runs the graphs of a frame with all template slots `runs` times on the calling thread and
    /// notes what every step takes, in the order they run. The results of the engine are what these
    /// runs leave; slots that were never written hold zeros. Allocates.
    pub fn step_times(&mut self, runs: usize) -> Vec<StepTime> {
        let slots = self.filled.len();
        let predict = self.programs.predict + slots - 1;
        let kinds = [
            (self.programs.features, SectionKind::FeaturesOnnx),
            (self.programs.template, SectionKind::TemplateOnnx),
            (predict, SectionKind::PredictOnnx(slots as u8)),
        ];
        let mut all = Vec::new();
        for (program, kind) in kinds {
            let labels = &self.labels[program];
            let mut shortest = vec![Duration::MAX; labels.len()];
            for _ in 0..runs.max(1) {
                self.team.time(program, &mut shortest);
            }
            all.extend(labels.iter().zip(shortest).map(|(label, time)| StepTime {
                graph: kind.to_string(),
                kind: label.kind,
                node: label.node.to_string(),
                operations: label.operations,
                time,
            }));
        }
        all
    }

    fn lower(
        planner: &mut Planner,
        spec: &ModelSpec,
        graphs: &Graphs<'_>,
    ) -> Result<Places, EngineError> {
        let (side, map, width) = (spec.crop_side(), spec.map_side(), usize::from(spec.width));
        let mut lasting = |shape: &[usize]| {
            let len = shape.iter().product();
            let at = planner.lasting(len);
            (View::dense(Base::Arena(at), shape), at..at + len)
        };
        let (crop_view, crop) = lasting(&[1, 3, side, side]);
        // Cell by cell, which is how tokens are: no graph has to turn it round.
        let feature = lasting(&[1, map, map, width]).0.transposed(&[0, 3, 1, 2]);
        let (label_view, label) = lasting(&[map, map]);
        let (ltrb_view, ltrb) = lasting(&[4, map, map]);
        let shape = graphs.tokens_shape()?;
        let (tokens_view, tokens) = lasting(&shape);
        let slots: Vec<_> = (0..spec.templates).map(|_| lasting(&shape)).collect();
        let (scores_view, scores) = lasting(&[map, map]);
        let (ltrb_map_view, ltrb_map) = lasting(&[4, map, map]);

        let bind = |name, view: &View| Binding { name, view: view.clone() };
        let mut add =
            |kind: SectionKind, graph, inputs: &[Binding<'_>], outputs: &[Binding<'_>]| {
                planner
                    .add(&kind.to_string(), graph, inputs, outputs)
                    .map_err(|e| error(Stage::Load, format_args!("{kind}: {e}")))
            };
        let feature = bind("feature", &feature);
        add(
            SectionKind::FeaturesOnnx,
            &graphs.features,
            &[bind("crop", &crop_view)],
            core::slice::from_ref(&feature),
        )?;
        let inputs = [feature.clone(), bind("label", &label_view), bind("ltrb", &ltrb_view)];
        let outputs = [bind("tokens", &tokens_view)];
        add(SectionKind::TemplateOnnx, &graphs.template, &inputs, &outputs)?;
        let names: Vec<String> = (0..slots.len()).map(|i| format!("template{i}")).collect();
        for (k, graph) in (1u8..).zip(&graphs.predict) {
            let filled = slots.iter().zip(&names).take(k.into());
            let mut inputs: Vec<_> = filled.map(|(s, name)| bind(name, &s.0)).collect();
            inputs.push(feature.clone());
            let outputs = [bind("scores", &scores_view), bind("ltrb", &ltrb_map_view)];
            add(SectionKind::PredictOnnx(k), graph, &inputs, &outputs)?;
        }
        let slots = slots.into_iter().map(|s| s.1.start).collect();
        Ok(Places { crop, label, ltrb, tokens, slots, scores, ltrb_map })
    }

    fn need_feature(&self, stage: Stage) -> Result<(), EngineError> {
        if self.has_feature {
            return Ok(());
        }
        Err(error(stage, format_args!("no head feature: call `features` first")))
    }
}

/// The graphs of a bundle, read and simplified.
struct Graphs<'a> {
    features: Graph<'a>,
    template: Graph<'a>,
    predict: Vec<Graph<'a>>,
}

impl<'a> Graphs<'a> {
    fn read(bundle: &Bundle<'a>, templates: u8) -> Result<Self, EngineError> {
        let weights = bundle.section(SectionKind::Weights).unwrap_or_default();
        let read = |kind: SectionKind| {
            let bytes =
                bundle.require(kind).map_err(|e| error(Stage::Load, format_args!("{e}")))?;
            let mut graph = graph::read(bytes, weights)
                .map_err(|e| error(Stage::Load, format_args!("{kind}: {e}")))?;
            graph::fuse(&mut graph);
            Ok::<_, EngineError>(graph)
        };
        Ok(Self {
            features: read(SectionKind::FeaturesOnnx)?,
            template: read(SectionKind::TemplateOnnx)?,
            predict: (1..=templates)
                .map(|k| read(SectionKind::PredictOnnx(k)))
                .collect::<Result<_, _>>()?,
        })
    }

    /// What the template graph makes of a frame, which is what a slot holds.
    fn tokens_shape(&self) -> Result<Vec<usize>, EngineError> {
        let values = &self.template.values;
        let found = self.template.outputs.iter().find(|&&id| values[id].name == "tokens");
        let missing = || {
            let kind = SectionKind::TemplateOnnx;
            error(Stage::Load, format_args!("{kind} has no output `tokens`"))
        };
        found.map(|&id| values[id].shape.clone()).ok_or_else(missing)
    }
}

impl Engine for NativeEngine {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    fn name(&self) -> &'static str {
        NAME
    }

    fn crop_mut(&mut self) -> &mut [f32] {
        self.team.view_mut(self.places.crop.clone())
    }

    fn features(&mut self) -> Result<(), EngineError> {
        self.team.run(self.programs.features);
        self.has_feature = true;
        Ok(())
    }

    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        let (label, ltrb) =
            self.team.two_views_mut(self.places.label.clone(), self.places.ltrb.clone());
        TemplateInput { label, ltrb }
    }

    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        let stage = Stage::Template;
        let slots = self.places.slots.len();
        let Some(&to) = self.places.slots.get(slot) else {
            return Err(error(stage, format_args!("slot {slot} of a network with {slots} slots")));
        };
        self.need_feature(stage)?;
        self.team.run(self.programs.template);
        self.team.copy(self.places.tokens.clone(), to);
        self.filled[slot] = true;
        Ok(())
    }

    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        let stage = Stage::Predict;
        let slots = self.filled.len();
        self.need_feature(stage)?;
        if !(1..=slots).contains(&filled) {
            let detail = format_args!("{filled} templates asked for, 1 to {slots} are possible");
            return Err(error(stage, detail));
        }
        if let Some(slot) = self.filled[..filled].iter().position(|written| !written) {
            return Err(error(stage, format_args!("template slot {slot} was never written")));
        }
        self.team.run(self.programs.predict + filled - 1);
        Ok(Maps {
            scores: self.team.view(self.places.scores.clone()),
            ltrb: self.team.view(self.places.ltrb_map.clone()),
        })
    }
}

fn error(stage: Stage, detail: core::fmt::Arguments<'_>) -> EngineError {
    EngineError::new(NAME, stage, detail)
}
