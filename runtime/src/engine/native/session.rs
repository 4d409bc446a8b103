//! Any single graph on the native engine: fixed shapes, f32. For checks; the tracker's engine is
//! [`super::NativeEngine`].

use super::graph;
use super::kernels::Team;
use super::plan::{Base, Binding, Plan, Planner, View};
use super::{EngineError, Isa, Stage, error};
use core::ops::Range;
use std::string::String;
use std::vec::Vec;

/// A compiled graph with its inputs and outputs.
#[derive(Debug)]
pub struct GraphSession {
    team: Team,
    inputs: Vec<(String, Range<usize>)>,
    outputs: Vec<(String, Range<usize>)>,
}

impl GraphSession {
    /// Compiles an ONNX file that holds its weights, for one thread and the best instruction set.
    ///
    /// # Errors
    /// When the file is damaged or has a node that is not supported.
    pub fn new(onnx: &[u8]) -> Result<Self, EngineError> {
        Self::with_weights(onnx, &[], Isa::best())
    }

    /// Compiles an ONNX file whose large constants are in `weights`, as those of bundles are, for
    /// one thread and an instruction set.
    ///
    /// # Errors
    /// As [`Self::new`]; also when the processor lacks the instruction set.
    pub fn with_weights(onnx: &[u8], weights: &[u8], isa: Isa) -> Result<Self, EngineError> {
        let failed = |e: &dyn core::fmt::Display| error(Stage::Load, format_args!("{e}"));
        let mut graph = graph::read(onnx, weights).map_err(|e| failed(&e))?;
        graph::fuse(&mut graph);
        let Some(kernels) = isa.kernels() else {
            return Err(failed(&format_args!("this processor has no {}", isa.name())));
        };
        let size = (onnx.len() + weights.len()) / 4;
        let mut planner = Planner::new(kernels, 1, size, Some(super::GROWTH), None);
        let mut place = |ids: &[usize]| -> Vec<(String, Range<usize>, View)> {
            ids.iter()
                .map(|&id| {
                    let value = &graph.values[id];
                    let len = value.shape.iter().product();
                    let at = planner.lasting(len);
                    let view = View::dense(Base::Arena(at), &value.shape);
                    (value.name.clone(), at..at + len, view)
                })
                .collect()
        };
        let (inputs, outputs) = (place(&graph.inputs), place(&graph.outputs));
        fn bind(ports: &[(String, Range<usize>, View)]) -> Vec<Binding<'_>> {
            ports.iter().map(|(name, _, view)| Binding { name, view: view.clone() }).collect()
        }
        let (from, to) = (bind(&inputs), bind(&outputs));
        planner.add("graph", &graph, &from, &to).map_err(|e| failed(&e))?;
        let Plan { programs, weights, arena, .. } = planner.finish().map_err(|e| failed(&e))?;
        let mut team =
            Team::new(arena, weights, programs, kernels, 1, false).map_err(|e| failed(&e))?;
        team.run(CONSTANTS);
        let named = |ports: Vec<(String, Range<usize>, View)>| {
            ports.into_iter().map(|(name, range, _)| (name, range)).collect()
        };
        Ok(Self { team, inputs: named(inputs), outputs: named(outputs) })
    }

    /// Values of an input, to be filled before [`Self::run`].
    pub fn input_mut(&mut self, name: &str) -> Option<&mut [f32]> {
        let range = self.inputs.iter().find(|(n, _)| n == name)?.1.clone();
        Some(self.team.view_mut(range))
    }

    /// Computes the outputs.
    pub fn run(&mut self) {
        self.team.run(GRAPH);
    }

    /// Values of an output after [`Self::run`].
    pub fn output(&self, name: &str) -> Option<&[f32]> {
        let range = self.outputs.iter().find(|(n, _)| n == name)?.1.clone();
        Some(self.team.view(range))
    }
}

/// The program of what depends on constants only.
const CONSTANTS: usize = 0;
/// The program of the graph.
const GRAPH: usize = 1;
