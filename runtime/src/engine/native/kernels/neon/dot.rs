//! 8-bit products: the dot product of ARMv8.2, and plain NEON.

use super::Neon;
use crate::engine::native::kernels::eight::{Dot, Layout};
use core::arch::aarch64::*;

/// Writes four numbers as bytes.
#[inline(always)]
unsafe fn narrow(v: float32x4_t, to: *mut u8) {
    // SAFETY: the caller promises room for four bytes.
    unsafe {
        let words = vqmovn_u32(vcvtnq_u32_f32(v));
        let bytes = vqmovn_u16(vcombine_u16(words, words));
        let four = vget_lane_u32::<0>(vreinterpret_u32_u8(bytes));
        to.cast::<u32>().write_unaligned(four);
    }
}

/// Needs `dotprod`. Its instruction takes signed bytes, so 128 is taken off every activation.
pub struct DotProd;

// SAFETY of all blocks below: the trait's contract, the caller promises the instruction set and
// valid pointers.
#[expect(clippy::undocumented_unsafe_blocks, reason = "one contract for all, stated above")]
impl Dot for DotProd {
    type F = Neon;
    type I = int32x4_t;
    type W = int8x16_t;
    type X = int8x16_t;
    const LAYOUT: Layout = Layout::Quads;
    const SHIFT: i32 = 128;

    #[inline(always)]
    unsafe fn zero() -> Self::I {
        unsafe { vdupq_n_s32(0) }
    }
    #[inline(always)]
    unsafe fn weights(p: *const f32) -> Self::W {
        unsafe { vld1q_s8(p.cast()) }
    }
    #[inline(always)]
    unsafe fn bytes(p: *const f32) -> Self::X {
        unsafe {
            let four = vreinterpretq_s8_u32(vdupq_n_u32(p.cast::<u32>().read()));
            veorq_s8(four, vdupq_n_s8(i8::MIN))
        }
    }
    #[inline(always)]
    unsafe fn dot(mut sum: Self::I, x: Self::X, w: Self::W) -> Self::I {
        // The function for this instruction is not stable yet.
        unsafe {
            core::arch::asm!(
                "sdot {sum:v}.4s, {x:v}.16b, {w:v}.16b",
                sum = inout(vreg) sum, x = in(vreg) x, w = in(vreg) w,
                options(pure, nomem, nostack, preserves_flags),
            );
        }
        sum
    }
    #[inline(always)]
    unsafe fn floats(sum: Self::I) -> float32x4_t {
        unsafe { vcvtq_f32_s32(sum) }
    }
    #[inline(always)]
    unsafe fn all(n: i32) -> Self::I {
        unsafe { vdupq_n_s32(n) }
    }
    #[inline(always)]
    unsafe fn load(p: *const i32) -> Self::I {
        unsafe { vld1q_s32(p) }
    }
    #[inline(always)]
    unsafe fn store(p: *mut i32, sum: Self::I) {
        unsafe { vst1q_s32(p, sum) }
    }
    #[inline(always)]
    unsafe fn larger(a: Self::I, b: Self::I) -> Self::I {
        unsafe { vmaxq_s32(a, b) }
    }
    #[inline(always)]
    unsafe fn top(sum: Self::I) -> i32 {
        unsafe { vmaxvq_s32(sum) }
    }
    #[inline(always)]
    unsafe fn narrow(v: float32x4_t, to: *mut u8) {
        unsafe { narrow(v, to) }
    }
}

/// Every aarch64 processor: bytes are widened to 16 bits.
pub struct Wide;

// SAFETY of all blocks below: as above.
#[expect(clippy::undocumented_unsafe_blocks, reason = "one contract for all, stated above")]
impl Dot for Wide {
    type F = Neon;
    type I = int32x4_t;
    type W = [int16x8_t; 2];
    type X = int16x4_t;
    const LAYOUT: Layout = Layout::Rows;

    #[inline(always)]
    unsafe fn zero() -> Self::I {
        unsafe { vdupq_n_s32(0) }
    }
    #[inline(always)]
    unsafe fn weights(p: *const f32) -> Self::W {
        unsafe {
            let all = vld1q_s8(p.cast());
            [vmovl_s8(vget_low_s8(all)), vmovl_s8(vget_high_s8(all))]
        }
    }
    #[inline(always)]
    unsafe fn bytes(p: *const f32) -> Self::X {
        unsafe {
            let four = vreinterpret_u8_u32(vdup_n_u32(p.cast::<u32>().read()));
            vreinterpret_s16_u16(vget_low_u16(vmovl_u8(four)))
        }
    }
    #[inline(always)]
    unsafe fn dot(sum: Self::I, x: Self::X, w: Self::W) -> Self::I {
        unsafe {
            let sum = vmlal_lane_s16::<0>(sum, vget_low_s16(w[0]), x);
            let sum = vmlal_lane_s16::<1>(sum, vget_high_s16(w[0]), x);
            let sum = vmlal_lane_s16::<2>(sum, vget_low_s16(w[1]), x);
            vmlal_lane_s16::<3>(sum, vget_high_s16(w[1]), x)
        }
    }
    #[inline(always)]
    unsafe fn floats(sum: Self::I) -> float32x4_t {
        unsafe { vcvtq_f32_s32(sum) }
    }
    #[inline(always)]
    unsafe fn all(n: i32) -> Self::I {
        unsafe { vdupq_n_s32(n) }
    }
    #[inline(always)]
    unsafe fn load(p: *const i32) -> Self::I {
        unsafe { vld1q_s32(p) }
    }
    #[inline(always)]
    unsafe fn store(p: *mut i32, sum: Self::I) {
        unsafe { vst1q_s32(p, sum) }
    }
    #[inline(always)]
    unsafe fn larger(a: Self::I, b: Self::I) -> Self::I {
        unsafe { vmaxq_s32(a, b) }
    }
    #[inline(always)]
    unsafe fn top(sum: Self::I) -> i32 {
        unsafe { vmaxvq_s32(sum) }
    }
    #[inline(always)]
    unsafe fn narrow(v: float32x4_t, to: *mut u8) {
        unsafe { narrow(v, to) }
    }
}
