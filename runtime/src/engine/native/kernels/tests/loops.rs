//! Copies, functions of two tensors and reductions.

use super::*;

/// Functions of two tensors that have vector code.
const ZIPPED: [Binary; 6] =
    [Binary::Add, Binary::Sub, Binary::Mul, Binary::Max, Binary::Min, Binary::MulHardSwish];

proptest! {
    #![proptest_config(ProptestConfig { cases: CASES, ..ProptestConfig::default() })]

    #[test]
    fn element_by_element(
        shape in (1usize..miri(4, 7), 1usize..miri(4, 7), 1usize..miri(19, 24)).prop_map(|(a, b, c)| [a, b, c]),
        order in Just(vec![0usize, 1, 2]).prop_shuffle(),
        (op, broadcast, threads) in (0..ZIPPED.len(), 0usize..8, 1usize..4),
    ) {
        let len: usize = shape.iter().product();
        let input = numbers(2 * len, 1);
        let dense = [shape[1] * shape[2], shape[2], 1];
        let mut other = [0; 3];
        let mut next = 1;
        for &i in order.iter().rev() {
            other[i] = next;
            next *= shape[i];
        }
        let right: [usize; 3] = core::array::from_fn(|i| if broadcast >> i & 1 == 1 { 0 } else { dense[i] });
        let op = ZIPPED[op];
        let nest = Nest::new(&shape, [&other, &right, &dense]).unwrap();
        let inputs = [Place::Arena(0), Place::Arena(len)];
        let step = |_: &'static Kernels| {
            (Step::Zip(Zip { op, nest: nest.clone(), inputs, output: 2 * len }), vec![0.0])
        };
        for_all(step, threads, |name, step, k, weights, threads| {
            let found = run(step, k, threads, &input, 3 * len, weights);
            compare(name, &found, 2 * len, |i| {
                let j = i - 2 * len;
                let at = [j / dense[0], j / dense[1] % shape[1], j % shape[2]];
                let index = |s: &[usize; 3]| (0..3).map(|d| at[d] * s[d]).sum::<usize>();
                let (a, b) = (input[index(&other)], input[len + index(&right)]);
                Some(match op {
                    Binary::Add => a + b,
                    Binary::Sub => a - b,
                    Binary::Mul => a * b,
                    Binary::Min => a.min(b),
                    Binary::MulHardSwish => a * b * (a * b / 6.0 + 0.5).clamp(0.0, 1.0),
                    _ => a.max(b),
                })
            })
        })?;
    }

    /// Runs, results side by side, and neither.
    #[test]
    fn reductions(
        (planes, lines, columns) in (1usize..miri(3, 5), 1usize..miri(12, 40), 1usize..miri(19, 40)),
        (kind, axes, threads) in (0usize..4, 1usize..7, 1usize..4),
    ) {
        let kind = [Reduce::Sum, Reduce::Mean, Reduce::Max, Reduce::Min][kind];
        let shape = [planes, lines, columns];
        let input = numbers(shape.iter().product(), 1);
        let stride = [lines * columns, columns, 1];
        let pick = |from: [usize; 3], goes: bool| -> Vec<usize> {
            (0..3).filter(|d| (axes >> d & 1 == 1) == goes).map(|d| from[d]).collect()
        };
        let (kept, gone) = (pick(shape, false), pick(shape, true));
        let (kept_at, gone_at) = (pick(stride, false), pick(stride, true));
        let dense: Vec<usize> =
            (0..kept.len()).map(|d| kept[d + 1..].iter().product()).collect();
        let outer = Nest::new(&kept, [&kept_at, &dense]).unwrap();
        let inner = Nest::new(&gone, [&gone_at]).unwrap();
        let (from, results) = (input.len(), kept.iter().product::<usize>());
        let step = |_: &'static Kernels| {
            let (outer, inner) = (outer.clone(), inner.clone());
            (Step::Fold(Fold { kind, outer, inner, input: Place::Arena(0), output: from }), vec![0.0])
        };
        let at = |i: usize, shape: &[usize], stride: &[usize]| -> usize {
            let mut rest = i;
            (0..shape.len()).rev().map(|d| {
                let index = rest % shape[d];
                rest /= shape[d];
                index * stride[d]
            }).sum()
        };
        for_all(step, threads, |name, step, k, weights, threads| {
            let found = run(step, k, threads, &input, from + results, weights);
            compare(name, &found, from, |i| {
                let start = at(i - from, &kept, &kept_at);
                let count: usize = gone.iter().product();
                let all = (0..count).map(|j| f64::from(input[start + at(j, &gone, &gone_at)]));
                Some(match kind {
                    Reduce::Sum => all.sum::<f64>(),
                    Reduce::Mean => all.sum::<f64>() / count as f64,
                    Reduce::Max => all.fold(f64::NEG_INFINITY, f64::max),
                    Reduce::Min => all.fold(f64::INFINITY, f64::min),
                } as f32)
            })
        })?;
    }

    /// Planes into pixels with a border, as before the first convolution, and back.
    #[test]
    fn copies_between_layouts(
        (channels, h, w) in (1usize..miri(3, 5), 1usize..miri(4, 9), 1usize..miri(35, 70)),
        (border, back, threads) in (0usize..2, any::<bool>(), 1usize..4),
    ) {
        let shape = [channels, h, w];
        let line = (w + 2 * border) * channels;
        let (planes, pixels) = ([h * w, w, 1], [1, line, channels]);
        let (from, to) = if back { (pixels, planes) } else { (planes, pixels) };
        let room = |s: [usize; 3]| (0..3).map(|d| (shape[d] - 1) * s[d]).sum::<usize>() + 1;
        let input = numbers(room(from), 1);
        let nest = Nest::new(&shape, [&from, &to]).unwrap();
        let output = input.len() + 2;
        let step = |_: &'static Kernels| {
            let nest = nest.clone();
            (Step::Copy(Copy { nest, input: Place::Arena(0), output }), vec![0.0])
        };
        let mut want = vec![None; output + room(to)];
        for i in 0..channels * h * w {
            let at = [i / (h * w), i / w % h, i % w];
            let index = |s: [usize; 3]| (0..3).map(|d| at[d] * s[d]).sum::<usize>();
            want[output + index(to)] = Some(input[index(from)]);
        }
        for_all(step, threads, |name, step, k, weights, threads| {
            let found = run(step, k, threads, &input, output + room(to), weights);
            compare(name, &found, input.len(), |i| want[i])
        })?;
    }
}
