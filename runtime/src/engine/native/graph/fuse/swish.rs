//! Hard-swish, written out as a hard sigmoid and a product, and the gate of a squeeze-excite in front
//! of it: one pass over the map each.

use super::{Trace, sweep};
use crate::engine::native::graph::{Binary, Graph, Op, Unary, ValueId};

/// Joins both forms.
pub(super) fn fuse(graph: &mut Graph<'_>) {
    written_out(graph);
    sweep(graph);
    gated(graph);
}

/// `x * HardSigmoid(x)`.
fn written_out(graph: &mut Graph<'_>) {
    // A sixth, rounded by whoever wrote the file.
    let close = |a: f32, b: f32| (a - b).abs() <= 1e-7;
    let trace = Trace::new(graph);
    let sigmoid_of = |id: ValueId| {
        let node = trace.maker(id)?;
        match node.op {
            Op::Unary(Unary::HardSigmoid(a, b)) if close(a, 1.0 / 6.0) && close(b, 0.5) => {
                Some(node.inputs[0])
            }
            _ => None,
        }
    };
    let found: Vec<(usize, ValueId)> = (graph.nodes.iter().enumerate())
        .filter(|(_, node)| node.op == Op::Binary(Binary::Mul))
        .filter_map(|(i, node)| {
            let [a, b] = *node.inputs else { return None };
            if sigmoid_of(b) == Some(a) {
                Some((i, a))
            } else {
                (sigmoid_of(a) == Some(b)).then_some((i, b))
            }
        })
        .collect();
    for (i, x) in found {
        graph.nodes[i].op = Op::Unary(Unary::HardSwish);
        graph.nodes[i].inputs = vec![x];
    }
}

/// Hard-swish of a product nothing else uses.
fn gated(graph: &mut Graph<'_>) {
    let uses = graph.uses();
    let trace = Trace::new(graph);
    let found: Vec<(usize, Vec<ValueId>)> = (graph.nodes.iter().enumerate())
        .filter(|(_, node)| node.op == Op::Unary(Unary::HardSwish))
        .filter_map(|(i, node)| {
            let x = node.inputs[0];
            let [a, b] = trace.binary(x, Binary::Mul).filter(|_| uses[x] == 1)?;
            Some((i, vec![a, b]))
        })
        .collect();
    for (i, inputs) in found {
        graph.nodes[i].op = Op::Binary(Binary::MulHardSwish);
        graph.nodes[i].inputs = inputs;
    }
}
