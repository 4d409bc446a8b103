//! ONNX nodes to [`Op`]s: settings read, shapes computed, everything unknown refused.

mod bytes;
mod moves;

use super::{
    Binary, Data, Graph, GraphError, Node, Op, Post, Reduce, UNLIMITED, Unary, Value, ValueId,
    Window,
};
use crate::bundle::WEIGHTS_FILE;
use crate::engine::native::proto;
use std::collections::HashMap;

/// Most elements of one tensor: a quarter of a gigabyte, thirty times what the largest network of the
/// family has.
const MAX_ELEMENTS: usize = 1 << 26;
/// Most dimensions of a tensor.
pub const MAX_RANK: usize = 6;

const F32: i64 = 1;
const U8: i64 = 2;
const I8: i64 = 3;
const I64: i64 = 7;
const F16: i64 = 10;

type Result<T> = core::result::Result<T, GraphError>;
/// Result of reading one node; the reason only, the caller knows the node.
type Step<T> = core::result::Result<T, String>;

/// Reads a model whose large constants are in `weights`.
pub fn read<'a>(bytes: &'a [u8], weights: &'a [u8]) -> Result<Graph<'a>> {
    let Some(file) = proto::read(bytes)? else {
        return Err(GraphError::Graph("the file holds no graph".into()));
    };
    let mut reader =
        Reader { graph: Graph::default(), names: HashMap::new(), bytes: HashMap::new() };
    for tensor in &file.initializers {
        let value = constant(tensor, weights)
            .map_err(|reason| GraphError::Graph(format!("tensor `{}`: {reason}", tensor.name)))?;
        reader.define(tensor.name, value);
    }
    for port in &file.inputs {
        if reader.names.contains_key(port.name) {
            continue;
        }
        let (shape, name) = (declared(port, "input")?, port.name);
        let id = reader.define(name, Value { name: name.into(), shape, data: None });
        reader.graph.inputs.push(id);
    }
    for node in &file.nodes {
        reader.node(node).map_err(|reason| {
            let name = if node.name.is_empty() { node.outputs.first() } else { Some(&node.name) };
            let node_name = name.copied().unwrap_or_default().to_owned();
            GraphError::Node { node: node_name, op: node.op.into(), reason }
        })?;
    }
    for port in &file.outputs {
        let shape = declared(port, "output")?;
        let Some(&id) = reader.names.get(port.name) else {
            let name = port.name;
            return Err(GraphError::Graph(format!("no node makes the output `{name}`")));
        };
        let found = &reader.graph.values[id].shape;
        if *found != shape {
            return Err(GraphError::Graph(format!(
                "output `{}` is declared as {shape:?} but comes out as {found:?}",
                port.name
            )));
        }
        reader.graph.outputs.push(id);
    }
    Ok(reader.graph)
}

fn declared(port: &proto::Port<'_>, what: &str) -> Result<Vec<usize>> {
    let name = port.name;
    if port.kind != F32 {
        return Err(GraphError::Graph(format!("{what} `{name}` must be f32")));
    }
    shape_of(&port.dims).map_err(|e| GraphError::Graph(format!("{what} `{name}`: {e}")))
}

fn shape_of(dims: &[i64]) -> Step<Vec<usize>> {
    let shape: Option<Vec<usize>> = dims.iter().map(|&d| usize::try_from(d).ok()).collect();
    let shape = shape.ok_or_else(|| format!("its shape {dims:?} is not fixed"))?;
    checked(&shape)?;
    Ok(shape)
}

/// Is it a shape the engine works with?
fn checked(shape: &[usize]) -> Step<()> {
    if shape.len() > MAX_RANK {
        return Err(format!("its shape {shape:?} has more than {MAX_RANK} dimensions"));
    }
    let elements = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
    match elements {
        Some(1..=MAX_ELEMENTS) => Ok(()),
        _ => Err(format!("its shape {shape:?} is empty or too large")),
    }
}

/// A constant as stored, inline or in the weights.
fn constant<'a>(tensor: &proto::Tensor<'a>, weights: &'a [u8]) -> Step<Value<'a>> {
    let shape = shape_of(&tensor.dims)?;
    let elements: usize = shape.iter().product();
    let raw = if tensor.external { Some(external(tensor, weights)?) } else { None };
    let raw = raw.or((!tensor.raw.is_empty()).then_some(tensor.raw));
    let (data, found) = match (tensor.kind, raw) {
        (F32, Some(raw)) => (Data::Bytes(raw), raw.len() as f64 / 4.0),
        (F32, None) => (Data::Floats(tensor.floats.clone()), tensor.floats.len() as f64),
        (I64, Some(raw)) => {
            let ints = raw.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b)).collect();
            (Data::Ints(ints), raw.len() as f64 / 8.0)
        }
        (I64, None) => (Data::Ints(tensor.ints.clone()), tensor.ints.len() as f64),
        (F16, Some(raw)) => (Data::Halves(raw), raw.len() as f64 / 2.0),
        (kind @ (U8 | I8), Some(bytes)) => {
            (Data::Bytes8 { bytes, signed: kind == I8 }, bytes.len() as f64)
        }
        (U8 | I8 | F16, None) => return Err("its elements must be raw data".into()),
        (other, _) => {
            return Err(format!("element type {other}; f32, f16, i8, u8 and i64 are supported"));
        }
    };
    if found != elements as f64 {
        return Err(format!("{found} elements are stored for its shape {shape:?}"));
    }
    Ok(Value { name: tensor.name.into(), shape, data: Some(data) })
}

/// The bytes of an external tensor.
fn external<'a>(tensor: &proto::Tensor<'a>, weights: &'a [u8]) -> Step<&'a [u8]> {
    let field = |key: &str| tensor.entries.iter().find(|e| e.0 == key).map(|e| e.1);
    match field("location") {
        Some(WEIGHTS_FILE) => {}
        Some(other) => return Err(format!("its data are in `{other}`, not in `{WEIGHTS_FILE}`")),
        None => return Err("its external data have no location".into()),
    }
    let number = |key: &str| match field(key) {
        None => Ok(None),
        Some(text) => text
            .parse::<usize>()
            .map(Some)
            .map_err(|_| format!("external data {key} `{text}` is not a number")),
    };
    let offset = number("offset")?.unwrap_or(0);
    let length = match number("length")? {
        Some(n) => n,
        None => weights.len().saturating_sub(offset),
    };
    offset.checked_add(length).and_then(|end| weights.get(offset..end)).ok_or_else(|| {
        let have = weights.len();
        format!(
            "bytes {offset} to {offset} + {length} are outside the weights section of {have} bytes"
        )
    })
}

struct Reader<'a> {
    graph: Graph<'a>,
    names: HashMap<String, ValueId>,
    /// Results that are bytes in the file; only `DequantizeLinear` may use them.
    bytes: HashMap<String, bytes::Rounding>,
}

/// The settings and operands of one node.
struct Call<'n, 'a> {
    node: &'n proto::Node<'a>,
    inputs: Vec<Option<ValueId>>,
}

impl Call<'_, '_> {
    fn input(&self, i: usize) -> Step<ValueId> {
        self.maybe(i).ok_or_else(|| format!("input {i} is missing"))
    }

    fn maybe(&self, i: usize) -> Option<ValueId> {
        self.inputs.get(i).copied().flatten()
    }

    fn int(&self, name: &str, default: i64) -> i64 {
        let found = self.node.attributes.iter().find(|a| a.name == name);
        found.and_then(|a| a.int).unwrap_or(default)
    }

    fn float(&self, name: &str, default: f32) -> f32 {
        let found = self.node.attributes.iter().find(|a| a.name == name);
        found.and_then(|a| a.float).unwrap_or(default)
    }

    fn ints(&self, name: &str) -> Option<&[i64]> {
        let found = self.node.attributes.iter().find(|a| a.name == name);
        found.map(|a| &*a.ints)
    }

    fn pair(&self, name: &str, default: usize) -> Step<[usize; 2]> {
        let Some(values) = self.ints(name) else { return Ok([default; 2]) };
        match *values {
            [a, b] if (1..=1024).contains(&a) && (1..=1024).contains(&b) => {
                Ok([a as usize, b as usize])
            }
            _ => Err(format!("{name} {values:?}; two numbers from 1 to 1024 are supported")),
        }
    }

    fn window(&self, kernel: Option<[usize; 2]>) -> Step<Window> {
        let declared =
            self.ints("kernel_shape").map(|_| self.pair("kernel_shape", 1)).transpose()?;
        let kernel = match (kernel, declared) {
            (Some(k), Some(d)) if k != d => {
                return Err(format!("kernel_shape {d:?} but weights of {k:?}"));
            }
            (Some(k), _) | (None, Some(k)) => k,
            (None, None) => return Err("no kernel_shape".into()),
        };
        let auto = self.node.attributes.iter().find(|a| a.name == "auto_pad").and_then(|a| a.text);
        if auto.is_some_and(|text| text != b"NOTSET") {
            return Err("auto_pad; only explicit pads are supported".into());
        }
        let pad = match self.ints("pads") {
            None => [0; 4],
            Some(&[t, l, b, r]) if [t, l, b, r].iter().all(|p| (0..=64).contains(p)) => {
                [t as usize, l as usize, b as usize, r as usize]
            }
            Some(other) => return Err(format!("pads {other:?}; four from 0 to 64 are supported")),
        };
        let (stride, dilation) = (self.pair("strides", 1)?, self.pair("dilations", 1)?);
        Ok(Window { kernel, stride, pad, dilation })
    }
}

/// An axis counted from either end.
fn axis(axis: i64, rank: usize) -> Step<usize> {
    let at = if axis < 0 { axis + rank as i64 } else { axis };
    usize::try_from(at)
        .ok()
        .filter(|&a| a < rank)
        .ok_or_else(|| format!("axis {axis} of a tensor with {rank} dimensions"))
}

/// Shape of two operands together.
fn broadcast(a: &[usize], b: &[usize]) -> Step<Vec<usize>> {
    let rank = a.len().max(b.len());
    let at = |s: &[usize], i: usize| (i + s.len()).checked_sub(rank).map_or(1, |j| s[j]);
    (0..rank)
        .map(|i| match (at(a, i), at(b, i)) {
            (x, y) if x == y || y == 1 => Ok(x),
            (1, y) => Ok(y),
            _ => Err(format!("shapes {a:?} and {b:?} do not fit")),
        })
        .collect()
}

impl<'a> Reader<'a> {
    fn define(&mut self, name: &str, value: Value<'a>) -> ValueId {
        let id = self.graph.values.len();
        self.graph.values.push(value);
        self.names.insert(name.into(), id);
        id
    }

    fn shape(&self, id: ValueId) -> Vec<usize> {
        self.graph.values[id].shape.clone()
    }

    /// Elements of a constant integer operand.
    fn ints(&self, id: ValueId) -> Step<&[i64]> {
        match &self.graph.values[id].data {
            Some(Data::Ints(ints)) => Ok(ints),
            _ => Err(format!("`{}` must be a constant of integers", self.graph.values[id].name)),
        }
    }

    fn float(&self, id: ValueId) -> Step<f32> {
        let name = &self.graph.values[id].name;
        self.graph.scalar(id).ok_or_else(|| format!("`{name}` must be a constant number"))
    }

    /// Adds a node with one result.
    fn push(
        &mut self,
        call: &Call<'_, 'a>,
        op: Op,
        inputs: Vec<ValueId>,
        shape: Vec<usize>,
    ) -> Step<()> {
        match *call.node.outputs {
            [name] => self.named(call, name, op, inputs, shape),
            _ => Err(format!("{} results instead of one", call.node.outputs.len())),
        }
    }

    fn named(
        &mut self,
        call: &Call<'_, 'a>,
        output: &str,
        op: Op,
        inputs: Vec<ValueId>,
        shape: Vec<usize>,
    ) -> Step<()> {
        checked(&shape)?;
        if self.names.contains_key(output) {
            return Err(format!("`{output}` is defined twice"));
        }
        for &id in &inputs {
            if matches!(self.graph.values[id].data, Some(Data::Ints(_) | Data::Bytes8 { .. })) {
                let name = &self.graph.values[id].name;
                return Err(format!("`{name}` holds integers, floats are needed"));
            }
        }
        let output = self.define(output, Value { name: output.into(), shape, data: None });
        let name = if call.node.name.is_empty() {
            self.graph.values[output].name.clone()
        } else {
            call.node.name.into()
        };
        self.graph.nodes.push(Node { name, op, inputs, output });
        Ok(())
    }

    /// A value between two operators that stand for one node.
    fn between(
        &mut self,
        call: &Call<'_, 'a>,
        op: Op,
        inputs: Vec<ValueId>,
        shape: Vec<usize>,
    ) -> Step<ValueId> {
        let name =
            format!("{}#{}", call.node.outputs.first().unwrap_or(&""), self.graph.nodes.len());
        self.named(call, &name, op, inputs, shape)?;
        Ok(self.names[&name])
    }

    fn node(&mut self, node: &proto::Node<'a>) -> Step<()> {
        let mut inputs = Vec::with_capacity(node.inputs.len());
        for &name in &node.inputs {
            if self.bytes.contains_key(name) && node.op != "DequantizeLinear" {
                return Err(format!("`{name}` holds bytes; only DequantizeLinear can use them"));
            }
            inputs.push(match (name, self.names.get(name)) {
                ("", _) => None,
                (_, Some(&id)) => Some(id),
                _ => return Err(format!("its input `{name}` is not defined before it")),
            });
        }
        let call = Call { node, inputs };
        if !matches!(node.domain, "" | "ai.onnx") {
            return Err(format!("operators of `{}` are not supported", node.domain));
        }
        match node.op {
            "Conv" => self.conv(&call),
            "MatMul" => self.matmul(&call),
            "Gemm" => self.gemm(&call),
            "Relu" => self.unary(&call, Unary::Clamp(0.0, UNLIMITED.1)),
            "Clip" => self.clip(&call),
            "Exp" => self.unary(&call, Unary::Exp),
            "Sqrt" => self.unary(&call, Unary::Sqrt),
            "Reciprocal" => self.unary(&call, Unary::Reciprocal),
            "Sigmoid" => self.unary(&call, Unary::Sigmoid),
            "HardSigmoid" => {
                let (alpha, beta) = (call.float("alpha", 0.2), call.float("beta", 0.5));
                self.unary(&call, Unary::HardSigmoid(alpha, beta))
            }
            "HardSwish" => self.unary(&call, Unary::HardSwish),
            "Neg" => self.unary(&call, Unary::Neg),
            "Abs" => self.unary(&call, Unary::Abs),
            "Log" => self.unary(&call, Unary::Log),
            "Tanh" => self.unary(&call, Unary::Tanh),
            "Sin" => self.unary(&call, Unary::Sin),
            "Cos" => self.unary(&call, Unary::Cos),
            "QuantizeLinear" => self.quantise(&call),
            "DequantizeLinear" => self.dequantise(&call),
            "Cast" => self.cast(&call),
            "Identity" | "Dropout" => self.reshape_to(&call, self.shape(call.input(0)?)),
            "Add" => self.binary(&call, Binary::Add),
            "Sub" => self.binary(&call, Binary::Sub),
            "Mul" => self.binary(&call, Binary::Mul),
            "Div" => self.binary(&call, Binary::Div),
            "Min" => self.binary(&call, Binary::Min),
            "Max" => self.binary(&call, Binary::Max),
            "Pow" => self.binary(&call, Binary::Pow),
            "LayerNormalization" => self.layer_norm(&call),
            "Softmax" => self.softmax(&call),
            "ReduceSum" => self.reduce(&call, Reduce::Sum),
            "ReduceMean" => self.reduce(&call, Reduce::Mean),
            "ReduceMax" => self.reduce(&call, Reduce::Max),
            "ReduceMin" => self.reduce(&call, Reduce::Min),
            "GlobalAveragePool" => self.global_pool(&call),
            "MaxPool" | "AveragePool" => self.pool(&call),
            "Transpose" => self.transpose(&call),
            "Reshape" => self.reshape(&call),
            "Flatten" => self.flatten(&call),
            "Squeeze" | "Unsqueeze" => self.squeeze(&call, node.op == "Unsqueeze"),
            "Slice" => self.slice(&call),
            "Split" => self.split(&call),
            "Gather" => self.gather(&call),
            "Expand" => self.expand(&call),
            "Concat" => self.concat(&call),
            _ => Err("this operator is not supported by the native engine".into()),
        }
    }

    fn conv(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let (x, w) = (call.input(0)?, call.input(1)?);
        let (&[1, channels, height, width], &[n, per_group, kh, kw]) =
            (&*self.shape(x), &*self.shape(w))
        else {
            let (x, w) = (self.shape(x), self.shape(w));
            return Err(format!("input {x:?} and weights {w:?}; (1, C, H, W) and (N, C, h, w)"));
        };
        if !self.graph.is_constant(w) {
            return Err("weights that are not constant".into());
        }
        let window = call.window(Some([kh, kw]))?;
        let group = usize::try_from(call.int("group", 1)).unwrap_or(0);
        if group == 0 || per_group.checked_mul(group) != Some(channels) || n % group != 0 {
            return Err(format!("{group} groups of {per_group} for {channels} channels to {n}"));
        }
        let bias = call.maybe(2);
        if let Some(b) = bias
            && (!self.graph.is_constant(b) || self.shape(b) != [n])
        {
            return Err(format!("a bias that is no constant of {n} numbers"));
        }
        let Some([oh, ow]) = window.output([height, width]) else {
            return Err(format!("the kernel {kh} x {kw} does not fit {height} x {width}"));
        };
        let post = Post { bias, ..Post::default() };
        self.push(call, Op::Conv { window, group, post }, vec![x, w], vec![1, n, oh, ow])
    }

    fn matmul(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let (a, b) = (call.input(0)?, call.input(1)?);
        let shape = self.product_shape(a, b)?;
        self.push(call, Op::MatMul { post: Post::default() }, vec![a, b], shape)
    }

    fn product_shape(&self, a: ValueId, b: ValueId) -> Step<Vec<usize>> {
        let (a, b) = (self.shape(a), self.shape(b));
        match (&*a, &*b) {
            ([before @ .., m, k], [batch @ .., k2, n]) if k == k2 => {
                let mut shape = broadcast(before, batch)?;
                shape.extend([*m, *n]);
                Ok(shape)
            }
            _ => Err(format!("shapes {a:?} and {b:?}")),
        }
    }

    fn gemm(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        if call.float("alpha", 1.0) != 1.0 || call.float("beta", 1.0) != 1.0 {
            return Err("alpha or beta other than 1".into());
        }
        let mut sides = [call.input(0)?, call.input(1)?];
        for (side, flag) in sides.iter_mut().zip(["transA", "transB"]) {
            if call.int(flag, 0) != 0 {
                let &[rows, columns] = &*self.shape(*side) else {
                    return Err("operands that are not matrices".into());
                };
                let op = Op::Transpose(vec![1, 0]);
                *side = self.between(call, op, vec![*side], vec![columns, rows])?;
            }
        }
        let shape = self.product_shape(sides[0], sides[1])?;
        let product = Op::MatMul { post: Post::default() };
        match call.maybe(2) {
            None => self.push(call, product, sides.into(), shape),
            Some(c) => {
                if broadcast(&shape, &self.shape(c))? != shape {
                    return Err(format!("C of shape {:?} for {shape:?}", self.shape(c)));
                }
                let ab = self.between(call, product, sides.into(), shape.clone())?;
                self.push(call, Op::Binary(Binary::Add), vec![ab, c], shape)
            }
        }
    }

    fn unary(&mut self, call: &Call<'_, 'a>, op: Unary) -> Step<()> {
        let x = call.input(0)?;
        let shape = self.shape(x);
        self.push(call, Op::Unary(op), vec![x], shape)
    }

    fn clip(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let bound = |i: usize, name: &str, none: f32| match call.maybe(i) {
            Some(id) => self.float(id),
            None => Ok(call.float(name, none)),
        };
        let (low, high) = (bound(1, "min", UNLIMITED.0)?, bound(2, "max", UNLIMITED.1)?);
        self.unary(call, Unary::Clamp(low, high))
    }

    fn binary(&mut self, call: &Call<'_, 'a>, op: Binary) -> Step<()> {
        if call.inputs.len() != 2 {
            return Err(format!("{} operands instead of two", call.inputs.len()));
        }
        let (a, b) = (call.input(0)?, call.input(1)?);
        let shape = broadcast(&self.shape(a), &self.shape(b))?;
        self.push(call, Op::Binary(op), vec![a, b], shape)
    }

    fn layer_norm(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let x = call.input(0)?;
        let shape = self.shape(x);
        let last = shape.len().checked_sub(1).ok_or("a number without dimensions")?;
        if axis(call.int("axis", -1), shape.len())? != last {
            return Err("more than the last dimension".into());
        }
        let mut inputs = vec![x];
        for id in [Some(call.input(1)?), call.maybe(2)].into_iter().flatten() {
            if self.shape(id) != shape[last..] || !self.graph.is_constant(id) {
                return Err(format!("gain or offset that is no constant of {}", shape[last]));
            }
            inputs.push(id);
        }
        let epsilon = call.float("epsilon", 1e-5);
        self.push(call, Op::LayerNorm { epsilon }, inputs, shape)
    }

    fn softmax(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let x = call.input(0)?;
        let shape = self.shape(x);
        let along = axis(call.int("axis", -1), shape.len())?;
        if along + 1 != shape.len() {
            return Err(format!("axis {along}; only the last one is supported"));
        }
        self.push(call, Op::Softmax, vec![x], shape)
    }

    fn reduce(&mut self, call: &Call<'_, 'a>, kind: Reduce) -> Step<()> {
        let x = call.input(0)?;
        let shape = self.shape(x);
        let given: Vec<i64> = match call.maybe(1) {
            Some(id) => self.ints(id)?.to_vec(),
            None => call.ints("axes").unwrap_or_default().to_vec(),
        };
        let mut axes = given.iter().map(|&a| axis(a, shape.len())).collect::<Step<Vec<_>>>()?;
        if axes.is_empty() {
            if call.int("noop_with_empty_axes", 0) != 0 {
                return self.reshape_to(call, shape);
            }
            axes = (0..shape.len()).collect();
        }
        axes.sort_unstable();
        axes.dedup();
        let keep = call.int("keepdims", 1) != 0;
        let sizes = shape.iter().enumerate();
        let out = sizes.filter_map(|(i, &n)| match (axes.contains(&i), keep) {
            (true, true) => Some(1),
            (true, false) => None,
            (false, _) => Some(n),
        });
        let out = out.collect();
        self.push(call, Op::Reduce { kind, axes }, vec![x], out)
    }

    fn global_pool(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let x = call.input(0)?;
        let mut shape = self.shape(x);
        let axes: Vec<usize> = (2..shape.len()).collect();
        shape.iter_mut().skip(2).for_each(|n| *n = 1);
        self.push(call, Op::Reduce { kind: Reduce::Mean, axes }, vec![x], shape)
    }

    fn pool(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let x = call.input(0)?;
        let &[1, channels, height, width] = &*self.shape(x) else {
            return Err(format!("input {:?} instead of (1, C, H, W)", self.shape(x)));
        };
        let window = call.window(None)?;
        if call.int("ceil_mode", 0) != 0 || call.int("storage_order", 0) != 0 {
            return Err("ceil_mode or storage_order".into());
        }
        let reach = |i: usize| window.pad[i].max(window.pad[i + 2]) < window.kernel[i];
        let size = window.output([height, width]).filter(|_| reach(0) && reach(1));
        let Some([oh, ow]) = size else {
            return Err(format!("{window:?} does not fit {height} x {width}"));
        };
        let (max, count_pad) = (call.node.op == "MaxPool", call.int("count_include_pad", 0) != 0);
        let op = Op::Pool { window, max, count_pad };
        self.push(call, op, vec![x], vec![1, channels, oh, ow])
    }
}
