//! Shapes of all tensors of a model file, for the operators that the exporter writes.

use super::super::proto::{GraphProto, NodeProto, TensorProto, data_type};
use std::collections::HashMap;

/// A tensor whose shape cannot be told.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("graph `{graph}`, node `{node}` ({op}): {reason}")]
#[non_exhaustive]
pub struct ShapeError {
    /// Name of the graph.
    pub graph: String,
    /// Name of the node.
    pub node: String,
    /// Its operator.
    pub op: String,
    /// What is missing.
    pub reason: String,
}

/// What is known of a tensor.
#[derive(Clone, Debug)]
pub(super) struct Shape {
    pub dims: Vec<usize>,
    /// The same in every run.
    pub fixed: bool,
    /// Integers of a constant, which shapes are made of.
    ints: Option<Vec<i64>>,
}

/// Largest side that is accepted; keeps sums of sides within range.
const LARGEST_SIDE: i64 = 1 << 40;

fn side(value: i64) -> Option<usize> {
    (0..=LARGEST_SIDE).contains(&value).then_some(value as usize)
}

fn initializer(tensor: &TensorProto) -> Option<Shape> {
    let dims = tensor.dims.iter().map(|d| side(*d)).collect::<Option<Vec<_>>>()?;
    let raw = tensor.raw_data.as_deref().unwrap_or_default();
    let ints = (tensor.data_type == Some(data_type::INT64))
        .then(|| raw.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b)).collect());
    Some(Shape { dims, fixed: true, ints })
}

/// Shapes by name.
pub(super) fn infer(graph: &GraphProto) -> Result<HashMap<&str, Shape>, ShapeError> {
    let mut known: HashMap<&str, Shape> = HashMap::new();
    for input in &graph.input {
        let tensor = input.r#type.as_ref().and_then(|t| t.tensor_type.as_ref());
        let shape = tensor.and_then(|t| t.shape.as_ref());
        let dims = shape.and_then(|s| s.dim.iter().map(|d| side(d.dim_value?)).collect());
        if let (Some(name), Some(dims)) = (input.name.as_deref(), dims) {
            known.insert(name, Shape { dims, fixed: false, ints: None });
        }
    }
    for tensor in &graph.initializer {
        if let (Some(name), Some(shape)) = (tensor.name.as_deref(), initializer(tensor)) {
            known.insert(name, shape);
        }
    }
    for node in &graph.node {
        let fail = |reason: String| ShapeError {
            graph: graph.name.clone().unwrap_or_default(),
            node: node.name.clone().unwrap_or_default(),
            op: node.op_type.clone().unwrap_or_default(),
            reason,
        };
        let mut inputs = Vec::with_capacity(node.input.len());
        for name in &node.input {
            let shape = known.get(name.as_str());
            if shape.is_none() && !name.is_empty() {
                return Err(fail(format!("nothing gives input `{name}` a fixed shape")));
            }
            inputs.push(shape);
        }
        let dims = Rule { node, inputs: &inputs }.output().ok_or_else(|| {
            let shapes: Vec<_> = inputs.iter().map(|s| s.map(|s| &s.dims)).collect();
            fail(format!("its output shape cannot be told from inputs of {shapes:?}"))
        })?;
        let fixed = inputs.iter().flatten().all(|s| s.fixed);
        if let Some(name) = node.output.first() {
            known.insert(name, Shape { dims, fixed, ints: None });
        }
    }
    Ok(known)
}

/// One node with what is known of its inputs.
struct Rule<'a> {
    node: &'a NodeProto,
    inputs: &'a [Option<&'a Shape>],
}

impl Rule<'_> {
    fn dims(&self, index: usize) -> Option<&[usize]> {
        self.inputs.get(index).copied().flatten().map(|s| &s.dims[..])
    }

    fn ints(&self, index: usize) -> Option<&[i64]> {
        self.inputs.get(index).copied().flatten()?.ints.as_deref()
    }

    fn int(&self, name: &str) -> Option<i64> {
        self.node.attribute.iter().find(|a| a.name.as_deref() == Some(name))?.i
    }

    /// A list attribute; empty where it is absent.
    fn list(&self, name: &str) -> &[i64] {
        let found = self.node.attribute.iter().find(|a| a.name.as_deref() == Some(name));
        found.map_or(&[], |a| &a.ints)
    }

    fn axis(&self, value: i64, rank: usize) -> Option<usize> {
        let axis = if value < 0 { value.checked_add(rank as i64)? } else { value };
        usize::try_from(axis).ok().filter(|axis| *axis < rank)
    }

    fn output(&self) -> Option<Vec<usize>> {
        let x = self.dims(0)?;
        match self.node.op_type.as_deref()? {
            "Identity" | "Cast" | "QuantizeLinear" | "DequantizeLinear" | "Relu" | "LeakyRelu"
            | "PRelu" | "Sigmoid" | "HardSigmoid" | "Clip" | "Exp" | "Log" | "Sqrt"
            | "Reciprocal" | "Abs" | "Neg" | "Sign" | "Floor" | "Ceil" | "Round" | "Erf"
            | "Sin" | "Cos" | "Tan" | "Tanh" | "Atan" | "Softmax" | "LogSoftmax" | "Softplus"
            | "Not" | "BatchNormalization" | "LayerNormalization" => Some(x.to_vec()),
            "Add" | "Sub" | "Mul" | "Div" | "Pow" | "Max" | "Min" | "And" | "Or" | "Xor"
            | "Equal" | "Greater" | "GreaterOrEqual" | "Less" | "LessOrEqual" | "Where" => {
                let shapes = self.inputs.iter().map(|s| s.map(|s| &s.dims[..]));
                shapes.collect::<Option<Vec<_>>>()?.into_iter().try_fold(vec![], broadcast)
            }
            "MatMul" => {
                let y = self.dims(1)?;
                let ([a @ .., m, k], [b @ .., rows, n]) = (x, y) else { return None };
                let mut out = broadcast(a.to_vec(), b).filter(|_| k == rows)?;
                out.extend([*m, *n]);
                Some(out)
            }
            "Gemm" => {
                let y = self.dims(1)?;
                let flipped = |name| self.int(name) == Some(1);
                let [m, k] = *x else { return None };
                let [rows, n] = *y else { return None };
                let (m, k) = if flipped("transA") { (k, m) } else { (m, k) };
                let (rows, n) = if flipped("transB") { (n, rows) } else { (rows, n) };
                (k == rows).then(|| vec![m, n])
            }
            "Conv" | "ConvTranspose" | "MaxPool" | "AveragePool" => self.window(x),
            "Reshape" => self.reshape(x),
            "Expand" => {
                let to = self.ints(1)?.iter().map(|d| side(*d)).collect::<Option<Vec<_>>>()?;
                broadcast(to, x)
            }
            "Tile" => {
                let times = self.ints(1)?;
                (times.len() == x.len())
                    .then(|| x.iter().zip(times).map(|(d, n)| d.checked_mul(side(*n)?)).collect())?
            }
            "Transpose" => {
                let perm = self.list("perm");
                (perm.len() == x.len())
                    .then(|| perm.iter().map(|p| Some(x[self.axis(*p, x.len())?])).collect())?
            }
            "Slice" => self.slice(x),
            "Concat" => {
                let axis = self.axis(self.int("axis")?, x.len())?;
                let mut out = x.to_vec();
                out[axis] = 0;
                for index in 0..self.inputs.len() {
                    out[axis] = out[axis].checked_add(*self.dims(index)?.get(axis)?)?;
                }
                Some(out)
            }
            "Gather" => {
                let axis = self.axis(self.int("axis").unwrap_or(0), x.len())?;
                Some([&x[..axis], self.dims(1)?, &x[axis + 1..]].concat())
            }
            "GatherElements" => Some(self.dims(1)?.to_vec()),
            "Pad" => {
                let pads = self.ints(1)?;
                let grown = |(i, d): (usize, &usize)| {
                    side((*d as i64).checked_add(*pads.get(i)?)?.checked_add(pads[i + x.len()])?)
                };
                (pads.len() == 2 * x.len()).then(|| x.iter().enumerate().map(grown).collect())?
            }
            "ReduceSum" => self.reduce(x, self.ints(1).unwrap_or_default()),
            "ReduceMean" | "ReduceProd" | "ReduceMax" | "ReduceMin" => {
                self.reduce(x, self.list("axes"))
            }
            "ArgMax" | "ArgMin" => self.reduce(x, &[self.int("axis").unwrap_or(0)]),
            _ => None,
        }
    }

    /// Convolutions and pooling.
    fn window(&self, x: &[usize]) -> Option<Vec<usize>> {
        let op = self.node.op_type.as_deref()?;
        if self.node.attribute.iter().any(|a| a.name.as_deref() == Some("auto_pad")) {
            return None;
        }
        let convolution = matches!(op, "Conv" | "ConvTranspose");
        let kernel: Vec<usize> = if convolution {
            self.dims(1)?.get(2..)?.to_vec()
        } else {
            self.list("kernel_shape").iter().map(|k| side(*k)).collect::<Option<_>>()?
        };
        let rank = kernel.len();
        if rank == 0 || x.len() != rank + 2 {
            return None;
        }
        let channels = match op {
            "Conv" => *self.dims(1)?.first()?,
            "ConvTranspose" => {
                self.dims(1)?.get(1)?.checked_mul(side(self.int("group").unwrap_or(1))?)?
            }
            _ => x[1],
        };
        let mut out = vec![x[0], channels];
        for i in 0..rank {
            let at = |name: &str, i: usize, default: i64| match self.list(name) {
                [] => Some(default),
                list => list.get(i).copied(),
            };
            let extent = at("dilations", i, 1)?.checked_mul(kernel[i] as i64 - 1)?;
            let pads = at("pads", i, 0)?.checked_add(at("pads", i + rank, 0)?)?;
            let (stride, input) = (at("strides", i, 1)?, x[i + 2] as i64);
            let length = if op == "ConvTranspose" {
                let more = at("output_padding", i, 0)?;
                (input - 1)
                    .checked_mul(stride)?
                    .checked_sub(pads)?
                    .checked_add(extent + more + 1)?
            } else {
                let room = input.checked_add(pads)?.checked_sub(extent + 1)?;
                let ceil = self.int("ceil_mode") == Some(1);
                let up = if ceil { stride.checked_sub(1)? } else { 0 };
                room.checked_add(up)?.checked_div(stride)?.checked_add(1)?
            };
            out.push(side(length)?);
        }
        Some(out)
    }

    fn reshape(&self, x: &[usize]) -> Option<Vec<usize>> {
        let count = |dims: &[usize]| dims.iter().try_fold(1usize, |n, d| n.checked_mul(*d));
        let target = self.ints(1)?;
        let mut out = Vec::with_capacity(target.len());
        let mut free = None;
        for (i, d) in target.iter().enumerate() {
            out.push(match d {
                0 => *x.get(i)?,
                -1 if free.is_none() => {
                    free = Some(i);
                    1
                }
                d => side(*d)?,
            });
        }
        let have = count(x)?;
        if let Some(i) = free {
            out[i] = have.checked_div(count(&out)?)?;
        }
        (count(&out)? == have).then_some(out)
    }

    fn slice(&self, x: &[usize]) -> Option<Vec<usize>> {
        let (starts, ends) = (self.ints(1)?, self.ints(2)?);
        let mut out = x.to_vec();
        for (i, (start, end)) in starts.iter().zip(ends).enumerate() {
            let axis = match self.dims(3) {
                Some(_) => self.axis(*self.ints(3)?.get(i)?, x.len())?,
                None => i,
            };
            let step = match self.dims(4) {
                Some(_) => *self.ints(4)?.get(i)?,
                None => 1,
            };
            let length = *x.get(axis)? as i64;
            let from = |v: i64| if v < 0 { v.saturating_add(length) } else { v };
            let taken = match step {
                1.. => {
                    let (a, b) = (from(*start).clamp(0, length), from(*end).clamp(0, length));
                    (b - a).max(0).checked_add(step - 1)? / step
                }
                // Backwards: from `start` down to, but not including, `end`.
                i64::MIN..0 => {
                    let (a, b) = (from(*start).min(length - 1), from(*end).max(-1));
                    (a - b).max(0).checked_sub(step.checked_add(1)?)? / step.checked_neg()?
                }
                0 => return None,
            };
            out[axis] = side(taken)?;
        }
        Some(out)
    }

    /// `axes` empty: all of them.
    fn reduce(&self, x: &[usize], axes: &[i64]) -> Option<Vec<usize>> {
        let axes = axes.iter().map(|a| self.axis(*a, x.len())).collect::<Option<Vec<_>>>()?;
        let gone = |i: &usize| axes.is_empty() || axes.contains(i);
        let keep = self.int("keepdims").unwrap_or(1) == 1;
        Some(if keep {
            (0..x.len()).map(|i| if gone(&i) { 1 } else { x[i] }).collect()
        } else {
            (0..x.len()).filter(|i| !gone(i)).map(|i| x[i]).collect()
        })
    }
}

/// Shape of two tensors broadcast against each other.
fn broadcast(a: Vec<usize>, b: &[usize]) -> Option<Vec<usize>> {
    let rank = a.len().max(b.len());
    let side = |d: &[usize], i: usize| (i + d.len()).checked_sub(rank).map_or(1, |i| d[i]);
    (0..rank)
        .map(|i| match (side(&a, i), side(b, i)) {
            (x, y) if x == y || y == 1 => Some(x),
            (1, y) => Some(y),
            _ => None,
        })
        .collect()
}
