use super::*;
use crate::rng::SplitMix;

/// RGB boxes along a path, their thermal counterparts under `truth`, noise and outliers.
fn pairs(truth: Affine, n: usize, spread: f64, noise: f64, outliers: usize) -> Vec<(BBox, BBox)> {
    let mut rng = SplitMix::new(&[5]);
    let mut list = Vec::new();
    for i in 0..n {
        let t = i as f64 / n as f64 * 7.0;
        let (x, y) = (900.0 + spread * t.sin(), 500.0 + spread * (1.3 * t).cos());
        let a = BBox::new(x as f32, y as f32, 40.0, 24.0);
        let mut b = truth.map_box(a);
        b.x += rng.uniform(-noise, noise) as f32;
        b.y += rng.uniform(-noise, noise) as f32;
        if i < outliers {
            b = BBox::new(10.0 * i as f32, 7.0, 30.0, 30.0);
        }
        list.push((a, b));
    }
    list
}

#[test]
fn finds_the_map_despite_noise_and_outliers() {
    let truth = Affine { rows: [[0.41, 0.012, -63.0], [-0.009, 0.39, 25.0]] };
    let fit = Affine::fit(&pairs(truth, 200, 300.0, 2.0, 30)).unwrap();
    assert!(fit.full && fit.residual < 2.0, "{fit:?}");
    for p in [(600.0, 200.0), (1200.0, 800.0), (900.0, 500.0)] {
        let (a, b) = (fit.affine.apply(p), truth.apply(p));
        assert!((a.0 - b.0).hypot(a.1 - b.1) < 1.0, "{p:?}: {a:?} {b:?}");
    }
}

#[test]
fn a_target_that_hardly_moves_gives_scale_and_shift() {
    let truth = Affine { rows: [[0.4, 0.0, -60.0], [0.0, 0.4, 20.0]] };
    let fit = Affine::fit(&pairs(truth, 60, 4.0, 0.5, 5)).unwrap();
    assert!(!fit.full, "{fit:?}");
    let (a, b) = (fit.affine.apply((900.0, 500.0)), truth.apply((900.0, 500.0)));
    assert!((a.0 - b.0).hypot(a.1 - b.1) < 1.0, "{fit:?}");
    assert!((fit.affine.rows[0][0] - 0.4).abs() < 0.01);
}

#[test]
fn nothing_to_fit() {
    let truth = Affine { rows: [[0.4, 0.0, -60.0], [0.0, 0.4, 20.0]] };
    assert_eq!(Affine::fit(&pairs(truth, LEAST_PAIRS - 1, 90.0, 0.0, 0)), None);
    let empty = vec![(BBox::default(), BBox::new(1.0, 1.0, 2.0, 2.0)); 50];
    assert_eq!(Affine::fit(&empty), None);
    let flat = Affine { rows: [[1.0, 2.0, 0.0], [2.0, 4.0, 0.0]] };
    assert_eq!(flat.inverse(), None);
}

#[test]
fn the_inverse_leads_back() {
    let map = Affine { rows: [[0.41, 0.12, -63.0], [-0.3, 0.39, 25.0]] };
    let back = map.inverse().unwrap().apply(map.apply((123.0, -45.0)));
    assert!((back.0 - 123.0).abs() < 1e-9 && (back.1 + 45.0).abs() < 1e-9);
}

#[test]
fn warping_shifts_shrinks_and_blackens() {
    let source =
        Picture { width: 4, height: 2, channels: 1, data: vec![10, 20, 30, 40, 50, 60, 70, 80] };
    let by = |rows, size| warp(&source, &Affine { rows }, size).data;
    let same = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    assert_eq!(by(same, (4, 2)), source.data);
    // One pixel to the right in the source; the last column has none.
    assert_eq!(by([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]], (4, 1)), [20, 30, 40, 0]);
    // Half the size: means of 2 x 2 pixels.
    assert_eq!(by([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]], (2, 1)), [35, 55]);
}
