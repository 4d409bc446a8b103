//! Groups of operators that are cheaper as one: attention, normalisation of a whole map,
//! hard-swish, and what follows a product (bias, residual, hard-swish, limits). Whatever does not
//! match stays as it is.

mod swish;

use super::{Binary, Graph, Node, Op, Post, Reduce, UNLIMITED, Unary, ValueId};

/// Joins what can be joined and drops what nothing needs.
pub fn fuse(graph: &mut Graph<'_>) {
    attention(graph);
    map_norms(graph);
    swish::fuse(graph);
    sweep(graph);
    followers(graph);
    sweep(graph);
    repeated(graph);
    sweep(graph);
}

/// Index of the node that makes a value.
fn makers(graph: &Graph<'_>) -> Vec<Option<usize>> {
    let mut makers = vec![None; graph.values.len()];
    for (i, node) in graph.nodes.iter().enumerate() {
        makers[node.output] = Some(i);
    }
    makers
}

/// Removes nodes whose result nothing needs.
fn sweep(graph: &mut Graph<'_>) {
    let mut needed = vec![false; graph.values.len()];
    for &id in &graph.outputs {
        needed[id] = true;
    }
    let mut keep = vec![false; graph.nodes.len()];
    for (i, node) in graph.nodes.iter().enumerate().rev() {
        if needed[node.output] {
            keep[i] = true;
            node.operands().for_each(|id| needed[id] = true);
        }
    }
    let mut keep = keep.into_iter();
    graph.nodes.retain(|_| keep.next().unwrap_or(false));
}

/// Walks from results to what they were made of.
struct Trace<'g, 'a> {
    graph: &'g Graph<'a>,
    makers: Vec<Option<usize>>,
}

impl<'g, 'a> Trace<'g, 'a> {
    fn new(graph: &'g Graph<'a>) -> Self {
        Self { graph, makers: makers(graph) }
    }

    fn maker(&self, id: ValueId) -> Option<&'g Node> {
        self.makers[id].map(|i| &self.graph.nodes[i])
    }

    /// Operand of the unary node that made `id`.
    fn unary(&self, id: ValueId, op: Unary) -> Option<ValueId> {
        self.maker(id).filter(|n| n.op == Op::Unary(op)).map(|n| n.inputs[0])
    }

    /// Operands of the binary node that made `id`.
    fn binary(&self, id: ValueId, op: Binary) -> Option<[ValueId; 2]> {
        let node = self.maker(id).filter(|n| n.op == Op::Binary(op))?;
        Some([node.inputs[0], node.inputs[1]])
    }

    /// The other operand and the number, if `id` is a tensor combined with a constant number.
    fn with_scalar(&self, id: ValueId, op: Binary) -> Option<(ValueId, f32)> {
        let [a, b] = self.binary(id, op)?;
        let right = self.graph.scalar(b).map(|s| (a, s));
        right.or_else(|| self.graph.scalar(a).map(|s| (b, s))).filter(|&(x, _)| {
            // A number can have several dimensions of size one; then the shape may change.
            self.graph.shape(x) == self.graph.shape(id)
        })
    }

    fn reshaped(&self, id: ValueId) -> Option<ValueId> {
        self.maker(id).filter(|n| n.op == Op::Reshape).map(|n| n.inputs[0])
    }

    /// Operand of a reduction of everything to one number, in one step or dimension by dimension.
    fn reduced(&self, id: ValueId, kind: Reduce) -> Option<ValueId> {
        if self.graph.shape(id).iter().any(|&n| n != 1) {
            return None;
        }
        let step = |id: ValueId| {
            let node = self.maker(id)?;
            matches!(&node.op, Op::Reduce { kind: k, .. } if *k == kind).then(|| node.inputs[0])
        };
        let mut operand = step(id)?;
        while let Some(before) = step(operand) {
            operand = before;
        }
        Some(operand)
    }

    /// The tensor and the constant, if `id` is a tensor combined with one number per channel of a map.
    fn with_channels(&self, id: ValueId, op: Binary) -> Option<(ValueId, ValueId)> {
        let [a, b] = self.binary(id, op)?;
        [(a, b), (b, a)].into_iter().find(|&(x, c)| {
            self.graph.shape(x) == self.graph.shape(id) && per_channel(self.graph, c, id, true)
        })
    }

    fn squared(&self, id: ValueId) -> Option<ValueId> {
        self.binary(id, Binary::Mul).filter(|[a, b]| a == b).map(|[a, _]| a)
    }
}

/// `softmax(scale * q kt) v`.
fn attention(graph: &mut Graph<'_>) {
    let uses = graph.uses();
    let trace = Trace::new(graph);
    let mut found = Vec::new();
    for (i, node) in graph.nodes.iter().enumerate() {
        let plain = |n: &&Node| n.op == Op::MatMul { post: Post::default() };
        let matched = || {
            let second = Some(node).filter(plain)?;
            let softmax = trace.maker(second.inputs[0]).filter(|n| n.op == Op::Softmax)?;
            let mut logits = softmax.inputs[0];
            let (mut scale, once) = (1.0, |id: ValueId| uses[id] == 1);
            if let Some((inner, s)) =
                trace.with_scalar(logits, Binary::Mul).filter(|_| once(logits))
            {
                (logits, scale) = (inner, s);
            }
            let first = trace.maker(logits).filter(plain)?;
            if !(once(softmax.output) && once(first.output)) {
                return None;
            }
            let (mut q, kt, v) = (first.inputs[0], first.inputs[1], second.inputs[1]);
            if let Some((inner, s)) = trace.with_scalar(q, Binary::Mul) {
                (q, scale) = (inner, scale * s);
            }
            let batch = |id: ValueId| {
                let shape = graph.shape(id);
                &shape[..shape.len() - 2]
            };
            (batch(q) == batch(kt) && batch(q) == batch(v)).then(|| (vec![q, kt, v], scale))
        };
        if let Some((inputs, scale)) = matched() {
            found.push((i, inputs, scale));
        }
    }
    for (i, inputs, scale) in found {
        graph.nodes[i].op = Op::Attention { scale };
        graph.nodes[i].inputs = inputs;
    }
}

/// Normalisation over all elements of a map, written out as reductions of a reshaped map; gain and
/// offset may come before it gets its shape back.
fn map_norms(graph: &mut Graph<'_>) {
    let trace = Trace::new(graph);
    let mut found = Vec::new();
    for (i, node) in graph.nodes.iter().enumerate() {
        let [1, channels, _, _] = *graph.shape(node.output) else { continue };
        let matched = || {
            let mut x = trace.reshaped(node.output)?;
            let mut inputs = Vec::new();
            if graph.shape(x).get(1) == Some(&channels) {
                let offset = trace.with_channels(x, Binary::Add);
                let scaled = offset.map_or(x, |(scaled, _)| scaled);
                if let Some((inner, gain)) = trace.with_channels(scaled, Binary::Mul) {
                    x = inner;
                    inputs.extend([Some(gain), offset.map(|(_, c)| c)].into_iter().flatten());
                }
            }
            let (source, op) = centred(&trace, x).or_else(|| scaled(&trace, x))?;
            inputs.insert(0, source);
            (graph.shape(source) == graph.shape(node.output)).then_some((inputs, op))
        };
        if let Some((inputs, op)) = matched() {
            found.push((i, inputs, op));
        }
    }
    for (i, inputs, op) in found {
        graph.nodes[i].op = op;
        graph.nodes[i].inputs = inputs;
    }
}

/// `d / sqrt(mean(d^2) + epsilon)`, as quotient or as product with the reciprocal, `d = r - mean(r)`,
/// `r` the reshaped map.
fn centred(trace: &Trace<'_, '_>, id: ValueId) -> Option<(ValueId, Op)> {
    let product = || {
        let [a, b] = trace.binary(id, Binary::Mul)?;
        let inverse = |d, r| trace.unary(r, Unary::Reciprocal).map(|root| [d, root]);
        inverse(a, b).or_else(|| inverse(b, a))
    };
    let [d, deviation] = trace.binary(id, Binary::Div).or_else(product)?;
    let (variance, epsilon) =
        trace.with_scalar(trace.unary(deviation, Unary::Sqrt)?, Binary::Add)?;
    if trace.squared(trace.reduced(variance, Reduce::Mean)?)? != d {
        return None;
    }
    let [r, mean] = trace.binary(d, Binary::Sub)?;
    if trace.reduced(mean, Reduce::Mean)? != r {
        return None;
    }
    let op = Op::MapNorm { epsilon, centre: true, factor: 1.0, clamp: UNLIMITED };
    Some((trace.reshaped(r)?, op))
}

/// `r * (factor / sqrt(sum(r^2) + epsilon))`, `r` the reshaped map.
fn scaled(trace: &Trace<'_, '_>, id: ValueId) -> Option<(ValueId, Op)> {
    let [r, mut scale] = trace.binary(id, Binary::Mul)?;
    let mut factor = 1.0;
    if let Some((inner, f)) = trace.with_scalar(scale, Binary::Mul) {
        (scale, factor) = (inner, f);
    }
    let root = trace.unary(trace.unary(scale, Unary::Reciprocal)?, Unary::Sqrt)?;
    let (sum, epsilon) = trace.with_scalar(root, Binary::Add)?;
    if trace.squared(trace.reduced(sum, Reduce::Sum)?)? != r {
        return None;
    }
    let op = Op::MapNorm { epsilon, centre: false, factor, clamp: UNLIMITED };
    Some((trace.reshaped(r)?, op))
}

/// Whether a constant has one number per channel of a value: along dimension 1 of a map, the last
/// one of anything else.
fn per_channel(graph: &Graph<'_>, constant: ValueId, of: ValueId, map: bool) -> bool {
    let (shape, to) = (graph.shape(constant), graph.shape(of));
    if !graph.is_constant(constant) || shape.len() > to.len() {
        return false;
    }
    let channel = if map { 1 } else { to.len() - 1 };
    let missing = to.len() - shape.len();
    channel >= missing
        && shape
            .iter()
            .enumerate()
            .all(|(i, &n)| n == if i + missing == channel { to[channel] } else { 1 })
}

/// Bias, residual, hard-swish and limits into the product before them.
fn followers(graph: &mut Graph<'_>) {
    let uses = graph.uses();
    let mut consumer = vec![None; graph.values.len()];
    for (i, node) in graph.nodes.iter().enumerate() {
        node.operands().for_each(|id| consumer[id] = Some(i));
    }
    for i in 0..graph.nodes.len() {
        let mut at = i;
        loop {
            let out = graph.nodes[at].output;
            if uses[out] != 1 || graph.outputs.contains(&out) {
                break;
            }
            let Some(next) = consumer[out] else { break };
            let Some((op, inputs)) = absorbed(graph, at, next) else { break };
            // The joined node stands where the later one stood, so all its operands exist.
            let name = core::mem::take(&mut graph.nodes[at].name);
            graph.nodes[next] = Node { name, op, inputs, output: graph.nodes[next].output };
            // What is left behind makes a value that nothing uses.
            graph.nodes[at].op = Op::Reshape;
            graph.nodes[at].inputs.truncate(1);
            at = next;
        }
    }
}

/// A constant that is added to every block of a product's rows, cut into blocks for it, becomes the
/// residual of the product: what positions add to the queries, keys and values of all templates.
fn repeated(graph: &mut Graph<'_>) {
    let uses = graph.uses();
    let trace = Trace::new(graph);
    let single = |id: ValueId| uses[id] == 1 && !graph.outputs.contains(&id);
    let mut found = Vec::new();
    for (i, node) in graph.nodes.iter().enumerate().filter(|(_, n)| n.op == Op::Binary(Binary::Add))
    {
        let sum = graph.shape(node.output);
        let [.., width] = *sum else { continue };
        for (x, added) in [(0, 1), (1, 0)].map(|(x, c)| (node.inputs[x], node.inputs[c])) {
            let block = graph.shape(added);
            // Whole dimensions, and before them nothing but ones.
            let lead = block.iter().take_while(|&&n| n == 1).count();
            let whole = sum.len() >= block.len() - lead && sum.ends_with(&block[lead..]);
            let cut = trace.maker(x).filter(|n| n.op == Op::Reshape && single(x));
            let Some(product) = cut.map(|n| n.inputs[0]).filter(|&id| single(id)) else { continue };
            let Some(at) = trace.makers[product] else { continue };
            let Op::MatMul { post } = &graph.nodes[at].op else { continue };
            let free = post.residual.is_none() && !post.swish && post.clamp == UNLIMITED;
            let matrix = graph.nodes[at].inputs[1];
            let rows = graph.is_constant(matrix) && graph.shape(matrix).len() == 2;
            let wide = graph.shape(product).last() == Some(&width) && block.len() > lead + 1;
            if graph.is_constant(added) && graph.shape(x) == sum && whole && free && rows && wide {
                found.push((i, at, product, added));
                break;
            }
        }
    }
    for (i, at, product, added) in found {
        if let Op::MatMul { post } = &mut graph.nodes[at].op {
            post.residual = Some(added);
        }
        graph.nodes[i].op = Op::Reshape;
        graph.nodes[i].inputs = vec![product];
    }
}

/// Node `at` with what `next` does to its result, if that is possible.
fn absorbed(graph: &Graph<'_>, at: usize, next: usize) -> Option<(Op, Vec<ValueId>)> {
    let (node, next) = (&graph.nodes[at], &graph.nodes[next]);
    let (out, result) = (node.output, next.output);
    if graph.shape(out) != graph.shape(result) {
        return None;
    }
    let mut op = node.op.clone();
    let mut inputs = node.inputs.clone();
    let limits = match next.op {
        Op::Unary(Unary::Clamp(low, high)) => Some((low, high)),
        _ => None,
    };
    let other = || next.inputs.iter().copied().find(|&id| id != out);
    match &mut op {
        Op::Conv { post, .. } | Op::MatMul { post } => {
            let b = inputs[1];
            if post.clamp != UNLIMITED || post.swish || !graph.is_constant(b) {
                return None;
            }
            let map = matches!(node.op, Op::Conv { .. });
            // Products with a batch of constant matrices run without what follows.
            if !map && graph.shape(b).len() != 2 {
                return None;
            }
            match next.op {
                Op::Binary(Binary::Add) => {
                    let other = other()?;
                    if post.bias.is_none() && per_channel(graph, other, out, map) {
                        post.bias = Some(other);
                    } else if post.residual.is_none() && graph.shape(other) == graph.shape(out) {
                        post.residual = Some(other);
                    } else {
                        return None;
                    }
                }
                Op::Unary(Unary::HardSwish) => post.swish = true,
                _ => post.clamp = limits?,
            }
        }
        Op::MapNorm { clamp, .. } if *clamp == UNLIMITED => match (&next.op, inputs.len()) {
            (Op::Binary(Binary::Mul), 1) | (Op::Binary(Binary::Add), 2) => {
                inputs.push(other().filter(|&id| per_channel(graph, id, out, true))?);
            }
            _ => *clamp = limits?,
        },
        _ => return None,
    }
    Some((op, inputs))
}
