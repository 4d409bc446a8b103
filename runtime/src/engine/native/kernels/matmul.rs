//! Products of two computed tensors: single queries, small batches. Large ones of this kind do not
//! occur outside attention, which has a kernel of its own.

use super::simd::Simd;
use super::{Mem, Part, Place};

/// `c = a b` for a batch of matrices.
#[derive(Clone, Debug)]
pub struct MatMul {
    /// Where the matrices of each batch start, from the places below: `a`, `b`, `c`.
    pub batch: Box<[[usize; 3]]>,
    /// Rows, sum, columns.
    pub size: [usize; 3],
    /// Left operand; its rows are runs of the sum's length.
    pub a: Place,
    /// From row to row of `a`.
    pub a_row: usize,
    /// Right operand.
    pub b: Place,
    /// From element to element of the sum in `b`.
    pub b_sum: usize,
    /// From column to column of `b`; this one or `b_sum` is 1.
    pub b_column: usize,
    /// Result; its rows are runs.
    pub c: usize,
    /// From row to row of `c`.
    pub c_row: usize,
}

/// Sum of products of two runs.
///
/// # Safety
/// Both have `n` floats; the instruction set is there.
#[inline(always)]
pub unsafe fn dot<S: Simd>(a: *const f32, b: *const f32, n: usize) -> f32 {
    // SAFETY: as promised by the caller.
    unsafe {
        let mut sums = [S::splat(0.0); 4];
        let mut at = 0;
        while at + 4 * S::LANES <= n {
            for (i, sum) in sums.iter_mut().enumerate() {
                let k = at + i * S::LANES;
                *sum = S::fma(S::load(a.add(k)), S::load(b.add(k)), *sum);
            }
            at += 4 * S::LANES;
        }
        while at < n {
            let lanes = (n - at).min(S::LANES);
            sums[0] = S::fma(S::load_n(a.add(at), lanes), S::load_n(b.add(at), lanes), sums[0]);
            at += lanes;
        }
        S::sum(S::add(S::add(sums[0], sums[1]), S::add(sums[2], sums[3])))
    }
}

/// `out = factor * sum over k of weights[k] * (row k of b)`.
///
/// # Safety
/// `weights` has `count` floats, `b` that many rows of `n`, `pitch` apart, `out` `n` floats; the
/// instruction set is there.
#[inline(always)]
pub unsafe fn combine<S: Simd>(
    weights: *const f32,
    count: usize,
    b: *const f32,
    pitch: usize,
    n: usize,
    factor: f32,
    out: *mut f32,
) {
    const WIDE: usize = 4;
    // SAFETY: as promised by the caller.
    unsafe {
        let factor = S::splat(factor);
        let mut at = 0;
        while at + WIDE * S::LANES <= n {
            let mut sums = [S::splat(0.0); WIDE];
            for k in 0..count {
                let w = S::splat(*weights.add(k));
                let row = b.add(k * pitch + at);
                for (i, sum) in sums.iter_mut().enumerate() {
                    *sum = S::fma(w, S::load(row.add(i * S::LANES)), *sum);
                }
            }
            for (i, &sum) in sums.iter().enumerate() {
                S::store(out.add(at + i * S::LANES), S::mul(sum, factor));
            }
            at += WIDE * S::LANES;
        }
        while at < n {
            let lanes = (n - at).min(S::LANES);
            // Two sums, so that one does not wait for the other.
            let mut sums = [S::splat(0.0); 2];
            for k in 0..count {
                let row = S::load_n(b.add(k * pitch + at), lanes);
                sums[k % 2] = S::fma(S::splat(*weights.add(k)), row, sums[k % 2]);
            }
            S::store_n(out.add(at), S::mul(S::add(sums[0], sums[1]), factor), lanes);
            at += lanes;
        }
    }
}

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn matmul<S: Simd>(s: &MatMul, mem: Mem, part: Part) {
    let [rows, sum, columns] = s.size;
    // SAFETY: all within the matrices that were checked.
    unsafe {
        for i in part.of(s.batch.len() * rows) {
            let ([a, b, c], row) = (s.batch[i / rows], i % rows);
            let a = mem.at(s.a).add(a + row * s.a_row);
            let b = mem.at(s.b).add(b);
            let c = mem.arena.add(s.c + c + row * s.c_row);
            if s.b_sum == 1 {
                for column in 0..columns {
                    *c.add(column) = dot::<S>(a, b.add(column * s.b_column), sum);
                }
            } else {
                combine::<S>(a, sum, b, s.b_sum, columns, 1.0, c);
            }
        }
    }
}
