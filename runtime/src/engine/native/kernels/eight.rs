//! Products of 8-bit numbers: activations unsigned with a zero point, weights signed, sums in 32
//! bits, results floats. Four neighbouring numbers share the place of one float, so a product of
//! bytes is a [`Gemm`] whose rows are a quarter as long: addresses, windows and panels are the same.

mod attention;

use super::attention::Attention;
use super::gemm::{Packing, Tile, TileFn};
use super::simd::{Simd, hard_swish};
use super::table::{MAX_ROWS, MAX_VECTORS};
use super::{Halo, Mem, Part, Pitch, Place};

pub use attention::{PackKvBytes, attend, pack as pack_kv};

/// Bytes in the place of a float.
pub const BYTES: usize = 4;

/// Order of the weights of one vector: `lanes` columns of four rows each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// Column by column, its four rows side by side.
    Quads,
    /// Rows 0 and 1 of all columns, then rows 2 and 3.
    Pairs,
    /// Row by row.
    Rows,
}

impl Layout {
    /// Place of a byte in its vector.
    const fn at(self, lanes: usize, column: usize, row: usize) -> usize {
        match self {
            Self::Quads => column * BYTES + row,
            Self::Pairs => row / 2 * (lanes * 2) + column * 2 + row % 2,
            Self::Rows => row * lanes + column,
        }
    }
}

/// The functions and layouts for 8-bit numbers of one instruction set.
#[derive(Clone, Copy, Debug)]
pub struct Eight {
    /// Rows of a full tile.
    pub rows: usize,
    /// Layout of packed matrices, in places of floats.
    pub packing: Packing,
    /// Order within a vector.
    pub layout: Layout,
    /// What the kernel takes off every activation; its share of the sum is part of the bias.
    pub shift: i32,
    pub(super) tiles: [[TileFn; MAX_ROWS]; MAX_VECTORS],
    pub(super) quantise: unsafe fn(&Quantise, Mem, Part),
    pub(super) pack_kv: unsafe fn(&PackKvBytes, Mem, Part),
    pub(super) attend: unsafe fn(&Attention, Mem, Part),
}

impl Eight {
    /// Floats that hold `n` bytes.
    pub const fn floats(n: usize) -> usize {
        n.div_ceil(BYTES)
    }

    /// Appends a matrix of `groups * 4` rows and `columns` columns, its elements given by
    /// `weight(row, column)`.
    pub fn pack(
        &self,
        groups: usize,
        columns: usize,
        weight: impl Fn(usize, usize) -> i8,
        out: &mut Vec<f32>,
    ) {
        let Packing { width, lanes } = self.packing;
        let mut vector = vec![0u8; lanes * BYTES];
        for panel in (0..columns).step_by(width) {
            let end = columns.min(panel + width);
            for group in 0..groups {
                for first in (panel..end).step_by(lanes) {
                    vector.fill(0);
                    for column in first..end.min(first + lanes) {
                        for row in 0..BYTES {
                            let at = self.layout.at(lanes, column - first, row);
                            vector[at] = weight(group * BYTES + row, column).cast_unsigned();
                        }
                    }
                    let four = vector.as_chunks::<BYTES>().0;
                    out.extend(four.iter().map(|b| f32::from_bits(u32::from_ne_bytes(*b))));
                }
            }
        }
    }
}

/// Floats to bytes: `round(x * factor) + zero`, limited to a byte.
#[derive(Clone, Debug)]
pub struct Quantise {
    /// Lines and pixels, or rows.
    pub size: [usize; 2],
    /// Elements of a pixel.
    pub channels: usize,
    /// First element.
    pub input: Place,
    /// From pixel to pixel.
    pub input_pitch: Pitch,
    /// First byte, as the place of a float in the arena.
    pub output: usize,
    /// From pixel to pixel of the result, in places of floats.
    pub output_pitch: Pitch,
    /// One over the step.
    pub factor: f32,
    /// What stands for zero.
    pub zero: u8,
    /// Border of the result, filled with `zero`.
    pub halo: Option<Halo>,
}

/// Vector operations on bytes. As for [`Simd`]: the caller promises the instruction set and valid
/// pointers.
pub trait Dot {
    /// The floats beside it.
    type F: Simd;
    /// Sums, one per lane.
    type I: Copy;
    /// Weights of a vector.
    type W: Copy;
    /// Four activations for all lanes.
    type X: Copy;
    /// Order of the weights.
    const LAYOUT: Layout;
    /// See [`Eight::shift`].
    const SHIFT: i32 = 0;

    /// No sum.
    unsafe fn zero() -> Self::I;
    /// Weights of as many columns as there are lanes.
    unsafe fn weights(p: *const f32) -> Self::W;
    /// Four activations.
    unsafe fn bytes(p: *const f32) -> Self::X;
    /// Adds four products per lane; nothing saturates.
    unsafe fn dot(sum: Self::I, x: Self::X, w: Self::W) -> Self::I;
    /// The sums as floats.
    unsafe fn floats(sum: Self::I) -> <Self::F as Simd>::V;
    /// The same number in all lanes.
    unsafe fn all(n: i32) -> Self::I;
    /// As many sums as there are lanes.
    unsafe fn load(p: *const i32) -> Self::I;
    /// Writes all lanes.
    unsafe fn store(p: *mut i32, sum: Self::I);
    /// The larger in every lane.
    unsafe fn larger(a: Self::I, b: Self::I) -> Self::I;
    /// Largest lane.
    unsafe fn top(sum: Self::I) -> i32;
    /// Writes as many bytes as there are lanes, of numbers from 0 to 255 rounded to whole ones.
    unsafe fn narrow(v: <Self::F as Simd>::V, to: *mut u8);
}

/// `R` rows times `NV` vectors of columns; see [`super::gemm::tile`].
///
/// # Safety
/// As for [`super::gemm::tile`]; `scales` and `bias` hold one number per column.
#[inline(always)]
pub unsafe fn tile<D: Dot, const R: usize, const NV: usize>(t: &Tile) {
    // SAFETY: as promised by the caller.
    unsafe {
        let lanes = <D::F as Simd>::LANES;
        let mut acc = [[D::zero(); NV]; R];
        let mut b = t.b;
        for tap in 0..t.tap_count {
            let offset = *t.taps.add(tap);
            let mut a = [core::ptr::null::<f32>(); R];
            for r in 0..R {
                a[r] = t.a[r].add(offset);
            }
            for k in 0..t.run {
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
        }
        let (low, high) = (D::F::splat(t.clamp.0), D::F::splat(t.clamp.1));
        let whole = t.columns == NV * lanes;
        // Every loop below is so small that it is unrolled and the sums stay in registers.
        let mut sums = [[D::F::splat(0.0); NV]; R];
        for j in 0..NV {
            let at = t.column + j * lanes;
            let (scale, bias) = (D::F::load(t.scales.add(at)), D::F::load(t.bias.add(at)));
            for r in 0..R {
                sums[r][j] = D::F::fma(D::floats(acc[r][j]), scale, bias);
            }
        }
        let rest = |j: usize| if whole { lanes } else { (t.columns - j * lanes).min(lanes) };
        if t.residual {
            for j in 0..NV {
                let at = t.column + j * lanes;
                for r in 0..R {
                    let p = t.r[r].add(at);
                    let residual = if whole { D::F::load(p) } else { D::F::load_n(p, rest(j)) };
                    sums[r][j] = D::F::add(sums[r][j], residual);
                }
            }
        }
        if t.swish {
            for r in 0..R {
                for j in 0..NV {
                    sums[r][j] = hard_swish::<D::F>(sums[r][j]);
                }
            }
        }
        for j in 0..NV {
            let at = t.column + j * lanes;
            for r in 0..R {
                let y = D::F::at_most(high, D::F::at_least(low, sums[r][j]));
                if whole {
                    D::F::store(t.c[r].add(at), y);
                } else {
                    D::F::store_n(t.c[r].add(at), y, rest(j));
                }
            }
        }
    }
}

/// Most lanes of any instruction set.
const MAX_LANES: usize = 16;

/// # Safety
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn quantise<D: Dot>(s: &Quantise, mem: Mem, part: Part) {
    let lanes = <D::F as Simd>::LANES;
    // SAFETY: the check covers all channels of all pixels.
    unsafe {
        if let Some(halo) = s.halo.as_ref().filter(|_| part.id == 0) {
            halo.fill(mem, s.zero);
        }
        let (factor, zero) = (D::F::splat(s.factor), D::F::splat(f32::from(s.zero)));
        let (low, high) = (D::F::splat(0.0), D::F::splat(255.0));
        let rounded = |x| {
            let y = D::F::add(D::F::round(D::F::mul(x, factor)), zero);
            D::F::at_most(high, D::F::at_least(low, y))
        };
        let input = mem.at(s.input);
        let [height, width] = s.size;
        // One long line is cut, many lines are dealt out.
        let (lines, pixels) = if height >= part.of {
            (part.of(height), 0..width)
        } else {
            (0..height, part.of(width))
        };
        for y in lines {
            for x in pixels.clone() {
                let from = input.add(y * s.input_pitch.y + x * s.input_pitch.x);
                let to = mem.arena.add(s.output + y * s.output_pitch.y + x * s.output_pitch.x);
                let to = to.cast::<u8>();
                let mut channel = 0;
                while channel + lanes <= s.channels {
                    D::narrow(rounded(D::F::load(from.add(channel))), to.add(channel));
                    channel += lanes;
                }
                if channel < s.channels {
                    let n = s.channels - channel;
                    let mut rest = [0u8; MAX_LANES];
                    let v = D::F::load_n(from.add(channel), n);
                    D::narrow(rounded(v), rest.as_mut_ptr());
                    core::ptr::copy_nonoverlapping(rest.as_ptr(), to.add(channel), n);
                }
            }
        }
    }
}

/// Plain Rust.
pub struct ScalarDot;

impl Dot for ScalarDot {
    type F = super::simd::Scalar;
    type I = [i32; <super::simd::Scalar as Simd>::LANES];
    type W = *const i8;
    type X = [u8; BYTES];
    const LAYOUT: Layout = Layout::Quads;

    #[inline(always)]
    unsafe fn zero() -> Self::I {
        [0; _]
    }
    #[inline(always)]
    unsafe fn weights(p: *const f32) -> Self::W {
        p.cast()
    }
    #[inline(always)]
    unsafe fn bytes(p: *const f32) -> Self::X {
        // SAFETY: the caller promises four bytes.
        unsafe { *p.cast::<Self::X>() }
    }
    #[inline(always)]
    unsafe fn dot(mut sum: Self::I, x: Self::X, w: Self::W) -> Self::I {
        for (lane, sum) in sum.iter_mut().enumerate() {
            for (k, x) in x.into_iter().enumerate() {
                // SAFETY: the caller promises four bytes for every lane.
                *sum += i32::from(x) * i32::from(unsafe { *w.add(lane * BYTES + k) });
            }
        }
        sum
    }
    #[inline(always)]
    unsafe fn floats(sum: Self::I) -> <Self::F as Simd>::V {
        sum.map(|n| n as f32)
    }
    #[inline(always)]
    unsafe fn all(n: i32) -> Self::I {
        [n; _]
    }
    #[inline(always)]
    unsafe fn load(p: *const i32) -> Self::I {
        // SAFETY: the caller promises that all lanes can be read.
        unsafe { p.cast::<Self::I>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(p: *mut i32, sum: Self::I) {
        // SAFETY: the caller promises that all lanes can be written.
        unsafe { p.cast::<Self::I>().write_unaligned(sum) }
    }
    #[inline(always)]
    unsafe fn larger(a: Self::I, b: Self::I) -> Self::I {
        core::array::from_fn(|i| a[i].max(b[i]))
    }
    #[inline(always)]
    unsafe fn top(sum: Self::I) -> i32 {
        sum.into_iter().fold(i32::MIN, i32::max)
    }
    #[inline(always)]
    unsafe fn narrow(v: <Self::F as Simd>::V, to: *mut u8) {
        for (i, x) in v.into_iter().enumerate() {
            // SAFETY: the caller promises room for all lanes.
            unsafe { *to.add(i) = x.round_ties_even() as u8 };
        }
    }
}
