//! burn operations to ONNX operations.

mod activation;
mod base;
mod module;
mod numeric;

use super::error::ExportError;
use super::graph::{Attribute, Data, Elem, Graph, Node, Port, ValueId};
use super::record::Recorder;
use burn::backend::ir::{OperationIr, ScalarIr, TensorId, TensorIr};
use burn::tensor::{CapturedGraph, DType, TensorData};
use std::collections::{BTreeMap, HashMap, HashSet};

/// Why one operation could not be converted; [`Converter::run`] adds which one it was.
pub(super) enum Refusal {
    /// Not known at all.
    Operation,
    /// Known, but not with these settings.
    Setting(String),
}

pub(super) type Converted = Result<(), Refusal>;

fn setting<T>(reason: impl Into<String>) -> Result<T, Refusal> {
    Err(Refusal::Setting(reason.into()))
}

/// Turns a captured burn graph into a [`Graph`].
pub(super) struct Converter<'a> {
    graph: Graph,
    captured: &'a CapturedGraph,
    recorder: &'a Recorder,
    values: HashMap<TensorId, ValueId>,
    constants: &'a BTreeMap<TensorId, TensorData>,
    /// Layer the operation being converted belongs to; names what it computes.
    scope: String,
    /// The layer of everything converted so far, and when it was computed.
    scopes: HashMap<TensorId, (usize, String)>,
    /// Tensors that depend on no input.
    fixed: HashSet<TensorId>,
}

impl<'a> Converter<'a> {
    pub fn new(name: &str, doc: &str, captured: &'a CapturedGraph, recorder: &'a Recorder) -> Self {
        Self {
            graph: Graph::new(name, doc),
            captured,
            recorder,
            values: HashMap::new(),
            constants: &captured.values,
            scope: String::new(),
            scopes: HashMap::new(),
            fixed: captured.values.keys().copied().collect(),
        }
    }

    pub fn run(mut self) -> Result<Graph, ExportError> {
        let operations = &self.captured.graph.operations;
        let shapes = shapes(operations);
        // `complete` resolves aliases, so the ids come from the captured graph, the names from the
        // recorder; both are in the order of declaration.
        for (id, port) in self.captured.graph.inputs.iter().zip(&self.recorder.inputs) {
            let dims = self.input_dims(*id, &shapes);
            let value = self.graph.add_value(&port.name, &dims, Elem::F32);
            self.values.insert(*id, value);
            self.fixed.remove(id);
            self.graph.inputs.push(Port { value, doc: port.doc.clone() });
        }
        // Outputs keep their declared names, so nothing else may take them.
        let reserved: Vec<ValueId> = (self.captured.graph.outputs.iter())
            .zip(&self.recorder.outputs)
            .map(|(id, port)| {
                let dims = self.input_dims(*id, &shapes);
                let value = self.graph.add_value(&port.name, &dims, Elem::F32);
                self.graph.outputs.push(Port { value, doc: port.doc.clone() });
                value
            })
            .collect();
        let needed = needed(operations, &self.captured.graph.outputs);
        for (position, operation) in operations.iter().enumerate() {
            if needed[position] {
                self.operation(operation).map_err(|refusal| ExportError::Unsupported {
                    graph: self.graph.name.clone(),
                    position,
                    operation: operation_name(operation),
                    reason: match refusal {
                        Refusal::Operation => "the converter does not know it".into(),
                        Refusal::Setting(reason) => reason,
                    },
                })?;
            }
        }
        for (id, value) in self.captured.graph.outputs.iter().zip(reserved) {
            self.finish_output(*id, value)?;
        }
        Ok(self.graph)
    }

    /// Lets the node that computes output `id` write the reserved `value`.
    fn finish_output(&mut self, id: TensorId, value: ValueId) -> Result<(), ExportError> {
        let unknown = || ExportError::Capture {
            graph: self.graph.name.clone(),
            reason: format!("nothing computes output {id}"),
        };
        let Some(source) = self.values.get(&id).copied() else {
            let data = self.constants.get(&id).ok_or_else(unknown)?;
            let dims: Vec<usize> = data.shape().iter().copied().collect();
            let Ok(data) = constant(data) else { return Err(unknown()) };
            let source = self.graph.add_constant("constant", &dims, data);
            self.identity(source, value);
            return Ok(());
        };
        match self.graph.nodes.iter_mut().find(|n| n.output == source) {
            Some(node) => {
                node.output = value;
                self.graph.redirect(source, value);
            }
            // An input or a constant passed through.
            None => self.identity(source, value),
        }
        Ok(())
    }

    fn identity(&mut self, source: ValueId, out: ValueId) {
        self.graph.nodes.push(Node {
            op: "Identity",
            inputs: vec![Some(source)],
            output: out,
            attributes: vec![],
        });
    }

    fn input_dims(&self, id: TensorId, shapes: &HashMap<TensorId, Vec<usize>>) -> Vec<usize> {
        let held = || self.constants.get(&id).map(|d| d.shape().iter().copied().collect());
        shapes.get(&id).cloned().or_else(held).unwrap_or_default()
    }

    fn operation(&mut self, operation: &OperationIr) -> Converted {
        self.place(operation);
        match operation {
            // Initial values are looked up where they are read.
            OperationIr::Init(_) | OperationIr::Drop(_) => Ok(()),
            OperationIr::BaseFloat(op) | OperationIr::BaseInt(op) | OperationIr::BaseBool(op) => {
                self.base(op)
            }
            OperationIr::NumericFloat(_, op) | OperationIr::NumericInt(_, op) => self.numeric(op),
            OperationIr::Float(_, op) => self.float(op),
            OperationIr::Int(op) => self.int(op),
            OperationIr::Bool(op) => self.bool(op),
            OperationIr::Module(op) => self.module(op),
            OperationIr::Activation(op) => self.activation(op),
            _ => Err(Refusal::Operation),
        }
    }

    /// Finds the layer of an operation: `backbone.layer1.0.conv1` where it reads
    /// `backbone.layer1.0.conv1.weight` or something computed from that alone, otherwise the layer
    /// of the input computed last, so that activations and sums go by the layer before them and
    /// attention by the layer of its query, not of the memory it reads.
    fn place(&mut self, operation: &OperationIr) {
        let inputs: Vec<TensorId> = operation.inputs().map(|t| t.id).collect();
        let parent = |id| self.recorder.names.get(id)?.rsplit_once('.').map(|(parent, _)| parent);
        let known = |id| self.scopes.get(id).filter(|(_, scope)| !scope.is_empty());
        let own = inputs.iter().find_map(parent);
        let latest = |fixed: bool| {
            let among = inputs.iter().filter(|id| !fixed || self.fixed.contains(id));
            among.filter_map(known).max_by_key(|(order, _)| *order)
        };
        let placed = || latest(true).or_else(|| latest(false)).map(|(_, scope)| scope.as_str());
        let scope = own.or_else(placed).unwrap_or_default().to_owned();
        let fixed = inputs.iter().all(|id| self.fixed.contains(id));
        for out in operation.outputs() {
            // Initialised tensors are no results; they have their own names.
            if !matches!(operation, OperationIr::Init(_) | OperationIr::Drop(_)) {
                self.scopes.insert(out.id, (self.scopes.len(), scope.clone()));
                if fixed {
                    self.fixed.insert(out.id);
                }
            }
        }
        self.scope = scope;
    }

    /// The tensor of the graph that stands for `tensor`; constants are added on first use.
    fn read(&mut self, tensor: &TensorIr) -> Result<ValueId, Refusal> {
        if let Some(value) = self.values.get(&tensor.id) {
            return Ok(*value);
        }
        let Some(data) = self.constants.get(&tensor.id) else {
            return setting(format!("it reads tensor {}, which nothing computes", tensor.id));
        };
        let data = constant(data)?;
        let fallback = String::from("constant");
        let name = self.recorder.names.get(&tensor.id).unwrap_or(&fallback);
        let value = self.graph.add_constant(name, &dims(tensor), data);
        self.values.insert(tensor.id, value);
        Ok(value)
    }

    /// Adds a node that computes `out`.
    fn node(
        &mut self,
        op: &'static str,
        inputs: impl IntoIterator<Item = ValueId>,
        out: &TensorIr,
        attributes: Vec<(&'static str, Attribute)>,
    ) -> Converted {
        let elem = elem(out.dtype)?;
        let value = self.push(op, inputs, &dims(out), elem, attributes);
        self.values.insert(out.id, value);
        Ok(())
    }

    /// Adds a node whose result is an intermediate one that burn does not know.
    fn push(
        &mut self,
        op: &'static str,
        inputs: impl IntoIterator<Item = ValueId>,
        dims: &[usize],
        elem: Elem,
        attributes: Vec<(&'static str, Attribute)>,
    ) -> ValueId {
        let name =
            if self.scope.is_empty() { op.to_owned() } else { format!("{}/{op}", self.scope) };
        let output = self.graph.add_value(&name, dims, elem);
        let inputs = inputs.into_iter().map(Some).collect();
        self.graph.nodes.push(Node { op, inputs, output, attributes });
        output
    }

    /// A list of integers as a 1-D constant.
    fn list(&mut self, name: &str, values: Vec<i64>) -> ValueId {
        self.graph.add_constant(name, &[values.len()], Data::I64(values))
    }

    /// A rank-0 float constant.
    fn number(&mut self, value: f32) -> ValueId {
        self.graph.add_constant("scalar", &[], Data::F32(vec![value]))
    }

    /// A rank-0 constant of the element type of `like`.
    fn scalar(&mut self, value: ScalarIr, like: &TensorIr) -> Result<ValueId, Refusal> {
        let data = match elem(like.dtype)? {
            Elem::F32 => Data::F32(vec![value.elem()]),
            Elem::I64 => Data::I64(vec![value.elem()]),
            Elem::Bool => Data::Bool(vec![value.elem()]),
        };
        Ok(self.graph.add_constant("scalar", &[], data))
    }

    /// A node with one tensor input and no settings.
    fn unary(&mut self, op: &'static str, input: &TensorIr, out: &TensorIr) -> Converted {
        let input = self.read(input)?;
        self.node(op, [input], out, vec![])
    }

    /// A node with two broadcasting inputs.
    fn binary(
        &mut self,
        op: &'static str,
        lhs: &TensorIr,
        rhs: &TensorIr,
        out: &TensorIr,
    ) -> Converted {
        let (lhs, rhs) = (self.read(lhs)?, self.read(rhs)?);
        self.node(op, [lhs, rhs], out, vec![])
    }

    /// A node with a tensor and a scalar input.
    fn with_scalar(
        &mut self,
        op: &'static str,
        lhs: &TensorIr,
        rhs: ScalarIr,
        out: &TensorIr,
    ) -> Converted {
        let scalar = self.scalar(rhs, lhs)?;
        let lhs = self.read(lhs)?;
        self.node(op, [lhs, scalar], out, vec![])
    }
}

/// Shape of every tensor the operations mention.
fn shapes(operations: &[OperationIr]) -> HashMap<TensorId, Vec<usize>> {
    operations.iter().flat_map(|op| op.nodes()).map(|t| (t.id, dims(t))).collect()
}

/// Which operations the outputs depend on.
fn needed(operations: &[OperationIr], outputs: &[TensorId]) -> Vec<bool> {
    let mut wanted: HashSet<TensorId> = outputs.iter().copied().collect();
    let mut needed = vec![false; operations.len()];
    for (i, operation) in operations.iter().enumerate().rev() {
        let passive = matches!(operation, OperationIr::Drop(_));
        if !passive && operation.outputs().any(|t| wanted.contains(&t.id)) {
            needed[i] = true;
            wanted.extend(operation.inputs().map(|t| t.id));
        }
    }
    needed
}

fn dims(tensor: &TensorIr) -> Vec<usize> {
    tensor.shape.iter().copied().collect()
}

fn i64s(values: &[usize]) -> Vec<i64> {
    values.iter().map(|v| *v as i64).collect()
}

fn elem(dtype: DType) -> Result<Elem, Refusal> {
    match dtype {
        DType::F32 | DType::Flex32 => Ok(Elem::F32),
        t if t.is_int() || t.is_uint() => Ok(Elem::I64),
        t if t.is_bool() => Ok(Elem::Bool),
        t => setting(format!("element type {t:?} is not supported; cast to f32, i64 or bool")),
    }
}

fn constant(data: &TensorData) -> Result<Data, Refusal> {
    Ok(match elem(data.dtype())? {
        Elem::F32 => Data::F32(data.iter::<f32>().collect()),
        Elem::I64 => Data::I64(data.iter::<i64>().collect()),
        Elem::Bool => Data::Bool(data.iter::<bool>().collect()),
    })
}

/// `NumericFloat/Sort` out of `NumericFloat(F32, Sort(SortOpIr { .. }))`.
fn operation_name(operation: &OperationIr) -> String {
    let text = format!("{operation:?}");
    let head = text.split(['{', '[']).next().unwrap_or_default();
    head.split(|c: char| !c.is_alphanumeric())
        .filter(|word| !word.is_empty() && !word.ends_with("OpIr"))
        .filter(|word| !["F16", "BF16", "F32", "F64", "I32", "I64", "Flex32"].contains(word))
        .take(2)
        .collect::<Vec<_>>()
        .join("/")
}
