//! The vector operations that the kernels are written in, once for every instruction set.
//!
//! Every function here is inlined into a caller that has the instruction set switched on; that is
//! what makes them `unsafe`: the caller promises that the processor has it. Pointers must be valid
//! for the lanes that are read or written; no alignment is asked for.

/// One vector register of floats.
pub trait Simd: Copy {
    /// The register.
    type V: Copy;
    /// Floats in it.
    const LANES: usize;

    /// The same number in all lanes.
    unsafe fn splat(x: f32) -> Self::V;
    /// [`Self::LANES`] floats.
    unsafe fn load(p: *const f32) -> Self::V;
    /// The first `n` lanes from memory, zero in the others; `n <= LANES`.
    unsafe fn load_n(p: *const f32, n: usize) -> Self::V;
    /// Writes all lanes.
    unsafe fn store(p: *mut f32, v: Self::V);
    /// Writes the first `n` lanes; `n <= LANES`.
    unsafe fn store_n(p: *mut f32, v: Self::V, n: usize);
    /// `a + b`.
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    /// `a - b`.
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V;
    /// `a * b`.
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, rounded once where the processor can.
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// The larger; NaN where `v` is NaN.
    unsafe fn at_least(limit: Self::V, v: Self::V) -> Self::V;
    /// The smaller; NaN where `v` is NaN.
    unsafe fn at_most(limit: Self::V, v: Self::V) -> Self::V;
    /// Nearest integer.
    unsafe fn round(v: Self::V) -> Self::V;
    /// `v * 2^n` for an integer `n` from -126 to 127.
    unsafe fn scale2(v: Self::V, n: Self::V) -> Self::V;
    /// Sum of all lanes.
    unsafe fn sum(v: Self::V) -> f32;
    /// Largest lane.
    unsafe fn top(v: Self::V) -> f32;
    /// Asks for the line at `p`, wherever that is, before it is needed.
    #[inline(always)]
    unsafe fn prefetch(_p: *const f32) {}
}

/// `2^x` for `x <= 0`, within 3e-7 of the value; below -126 it stays at `2^-126`, about 1e-38.
#[inline(always)]
pub unsafe fn exp2<S: Simd>(x: S::V) -> S::V {
    // SAFETY: the caller promises the instruction set.
    unsafe {
        let x = S::at_least(S::splat(-126.0), x);
        let n = S::round(x);
        let r = S::sub(x, n);
        let mut p = S::splat(1.327_640_7e-3);
        for c in [9.675_541e-3, 5.550_713_5e-2, 2.402_212e-1, 6.931_469_4e-1, 1.000_000_1] {
            p = S::fma(p, r, S::splat(c));
        }
        S::scale2(p, n)
    }
}

/// `x * clamp(x / 6 + 1 / 2, 0, 1)`.
#[inline(always)]
pub unsafe fn hard_swish<S: Simd>(x: S::V) -> S::V {
    // SAFETY: the caller promises the instruction set.
    unsafe {
        let gate = S::fma(x, S::splat(1.0 / 6.0), S::splat(0.5));
        S::mul(x, S::at_most(S::splat(1.0), S::at_least(S::splat(0.0), gate)))
    }
}

/// Plain Rust: any processor, and Miri.
#[derive(Clone, Copy)]
pub struct Scalar;

const WIDE: usize = 8;

#[inline(always)]
fn each(f: impl Fn(usize) -> f32) -> [f32; WIDE] {
    let mut out = [0.0; WIDE];
    for (i, v) in out.iter_mut().enumerate() {
        *v = f(i);
    }
    out
}

impl Simd for Scalar {
    type V = [f32; WIDE];
    const LANES: usize = WIDE;

    #[inline(always)]
    unsafe fn splat(x: f32) -> Self::V {
        [x; WIDE]
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self::V {
        // SAFETY: the caller promises that all lanes can be read.
        each(|i| unsafe { *p.add(i) })
    }
    #[inline(always)]
    unsafe fn load_n(p: *const f32, n: usize) -> Self::V {
        // SAFETY: the caller promises that the first n lanes can be read.
        each(|i| if i < n { unsafe { *p.add(i) } } else { 0.0 })
    }
    #[inline(always)]
    unsafe fn store(p: *mut f32, v: Self::V) {
        // SAFETY: the caller promises that all lanes can be written.
        unsafe { Self::store_n(p, v, WIDE) }
    }
    #[inline(always)]
    unsafe fn store_n(p: *mut f32, v: Self::V, n: usize) {
        for (i, x) in v.into_iter().enumerate().take(n) {
            // SAFETY: the caller promises that the first n lanes can be written.
            unsafe { *p.add(i) = x };
        }
    }
    #[inline(always)]
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V {
        each(|i| a[i] + b[i])
    }
    #[inline(always)]
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V {
        each(|i| a[i] - b[i])
    }
    #[inline(always)]
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V {
        each(|i| a[i] * b[i])
    }
    #[inline(always)]
    unsafe fn fma(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        // Not `mul_add`, which is a library call where the processor has no such instruction.
        each(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    unsafe fn at_least(limit: Self::V, v: Self::V) -> Self::V {
        each(|i| if v[i] < limit[i] { limit[i] } else { v[i] })
    }
    #[inline(always)]
    unsafe fn at_most(limit: Self::V, v: Self::V) -> Self::V {
        each(|i| if v[i] > limit[i] { limit[i] } else { v[i] })
    }
    #[inline(always)]
    unsafe fn round(v: Self::V) -> Self::V {
        each(|i| v[i].round_ties_even())
    }
    #[inline(always)]
    unsafe fn scale2(v: Self::V, n: Self::V) -> Self::V {
        each(|i| v[i] * f32::from_bits(((n[i] as i32 + 127) as u32) << 23))
    }
    #[inline(always)]
    unsafe fn sum(v: Self::V) -> f32 {
        v.into_iter().sum()
    }
    #[inline(always)]
    unsafe fn top(v: Self::V) -> f32 {
        v.into_iter().fold(f32::NEG_INFINITY, f32::max)
    }
}
