//! Every kernel, with every instruction set of this processor and several threads, against loops
//! written out, over odd sizes, strides and alignments.

mod eight;
mod loops;
mod winograd;

use super::*;
use crate::engine::native::graph::{Binary, Reduce, Unary};
use proptest::prelude::*;

/// Everything this processor can run.
fn tables() -> Vec<(Isa, &'static Kernels)> {
    let all = [Isa::Scalar, Isa::Avx2, Isa::Avx512, Isa::Neon];
    all.into_iter().filter_map(|isa| isa.kernels().map(|k| (isa, k))).collect()
}

/// Numbers that are the same on every run.
fn numbers(len: usize, seed: usize) -> Vec<f32> {
    (0..len).map(|i| (((i * 7919 + seed * 104_729) % 2003) as f32 - 1001.0) / 500.0).collect()
}

/// Marks what no kernel may touch.
const UNTOUCHED: f32 = 12345.0;

/// Cases of a property; Miri takes minutes for more.
const CASES: u32 = if cfg!(miri) { 2 } else { 40 };
/// Bound of the number of queries.
const QUERIES: usize = miri(5, 35);

/// A size under Miri, and without it.
const fn miri(with: usize, without: usize) -> usize {
    if cfg!(miri) { with } else { without }
}

/// Runs a step on an arena that starts with `input` and is `UNTOUCHED` behind it.
fn run(
    step: &Step,
    k: &'static Kernels,
    threads: usize,
    input: &[f32],
    arena: usize,
    weights: &[f32],
) -> Vec<f32> {
    // Twice: what a kernel leaves behind must not matter to the next run.
    run_steps(vec![step.clone(), step.clone()], k, threads, input, arena, weights)
}

/// As [`run`], for steps after one another without weights.
fn run_all(
    steps: Vec<Step>,
    k: &'static Kernels,
    threads: usize,
    input: &[f32],
    arena: usize,
) -> Vec<f32> {
    run_steps([steps.clone(), steps].concat(), k, threads, input, arena, &[0.0])
}

fn run_steps(
    steps: Vec<Step>,
    k: &'static Kernels,
    threads: usize,
    input: &[f32],
    arena: usize,
    weights: &[f32],
) -> Vec<f32> {
    let program = Program::new(steps, arena, weights.len(), threads, k).unwrap();
    let mut team = Team::new(arena, weights.to_vec(), vec![program], k, threads, false).unwrap();
    let all = team.view_mut(0..arena);
    all.fill(UNTOUCHED);
    all[..input.len()].copy_from_slice(input);
    team.run(0);
    team.view(0..arena).to_vec()
}

/// The result must be `want(i)` where that is something, and untouched elsewhere.
fn compare(
    what: &str,
    found: &[f32],
    from: usize,
    want: impl Fn(usize) -> Option<f32>,
) -> Result<(), TestCaseError> {
    for (i, &v) in found.iter().enumerate().skip(from) {
        match want(i) {
            Some(w) => {
                let close = (v - w).abs() <= 2e-5 * w.abs().max(1.0);
                prop_assert!(close, "{what}: {v} instead of {w} at {i}");
            }
            None => prop_assert_eq!(v, UNTOUCHED, "{} touched {}", what, i),
        }
    }
    Ok(())
}

fn for_all(
    step: impl Fn(&'static Kernels) -> (Step, Vec<f32>),
    threads: usize,
    mut check: impl FnMut(&str, &Step, &'static Kernels, &[f32], usize) -> Result<(), TestCaseError>,
) -> Result<(), TestCaseError> {
    for (isa, k) in tables() {
        let (step, weights) = step(k);
        let name = format!("{isa:?}, {threads} threads, {step:?}");
        check(&name, &step, k, &weights, threads)?;
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: CASES, ..ProptestConfig::default() })]

    /// A convolution with a border, bias, residual and limits; 1 x 1 is a linear layer.
    #[test]
    fn products(
        (h, w, c, n) in (1usize..miri(4, 8), 1usize..miri(5, 9), 1usize..miri(6, 20), 1usize..miri(19, 71)),
        (kernel, stride, halo) in (prop::sample::select(vec![1usize, 3]), 1usize..3, 0usize..2),
        (gap, with, swish, threads) in (0usize..5, 0usize..4, any::<bool>(), 1usize..4),
    ) {
        let pad = kernel / 2;
        let (oh, ow) = ((h + 2 * pad - kernel) / stride + 1, (w + 2 * pad - kernel) / stride + 1);
        let (pixel, line) = (c + gap, (w + 2 * pad) * (c + gap));
        let input = numbers((h + 2 * pad) * line + 3, 1);
        let (out_pixel, out_line) = (n + gap, (ow + 2 * halo) * (n + gap));
        let start = input.len();
        let output = start + halo * (out_line + out_pixel);
        let border = Halo { start, size: [oh, ow], width: halo, line: out_line, pixel: out_pixel };
        let end = start + (oh + 2 * halo) * out_line;
        let residual_at = end + 7;
        let residual = numbers(oh * ow * n, 2);
        let depth = kernel * kernel * c;
        let matrix = numbers(depth * n, 3);
        let bias = numbers(n, 4);
        let step = |k: &'static Kernels| {
            let mut weights = vec![0.0; 5];
            k.packing.pack(depth, n, |row, out| out.copy_from_slice(&matrix[row * n..][..n]), &mut weights);
            let at = weights.len();
            weights.extend(&bias);
            weights.resize(at + k.packing.columns(n), 0.0);
            let taps = (0..kernel * kernel).map(|t| t / kernel * line + t % kernel * pixel).collect();
            let residual = (Place::Arena(residual_at), Pitch { y: ow * n, x: n });
            let step = Step::Gemm(Gemm {
                size: [oh, ow],
                input: Place::Arena(3),
                input_pitch: Pitch { y: stride * line, x: stride * pixel },
                taps,
                run: c,
                weights: Place::Weights(5),
                bias: (with & 1 == 1).then_some(at),
                columns: n,
                output,
                output_pitch: Pitch { y: out_line, x: out_pixel },
                residual: (with & 2 == 2).then_some(residual),
                swish,
                clamp: if with == 3 { (0.0, 6.0) } else { (f32::NEG_INFINITY, f32::INFINITY) },
                halo: (halo > 0).then_some(border),
                block: 1 + gap * 8,
                scales: None,
            });
            (step, weights)
        };
        for_all(step, threads, |name, step, k, weights, threads| {
            let mut start_values = input.clone();
            start_values.resize(residual_at, UNTOUCHED);
            start_values.extend(&residual);
            let found = run(step, k, threads, &start_values, residual_at + residual.len(), weights);
            compare(name, &found[..residual_at], start, |i| {
                if i >= end {
                    return None;
                }
                let at = i - start;
                let (y, x) = (at / out_line, at % out_line / out_pixel);
                let column = at % out_line % out_pixel;
                let inside = (halo..oh + halo).contains(&y) && (halo..ow + halo).contains(&x);
                if !inside {
                    return Some(0.0);
                }
                if column >= n {
                    return None;
                }
                let (y, x) = (y - halo, x - halo);
                let mut sum = 0.0f64;
                for t in 0..kernel * kernel {
                    for ch in 0..c {
                        let from = 3 + (y * stride + t / kernel) * line
                            + (x * stride + t % kernel) * pixel + ch;
                        sum += f64::from(input[from]) * f64::from(matrix[(t * c + ch) * n + column]);
                    }
                }
                if with & 1 == 1 {
                    sum += f64::from(bias[column]);
                }
                if with & 2 == 2 {
                    sum += f64::from(residual[(y * ow + x) * n + column]);
                }
                if swish {
                    sum *= (sum / 6.0 + 0.5).clamp(0.0, 1.0);
                }
                Some(if with == 3 { sum.clamp(0.0, 6.0) } else { sum } as f32)
            })
        })?;
    }

    #[test]
    fn depthwise_convolutions(
        (h, w, c) in (1usize..miri(4, 7), 1usize..miri(4, 8), 1usize..miri(19, 40)),
        (kernel, stride, bias) in (prop::sample::select(vec![2usize, 3, 5]), 1usize..3, any::<bool>()),
        (swish, threads) in (any::<bool>(), 1usize..4),
    ) {
        let (full_h, full_w) = ((h - 1) * stride + kernel, (w - 1) * stride + kernel);
        let input = numbers(full_h * full_w * c, 1);
        let taps = kernel * kernel;
        let mut weights = numbers(taps * c + 1, 2);
        weights.extend(numbers(c, 3));
        let step = |_: &'static Kernels| {
            let step = Step::Depthwise(Depthwise {
                size: [h, w],
                channels: c,
                input: Place::Arena(0),
                input_pitch: Pitch { y: stride * full_w * c, x: stride * c },
                taps: (0..taps).map(|t| (t / kernel * full_w + t % kernel) * c).collect(),
                weights: 1,
                bias: bias.then_some(1 + taps * c),
                output: input.len(),
                output_pitch: Pitch { y: w * (c + 1), x: c + 1 },
                swish,
                clamp: (-2.0, 6.0),
                halo: None,
            });
            (step, weights.clone())
        };
        for_all(step, threads, |name, step, k, weights, threads| {
            let found = run(step, k, threads, &input, input.len() + h * w * (c + 1), weights);
            compare(name, &found, input.len(), |i| {
                let (pixel, ch) = ((i - input.len()) / (c + 1), (i - input.len()) % (c + 1));
                if ch == c {
                    return None;
                }
                let (y, x) = (pixel / w * stride, pixel % w * stride);
                let products = (0..taps).map(|t| {
                    let at = ((y + t / kernel) * full_w + x + t % kernel) * c + ch;
                    input[at] * weights[1 + t * c + ch]
                });
                let sum = products.sum::<f32>() + if bias { weights[1 + taps * c + ch] } else { 0.0 };
                let gate = if swish { (sum / 6.0 + 0.5).clamp(0.0, 1.0) } else { 1.0 };
                Some((sum * gate).clamp(-2.0, 6.0))
            })
        })?;
    }

    #[test]
    fn pools(
        (h, w, c) in (3usize..miri(5, 9), 3usize..miri(5, 9), 1usize..miri(19, 36)),
        (stride, pad, max, count_pad) in (1usize..3, 0usize..2, any::<bool>(), any::<bool>()),
        threads in 1usize..4,
    ) {
        let size = [(h + 2 * pad - 3) / stride + 1, (w + 2 * pad - 3) / stride + 1];
        let input = numbers(h * w * c, 1);
        let step = |_: &'static Kernels| {
            let step = Step::Pool(Pool {
                from: [h, w],
                size,
                channels: c,
                kernel: [3, 3],
                stride: [stride; 2],
                dilation: [1, 1],
                pad: [pad; 2],
                input: Place::Arena(0),
                input_pitch: Pitch { y: w * c, x: c },
                output: input.len(),
                output_pitch: Pitch { y: size[1] * c, x: c },
                max,
                count_pad,
                halo: None,
            });
            (step, vec![0.0])
        };
        for_all(step, threads, |name, step, k, weights, threads| {
            let found = run(step, k, threads, &input, input.len() + size[0] * size[1] * c, weights);
            compare(name, &found, input.len(), |i| {
                let (pixel, ch) = ((i - input.len()) / c, (i - input.len()) % c);
                let (y, x) = (pixel / size[1] * stride, pixel % size[1] * stride);
                let mut all = Vec::new();
                for at in 0..9 {
                    let (y, x) = ((y + at / 3).checked_sub(pad), (x + at % 3).checked_sub(pad));
                    if let (Some(y), Some(x)) = (y, x) && y < h && x < w {
                        all.push(input[(y * w + x) * c + ch]);
                    }
                }
                let count = if count_pad { 9 } else { all.len() };
                Some(if max {
                    all.into_iter().fold(f32::NEG_INFINITY, f32::max)
                } else {
                    all.iter().sum::<f32>() / count as f32
                })
            })
        })?;
    }

    #[test]
    fn normalisations(
        (h, w, c, gap) in (1usize..miri(3, 5), 1usize..miri(4, 6), 1usize..miri(35, 75), 0usize..4),
        (map, centre, threads) in (any::<bool>(), any::<bool>(), 1usize..4),
    ) {
        let pitch = Pitch { y: w * (c + gap) + 1, x: c + gap };
        let input = numbers(h * pitch.y, 1);
        let weights = [numbers(c, 2), numbers(c, 3)].concat();
        let (place, output) = (Place::Arena(0), input.len());
        let step = |_: &'static Kernels| {
            let step = if map {
                Step::MapNorm(MapNorm {
                    size: [h, w],
                    channels: c,
                    input: place,
                    input_pitch: pitch,
                    output,
                    output_pitch: pitch,
                    gain: Some(0),
                    offset: Some(c),
                    centre,
                    factor: 0.75,
                    epsilon: 1e-3,
                    clamp: (-1.5, 1.5),
                    halo: None,
                })
            } else {
                Step::LayerNorm(LayerNorm {
                    size: [h, w],
                    columns: c,
                    input: place,
                    input_pitch: pitch,
                    output,
                    output_pitch: pitch,
                    gain: 0,
                    offset: centre.then_some(c),
                    epsilon: 1e-3,
                })
            };
            (step, weights.clone())
        };
        let value = |y: usize, x: usize, ch: usize| f64::from(input[y * pitch.y + x * pitch.x + ch]);
        let moments = |values: &[f64], centre: bool| {
            let mean = if centre { values.iter().sum::<f64>() / values.len() as f64 } else { 0.0 };
            let squares: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
            (mean, if centre { squares / values.len() as f64 } else { squares })
        };
        for_all(step, threads, |name, step, k, weights, threads| {
            let found = run(step, k, threads, &input, 2 * input.len(), weights);
            compare(name, &found, input.len(), |i| {
                let at = i - input.len();
                let (y, x, ch) = (at / pitch.y, at % pitch.y / pitch.x, at % pitch.y % pitch.x);
                if x >= w || ch >= c {
                    return None;
                }
                let row = |y, x| (0..c).map(move |ch| value(y, x, ch));
                let (gain, offset) = (f64::from(weights[ch]), f64::from(weights[c + ch]));
                Some(if map {
                    let all: Vec<f64> = (0..h * w).flat_map(|i| row(i / w, i % w)).collect();
                    let (mean, spread) = moments(&all, centre);
                    let v = (value(y, x, ch) - mean) * 0.75 / (spread + 1e-3).sqrt();
                    (v * gain + offset).clamp(-1.5, 1.5)
                } else {
                    let (mean, spread) = moments(&row(y, x).collect::<Vec<_>>(), true);
                    let v = (value(y, x, ch) - mean) / (spread + 1e-3).sqrt();
                    v * gain + if centre { offset } else { 0.0 }
                } as f32)
            })
        })?;
    }

    /// Packed and thin attention give the same, with heads side by side.
    #[test]
    fn attention_of_any_size(
        (heads, queries, keys) in (1usize..4, 1usize..QUERIES, 1usize..2 * QUERIES),
        (key, value, threads) in (1usize..miri(12, 37), 1usize..miri(12, 37), 1usize..4),
    ) {
        let (qs, ks, vs) = (queries * heads * key, keys * heads * key, keys * heads * value);
        let input = numbers(qs + ks + vs, 1);
        let (q, kv, v) = (&input[..qs], &input[qs..qs + ks], &input[qs + ks..]);
        let want = |head: usize, query: usize, e: usize| {
            let logits: Vec<f64> = (0..keys).map(|j| {
                (0..key).map(|d| {
                    f64::from(q[(query * heads + head) * key + d]) * f64::from(kv[(j * heads + head) * key + d])
                }).sum::<f64>() * 0.3
            }).collect();
            let max = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let weights: Vec<f64> = logits.iter().map(|l| (l - max).exp()).collect();
            let sum: f64 = weights.iter().sum();
            (weights.iter().enumerate().map(|(j, w)| w * f64::from(v[(j * heads + head) * value + e])).sum::<f64>() / sum) as f32
        };
        let output = input.len();
        let results = queries * heads * value;
        let scratch = output + results;
        let size = [keys, key, value];
        for (isa, k) in tables() {
            let panels = scratch + threads * Attention::scratch_len(keys);
            let arena = panels + heads * PackKv::len(size, k).1;
            let packed = vec![
                Step::PackKv(PackKv {
                    heads: (0..heads).map(|h| [h * key, h * value]).collect(),
                    keys: Place::Arena(qs),
                    key_stride: [heads * key, 1],
                    values: Place::Arena(qs + ks),
                    value_stride: [heads * value, 1],
                    size,
                    output: panels,
                }),
                Step::Attention(Attention {
                    heads: (0..heads).map(|h| [h * key, h * value]).collect(),
                    queries,
                    size,
                    input: Place::Arena(0),
                    input_row: heads * key,
                    panels,
                    output,
                    output_row: heads * value,
                    scale: 0.3,
                    scratch,
                }),
            ];
            let thin = vec![Step::ThinAttention(ThinAttention {
                heads: (0..heads).map(|h| [h * key, h * key, h * value, h * value]).collect(),
                queries,
                size,
                inputs: [Place::Arena(0), Place::Arena(qs), Place::Arena(qs + ks)],
                rows: [heads * key, heads * key, heads * value],
                output,
                output_row: heads * value,
                scale: 0.3,
                scratch,
            })];
            for (kind, steps) in [("packed", packed), ("thin", thin)] {
                let program = Program::new(steps, arena, 1, threads, k).unwrap();
                let mut team = Team::new(arena, vec![0.0], vec![program], k, threads, false).unwrap();
                team.view_mut(0..input.len()).copy_from_slice(&input);
                team.run(0);
                let found = team.view(output..output + results);
                compare(&format!("{isa:?}, {kind}, {threads} threads"), found, 0, |i| {
                    Some(want(i / value % heads, i / value / heads, i % value))
                })?;
            }
        }
    }

    #[test]
    fn products_of_computed_tensors(
        (batch, m, n, depth) in (1usize..miri(3, 4), 1usize..miri(3, 5), 1usize..miri(35, 80), 1usize..miri(35, 80)),
        (turned, threads) in (any::<bool>(), 1usize..3),
    ) {
        let (a_len, b_len) = (batch * m * depth, batch * depth * n);
        let input = numbers(a_len + b_len, 1);
        let (b_sum, b_column) = if turned { (1, depth) } else { (n, 1) };
        let step = |_: &'static Kernels| {
            let step = Step::MatMul(MatMul {
                batch: (0..batch).map(|i| [i * m * depth, i * depth * n, i * m * n]).collect(),
                size: [m, depth, n],
                a: Place::Arena(0),
                a_row: depth,
                b: Place::Arena(a_len),
                b_sum,
                b_column,
                c: a_len + b_len,
                c_row: n,
            });
            (step, vec![0.0])
        };
        for_all(step, threads, |name, step, k, weights, threads| {
            let found = run(step, k, threads, &input, a_len + b_len + batch * m * n, weights);
            compare(name, &found, a_len + b_len, |i| {
                let i = i - a_len - b_len;
                let (b, row, column) = (i / (m * n), i / n % m, i % n);
                let sum: f64 = (0..depth).map(|d| {
                    let right = a_len + b * depth * n + d * b_sum + column * b_column;
                    f64::from(input[(b * m + row) * depth + d]) * f64::from(input[right])
                }).sum();
                Some(sum as f32)
            })
        })?;
    }
}

#[test]
fn functions_and_reductions() {
    let input = numbers(60, 1);
    type Function = fn(f32) -> f32;
    let functions: [(Unary, Function); 7] = [
        (Unary::Clamp(-0.5, 0.5), |x| x.clamp(-0.5, 0.5)),
        (Unary::Exp, f32::exp),
        (Unary::Sigmoid, |x| 1.0 / (1.0 + (-x).exp())),
        (Unary::HardSigmoid(0.4, 0.25), |x| (0.4 * x + 0.25).clamp(0.0, 1.0)),
        (Unary::HardSwish, |x| x * (x / 6.0 + 0.5).clamp(0.0, 1.0)),
        (Unary::Abs, f32::abs),
        (Unary::Neg, |x| -x),
    ];
    for (_, k) in tables() {
        for (op, f) in functions {
            let nest = Nest::new(&[60], [&[1], &[1]]).unwrap();
            let step = Step::Map(Map { op, nest, input: Place::Arena(0), output: 60 });
            let found = run(&step, k, 2, &input, 120, &[0.0]);
            compare("map", &found, 60, |i| Some(f(input[i - 60]))).unwrap();
        }
        for kind in [Reduce::Sum, Reduce::Mean, Reduce::Max, Reduce::Min] {
            // (3, 4, 5) over the first and last dimension.
            let outer = Nest::new(&[4], [&[5], &[1]]).unwrap();
            let inner = Nest::new(&[3, 5], [&[20, 1]]).unwrap();
            let step = Step::Fold(Fold { kind, outer, inner, input: Place::Arena(0), output: 60 });
            let found = run(&step, k, 1, &input, 64, &[0.0]);
            compare("fold", &found, 60, |i| {
                let all = (0..15).map(|j| input[j / 5 * 20 + (i - 60) * 5 + j % 5]);
                Some(match kind {
                    Reduce::Sum => all.sum(),
                    Reduce::Mean => all.sum::<f32>() / 15.0,
                    Reduce::Max => all.fold(f32::NEG_INFINITY, f32::max),
                    Reduce::Min => all.fold(f32::INFINITY, f32::min),
                })
            })
            .unwrap();
        }
        let row = |columns| Softmax {
            size: [1, 3],
            columns,
            input: Place::Arena(0),
            input_pitch: Pitch { y: 0, x: 20 },
            output: 60,
            output_pitch: Pitch { y: 0, x: columns },
        };
        for columns in [1, 7, 16, 20] {
            let found = run(&Step::Softmax(row(columns)), k, 1, &input, 60 + 3 * columns, &[0.0]);
            compare("softmax", &found, 60, |i| {
                let (r, at) = ((i - 60) / columns, (i - 60) % columns);
                let line = &input[r * 20..r * 20 + columns];
                let sum: f32 = line.iter().map(|v| v.exp()).sum();
                Some(line[at].exp() / sum)
            })
            .unwrap();
        }
    }
}

#[test]
fn steps_that_leave_their_memory_are_refused() {
    let k = Isa::Scalar.kernels().unwrap();
    let copy = |input, output, strides: [&[usize]; 2]| {
        Step::Copy(Copy { nest: Nest::new(&[4, 5], strides).unwrap(), input, output })
    };
    let good: [&[usize]; 2] = [&[5, 1], &[5, 1]];
    let cases = [
        (copy(Place::Arena(0), 20, good), None),
        (copy(Place::Arena(0), 21, good), Some("writes beyond")),
        (copy(Place::Arena(0), 19, good), Some("writes what it reads")),
        (copy(Place::Arena(usize::MAX), 20, good), Some("reads beyond the arena")),
        (copy(Place::Weights(1), 20, good), Some("reads beyond the weights")),
        (copy(Place::Weights(0), 0, [&[5, 1], &[4, 1]]), Some("overlap")),
    ];
    for (step, want) in cases {
        let result = Program::new(vec![step.clone()], 40, 20, 1, k);
        match (result, want) {
            (Ok(_), None) => {}
            (Err((0, what)), Some(want)) if what.contains(want) => {}
            (other, _) => panic!("{step:?}: {other:?}, not {want:?}"),
        }
    }
}
