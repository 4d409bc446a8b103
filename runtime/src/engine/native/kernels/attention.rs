//! `softmax(scale * q k^T) v` a few query rows at a time: the matrix of all weights is never
//! stored, only the rows that a thread is working on.

use super::gemm::Tile;
use super::matmul::{combine, dot};
use super::simd::Simd;
use super::table::{Kernels, MAX_ROWS};
use super::{Mem, Part, Place};

/// Keys and values into panels, once for all query rows.
#[derive(Clone, Debug)]
pub struct PackKv {
    /// Where the keys and values of each head start, from the places below.
    pub heads: Box<[[usize; 2]]>,
    /// Keys.
    pub keys: Place,
    /// From key to key, from element to element of a key.
    pub key_stride: [usize; 2],
    /// Values.
    pub values: Place,
    /// From value to value, from element to element of a value.
    pub value_stride: [usize; 2],
    /// Number of keys, length of a key, length of a value.
    pub size: [usize; 3],
    /// Panels of each head, [`Self::len`] apart.
    pub output: usize,
}

impl PackKv {
    /// Floats of the packed keys and of all panels of one head.
    pub const fn len(size: [usize; 3], k: &Kernels) -> (usize, usize) {
        let keys = k.packing.len(size[1], size[0]);
        (keys, keys + k.packing.len(size[0], size[2]))
    }

    /// # Safety
    /// The step was checked, nobody else touches the result.
    pub(super) unsafe fn run(&self, k: &Kernels, mem: Mem, part: Part) {
        let [count, key, value] = self.size;
        let width = k.packing.width;
        let panels = count.div_ceil(width);
        let (keys_len, len) = Self::len(self.size, k);
        // SAFETY: all within keys, values and panels as they were checked.
        unsafe {
            for i in part.of(self.heads.len() * panels) {
                let (head, panel) = (i / panels, i % panels);
                let [keys, values] = self.heads[head];
                let keys = mem.at(self.keys).add(keys);
                let values = mem.at(self.values).add(values);
                let out = mem.arena.add(self.output + head * len);
                let first = panel * width;
                let columns = width.min(count - first);
                let padded = k.packing.columns(columns);
                let to = out.add(first * key);
                let [step, element] = self.key_stride;
                for j in 0..padded {
                    for d in 0..key {
                        let v = if j < columns {
                            *keys.add((first + j) * step + d * element)
                        } else {
                            0.0
                        };
                        *to.add(d * padded + j) = v;
                    }
                }
                let [step, element] = self.value_stride;
                let mut e = 0;
                while e < value {
                    let n = width.min(value - e);
                    let padded = k.packing.columns(n);
                    let to = out.add(keys_len + e * count);
                    for j in first..first + columns {
                        let (from, to) = (values.add(j * step + e * element), to.add(j * padded));
                        if element == 1 {
                            core::ptr::copy_nonoverlapping(from, to, n);
                        } else {
                            for x in 0..n {
                                *to.add(x) = *from.add(x * element);
                            }
                        }
                        to.add(n).write_bytes(0, padded - n);
                    }
                    e += n;
                }
            }
        }
    }
}

/// Attention over packed keys and values, in floats or ([`super::PackKvBytes`]) bytes.
#[derive(Clone, Debug)]
pub struct Attention {
    /// Where the queries and results of each head start, from the places below.
    pub heads: Box<[[usize; 2]]>,
    /// Number of queries.
    pub queries: usize,
    /// Number of keys, length of a key, length of a value.
    pub size: [usize; 3],
    /// Queries; each one a run.
    pub input: Place,
    /// From query to query.
    pub input_row: usize,
    /// What [`PackKv`] or its twin of bytes made.
    pub panels: usize,
    /// Results; each one a run.
    pub output: usize,
    /// From result to result.
    pub output_row: usize,
    /// Factor of the logits, positive.
    pub scale: f32,
    /// Rows of weights that are being worked on, [`Self::scratch_len`] (or the twin's) per thread.
    pub scratch: usize,
}

impl Attention {
    /// Floats from row to row of the weights. Never a multiple of a page, where all rows would
    /// compete for the same few lines of the first-level cache.
    pub const fn scratch_row(keys: usize) -> usize {
        keys.next_multiple_of(16) + 16
    }

    /// Scratch of one thread.
    pub const fn scratch_len(keys: usize) -> usize {
        MAX_ROWS * Self::scratch_row(keys)
    }
}

/// # Safety
/// The step was checked against the memory and the number of threads, nobody else touches the
/// result.
pub unsafe fn run(s: &Attention, k: &Kernels, mem: Mem, part: Part) {
    let [keys, key, value] = s.size;
    let tiles = s.queries.div_ceil(k.rows);
    let (keys_len, len) = PackKv::len(s.size, k);
    let row = Attention::scratch_row(keys);
    let zero = 0usize;
    let mut factors = [0.0f32; MAX_ROWS];
    // SAFETY: all within queries, panels, results and this thread's scratch as they were checked.
    unsafe {
        let scratch = mem.arena.add(s.scratch + part.id * Attention::scratch_len(keys));
        let mut first = Tile { taps: &zero, tap_count: 1, run: key, ..Tile::EMPTY };
        let mut second = Tile { taps: &zero, tap_count: 1, run: keys, ..Tile::EMPTY };
        for r in 0..k.rows {
            first.c[r] = scratch.add(r * row);
            second.a[r] = first.c[r];
        }
        let factors = factors.as_mut_ptr();
        second.factors = factors;
        for i in part.of(s.heads.len() * tiles) {
            let (head, query) = (i / tiles, i % tiles * k.rows);
            let rows = k.rows.min(s.queries - query);
            let [input, output] = s.heads[head];
            for r in 0..rows {
                first.a[r] = mem.at(s.input).add(input + (query + r) * s.input_row);
                second.c[r] = mem.arena.add(s.output + output + (query + r) * s.output_row);
            }
            let panels = mem.arena.add(s.panels + head * len);
            columns(&mut first, k, panels, keys, rows);
            (k.weigh)(scratch, rows, row, keys, s.scale, factors);
            columns(&mut second, k, panels.add(keys_len), value, rows);
        }
    }
}

/// One tile after the other over all columns.
unsafe fn columns(tile: &mut Tile, k: &Kernels, panels: *const f32, columns: usize, rows: usize) {
    let mut at = 0;
    while at < columns {
        tile.column = at;
        tile.columns = k.packing.width.min(columns - at);
        // SAFETY: the panel of these columns, which are inside the tile's rows.
        unsafe {
            tile.b = panels.add(at * tile.run);
            (k.tiles[tile.columns.div_ceil(k.packing.lanes) - 1][rows - 1])(tile);
        }
        at += k.packing.width;
    }
}

/// Attention of few queries, keys and values where they lie.
#[derive(Clone, Debug)]
pub struct ThinAttention {
    /// Where queries, keys, values and results of each head start, from the places below.
    pub heads: Box<[[usize; 4]]>,
    /// Number of queries.
    pub queries: usize,
    /// Number of keys, length of a key, length of a value.
    pub size: [usize; 3],
    /// Queries, keys, values; each one a run.
    pub inputs: [Place; 3],
    /// From one to the next.
    pub rows: [usize; 3],
    /// Results; each one a run.
    pub output: usize,
    /// From result to result.
    pub output_row: usize,
    /// Factor of the logits, positive.
    pub scale: f32,
    /// The row of weights that is being worked on, [`Attention::scratch_len`] per thread.
    pub scratch: usize,
}

/// # Safety
/// The step was checked against the memory and the number of threads, the instruction set is there,
/// nobody else touches the result.
#[inline(always)]
pub unsafe fn thin<S: Simd>(s: &ThinAttention, mem: Mem, part: Part) {
    let [keys, key, value] = s.size;
    // SAFETY: all within queries, keys, values, results and scratch as they were checked.
    unsafe {
        let weights = mem.arena.add(s.scratch + part.id * Attention::scratch_len(keys));
        for i in part.of(s.heads.len() * s.queries) {
            let ([q, k, v, o], query) = (s.heads[i / s.queries], i % s.queries);
            let q = mem.at(s.inputs[0]).add(q + query * s.rows[0]);
            let k = mem.at(s.inputs[1]).add(k);
            let v = mem.at(s.inputs[2]).add(v);
            let out = mem.arena.add(s.output + o + query * s.output_row);
            for j in 0..keys {
                *weights.add(j) = dot::<S>(q, k.add(j * s.rows[1]), key);
            }
            let mut factor = 0.0;
            super::norms::weigh::<S>(weights, 1, 0, keys, s.scale, &mut factor);
            combine::<S>(weights, keys, v, s.rows[2], value, factor, out);
        }
    }
}
