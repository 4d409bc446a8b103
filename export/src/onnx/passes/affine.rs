//! Batch norm, per-channel scales and shifts, and zero padding into convolutions and products.

use super::super::graph::{Attribute, Data, Graph, Node, ValueId};

/// What a node after a convolution does to channel `c`: `y = scale[c] * x + shift[c]`.
struct PerChannel {
    scale: Vec<f64>,
    shift: Vec<f64>,
}

/// Folds the first scale or shift that directly and alone follows a convolution into its weights.
pub(super) fn into_convolutions(graph: &mut Graph) -> bool {
    let uses = graph.uses();
    let mut changed = false;
    let mut i = 0;
    while i < graph.nodes.len() {
        match fold_one(graph, i, &uses) {
            Some((at, conv, output)) => {
                graph.nodes[at] = Node { output, ..conv };
                graph.nodes.remove(i);
                changed = true;
            }
            None => i += 1,
        }
    }
    changed
}

/// The convolution (its place and its new form, writing the last element) that node `i` goes into.
fn fold_one(
    graph: &mut Graph,
    i: usize,
    uses: &std::collections::HashMap<ValueId, usize>,
) -> Option<(usize, Node, ValueId)> {
    let node = &graph.nodes[i];
    let (source, effect) = [0, 1].into_iter().find_map(|slot| {
        let at = node.input(slot)?;
        let source = graph.nodes[..i].iter().position(|n| n.output == at && n.op == "Conv")?;
        let alone = uses.get(&at) == Some(&1);
        let effect = alone.then(|| effect(graph, node, slot)).flatten()?;
        Some((source, effect))
    })?;
    let mut conv = graph.nodes[source].clone();
    let output = node.output;
    let weight_id = conv.input(1)?;
    let dims = graph.dims(weight_id).to_vec();
    let channels = *dims.first()?;
    let weight = graph.constant(weight_id)?.f32s()?;
    let bias = match conv.input(2) {
        Some(bias) => graph.constant(bias)?.f32s()?.to_vec(),
        None => vec![0.0; channels],
    };
    if effect.scale.len() != channels || bias.len() != channels {
        return None;
    }
    let per = weight.len() / channels.max(1);
    let scaled = (weight.iter().enumerate())
        .map(|(j, w)| (f64::from(*w) * effect.scale[j / per]) as f32)
        .collect();
    let shifted: Vec<f32> = (bias.iter().enumerate())
        .map(|(c, b)| (f64::from(*b) * effect.scale[c] + effect.shift[c]) as f32)
        .collect();
    let name = graph.value(weight_id).name.clone();
    let base = name.strip_suffix("weight").map(str::to_owned).unwrap_or(format!("{name}."));
    let weight = graph.add_constant(&format!("{base}weight.folded"), &dims, Data::F32(scaled));
    let bias = graph.add_constant(&format!("{base}bias.folded"), &[channels], Data::F32(shifted));
    conv.inputs = vec![conv.input(0), Some(weight), Some(bias)];
    Some((source, conv, output))
}

/// What `node` does to each channel of its input `slot`, if it does only that.
fn effect(graph: &Graph, node: &Node, slot: usize) -> Option<PerChannel> {
    let channels = *graph.dims(node.output).get(1)?;
    if node.op == "BatchNormalization" {
        if slot != 0 {
            return None;
        }
        let list = |i: usize| graph.constant(node.input(i)?)?.f32s();
        let (gamma, beta, mean, var) = (list(1)?, list(2)?, list(3)?, list(4)?);
        if [gamma, beta, mean, var].iter().any(|v| v.len() != channels) {
            return None;
        }
        let epsilon = f64::from(node.float("epsilon")?);
        let scale: Vec<f64> = (0..channels)
            .map(|c| f64::from(gamma[c]) / (f64::from(var[c]) + epsilon).sqrt())
            .collect();
        let shift =
            (0..channels).map(|c| f64::from(beta[c]) - f64::from(mean[c]) * scale[c]).collect();
        return Some(PerChannel { scale, shift });
    }
    let operand = per_channel(graph, node.input(1 - slot)?, graph.dims(node.output))?;
    let (ones, zeros) = (vec![1.0; channels], vec![0.0; channels]);
    Some(match (node.op, slot) {
        ("Mul", _) => PerChannel { scale: operand, shift: zeros },
        ("Div", 0) => PerChannel { scale: operand.iter().map(|v| 1.0 / v).collect(), shift: zeros },
        ("Add", _) => PerChannel { scale: ones, shift: operand },
        ("Sub", 0) => PerChannel { scale: ones, shift: operand.iter().map(|v| -v).collect() },
        ("Sub", _) => PerChannel { scale: vec![-1.0; channels], shift: operand },
        _ => return None,
    })
}

/// A constant operand as one number per channel (second axis) of a tensor of shape `out`.
fn per_channel(graph: &Graph, id: ValueId, out: &[usize]) -> Option<Vec<f64>> {
    let (dims, values) = (graph.dims(id), graph.constant(id)?.f32s()?);
    let channels = *out.get(1)?;
    if values.len() == 1 && dims.len() <= out.len() {
        return Some(vec![f64::from(values[0]); channels]);
    }
    // All sides 1 but the channels', counted from the right as broadcasting does.
    let axis = dims.len().checked_sub(out.len() - 1)?;
    let others = dims.iter().enumerate().all(|(i, side)| i == axis || *side == 1);
    (others && dims.get(axis) == Some(&channels) && values.len() == channels)
        .then(|| values.iter().map(|v| f64::from(*v)).collect())
}

/// Folds batch norm behind `x W + b` (tokens by channels) into `W` and `b`.
pub(super) fn into_products(graph: &mut Graph) -> bool {
    let uses = graph.uses();
    let mut changed = false;
    for i in 0..graph.nodes.len() {
        if let Some((product, weight, bias)) = product_and_bias(graph, i, &uses) {
            graph.nodes[product].inputs[1] = Some(weight);
            // The norm's place becomes the sum's; the sum, now unread, goes as dead.
            let read = Some(graph.nodes[product].output);
            let output = graph.nodes[i].output;
            graph.nodes[i] =
                Node { op: "Add", inputs: vec![read, Some(bias)], output, attributes: vec![] };
            changed = true;
        }
    }
    changed
}

/// For a batch norm at `i` behind a biased product: the product, its new matrix and bias.
fn product_and_bias(
    graph: &mut Graph,
    i: usize,
    uses: &std::collections::HashMap<ValueId, usize>,
) -> Option<(usize, ValueId, ValueId)> {
    let node = &graph.nodes[i];
    if node.op != "BatchNormalization" || graph.dims(node.output).len() != 2 {
        return None;
    }
    let effect = effect(graph, node, 0)?;
    let channels = effect.scale.len();
    let source = |id: ValueId, op: &str| {
        let at = graph.nodes[..i].iter().position(|n| n.output == id && n.op == op)?;
        (uses.get(&id) == Some(&1)).then_some(at)
    };
    let sum = &graph.nodes[source(node.input(0)?, "Add")?];
    let slot = [0, 1]
        .into_iter()
        .find(|s| sum.input(1 - s).is_some_and(|b| graph.constant(b).is_some()))?;
    let product = source(sum.input(slot)?, "MatMul")?;
    let bias = graph.constant(sum.input(1 - slot)?)?.f32s()?;
    let weight_id = graph.nodes[product].input(1)?;
    let (dims, weight) = (graph.dims(weight_id).to_vec(), graph.constant(weight_id)?.f32s()?);
    if dims.len() != 2 || dims[1] != channels || bias.len() != channels {
        return None;
    }
    let scaled = (weight.iter().enumerate())
        .map(|(j, w)| (f64::from(*w) * effect.scale[j % channels]) as f32)
        .collect();
    let shifted = (bias.iter().enumerate())
        .map(|(c, b)| (f64::from(*b) * effect.scale[c] + effect.shift[c]) as f32)
        .collect();
    let name = format!("{}.folded", graph.value(weight_id).name);
    let weight = graph.add_constant(&name, &dims, Data::F32(scaled));
    let name = name.replace("weight.folded", "bias.folded");
    let bias = graph.add_constant(&name, &[channels], Data::F32(shifted));
    Some((product, weight, bias))
}

/// Zero padding of the spatial sides that only convolutions read becomes their own.
pub(super) fn padding_into_convolutions(graph: &mut Graph) -> bool {
    let mut changed = false;
    for i in (0..graph.nodes.len()).rev() {
        if let Some((input, pads)) = zero_padding(graph, i) {
            let output = graph.nodes[i].output;
            for node in graph.nodes.iter_mut().filter(|n| n.input(0) == Some(output)) {
                node.inputs[0] = Some(input);
                for (name, value) in &mut node.attributes {
                    if let (&mut "pads", Attribute::Ints(own)) = (name, value) {
                        own.iter_mut().zip(&pads).for_each(|(own, more)| *own += more);
                    }
                }
            }
            graph.nodes.remove(i);
            changed = true;
        }
    }
    changed
}

/// Input and spatial pads (begins, then ends) of node `i`, if it can go into its readers.
fn zero_padding(graph: &Graph, i: usize) -> Option<(ValueId, Vec<i64>)> {
    let node = &graph.nodes[i];
    if node.op != "Pad" || graph.is_output(node.output) {
        return None;
    }
    let zero = graph.constant(node.input(2)?)?.f32s()? == [0.0];
    let pads = graph.constant(node.input(1)?)?.i64s()?;
    let rank = pads.len() / 2;
    let readers: Vec<&Node> =
        graph.nodes.iter().filter(|n| n.inputs.contains(&Some(node.output))).collect();
    let fits = zero
        && rank > 2
        && pads.iter().all(|p| *p >= 0)
        && [pads[0], pads[1], pads[rank], pads[rank + 1]] == [0; 4]
        && !readers.is_empty()
        && readers.iter().all(|n| n.op == "Conv" && n.input(0) == Some(node.output));
    fits.then(|| {
        let spatial = pads[2..rank].iter().chain(&pads[rank + 2..]).copied().collect();
        node.input(0).map(|input| (input, spatial))
    })?
}
