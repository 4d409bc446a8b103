//! 3 x 3 convolutions as products of transformed windows and weights, where that is less work and
//! the weights, which grow by 7/9, may still grow.

use super::super::super::graph::{Post, Window};
use super::super::super::kernels::{
    FromPoints, Gemm, KernelsToPoints, Matrices, POINTS, Pitch, Place, Step, ToPoints, transform,
};
use super::super::view::{Base, View};
use super::super::{ALIGN, Made, source, spread};
use super::{Lower, MapSource, MapTarget, Try, four};

/// Fewest input or output channels: with fewer the transforms cost what the products save.
const CHANNELS: usize = 32;
/// Fewest full tiles of rows in a product.
const ROWS: usize = 3;
/// Floats of points, before and after the products, that are worked on at a time: they stay in the
/// second-level cache.
const BLOCK: usize = 256 * 1024;
/// Full tiles of rows in a block, at least: weights are read once per block.
const BLOCK_ROWS: usize = 8;
/// Fewest full tiles of rows where weights are transformed in every run: below that it takes longer than
/// the products save.
const FRESH_ROWS: usize = 5;
/// Floats of such weights that are made and used at a time, beside the points.
const FRESH: usize = 512 * 1024;

/// Weights for products of points.
#[derive(Clone, Copy, Debug)]
pub(super) enum Points {
    /// Transformed at load.
    Made(usize),
    /// To be transformed in every run, from what the convolution itself would read.
    Fresh(usize),
}

impl Lower<'_, '_, '_> {
    /// The weights of a convolution of one group over floats, if it is one for this way: 3 x 3, every
    /// pixel, one pixel of border, a result of even size. They are transformed at load as long as
    /// weights may grow.
    pub(super) fn points(
        &mut self,
        id: usize,
        window: &Window,
        size: [usize; 2],
    ) -> Try<Option<Points>> {
        let [n, channels, kh, kw] = four(self.graph.shape(id))?;
        let tiles = size[0] * size[1] / 4;
        let fits = [kh, kw] == [3, 3]
            && window.stride == [1, 1]
            && window.dilation == [1, 1]
            && window.pad == [1, 1, 1, 1]
            && size.iter().all(|n| n.is_multiple_of(2))
            && tiles >= ROWS * self.planner.kernels.rows
            && channels.min(n) >= CHANNELS;
        let Some(growth) = self.planner.growth.filter(|_| fits && !self.once) else {
            return Ok(None);
        };
        let data = self.graph.values[id].data.as_ref().ok_or("an operand is not constant")?;
        let made = Made::Points(source(self.index, id, data));
        if let Some(&at) = self.planner.made.get(&made) {
            return Ok(Some(Points::Made(at)));
        }
        let grown = (POINTS - 9) * channels * n;
        let Some(left) = growth.checked_sub(grown) else {
            let worth = tiles >= FRESH_ROWS * self.planner.kernels.rows;
            let fresh = worth.then(|| self.pack_kernel(id, 0, n)).transpose()?;
            return Ok(fresh.map(Points::Fresh));
        };
        self.planner.growth = Some(left);
        let (data, _) = self.constant(id)?;
        let packing = self.planner.kernels.packing;
        Ok(Some(Points::Made(self.planner.make(made, || {
            let mut points = vec![0.0; POINTS * channels * n];
            for (at, kernel) in data.chunks_exact(9).enumerate() {
                let (column, channel) = (at / channels, at % channels);
                let kernel = core::array::from_fn(|y| core::array::from_fn(|x| kernel[3 * y + x]));
                for (p, v) in transform(kernel).into_iter().enumerate() {
                    points[(p * channels + channel) * n + column] = v;
                }
            }
            let mut packed = Vec::with_capacity(POINTS * packing.len(channels, n));
            for matrix in points.chunks_exact(channels * n) {
                let row = |k: usize, out: &mut [f32]| out.copy_from_slice(&matrix[k * n..][..n]);
                packing.pack(channels, n, row, &mut packed);
            }
            packed
        }))))
    }

    /// The convolution with those weights, block by block of lines of the result.
    pub(super) fn winograd(
        &mut self,
        weights: Points,
        [channels, columns]: [usize; 2],
        source: &MapSource,
        target: &MapTarget,
        residual: Option<(Place, Pitch)>,
        post: &Post,
    ) -> Try<()> {
        let Base::Arena(at) = source.base else { return Err("an input that is constant".into()) };
        let pitch = source.pitch;
        let start = at + source.offset - pitch.y - pitch.x;
        let bias = self.channels(post.bias, columns, true)?;
        let [_, _, oh, ow] = four(&target.view.shape)?;
        let (all, across) = (oh / 2, ow / 2);
        let row = |n: usize| {
            let n = n.next_multiple_of(ALIGN);
            n + spread(n)
        };
        let (row_in, row_out) = (row(channels), row(columns));
        let tiles =
            (BLOCK / (POINTS * (row_in + row_out))).max(BLOCK_ROWS * self.planner.kernels.rows);
        let blocks = all.div_ceil(tiles.div_ceil(across));
        let lines = all.div_ceil(blocks);
        let mut matrices = |row: usize| {
            let matrix = lines * across * row;
            let matrix = matrix + spread(matrix);
            Matrices { start: self.buffer(POINTS * matrix), row, matrix }
        };
        let (before, after) = (matrices(row_in), matrices(row_out));
        if let Some(border) = target.halo {
            self.push(Step::Clear(border));
        }
        let packing = self.planner.kernels.packing;
        // Where all columns of fresh weights are not needed again for the next block, a few at a time do.
        let group = match weights {
            Points::Fresh(_) if blocks == 1 => {
                let panels = FRESH / (POINTS * channels * packing.width);
                (panels.max(1) * packing.width).min(columns)
            }
            _ => columns,
        };
        let (packed, fresh) = match weights {
            Points::Fresh(at) => (at, Some(self.buffer(POINTS * packing.len(channels, group)))),
            Points::Made(at) => (at, None),
        };
        let pitches = (Pitch { y: 0, x: row_in }, Pitch { y: 0, x: row_out });
        for first in (0..all).step_by(lines) {
            let size = [lines.min(all - first), across];
            self.push(Step::ToPoints(ToPoints {
                size,
                channels,
                input: Place::Arena(start + 2 * first * pitch.y),
                input_pitch: pitch,
                output: before,
            }));
            for column in (0..columns).step_by(group) {
                let columns = group.min(columns - column);
                let ready = match fresh {
                    Some(output) => {
                        if first == 0 {
                            let weights = packed + 9 * packing.len(channels, column);
                            let step = KernelsToPoints { channels, columns, weights, output };
                            self.push(Step::KernelsToPoints(step));
                        }
                        Place::Arena(output)
                    }
                    None => Place::Weights(packed),
                };
                for p in 0..POINTS {
                    let matrix = |m: &Matrices, column: usize| {
                        View::dense(Base::Arena(m.start + p * m.matrix + column), &[])
                    };
                    let weights = ready.beyond(p * packing.len(channels, columns));
                    let (from, to) = (matrix(&before, 0), matrix(&after, column));
                    let rows = [1, size[0] * size[1]];
                    self.gemm(&from, rows, pitches, channels, &to, |gemm| Gemm {
                        weights,
                        columns,
                        ..gemm
                    })?;
                }
            }
            self.push(Step::FromPoints(FromPoints {
                size,
                columns,
                input: after,
                bias,
                output: target.output + 2 * first * target.pitch.y,
                output_pitch: target.pitch,
                residual: residual.map(|(place, pitch)| (place.beyond(2 * first * pitch.y), pitch)),
                swish: post.swish,
                clamp: post.clamp,
            }));
        }
        Ok(())
    }
}
