//! Convolutions, matrix products, attention.

use super::super::super::graph::{Node, Post, Window};
use super::super::super::kernels::{
    Attention, Depthwise, Eight, Gemm, MatMul, PackKv, PackKvBytes, Pitch, Place, Step,
    ThinAttention,
};
use super::super::rows::{offsets, rows};
use super::super::view::{Base, View};
use super::super::{Made, gather};
use super::bytes::Operands;
use super::{Lower, TOO_MANY, Try, address, four};

/// Floats of input and output rows that stay in the second-level cache beside a panel of weights.
const BLOCK: usize = 96 * 1024;
/// Queries up to which attention reads keys and values where they lie.
const THIN: usize = 16;

impl Lower<'_, '_, '_> {
    pub(super) fn conv(
        &mut self,
        node: &Node,
        window: &Window,
        group: usize,
        post: &Post,
    ) -> Try<View> {
        let x = self.view(node.inputs[0]);
        let weights = node.inputs[1];
        let [_, channels, _, _] = four(&x.shape)?;
        let [n, per_group, kh, kw] = four(self.graph.shape(weights))?;
        let bytes = self.byte_input(node);
        let source = match &bytes {
            Some(bytes) => bytes.source(),
            None => self.map_source(&x, window.halo())?,
        };
        // Places of floats that a pixel takes.
        let depth = if bytes.is_some() { Eight::floats(per_group) } else { per_group };
        let target = self.map_target(node.output)?;
        let [_, _, oh, ow] = four(&target.view.shape)?;
        let pitch = source.pitch;
        let [top, left, _, _] = window.pad;
        let start = match source.base {
            // The border lies before the first pixel.
            Base::Arena(at) => Place::Arena(at + source.offset - top * pitch.y - left * pitch.x),
            _ => return Err("an input that is constant".into()),
        };
        let stride = Pitch { y: pitch.y * window.stride[0], x: pitch.x * window.stride[1] };
        let lines = (0..kh).map(|y| y * window.dilation[0] * pitch.y);
        let taps = lines
            .clone()
            .flat_map(|y| (0..kw).map(move |x| y + x * window.dilation[1] * pitch.x))
            .collect();

        let own = group == channels && n == channels && per_group == 1;
        if own && post.residual.is_none() && bytes.is_none() {
            let (data, from) = self.constant(weights)?;
            let (shape, order) = ([kh * kw, n], [1, kh * kw]);
            let made = Made::Copy(from, 0, shape.into(), order.into());
            let kernel = self.planner.make(made, || gather(&data, 0, &shape, &order));
            let bias = self.channels(post.bias, n, false)?;
            self.push(Step::Depthwise(Depthwise {
                size: [oh, ow],
                channels,
                input: start,
                input_pitch: stride,
                taps,
                weights: kernel,
                bias,
                output: target.output,
                output_pitch: target.pitch,
                swish: post.swish,
                clamp: post.clamp,
                halo: target.halo,
            }));
            return Ok(target.view);
        }

        let residual = match post.residual {
            Some(id) => {
                let view = self.view(id);
                let source = self.map_source(&view, 0)?;
                Some((self.place(source.base, source.offset)?, source.pitch))
            }
            None => None,
        };
        if bytes.is_none()
            && group == 1
            && let Some(points) = self.points(weights, window, [oh, ow])?
        {
            self.winograd(points, [channels, n], &source, &target, residual, post)?;
            return Ok(target.view);
        }
        // The pixels of a window's line are one run when nothing lies between them.
        let joined = group == 1 && pitch.x == depth && window.dilation[1] == 1;
        let (taps, run): (Box<[usize]>, usize) =
            if joined { (lines.collect(), kw * depth) } else { (taps, depth) };
        let footprint = pitch.x * window.stride[0] * window.stride[1];
        let columns = n / group;
        for g in 0..group {
            let bias = match (post.bias, group) {
                _ if bytes.is_some() => None,
                (bias, 1) => self.channels(bias, n, true)?,
                (None, _) => None,
                (Some(id), _) => {
                    let (data, from) = self.constant(id)?;
                    let len = self.planner.kernels.packing.columns(columns);
                    let made = Made::Copy(from, g * columns, vec![len], vec![1]);
                    Some(self.planner.make(made, || {
                        let mut part = data[g * columns..(g + 1) * columns].to_vec();
                        part.resize(len, 0.0);
                        part
                    }))
                }
            };
            let Operands { weights, bias, scales } = match &bytes {
                Some(input) => self.byte_operands(input, weights, post)?,
                None => {
                    let weights = self.pack_kernel(weights, g * columns, columns)?;
                    Operands { weights, bias, scales: None }
                }
            };
            let shifted = |(place, pitch): (Place, Pitch)| (place.beyond(g * columns), pitch);
            self.push(Step::Gemm(Gemm {
                size: [oh, ow],
                input: start.beyond(g * per_group),
                input_pitch: stride,
                taps: taps.clone(),
                run,
                weights: Place::Weights(weights),
                bias,
                scales,
                columns,
                output: target.output + g * columns,
                output_pitch: target.pitch,
                residual: residual.map(shifted),
                swish: post.swish,
                clamp: post.clamp,
                halo: target.halo.filter(|_| g == 0),
                block: BLOCK / footprint.max(1),
            }));
        }
        Ok(target.view)
    }

    /// Packs output channels `first .. first + count` of a convolution's weights `(N, C, h, w)` as a
    /// matrix with rows `(h, w, C)`.
    pub(super) fn pack_kernel(&mut self, id: usize, first: usize, count: usize) -> Try<usize> {
        let [_, channels, kh, kw] = four(self.graph.shape(id))?;
        let (data, from) = self.constant(id)?;
        let area = kh * kw;
        let depth = channels * area;
        let made = Made::Packed(from, first, vec![area, channels, count], vec![1, area, depth]);
        let packing = self.planner.kernels.packing;
        let row = |k: usize, out: &mut [f32]| {
            let at = k % channels * area + k / channels;
            for (j, v) in out.iter_mut().enumerate() {
                *v = data[(first + j) * depth + at];
            }
        };
        Ok(self.planner.make(made, || {
            let mut packed = Vec::with_capacity(packing.len(depth, count));
            packing.pack(depth, count, row, &mut packed);
            packed
        }))
    }

    pub(super) fn matmul(&mut self, node: &Node, post: &Post) -> Try<View> {
        let (a, b) = (self.view(node.inputs[0]), self.view(node.inputs[1]));
        let shape = self.graph.shape(node.output).to_vec();
        if let Some(bytes) = self.byte_input(node) {
            let operands = self.byte_operands(&bytes, node.inputs[1], post)?;
            let size = [Eight::floats(b.shape[0]), b.shape[1]];
            return self.linear(&bytes.view, operands, size, &shape, post);
        }
        if matches!(b.base, Base::Constant(_)) {
            if b.shape.len() == 2 {
                let weights = self.pack_matrix(&b)?;
                let bias = self.channels(post.bias, b.shape[1], true)?;
                let operands = Operands { weights, bias, scales: None };
                return self.linear(&a, operands, [b.shape[0], b.shape[1]], &shape, post);
            }
            return self.linear_batch(&a, &b, &shape);
        }
        self.product(&a, &b, &shape)
    }

    /// A tensor times a constant matrix of `depth` rows.
    fn linear(
        &mut self,
        a: &View,
        operands: Operands,
        [depth, columns]: [usize; 2],
        shape: &[usize],
        post: &Post,
    ) -> Try<View> {
        let mut a = self.runs(a)?;
        let to = self.matrix(shape);
        let mut residual = match post.residual {
            Some(id) => {
                let view = self.view(id);
                Some(self.runs(&view)?)
            }
            None => None,
        };
        // One for every block of rows: the same rows, written as lines of a block each.
        let mut lines = to.clone();
        if let Some(r) = &mut residual
            && r.shape != shape
        {
            let block = r.shape.iter().product::<usize>() / columns;
            let blocks = shape.iter().product::<usize>() / columns / block;
            let cut = |v: &View| {
                let width = v.shape.last().copied().unwrap_or(1);
                v.reshaped(&[blocks, block, width]).ok_or(TOO_MANY)
            };
            *r = r
                .reshaped(&[1, block, columns])
                .ok_or(TOO_MANY)?
                .expanded(&[blocks, block, columns]);
            lines = cut(&lines)?;
            a = match cut(&a) {
                Ok(a) => a,
                Err(_) => cut(&self.whole(&a)?)?,
            };
        }
        let views = |a: &View, r: &Option<View>| -> Vec<View> {
            [Some(a), Some(&lines), r.as_ref()].into_iter().flatten().cloned().collect()
        };
        let joined = |a: &View, r: &Option<View>| {
            let all = views(a, r);
            rows(&all.iter().collect::<Vec<_>>())
        };
        if joined(&a, &residual).is_none() {
            a = self.whole(&a)?;
            residual = residual.map(|r| self.whole(&r)).transpose()?;
        }
        let rows = joined(&a, &residual).ok_or(TOO_MANY)?;
        let Operands { weights, bias, scales } = operands;
        let residual = match &residual {
            Some(r) => Some((self.place(r.base, r.offset)?, rows.pitch[2])),
            None => None,
        };
        self.gemm(&a, rows.size, (rows.pitch[0], rows.pitch[1]), depth, &to, |gemm| Gemm {
            weights: Place::Weights(weights),
            bias,
            scales,
            columns,
            residual,
            swish: post.swish,
            clamp: post.clamp,
            ..gemm
        })?;
        Ok(to)
    }

    /// A product with a constant matrix of `depth` rows, of tensors whose rows lie like this; weights
    /// and columns are for `rest` to say.
    pub(super) fn gemm(
        &mut self,
        a: &View,
        size: [usize; 2],
        pitch: (Pitch, Pitch),
        depth: usize,
        to: &View,
        rest: impl FnOnce(Gemm) -> Gemm,
    ) -> Try<()> {
        let gemm = Gemm {
            size,
            input: self.place(a.base, a.offset)?,
            input_pitch: pitch.0,
            taps: [0].into(),
            run: depth,
            weights: Place::Weights(0),
            bias: None,
            columns: 0,
            output: address(to)?,
            output_pitch: pitch.1,
            residual: None,
            swish: false,
            clamp: (f32::NEG_INFINITY, f32::INFINITY),
            halo: None,
            block: BLOCK / depth.max(1),
            scales: None,
        };
        self.push(Step::Gemm(rest(gemm)));
        Ok(())
    }

    /// Every matrix of a batch times its own constant matrix.
    fn linear_batch(&mut self, a: &View, b: &View, shape: &[usize]) -> Try<View> {
        let a = self.runs(a)?;
        let to = self.matrix(shape);
        let outer = shape.len() - 2;
        let expand = |v: &View| {
            let tail = &v.shape[v.shape.len() - 2..];
            v.expanded(&[&shape[..outer], tail].concat())
        };
        let (a, b) = (expand(&a), expand(b));
        let strides = [&a, &b, &to].map(|v| &v.stride[..outer]);
        for [ia, ib, io] in offsets(&shape[..outer], strides) {
            let matrix = |v: &View, at: usize| View {
                base: v.base,
                offset: v.offset + at,
                shape: v.shape[outer..].into(),
                stride: v.stride[outer..].into(),
                halo: 0,
            };
            let (a, b, to) = (matrix(&a, ia), matrix(&b, ib), matrix(&to, io));
            let weights = self.pack_matrix(&b)?;
            let pitch = |v: &View| Pitch { y: 0, x: v.stride[0] };
            let (size, pitches) = ([1, a.shape[0]], (pitch(&a), pitch(&to)));
            let columns = b.shape[1];
            self.gemm(&a, size, pitches, b.shape[0], &to, |gemm| Gemm {
                weights: Place::Weights(weights),
                columns,
                ..gemm
            })?;
        }
        Ok(to)
    }

    /// Packs a constant matrix, as the view shows it.
    fn pack_matrix(&mut self, b: &View) -> Try<usize> {
        let Base::Constant(id) = b.base else { return Err("weights that are not constant".into()) };
        let (data, from) = self.constant(id)?;
        let made = Made::Packed(from, b.offset, b.shape.clone(), b.stride.clone());
        let packing = self.planner.kernels.packing;
        let (depth, columns) = (b.shape[0], b.shape[1]);
        Ok(self.planner.make(made, || {
            let mut packed = Vec::with_capacity(packing.len(depth, columns));
            let row = |k: usize, out: &mut [f32]| {
                let at = b.offset + k * b.stride[0];
                for (j, v) in out.iter_mut().enumerate() {
                    *v = data[at + j * b.stride[1]];
                }
            };
            packing.pack(depth, columns, row, &mut packed);
            packed
        }))
    }

    /// A product of two computed tensors.
    fn product(&mut self, a: &View, b: &View, shape: &[usize]) -> Try<View> {
        let outer = shape.len() - 2;
        let a = self.runs(a)?;
        let last = b.shape.len() - 2;
        let (sum, columns) = (b.shape[last], b.shape[last + 1]);
        let run = |i: usize| b.shape[last + i] == 1 || b.stride[last + i] == 1;
        let b = if run(0) || run(1) { b.clone() } else { self.whole(b)? };
        let to = self.matrix(shape);
        let tail = |v: &View, i: usize| v.stride[v.stride.len() - 2 + i];
        let (b_sum, b_column) = if columns == 1 {
            (tail(&b, 0), 1)
        } else if sum == 1 {
            (1, tail(&b, 1))
        } else {
            (tail(&b, 0), tail(&b, 1))
        };
        let expand =
            |v: &View| v.expanded(&[&shape[..outer], &v.shape[v.shape.len() - 2..]].concat());
        let (wide_a, wide_b) = (expand(&a), expand(&b));
        let strides = [&wide_a, &wide_b, &to].map(|v| &v.stride[..outer]);
        self.push(Step::MatMul(MatMul {
            batch: offsets(&shape[..outer], strides).into(),
            size: [shape[outer], sum, columns],
            a: self.place(a.base, a.offset)?,
            a_row: tail(&a, 0),
            b: self.place(b.base, b.offset)?,
            b_sum,
            b_column,
            c: address(&to)?,
            c_row: to.stride[outer],
        }));
        Ok(to)
    }

    pub(super) fn attention(&mut self, node: &Node, scale: f32) -> Try<View> {
        let [q, kt, v] = [0, 1, 2].map(|i| self.view(node.inputs[i]));
        let q = self.runs(&q)?;
        let (kt, mut v) = (self.placed(&kt)?, self.placed(&v)?);
        let outer = q.shape.len() - 2;
        let (queries, key) = (q.shape[outer], q.shape[outer + 1]);
        let (keys, value) = (v.shape[outer], v.shape[outer + 1]);
        if self.byte_attention && queries > THIN && key.max(keys) <= PackKvBytes::DEEPEST {
            return self.attention_of_bytes([&q, &kt, &v], scale);
        }
        let shape = [&q.shape[..outer], &[queries, value]].concat();
        let to = self.beside(&shape);
        let batch = q.shape[..outer].to_vec();
        let strides = [&q, &kt, &v, &to].map(|v| &v.stride[..outer]);
        let heads = offsets(&batch, strides);
        let size = [keys, key, value];
        let scratch = self.buffer(self.planner.threads * Attention::scratch_len(keys));
        let keys_are_runs = key == 1 || kt.stride[outer] == 1;
        if queries <= THIN && keys_are_runs {
            let heads = if v.is_run() {
                heads
            } else {
                v = self.whole(&v)?;
                offsets(&batch, [&q, &kt, &v, &to].map(|v| &v.stride[..outer]))
            };
            self.push(Step::ThinAttention(ThinAttention {
                heads: heads.into(),
                queries,
                size,
                inputs: [
                    self.place(q.base, q.offset)?,
                    self.place(kt.base, kt.offset)?,
                    self.place(v.base, v.offset)?,
                ],
                rows: [q.stride[outer], kt.stride[outer + 1], v.stride[outer]],
                output: address(&to)?,
                output_row: to.stride[outer],
                scale,
                scratch,
            }));
            return Ok(to);
        }
        let panels = heads.len() * PackKv::len(size, self.planner.kernels).1;
        let panels = self.buffer(panels);
        self.push(Step::PackKv(PackKv {
            heads: heads.iter().map(|h| [h[1], h[2]]).collect(),
            keys: self.place(kt.base, kt.offset)?,
            key_stride: [kt.stride[outer + 1], kt.stride[outer]],
            values: self.place(v.base, v.offset)?,
            value_stride: [v.stride[outer], v.stride[outer + 1]],
            size,
            output: panels,
        }));
        let step = self.attend([&q, &to], &heads, size, scale, [panels, scratch])?;
        self.push(Step::Attention(step));
        Ok(to)
    }

    /// Attention of the queries over panels, into the result; both places of floats by now.
    fn attend(
        &self,
        [q, to]: [&View; 2],
        heads: &[[usize; 4]],
        size: [usize; 3],
        scale: f32,
        [panels, scratch]: [usize; 2],
    ) -> Try<Attention> {
        let outer = q.shape.len() - 2;
        Ok(Attention {
            heads: heads.iter().map(|h| [h[0], h[3]]).collect(),
            queries: q.shape[outer],
            size,
            input: self.place(q.base, q.offset)?,
            input_row: q.stride[outer],
            panels,
            output: address(to)?,
            output_row: to.stride[outer],
            scale,
            scratch,
        })
    }

    /// A new tensor with heads side by side within each query, which is how they are used next.
    fn beside(&mut self, shape: &[usize]) -> View {
        let outer = shape.len() - 2;
        let mut order: Vec<usize> = (0..outer + 2).collect();
        if outer > 0 {
            order.swap(outer - 1, outer);
        }
        self.tensor(shape, &order)
    }

    /// Attention of queries, transposed keys and values, rounded to bytes on the way.
    fn attention_of_bytes(&mut self, [q, kt, v]: [&View; 3], scale: f32) -> Try<View> {
        let outer = q.shape.len() - 2;
        let mut swapped: Vec<usize> = (0..outer + 2).collect();
        swapped.swap(outer, outer + 1);
        let (k, v) = (self.runs(&kt.transposed(&swapped))?, self.runs(v)?);
        let (queries, size) =
            (q.shape[outer], [v.shape[outer], q.shape[outer + 1], v.shape[outer + 1]]);
        let shape = [&q.shape[..outer], &[queries, size[2]]].concat();
        let to = self.beside(&shape);
        let strides = [q, &k, &v, &to].map(|v| &v.stride[..outer]);
        let heads = offsets(&q.shape[..outer], strides);
        let eight = &self.planner.kernels.eight;
        let scratch = self.planner.threads * PackKvBytes::scratch_len(size, eight);
        let panels = heads.len() * PackKvBytes::len(size, eight);
        let (scratch, panels) = (self.buffer(scratch), self.buffer(panels));
        self.push(Step::PackKvBytes(PackKvBytes {
            heads: heads.iter().map(|h| [h[1], h[2]]).collect(),
            keys: self.place(k.base, k.offset)?,
            key_row: k.stride[outer],
            values: self.place(v.base, v.offset)?,
            value_row: v.stride[outer],
            size,
            output: panels,
        }));
        let step = self.attend([q, &to], &heads, size, scale, [panels, scratch])?;
        self.push(Step::AttentionBytes(step));
        Ok(to)
    }
}
