//! Calls of kernels: what they cost, what they read and write.

use super::attention::Attention;
use super::eight::BYTES;
use super::winograd::{FromPoints, KernelsToPoints, POINTS, ToPoints};
use super::{
    Copy, Depthwise, Eight, Fold, Gemm, Halo, Kernels, LayerNorm, Map, MapNorm, MatMul, Mem,
    PackKv, PackKvBytes, Part, Pitch, Place, Pool, Quantise, Softmax, ThinAttention, Zip,
};

/// One call of a kernel.
#[derive(Clone, Debug)]
pub enum Step {
    /// Zeros around a map whose kernel does not write them.
    Clear(Halo),
    /// Product with a constant matrix, or convolution.
    Gemm(Gemm),
    /// Windows of 4 x 4 to points, for products in the place of a 3 x 3 convolution.
    ToPoints(ToPoints),
    /// Kernels of 3 x 3 to points, as weights of these products.
    KernelsToPoints(KernelsToPoints),
    /// Points to pixels, after these products.
    FromPoints(FromPoints),
    /// Floats to bytes.
    Quantise(Quantise),
    /// Convolution per channel.
    Depthwise(Depthwise),
    /// Maximum or mean over windows.
    Pool(Pool),
    /// Another layout.
    Copy(Copy),
    /// Function of one tensor.
    Map(Map),
    /// Function of two tensors.
    Zip(Zip),
    /// Reduction.
    Fold(Fold),
    /// Product of two computed tensors.
    MatMul(MatMul),
    /// Softmax of rows.
    Softmax(Softmax),
    /// Normalisation of rows.
    LayerNorm(LayerNorm),
    /// Normalisation of a map.
    MapNorm(MapNorm),
    /// Keys and values into panels.
    PackKv(PackKv),
    /// Attention over panels.
    Attention(Attention),
    /// Keys and values into panels of bytes.
    PackKvBytes(PackKvBytes),
    /// Attention over panels of bytes.
    AttentionBytes(Attention),
    /// Attention of few queries.
    ThinAttention(ThinAttention),
}

/// What a step costs, for sharing and reports.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cost {
    /// Floating-point operations, about.
    pub operations: usize,
}

/// Places that a step reads and writes, as runs of floats.
#[derive(Debug, Default)]
pub(super) struct Spans {
    pub(super) reads: Vec<(Place, usize)>,
    pub(super) writes: Vec<(usize, usize)>,
    /// What is wrong beyond places.
    pub(super) wrong: Option<&'static str>,
}

impl Spans {
    fn read(&mut self, place: Place, len: usize) {
        self.reads.push((place, len));
    }

    fn weights(&mut self, at: Option<usize>, len: usize) {
        self.reads.extend(at.map(|at| (Place::Weights(at), len)));
    }

    fn write(&mut self, at: usize, len: usize) {
        self.writes.push((at, len));
    }

    fn demand(&mut self, holds: bool, what: &'static str) {
        if !holds {
            self.wrong = Some(what);
        }
    }

    /// A result of lines and pixels with its border.
    fn map(&mut self, at: usize, size: [usize; 2], pitch: Pitch, run: usize, halo: Option<&Halo>) {
        self.write(at, extent(size, pitch, run));
        let apart = (size[1] == 1 || pitch.x >= run)
            && (size[0] == 1 || pitch.y >= (size[1] - 1) * pitch.x + run);
        self.demand(apart, "rows of its result overlap");
        if let Some(halo) = halo {
            self.border(halo);
            let inner = halo.start + halo.width * (halo.line + halo.pixel);
            let same = halo.size == size
                && at == inner
                && run <= halo.pixel
                && (pitch.x == halo.pixel || size[1] == 1)
                && (pitch.y == halo.line || size[0] == 1);
            self.demand(same, "its border is not that of its result");
        }
    }

    fn border(&mut self, halo: &Halo) {
        self.write(halo.start, halo.len());
        let wide = halo.line >= (halo.size[1] + 2 * halo.width) * halo.pixel;
        self.demand(wide, "its border has lines that overlap");
    }
}

/// Floats from the first to behind the last element.
const fn extent(size: [usize; 2], pitch: Pitch, run: usize) -> usize {
    (size[0] - 1) * pitch.y + (size[1] - 1) * pitch.x + run
}

fn farthest<const N: usize>(starts: &[[usize; N]], i: usize) -> usize {
    starts.iter().map(|s| s[i]).max().unwrap_or(0)
}

impl Step {
    /// Kind of kernel, for reports.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Clear(_) => "clear",
            Self::Gemm(s) => match (s.taps.len() > 1 || s.size[0] > 1, s.scales.is_some()) {
                (true, false) => "convolution",
                (true, true) => "convolution of bytes",
                (false, false) => "linear",
                (false, true) => "linear of bytes",
            },
            Self::ToPoints(_) => "to points",
            Self::KernelsToPoints(_) => "kernels to points",
            Self::FromPoints(_) => "from points",
            Self::Quantise(_) => "to bytes",
            Self::Depthwise(_) => "depthwise",
            Self::Pool(_) => "pool",
            Self::Copy(_) => "copy",
            Self::Map(_) => "map",
            Self::Zip(_) => "zip",
            Self::Fold(_) => "reduce",
            Self::MatMul(_) => "matmul",
            Self::Softmax(_) => "softmax",
            Self::LayerNorm(_) => "layer norm",
            Self::MapNorm(_) => "map norm",
            Self::PackKv(_) => "pack keys and values",
            Self::Attention(_) => "attention",
            Self::PackKvBytes(_) => "keys and values to bytes",
            Self::AttentionBytes(_) => "attention of bytes",
            Self::ThinAttention(_) => "attention of one query",
        }
    }

    /// What it costs.
    pub fn cost(&self) -> Cost {
        let operations = match self {
            Self::Clear(s) => s.len() / 4,
            Self::Gemm(s) => {
                let numbers = if s.scales.is_some() { BYTES } else { 1 };
                2 * s.rows() * s.columns * s.depth() * numbers
            }
            Self::ToPoints(s) => 32 * s.size[0] * s.size[1] * s.channels,
            Self::KernelsToPoints(s) => 36 * s.channels * s.columns,
            Self::FromPoints(s) => 32 * s.size[0] * s.size[1] * s.columns,
            Self::Quantise(s) => 4 * s.size[0] * s.size[1] * s.channels,
            Self::Depthwise(s) => 2 * s.size[0] * s.size[1] * s.channels * s.taps.len(),
            Self::Pool(s) => s.size[0] * s.size[1] * s.channels * s.kernel[0] * s.kernel[1],
            Self::Copy(s) => 2 * s.nest.len(),
            Self::Map(s) => 4 * s.nest.len(),
            Self::Zip(s) => 2 * s.nest.len(),
            Self::Fold(s) => 4 * s.outer.len() * s.inner.len(),
            Self::MatMul(s) => 2 * s.batch.len() * s.size.iter().product::<usize>(),
            Self::Softmax(s) => 16 * s.size[0] * s.size[1] * s.columns,
            Self::LayerNorm(s) => 8 * s.size[0] * s.size[1] * s.columns,
            Self::MapNorm(s) => 8 * s.size[0] * s.size[1] * s.channels,
            Self::PackKv(s) => 4 * s.heads.len() * s.size[0] * (s.size[1] + s.size[2]),
            Self::Attention(s) | Self::AttentionBytes(s) => {
                s.heads.len() * s.queries * s.size[0] * (2 * (s.size[1] + s.size[2]) + 16)
            }
            Self::PackKvBytes(s) => 8 * s.heads.len() * s.size[0] * (s.size[1] + s.size[2]),
            Self::ThinAttention(s) => {
                s.heads.len() * s.queries * s.size[0] * (2 * (s.size[1] + s.size[2]) + 16)
            }
        };
        Cost { operations }
    }

    /// Address and length of everything it uses of the arena.
    pub fn arena_spans(&self, k: &Kernels, threads: usize) -> Vec<(usize, usize)> {
        let spans = self.spans(k, threads);
        let reads = spans.reads.into_iter().filter_map(|(place, len)| match place {
            Place::Arena(at) => Some((at, len)),
            Place::Weights(_) => None,
        });
        reads.chain(spans.writes).collect()
    }

    /// Moves every address in the arena.
    pub fn relocate(&mut self, to: &impl Fn(usize) -> usize) {
        let place = |place: &mut Place| {
            if let Place::Arena(at) = place {
                *at = to(*at);
            }
        };
        let at = |at: &mut usize| *at = to(*at);
        let border = |halo: &mut Option<Halo>| {
            if let Some(halo) = halo {
                at(&mut halo.start);
            }
        };
        match self {
            Self::Clear(halo) => at(&mut halo.start),
            Self::Gemm(s) => {
                place(&mut s.input);
                place(&mut s.weights);
                if let Some((from, _)) = &mut s.residual {
                    place(from);
                }
                at(&mut s.output);
                border(&mut s.halo);
            }
            Self::KernelsToPoints(s) => at(&mut s.output),
            Self::ToPoints(s) => {
                place(&mut s.input);
                at(&mut s.output.start);
            }
            Self::FromPoints(s) => {
                at(&mut s.input.start);
                if let Some((from, _)) = &mut s.residual {
                    place(from);
                }
                at(&mut s.output);
            }
            Self::Quantise(s) => {
                place(&mut s.input);
                at(&mut s.output);
                border(&mut s.halo);
            }
            Self::Depthwise(s) => {
                place(&mut s.input);
                at(&mut s.output);
                border(&mut s.halo);
            }
            Self::Pool(s) => {
                place(&mut s.input);
                at(&mut s.output);
                border(&mut s.halo);
            }
            Self::Copy(s) => {
                place(&mut s.input);
                at(&mut s.output);
            }
            Self::Map(s) => {
                place(&mut s.input);
                at(&mut s.output);
            }
            Self::Zip(s) => {
                s.inputs.iter_mut().for_each(place);
                at(&mut s.output);
            }
            Self::Fold(s) => {
                place(&mut s.input);
                at(&mut s.output);
            }
            Self::MatMul(s) => {
                place(&mut s.a);
                place(&mut s.b);
                at(&mut s.c);
            }
            Self::Softmax(s) => {
                place(&mut s.input);
                at(&mut s.output);
            }
            Self::LayerNorm(s) => {
                place(&mut s.input);
                at(&mut s.output);
            }
            Self::MapNorm(s) => {
                place(&mut s.input);
                at(&mut s.output);
                border(&mut s.halo);
            }
            Self::PackKv(s) => {
                place(&mut s.keys);
                place(&mut s.values);
                at(&mut s.output);
            }
            Self::Attention(s) | Self::AttentionBytes(s) => {
                place(&mut s.input);
                at(&mut s.panels);
                at(&mut s.output);
                at(&mut s.scratch);
            }
            Self::PackKvBytes(s) => {
                place(&mut s.keys);
                place(&mut s.values);
                at(&mut s.output);
            }
            Self::ThinAttention(s) => {
                s.inputs.iter_mut().for_each(place);
                at(&mut s.output);
                at(&mut s.scratch);
            }
        }
    }

    pub(super) fn spans(&self, k: &Kernels, threads: usize) -> Spans {
        let mut spans = Spans::default();
        match self {
            Self::Clear(halo) => spans.border(halo),
            Self::Gemm(s) => {
                let reach = s.taps.iter().copied().max().unwrap_or(0) + s.run;
                spans.read(s.input, extent(s.size, s.input_pitch, reach));
                let packing = s.packing(k);
                spans.read(s.weights, packing.len(s.depth(), s.columns));
                spans.weights(s.bias, packing.columns(s.columns));
                spans.weights(s.scales, packing.columns(s.columns));
                let biased = s.scales.is_none() || s.bias.is_some();
                spans.demand(biased, "it has bytes but no bias");
                if let Some((place, pitch)) = s.residual {
                    spans.read(place, extent(s.size, pitch, s.columns));
                }
                spans.map(s.output, s.size, s.output_pitch, s.columns, s.halo.as_ref());
                spans.demand(s.columns > 0, "it has no columns");
            }
            Self::ToPoints(s) => {
                let pixels = s.size.map(|n| 2 * n + 2);
                spans.read(s.input, extent(pixels, s.input_pitch, s.channels));
                let tiles = s.size[0] * s.size[1];
                spans.write(s.output.start, s.output.extent(tiles, s.channels));
                spans.demand(s.output.apart(tiles, s.channels), "its points overlap");
            }
            Self::KernelsToPoints(s) => {
                let len = k.packing.len(s.channels, s.columns);
                spans.weights(Some(s.weights), 9 * len);
                spans.write(s.output, POINTS * len);
            }
            Self::FromPoints(s) => {
                let (tiles, pixels) = (s.size[0] * s.size[1], s.size.map(|n| 2 * n));
                spans.read(Place::Arena(s.input.start), s.input.extent(tiles, s.columns));
                spans.weights(s.bias, s.columns);
                if let Some((place, pitch)) = s.residual {
                    spans.read(place, extent(pixels, pitch, s.columns));
                }
                spans.map(s.output, pixels, s.output_pitch, s.columns, None);
            }
            Self::Quantise(s) => {
                spans.read(s.input, extent(s.size, s.input_pitch, s.channels));
                let run = Eight::floats(s.channels);
                spans.map(s.output, s.size, s.output_pitch, run, s.halo.as_ref());
            }
            Self::Depthwise(s) => {
                let reach = s.taps.iter().copied().max().unwrap_or(0) + s.channels;
                spans.read(s.input, extent(s.size, s.input_pitch, reach));
                spans.weights(Some(s.weights), s.taps.len() * s.channels);
                spans.weights(s.bias, s.channels);
                spans.map(s.output, s.size, s.output_pitch, s.channels, s.halo.as_ref());
            }
            Self::Pool(s) => {
                spans.read(s.input, extent(s.from, s.input_pitch, s.channels));
                spans.map(s.output, s.size, s.output_pitch, s.channels, s.halo.as_ref());
            }
            Self::Copy(s) => {
                spans.read(s.input, s.nest.extent(0));
                spans.write(s.output, s.nest.extent(1));
                spans.demand(s.nest.distinct(1), "elements of its result overlap");
            }
            Self::Map(s) => {
                spans.read(s.input, s.nest.extent(0));
                spans.write(s.output, s.nest.extent(1));
                spans.demand(s.nest.distinct(1), "elements of its result overlap");
            }
            Self::Zip(s) => {
                spans.read(s.inputs[0], s.nest.extent(0));
                spans.read(s.inputs[1], s.nest.extent(1));
                spans.write(s.output, s.nest.extent(2));
                spans.demand(s.nest.distinct(2), "elements of its result overlap");
            }
            Self::Fold(s) => {
                spans.read(s.input, s.outer.extent(0) + s.inner.extent(0) - 1);
                spans.write(s.output, s.outer.extent(1));
                spans.demand(s.outer.distinct(1), "elements of its result overlap");
            }
            Self::MatMul(s) => {
                let [rows, sum, columns] = s.size;
                spans.read(s.a, farthest(&s.batch, 0) + (rows - 1) * s.a_row + sum);
                let b = (sum - 1) * s.b_sum + (columns - 1) * s.b_column + 1;
                spans.read(s.b, farthest(&s.batch, 1) + b);
                spans.demand(s.b_sum == 1 || s.b_column == 1, "neither side of `b` is a run");
                let c = (rows - 1) * s.c_row + columns;
                spans.write(s.c, farthest(&s.batch, 2) + c);
                let starts = s.batch.iter().map(|b| b[2]);
                spans.demand(blocks(starts, rows, s.c_row, columns), "its results overlap");
            }
            Self::Softmax(s) => {
                spans.read(s.input, extent(s.size, s.input_pitch, s.columns));
                spans.map(s.output, s.size, s.output_pitch, s.columns, None);
            }
            Self::LayerNorm(s) => {
                spans.read(s.input, extent(s.size, s.input_pitch, s.columns));
                spans.weights(Some(s.gain), s.columns);
                spans.weights(s.offset, s.columns);
                spans.map(s.output, s.size, s.output_pitch, s.columns, None);
            }
            Self::MapNorm(s) => {
                spans.read(s.input, extent(s.size, s.input_pitch, s.channels));
                spans.weights(s.gain, s.channels);
                spans.weights(s.offset, s.channels);
                spans.map(s.output, s.size, s.output_pitch, s.channels, s.halo.as_ref());
            }
            Self::PackKv(s) => {
                let [count, key, value] = s.size;
                let run = |n: usize, stride: [usize; 2], len: usize| {
                    (n - 1) * stride[0] + (len - 1) * stride[1] + 1
                };
                spans.read(s.keys, farthest(&s.heads, 0) + run(count, s.key_stride, key));
                spans.read(s.values, farthest(&s.heads, 1) + run(count, s.value_stride, value));
                spans.write(s.output, s.heads.len() * PackKv::len(s.size, k).1);
            }
            Self::Attention(s) | Self::AttentionBytes(s) => {
                let [keys, key, value] = s.size;
                let of_bytes = matches!(self, Self::AttentionBytes(_));
                let (panels, scratch) = match of_bytes {
                    true => (
                        PackKvBytes::len(s.size, &k.eight),
                        PackKvBytes::scratch_len(s.size, &k.eight),
                    ),
                    false => (PackKv::len(s.size, k).1, Attention::scratch_len(keys)),
                };
                let queries = (s.queries - 1) * s.input_row + key;
                spans.read(s.input, farthest(&s.heads, 0) + queries);
                spans.read(Place::Arena(s.panels), s.heads.len() * panels);
                let results = (s.queries - 1) * s.output_row + value;
                spans.write(s.output, farthest(&s.heads, 1) + results);
                spans.write(s.scratch, threads * scratch);
                let starts = s.heads.iter().map(|h| h[1]);
                let apart = blocks(starts, s.queries, s.output_row, value);
                spans.demand(apart, "its results overlap");
                // Sums of products of bytes must stay away from the ends of their range.
                let deep = !of_bytes || key.max(keys) <= PackKvBytes::DEEPEST;
                spans.demand(deep, "its sums could overflow");
            }
            Self::PackKvBytes(s) => {
                let [count, key, value] = s.size;
                spans.read(s.keys, farthest(&s.heads, 0) + (count - 1) * s.key_row + key);
                spans.read(s.values, farthest(&s.heads, 1) + (count - 1) * s.value_row + value);
                spans.write(s.output, s.heads.len() * PackKvBytes::len(s.size, &k.eight));
            }
            Self::ThinAttention(s) => {
                let [keys, key, value] = s.size;
                for (i, (n, run)) in
                    [(s.queries, key), (keys, key), (keys, value)].into_iter().enumerate()
                {
                    let len = farthest(&s.heads, i) + (n - 1) * s.rows[i] + run;
                    spans.read(s.inputs[i], len);
                }
                let results = (s.queries - 1) * s.output_row + value;
                spans.write(s.output, farthest(&s.heads, 3) + results);
                spans.write(s.scratch, threads * Attention::scratch_len(keys));
                let starts = s.heads.iter().map(|h| h[3]);
                let apart = blocks(starts, s.queries, s.output_row, value);
                spans.demand(apart, "its results overlap");
            }
        }
        spans
    }

    /// # Safety
    /// The step was checked, and nobody else touches what it writes or writes what it reads.
    pub(super) unsafe fn run(&self, k: &Kernels, mem: Mem, part: Part) {
        // SAFETY: passed on; the table fits the processor because `Isa::kernels` gave it out.
        unsafe {
            match self {
                Self::Clear(halo) => {
                    if part.id == 0 {
                        halo.clear(mem);
                    }
                }
                Self::Gemm(s) => s.run(k, mem, part),
                Self::ToPoints(s) => (k.to_points)(s, mem, part),
                Self::KernelsToPoints(s) => (k.kernels_to_points)(s, k.packing, mem, part),
                Self::FromPoints(s) => (k.from_points)(s, mem, part),
                Self::Quantise(s) => (k.eight.quantise)(s, mem, part),
                Self::Depthwise(s) => (k.depthwise)(s, mem, part),
                Self::Pool(s) => (k.pool)(s, mem, part),
                Self::Copy(s) => (k.copy)(s, mem, part),
                Self::Map(s) => (k.map)(s, mem, part),
                Self::Zip(s) => (k.zip)(s, mem, part),
                Self::Fold(s) => (k.fold)(s, mem, part),
                Self::MatMul(s) => (k.matmul)(s, mem, part),
                Self::Softmax(s) => (k.softmax)(s, mem, part),
                Self::LayerNorm(s) => (k.layer_norm)(s, mem, part),
                Self::MapNorm(s) => (k.map_norm)(s, mem, part),
                Self::PackKv(s) => s.run(k, mem, part),
                Self::Attention(s) => k.attention(s, mem, part),
                Self::PackKvBytes(s) => (k.eight.pack_kv)(s, mem, part),
                Self::AttentionBytes(s) => (k.eight.attend)(s, mem, part),
                Self::ThinAttention(s) => (k.thin_attention)(s, mem, part),
            }
        }
    }
}

/// Whether blocks of `rows` runs, `pitch` apart, that start at these places never overlap: no two
/// runs do.
fn blocks(starts: impl Iterator<Item = usize>, rows: usize, pitch: usize, run: usize) -> bool {
    let mut runs: Vec<usize> =
        starts.flat_map(|start| (0..rows).map(move |row| start + row * pitch)).collect();
    runs.sort_unstable();
    runs.windows(2).all(|w| w[1] - w[0] >= run)
}
