//! Constants that are added to blocks of rows.

use super::super::graph::Op;
use super::*;

/// What is added to every block of a product's rows is part of the product where it can be.
#[test]
fn constants_that_repeat_over_blocks_of_rows() {
    let x: Vec<f32> = (0..12).map(|i| 0.5 * i as f32 - 2.0).collect();
    let weight: Vec<f32> = (0..6).map(|i| i as f32 - 2.5).collect();
    let added: Vec<f32> = (0..18).map(|i| 10.0 * i as f32).collect();
    let product = |row: usize, column: usize| -> f32 {
        (0..2).map(|k| x[row * 2 + k] * weight[k * 3 + column]).sum()
    };
    // Shape of the constant; nodes that compute something; whether the product is the second operand.
    let cases: [(&[usize], usize, bool); 5] = [
        (&[1, 3, 3], 1, false),
        (&[3, 3], 1, true),
        (&[2, 3, 3], 1, false),
        (&[1, 1, 3], 2, false),
        (&[2, 1, 3], 2, false),
    ];
    for (shape, left, turned) in cases {
        let count = shape.iter().product::<usize>();
        let operands = if turned { ["a", "b"] } else { ["b", "a"] };
        let nodes = vec![
            node("MatMul", &["x", "w"], "p", vec![]),
            node("Reshape", &["p", "s"], "b", vec![]),
            node("Add", &operands, "y", vec![]),
        ];
        let constants = vec![
            floats("w", &[2, 3], &weight),
            floats("a", shape, &added[..count]),
            longs("s", &[2, 3, 3]),
        ];
        let (x_port, y_port) = (vec![port("x", &[6, 2])], vec![port("y", &[2, 3, 3])]);
        let bytes = model(nodes, x_port, y_port, constants);
        let mut graph = graph::read(&bytes, &[]).unwrap();
        graph::fuse(&mut graph);
        let kept = graph.nodes.iter().filter(|n| n.op != Op::Reshape).count();
        assert_eq!(kept, left, "{shape:?}");
        let found = evaluate(&bytes, (&[6, 2], &x), &[2, 3, 3]);
        for (i, y) in found.iter().enumerate() {
            let (row, column) = (i / 3, i % 3);
            let at = match shape {
                [.., 1, 3] if count > 3 => row / 3 * 3 + column,
                _ => i % count,
            };
            let want = product(row, column) + added[at];
            assert!((y - want).abs() <= 1e-4, "{shape:?}, element {i}: {y}, not {want}");
        }
    }
}
