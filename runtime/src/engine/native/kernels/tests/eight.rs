//! Products of bytes: exact against loops in integers, with every instruction set.

use super::super::eight::BYTES;
use super::*;

/// Tables for bytes that [`Isa::kernels`] did not choose are tested too.
fn all_tables() -> Vec<(String, &'static Kernels)> {
    let chosen = tables().into_iter().map(|(isa, k)| (format!("{isa:?}"), k));
    chosen.chain(super::super::table::passed_over()).collect()
}

/// A byte that is the same on every run; extremes are frequent.
fn byte(i: usize, seed: usize) -> u8 {
    match (i * 31 + seed * 17) % 7 {
        0 => 255,
        1 => 0,
        _ => ((i * 7919 + seed * 104_729) % 251) as u8,
    }
}

/// Bytes in the places of floats, every pixel in `groups` of them.
fn packed(pixels: usize, channels: usize, pixel: usize, seed: usize) -> Vec<f32> {
    let mut floats = Vec::new();
    for p in 0..pixels {
        for group in 0..pixel {
            let four: [u8; BYTES] = std::array::from_fn(|k| {
                let c = group * BYTES + k;
                // What lies behind the channels must not matter.
                if c < channels { byte(p * channels + c, seed) } else { 0xa5 }
            });
            floats.push(f32::from_bits(u32::from_ne_bytes(four)));
        }
    }
    floats
}

proptest! {
    #![proptest_config(ProptestConfig { cases: CASES, ..ProptestConfig::default() })]

    #[test]
    fn products_of_bytes(
        (h, w, c, n) in
            (1usize..6, 1usize..miri(4, 9), 1usize..miri(7, 23), 1usize..miri(19, 71)),
        (kernel, stride) in (prop::sample::select(vec![1usize, 3]), 1usize..3),
        (gap, with, swish, threads) in (0usize..3, 0usize..4, any::<bool>(), 1usize..4),
    ) {
        let pad = kernel / 2;
        let (ih, iw) = (h + 2 * pad, w + 2 * pad);
        let (oh, ow) = ((ih - kernel) / stride + 1, (iw - kernel) / stride + 1);
        let groups = Eight::floats(c);
        let (pixel, line) = (groups + gap, iw * (groups + gap));
        let input = packed(ih * iw, c, pixel, 1);
        let residual = numbers(oh * ow * n, 2);
        let output = input.len() + residual.len() + 5;
        let area = kernel * kernel;
        let weight = |tap: usize, channel: usize, column: usize| {
            byte((tap * c + channel) * n + column, 3).cast_signed()
        };
        let scales: Vec<f32> = (0..n).map(|j| 1e-4 * (1 + j % 5) as f32).collect();
        let bias = numbers(n, 4);
        let zero = 77;
        let clamp = if with == 3 { (0.0, 6.0) } else { (f32::NEG_INFINITY, f32::INFINITY) };
        for (name, k) in all_tables() {
            let eight = &k.eight;
            let columns = eight.packing.columns(n);
            let depth = groups * BYTES;
            let mut weights = vec![0.0; 5];
            let at = |row: usize, column: usize| {
                if row % depth < c { weight(row / depth, row % depth, column) } else { 0 }
            };
            eight.pack(area * groups, n, at, &mut weights);
            prop_assert_eq!(weights.len(), 5 + eight.packing.len(area * groups, n));
            let scales_at = weights.len();
            weights.extend(&scales);
            weights.resize(scales_at + columns, 0.0);
            let bias_at = weights.len();
            weights.extend((0..n).map(|j| {
                let all = (0..area).flat_map(|t| (0..c).map(move |i| (t, i)));
                let sum: i32 = all.map(|(t, i)| i32::from(weight(t, i, j))).sum();
                bias[j] - (zero - eight.shift) as f32 * scales[j] * sum as f32
            }));
            weights.resize(bias_at + columns, 0.0);
            let residual_at = (Place::Arena(input.len()), Pitch { y: ow * n, x: n });
            let step = Step::Gemm(Gemm {
                size: [oh, ow],
                input: Place::Arena(0),
                input_pitch: Pitch { y: stride * line, x: stride * pixel },
                taps: (0..area).map(|t| t / kernel * line + t % kernel * pixel).collect(),
                run: groups,
                weights: Place::Weights(5),
                bias: Some(bias_at),
                columns: n,
                output,
                output_pitch: Pitch { y: ow * n, x: n },
                residual: (with & 2 == 2).then_some(residual_at),
                swish,
                clamp,
                halo: None,
                block: 1 + gap * 8,
                scales: Some(scales_at),
            });
            let mut start = input.clone();
            start.extend(&residual);
            let end = output + oh * ow * n;
            let found = run(&step, k, threads, &start, end + 3, &weights);
            for i in 0..oh * ow * n {
                let (y, x, j) = (i / n / ow, i / n % ow, i % n);
                let mut sum = 0;
                for (t, channel) in (0..area).flat_map(|t| (0..c).map(move |i| (t, i))) {
                    let p = (y * stride + t / kernel) * iw + x * stride + t % kernel;
                    let a = i32::from(byte(p * c + channel, 1)) - zero;
                    sum += a * i32::from(weight(t, channel, j));
                }
                let add = if with & 2 == 2 { residual[i] } else { 0.0 };
                let sum = sum as f32 * scales[j] + bias[j] + add;
                let gate = if swish { (sum / 6.0 + 0.5).clamp(0.0, 1.0) } else { 1.0 };
                let want = (sum * gate).clamp(clamp.0, clamp.1);
                let v = found[output + i];
                // Hard-swish is at most 1.5 times as steep as its operand.
                let room = 1.5e-6 * scales[j] * (area * c) as f32 * 65_000.0;
                prop_assert!((v - want).abs() <= room + 1e-5, "{name}: {v}, not {want} at {i}");
            }
            prop_assert_eq!(&found[end..], &[UNTOUCHED; 3][..]);
            prop_assert_eq!(found[output - 1], UNTOUCHED);
        }
    }

    #[test]
    fn floats_to_bytes(
        (h, w, c, halo) in (1usize..5, 1usize..6, 1usize..40, 0usize..2),
        (zero, threads) in (0u8..=255, 1usize..4),
    ) {
        let input: Vec<f32> = numbers(h * w * c, 1).iter().map(|x| x * 20.0).collect();
        let pixel = Eight::floats(c);
        let line = (w + 2 * halo) * pixel;
        let start = input.len();
        let border = Halo { start, size: [h, w], width: halo, line, pixel };
        let arena = start + border.len();
        for (name, k) in all_tables() {
            let step = Step::Quantise(Quantise {
                size: [h, w],
                channels: c,
                input: Place::Arena(0),
                input_pitch: Pitch { y: w * c, x: c },
                output: start + halo * (line + pixel),
                output_pitch: Pitch { y: line, x: pixel },
                factor: 4.0,
                zero,
                halo: (halo > 0).then_some(border),
            });
            let found = run(&step, k, threads, &input, arena, &[0.0]);
            for (i, v) in found[start..].iter().enumerate() {
                let (y, x, group) = (i / line, i % line / pixel, i % pixel);
                let inside = (halo..h + halo).contains(&y) && (halo..w + halo).contains(&x);
                for (k, b) in v.to_bits().to_ne_bytes().into_iter().enumerate() {
                    let channel = group * BYTES + k;
                    if inside && channel >= c {
                        continue;
                    }
                    let want = if inside {
                        let x = input[((y - halo) * w + x - halo) * c + channel];
                        ((x * 4.0).round_ties_even() + f32::from(zero)).clamp(0.0, 255.0) as u8
                    } else {
                        zero
                    };
                    prop_assert_eq!(b, want, "{} at {}, byte {}", name, i, k);
                }
            }
        }
    }

    /// Attention in bytes against attention in numbers of twice the length. Rounding is what differs,
    /// so the tolerance is that of steps; `flat` makes all weights nearly equal.
    #[test]
    fn attention_of_bytes(
        (queries, keys) in (1usize..QUERIES, 1usize..miri(20, 70)),
        (heads, key, value) in (1usize..miri(3, 4), 1usize..miri(12, 40), 1usize..miri(12, 40)),
        (gap, threads, flat) in (0usize..5, 1usize..4, any::<bool>()),
    ) {
        let (row, out_row) = (heads * key.max(value) + gap, heads * value + gap);
        let (most, far) = (queries.max(keys), keys.max(queries) * row);
        let mut input = numbers(3 * most * row, 5);
        // Keys and values far from zero: their mean must not cost precision.
        input[far..].iter_mut().for_each(|x| *x += 6.0);
        let (output, size) = (input.len() + 3, [keys, key, value]);
        let scale = if flat { 1e-3 } else { 0.4 / (key as f32).sqrt() };
        for (name, k) in all_tables() {
            let panels = output + queries * out_row + 2;
            let scratch = panels + heads * PackKvBytes::len(size, &k.eight);
            let arena = scratch + threads * PackKvBytes::scratch_len(size, &k.eight);
            let steps = vec![
                Step::PackKvBytes(PackKvBytes {
                    heads: (0..heads).map(|h| [h * key, h * value]).collect(),
                    keys: Place::Arena(far),
                    key_row: row,
                    values: Place::Arena(2 * far),
                    value_row: row,
                    size,
                    output: panels,
                }),
                Step::AttentionBytes(Attention {
                    heads: (0..heads).map(|h| [h * key, h * value]).collect(),
                    queries,
                    size,
                    input: Place::Arena(0),
                    input_row: row,
                    panels,
                    output,
                    output_row: out_row,
                    scale,
                    scratch,
                }),
            ];
            let found = run_all(steps, k, threads, &input, arena);
            let dot = |h: usize, i: usize, j: usize| -> f64 {
                let at = |x: usize, d: usize| f64::from(input[x + h * key + d]);
                (0..key).map(|d| at(i * row, d) * at(far + j * row, d)).sum()
            };
            for (h, i) in (0..heads).flat_map(|h| (0..queries).map(move |i| (h, i))) {
                let logits: Vec<f64> =
                    (0..keys).map(|j| dot(h, i, j) * f64::from(scale)).collect();
                let top = logits.iter().copied().fold(f64::MIN, f64::max);
                let weights: Vec<f64> = logits.iter().map(|x| (x - top).exp()).collect();
                let sum: f64 = weights.iter().sum();
                for e in 0..value {
                    let v = |j: usize| f64::from(input[2 * far + j * row + h * value + e]);
                    let want: f64 = (0..keys).map(|j| weights[j] / sum * v(j)).sum();
                    let got = f64::from(found[output + i * out_row + h * value + e]);
                    let room = if flat { 0.02 } else { 0.09 };
                    prop_assert!(
                        (got - want).abs() <= room,
                        "{name}: {got}, not {want}: query {i}, head {h}, element {e}"
                    );
                }
            }
            for i in 0..queries {
                let rest = &found[output + i * out_row + heads * value..output + (i + 1) * out_row];
                prop_assert!(rest.iter().all(|&v| v == UNTOUCHED), "{name}: behind row {i}");
            }
            prop_assert_eq!(&found[panels - 2..panels], &[UNTOUCHED; 2][..]);
            prop_assert_eq!(&found[input.len()..output], &[UNTOUCHED; 3][..]);
        }
    }
}

/// Every instruction set must come to the same bytes but where a number lies between two steps.
#[test]
fn instruction_sets_round_attention_alike() {
    let (heads, queries, keys, size) = (2, miri(7, 29), miri(19, 53), miri(8, 24));
    let row = 3 * heads * size;
    let input = numbers(keys * row, 9);
    let mut first: Option<Vec<f32>> = None;
    for (name, k) in all_tables() {
        let sizes = [keys, size, size];
        let panels = input.len() + queries * heads * size;
        let scratch = panels + heads * PackKvBytes::len(sizes, &k.eight);
        let arena = scratch + PackKvBytes::scratch_len(sizes, &k.eight);
        let starts = |first: usize| (0..heads).map(move |h| (first * heads + h) * size);
        let steps = vec![
            Step::PackKvBytes(PackKvBytes {
                heads: starts(1).zip(starts(2)).map(|(k, v)| [k, v]).collect(),
                keys: Place::Arena(0),
                key_row: row,
                values: Place::Arena(0),
                value_row: row,
                size: sizes,
                output: panels,
            }),
            Step::AttentionBytes(Attention {
                heads: (0..heads).map(|h| [h * size; 2]).collect(),
                queries,
                size: sizes,
                input: Place::Arena(0),
                input_row: row,
                panels,
                output: input.len(),
                output_row: heads * size,
                scale: 0.3,
                scratch,
            }),
        ];
        let found = run_all(steps, k, 1, &input, arena);
        let found = found[input.len()..panels].to_vec();
        match &first {
            None => first = Some(found),
            Some(first) => {
                for (i, (a, b)) in first.iter().zip(&found).enumerate() {
                    assert!((a - b).abs() <= 4e-3, "{name}: {b}, not {a} at {i}");
                }
            }
        }
    }
}
