//! Keys and values of all heads into panels of bytes, once for all query rows.

use super::{MAX_BYTES, MOST, NEVER, PackKvBytes, Panels, ZERO, inverse, packing};
use crate::engine::native::kernels::eight::{BYTES, Dot, Eight, Layout};
use crate::engine::native::kernels::simd::Simd;
use crate::engine::native::kernels::table::MAX_VECTORS;
use crate::engine::native::kernels::{Mem, Part};

/// Mean of `count` rows of at most a vector, and the largest distance from it.
#[inline(always)]
unsafe fn spread<S: Simd>(first: *const f32, row: usize, count: usize, lanes: usize) -> [S::V; 2] {
    /// Sums that do not wait for each other.
    const ABREAST: usize = 4;
    // SAFETY: the caller promises that many lanes of that many rows.
    unsafe {
        let whole = lanes == S::LANES;
        let load = |i: usize| {
            let p = first.add(i * row);
            if whole { S::load(p) } else { S::load_n(p, lanes) }
        };
        // The number farthest from the mean is the largest or the smallest one.
        let mut sums = [S::splat(0.0); ABREAST];
        let [mut top, mut bottom] = [load(0); 2];
        for i in 0..count {
            let v = load(i);
            sums[i % ABREAST] = S::add(sums[i % ABREAST], v);
            top = S::at_least(top, v);
            bottom = S::at_most(bottom, v);
        }
        let sum = S::add(S::add(sums[0], sums[1]), S::add(sums[2], sums[3]));
        let mean = S::mul(sum, S::splat(1.0 / count as f32));
        let most = S::at_least(S::sub(top, mean), S::sub(mean, bottom));
        [mean, most]
    }
}

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn pack<D: Dot>(s: &PackKvBytes, mem: Mem, part: Part) {
    let len = Panels::new(s.size, packing::<D>()).len;
    for head in part.of(s.heads.len()) {
        let [keys, values] = s.heads[head];
        // SAFETY: all within keys, values and panels as they were checked.
        unsafe {
            let out = mem.arena.add(s.output + head * len);
            pack_keys::<D>(s, mem.at(s.keys).add(keys), out);
            pack_values::<D>(s, mem.at(s.values).add(values), out);
        }
    }
}

/// Vectors of a key whose means are kept between two walks over all keys.
const KEPT: usize = 8;

/// Columns of the products of queries and keys are keys: the four bytes of a group lie together.
#[inline(always)]
unsafe fn pack_keys<D: Dot>(s: &PackKvBytes, keys: *const f32, out: *mut f32) {
    let (lanes, [count, key, _]) = (D::F::LANES, s.size);
    let p = Panels::new(s.size, packing::<D>());
    // SAFETY: as for `pack`.
    unsafe {
        let starts = out.add(p.key_starts).cast::<i32>();
        for j in 0..p.keys {
            *starts.add(j) = if j < count { 0 } else { NEVER };
        }
        let mut most = 0.0f32;
        let mut means = [D::F::splat(0.0); KEPT];
        for (i, at) in (0..key).step_by(lanes).enumerate() {
            let n = lanes.min(key - at);
            let [mean, far] = spread::<D::F>(keys.add(at), s.key_row, count, n);
            most = most.max(D::F::top(far));
            if let Some(kept) = means.get_mut(i) {
                *kept = mean;
            }
        }
        *out.add(p.key_step) = most / MOST;
        let factor = D::F::splat(inverse(most));
        let width = MAX_VECTORS * lanes;
        for (i, at) in (0..key).step_by(lanes).enumerate() {
            let n = lanes.min(key - at);
            let mean = match means.get(i) {
                Some(&mean) => mean,
                None => spread::<D::F>(keys.add(at), s.key_row, count, n)[0],
            };
            let (first, groups) = (at / BYTES, Eight::floats(n));
            for j in 0..p.keys {
                let words = if j < count {
                    rounded::<D>(keys.add(j * s.key_row + at), n, mean, factor)
                } else {
                    [0; MAX_BYTES / BYTES]
                };
                let panel = j / width * width;
                let columns = width.min(p.keys - panel);
                let to = out.add(panel * p.groups + (j - panel) / lanes * lanes);
                for (g, word) in words.into_iter().enumerate().take(groups) {
                    put::<D>(to.add((first + g) * columns), j % lanes, word);
                }
            }
        }
        // What the queries' zero will add, taken off beforehand.
        let zero = f32::from_bits(u32::from_ne_bytes([ZERO as u8; BYTES]));
        for at in (0..p.keys).step_by(lanes) {
            let panel = at / width * width;
            let columns = width.min(p.keys - panel);
            let vectors = out.add(panel * p.groups + (at - panel));
            take_off::<D>(zero, vectors, columns, p.groups, starts.add(at));
        }
    }
}

/// Subtracts from every lane the sum of `groups` products with these four bytes.
#[inline(always)]
unsafe fn take_off<D: Dot>(
    bytes: f32,
    vectors: *const f32,
    pitch: usize,
    groups: usize,
    starts: *mut i32,
) {
    // SAFETY: the caller promises that many vectors, `pitch` apart, and one more of starts.
    unsafe {
        let (x, mut sum) = (D::bytes(&bytes), D::zero());
        for g in 0..groups {
            sum = D::dot(sum, x, D::weights(vectors.add(g * pitch)));
        }
        let mut sums = [0; MAX_BYTES];
        D::store(sums.as_mut_ptr(), sum);
        for (lane, sum) in sums.iter().enumerate().take(D::F::LANES) {
            *starts.add(lane) -= sum;
        }
    }
}

/// `n` numbers, at most a vector, less their mean, as signed bytes; zeros behind them.
#[inline(always)]
unsafe fn rounded<D: Dot>(
    from: *const f32,
    n: usize,
    mean: <D::F as Simd>::V,
    factor: <D::F as Simd>::V,
) -> [u32; MAX_BYTES / BYTES] {
    // SAFETY: the caller promises that many numbers and the instruction set.
    unsafe {
        let whole = n == D::F::LANES;
        let v = if whole { D::F::load(from) } else { D::F::load_n(from, n) };
        let v = D::F::fma(D::F::sub(v, mean), factor, D::F::splat(ZERO));
        let mut words = [SIGNS; MAX_BYTES / BYTES];
        D::narrow(v, words.as_mut_ptr().cast());
        if !whole {
            words.as_mut_ptr().cast::<u8>().add(n).write_bytes(ZERO as u8, MAX_BYTES - n);
        }
        words.map(|word| word ^ SIGNS)
    }
}

/// Columns of the products of weights and values are elements: the bytes of four neighbouring values
/// lie together.
#[inline(always)]
unsafe fn pack_values<D: Dot>(s: &PackKvBytes, values: *const f32, out: *mut f32) {
    let (lanes, [count, _, value]) = (D::F::LANES, s.size);
    let p = Panels::new(s.size, packing::<D>());
    let width = MAX_VECTORS * lanes;
    // SAFETY: as for `pack`.
    unsafe {
        for at in (0..p.value).step_by(lanes) {
            let n = lanes.min(value - at);
            let [mean, far] = spread::<D::F>(values.add(at), s.value_row, count, n);
            D::F::store(out.add(p.value_means + at), mean);
            D::F::store(out.add(p.value_steps + at), D::F::mul(far, D::F::splat(1.0 / MOST)));
            let mut factors = [0.0; MAX_BYTES];
            D::F::store(factors.as_mut_ptr(), far);
            factors.iter_mut().for_each(|f| *f = inverse(*f));
            let factor = D::F::load(factors.as_ptr());
            let panel = at / width * width;
            let columns = width.min(p.value - panel);
            let to = out.add(p.values + panel * (p.keys / BYTES) + (at - panel));
            for group in 0..p.keys / BYTES {
                let mut rows = [[0u32; MAX_BYTES / BYTES]; BYTES];
                for (b, row) in rows.iter_mut().enumerate() {
                    let j = group * BYTES + b;
                    if j < count {
                        *row = rounded::<D>(values.add(j * s.value_row + at), n, mean, factor);
                    }
                }
                let [a, b, c, d] = rows.map(bytes_of);
                let mut words = [0u32; MAX_BYTES];
                for (lane, word) in words.iter_mut().enumerate() {
                    // Written with shifts, this becomes vector code.
                    let low = u32::from(a[lane]) | u32::from(b[lane]) << 8;
                    *word = u32::from_le(low | u32::from(c[lane]) << 16 | u32::from(d[lane]) << 24);
                }
                put_all::<D>(to.add(group * columns), &words);
            }
            let starts = out.add(p.value_starts + at).cast::<i32>();
            for lane in 0..lanes {
                *starts.add(lane) = 0;
            }
            take_off::<D>(0.0, to, columns, p.keys / BYTES, starts);
        }
    }
}

const fn bytes_of(words: [u32; MAX_BYTES / BYTES]) -> [u8; MAX_BYTES] {
    let mut bytes = [0; MAX_BYTES];
    let mut i = 0;
    while i < MAX_BYTES {
        bytes[i] = words[i / BYTES].to_ne_bytes()[i % BYTES];
        i += 1;
    }
    bytes
}

/// The sign bits of four bytes.
const SIGNS: u32 = 0x8080_8080;

/// Four rows of a column into the vector at `p`.
#[inline(always)]
unsafe fn put<D: Dot>(p: *mut f32, lane: usize, four: u32) {
    // SAFETY: the caller promises a whole vector.
    unsafe {
        if D::LAYOUT == Layout::Quads {
            *p.add(lane) = f32::from_bits(four);
            return;
        }
        for (row, byte) in four.to_ne_bytes().into_iter().enumerate() {
            *p.cast::<u8>().add(D::LAYOUT.at(D::F::LANES, lane, row)) = byte;
        }
    }
}

/// Four rows of as many columns as there are lanes.
#[inline(always)]
unsafe fn put_all<D: Dot>(p: *mut f32, words: &[u32; MAX_BYTES]) {
    // SAFETY: the caller promises a whole vector.
    unsafe {
        if D::LAYOUT == Layout::Quads {
            D::F::store(p, D::F::load(words.as_ptr().cast()));
            return;
        }
        for (lane, &word) in words.iter().enumerate().take(D::F::LANES) {
            put::<D>(p, lane, word);
        }
    }
}
