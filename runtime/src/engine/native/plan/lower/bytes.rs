//! Products of 8-bit numbers: activations that are rounded to bytes once, for all products that can
//! take them so, and weights that stay the bytes they are in the bundle.

use super::super::super::graph::{Data, Node, Op, Post, Unary};
use super::super::super::kernels::{Eight, Quantise, Step};
use super::super::rows::rows;
use super::super::view::View;
use super::super::{Made, Source};
use super::{Lower, MapSource, TOO_MANY, Try, address, four};

/// How the users of a rounded tensor read it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Shape {
    /// As a map: convolutions.
    Map,
    /// As rows: linear layers.
    Rows,
}

/// A tensor as bytes, four in the place of a float.
#[derive(Clone, Debug)]
pub(super) struct Bytes {
    shape: Shape,
    /// Channels in groups of four.
    pub view: View,
    scale: f32,
    zero: u8,
}

impl Bytes {
    /// The map, for windows.
    pub fn source(&self) -> MapSource {
        let View { base, offset, stride, .. } = &self.view;
        let pitch = super::Pitch { y: stride[2], x: stride[3] };
        MapSource { base: *base, offset: *offset, pitch }
    }
}

/// Constant operands of a product, in the weights.
#[derive(Clone, Copy, Debug)]
pub(super) struct Operands {
    pub weights: usize,
    pub bias: Option<usize>,
    pub scales: Option<usize>,
}

/// Constant weights of bytes.
struct Weights<'g> {
    bytes: &'g [u8],
    scale: &'g [f32],
    shape: Vec<usize>,
    from: Source,
}

impl Weights<'_> {
    /// Output channels.
    fn columns(&self) -> usize {
        if self.shape.len() == 4 { self.shape[0] } else { self.shape[1] }
    }

    /// Rows of the packed matrix: positions in the kernel, and channels of the input.
    fn rows(&self) -> (usize, usize) {
        match *self.shape {
            [_, channels, height, width] => (height * width, channels),
            [channels, _] => (1, channels),
            _ => (0, 0),
        }
    }

    fn at(&self, position: usize, channel: usize, column: usize) -> i8 {
        let (area, channels) = self.rows();
        let at = if self.shape.len() == 4 {
            (column * channels + channel) * area + position
        } else {
            channel * self.shape[1] + column
        };
        self.bytes[at].cast_signed()
    }
}

impl Lower<'_, '_, '_> {
    /// [`Unary::Round`]: as bytes for products that take them, as floats for everybody else.
    pub(super) fn round(&mut self, node: &Node, x: &View, scale: f32, zero: u8) -> Try<View> {
        let value = node.output;
        let users = || self.graph.nodes.iter().filter(|n| n.operands().any(|id| id == value));
        let taken = |n: &Node| self.takes_bytes(n, value);
        let shape = if users().any(|n| taken(n) == Some(Shape::Map)) {
            Shape::Map
        } else if users().any(|n| taken(n) == Some(Shape::Rows)) {
            Shape::Rows
        } else {
            return self.unary(Unary::Round { scale, zero }, x, value);
        };
        let others =
            self.graph.outputs.contains(&value) || users().any(|n| taken(n) != Some(shape));
        let view = match shape {
            Shape::Map => self.round_map(x, value, 1.0 / scale, zero)?,
            Shape::Rows => self.round_rows(x, 1.0 / scale, zero)?,
        };
        let hidden = View { shape: x.shape.clone(), ..view.clone() };
        self.bytes[value] = Some(Bytes { shape, view, scale, zero });
        // Nobody looks at the view of a tensor that all users take as bytes.
        if others { self.unary(Unary::Round { scale, zero }, x, value) } else { Ok(hidden) }
    }

    fn round_map(&mut self, x: &View, value: usize, factor: f32, zero: u8) -> Try<View> {
        let [_, channels, height, width] = four(&x.shape)?;
        let source = self.map_source(x, 0)?;
        let target = self.new_map(Eight::floats(channels), [height, width], self.halo[value]);
        self.push(Step::Quantise(Quantise {
            size: [height, width],
            channels,
            input: self.place(source.base, source.offset)?,
            input_pitch: source.pitch,
            output: target.output,
            output_pitch: target.pitch,
            factor,
            zero,
            halo: target.halo,
        }));
        Ok(target.view)
    }

    fn round_rows(&mut self, x: &View, factor: f32, zero: u8) -> Try<View> {
        let mut x = self.runs(x)?;
        let channels = *x.shape.last().ok_or("a number without dimensions")?;
        let mut shape = x.shape.clone();
        if let Some(last) = shape.last_mut() {
            *last = Eight::floats(channels);
        }
        let to = self.matrix(&shape);
        if rows(&[&x, &to]).is_none() {
            x = self.whole(&x)?;
        }
        let rows = rows(&[&x, &to]).ok_or(TOO_MANY)?;
        self.push(Step::Quantise(Quantise {
            size: rows.size,
            channels,
            input: self.place(x.base, x.offset)?,
            input_pitch: rows.pitch[0],
            output: address(&to)?,
            output_pitch: rows.pitch[1],
            factor,
            zero,
            halo: None,
        }));
        Ok(to)
    }

    /// Whether a node is a product of bytes when this value, its input, is one of bytes.
    fn takes_bytes(&self, node: &Node, value: usize) -> Option<Shape> {
        let (shape, post) = match &node.op {
            Op::Conv { group: 1, post, .. } => (Shape::Map, post),
            Op::MatMul { post } => (Shape::Rows, post),
            _ => return None,
        };
        let whole = node.inputs[0] == value && node.inputs[1] != value;
        (whole && post.residual != Some(value)).then_some(())?;
        self.byte_weights(node.inputs[1]).map(|_| shape)
    }

    /// Weights of bytes with one scale, or one per output channel.
    fn byte_weights(&self, id: usize) -> Option<Weights<'_>> {
        let value = &self.graph.values[id];
        let data = value.data.as_ref()?;
        let Data::Scaled { bytes, scale, inner } = data else { return None };
        let shape = value.shape.clone();
        let along = match *shape {
            [_, channels, height, width] => channels * height * width,
            [_, _] => 1,
            _ => return None,
        };
        let weights =
            Weights { bytes, scale, shape, from: super::super::source(self.index, id, data) };
        let fits = scale.len() == 1 || (scale.len() == weights.columns() && *inner == along);
        fits.then_some(weights)
    }

    /// The input of a product as bytes, if it is there and the product takes it.
    pub(super) fn byte_input(&self, node: &Node) -> Option<Bytes> {
        let value = node.inputs[0];
        let bytes = self.bytes[value].as_ref()?;
        (self.takes_bytes(node, value) == Some(bytes.shape)).then(|| bytes.clone())
    }

    /// Weights, factors and offsets of a product of bytes: with the input `(a - zero) * scale` it is
    /// `sum(a * w) * factor + offset`, and `offset` is the bias less `zero * factor * sum(w)`.
    pub(super) fn byte_operands(
        &mut self,
        input: &Bytes,
        weights: usize,
        post: &Post,
    ) -> Try<Operands> {
        let bias = post.bias.map(|id| self.constant(id)).transpose()?;
        let eight = &self.planner.kernels.eight;
        let weights = self.byte_weights(weights).ok_or("weights that are not bytes")?;
        let (columns, (area, channels)) = (weights.columns(), weights.rows());
        let padded = eight.packing.columns(columns);
        let factor = |column: usize| {
            let scale = weights.scale[if weights.scale.len() == 1 { 0 } else { column }];
            input.scale * scale
        };
        let factors: Vec<f32> =
            (0..padded).map(|j| if j < columns { factor(j) } else { 0.0 }).collect();
        let zero = f64::from(i32::from(input.zero) - eight.shift);
        let offset = |column: usize| {
            let all = (0..area).flat_map(|p| (0..channels).map(move |c| (p, c)));
            let sum: i64 = all.map(|(p, c)| i64::from(weights.at(p, c, column))).sum();
            let bias = bias.as_ref().map_or(0.0, |(values, _)| f64::from(values[column]));
            (bias - zero * f64::from(factor(column)) * sum as f64) as f32
        };
        if bias.as_ref().is_some_and(|(values, _)| values.len() != columns) {
            return Err(format!("a bias that has not {columns} numbers"));
        }
        let offsets: Vec<f32> =
            (0..padded).map(|j| if j < columns { offset(j) } else { 0.0 }).collect();
        let groups = Eight::floats(channels);
        let depth = 4 * groups;
        let mut packed = Vec::with_capacity(eight.packing.len(area * groups, columns));
        let weight = |row: usize, column: usize| {
            let (position, channel) = (row / depth, row % depth);
            if channel < channels { weights.at(position, channel, column) } else { 0 }
        };
        let (from, shape) = (weights.from, weights.shape.clone());
        let made = Made::Bytes(from, shape);
        if !self.planner.made.contains_key(&made) {
            eight.pack(area * groups, columns, weight, &mut packed);
        }
        let step = input.scale.to_bits();
        let bias_from = bias.as_ref().map(|(_, from)| *from);
        Ok(Operands {
            weights: self.planner.make(made, || packed),
            bias: Some(
                self.planner.make(Made::Offsets(from, bias_from, step, input.zero), || offsets),
            ),
            scales: Some(self.planner.make(Made::Scales(from, step), || factors)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_found_where_they_lie() {
        let bytes: Vec<u8> = (0..24).collect();
        let from = Source::Bytes(0, 0);
        let kernel = Weights { bytes: &bytes, scale: &[1.0], shape: vec![2, 3, 2, 2], from };
        assert_eq!((kernel.columns(), kernel.rows()), (2, (4, 3)));
        assert_eq!(kernel.at(3, 2, 1), 23);
        assert_eq!(kernel.at(1, 0, 1), 13);
        let matrix = Weights { shape: vec![6, 4], ..kernel };
        assert_eq!((matrix.columns(), matrix.rows()), (4, (1, 6)));
        assert_eq!(matrix.at(0, 5, 1), 21);
    }
}
