//! Multiply-accumulates of a graph, exactly, from its shapes.
//!
//! Counted are convolutions (any number of groups), transposed convolutions and matrix products,
//! wherever at least one input changes from run to run; products of constants are computed when a
//! model is loaded. Element-wise work, norms, softmax and moves are not counted, nor are biases.
//! Padding counts as if it were multiplied, as is usual.

mod shapes;
#[cfg(test)]
mod tests;

pub use shapes::ShapeError;

use super::graph::{Graph, Node};
use super::proto::{GraphProto, ModelProto, NodeProto};
use std::collections::HashMap;

/// What one operation costs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeMacs {
    /// Name of what it computes: the layer, a slash, the operator.
    pub name: String,
    /// ONNX operator.
    pub op: String,
    /// Multiply-accumulates of one run.
    pub macs: u64,
}

/// Every operation of a graph that multiplies, in order.
pub fn count(graph: &Graph) -> Vec<NodeMacs> {
    let counted = graph.nodes.iter().filter(|n| graph.constant(n.output).is_none());
    counted
        .filter_map(|node| {
            let dims = |i: usize| node.input(i).map(|id| graph.dims(id));
            let transposed = node.int("transA") == Some(1);
            let macs = products(node.op, dims(0)?, dims(1)?, graph.dims(node.output), transposed)?;
            let name = graph.value(node.output).name.clone();
            Some(NodeMacs { name, op: node.op.into(), macs })
        })
        .collect()
}

/// Every operation of a model file that multiplies, in order. Shapes are inferred from those of the
/// inputs and initialisers; weights themselves are not needed, so external data may be absent.
///
/// # Errors
/// Names the first operation whose shape cannot be told: one that the exporter does not write, or
/// one whose target shape is not a constant of the file.
pub fn count_model(model: &ModelProto) -> Result<Vec<NodeMacs>, ShapeError> {
    let Some(graph) = &model.graph else { return Ok(Vec::new()) };
    let known = shapes::infer(graph)?;
    let mut counted = Vec::new();
    for node in &graph.node {
        let (Some(op), Some(output)) = (&node.op_type, node.output.first()) else { continue };
        let Some(found) = known.get(output.as_str()).filter(|s| !s.fixed) else { continue };
        let dims = |i: usize| Some(&known.get(node.input.get(i)?.as_str())?.dims[..]);
        let (Some(x), Some(y)) = (dims(0), dims(1)) else { continue };
        if let Some(macs) = products(op, x, y, &found.dims, transposed(node)) {
            counted.push(NodeMacs { name: output.clone(), op: op.clone(), macs });
        }
    }
    Ok(counted)
}

/// Shapes of all tensors of a model file, by name.
///
/// # Errors
/// As [`count_model`].
pub fn shapes(graph: &GraphProto) -> Result<HashMap<String, Vec<usize>>, ShapeError> {
    let known = shapes::infer(graph)?;
    Ok(known.into_iter().map(|(name, shape)| (name.to_owned(), shape.dims)).collect())
}

fn transposed(node: &NodeProto) -> bool {
    node.attribute.iter().any(|a| a.name.as_deref() == Some("transA") && a.i == Some(1))
}

/// Multiply-accumulates of an operator on operands `x` and `y`; `None` for one that does not
/// multiply. `transposed` is the `transA` of a `Gemm`.
fn products(op: &str, x: &[usize], y: &[usize], out: &[usize], transposed: bool) -> Option<u64> {
    let count = |dims: &[usize]| dims.iter().fold(1u64, |n, side| n.saturating_mul(*side as u64));
    let (elements, each) = match op {
        // (out, in / groups, kernel ..): what one output element reads.
        "Conv" => (count(out), count(y.get(1..)?)),
        // (in, out / groups, kernel ..): what one input element is spread to.
        "ConvTranspose" => (count(x), count(y.get(1..)?)),
        "MatMul" => (count(out), *x.last()? as u64),
        "Gemm" => (count(out), *x.get(usize::from(!transposed))? as u64),
        _ => return None,
    };
    Some(elements.saturating_mul(each))
}

/// The layer an operation belongs to: its name up to the slash.
pub fn layer(name: &str) -> &str {
    name.split_once('/').map_or(name, |(layer, _)| layer)
}

impl Node {
    /// Whether it is an operation that [`count`] counts.
    pub fn multiplies(&self) -> bool {
        matches!(self.op, "Conv" | "ConvTranspose" | "MatMul" | "Gemm")
    }
}
