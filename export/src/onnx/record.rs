//! Recording burn modules as graphs.

use super::convert::Converter;
use super::error::ExportError;
use super::graph::Graph;
use burn::backend::Capture;
use burn::backend::ir::TensorId;
use burn::module::{Module, ModuleVisitor, Param};
use burn::tensor::{Bool, Device, Int, Tensor, TensorData};
use std::any::Any;
use std::collections::HashMap;

/// Names and boundaries of a recording in progress; handed to the closure of [`record`].
pub struct Recorder {
    graph: String,
    device: Device,
    pub(super) names: HashMap<TensorId, String>,
    pub(super) inputs: Vec<Boundary>,
    pub(super) outputs: Vec<Boundary>,
    /// Handles that have to outlive the recording: a dropped output is no output.
    alive: Vec<Box<dyn Any>>,
}

/// An input or output of a recording.
pub(super) struct Boundary {
    pub id: TensorId,
    pub name: String,
    pub doc: String,
}

impl Recorder {
    /// The device on which everything is recorded. Constants made on it become constants of the
    /// graph.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// A copy of `module`, in its inference form, whose computations are recorded. Its parameters
    /// are named by their path in the module.
    pub fn module<M: Module>(&mut self, module: &M) -> M {
        // `valid` takes it off an autodiff device, where batch norm would use batch statistics,
        // and separates running statistics, which clones share and `to_device` moves in place.
        let module = module.valid().to_device(&self.device);
        let mut namer = Namer { path: Vec::new(), names: &mut self.names };
        module.visit(&mut namer);
        module
    }

    /// A tensor that the caller of the graph provides.
    ///
    /// # Errors
    /// When the name is empty or taken.
    pub fn input<const D: usize>(
        &mut self,
        name: &str,
        dims: [usize; D],
        doc: &str,
    ) -> Result<Tensor<D>, ExportError> {
        self.check(name)?;
        let tensor = Tensor::<D>::from_data(
            TensorData::new(vec![0f32; dims.iter().product()], dims),
            &self.device,
        );
        let id = self.id(&tensor)?;
        self.inputs.push(Boundary { id, name: name.into(), doc: doc.into() });
        self.alive.push(Box::new(tensor.clone()));
        Ok(tensor)
    }

    /// Declares a result of the graph.
    ///
    /// # Errors
    /// When the name is empty or taken.
    pub fn output<const D: usize>(
        &mut self,
        name: &str,
        tensor: Tensor<D>,
        doc: &str,
    ) -> Result<(), ExportError> {
        self.check(name)?;
        let id = self.id(&tensor)?;
        self.outputs.push(Boundary { id, name: name.into(), doc: doc.into() });
        self.alive.push(Box::new(tensor));
        Ok(())
    }

    fn check(&self, name: &str) -> Result<(), ExportError> {
        let reason = if name.is_empty() {
            "it is empty"
        } else if self.inputs.iter().chain(&self.outputs).any(|b| b.name == name) {
            "it is already in use"
        } else {
            return Ok(());
        };
        Err(ExportError::Name { graph: self.graph.clone(), name: name.into(), reason })
    }

    fn id<const D: usize>(&self, tensor: &Tensor<D>) -> Result<TensorId, ExportError> {
        float_id(tensor).ok_or_else(|| ExportError::Capture {
            graph: self.graph.clone(),
            reason: "a tensor does not belong to the recording; make it with \
                     `Recorder::device`"
                .into(),
        })
    }
}

fn float_id<const D: usize>(tensor: &Tensor<D>) -> Option<TensorId> {
    tensor.clone().try_into_primitive::<Capture>().ok().map(|t| t.id())
}

/// Collects the path of every parameter.
struct Namer<'a> {
    path: Vec<String>,
    names: &'a mut HashMap<TensorId, String>,
}

impl Namer<'_> {
    fn insert(&mut self, id: Option<TensorId>) {
        if let Some(id) = id {
            self.names.insert(id, self.path.join("."));
        }
    }
}

impl ModuleVisitor for Namer<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.insert(float_id(&param.val()));
    }

    fn visit_int<const D: usize>(&mut self, param: &Param<Tensor<D, Int>>) {
        let id = param.val().try_into_primitive::<Capture>().ok().map(|t| t.id());
        self.insert(id);
    }

    fn visit_bool<const D: usize>(&mut self, param: &Param<Tensor<D, Bool>>) {
        let id = param.val().try_into_primitive::<Capture>().ok().map(|t| t.id());
        self.insert(id);
    }
}

/// Records what `computation` does and returns it as a graph, one ONNX node per burn operation (or
/// a few), not yet simplified; see [`super::optimise`].
///
/// Nothing is executed. Shapes are those of the declared inputs and stay fixed; control flow of the
/// closure is not part of the graph.
///
/// # Errors
/// Names the first operation that has no ONNX counterpart here, with its position.
pub fn record(
    name: &str,
    doc: &str,
    computation: impl FnOnce(&mut Recorder) -> Result<(), ExportError>,
) -> Result<Graph, ExportError> {
    let device = Device::capture();
    let mut recorder = Recorder {
        graph: name.into(),
        device: device.clone(),
        names: HashMap::new(),
        inputs: Vec::new(),
        outputs: Vec::new(),
        alive: Vec::new(),
    };
    let mut failed = None;
    let captured = device.capture_scope(|scope| {
        if let Err(error) = computation(&mut recorder) {
            failed = Some(error);
            return scope.complete([], []);
        }
        let ids = |b: &[Boundary]| b.iter().map(|b| b.id).collect::<Vec<_>>();
        scope.complete(ids(&recorder.inputs), ids(&recorder.outputs))
    });
    if let Some(error) = failed {
        return Err(error);
    }
    let captured =
        captured.map_err(|e| ExportError::Capture { graph: name.into(), reason: e.to_string() })?;
    Converter::new(name, doc, &captured, &recorder).run()
}
