//! 3 x 3 convolutions by transformed windows and weights, against loops written out.

use super::*;

#[test]
fn transformed_kernels_of_known_values() {
    // One number in the middle: every combination of halves along both axes.
    let middle = transform([[0.0; 3], [0.0, 4.0, 0.0], [0.0; 3]]);
    let line = [0.0, 0.5, -0.5, 0.0];
    for (i, v) in middle.into_iter().enumerate() {
        assert_eq!(v, 4.0 * line[i / 4] * line[i % 4], "{i}");
    }
    let ones = transform([[1.0; 3]; 3]);
    let line = [1.0, 1.5, 0.5, 1.0];
    for (i, v) in ones.into_iter().enumerate() {
        assert_eq!(v, line[i / 4] * line[i % 4], "{i}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: CASES, ..ProptestConfig::default() })]

    #[test]
    fn convolutions_by_points(
        (lines, across) in (1usize..miri(3, 5), 1usize..miri(3, 6)),
        (c, n) in (1usize..miri(6, 40), 1usize..miri(19, 50)),
        (gap, with, swish, threads) in (0usize..5, 0usize..4, any::<bool>(), 1usize..4),
        fresh in any::<bool>(),
    ) {
        let (h, w) = (2 * lines, 2 * across);
        let (pixel, line) = (c + gap, (w + 2) * (c + gap) + 1);
        let input = numbers((h + 2) * line + 3, 1);
        let tiles = lines * across;
        let residual = numbers(h * w * n, 2);
        let kernels: Vec<[[f32; 3]; 3]> = (0..c * n)
            .map(|at| {
                let v = numbers(9, at + 3);
                core::array::from_fn(|y| core::array::from_fn(|x| v[3 * y + x]))
            })
            .collect();
        let bias = numbers(n, 4);
        let matrices = |start: usize, columns: usize| {
            let row = columns + gap;
            Matrices { start, row, matrix: tiles * row + gap }
        };
        let residual_at = input.len();
        let before = matrices(residual_at + residual.len(), c);
        let after = matrices(before.start + POINTS * before.matrix + c, n);
        let fresh_at = after.start + POINTS * after.matrix + n;
        // Room for every packing.
        let output = fresh_at + POINTS * c * n.next_multiple_of(16);
        let (out_pixel, out_line) = (n + gap, w * (n + gap) + gap);
        for (isa, k) in tables() {
            let mut weights = vec![0.0; 5];
            for p in 0..POINTS {
                let row = |ch: usize, out: &mut [f32]| {
                    for (j, v) in out.iter_mut().enumerate() {
                        *v = transform(kernels[j * c + ch])[p];
                    }
                };
                k.packing.pack(c, n, row, &mut weights);
            }
            // The same, as the convolution itself would read them.
            let plain_at = weights.len();
            let row = |at: usize, out: &mut [f32]| {
                for (j, v) in out.iter_mut().enumerate() {
                    *v = kernels[j * c + at % c][at / c / 3][at / c % 3];
                }
            };
            k.packing.pack(9 * c, n, row, &mut weights);
            let bias_at = weights.len();
            weights.extend(&bias);
            weights.resize(bias_at + k.packing.columns(n), 0.0);
            let made = if fresh { Place::Arena(fresh_at) } else { Place::Weights(5) };
            let transformed = Step::KernelsToPoints(KernelsToPoints {
                channels: c,
                columns: n,
                weights: plain_at,
                output: fresh_at,
            });
            let mut steps: Vec<_> = fresh.then_some(transformed).into_iter().collect();
            steps.push(Step::ToPoints(ToPoints {
                size: [lines, across],
                channels: c,
                input: Place::Arena(3),
                input_pitch: Pitch { y: line, x: pixel },
                output: before,
            }));
            steps.extend((0..POINTS).map(|p| {
                Step::Gemm(Gemm {
                    size: [1, tiles],
                    input: Place::Arena(before.start + p * before.matrix),
                    input_pitch: Pitch { y: 0, x: before.row },
                    taps: [0].into(),
                    run: c,
                    weights: made.beyond(p * k.packing.len(c, n)),
                    bias: None,
                    columns: n,
                    output: after.start + p * after.matrix,
                    output_pitch: Pitch { y: 0, x: after.row },
                    residual: None,
                    swish: false,
                    clamp: (f32::NEG_INFINITY, f32::INFINITY),
                    halo: None,
                    block: 1 + gap * 8,
                    scales: None,
                })
            }));
            let limits = if with == 3 { (0.0, 6.0) } else { (f32::NEG_INFINITY, f32::INFINITY) };
            let pitch = Pitch { y: w * n, x: n };
            steps.push(Step::FromPoints(FromPoints {
                size: [lines, across],
                columns: n,
                input: after,
                bias: (with & 1 == 1).then_some(bias_at),
                output,
                output_pitch: Pitch { y: out_line, x: out_pixel },
                residual: (with & 2 == 2).then_some((Place::Arena(residual_at), pitch)),
                swish,
                clamp: limits,
            }));
            let start: Vec<f32> = input.iter().chain(&residual).copied().collect();
            let arena = output + h * out_line + 9;
            let steps = [steps.clone(), steps].concat();
            let found = run_steps(steps, k, threads, &start, arena, &weights);
            let name = format!("{isa:?}, {threads} threads, {h} x {w}, {c} to {n}");
            compare(&name, &found, output, |i| {
                let at = i - output;
                let (y, x, column) =
                    (at / out_line, at % out_line / out_pixel, at % out_line % out_pixel);
                if y >= h || x >= w || column >= n {
                    return None;
                }
                let mut sum = 0.0f64;
                for t in 0..9 {
                    for ch in 0..c {
                        let from = 3 + (y + t / 3) * line + (x + t % 3) * pixel + ch;
                        let weight = kernels[column * c + ch][t / 3][t % 3];
                        sum += f64::from(input[from]) * f64::from(weight);
                    }
                }
                if with & 1 == 1 {
                    sum += f64::from(bias[column]);
                }
                if with & 2 == 2 {
                    sum += f64::from(residual[(y * w + x) * n + column]);
                }
                if swish {
                    sum *= (sum / 6.0 + 0.5).clamp(0.0, 1.0);
                }
                Some(sum.clamp(limits.0.into(), limits.1.into()) as f32)
            })?;
        }
    }
}
