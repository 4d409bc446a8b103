//! A small evaluator for nodes whose inputs are all known.
//!
//! Only what constant parts of networks are made of; anything else is answered with `None` and
//! stays a node. Arithmetic is f32, sums of matrix products and reductions are f64 inside.

use super::graph::{Attribute, Data, Graph, Node};
use super::proto::data_type;

/// A constant input: shape and elements.
type Known<'a> = (&'a [usize], &'a Data);

/// The value of `node`, or `None` when an input is not constant or the operation is not known here.
pub(super) fn evaluate(graph: &Graph, node: &Node) -> Option<Data> {
    let mut inputs: Vec<Option<Known<'_>>> = Vec::with_capacity(node.inputs.len());
    for input in &node.inputs {
        inputs.push(match input {
            Some(id) => Some((graph.dims(*id), graph.constant(*id)?)),
            None => None,
        });
    }
    let out = graph.dims(node.output);
    let x = (*inputs.first()?)?;
    let second = || inputs.get(1).copied().flatten();
    match node.op {
        "Identity" | "Reshape" => Some(x.1.clone()),
        "Expand" => each(x.1, out, |i| broadcast(i, out, x.0)),
        "Tile" => each(x.1, out, |i| {
            let at = unravel(i, out);
            ravel(at.iter().zip(x.0).map(|(p, side)| p % side), x.0)
        }),
        "Transpose" => {
            let perm = node.ints("perm")?;
            each(x.1, out, |i| {
                let at = unravel(i, out);
                let mut from = vec![0; x.0.len()];
                for (place, axis) in at.iter().zip(perm) {
                    from[*axis as usize] = *place;
                }
                ravel(from.into_iter(), x.0)
            })
        }
        "Slice" => {
            let list = |i: usize| inputs.get(i).copied().flatten().and_then(|k| k.1.i64s());
            let (starts, axes, steps) = (list(1)?, list(3)?, list(4)?);
            let mut first = vec![0i64; x.0.len()];
            let mut step = vec![1i64; x.0.len()];
            for ((axis, start), by) in axes.iter().zip(starts).zip(steps) {
                let side = x.0[*axis as usize] as i64;
                first[*axis as usize] = if *start < 0 { start + side } else { *start };
                step[*axis as usize] = *by;
            }
            each(x.1, out, |i| {
                let at = unravel(i, out);
                let from = (0..at.len()).map(|a| (first[a] + step[a] * at[a] as i64) as usize);
                ravel(from, x.0)
            })
        }
        "Concat" => concat(&inputs, node.int("axis")? as usize, out),
        "Gather" => {
            let (axis, indices) = (node.int("axis")? as usize, second()?);
            let ids = indices.1.i64s()?;
            let inner = x.0.len() - axis - 1;
            each(x.1, out, |i| {
                let at = unravel(i, out);
                let tail = at.len() - inner;
                let id = ids[ravel(at[axis..tail].iter().copied(), indices.0)];
                let id = if id < 0 { id + x.0[axis] as i64 } else { id } as usize;
                let from = at[..axis].iter().copied().chain([id]).chain(at[tail..].iter().copied());
                ravel(from, x.0)
            })
        }
        "Cast" => cast(x.1, node.int("to")?),
        "Where" => {
            let (yes, no) = (second()?, inputs.get(2).copied().flatten()?);
            let Data::Bool(mask) = x.1 else { return None };
            let (a, b) = (yes.1.f32s()?, no.1.f32s()?);
            let pick = |i| {
                if mask[broadcast(i, out, x.0)] {
                    a[broadcast(i, out, yes.0)]
                } else {
                    b[broadcast(i, out, no.0)]
                }
            };
            Some(Data::F32((0..count(out)).map(pick).collect()))
        }
        "Add" | "Sub" | "Mul" | "Div" | "Pow" | "Max" | "Min" => binary(node.op, x, second()?, out),
        "MatMul" => matmul(x, second()?, out),
        "ReduceSum" | "ReduceMean" => reduce(node, x, second(), out),
        "Softmax" => softmax(x, node.int("axis")?),
        "LayerNormalization" => {
            let bias = inputs.get(2).copied().flatten();
            layer_norm(node.float("epsilon")?, x, second()?, bias)
        }
        op => unary(op, &inputs, x.1.f32s()?),
    }
}

fn unary(op: &str, inputs: &[Option<Known<'_>>], x: &[f32]) -> Option<Data> {
    let map = |f: fn(f32) -> f32| Some(Data::F32(x.iter().map(|v| f(*v)).collect()));
    match op {
        "Neg" => map(|v| -v),
        "Abs" => map(f32::abs),
        "Exp" => map(f32::exp),
        "Log" => map(f32::ln),
        "Sqrt" => map(f32::sqrt),
        "Reciprocal" => map(f32::recip),
        "Sin" => map(f32::sin),
        "Cos" => map(f32::cos),
        "Tanh" => map(f32::tanh),
        "Relu" => map(|v| v.max(0.0)),
        "Sigmoid" => map(|v| 1.0 / (1.0 + (-v).exp())),
        "Floor" => map(f32::floor),
        "Ceil" => map(f32::ceil),
        "Clip" => {
            let limit = |i: usize| inputs.get(i).copied().flatten().and_then(|k| k.1.f32s());
            let (low, high) = (*limit(1)?.first()?, *limit(2)?.first()?);
            Some(Data::F32(x.iter().map(|v| v.max(low).min(high)).collect()))
        }
        _ => None,
    }
}

fn binary(op: &str, lhs: Known<'_>, rhs: Known<'_>, out: &[usize]) -> Option<Data> {
    let pairs = (0..count(out)).map(|i| (broadcast(i, out, lhs.0), broadcast(i, out, rhs.0)));
    if let (Data::I64(a), Data::I64(b)) = (lhs.1, rhs.1) {
        let f: fn(i64, i64) -> Option<i64> = match op {
            "Add" => i64::checked_add,
            "Sub" => i64::checked_sub,
            "Mul" => i64::checked_mul,
            // burn and ONNX both cut towards zero.
            "Div" => i64::checked_div,
            "Max" => |a, b| Some(a.max(b)),
            "Min" => |a, b| Some(a.min(b)),
            _ => return None,
        };
        return pairs.map(|(i, j)| f(a[i], b[j])).collect::<Option<Vec<_>>>().map(Data::I64);
    }
    let (a, b) = (lhs.1.f32s()?, rhs.1.f32s()?);
    let f: fn(f32, f32) -> f32 = match op {
        "Add" => |a, b| a + b,
        "Sub" => |a, b| a - b,
        "Mul" => |a, b| a * b,
        "Div" => |a, b| a / b,
        "Pow" => f32::powf,
        "Max" => f32::max,
        "Min" => f32::min,
        _ => return None,
    };
    Some(Data::F32(pairs.map(|(i, j)| f(a[i], b[j])).collect()))
}

fn matmul(lhs: Known<'_>, rhs: Known<'_>, out: &[usize]) -> Option<Data> {
    let (a, b) = (lhs.1.f32s()?, rhs.1.f32s()?);
    if lhs.0.len() < 2 || rhs.0.len() < 2 {
        return None;
    }
    let (m, k) = (lhs.0[lhs.0.len() - 2], lhs.0[lhs.0.len() - 1]);
    let n = rhs.0[rhs.0.len() - 1];
    let stack = &out[..out.len() - 2];
    let (a_stack, b_stack) = (&lhs.0[..lhs.0.len() - 2], &rhs.0[..rhs.0.len() - 2]);
    let mut result = Vec::with_capacity(count(out));
    let mut row = vec![0f64; n];
    for s in 0..count(stack) {
        let a = &a[broadcast(s, stack, a_stack) * m * k..][..m * k];
        let b = &b[broadcast(s, stack, b_stack) * k * n..][..k * n];
        for i in 0..m {
            row.fill(0.0);
            for (j, x) in a[i * k..(i + 1) * k].iter().enumerate() {
                for (sum, y) in row.iter_mut().zip(&b[j * n..(j + 1) * n]) {
                    *sum += f64::from(*x) * f64::from(*y);
                }
            }
            result.extend(row.iter().map(|v| *v as f32));
        }
    }
    Some(Data::F32(result))
}

fn reduce(node: &Node, x: Known<'_>, axes: Option<Known<'_>>, out: &[usize]) -> Option<Data> {
    if node.int("keepdims") != Some(1) {
        return None;
    }
    let axes: Vec<usize> = match (node.attribute("axes"), axes) {
        (Some(Attribute::Ints(axes)), _) => axes.iter().map(|a| *a as usize).collect(),
        (_, Some(axes)) => axes.1.i64s()?.iter().map(|a| *a as usize).collect(),
        _ => (0..x.0.len()).collect(),
    };
    let values = x.1.f32s()?;
    let mut sums = vec![0f64; count(out)];
    for (i, v) in values.iter().enumerate() {
        let at = unravel(i, x.0);
        let to = at.iter().enumerate().map(|(a, p)| if axes.contains(&a) { 0 } else { *p });
        sums[ravel(to, out)] += f64::from(*v);
    }
    let n = if node.op == "ReduceMean" { values.len() / count(out).max(1) } else { 1 };
    Some(Data::F32(sums.iter().map(|s| (s / n as f64) as f32).collect()))
}

fn softmax(x: Known<'_>, axis: i64) -> Option<Data> {
    let rank = x.0.len() as i64;
    let axis = if axis < 0 { axis + rank } else { axis };
    // Anything but the last axis does not occur in constant parts.
    if axis != rank - 1 {
        return None;
    }
    let side = *x.0.last()?;
    let mut out = Vec::with_capacity(count(x.0));
    for row in x.1.f32s()?.chunks(side.max(1)) {
        let top = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let powers: Vec<f64> = row.iter().map(|v| f64::from(*v - top).exp()).collect();
        let sum: f64 = powers.iter().sum();
        out.extend(powers.iter().map(|p| (p / sum) as f32));
    }
    Some(Data::F32(out))
}

fn layer_norm(
    epsilon: f32,
    x: Known<'_>,
    gamma: Known<'_>,
    beta: Option<Known<'_>>,
) -> Option<Data> {
    let side = *x.0.last()?;
    let gamma = gamma.1.f32s()?;
    let beta = match beta {
        Some(beta) => beta.1.f32s()?.to_vec(),
        None => vec![0.0; side],
    };
    if gamma.len() != side || beta.len() != side || side == 0 {
        return None;
    }
    let mut out = Vec::with_capacity(count(x.0));
    for row in x.1.f32s()?.chunks(side) {
        let mean = row.iter().map(|v| f64::from(*v)).sum::<f64>() / side as f64;
        let var = row.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / side as f64;
        let scale = 1.0 / (var + f64::from(epsilon)).sqrt();
        let one = |(i, v): (usize, &f32)| {
            ((f64::from(*v) - mean) * scale * f64::from(gamma[i]) + f64::from(beta[i])) as f32
        };
        out.extend(row.iter().enumerate().map(one));
    }
    Some(Data::F32(out))
}

fn concat(inputs: &[Option<Known<'_>>], axis: usize, out: &[usize]) -> Option<Data> {
    let parts = inputs.iter().copied().collect::<Option<Vec<_>>>()?;
    // Which part, and where in it, each place along the axis comes from.
    let origin: Vec<(usize, usize)> = (parts.iter().enumerate())
        .flat_map(|(part, (dims, _))| (0..dims[axis]).map(move |at| (part, at)))
        .collect();
    let source = |i: usize| {
        let mut at = unravel(i, out);
        let (part, along) = origin[at[axis]];
        at[axis] = along;
        (part, ravel(at.into_iter(), parts[part].0))
    };
    let places = (0..count(out)).map(source);
    match parts.first()?.1 {
        Data::F32(_) => {
            let data = parts.iter().map(|p| p.1.f32s()).collect::<Option<Vec<_>>>()?;
            Some(Data::F32(places.map(|(part, i)| data[part][i]).collect()))
        }
        Data::I64(_) => {
            let data = parts.iter().map(|p| p.1.i64s()).collect::<Option<Vec<_>>>()?;
            Some(Data::I64(places.map(|(part, i)| data[part][i]).collect()))
        }
        Data::Bool(_) => None,
    }
}

fn cast(x: &Data, to: i64) -> Option<Data> {
    const FLOAT: i64 = data_type::FLOAT as i64;
    const INT64: i64 = data_type::INT64 as i64;
    Some(match (x, to) {
        (Data::I64(v), FLOAT) => Data::F32(v.iter().map(|v| *v as f32).collect()),
        (Data::Bool(v), FLOAT) => Data::F32(v.iter().map(|v| f32::from(*v)).collect()),
        (Data::F32(v), INT64) => Data::I64(v.iter().map(|v| *v as i64).collect()),
        (Data::Bool(v), INT64) => Data::I64(v.iter().map(|v| i64::from(*v)).collect()),
        (Data::F32(_), FLOAT) | (Data::I64(_), INT64) => x.clone(),
        _ => return None,
    })
}

/// Elements of `x` in the order `from` says.
fn each(x: &Data, out: &[usize], from: impl Fn(usize) -> usize) -> Option<Data> {
    let order = (0..count(out)).map(from);
    Some(match x {
        Data::F32(v) => Data::F32(order.map(|i| v[i]).collect()),
        Data::I64(v) => Data::I64(order.map(|i| v[i]).collect()),
        Data::Bool(v) => Data::Bool(order.map(|i| v[i]).collect()),
    })
}

fn count(dims: &[usize]) -> usize {
    dims.iter().product()
}

/// Position of flat index `i` in a tensor of shape `dims`.
fn unravel(mut i: usize, dims: &[usize]) -> Vec<usize> {
    let mut at = vec![0; dims.len()];
    for (place, side) in at.iter_mut().zip(dims).rev() {
        *place = i % side;
        i /= side;
    }
    at
}

fn ravel(at: impl Iterator<Item = usize>, dims: &[usize]) -> usize {
    at.zip(dims).fold(0, |i, (place, side)| i * side + place)
}

/// Flat index in a tensor of shape `from` of what index `i` of its broadcast to `out` reads.
fn broadcast(mut i: usize, out: &[usize], from: &[usize]) -> usize {
    let (mut index, mut stride) = (0, 1);
    let missing = out.len() - from.len();
    for axis in (0..out.len()).rev() {
        let place = i % out[axis];
        i /= out[axis];
        if axis >= missing {
            let side = from[axis - missing];
            if side != 1 {
                index += place * stride;
            }
            stride *= side;
        }
    }
    index
}
