//! Graphs with narrow numbers: what is computed in bytes, and what is refused.

use super::*;

fn narrow(name: &str, shape: &[usize], kind: i64, raw: &[u8]) -> Message {
    let m = shape.iter().fold(Message::default(), |m, &n| m.int(1, n as i64));
    m.int(2, kind).bytes(8, name).bytes(9, raw)
}

const U8: i64 = 2;
const I8: i64 = 3;
const F16: i64 = 10;

/// `x (1, 6, 4, 5)` rounded, times a 3 x 3 kernel of bytes, bias, ReLU.
fn convolution(extra: &[Message], from: &str) -> Vec<u8> {
    let weights: Vec<u8> = (0..7 * 6 * 9).map(|i| (i * 89 % 255 - 127) as i8 as u8).collect();
    let scales: Vec<f32> = (0..7).map(|j| 0.01 + 0.002 * j as f32).collect();
    let mut nodes = vec![
        node("QuantizeLinear", &["x", "step", "zero"], "q", vec![]),
        node("DequantizeLinear", &["q", "step", "zero"], "d", vec![]),
        node("DequantizeLinear", &["w8", "scales", "none"], "w", vec![int("axis", 0)]),
        node("Conv", &[from, "w", "bias"], "c", vec![ints("pads", &[1; 4])]),
    ];
    nodes.extend_from_slice(extra);
    if extra.is_empty() {
        nodes.push(node("Relu", &["c"], "y", vec![]));
    }
    let constants = vec![
        narrow("w8", &[7, 6, 3, 3], I8, &weights),
        narrow("none", &[7], I8, &[0; 7]),
        narrow("zero", &[], U8, &[90]),
        floats("step", &[], &[0.05]),
        floats("scales", &[7], &scales),
        floats("bias", &[7], &[0.5; 7]),
    ];
    model(nodes, vec![port("x", &[1, 6, 4, 5])], vec![port("y", &[1, 7, 4, 5])], constants)
}

#[test]
fn convolutions_of_bytes_are_exact() {
    let x: Vec<f32> = (0..120).map(|i| (i * 37 % 100) as f32 * 0.09 - 4.3).collect();
    let bytes = convolution(&[], "d");
    let mut graph = graph::read(&bytes, &[]).unwrap();
    graph::fuse(&mut graph);
    assert_eq!(graph.nodes.len(), 2, "rounding, and a product with bias and limits");
    let found = evaluate(&bytes, (&[1, 6, 4, 5], &x), &[1, 7, 4, 5]);
    let rounded = |v: f32| ((v / 0.05).round_ties_even() + 90.0).clamp(0.0, 255.0) as i32 - 90;
    for (i, y) in found.iter().enumerate() {
        let (n, row, column) = (i / 20, i % 20 / 5, i % 5);
        let mut sum = 0;
        for (c, ky, kx) in (0..54).map(|t| (t / 9, t % 9 / 3, t % 3)) {
            let (r, k) = (row + ky, column + kx);
            if (1..5).contains(&r) && (1..6).contains(&k) {
                let w = (((n * 6 + c) * 9 + ky * 3 + kx) as i32 * 89) % 255 - 127;
                sum += w * rounded(x[c * 20 + (r - 1) * 5 + k - 1]);
            }
        }
        let want = (sum as f32 * 0.05 * (0.01 + 0.002 * n as f32) + 0.5).max(0.0);
        assert!((y - want).abs() <= 1e-4 * want.max(1.0), "{i}: {y}, not {want}");
    }
}

/// A rounded tensor that also somebody else reads, and weights of bytes without rounded input.
#[test]
fn floats_come_out_where_they_are_needed() {
    let x: Vec<f32> = (0..120).map(|i| (i * 37 % 100) as f32 * 0.09 - 4.3).collect();
    let shape: (&[usize], &[f32]) = (&[1, 6, 4, 5], &x);
    let last = node("Relu", &["c"], "y", vec![]);
    let both = [last.clone(), node("Abs", &["d"], "unused", vec![])];
    assert_eq!(
        evaluate(&convolution(&both, "d"), shape, &[1, 7, 4, 5]),
        evaluate(&convolution(&[], "d"), shape, &[1, 7, 4, 5])
    );
    let in_floats = evaluate(&convolution(&[], "x"), shape, &[1, 7, 4, 5]);
    let in_bytes = evaluate(&convolution(&[], "d"), shape, &[1, 7, 4, 5]);
    let far = in_floats.iter().zip(&in_bytes).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    // Half a step times the sum of 54 weights of at most 1.3.
    assert!(far > 1e-3 && far < 0.025 * 54.0 * 1.3, "{far}");
}

#[test]
fn linear_layers_of_bytes_are_exact() {
    let weights: Vec<u8> = (0..5 * 33).map(|i| (i * 53 % 251 - 125) as i8 as u8).collect();
    let x: Vec<f32> = (0..3 * 5).map(|i| i as f32 - 7.0).collect();
    let bytes = model(
        vec![
            node("QuantizeLinear", &["x", "step", "zero"], "q", vec![]),
            node("DequantizeLinear", &["q", "step", "zero"], "d", vec![]),
            node("DequantizeLinear", &["w8", "step"], "w", vec![]),
            node("MatMul", &["d", "w"], "y", vec![]),
        ],
        vec![port("x", &[1, 3, 5])],
        vec![port("y", &[1, 3, 33])],
        vec![
            narrow("w8", &[5, 33], I8, &weights),
            // Signed: the same as 128 + 3 unsigned.
            narrow("zero", &[1], I8, &[3]),
            floats("step", &[], &[0.5]),
        ],
    );
    let found = evaluate(&bytes, (&[1, 3, 5], &x), &[1, 3, 33]);
    for (i, y) in found.iter().enumerate() {
        let (row, column) = (i / 33, i % 33);
        let products =
            (0..5).map(|k| x[row * 5 + k] * ((k * 33 + column) as i32 * 53 % 251 - 125) as f32);
        let want = products.sum::<f32>() * 0.5;
        assert!((y - want).abs() <= 1e-3, "{i}: {y}, not {want}");
    }
}

#[test]
fn halves_are_the_numbers_they_stand_for() {
    let halves: [(u16, f32); 8] = [
        (0x3c00, 1.0),
        (0xc000, -2.0),
        (0x7bff, 65504.0),
        (0x0001, 5.960_464_5e-8),
        (0x8400, -6.103_515_6e-5),
        (0x3555, 0.333_251_95),
        (0x8000, -0.0),
        (0x7c00, f32::INFINITY),
    ];
    let raw: Vec<u8> = halves.iter().flat_map(|h| h.0.to_le_bytes()).collect();
    let file = |to: i64| {
        model(
            vec![
                node("Cast", &["h"], "f", vec![int("to", to)]),
                node("Add", &["x", "f"], "y", vec![]),
            ],
            vec![port("x", &[8])],
            vec![port("y", &[8])],
            vec![narrow("h", &[8], F16, &raw)],
        )
    };
    let found = evaluate(&file(1), (&[8], &[0.0; 8]), &[8]);
    assert_eq!(found, halves.map(|h| h.1));
    let error = graph::read(&file(7), &[]).unwrap_err().to_string();
    assert!(error.contains("Cast_f") && error.contains("16-bit"), "{error}");
}

#[test]
fn what_cannot_be_done_in_bytes_is_named() {
    let refused = |nodes: Vec<Message>, constants: Vec<Message>| {
        let io = || port("x", &[1, 4]);
        let constants = [
            vec![
                floats("s", &[], &[0.5]),
                floats("bad", &[], &[0.0]),
                floats("two", &[2], &[0.5, 0.5]),
                narrow("one", &[], I8, &[1]),
                narrow("z", &[], U8, &[1]),
                narrow("w8", &[4, 4], I8, &[1; 16]),
            ],
            constants,
        ]
        .concat();
        let bytes = model(nodes, vec![io()], vec![port("y", &[1, 4])], constants);
        graph::read(&bytes, &[]).unwrap_err().to_string()
    };
    let q = |scale: &str| node("QuantizeLinear", &["x", scale, "z"], "q", vec![]);
    let d = |inputs: &[&str]| node("DequantizeLinear", inputs, "y", vec![]);
    let cases: [(String, &[&str]); 8] = [
        (refused(vec![q("bad")], vec![]), &["QuantizeLinear_q", "above 0"]),
        (refused(vec![q("two")], vec![]), &["QuantizeLinear_q", "`two`"]),
        (refused(vec![q("s"), node("Relu", &["q"], "y", vec![])], vec![]), &["`q` holds bytes"]),
        (refused(vec![q("s"), d(&["q", "s", "one"])], vec![]), &["DequantizeLinear_y", "undoes"]),
        (refused(vec![d(&["x", "s"])], vec![]), &["`x` must be a constant of signed bytes"]),
        (refused(vec![d(&["w8", "s", "one"])], vec![]), &["zero point"]),
        (refused(vec![d(&["w8", "two"])], vec![]), &["2 scales for 4 channels"]),
        (refused(vec![node("Add", &["x", "w8"], "y", vec![])], vec![]), &["`w8` holds integers"]),
    ];
    for (message, wants) in cases {
        for want in wants {
            assert!(message.contains(want), "{want}: {message}");
        }
    }
}
