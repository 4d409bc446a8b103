//! Operations without effect, chains of moves, repeated computations.

use super::super::graph::{Attribute, Data, Graph, Node, ValueId};
use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};

/// Removes reshapes, expansions, transpositions, slices and arithmetic that change nothing, and
/// joins chains of reshapes and of transpositions.
pub(super) fn no_ops(graph: &mut Graph) -> bool {
    let mut changed = false;
    let mut i = 0;
    while i < graph.nodes.len() {
        let same = passes_through(graph, &graph.nodes[i]);
        if same.is_some_and(|input| remove(graph, i, input)) {
            changed = true;
            continue;
        }
        changed |= join_with_source(graph, i) | read_unexpanded(graph, i);
        i += 1;
    }
    changed
}

/// The input that the node's output equals, if there is one.
fn passes_through(graph: &Graph, node: &Node) -> Option<ValueId> {
    let x = node.input(0)?;
    let same = graph.dims(x) == graph.dims(node.output)
        && graph.value(x).elem == graph.value(node.output).elem;
    if !same {
        return None;
    }
    let scalar = |input: Option<ValueId>| match graph.constant(input?)? {
        Data::F32(v) if v.len() == 1 => Some(v[0]),
        _ => None,
    };
    let nothing = match node.op {
        "Identity" | "Reshape" | "Expand" | "Tile" | "Slice" | "Cast" => {
            // A slice with a negative step keeps the shape and turns the order.
            let steps = node.input(4).and_then(|s| graph.constant(s)).and_then(Data::i64s);
            steps.is_none_or(|s| s.iter().all(|v| *v > 0))
        }
        "Concat" => node.inputs.len() == 1,
        "Transpose" => {
            node.ints("perm").is_some_and(|p| p.iter().enumerate().all(|(i, v)| i as i64 == *v))
        }
        "Mul" | "Div" => scalar(node.input(1)) == Some(1.0),
        "Add" | "Sub" => scalar(node.input(1)) == Some(0.0),
        _ => false,
    };
    nothing.then_some(x)
}

/// Takes node `i`, whose output equals `input`, out of the graph. An output of the graph has to be
/// written by some node, so there the source writes it directly where it can.
fn remove(graph: &mut Graph, i: usize, input: ValueId) -> bool {
    let output = graph.nodes[i].output;
    if !graph.is_output(output) {
        graph.redirect(output, input);
        graph.nodes.remove(i);
        return true;
    }
    let source = graph.nodes.iter().position(|n| n.output == input);
    let Some(source) = source.filter(|_| !graph.is_output(input)) else { return false };
    if graph.constant(input).is_some() {
        return false;
    }
    graph.nodes[source].output = output;
    graph.redirect(input, output);
    graph.nodes.remove(i);
    true
}

/// `Reshape(Reshape(x))` reads `x`; `Transpose(Transpose(x))` becomes one.
fn join_with_source(graph: &mut Graph, i: usize) -> bool {
    let node = &graph.nodes[i];
    let Some(input) = node.input(0) else { return false };
    let Some(source) = graph.nodes[..i].iter().find(|n| n.output == input) else { return false };
    let Some(origin) = source.input(0) else { return false };
    match (node.op, source.op) {
        ("Reshape", "Reshape") => {
            graph.nodes[i].inputs[0] = Some(origin);
            true
        }
        ("Transpose", "Transpose") => {
            let (Some(outer), Some(inner)) = (node.ints("perm"), source.ints("perm")) else {
                return false;
            };
            let perm = outer.iter().map(|axis| inner[*axis as usize]).collect();
            graph.nodes[i].inputs[0] = Some(origin);
            graph.nodes[i].attributes = vec![("perm", Attribute::Ints(perm))];
            true
        }
        _ => false,
    }
}

/// Arithmetic broadcasts by itself: it reads what an `Expand` reads, if the shape stays the same.
fn read_unexpanded(graph: &mut Graph, i: usize) -> bool {
    let node = &graph.nodes[i];
    if !matches!(node.op, "Add" | "Sub" | "Mul" | "Div") {
        return false;
    }
    let mut replaced = None;
    for (slot, input) in node.inputs.iter().enumerate() {
        let other = node.input(1 - slot.min(1));
        let Some((expand, other)) = graph.nodes[..i]
            .iter()
            .find(|n| Some(n.output) == *input && n.op == "Expand")
            .zip(other)
        else {
            continue;
        };
        let Some(origin) = expand.input(0) else { continue };
        if broadcast_dims(graph.dims(origin), graph.dims(other)).as_deref()
            == Some(graph.dims(node.output))
        {
            replaced = Some((slot, origin));
            break;
        }
    }
    let Some((slot, origin)) = replaced else { return false };
    graph.nodes[i].inputs[slot] = Some(origin);
    true
}

/// Products with a constant matrix read it as a plain matrix: engines know that form best.
pub(super) fn plain_matrices(graph: &mut Graph) -> bool {
    let uses = graph.uses();
    let mut copies: HashMap<ValueId, ValueId> = HashMap::new();
    let mut changed = false;
    for i in 0..graph.nodes.len() {
        let node = &graph.nodes[i];
        if node.op != "MatMul" {
            continue;
        }
        let (Some(lhs), Some(rhs)) = (node.input(0), node.input(1)) else { continue };
        let dims = graph.dims(rhs);
        let stacked = dims.len() > 2 && dims[..dims.len() - 2].iter().all(|side| *side == 1);
        if !stacked || graph.dims(lhs).len() < dims.len() {
            continue;
        }
        let matrix = dims[dims.len() - 2..].to_vec();
        let Some(data) = graph.constant(rhs) else { continue };
        if uses.get(&rhs) == Some(&1) {
            graph.set_dims(rhs, &matrix);
        } else {
            let copy = match copies.get(&rhs) {
                Some(copy) => *copy,
                None => {
                    let (data, name) = (data.clone(), graph.value(rhs).name.clone());
                    graph.add_constant(&name, &matrix, data)
                }
            };
            copies.insert(rhs, copy);
            graph.nodes[i].inputs[1] = Some(copy);
        }
        changed = true;
    }
    changed
}

/// Shape of two tensors broadcast against each other.
fn broadcast_dims(a: &[usize], b: &[usize]) -> Option<Vec<usize>> {
    let rank = a.len().max(b.len());
    let side = |d: &[usize], axis: usize| {
        let missing = rank - d.len();
        if axis < missing { 1 } else { d[axis - missing] }
    };
    (0..rank)
        .map(|axis| match (side(a, axis), side(b, axis)) {
            (x, y) if x == y || y == 1 => Some(x),
            (1, y) => Some(y),
            _ => None,
        })
        .collect()
}

/// Computes equal expressions once, and keeps equal constants once.
pub(super) fn join_equal(graph: &mut Graph) -> bool {
    let constants = join_constants(graph);
    join_nodes(graph) | constants
}

fn join_constants(graph: &mut Graph) -> bool {
    let mut kept: HashMap<(Vec<usize>, u64), Vec<ValueId>> = HashMap::new();
    let mut joined = Vec::new();
    for id in graph.initialisers() {
        let Some(data) = graph.constant(id) else { continue };
        let mut hasher = DefaultHasher::new();
        match data {
            Data::F32(v) => v.iter().for_each(|v| v.to_bits().hash(&mut hasher)),
            Data::I64(v) => v.hash(&mut hasher),
            Data::Bool(v) => v.hash(&mut hasher),
        }
        let alike = kept.entry((graph.dims(id).to_vec(), hasher.finish())).or_default();
        match alike.iter().find(|first| graph.constant(**first).is_some_and(|d| d.same_as(data))) {
            Some(first) => joined.push((id, *first)),
            None => alike.push(id),
        }
    }
    for (later, first) in &joined {
        graph.redirect(*later, *first);
    }
    !joined.is_empty()
}

fn join_nodes(graph: &mut Graph) -> bool {
    let mut same: HashMap<ValueId, ValueId> = HashMap::new();
    let mut seen: HashMap<String, ValueId> = HashMap::new();
    let mut joined = Vec::new();
    for node in &graph.nodes {
        let of = |id: ValueId| same.get(&id).copied().unwrap_or(id);
        let inputs: Vec<_> = node.inputs.iter().map(|i| i.map(of)).collect();
        // The shape tells apart a Reshape to [4, 1] from one to [1, 4] even if its input is large.
        let key =
            format!("{} {inputs:?} {:?} {:?}", node.op, node.attributes, graph.dims(node.output));
        if let Some(first) = seen.get(&key) {
            if !graph.is_output(node.output) {
                joined.push((node.output, *first));
                same.insert(node.output, *first);
            }
        } else {
            seen.insert(key, node.output);
        }
    }
    for (later, first) in &joined {
        graph.redirect(*later, *first);
    }
    graph.nodes.retain(|n| !joined.iter().any(|(later, _)| *later == n.output));
    !joined.is_empty()
}
