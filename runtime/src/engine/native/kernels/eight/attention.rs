//! Attention over bytes: queries, keys, values and the weights between them are rounded where they
//! are needed, with steps found in the numbers themselves.
//!
//! Two shifts that change nothing in exact arithmetic keep the steps small. Adding the same vector to
//! all keys adds the same number to all logits of a query, and the softmax takes it away again: keys
//! are rounded after their mean has been subtracted. Weights sum up to one: the mean of the values is
//! subtracted before rounding and added to the results. Weights are rounded to 255 steps below the
//! largest one of their row; the sum they are divided by is that of the weights before rounding, so
//! the mean stands in for values whose weights were too small to be seen.

mod panels;

use super::{BYTES, Dot, Eight};
use crate::engine::native::kernels::attention::Attention;
use crate::engine::native::kernels::gemm::Packing;
use crate::engine::native::kernels::simd::Simd;
use crate::engine::native::kernels::table::MAX_VECTORS;
use crate::engine::native::kernels::{Mem, Part, Place};

pub use panels::pack;

/// Largest magnitude of a rounded query, key or value.
const MOST: f32 = 127.0;
/// What is added to rounded queries: the products take unsigned bytes on their left.
const ZERO: f32 = 128.0;
/// Start of the sums of keys that are not there: no logit comes near it, and subtracting one does not
/// overflow.
const NEVER: i32 = i32::MIN / 2;

/// Where the parts of one head's panels lie, in places of floats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Panels {
    /// Keys, values, and weights per row of a tile, in whole vectors.
    keys: usize,
    value: usize,
    /// Groups of four elements of a key.
    groups: usize,
    /// Bytes of values.
    values: usize,
    /// Starts of the sums: one per key, one per element of a value.
    key_starts: usize,
    value_starts: usize,
    /// Step and mean of every element of a value.
    value_steps: usize,
    value_means: usize,
    /// Step of the keys.
    key_step: usize,
    len: usize,
}

impl Panels {
    const fn new([count, key, value]: [usize; 3], packing: Packing) -> Self {
        let (keys, value, groups) =
            (packing.columns(count), packing.columns(value), Eight::floats(key));
        let values = groups * keys;
        let key_starts = values + keys / BYTES * value;
        let value_starts = key_starts + keys;
        let value_steps = value_starts + value;
        let value_means = value_steps + value;
        let key_step = value_means + value;
        let len = (key_step + 1).next_multiple_of(packing.lanes);
        Self {
            keys,
            value,
            groups,
            values,
            key_starts,
            value_starts,
            value_steps,
            value_means,
            key_step,
            len,
        }
    }
}

/// Keys and values into panels of bytes, once for all query rows.
#[derive(Clone, Debug)]
pub struct PackKvBytes {
    /// Where the keys and values of each head start, from the places below.
    pub heads: Box<[[usize; 2]]>,
    /// Keys; each one a run.
    pub keys: Place,
    /// From key to key.
    pub key_row: usize,
    /// Values; each one a run.
    pub values: Place,
    /// From value to value.
    pub value_row: usize,
    /// Number of keys, length of a key, length of a value.
    pub size: [usize; 3],
    /// Panels of each head, [`Self::len`] apart.
    pub output: usize,
}

impl PackKvBytes {
    /// Floats of all panels of one head.
    pub const fn len(size: [usize; 3], eight: &Eight) -> usize {
        Panels::new(size, eight.packing).len
    }

    /// Most keys, and longest key: sums of this many products keep away from the ends of 32 bits.
    pub const DEEPEST: usize = 1 << 14;

    /// Places of floats from row to row of the rounded weights, and of the sums behind them.
    const fn rows(panels: &Panels, packing: Packing) -> [usize; 2] {
        [(panels.keys / BYTES).next_multiple_of(packing.lanes), panels.keys + packing.lanes]
    }

    /// Scratch of one thread for the attention over them.
    pub const fn scratch_len(size: [usize; 3], eight: &Eight) -> usize {
        let panels = Panels::new(size, eight.packing);
        let [weights, sums] = Self::rows(&panels, eight.packing);
        let queries = panels.groups.next_multiple_of(eight.packing.lanes);
        eight.rows * (queries + weights + sums)
    }
}

const fn packing<D: Dot>() -> Packing {
    Packing { width: MAX_VECTORS * D::F::LANES, lanes: D::F::LANES }
}

/// The larger of a number and its negative.
#[inline(always)]
unsafe fn magnitude<S: Simd>(v: S::V) -> S::V {
    // SAFETY: the caller promises the instruction set.
    unsafe { S::at_least(v, S::sub(S::splat(0.0), v)) }
}

/// One over a step, or nothing where there is nothing to round.
fn inverse(most: f32) -> f32 {
    if most > 0.0 { MOST / most } else { 0.0 }
}

/// Most bytes that a vector of floats is narrowed to.
const MAX_BYTES: usize = 16;

/// # Safety
/// The step was checked against the memory and the number of threads, the instruction set is there,
/// nobody else touches the result.
#[inline(always)]
pub unsafe fn attend<D: Dot, const R: usize>(s: &Attention, mem: Mem, part: Part) {
    let (lanes, [_, key, value]) = (D::F::LANES, s.size);
    let p = Panels::new(s.size, packing::<D>());
    let [weights_row, sums_row] = PackKvBytes::rows(&p, packing::<D>());
    let queries_row = p.groups.next_multiple_of(lanes);
    let tiles = s.queries.div_ceil(R);
    let width = MAX_VECTORS * lanes;
    // SAFETY: all within queries, panels, results and this thread's scratch as they were checked.
    unsafe {
        let len = R * (queries_row + weights_row + sums_row);
        let queries = mem.arena.add(s.scratch + part.id * len);
        let weights = queries.add(R * queries_row);
        let sums = weights.add(R * weights_row);
        for i in part.of(s.heads.len() * tiles) {
            let (head, query) = (i / tiles, i % tiles * R);
            let [input, output] = s.heads[head];
            let panels = mem.arena.add(s.panels + head * p.len).cast_const();
            let step = *panels.add(p.key_step) * s.scale * core::f32::consts::LOG2_E;
            let mut factors = [0.0; R];
            for r in 0..R {
                // A tile is always full: the last query stands in for those behind it.
                let row = (query + r).min(s.queries - 1);
                let from = mem.at(s.input).add(input + row * s.input_row);
                factors[r] = step * round::<D>(from, key, queries.add(r * queries_row).cast());
            }
            let mut tops = [D::zero(); R];
            for r in 0..R {
                tops[r] = D::all(i32::MIN);
            }
            let starts = panels.add(p.key_starts).cast::<i32>();
            let mut at = 0;
            while at < p.keys {
                let block = Block {
                    a: queries,
                    a_row: queries_row,
                    depth: p.groups,
                    b: panels.add(at * p.groups),
                    starts: starts.add(at),
                };
                let to = sums.add(at).cast::<i32>();
                if p.keys - at >= width {
                    logits::<D, R, MAX_VECTORS>(&block, to, sums_row, &mut tops);
                } else {
                    logits::<D, R, 1>(&block, to, sums_row, &mut tops);
                }
                at += width;
            }
            for r in 0..R {
                let from = sums.add(r * sums_row).cast::<i32>().cast_const();
                let to = weights.add(r * weights_row).cast::<u8>();
                factors[r] = weigh::<D>(from, s.size[0], factors[r], D::top(tops[r]), to);
            }
            let starts = panels.add(p.value_starts).cast::<i32>();
            let mut at = 0;
            while at < p.value {
                let block = Block {
                    a: weights,
                    a_row: weights_row,
                    depth: p.keys / BYTES,
                    b: panels.add(p.values + at * (p.keys / BYTES)),
                    starts: starts.add(at),
                };
                let columns = Columns {
                    steps: panels.add(p.value_steps + at),
                    means: panels.add(p.value_means + at),
                    to: mem.arena.add(s.output + output + query * s.output_row + at),
                    row: s.output_row,
                    rows: R.min(s.queries - query),
                    columns: value - at,
                };
                if p.value - at >= width {
                    results::<D, R, MAX_VECTORS>(&block, &factors, &columns);
                } else {
                    results::<D, R, 1>(&block, &factors, &columns);
                }
                at += width;
            }
        }
    }
}

/// Rounds a query to `bytes`; its step. Bytes behind its end are left as they are, there are zeros
/// in the keys.
#[inline(always)]
unsafe fn round<D: Dot>(from: *const f32, key: usize, bytes: *mut u8) -> f32 {
    let lanes = D::F::LANES;
    // SAFETY: as for `attend`.
    unsafe {
        let load = |at: usize| {
            if key - at >= lanes {
                D::F::load(from.add(at))
            } else {
                D::F::load_n(from.add(at), key - at)
            }
        };
        let mut most = D::F::splat(0.0);
        for at in (0..key).step_by(lanes) {
            most = D::F::at_least(most, magnitude::<D::F>(load(at)));
        }
        let most = D::F::top(most);
        let (factor, zero) = (D::F::splat(inverse(most)), D::F::splat(ZERO));
        for at in (0..key).step_by(lanes) {
            // Rows have room for whole vectors.
            D::narrow(D::F::fma(load(at), factor, zero), bytes.add(at));
        }
        most / MOST
    }
}

/// Operands of a product of `R` rows and a panel.
struct Block {
    a: *const f32,
    a_row: usize,
    depth: usize,
    b: *const f32,
    starts: *const i32,
}

/// The sums of a block.
#[inline(always)]
unsafe fn product<D: Dot, const R: usize, const NV: usize>(block: &Block) -> [[D::I; NV]; R] {
    let lanes = D::F::LANES;
    // SAFETY: as for `attend`.
    unsafe {
        let mut acc = [[D::zero(); NV]; R];
        for j in 0..NV {
            let start = D::load(block.starts.add(j * lanes));
            for r in 0..R {
                acc[r][j] = start;
            }
        }
        let mut a = [block.a; R];
        for r in 1..R {
            a[r] = block.a.add(r * block.a_row);
        }
        let mut b = block.b;
        for k in 0..block.depth {
            let mut weights = [D::weights(b); NV];
            for j in 1..NV {
                weights[j] = D::weights(b.add(j * lanes));
            }
            b = b.add(NV * lanes);
            for r in 0..R {
                let x = D::bytes(a[r].add(k));
                for j in 0..NV {
                    acc[r][j] = D::dot(acc[r][j], x, weights[j]);
                }
            }
        }
        acc
    }
}

/// Writes the logits of a panel of keys and raises the largest of every row.
#[inline(always)]
unsafe fn logits<D: Dot, const R: usize, const NV: usize>(
    block: &Block,
    to: *mut i32,
    row: usize,
    tops: &mut [D::I; R],
) {
    // SAFETY: as for `attend`.
    unsafe {
        let acc = product::<D, R, NV>(block);
        for r in 0..R {
            let mut top = tops[r];
            for j in 0..NV {
                D::store(to.add(r * row + j * D::F::LANES), acc[r][j]);
                top = D::larger(top, acc[r][j]);
            }
            tops[r] = top;
        }
    }
}

/// `255 * 2^(factor * (sum - top))` as bytes; returns one over the sum of these before rounding.
#[inline(always)]
unsafe fn weigh<D: Dot>(sums: *const i32, keys: usize, factor: f32, top: i32, to: *mut u8) -> f32 {
    /// Logarithm of the largest weight.
    const LOG2_255: f32 = 7.994_353;
    // SAFETY: as for `attend`; there is room for whole vectors of keys.
    unsafe {
        let shift = D::F::splat(LOG2_255 - top as f32 * factor);
        let (factor, least) = (D::F::splat(factor), D::F::splat(-100.0));
        let mut total = D::F::splat(0.0);
        for at in (0..keys).step_by(D::F::LANES) {
            let x = D::F::fma(D::floats(D::load(sums.add(at))), factor, shift);
            let x = D::F::at_least(least, x);
            let n = D::F::round(x);
            let r = D::F::sub(x, n);
            // 2^r within 8e-5, far less than the rounding to come.
            let mut p = D::F::splat(0.055_171_24);
            for c in [0.242_611_44, 0.693_261_1, 0.999_928_06] {
                p = D::F::fma(p, r, D::F::splat(c));
            }
            let weight = D::F::scale2(p, n);
            D::narrow(weight, to.add(at));
            if keys - at >= D::F::LANES {
                total = D::F::add(total, weight);
            } else {
                // Keys that are not there may have a weight; their values are zeros.
                let mut all = [0.0; MAX_BYTES];
                D::F::store(all.as_mut_ptr(), weight);
                total = D::F::add(total, D::F::load_n(all.as_ptr(), keys - at));
            }
        }
        1.0 / D::F::sum(total)
    }
}

/// Where the results of a panel of values go.
struct Columns {
    steps: *const f32,
    means: *const f32,
    to: *mut f32,
    row: usize,
    rows: usize,
    /// From this panel's first on.
    columns: usize,
}

/// Writes `sums * step * factor + mean`.
#[inline(always)]
unsafe fn results<D: Dot, const R: usize, const NV: usize>(
    block: &Block,
    factors: &[f32; R],
    c: &Columns,
) {
    let lanes = D::F::LANES;
    // SAFETY: as for `attend`.
    unsafe {
        let acc = product::<D, R, NV>(block);
        for j in 0..NV {
            let at = j * lanes;
            let (step, mean) = (D::F::load(c.steps.add(at)), D::F::load(c.means.add(at)));
            let n = lanes.min(c.columns - at);
            for r in 0..R {
                if r >= c.rows {
                    break;
                }
                let sum = D::F::mul(D::floats(acc[r][j]), D::F::splat(factors[r]));
                let y = D::F::fma(sum, step, mean);
                let to = c.to.add(r * c.row + at);
                if n == lanes { D::F::store(to, y) } else { D::F::store_n(to, y, n) }
            }
        }
    }
}
