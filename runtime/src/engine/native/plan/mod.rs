//! From graphs to programs: layouts chosen, weights packed, buffers placed.
//!
//! Maps `(1, C, H, W)` lie in memory with channels innermost and, where a convolution wants one,
//! with a border of zeros; everything else lies as its maker left it, as a [`View`]. While a graph
//! is lowered every buffer has an address of its own; when all graphs are known, buffers that are
//! not in use at the same time get the same memory.

mod arena;
mod lower;
mod rows;
mod view;

use super::graph::{Data, Graph, GraphError};
use super::kernels::{Halo, Kernels, Program, Step};
use crate::system::Mapping;
use arena::Life;
use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::Arc;
pub use view::{Base, View};

/// Buffers, weights and lines start at multiples of this many floats, a cache line.
const ALIGN: usize = 16;
/// Addresses of buffers without a place yet; those below have one.
const FLOATING: usize = usize::MAX / 2 + 1;

type Result<T> = core::result::Result<T, GraphError>;

/// What a constant is, whichever graph it is met in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Source {
    /// Bytes of the bundle, which graphs share.
    Bytes(usize, usize),
    /// Bytes of the bundle that are scaled, with a hash of the scales.
    Scaled(usize, usize, u64),
    /// A value that the reader made.
    Value(usize, usize),
}

/// What has been made of a constant and can be used again.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
enum Made {
    /// Its elements in the order of these sizes and strides from this offset.
    Copy(Source, usize, Vec<usize>, Vec<usize>),
    /// Packed for products, from this offset.
    Packed(Source, usize, Vec<usize>, Vec<usize>),
    /// Kernels of 3 x 3 transformed and packed for products.
    Points(Source),
    /// Padded to whole vectors.
    Padded(Source, usize),
    /// Bytes packed for products.
    Bytes(Source, Vec<usize>),
    /// Factors of the columns of a product of bytes, for this step of the activations (as bits).
    Scales(Source, u32),
    /// What is added to such a product: its bias and the share of this zero point.
    Offsets(Source, Option<Source>, u32, u8),
}

/// Where inputs and outputs of graphs are.
#[derive(Clone, Debug)]
pub struct Binding<'n> {
    /// Name in the graph.
    pub name: &'n str,
    /// Its place in the arena.
    pub view: View,
}

/// A graph turned into steps.
#[derive(Debug)]
struct Routine {
    name: String,
    steps: Vec<Step>,
    /// Name of the node behind every step.
    nodes: Vec<String>,
    /// Address and length of every floating buffer, ascending.
    buffers: Vec<(usize, usize)>,
}

/// What a program consists of, for reports.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ProgramSummary {
    /// Name of the graph.
    pub name: String,
    /// Kernel calls.
    pub steps: usize,
    /// Floating-point operations, about.
    pub operations: usize,
    /// Bytes of its buffers, when they share memory.
    pub buffers: usize,
    /// Bytes of its buffers if each had memory of its own.
    pub unshared: usize,
    /// Kernel calls and operations by kind, in order of first use.
    pub kinds: Vec<(&'static str, usize, usize)>,
}

/// What a step is, for reports.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StepLabel {
    /// Kind of kernel.
    pub kind: &'static str,
    /// Node of the graph that it computes or is part of.
    pub node: Box<str>,
    /// Floating-point operations, about.
    pub operations: usize,
}

/// Everything a [`super::kernels::Team`] needs.
#[derive(Debug)]
pub struct Plan {
    /// One per graph, in the order they were added; the first one runs once, at load.
    pub programs: Vec<Program>,
    /// One per step of every program.
    pub labels: Vec<Box<[StepLabel]>>,
    /// See [`ProgramSummary`], in the same order.
    pub summaries: Vec<ProgramSummary>,
    /// Constants.
    pub weights: Vec<f32>,
    /// Floats of the arena.
    pub arena: usize,
    /// Floats at its start that live on between runs.
    pub lasting: usize,
}

/// Collects graphs and what they share.
#[derive(Debug)]
pub struct Planner {
    kernels: &'static Kernels,
    threads: usize,
    weights: Vec<f32>,
    /// Index of the first weight that lies at the start of a cache line, as all tensors then do.
    origin: usize,
    /// The file that constants are read from, when it is mapped.
    mapping: Option<Arc<Mapping>>,
    made: HashMap<Made, usize>,
    lasting: usize,
    /// Floats by which weights may still grow when those of 3 x 3 convolutions are transformed; the
    /// others are transformed in every run. Without it these convolutions stay what they are.
    growth: Option<usize>,
    /// Whether attention in graphs with products of bytes is computed in bytes too.
    byte_attention: bool,
    /// Computed once, from constants only.
    once: (Vec<Step>, Vec<String>),
    /// Address and length of what that writes.
    once_buffers: Vec<(usize, usize)>,
    routines: Vec<Routine>,
}

impl Planner {
    /// For an instruction set and a number of threads. `weights` is about how many floats there
    /// will be, `growth` by how many more they may grow for 3 x 3 convolutions
    /// by points, without which there are none; `mapping` the file they
    /// come from, which gets its memory back piece by piece.
    pub fn new(
        kernels: &'static Kernels,
        threads: usize,
        weights: usize,
        growth: Option<usize>,
        mapping: Option<Arc<Mapping>>,
    ) -> Self {
        let mut weights: Vec<f32> = Vec::with_capacity(weights + growth.unwrap_or(0) + ALIGN);
        // Where that cannot be said, it is all the same: kernels work with any alignment.
        let origin = Some(weights.as_ptr().align_offset(4 * ALIGN)).filter(|&n| n < ALIGN);
        weights.resize(origin.unwrap_or(0), 0.0);
        Self {
            kernels,
            threads,
            origin: weights.len(),
            weights,
            mapping,
            made: HashMap::new(),
            lasting: 0,
            growth,
            byte_attention: false,
            once: Default::default(),
            once_buffers: Vec::new(),
            routines: Vec::new(),
        }
    }

    /// Computes attention in bytes too, in graphs with products of bytes.
    pub const fn narrow_attention(&mut self) {
        self.byte_attention = true;
    }

    /// A buffer that lives on between runs; its address.
    pub fn lasting(&mut self, len: usize) -> usize {
        let at = self.lasting;
        self.lasting += len.next_multiple_of(ALIGN);
        at
    }

    /// A buffer that is written once, at load.
    fn lasting_once(&mut self, len: usize) -> usize {
        let at = self.lasting(len);
        self.once_buffers.push((at, len));
        at
    }

    /// Whether an address belongs to what is computed once.
    fn is_once(&self, at: usize) -> bool {
        self.once_buffers.iter().any(|b| (b.0..b.0 + b.1).contains(&at))
    }

    /// Lowers a graph whose inputs are read from, and whose outputs are written to, these places.
    ///
    /// # Errors
    /// Names the node that cannot be run.
    pub fn add(
        &mut self,
        name: &str,
        graph: &Graph<'_>,
        inputs: &[Binding<'_>],
        outputs: &[Binding<'_>],
    ) -> Result<()> {
        let index = self.routines.len();
        let routine = lower::lower(self, index, graph, inputs, outputs)?;
        let (steps, nodes, buffers) = routine;
        self.routines.push(Routine { name: name.into(), steps, nodes, buffers });
        Ok(())
    }

    /// Places all buffers and checks all steps.
    ///
    /// # Errors
    /// Names the node whose step does not keep within its buffers.
    pub fn finish(self) -> Result<Plan> {
        let Self { kernels, threads, weights, lasting, once, routines, .. } = self;
        let once =
            Routine { name: "once".into(), steps: once.0, nodes: once.1, buffers: Vec::new() };
        let mut placed = Vec::with_capacity(routines.len() + 1);
        let mut arena = lasting;
        for mut routine in core::iter::once(once).chain(routines) {
            let lives = lives(&routine, kernels, threads)?;
            let (starts, len) = arena::place(&lives, ALIGN);
            arena = arena.max(lasting + len);
            let moved = |at: usize| match at.checked_sub(FLOATING) {
                None => at,
                Some(_) => {
                    let i = routine.buffers.partition_point(|b| b.0 <= at) - 1;
                    lasting + starts[i] + (at - routine.buffers[i].0)
                }
            };
            routine.steps.iter_mut().for_each(|step| step.relocate(&moved));
            let unshared: usize = lives.iter().map(|l| l.len).sum();
            placed.push((routine, len, unshared));
        }
        let mut plan = Plan {
            programs: Vec::with_capacity(placed.len()),
            labels: Vec::with_capacity(placed.len()),
            summaries: Vec::with_capacity(placed.len()),
            arena,
            lasting,
            weights,
        };
        for (routine, len, unshared) in placed {
            let mut summary = ProgramSummary {
                name: routine.name,
                steps: routine.steps.len(),
                buffers: 4 * len,
                unshared: 4 * unshared,
                ..Default::default()
            };
            for step in &routine.steps {
                let operations = step.cost().operations;
                summary.operations += operations;
                match summary.kinds.iter_mut().find(|k| k.0 == step.name()) {
                    Some(kind) => (kind.1, kind.2) = (kind.1 + 1, kind.2 + operations),
                    None => summary.kinds.push((step.name(), 1, operations)),
                }
            }
            let nodes = routine.nodes;
            let label = |(step, node): (&Step, &String)| StepLabel {
                kind: step.name(),
                node: node.as_str().into(),
                operations: step.cost().operations,
            };
            plan.labels.push(routine.steps.iter().zip(&nodes).map(label).collect());
            let program = Program::new(routine.steps, arena, plan.weights.len(), threads, kernels)
                .map_err(|(i, what)| fault(&nodes[i], what))?;
            plan.programs.push(program);
            plan.summaries.push(summary);
        }
        Ok(plan)
    }

    /// Says that a constant has been read; it can be read again.
    fn release(&self, data: &Data<'_>) {
        if let (Some(mapping), Data::Bytes(bytes)) = (&self.mapping, data) {
            mapping.release(bytes);
        }
    }

    /// Appends to the weights; the place.
    fn put(&mut self, values: &[f32]) -> usize {
        let at = self.origin + (self.weights.len() - self.origin).next_multiple_of(ALIGN);
        self.weights.resize(at, 0.0);
        self.weights.extend_from_slice(values);
        at
    }

    /// The place of something made of a constant; it is made the first time.
    fn make(&mut self, what: Made, values: impl FnOnce() -> Vec<f32>) -> usize {
        if let Some(&at) = self.made.get(&what) {
            return at;
        }
        let at = self.put(&values());
        self.made.insert(what, at);
        at
    }
}

/// A step that the checks refuse: a mistake of this planner, told like any other.
fn fault(node: &str, what: &str) -> GraphError {
    GraphError::Node {
        node: node.into(),
        op: "plan".into(),
        reason: format!("{what}; please report this with the bundle"),
    }
}

/// First and last use of every buffer.
fn lives(routine: &Routine, kernels: &'static Kernels, threads: usize) -> Result<Vec<Life>> {
    let buffers = &routine.buffers;
    let mut lives: Vec<Life> =
        buffers.iter().map(|b| Life { len: b.1, first: usize::MAX, last: 0 }).collect();
    for (i, step) in routine.steps.iter().enumerate() {
        for (at, len) in step.arena_spans(kernels, threads) {
            if at < FLOATING {
                continue;
            }
            let index = buffers.partition_point(|b| b.0 <= at).checked_sub(1);
            let Some(index) = index.filter(|&b| at + len <= buffers[b].0 + buffers[b].1) else {
                return Err(fault(&routine.nodes[i], "it leaves its buffer"));
            };
            let life = &mut lives[index];
            life.first = life.first.min(i);
            life.last = life.last.max(i);
        }
    }
    for life in &mut lives {
        life.first = life.first.min(life.last);
    }
    Ok(lives)
}

/// Source of a constant of the graph with this index.
fn source(graph: usize, value: usize, data: &Data<'_>) -> Source {
    match data {
        Data::Bytes(bytes) | Data::Halves(bytes) => {
            Source::Bytes(bytes.as_ptr().addr(), bytes.len())
        }
        Data::Scaled { bytes, scale, .. } => {
            let mut hasher = DefaultHasher::new();
            scale.iter().for_each(|s| s.to_bits().hash(&mut hasher));
            Source::Scaled(bytes.as_ptr().addr(), bytes.len(), hasher.finish())
        }
        _ => Source::Value(graph, value),
    }
}

/// Elements of a constant in the order of a view.
fn gather(data: &[f32], offset: usize, shape: &[usize], stride: &[usize]) -> Vec<f32> {
    let len: usize = shape.iter().product();
    let mut out = Vec::with_capacity(len);
    let inner = shape.last().copied().unwrap_or(1);
    let step = stride.last().copied().unwrap_or(1);
    for i in 0..len / inner.max(1) {
        let mut rest = i;
        let mut at = offset;
        for d in (0..shape.len().saturating_sub(1)).rev() {
            at += rest % shape[d] * stride[d];
            rest /= shape[d];
        }
        out.extend((0..inner).map(|k| data[at + k * step]));
    }
    out
}

/// A map's buffer: floats per pixel, per line and in all, for `(channels, height, width)`.
#[derive(Clone, Copy, Debug)]
struct MapLayout {
    halo: Halo,
    len: usize,
}

/// Layout of a map with a border of `width` zeros.
fn map_layout(channels: usize, size: [usize; 2], width: usize) -> MapLayout {
    // Whole cache lines per pixel; a few channels stay together, so that the pixels of a window's
    // line are one run.
    let mut pixel = if channels > ALIGN { channels.next_multiple_of(ALIGN) } else { channels };
    pixel += spread(pixel);
    let line = (size[1] + 2 * width) * pixel;
    let halo = Halo { start: 0, size, width, line, pixel };
    MapLayout { halo, len: (size[0] + 2 * width) * line }
}

/// Floats to add to a pitch of whole pages: rows that far apart compete for the same lines of the
/// first-level cache.
const fn spread(pitch: usize) -> usize {
    if pitch > 0 && pitch.is_multiple_of(1024) { ALIGN } else { 0 }
}
