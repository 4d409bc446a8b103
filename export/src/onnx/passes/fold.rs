//! Constant folding.

use super::super::eval::evaluate;
use super::super::graph::{Graph, ValueId};
use std::collections::HashSet;

/// A result of more elements than this that is also larger than its inputs is left to be computed
/// by the engine (4 MiB of f32).
const LARGEST: usize = 1 << 20;

/// Computes nodes whose inputs are all constant.
///
/// Operations that only repeat their inputs stay nodes when folding them would make the file
/// larger: their value is known to what follows, but where it is read directly it is computed when
/// the model is loaded.
pub(super) fn constants(graph: &mut Graph) -> bool {
    let uses = graph.uses();
    let mut changed = false;
    let mut i = 0;
    while i < graph.nodes.len() {
        let node = &graph.nodes[i];
        let output = node.output;
        let size: usize = graph.dims(output).iter().product();
        let open = graph.constant(output).is_none() && !graph.is_output(output);
        let inputs: HashSet<ValueId> = node.inputs.iter().flatten().copied().collect();
        let held: usize = inputs.iter().map(|v| graph.dims(*v).iter().product::<usize>()).sum();
        if !open || size > LARGEST.max(held) {
            i += 1;
            continue;
        }
        let Some(data) = evaluate(graph, node) else {
            i += 1;
            continue;
        };
        let repeats = matches!(node.op, "Expand" | "Tile" | "Concat") && size > held.max(64);
        // A reshaped weight keeps its name.
        let renamed = (node.op == "Reshape").then(|| node.input(0)).flatten();
        if let Some(source) = renamed.filter(|id| uses.get(id) == Some(&1)) {
            graph.swap_names(source, output);
        }
        graph.set_constant(output, data);
        changed = true;
        if repeats {
            i += 1;
        } else {
            graph.nodes.remove(i);
        }
    }
    changed
}
