//! 3 x 3 convolutions by points on the planner: the numbers of the loops.

use super::*;

fn numbers(n: usize, seed: usize) -> Vec<f32> {
    (0..n).map(|i| ((i * 7919 + seed * 104_729) % 2003) as f32 / 1001.0 - 1.0).collect()
}

/// Within the digits that another order of sums, and rounded weights, cost.
fn close(found: &[f32], direct: &[f32]) {
    let largest = direct.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    for (i, (a, b)) in found.iter().zip(direct).enumerate() {
        assert!((a - b).abs() <= 2e-6 * largest, "{a} instead of {b} at {i}");
    }
}

/// A convolution so deep that its weights are transformed a few columns at a time, with a last group
/// of fewer.
#[test]
fn fresh_points_in_groups() {
    let (c, n) = (640, 150);
    let (from, to) = ([1, c, 16, 16], [1, n, 16, 16]);
    let file = model(
        vec![node("Conv", &["x", "w", "b"], "y", vec![ints("pads", &[1; 4])])],
        vec![port("x", &from)],
        vec![port("y", &to)],
        vec![floats("w", &[n, c, 3, 3], &numbers(9 * c * n, 1)), floats("b", &[n], &numbers(n, 2))],
    );
    let x = numbers(from.iter().product(), 3);
    let (direct, _) = planned(&file, (&from, &x), &to, None);
    let (found, kinds) = planned(&file, (&from, &x), &to, Some(0));
    assert!(kinds.iter().any(|k| k.0 == "kernels to points" && k.1 > 1), "{kinds:?}");
    close(&found, &direct);
}

/// Two convolutions with a border between them and a residual, by loops and by points: in several
/// blocks, with weights transformed at load as far as they may grow and in every run beyond that.
#[test]
fn convolutions_by_points() {
    let (c, shape) = (32, [1, 32, 36, 40]);
    let conv = |from: &str, w: &str, b: &str, to: &str| {
        node("Conv", &[from, w, b], to, vec![ints("pads", &[1; 4])])
    };
    let file = model(
        vec![
            conv("x", "v", "a", "c"),
            node("Relu", &["c"], "h", vec![]),
            conv("h", "w", "b", "d"),
            node("Add", &["d", "h"], "s", vec![]),
            node("Relu", &["s"], "y", vec![]),
        ],
        vec![port("x", &shape)],
        vec![port("y", &shape)],
        vec![
            floats("v", &[c, c, 3, 3], &numbers(9 * c * c, 1)),
            floats("w", &[c, c, 3, 3], &numbers(9 * c * c, 2)),
            floats("a", &[c], &numbers(c, 3)),
            floats("b", &[c], &numbers(c, 4)),
        ],
    );
    let x = numbers(shape.iter().product(), 5);
    let (direct, kinds) = planned(&file, (&shape, &x), &shape, None);
    assert!(kinds.contains(&("convolution", 2)), "{kinds:?}");
    // How many are transformed in every run when weights may grow by so much.
    let grown = 7 * c * c;
    for (growth, fresh) in [(0, 2), (grown - 1, 2), (grown, 1), (2 * grown, 0)] {
        let (found, kinds) = planned(&file, (&shape, &x), &shape, Some(growth));
        let count = |kind: &str| kinds.iter().find(|k| k.0 == kind).map_or(0, |k| k.1);
        assert_eq!(count("convolution"), 0, "{kinds:?}");
        assert_eq!(count("kernels to points"), fresh, "{kinds:?}");
        assert!(count("to points") >= 4, "{kinds:?}");
        assert_eq!(count("to points"), count("from points"));
        close(&found, &direct);
    }
}
