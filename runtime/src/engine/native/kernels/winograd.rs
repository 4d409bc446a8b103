//! 3 x 3 convolutions with 16 multiplications where loops take 36: Winograd's F(2 x 2, 3 x 3)
//! (Lavin and Gray, "Fast algorithms for convolutional neural networks", 2015).
//!
//! A window of 4 x 4 pixels gives a tile of 2 x 2 results. [`ToPoints`] transforms windows into 16
//! numbers per channel (`B'dB`), one matrix of tiles and channels per number; 16 ordinary products
//! with weights transformed at load ([`transform`], `GgG'`) follow; [`FromPoints`] turns their results
//! into pixels (`A'mA`). The transforms of pixels are additions only, so little precision is lost.

use super::gemm::Packing;
use super::simd::{Simd, hard_swish};
use super::{Mem, Part, Pitch, Place};

/// Numbers per window and channel, and so matrices.
pub const POINTS: usize = 16;

/// Matrices of equal size, one per point: rows are tiles, line by line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Matrices {
    /// Address of the first one.
    pub start: usize,
    /// Floats from tile to tile.
    pub row: usize,
    /// Floats from matrix to matrix.
    pub matrix: usize,
}

impl Matrices {
    /// Floats from the first to behind the last element.
    pub const fn extent(&self, tiles: usize, columns: usize) -> usize {
        (POINTS - 1) * self.matrix + (tiles - 1) * self.row + columns
    }

    /// Whether no two of their rows of `columns` share a place.
    pub const fn apart(&self, tiles: usize, columns: usize) -> bool {
        (tiles == 1 || self.row >= columns) && self.matrix >= (tiles - 1) * self.row + columns
    }
}

/// Windows of a map to points.
#[derive(Clone, Debug)]
pub struct ToPoints {
    /// Lines and columns of tiles.
    pub size: [usize; 2],
    /// Channels.
    pub channels: usize,
    /// First pixel of the first window.
    pub input: Place,
    /// From pixel to pixel of the map.
    pub input_pitch: Pitch,
    /// Points.
    pub output: Matrices,
}

/// Packed weights of a 3 x 3 convolution to packed weights of the products, point by point.
#[derive(Clone, Debug)]
pub struct KernelsToPoints {
    /// Rows of each of the nine matrices that lie one after the other, and of the results.
    pub channels: usize,
    /// Their columns.
    pub columns: usize,
    /// [`Packing`] of `9 * channels` rows, pixel by pixel of the kernel.
    pub weights: usize,
    /// [`POINTS`] packings of `channels` rows.
    pub output: usize,
}

/// Points to pixels of the result, `clamp(sum + bias + residual)` as for [`super::Gemm`].
#[derive(Clone, Debug)]
pub struct FromPoints {
    /// Lines and columns of tiles.
    pub size: [usize; 2],
    /// Channels of the result.
    pub columns: usize,
    /// Points.
    pub input: Matrices,
    /// Bias, padded with zeros to whole vectors.
    pub bias: Option<usize>,
    /// First pixel of the result.
    pub output: usize,
    /// From pixel to pixel of the result.
    pub output_pitch: Pitch,
    /// Added before the limits; same size as the result.
    pub residual: Option<(Place, Pitch)>,
    /// Whether the result is the hard-swish of the sum.
    pub swish: bool,
    /// Range of the result.
    pub clamp: (f32, f32),
}

/// The 16 numbers that a kernel of 3 x 3 becomes (`GgG'`).
pub fn transform(g: [[f32; 3]; 3]) -> [f32; POINTS] {
    let line = |a: f64, b: f64, c: f64| [a, 0.5 * (a + b + c), 0.5 * (a - b + c), c];
    let g = g.map(|row| row.map(f64::from));
    let columns: [[f64; 4]; 3] = core::array::from_fn(|x| line(g[0][x], g[1][x], g[2][x]));
    let mut out = [0.0; POINTS];
    for y in 0..4 {
        let row = line(columns[0][y], columns[1][y], columns[2][y]);
        for x in 0..4 {
            out[4 * y + x] = row[x] as f32;
        }
    }
    out
}

/// Three numbers of a kernel in a row to points (`Gg`).
#[inline(always)]
unsafe fn kernel<S: Simd>([a, b, c]: [S::V; 3]) -> [S::V; 4] {
    // SAFETY: the caller promises the instruction set.
    unsafe {
        let half = S::splat(0.5);
        let (ends, middle) = (S::mul(half, S::add(a, c)), S::mul(half, b));
        [a, S::add(ends, middle), S::sub(ends, middle), c]
    }
}

/// # Safety
/// The step was checked, the instruction set and its packing are there, nobody else touches the result.
#[inline(always)]
pub unsafe fn kernels_to_points<S: Simd>(
    s: &KernelsToPoints,
    packing: Packing,
    mem: Mem,
    part: Part,
) {
    let len = packing.len(s.channels, s.columns);
    // SAFETY: the check covers nine matrices and as many results as there are points.
    unsafe {
        // Panels lie one after the other; rows of all of them are shared out.
        for row in part.of(s.columns.div_ceil(packing.width) * s.channels) {
            let (panel, channel) = (row / s.channels, row % s.channels);
            let first = panel * packing.width;
            let width = packing.columns(packing.width.min(s.columns - first));
            let from = mem.weights.add(s.weights + 9 * first * s.channels + channel * width);
            let to = mem.arena.add(s.output + first * s.channels + channel * width);
            for column in (0..width).step_by(S::LANES) {
                let load = |tap: usize| S::load(from.add(tap * s.channels * width + column));
                let mut lines = [[S::splat(0.0); 4]; 3];
                for y in 0..3 {
                    lines[y] = kernel::<S>([load(3 * y), load(3 * y + 1), load(3 * y + 2)]);
                }
                for x in 0..4 {
                    let points = kernel::<S>([lines[0][x], lines[1][x], lines[2][x]]);
                    for y in 0..4 {
                        S::store(to.add((4 * y + x) * len + column), points[y]);
                    }
                }
            }
        }
    }
}

/// Four pixels in a row to points (`B'd`).
#[inline(always)]
unsafe fn four<S: Simd>([a, b, c, d]: [S::V; 4]) -> [S::V; 4] {
    // SAFETY: the caller promises the instruction set.
    unsafe { [S::sub(a, c), S::add(b, c), S::sub(c, b), S::sub(b, d)] }
}

/// Four points to two pixels in a row (`A'm`).
#[inline(always)]
unsafe fn two<S: Simd>([a, b, c, d]: [S::V; 4]) -> [S::V; 2] {
    // SAFETY: the caller promises the instruction set.
    unsafe { [S::add(S::add(a, b), c), S::sub(S::sub(b, c), d)] }
}

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn to_points<S: Simd>(s: &ToPoints, mem: Mem, part: Part) {
    // SAFETY: the check covers all windows, and all channels of all points.
    unsafe {
        let input = mem.at(s.input);
        for line in part.of(s.size[0]) {
            for column in 0..s.size[1] {
                let window = input.add(2 * line * s.input_pitch.y + 2 * column * s.input_pitch.x);
                let tile = line * s.size[1] + column;
                let out = mem.arena.add(s.output.start + tile * s.output.row);
                let mut channel = 0;
                while channel < s.channels {
                    let n = (s.channels - channel).min(S::LANES);
                    let whole = n == S::LANES;
                    let load = |y: usize, x: usize| {
                        let p = window.add(y * s.input_pitch.y + x * s.input_pitch.x + channel);
                        if whole { S::load(p) } else { S::load_n(p, n) }
                    };
                    let mut d = [[S::splat(0.0); 4]; 4];
                    for y in 0..4 {
                        d[y] = four::<S>([load(y, 0), load(y, 1), load(y, 2), load(y, 3)]);
                    }
                    for x in 0..4 {
                        let column = four::<S>([d[0][x], d[1][x], d[2][x], d[3][x]]);
                        for y in 0..4 {
                            let at = out.add((4 * y + x) * s.output.matrix + channel);
                            if whole {
                                S::store(at, column[y])
                            } else {
                                S::store_n(at, column[y], n)
                            }
                        }
                    }
                    channel += n;
                }
            }
        }
    }
}

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn from_points<S: Simd>(s: &FromPoints, mem: Mem, part: Part) {
    // SAFETY: the check covers all points, and all pixels of all tiles.
    unsafe {
        let (low, high) = (S::splat(s.clamp.0), S::splat(s.clamp.1));
        let along = |p: Pitch, y: usize, x: usize| y * p.y + x * p.x;
        for line in part.of(s.size[0]) {
            for column in 0..s.size[1] {
                let tile = line * s.size[1] + column;
                let points = mem.arena.add(s.input.start + tile * s.input.row);
                let mut channel = 0;
                while channel < s.columns {
                    let n = (s.columns - channel).min(S::LANES);
                    let whole = n == S::LANES;
                    let load = |p: *const f32| if whole { S::load(p) } else { S::load_n(p, n) };
                    let mut lines = [[S::splat(0.0); 4]; 2];
                    for x in 0..4 {
                        let m = |y: usize| load(points.add((4 * y + x) * s.input.matrix + channel));
                        [lines[0][x], lines[1][x]] = two::<S>([m(0), m(1), m(2), m(3)]);
                    }
                    let bias = match s.bias {
                        Some(at) => load(mem.weights.add(at + channel)),
                        None => S::splat(0.0),
                    };
                    for y in 0..2 {
                        let pixels = two::<S>(lines[y]);
                        for x in 0..2 {
                            let mut v = S::add(pixels[x], bias);
                            let (py, px) = (2 * line + y, 2 * column + x);
                            if let Some((place, pitch)) = s.residual {
                                v = S::add(
                                    v,
                                    load(mem.at(place).add(along(pitch, py, px) + channel)),
                                );
                            }
                            if s.swish {
                                v = hard_swish::<S>(v);
                            }
                            let v = S::at_most(high, S::at_least(low, v));
                            let at = s.output + along(s.output_pitch, py, px) + channel;
                            let at = mem.arena.add(at);
                            if whole { S::store(at, v) } else { S::store_n(at, v, n) }
                        }
                    }
                    channel += n;
                }
            }
        }
    }
}
