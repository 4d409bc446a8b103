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
        match (s.square(), s.swish) {
            (3, false) => depthwise_of::<S, 3, false>(s, mem, part),
            (5, false) => depthwise_of::<S, 5, false>(s, mem, part),
            (_, false) => depthwise_of::<S, 0, false>(s, mem, part),
            (3, true) => depthwise_of::<S, 3, true>(s, mem, part),
            (5, true) => depthwise_of::<S, 5, true>(s, mem, part),
            (_, true) => depthwise_of::<S, 0, true>(s, mem, part),
        }
    }
}

impl Depthwise {
    /// Lines and columns of a kernel whose taps are that many lines of as many, evenly spaced.
    fn square(&self) -> usize {
        let even = |&k: &usize| {
            self.taps.len() == k * k
                && (0..k * k).all(|t| self.taps[t] == t / k * self.taps[k] + t % k * self.taps[1])
        };
        [3, 5].into_iter().find(even).unwrap_or(0)
    }
}

/// `K` is [`Depthwise::square`], or 0 for any taps. Hard-swish is code of its own too: 25 weights leave
/// no registers for constants that are not needed.
#[inline(always)]
unsafe fn depthwise_of<S: Simd, const K: usize, const SWISH: bool>(
    s: &Depthwise,
    mem: Mem,
    part: Part,
) {
    /// Sums that do not wait for each other.
    const ABREAST: usize = 3;
    let [height, width] = s.size;
    // Addresses from two distances: as many offsets as taps would have to be read from memory.
    let [across, down] = if K == 0 { [0; 2] } else { [s.taps[1], s.taps[K]] };
    // SAFETY: the check covers all taps of all windows, and all channels.
    unsafe {
        let (low, high) = (S::splat(s.clamp.0), S::splat(s.clamp.1));
        let kernel = mem.weights.add(s.weights);
        let input = mem.at(s.input);
        // A vector of channels of all lines stays in the first-level cache, and so do its weights in
        // registers.
        let mut channel = 0;
        while channel < s.channels {
            let n = (s.channels - channel).min(S::LANES);
            let whole = n == S::LANES;
            let load = |p: *const f32| if whole { S::load(p) } else { S::load_n(p, n) };
            let bias = match s.bias {
                Some(at) => load(mem.weights.add(at + channel)),
                None => S::splat(0.0),
            };
            let mut weights = [[bias; 5]; 5];
            for ky in 0..K {
                for kx in 0..K {
                    weights[ky][kx] = load(kernel.add((ky * K + kx) * s.channels + channel));
                }
            }
            for y in part.of(height) {
                let line = input.add(y * s.input_pitch.y + channel);
                let out = mem.arena.add(s.output + y * s.output_pitch.y + channel);
                for x in 0..width {
                    let window = line.add(x * s.input_pitch.x);
                    let mut sums = [S::splat(0.0); ABREAST];
                    sums[0] = bias;
                    if K == 0 {
                        for (t, &offset) in s.taps.iter().enumerate() {
                            let w = load(kernel.add(t * s.channels + channel));
                            sums[0] = S::fma(load(window.add(offset)), w, sums[0]);
                        }
                    }
                    for ky in 0..K {
                        let taps = window.add(ky * down);
                        for kx in 0..K {
                            let sum = &mut sums[(ky * K + kx) % ABREAST];
                            *sum = S::fma(load(taps.add(kx * across)), weights[ky][kx], *sum);
                        }
                    }
                    let mut sum = S::add(S::add(sums[0], sums[1]), sums[2]);
                    if SWISH {
                        sum = hard_swish::<S>(sum);
                    }
                    let v = S::at_most(high, S::at_least(low, sum));
                    let at = out.add(x * s.output_pitch.x);
                    if whole { S::store(at, v) } else { S::store_n(at, v, n) }
                }
            }
            channel += n;
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
