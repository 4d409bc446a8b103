//! One graph, node by node: each one becomes a view, or steps that write a new buffer.

mod bytes;
mod products;
mod winograd;

use super::super::graph::{Binary, Data, Graph, GraphError, Node, Op, Reduce, Unary, Window};
use super::super::kernels::{
    Copy, Fold, Halo, LayerNorm, Map, MapNorm, Nest, Pitch, Place, Pool, Softmax, Step, Zip,
};
use super::rows::{Rows, rows};
use super::view::{Base, View, dense};
use super::{ALIGN, Binding, FLOATING, Made, Planner, Result, gather, map_layout, source, spread};

/// Steps, the node behind each, and the buffers they use.
type Lowered = (Vec<Step>, Vec<String>, Vec<(usize, usize)>);

/// Why a node cannot be run; the caller knows which.
type Try<T> = core::result::Result<T, String>;

/// See [`Planner::add`].
pub fn lower(
    planner: &mut Planner,
    index: usize,
    graph: &Graph<'_>,
    inputs: &[Binding<'_>],
    outputs: &[Binding<'_>],
) -> Result<Lowered> {
    let mut halo = vec![0; graph.values.len()];
    for node in &graph.nodes {
        if let Op::Conv { window, .. } = &node.op {
            let need = &mut halo[node.inputs[0]];
            *need = window.halo().max(*need);
        }
    }
    let narrow = graph.values.iter().any(|v| matches!(v.data, Some(Data::Scaled { .. })));
    let mut lower = Lower {
        byte_attention: planner.byte_attention && narrow,
        planner,
        index,
        graph,
        views: vec![None; graph.values.len()],
        halo,
        bytes: vec![None; graph.values.len()],
        steps: Vec::new(),
        nodes: Vec::new(),
        buffers: Vec::new(),
        node: String::new(),
        once: false,
    };
    lower.bind(inputs)?;
    for node in &graph.nodes {
        lower.node(node)?;
    }
    lower.deliver(outputs)?;
    Ok((lower.steps, lower.nodes, lower.buffers))
}

struct Lower<'p, 'g, 'a> {
    planner: &'p mut Planner,
    index: usize,
    graph: &'g Graph<'a>,
    /// Of every value that is no constant, once it is known.
    views: Vec<Option<View>>,
    /// Whether attention is computed in bytes, as the products around it are.
    byte_attention: bool,
    /// Values that products take as bytes.
    bytes: Vec<Option<bytes::Bytes>>,
    /// Border that the convolutions after a value want.
    halo: Vec<usize>,
    steps: Vec<Step>,
    nodes: Vec<String>,
    buffers: Vec<(usize, usize)>,
    /// The node that is being lowered.
    node: String,
    /// Whether it depends on constants only.
    once: bool,
}

/// A map ready to be read by windows.
#[derive(Clone, Copy, Debug)]
struct MapSource {
    /// First pixel.
    base: Base,
    offset: usize,
    pitch: Pitch,
}

/// A map to be written.
struct MapTarget {
    view: View,
    output: usize,
    pitch: Pitch,
    halo: Option<Halo>,
}

impl Lower<'_, '_, '_> {
    fn bind(&mut self, inputs: &[Binding<'_>]) -> Result<()> {
        for &id in &self.graph.inputs {
            let value = &self.graph.values[id];
            let Some(binding) = inputs.iter().find(|b| b.name == value.name) else {
                let name = &value.name;
                return Err(GraphError::Graph(format!(
                    "nothing is known about its input `{name}`"
                )));
            };
            fits("input", binding, &value.shape)?;
            self.views[id] = Some(binding.view.clone());
        }
        for binding in inputs {
            let named = |&id: &usize| self.graph.values[id].name == binding.name;
            if !self.graph.inputs.iter().any(named) {
                return Err(GraphError::Graph(format!("it has no input `{}`", binding.name)));
            }
        }
        Ok(())
    }

    fn deliver(&mut self, outputs: &[Binding<'_>]) -> Result<()> {
        for binding in outputs {
            let named = |&&id: &&usize| self.graph.values[id].name == binding.name;
            let Some(&id) = self.graph.outputs.iter().find(named) else {
                return Err(GraphError::Graph(format!("it has no output `{}`", binding.name)));
            };
            fits("output", binding, self.graph.shape(id))?;
            self.node = format!("output {}", binding.name);
            self.once = false;
            let failed = |reason| GraphError::Graph(format!("output `{}`: {reason}", binding.name));
            let view = self.view(id);
            self.copy(&view, &binding.view).map_err(failed)?;
        }
        Ok(())
    }

    fn node(&mut self, node: &Node) -> Result<()> {
        self.node = node.name.clone();
        self.once = node.operands().all(|id| {
            self.graph.is_constant(id) || self.views[id].as_ref().is_some_and(|v| self.is_fixed(v))
        });
        let view = self.lower(node).map_err(|reason| node.error(reason))?;
        if view.shape != self.graph.shape(node.output) {
            let want = self.graph.shape(node.output);
            return Err(node.error(format!("it comes out as {:?} instead of {want:?}", view.shape)));
        }
        self.views[node.output] = Some(view);
        Ok(())
    }

    fn lower(&mut self, node: &Node) -> Try<View> {
        let x = self.view(node.inputs[0]);
        let shape = self.graph.shape(node.output).to_vec();
        Ok(match &node.op {
            Op::Transpose(perm) => x.transposed(perm),
            Op::Reshape => match x.reshaped(&shape) {
                Some(view) => view,
                None => {
                    let whole = self.whole(&x)?;
                    whole.reshaped(&shape).ok_or("its elements do not fit")?
                }
            },
            Op::Slice { axis, start, step } => x.sliced(*axis, *start, *step, shape[*axis]),
            Op::Expand => x.expanded(&shape),
            Op::Concat(axis) => self.concat(node, *axis, &shape)?,
            Op::Unary(Unary::Round { scale, zero }) => self.round(node, &x, *scale, *zero)?,
            Op::Unary(op) => self.unary(*op, &x, node.output)?,
            Op::Binary(op) => {
                let y = self.view(node.inputs[1]);
                self.binary(*op, &x, &y, node.output)?
            }
            Op::LayerNorm { epsilon } => self.layer_norm(node, &x, *epsilon)?,
            Op::Softmax => self.softmax(&x)?,
            Op::MapNorm { epsilon, centre, factor, clamp } => {
                let source = self.map_source(&x, 0)?;
                let [_, channels, height, width] = four(&shape)?;
                let target = self.map_target(node.output)?;
                let gain = self.channels(node.inputs.get(1).copied(), channels, false)?;
                let offset = self.channels(node.inputs.get(2).copied(), channels, false)?;
                self.push(Step::MapNorm(MapNorm {
                    size: [height, width],
                    channels,
                    input: self.place(source.base, source.offset)?,
                    input_pitch: source.pitch,
                    output: target.output,
                    output_pitch: target.pitch,
                    gain,
                    offset,
                    centre: *centre,
                    factor: *factor,
                    epsilon: *epsilon,
                    clamp: *clamp,
                    halo: target.halo,
                }));
                target.view
            }
            Op::Reduce { kind, axes } => self.reduce(*kind, axes, &x, &shape)?,
            Op::Pool { window, max, count_pad } => {
                self.pool(&x, window, (*max, *count_pad), node.output)?
            }
            Op::Conv { window, group, post } => self.conv(node, window, *group, post)?,
            Op::MatMul { post } => self.matmul(node, post)?,
            Op::Attention { scale } => self.attention(node, *scale)?,
        })
    }

    /// The view of a value that is defined.
    fn view(&self, id: usize) -> View {
        match &self.views[id] {
            Some(view) => view.clone(),
            None => View::dense(Base::Constant(id), self.graph.shape(id)),
        }
    }

    /// Whether a view shows constants or what was computed from them at load.
    fn is_fixed(&self, view: &View) -> bool {
        match view.base {
            Base::Constant(_) | Base::Weights(_) => true,
            Base::Arena(at) => self.planner.is_once(at),
        }
    }

    fn push(&mut self, step: Step) {
        let (steps, nodes) = if self.once {
            (&mut self.planner.once.0, &mut self.planner.once.1)
        } else {
            (&mut self.steps, &mut self.nodes)
        };
        steps.push(step);
        nodes.push(self.node.clone());
    }

    /// A new buffer; its address.
    fn buffer(&mut self, len: usize) -> usize {
        if self.once {
            return self.planner.lasting_once(len);
        }
        let end = |&(at, len): &(usize, usize)| at + len.next_multiple_of(ALIGN);
        let at = self.buffers.last().map_or(FLOATING, end);
        self.buffers.push((at, len));
        at
    }

    /// A new tensor whose dimensions lie in this order, outermost first.
    fn tensor(&mut self, shape: &[usize], order: &[usize]) -> View {
        let mut stride = vec![0; shape.len()];
        let mut next = 1;
        for &i in order.iter().rev() {
            stride[i] = next;
            next *= shape[i];
        }
        let at = self.buffer(next);
        View { base: Base::Arena(at), offset: 0, shape: shape.into(), stride, halo: 0 }
    }

    /// A new tensor of rows, each a run, its pitch kind to the cache.
    fn matrix(&mut self, shape: &[usize]) -> View {
        let mut padded = shape.to_vec();
        if let Some(last) = padded.last_mut() {
            *last += spread(*last);
        }
        let at = self.buffer(padded.iter().product());
        let base = Base::Arena(at);
        View { base, offset: 0, shape: shape.into(), stride: dense(&padded), halo: 0 }
    }

    /// The place of an element of a view whose constant, if it is one, has been placed.
    fn place(&self, base: Base, offset: usize) -> Try<Place> {
        match base {
            Base::Arena(at) => Ok(Place::Arena(at + offset)),
            Base::Weights(at) => Ok(Place::Weights(at + offset)),
            Base::Constant(_) => Err("a constant without a place".into()),
        }
    }

    /// Elements and source of a constant.
    fn constant(&self, id: usize) -> Try<(Vec<f32>, super::Source)> {
        let data = self.graph.values[id].data.as_ref().ok_or("an operand is not constant")?;
        let floats = data.floats();
        self.planner.release(data);
        Ok((floats, source(self.index, id, data)))
    }

    /// The view with constants placed in the weights, as they are.
    fn placed(&mut self, view: &View) -> Try<View> {
        let Base::Constant(id) = view.base else { return Ok(view.clone()) };
        let (data, from) = self.constant(id)?;
        let made = Made::Copy(from, 0, vec![data.len()], vec![1]);
        let at = self.planner.make(made, || data);
        Ok(View { base: Base::Weights(at), ..view.clone() })
    }

    /// The view's elements without gaps, in order; copied if they are not.
    fn whole(&mut self, view: &View) -> Try<View> {
        if view.stride == dense(&view.shape) && !matches!(view.base, Base::Constant(_)) {
            return Ok(view.clone());
        }
        if let Base::Constant(id) = view.base {
            let (data, from) = self.constant(id)?;
            let made = Made::Copy(from, view.offset, view.shape.clone(), view.stride.clone());
            let at =
                self.planner.make(made, || gather(&data, view.offset, &view.shape, &view.stride));
            return Ok(View::dense(Base::Weights(at), &view.shape));
        }
        let order: Vec<usize> = (0..view.shape.len()).collect();
        let to = self.tensor(&view.shape, &order);
        self.copy(view, &to)?;
        Ok(to)
    }

    /// The view with neighbours along the last dimension next to each other.
    fn runs(&mut self, view: &View) -> Try<View> {
        if view.is_run() { self.placed(view) } else { self.whole(view) }
    }

    fn copy(&mut self, from: &View, to: &View) -> Try<()> {
        let from = self.placed(from)?;
        let nest = Nest::new(&from.shape, [&from.stride, &to.stride]).ok_or(TOO_MANY)?;
        let input = self.place(from.base, from.offset)?;
        let Place::Arena(output) = self.place(to.base, to.offset)? else {
            return Err("a result among the weights".into());
        };
        self.push(Step::Copy(Copy { nest, input, output }));
        Ok(())
    }

    /// A constant with one number per channel, in the weights; padded with zeros to whole vectors
    /// for products.
    fn channels(&mut self, id: Option<usize>, count: usize, padded: bool) -> Try<Option<usize>> {
        let Some(id) = id else { return Ok(None) };
        let (mut data, from) = self.constant(id)?;
        if data.len() != count {
            return Err(format!("{} numbers for {count} channels", data.len()));
        }
        let len = if padded { self.planner.kernels.packing.columns(count) } else { count };
        data.resize(len, 0.0);
        Ok(Some(self.planner.make(Made::Padded(from, len), || data)))
    }

    /// A map with channels innermost and a border of at least `halo` zeros; copied if it is not one.
    fn map_source(&mut self, x: &View, halo: usize) -> Try<MapSource> {
        let [one, channels, height, width] = four(&x.shape)?;
        if one != 1 {
            return Err(format!("{one} maps at once"));
        }
        let ready = (channels == 1 || x.stride[1] == 1)
            && x.halo >= halo
            && !matches!(x.base, Base::Constant(_));
        let x = if ready {
            x.clone()
        } else {
            let target = self.new_map(channels, [height, width], halo);
            if let Some(border) = target.halo {
                self.push(Step::Clear(border));
            }
            self.copy(x, &target.view)?;
            target.view
        };
        let pitch = Pitch { y: x.stride[2], x: x.stride[3] };
        Ok(MapSource { base: x.base, offset: x.offset, pitch })
    }

    /// A buffer for a value that is a map, with the border its users want.
    fn map_target(&mut self, value: usize) -> Try<MapTarget> {
        let [_, channels, height, width] = four(self.graph.shape(value))?;
        Ok(self.new_map(channels, [height, width], self.halo[value]))
    }

    fn new_map(&mut self, channels: usize, size: [usize; 2], halo: usize) -> MapTarget {
        let layout = map_layout(channels, size, halo);
        let at = self.buffer(layout.len);
        let Halo { line, pixel, width, .. } = layout.halo;
        let offset = width * (line + pixel);
        let view = View {
            base: Base::Arena(at),
            offset,
            shape: vec![1, channels, size[0], size[1]],
            stride: vec![layout.len, 1, line, pixel],
            halo,
        };
        let border = Halo { start: at, ..layout.halo };
        MapTarget {
            view,
            output: at + offset,
            pitch: Pitch { y: line, x: pixel },
            halo: (halo > 0).then_some(border),
        }
    }

    /// A result that lies like `like`: a map with its border, or its dimensions in that order.
    fn result_like(&mut self, like: &View, value: usize) -> Try<View> {
        let shape = self.graph.shape(value).to_vec();
        if let [1, channels, _, _] = *shape
            && channels > 1
            && like.stride[1] == 1
        {
            let target = self.map_target(value)?;
            if let Some(border) = target.halo {
                self.push(Step::Clear(border));
            }
            return Ok(target.view);
        }
        Ok(self.tensor(&shape, &like.order()))
    }

    fn unary(&mut self, op: Unary, x: &View, value: usize) -> Try<View> {
        let x = self.placed(x)?;
        let to = self.result_like(&x, value)?;
        let nest = Nest::new(&x.shape, [&x.stride, &to.stride]).ok_or(TOO_MANY)?;
        let input = self.place(x.base, x.offset)?;
        let output = address(&to)?;
        self.push(Step::Map(Map { op, nest, input, output }));
        Ok(to)
    }

    fn binary(&mut self, op: Binary, x: &View, y: &View, value: usize) -> Try<View> {
        let shape = self.graph.shape(value).to_vec();
        let (x, y) = (self.placed(x)?, self.placed(y)?);
        let full = |v: &&View| v.shape == shape;
        let in_arena = |v: &&View| matches!(v.base, Base::Arena(_));
        let views = [&x, &y];
        let found =
            views.iter().find(|v| full(v) && in_arena(v)).or(views.iter().find(|v| full(v)));
        let to = match found {
            Some(like) => self.result_like(like, value)?,
            None => self.tensor(&shape, &(0..shape.len()).collect::<Vec<_>>()),
        };
        let (x, y) = (x.expanded(&shape), y.expanded(&shape));
        let strides: [&[usize]; 3] = [&x.stride, &y.stride, &to.stride];
        let nest = Nest::new(&shape, strides).ok_or(TOO_MANY)?;
        let inputs = [self.place(x.base, x.offset)?, self.place(y.base, y.offset)?];
        let output = address(&to)?;
        self.push(Step::Zip(Zip { op, nest, inputs, output }));
        Ok(to)
    }

    fn concat(&mut self, node: &Node, axis: usize, shape: &[usize]) -> Try<View> {
        let parts: Vec<View> = node.inputs.iter().map(|&id| self.view(id)).collect();
        let in_arena = |v: &&View| matches!(v.base, Base::Arena(_));
        let like = parts.iter().find(in_arena).unwrap_or(&parts[0]);
        let to = self.tensor(shape, &like.order());
        let mut start = 0;
        for part in &parts {
            let len = part.shape[axis];
            self.copy(part, &to.sliced(axis, start, 1, len))?;
            start += len;
        }
        Ok(to)
    }

    /// A view as rows, and a new tensor of the same rows with `columns` columns.
    fn row_wise(&mut self, x: &View) -> Try<(View, View, Rows)> {
        let mut x = self.runs(x)?;
        let to = self.matrix(&x.shape);
        if rows(&[&x, &to]).is_none() {
            x = self.whole(&x)?;
        }
        let rows = rows(&[&x, &to]).ok_or(TOO_MANY)?;
        Ok((x, to, rows))
    }

    fn layer_norm(&mut self, node: &Node, x: &View, epsilon: f32) -> Try<View> {
        let (x, to, rows) = self.row_wise(x)?;
        let columns = *x.shape.last().ok_or("a number without dimensions")?;
        let gain = self.channels(node.inputs.get(1).copied(), columns, false)?;
        let offset = self.channels(node.inputs.get(2).copied(), columns, false)?;
        self.push(Step::LayerNorm(LayerNorm {
            size: rows.size,
            columns,
            input: self.place(x.base, x.offset)?,
            input_pitch: rows.pitch[0],
            output: address(&to)?,
            output_pitch: rows.pitch[1],
            gain: gain.ok_or("no gain")?,
            offset,
            epsilon,
        }));
        Ok(to)
    }

    fn softmax(&mut self, x: &View) -> Try<View> {
        let (x, to, rows) = self.row_wise(x)?;
        self.push(Step::Softmax(Softmax {
            size: rows.size,
            columns: *x.shape.last().ok_or("a number without dimensions")?,
            input: self.place(x.base, x.offset)?,
            input_pitch: rows.pitch[0],
            output: address(&to)?,
            output_pitch: rows.pitch[1],
        }));
        Ok(to)
    }

    fn reduce(&mut self, kind: Reduce, axes: &[usize], x: &View, shape: &[usize]) -> Try<View> {
        let x = self.placed(x)?;
        let to = self.tensor(shape, &(0..shape.len()).collect::<Vec<_>>());
        let keeps = |i: &usize| !axes.contains(i);
        let pick = |from: &[usize], stay: bool| -> Vec<usize> {
            (0..x.shape.len()).filter(|i| keeps(i) == stay).map(|i| from[i]).collect()
        };
        // Dimensions of size one may be there or not; their strides do not matter.
        let kept = pick(&x.shape, true);
        let whole = dense(&kept);
        let outer = Nest::new(&kept, [&pick(&x.stride, true), &whole]).ok_or(TOO_MANY)?;
        let inner = Nest::new(&pick(&x.shape, false), [&pick(&x.stride, false)]).ok_or(TOO_MANY)?;
        let input = self.place(x.base, x.offset)?;
        let output = address(&to)?;
        self.push(Step::Fold(Fold { kind, outer, inner, input, output }));
        Ok(to)
    }

    fn pool(&mut self, x: &View, window: &Window, kind: (bool, bool), value: usize) -> Try<View> {
        let [_, channels, height, width] = four(&x.shape)?;
        let [_, _, oh, ow] = four(self.graph.shape(value))?;
        let source = self.map_source(x, 0)?;
        let target = self.map_target(value)?;
        self.push(Step::Pool(Pool {
            from: [height, width],
            size: [oh, ow],
            channels,
            kernel: window.kernel,
            stride: window.stride,
            dilation: window.dilation,
            pad: [window.pad[0], window.pad[1]],
            input: self.place(source.base, source.offset)?,
            input_pitch: source.pitch,
            output: target.output,
            output_pitch: target.pitch,
            max: kind.0,
            count_pad: kind.1,
            halo: target.halo,
        }));
        Ok(target.view)
    }
}

const TOO_MANY: &str = "its tensors have too many dimensions that cannot be joined";

fn four(shape: &[usize]) -> Try<[usize; 4]> {
    shape.try_into().map_err(|_| format!("shape {shape:?} instead of (1, C, H, W)"))
}

/// Address of a result's first element.
fn address(view: &View) -> Try<usize> {
    match view.base {
        Base::Arena(at) => Ok(at + view.offset),
        _ => Err("a result among the weights".into()),
    }
}

fn fits(what: &str, binding: &Binding<'_>, shape: &[usize]) -> Result<()> {
    if binding.view.shape == shape {
        return Ok(());
    }
    let (name, want) = (binding.name, &binding.view.shape);
    let message = format!("{what} `{name}` is {shape:?}, the specification needs {want:?}");
    Err(GraphError::Graph(message))
}
