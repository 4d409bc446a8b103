//! Work per channel: depthwise convolutions and pooling, on maps with channels innermost.

use super::simd::{Simd, hard_swish};
use super::{Halo, Mem, Part, Pitch, Place};

/// A convolution of every channel with its own kernel.
#[derive(Clone, Debug)]
pub struct Depthwise {
    /// Lines and pixels of the result.
    pub size: [usize; 2],
    /// Channels.
    pub channels: usize,
    /// First element of the first window.
    pub input: Place,
    /// From window to window.
    pub input_pitch: Pitch,
    /// Offsets of the kernel elements in a window.
    pub taps: Box<[usize]>,
    /// Kernel, `taps` rows of `channels`.
    pub weights: usize,
    /// Bias, `channels` numbers.
    pub bias: Option<usize>,
    /// First element of the result.
    pub output: usize,
    /// From pixel to pixel of the result.
    pub output_pitch: Pitch,
    /// Whether the result is the hard-swish of the sum.
    pub swish: bool,
    /// Range of the result.
    pub clamp: (f32, f32),
    /// Zeros around the result.
    pub halo: Option<Halo>,
}

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn depthwise<S: Simd>(s: &Depthwise, mem: Mem, part: Part) {
    // SAFETY: passed on.
    unsafe {
        if let Some(halo) = s.halo.as_ref().filter(|_| part.id == 0) {
            halo.clear(mem);
        }
        match (s.taps.len(), s.swish) {
            (9, false) => depthwise_of::<S, 9, false>(s, mem, part),
            (25, false) => depthwise_of::<S, 25, false>(s, mem, part),
            (_, false) => depthwise_of::<S, 0, false>(s, mem, part),
            (9, true) => depthwise_of::<S, 9, true>(s, mem, part),
            (25, true) => depthwise_of::<S, 25, true>(s, mem, part),
            (_, true) => depthwise_of::<S, 0, true>(s, mem, part),
        }
    }
}

/// `T` is the number of taps, 0 when it is none of those with code of their own. Hard-swish is code of
/// its own too: 25 weights leave no registers for constants that are not needed.
#[inline(always)]
unsafe fn depthwise_of<S: Simd, const T: usize, const SWISH: bool>(
    s: &Depthwise,
    mem: Mem,
    part: Part,
) {
    let [height, width] = s.size;
    let (low, high) = (s.clamp.0, s.clamp.1);
    // SAFETY: the check covers all taps of all windows, and all channels.
    unsafe {
        let (low, high) = (S::splat(low), S::splat(high));
        let kernel = mem.weights.add(s.weights);
        let input = mem.at(s.input);
        for y in part.of(height) {
            let (line, out) = (input.add(y * s.input_pitch.y), s.output + y * s.output_pitch.y);
            let out = mem.arena.add(out);
            let mut channel = 0;
            while channel < s.channels {
                let n = (s.channels - channel).min(S::LANES);
                let whole = n == S::LANES;
                let load = |p: *const f32| if whole { S::load(p) } else { S::load_n(p, n) };
                let bias = match s.bias {
                    Some(at) => load(mem.weights.add(at + channel)),
                    None => S::splat(0.0),
                };
                let mut weights = [bias; 32];
                let mut offsets = [0; 32];
                for t in 0..T {
                    weights[t] = load(kernel.add(t * s.channels + channel));
                    offsets[t] = *s.taps.get_unchecked(t);
                }
                for x in 0..width {
                    let window = line.add(x * s.input_pitch.x + channel);
                    let mut sum = bias;
                    if T == 0 {
                        for (t, &offset) in s.taps.iter().enumerate() {
                            let w = load(kernel.add(t * s.channels + channel));
                            sum = S::fma(load(window.add(offset)), w, sum);
                        }
                    } else {
                        // Two sums, so that one does not wait for the other.
                        let mut other = S::splat(0.0);
                        for t in 0..T {
                            let v = load(window.add(offsets[t]));
                            if t % 2 == 0 {
                                sum = S::fma(v, weights[t], sum);
                            } else {
                                other = S::fma(v, weights[t], other);
                            }
                        }
                        sum = S::add(sum, other);
                    }
                    if SWISH {
                        sum = hard_swish::<S>(sum);
                    }
                    let y = S::at_most(high, S::at_least(low, sum));
                    let at = out.add(x * s.output_pitch.x + channel);
                    if whole { S::store(at, y) } else { S::store_n(at, y, n) }
                }
                channel += n;
            }
        }
    }
}

/// Maximum or mean over windows.
#[derive(Clone, Debug)]
pub struct Pool {
    /// Lines and pixels of the input.
    pub from: [usize; 2],
    /// Lines and pixels of the result.
    pub size: [usize; 2],
    /// Channels.
    pub channels: usize,
    /// Lines and pixels of a window.
    pub kernel: [usize; 2],
    /// From window to window.
    pub stride: [usize; 2],
    /// Between elements of a window.
    pub dilation: [usize; 2],
    /// Padding, above and left.
    pub pad: [usize; 2],
    /// First pixel of the input.
    pub input: Place,
    /// From pixel to pixel of the input.
    pub input_pitch: Pitch,
    /// First pixel of the result.
    pub output: usize,
    /// From pixel to pixel of the result.
    pub output_pitch: Pitch,
    /// Maximum, or mean.
    pub max: bool,
    /// Whether padding counts in a mean.
    pub count_pad: bool,
    /// Zeros around the result.
    pub halo: Option<Halo>,
}

impl Pool {
    /// Kernel elements of window `at` along an axis that lie on the map.
    fn inside(&self, axis: usize, at: usize) -> core::ops::Range<usize> {
        let (first, d) = (at * self.stride[axis], self.dilation[axis]);
        let start = self.pad[axis].saturating_sub(first).div_ceil(d);
        let end = (self.from[axis] + self.pad[axis]).saturating_sub(first).div_ceil(d);
        start..end.min(self.kernel[axis]).max(start)
    }
}

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn pool<S: Simd>(s: &Pool, mem: Mem, part: Part) {
    // SAFETY: `inside` keeps every access on the input map, which the check covers.
    unsafe {
        if let Some(halo) = s.halo.as_ref().filter(|_| part.id == 0) {
            halo.clear(mem);
        }
        let input = mem.at(s.input);
        for y in part.of(s.size[0]) {
            let lines = s.inside(0, y);
            for x in 0..s.size[1] {
                let pixels = s.inside(1, x);
                let count = if s.count_pad {
                    s.kernel[0] * s.kernel[1]
                } else {
                    lines.len() * pixels.len()
                };
                let out = s.output + y * s.output_pitch.y + x * s.output_pitch.x;
                let out = mem.arena.add(out);
                let mut channel = 0;
                while channel < s.channels {
                    let n = (s.channels - channel).min(S::LANES);
                    let whole = n == S::LANES;
                    let mut all = S::splat(if s.max { f32::NEG_INFINITY } else { 0.0 });
                    for ky in lines.clone() {
                        let line = y * s.stride[0] + ky * s.dilation[0] - s.pad[0];
                        for kx in pixels.clone() {
                            let pixel = x * s.stride[1] + kx * s.dilation[1] - s.pad[1];
                            let at = line * s.input_pitch.y + pixel * s.input_pitch.x + channel;
                            let p = input.add(at);
                            let v = if whole { S::load(p) } else { S::load_n(p, n) };
                            all = if s.max { S::at_least(all, v) } else { S::add(all, v) };
                        }
                    }
                    if !s.max {
                        all = S::mul(all, S::splat(1.0 / count as f32));
                    }
                    let at = out.add(channel);
                    if whole {
                        S::store(at, all)
                    } else {
                        S::store_n(at, all, n)
                    }
                    channel += n;
                }
            }
        }
    }
}
