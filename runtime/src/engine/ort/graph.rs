//! Any single graph on ONNX Runtime: fixed shapes, f32, all tensors bound once. For checks; the
//! tracker's engine is [`super::OrtEngine`].

use super::{EngineError, OrtLibrary, Stage, bind, error, read, write, zeros};
use crate::bundle::SectionKind;
use ::ort::session::{IoBinding, Session};
use ::ort::value::{Outlet, Tensor, ValueType};
use std::string::String;
use std::vec::Vec;

/// A loaded graph with its inputs and outputs.
#[derive(Debug)]
pub struct GraphSession {
    session: Session,
    binding: IoBinding,
    inputs: Vec<(String, Tensor<f32>)>,
    outputs: Vec<(String, Tensor<f32>)>,
}

impl GraphSession {
    /// Loads an ONNX file that holds its weights; `threads` per operation, 0 for one per core.
    ///
    /// # Errors
    /// When the library cannot be loaded, it refuses the graph, or a shape is not fixed.
    pub fn new(onnx: &[u8], threads: usize) -> Result<Self, EngineError> {
        let failed = |e: &dyn core::fmt::Display| error(Stage::Load, format_args!("{e}"));
        let session = Session::builder(&OrtLibrary::get()?.environment)
            .map_err(|e| failed(&e))?
            .with_intra_threads(threads)
            .map_err(|e| failed(&e))?
            .with_intra_op_spinning(false)
            .map_err(|e| failed(&e))?
            .commit_from_memory(onnx)
            .map_err(|e| failed(&e))?;
        let mut inputs = tensors(session.inputs())?;
        let mut outputs = tensors(session.outputs())?;
        // The kind only names the graph in errors.
        let binding = bind(
            SectionKind::PredictOnnx(0),
            &session,
            &mut inputs.iter_mut().map(|(n, t)| (n.as_str(), t)).collect::<Vec<_>>(),
            &mut outputs.iter_mut().map(|(n, t)| (n.as_str(), t)).collect::<Vec<_>>(),
        )?;
        Ok(Self { session, binding, inputs, outputs })
    }

    /// Values of an input, to be filled before [`Self::run`].
    pub fn input_mut(&mut self, name: &str) -> Option<&mut [f32]> {
        self.inputs.iter_mut().find(|(n, _)| n == name).map(|(_, t)| write(t))
    }

    /// Computes the outputs.
    ///
    /// # Errors
    /// What ONNX Runtime reported.
    pub fn run(&mut self) -> Result<(), EngineError> {
        super::run(&mut self.session, &self.binding, Stage::Predict)
    }

    /// Values of an output after [`Self::run`].
    pub fn output(&self, name: &str) -> Option<&[f32]> {
        self.outputs.iter().find(|(n, _)| n == name).and_then(|(_, t)| read(t).ok())
    }
}

/// Zeros in the shape of every port.
fn tensors(ports: &[Outlet]) -> Result<Vec<(String, Tensor<f32>)>, EngineError> {
    ports
        .iter()
        .map(|port| {
            let name = port.name();
            let ValueType::Tensor { shape, .. } = port.dtype() else {
                return Err(error(Stage::Load, format_args!("`{name}` is no tensor")));
            };
            let sides: Option<Vec<usize>> =
                shape.iter().map(|side| usize::try_from(*side).ok()).collect();
            let sides = sides.ok_or_else(|| {
                error(Stage::Load, format_args!("`{name}` has no fixed shape: {shape:?}"))
            })?;
            Ok((name.into(), zeros(&sides)?))
        })
        .collect()
}
