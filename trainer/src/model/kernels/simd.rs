//! The two inner loops of the depthwise convolution: eight floats at a time where the processor has
//! AVX2 and FMA, and a scalar twin for every other one (and for the tests).
//!
//! Sums are formed in a fixed order, so results depend on the processor's kind, never on threads.

#![allow(unsafe_code)]

/// Floats per vector; lengths of runs are multiples of it.
pub(super) const LANES: usize = 8;

/// One tap of a kernel: where its run begins, and its weight.
pub(super) type Tap = (usize, f32);

#[cfg(target_arch = "x86_64")]
fn has_fma() -> bool {
    is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma")
}

/// `out[i] = start + sum over taps of weight * source[from + i]`.
///
/// # Panics
/// When a run reaches past the source.
pub(super) fn weighted_runs(out: &mut [f32], source: &[f32], taps: &[Tap], start: f32) {
    assert!(
        taps.iter().all(|(from, _)| from + out.len() <= source.len()),
        "runs inside the source"
    );
    #[cfg(target_arch = "x86_64")]
    if has_fma() {
        // SAFETY: the processor has AVX2 and FMA; every run is inside the source, checked above.
        unsafe { avx2::weighted_runs(out, source, taps, start) };
        return;
    }
    scalar::weighted_runs(out, source, taps, start);
}

/// `sums[t] += dot(run, source[from[t]..])` for every tap.
///
/// # Panics
/// When a run reaches past the source, or the run's length is no multiple of [`LANES`].
pub(super) fn correlations<const T: usize>(
    sums: &mut [f32; T],
    run: &[f32],
    source: &[f32],
    from: [usize; T],
) {
    assert!(from.iter().all(|from| from + run.len() <= source.len()), "runs inside the source");
    assert!(run.len().is_multiple_of(LANES), "whole vectors");
    #[cfg(target_arch = "x86_64")]
    if has_fma() {
        // SAFETY: as in `weighted_runs`.
        unsafe { avx2::correlations(sums, run, source, from) };
        return;
    }
    scalar::correlations(sums, run, source, from);
}

mod scalar {
    use super::{LANES, Tap};

    pub fn weighted_runs(out: &mut [f32], source: &[f32], taps: &[Tap], start: f32) {
        out.fill(start);
        for (from, weight) in taps {
            for (out, v) in out.iter_mut().zip(&source[*from..]) {
                *out += weight * v;
            }
        }
    }

    pub fn correlations<const T: usize>(
        sums: &mut [f32; T],
        run: &[f32],
        source: &[f32],
        from: [usize; T],
    ) {
        for (sum, from) in sums.iter_mut().zip(from) {
            let mut lanes = [0.0f32; LANES];
            let pairs = run.chunks_exact(LANES).zip(source[from..].chunks_exact(LANES));
            for (run, source) in pairs {
                for ((lane, a), b) in lanes.iter_mut().zip(run).zip(source) {
                    *lane += a * b;
                }
            }
            *sum += lanes.iter().sum::<f32>();
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{LANES, Tap};
    use core::arch::x86_64::*;

    /// Vectors of output kept in registers while the taps go by.
    const BLOCK: usize = 8;

    /// # Safety
    /// AVX2 and FMA; `from + out.len() <= source.len()` for every tap.
    #[target_feature(enable = "avx2,fma")]
    pub unsafe fn weighted_runs(out: &mut [f32], source: &[f32], taps: &[Tap], start: f32) {
        let mut at = 0;
        let mut blocks = out.chunks_exact_mut(BLOCK * LANES);
        for block in &mut blocks {
            let mut sums = [_mm256_set1_ps(start); BLOCK];
            for &(from, weight) in taps {
                let weight = _mm256_set1_ps(weight);
                for (i, sum) in sums.iter_mut().enumerate() {
                    // SAFETY: below `from + out.len()`, the caller's promise.
                    let v = unsafe { _mm256_loadu_ps(source.as_ptr().add(from + at + i * LANES)) };
                    *sum = _mm256_fmadd_ps(weight, v, *sum);
                }
            }
            for (out, sum) in block.chunks_exact_mut(LANES).zip(sums) {
                // SAFETY: `out` is LANES long.
                unsafe { _mm256_storeu_ps(out.as_mut_ptr(), sum) };
            }
            at += BLOCK * LANES;
        }
        let mut vectors = blocks.into_remainder().chunks_exact_mut(LANES);
        for out in &mut vectors {
            let mut sum = _mm256_set1_ps(start);
            for &(from, weight) in taps {
                // SAFETY: below `from + out.len()`, the caller's promise.
                let v = unsafe { _mm256_loadu_ps(source.as_ptr().add(from + at)) };
                sum = _mm256_fmadd_ps(_mm256_set1_ps(weight), v, sum);
            }
            // SAFETY: `out` is LANES long.
            unsafe { _mm256_storeu_ps(out.as_mut_ptr(), sum) };
            at += LANES;
        }
        for (i, out) in vectors.into_remainder().iter_mut().enumerate() {
            let taps = taps.iter();
            *out =
                taps.fold(start, |sum, (from, weight)| weight.mul_add(source[from + at + i], sum));
        }
    }

    /// # Safety
    /// AVX2 and FMA; `from + run.len() <= source.len()` for every tap; whole vectors.
    #[target_feature(enable = "avx2,fma")]
    pub unsafe fn correlations<const T: usize>(
        sums: &mut [f32; T],
        run: &[f32],
        source: &[f32],
        from: [usize; T],
    ) {
        let mut lanes = [_mm256_setzero_ps(); T];
        for (i, run) in run.chunks_exact(LANES).enumerate() {
            // SAFETY: `run` is LANES long.
            let g = unsafe { _mm256_loadu_ps(run.as_ptr()) };
            for (lane, from) in lanes.iter_mut().zip(from) {
                // SAFETY: below `from + run.len()`, the caller's promise.
                let v = unsafe { _mm256_loadu_ps(source.as_ptr().add(from + i * LANES)) };
                *lane = _mm256_fmadd_ps(g, v, *lane);
            }
        }
        for (sum, lane) in sums.iter_mut().zip(lanes) {
            let mut values = [0.0f32; LANES];
            // SAFETY: LANES floats.
            unsafe { _mm256_storeu_ps(values.as_mut_ptr(), lane) };
            *sum += values.iter().sum::<f32>();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(n: usize, seed: u32) -> Vec<f32> {
        (0..n as u32)
            .map(|i| {
                ((i.wrapping_mul(2_654_435_761).wrapping_add(seed) >> 16) as f32 / 32768.0) - 1.0
            })
            .collect()
    }

    #[test]
    fn vectors_equal_the_scalar_twin() {
        let source = values(400, 1);
        for length in [1, 7, 8, 24, 63, 64, 65, 120, 200] {
            let taps: Vec<Tap> =
                values(9, 5).into_iter().enumerate().map(|(i, w)| (3 * i + 1, w)).collect();
            let (mut fast, mut plain) = (vec![9.0; length], vec![7.0; length]);
            weighted_runs(&mut fast, &source, &taps, 0.5);
            scalar::weighted_runs(&mut plain, &source, &taps, 0.5);
            for (a, b) in fast.iter().zip(&plain) {
                assert!((a - b).abs() < 1e-5, "length {length}: {a} {b}");
            }
        }
        for length in [8, 64, 120] {
            let run = values(length, 3);
            let (mut fast, mut plain) = ([1.0f32; 5], [1.0f32; 5]);
            let from = [0, 1, 7, 90, 280];
            correlations(&mut fast, &run, &source, from);
            scalar::correlations(&mut plain, &run, &source, from);
            for (a, b) in fast.iter().zip(&plain) {
                assert!((a - b).abs() < 1e-4, "length {length}: {a} {b}");
            }
        }
    }

    #[test]
    #[should_panic(expected = "runs inside the source")]
    fn runs_past_the_end_are_refused() {
        weighted_runs(&mut [0.0; 8], &[0.0; 9], &[(2, 1.0)], 0.0);
    }
}
