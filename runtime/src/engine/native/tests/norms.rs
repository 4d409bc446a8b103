//! Normalisations of whole maps, in the forms that exporters write them.

use super::super::graph::Op;
use super::*;

/// Mean of everything at once or dimension by dimension, quotient or product with a reciprocal, gain
/// and offset before or after the map gets its shape back: one node, the same numbers.
#[test]
fn map_norms_in_all_their_forms() {
    const C: usize = 3;
    let (shape, cells) = ([1, C, 2, 4], 8);
    let x: Vec<f32> = (0..C * cells).map(|i| (i * 37 % 23) as f32 / 4.0 - 2.0).collect();
    let (gain, offset) = ([0.5, -2.0, 3.0], [1.0, 0.25, -4.0]);
    // By channel first; reciprocal; gain and offset: none, gain alone, both; whether inside the shape
    // of the means.
    let mut cases = Vec::new();
    for by_channel in [false, true] {
        for reciprocal in [false, true] {
            for parts in 0..3 {
                cases.extend(
                    [false, by_channel].map(|inside| (by_channel, reciprocal, parts, inside)),
                );
            }
        }
    }
    for (by_channel, reciprocal, parts, inside) in cases {
        let mut nodes = vec![node("Reshape", &["x", "flat"], "r", vec![])];
        let mean =
            |nodes: &mut Vec<Message>, from: &str, to: &'static str, between: &'static str| {
                let axes = |axis: i64| vec![ints("axes", &[axis])];
                let first = if by_channel { between } else { to };
                nodes.push(node("ReduceMean", &[from], first, axes(2)));
                if by_channel {
                    nodes.push(node("ReduceMean", &[between], to, axes(1)));
                }
            };
        mean(&mut nodes, "r", "m", "m1");
        nodes.push(node("Sub", &["r", "m"], "d", vec![]));
        nodes.push(node("Mul", &["d", "d"], "q", vec![]));
        mean(&mut nodes, "q", "v", "v1");
        nodes.push(node("Add", &["v", "e"], "ve", vec![]));
        nodes.push(node("Sqrt", &["ve"], "root", vec![]));
        if reciprocal {
            nodes.push(node("Reciprocal", &["root"], "inverse", vec![]));
            nodes.push(node("Mul", &["inverse", "d"], "n", vec![]));
        } else {
            nodes.push(node("Div", &["d", "root"], "n", vec![]));
        }
        let mut last = "n";
        let affine = |nodes: &mut Vec<Message>, last: &mut &'static str| {
            for (op, by, to) in [("Mul", "g", "ng"), ("Add", "o", "ngo")].into_iter().take(parts) {
                nodes.push(node(op, &[*last, by], to, vec![]));
                *last = to;
            }
        };
        if inside {
            affine(&mut nodes, &mut last);
        }
        nodes.push(node("Reshape", &[last, "map"], "back", vec![]));
        last = "back";
        if !inside {
            affine(&mut nodes, &mut last);
        }
        nodes.push(node("Relu", &[last], "y", vec![]));
        let per_channel = if inside { vec![1, C, 1] } else { vec![1, C, 1, 1] };
        let flat = if by_channel { [1, C as i64, -1] } else { [1, 1, -1] };
        let file = model(
            nodes,
            vec![port("x", &shape)],
            vec![port("y", &shape)],
            vec![
                longs("flat", &flat),
                longs("map", &shape.map(|n| n as i64)),
                floats("e", &[], &[1e-5]),
                floats("g", &per_channel, &gain),
                floats("o", &per_channel, &offset),
            ],
        );
        let case = (by_channel, reciprocal, parts, inside);
        let mut graph = graph::read(&file, &[]).unwrap();
        graph::fuse(&mut graph);
        let kinds: Vec<_> = graph.nodes.iter().map(|n| n.op.name()).collect();
        assert_eq!(kinds, ["MapNorm"], "{case:?}");
        assert!(matches!(graph.nodes[0].op, Op::MapNorm { centre: true, clamp: (0.0, _), .. }));
        assert_eq!(graph.nodes[0].inputs.len(), 1 + parts, "{case:?}");

        let mean = x.iter().sum::<f32>() / x.len() as f32;
        let variance = x.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / x.len() as f32;
        let found = evaluate(&file, (&shape, &x), &shape);
        for (i, (y, v)) in found.iter().zip(&x).enumerate() {
            let mut want = (v - mean) / (variance + 1e-5).sqrt();
            if parts > 0 {
                want *= gain[i / cells];
            }
            if parts > 1 {
                want += offset[i / cells];
            }
            assert!((y - want.max(0.0)).abs() <= 1e-5, "{case:?}, element {i}: {y}, not {want}");
        }
    }
}
