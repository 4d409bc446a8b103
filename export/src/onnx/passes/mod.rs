//! Simplifications that leave the numbers as they are (up to float rounding).

mod affine;
mod cleanup;
mod fold;

use super::graph::{Graph, ValueId};
use std::collections::HashSet;

/// Simplifies until nothing changes: computes constant parts, folds scales and shifts (batch norm)
/// into convolutions and matrix products, and padding into windows, drops operations without effect
/// and what no output needs, joins equal computations.
pub fn optimise(graph: &mut Graph) {
    let passes: [fn(&mut Graph) -> bool; 8] = [
        remove_dead,
        // Before folding, so that what several places compute from weights stays one constant.
        cleanup::join_equal,
        fold::constants,
        cleanup::no_ops,
        affine::into_convolutions,
        affine::into_products,
        affine::padding_into_convolutions,
        cleanup::plain_matrices,
    ];
    // Every pass that reports a change has made the graph smaller or a value constant.
    while passes.iter().fold(false, |changed, pass| pass(graph) | changed) {}
    remove_dead(graph);
}

/// Drops nodes that no output needs.
fn remove_dead(graph: &mut Graph) -> bool {
    let mut wanted: HashSet<ValueId> = graph.outputs.iter().map(|p| p.value).collect();
    let mut keep = vec![false; graph.nodes.len()];
    for (i, node) in graph.nodes.iter().enumerate().rev() {
        if wanted.contains(&node.output) {
            keep[i] = true;
            wanted.extend(node.inputs.iter().flatten());
        }
    }
    let before = graph.nodes.len();
    let mut kept = keep.into_iter();
    graph.nodes.retain(|_| kept.next() == Some(true));
    graph.nodes.len() != before
}
