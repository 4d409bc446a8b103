//! Normalisations and softmax.

use super::simd::{self, Simd};
use super::{Halo, Mem, Part, Pitch, Place};

/// Calls `f(offset, lanes)` for the vectors of a run of `n` floats.
#[inline(always)]
fn vectors<S: Simd>(n: usize, mut f: impl FnMut(usize, usize)) {
    let mut at = 0;
    while at < n {
        let lanes = (n - at).min(S::LANES);
        f(at, lanes);
        at += lanes;
    }
}

#[inline(always)]
unsafe fn load<S: Simd>(p: *const f32, lanes: usize) -> S::V {
    // SAFETY: the caller promises that many floats and the instruction set.
    unsafe { if lanes == S::LANES { S::load(p) } else { S::load_n(p, lanes) } }
}

#[inline(always)]
unsafe fn store<S: Simd>(p: *mut f32, v: S::V, lanes: usize) {
    // SAFETY: the caller promises that many floats and the instruction set.
    unsafe { if lanes == S::LANES { S::store(p, v) } else { S::store_n(p, v, lanes) } }
}

/// Zero in the lanes that do not count, so that they add nothing.
#[inline(always)]
unsafe fn deviation<S: Simd>(p: *const f32, lanes: usize, mean: S::V, means: *const f32) -> S::V {
    // SAFETY: as `load`; `means` holds a whole vector of the mean.
    unsafe {
        let mean = if lanes == S::LANES { mean } else { S::load_n(means, lanes) };
        S::sub(load::<S>(p, lanes), mean)
    }
}

/// `(x - mean) / sqrt(variance + epsilon) * gain + offset` for every row.
#[derive(Clone, Debug)]
pub struct LayerNorm {
    /// Rows: lines and rows per line.
    pub size: [usize; 2],
    /// Length of a row.
    pub columns: usize,
    /// First row.
    pub input: Place,
    /// From row to row.
    pub input_pitch: Pitch,
    /// First row of the result.
    pub output: usize,
    /// From row to row.
    pub output_pitch: Pitch,
    /// Gain, in the weights.
    pub gain: usize,
    /// Offset, in the weights.
    pub offset: Option<usize>,
    /// Added to the variance.
    pub epsilon: f32,
}

/// Rows that are normalised side by side: their sums do not wait for each other.
const ABREAST: usize = 4;

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn layer_norm<S: Simd>(s: &LayerNorm, mem: Mem, part: Part) {
    let rows = part.of(s.size[0] * s.size[1]);
    let mut row = rows.start;
    // SAFETY: as the caller promises.
    unsafe {
        while row + ABREAST <= rows.end {
            norm_rows::<S, ABREAST>(s, mem, row);
            row += ABREAST;
        }
        for row in row..rows.end {
            norm_rows::<S, 1>(s, mem, row);
        }
    }
}

/// # Safety
/// As for [`layer_norm`]; there are `R` rows from `first` on.
#[inline(always)]
unsafe fn norm_rows<S: Simd, const R: usize>(s: &LayerNorm, mem: Mem, first: usize) {
    let n = s.columns;
    // SAFETY: rows and columns are those that were checked.
    unsafe {
        let gain = mem.weights.add(s.gain);
        let place: [(*const f32, *mut f32); R] = core::array::from_fn(|r| {
            let (y, x) = ((first + r) / s.size[1], (first + r) % s.size[1]);
            (
                mem.at(s.input).add(y * s.input_pitch.y + x * s.input_pitch.x),
                mem.arena.add(s.output + y * s.output_pitch.y + x * s.output_pitch.x),
            )
        });
        let mut sums = [S::splat(0.0); R];
        vectors::<S>(n, |at, lanes| {
            for r in 0..R {
                sums[r] = S::add(sums[r], load::<S>(place[r].0.add(at), lanes));
            }
        });
        let means: [[f32; 16]; R] = core::array::from_fn(|r| [S::sum(sums[r]) / n as f32; 16]);
        let mut squares = [S::splat(0.0); R];
        vectors::<S>(n, |at, lanes| {
            for r in 0..R {
                let mean = S::splat(means[r][0]);
                let d = deviation::<S>(place[r].0.add(at), lanes, mean, means[r].as_ptr());
                squares[r] = S::fma(d, d, squares[r]);
            }
        });
        let factors: [f32; R] =
            core::array::from_fn(|r| 1.0 / (S::sum(squares[r]) / n as f32 + s.epsilon).sqrt());
        vectors::<S>(n, |at, lanes| {
            let g = load::<S>(gain.add(at), lanes);
            let o = match s.offset {
                Some(offset) => load::<S>(mem.weights.add(offset + at), lanes),
                None => S::splat(0.0),
            };
            for r in 0..R {
                let d = S::sub(load::<S>(place[r].0.add(at), lanes), S::splat(means[r][0]));
                let v = S::fma(S::mul(d, S::splat(factors[r])), g, o);
                store::<S>(place[r].1.add(at), v, lanes);
            }
        });
    }
}

/// Normalisation over all elements of a map with channels innermost.
#[derive(Clone, Debug)]
pub struct MapNorm {
    /// Lines and pixels.
    pub size: [usize; 2],
    /// Channels.
    pub channels: usize,
    /// First pixel.
    pub input: Place,
    /// From pixel to pixel.
    pub input_pitch: Pitch,
    /// First pixel of the result.
    pub output: usize,
    /// From pixel to pixel.
    pub output_pitch: Pitch,
    /// Per channel, in the weights.
    pub gain: Option<usize>,
    /// Per channel, in the weights.
    pub offset: Option<usize>,
    /// Whether mean and variance are used; if not, the sum of squares.
    pub centre: bool,
    /// Factor of the result.
    pub factor: f32,
    /// Added to the variance or the sum.
    pub epsilon: f32,
    /// Range of the result.
    pub clamp: (f32, f32),
    /// Zeros around the result.
    pub halo: Option<Halo>,
}

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn map_norm<S: Simd>(s: &MapNorm, mem: Mem, part: Part) {
    let [height, width] = s.size;
    let count = (height * width * s.channels) as f64;
    // SAFETY: lines, pixels and channels are those that were checked.
    unsafe {
        if let Some(halo) = s.halo.as_ref().filter(|_| part.id == 0) {
            halo.clear(mem);
        }
        let input = mem.at(s.input);
        let pixel = |y: usize, x: usize| input.add(y * s.input_pitch.y + x * s.input_pitch.x);
        // Every thread sums up everything: that is cheaper than to wait for each other. Lines are
        // summed in f32, their sums in f64.
        let mut mean = 0.0;
        if s.centre {
            for y in 0..height {
                let mut line = S::splat(0.0);
                for x in 0..width {
                    let p = pixel(y, x);
                    vectors::<S>(s.channels, |at, lanes| {
                        line = S::add(line, load::<S>(p.add(at), lanes));
                    });
                }
                mean += f64::from(S::sum(line));
            }
            mean /= count;
        }
        let means = [mean as f32; 16];
        let mean = S::splat(mean as f32);
        let mut squares = 0.0;
        for y in 0..height {
            let mut line = S::splat(0.0);
            for x in 0..width {
                let p = pixel(y, x);
                vectors::<S>(s.channels, |at, lanes| {
                    let d = deviation::<S>(p.add(at), lanes, mean, means.as_ptr());
                    line = S::fma(d, d, line);
                });
            }
            squares += f64::from(S::sum(line));
        }
        if s.centre {
            squares /= count;
        }
        let factor = f64::from(s.factor) / (squares + f64::from(s.epsilon)).sqrt();
        let factor = S::splat(factor as f32);
        let (low, high) = (S::splat(s.clamp.0), S::splat(s.clamp.1));
        for y in part.of(height) {
            for x in 0..width {
                let from = pixel(y, x);
                let to = mem.arena.add(s.output + y * s.output_pitch.y + x * s.output_pitch.x);
                vectors::<S>(s.channels, |at, lanes| {
                    let mut v = S::mul(S::sub(load::<S>(from.add(at), lanes), mean), factor);
                    if let Some(gain) = s.gain {
                        v = S::mul(v, load::<S>(mem.weights.add(gain + at), lanes));
                    }
                    if let Some(offset) = s.offset {
                        v = S::add(v, load::<S>(mem.weights.add(offset + at), lanes));
                    }
                    store::<S>(to.add(at), S::at_most(high, S::at_least(low, v)), lanes);
                });
            }
        }
    }
}

/// Softmax of every row.
#[derive(Clone, Debug)]
pub struct Softmax {
    /// Rows: lines and rows per line.
    pub size: [usize; 2],
    /// Length of a row.
    pub columns: usize,
    /// First row.
    pub input: Place,
    /// From row to row.
    pub input_pitch: Pitch,
    /// First row of the result.
    pub output: usize,
    /// From row to row.
    pub output_pitch: Pitch,
}

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn softmax<S: Simd>(s: &Softmax, mem: Mem, part: Part) {
    // SAFETY: rows and columns are those that were checked.
    unsafe {
        for row in part.of(s.size[0] * s.size[1]) {
            let (y, x) = (row / s.size[1], row % s.size[1]);
            let from = mem.at(s.input).add(y * s.input_pitch.y + x * s.input_pitch.x);
            let to = mem.arena.add(s.output + y * s.output_pitch.y + x * s.output_pitch.x);
            core::ptr::copy_nonoverlapping(from, to, s.columns);
            let mut inverse = 0.0;
            weigh::<S>(to, 1, 0, s.columns, 1.0, &mut inverse);
            vectors::<S>(s.columns, |at, lanes| {
                let v = S::mul(load::<S>(to.add(at), lanes), S::splat(inverse));
                store::<S>(to.add(at), v, lanes);
            });
        }
    }
}

/// `e^(scale * (x - max))` of `rows` rows of `n`, in place; the inverted sums go to `factors`.
/// `scale` is positive.
///
/// # Safety
/// The rows, `pitch` apart, and as many factors can be written; the instruction set is there.
#[inline(always)]
pub unsafe fn weigh<S: Simd>(
    first: *mut f32,
    rows: usize,
    pitch: usize,
    n: usize,
    scale: f32,
    factors: *mut f32,
) {
    // SAFETY: as promised by the caller.
    unsafe {
        let scale = S::splat(scale * core::f32::consts::LOG2_E);
        for row in 0..rows {
            let p = first.add(row * pitch);
            let whole = n / S::LANES * S::LANES;
            let mut top = [S::splat(f32::NEG_INFINITY); 4];
            let mut at = 0;
            while at + 4 * S::LANES <= whole {
                for (i, top) in top.iter_mut().enumerate() {
                    *top = S::at_least(*top, S::load(p.add(at + i * S::LANES)));
                }
                at += 4 * S::LANES;
            }
            while at < whole {
                top[0] = S::at_least(top[0], S::load(p.add(at)));
                at += S::LANES;
            }
            let mut max =
                S::top(S::at_least(S::at_least(top[0], top[1]), S::at_least(top[2], top[3])));
            while at < n {
                max = max.max(*p.add(at));
                at += 1;
            }
            // scale x - scale max in one operation.
            let shift = S::mul(S::splat(-max), scale);
            let mut sum = S::splat(0.0);
            let mut at = 0;
            while at < whole {
                let v = S::fma(S::load(p.add(at)), scale, shift);
                let e = simd::exp2::<S>(v);
                sum = S::add(sum, e);
                S::store(p.add(at), e);
                at += S::LANES;
            }
            let mut total = S::sum(sum);
            if at < n {
                let lanes = n - at;
                let v = S::fma(S::load_n(p.add(at), lanes), scale, shift);
                S::store_n(p.add(at), simd::exp2::<S>(v), lanes);
                total += S::sum(S::load_n(p.add(at), lanes));
            }
            *factors.add(row) = 1.0 / total;
        }
    }
}
