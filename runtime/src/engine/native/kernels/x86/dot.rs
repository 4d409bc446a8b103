//! 8-bit products: VNNI in both widths, and AVX2 without it.

use super::{Avx2, Avx512};
use crate::engine::native::kernels::eight::{Dot, Layout};
use core::arch::x86_64::*;

/// Sixteen sums; needs `avx512f` and `avx512vnni`.
pub struct Vnni512;

// SAFETY of all blocks below: the trait's contract, the caller promises the instruction set and
// valid pointers.
#[expect(clippy::undocumented_unsafe_blocks, reason = "one contract for all, stated above")]
impl Dot for Vnni512 {
    type F = Avx512;
    type I = __m512i;
    type W = __m512i;
    type X = __m512i;
    const LAYOUT: Layout = Layout::Quads;

    #[inline(always)]
    unsafe fn zero() -> Self::I {
        unsafe { _mm512_setzero_si512() }
    }
    #[inline(always)]
    unsafe fn weights(p: *const f32) -> Self::W {
        unsafe { _mm512_loadu_si512(p.cast()) }
    }
    #[inline(always)]
    unsafe fn bytes(p: *const f32) -> Self::X {
        unsafe { _mm512_set1_epi32(p.cast::<i32>().read()) }
    }
    #[inline(always)]
    unsafe fn dot(sum: Self::I, x: Self::X, w: Self::W) -> Self::I {
        unsafe { _mm512_dpbusd_epi32(sum, x, w) }
    }
    #[inline(always)]
    unsafe fn floats(sum: Self::I) -> __m512 {
        unsafe { _mm512_cvtepi32_ps(sum) }
    }
    #[inline(always)]
    unsafe fn all(n: i32) -> Self::I {
        unsafe { _mm512_set1_epi32(n) }
    }
    #[inline(always)]
    unsafe fn load(p: *const i32) -> Self::I {
        unsafe { _mm512_loadu_si512(p.cast()) }
    }
    #[inline(always)]
    unsafe fn store(p: *mut i32, sum: Self::I) {
        unsafe { _mm512_storeu_si512(p.cast(), sum) }
    }
    #[inline(always)]
    unsafe fn larger(a: Self::I, b: Self::I) -> Self::I {
        unsafe { _mm512_max_epi32(a, b) }
    }
    #[inline(always)]
    unsafe fn top(sum: Self::I) -> i32 {
        unsafe { _mm512_reduce_max_epi32(sum) }
    }
    #[inline(always)]
    unsafe fn narrow(v: __m512, to: *mut u8) {
        unsafe { _mm_storeu_si128(to.cast(), _mm512_cvtepi32_epi8(_mm512_cvtps_epi32(v))) }
    }
}

/// Largest of eight sums; needs `avx2`.
#[inline(always)]
unsafe fn top256(v: __m256i) -> i32 {
    // SAFETY: the caller promises AVX2.
    unsafe {
        let four = _mm_max_epi32(_mm256_castsi256_si128(v), _mm256_extracti128_si256::<1>(v));
        let two = _mm_max_epi32(four, _mm_shuffle_epi32::<0b01_00_11_10>(four));
        _mm_cvtsi128_si32(_mm_max_epi32(two, _mm_shuffle_epi32::<0b10_11_00_01>(two)))
    }
}

/// Writes eight numbers as bytes; needs `avx2`.
#[inline(always)]
unsafe fn narrow256(v: __m256, to: *mut u8) {
    // SAFETY: the caller promises AVX2 and room for eight bytes.
    unsafe {
        let wide = _mm256_cvtps_epi32(v);
        let (low, high) = (_mm256_castsi256_si128(wide), _mm256_extracti128_si256::<1>(wide));
        let words = _mm_packs_epi32(low, high);
        _mm_storel_epi64(to.cast(), _mm_packus_epi16(words, words));
    }
}

/// Eight sums; needs `avx2`, `fma` and `avxvnni`.
pub struct Vnni256;

// SAFETY of all blocks below: as above.
#[expect(clippy::undocumented_unsafe_blocks, reason = "one contract for all, stated above")]
impl Dot for Vnni256 {
    type F = Avx2;
    type I = __m256i;
    type W = __m256i;
    type X = __m256i;
    const LAYOUT: Layout = Layout::Quads;

    #[inline(always)]
    unsafe fn zero() -> Self::I {
        unsafe { _mm256_setzero_si256() }
    }
    #[inline(always)]
    unsafe fn weights(p: *const f32) -> Self::W {
        unsafe { _mm256_loadu_si256(p.cast()) }
    }
    #[inline(always)]
    unsafe fn bytes(p: *const f32) -> Self::X {
        unsafe { _mm256_set1_epi32(p.cast::<i32>().read()) }
    }
    #[inline(always)]
    unsafe fn dot(sum: Self::I, x: Self::X, w: Self::W) -> Self::I {
        unsafe { _mm256_dpbusd_avx_epi32(sum, x, w) }
    }
    #[inline(always)]
    unsafe fn floats(sum: Self::I) -> __m256 {
        unsafe { _mm256_cvtepi32_ps(sum) }
    }
    #[inline(always)]
    unsafe fn all(n: i32) -> Self::I {
        unsafe { _mm256_set1_epi32(n) }
    }
    #[inline(always)]
    unsafe fn load(p: *const i32) -> Self::I {
        unsafe { _mm256_loadu_si256(p.cast()) }
    }
    #[inline(always)]
    unsafe fn store(p: *mut i32, sum: Self::I) {
        unsafe { _mm256_storeu_si256(p.cast(), sum) }
    }
    #[inline(always)]
    unsafe fn larger(a: Self::I, b: Self::I) -> Self::I {
        unsafe { _mm256_max_epi32(a, b) }
    }
    #[inline(always)]
    unsafe fn top(sum: Self::I) -> i32 {
        unsafe { top256(sum) }
    }
    #[inline(always)]
    unsafe fn narrow(v: __m256, to: *mut u8) {
        unsafe { narrow256(v, to) }
    }
}

/// Eight sums; needs `avx2` and `fma`. Bytes are widened to 16 bits first: the instruction that
/// multiplies bytes directly saturates.
pub struct Wide256;

// SAFETY of all blocks below: as above.
#[expect(clippy::undocumented_unsafe_blocks, reason = "one contract for all, stated above")]
impl Dot for Wide256 {
    type F = Avx2;
    type I = __m256i;
    type W = [__m256i; 2];
    type X = [__m256i; 2];
    const LAYOUT: Layout = Layout::Pairs;

    #[inline(always)]
    unsafe fn zero() -> Self::I {
        unsafe { _mm256_setzero_si256() }
    }
    #[inline(always)]
    unsafe fn weights(p: *const f32) -> Self::W {
        unsafe {
            let half = |i: usize| _mm256_cvtepi8_epi16(_mm_loadu_si128(p.add(i * 4).cast()));
            [half(0), half(1)]
        }
    }
    #[inline(always)]
    unsafe fn bytes(p: *const f32) -> Self::X {
        unsafe {
            let four = _mm256_set1_epi32(p.cast::<i32>().read());
            // Byte `i` and the one behind it, each with a zero above, in every lane.
            let pair = |i: i32| {
                let mask = _mm256_set1_epi32(i | 0x8000 | (i + 1) << 16 | i32::MIN);
                _mm256_shuffle_epi8(four, mask)
            };
            [pair(0), pair(2)]
        }
    }
    #[inline(always)]
    unsafe fn dot(sum: Self::I, x: Self::X, w: Self::W) -> Self::I {
        unsafe {
            let sum = _mm256_add_epi32(sum, _mm256_madd_epi16(x[0], w[0]));
            _mm256_add_epi32(sum, _mm256_madd_epi16(x[1], w[1]))
        }
    }
    #[inline(always)]
    unsafe fn floats(sum: Self::I) -> __m256 {
        unsafe { _mm256_cvtepi32_ps(sum) }
    }
    #[inline(always)]
    unsafe fn all(n: i32) -> Self::I {
        unsafe { _mm256_set1_epi32(n) }
    }
    #[inline(always)]
    unsafe fn load(p: *const i32) -> Self::I {
        unsafe { _mm256_loadu_si256(p.cast()) }
    }
    #[inline(always)]
    unsafe fn store(p: *mut i32, sum: Self::I) {
        unsafe { _mm256_storeu_si256(p.cast(), sum) }
    }
    #[inline(always)]
    unsafe fn larger(a: Self::I, b: Self::I) -> Self::I {
        unsafe { _mm256_max_epi32(a, b) }
    }
    #[inline(always)]
    unsafe fn top(sum: Self::I) -> i32 {
        unsafe { top256(sum) }
    }
    #[inline(always)]
    unsafe fn narrow(v: __m256, to: *mut u8) {
        unsafe { narrow256(v, to) }
    }
}
