use super::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;

#[derive(Deserialize)]
struct Case {
    image_hw: [usize; 2],
    #[serde(rename = "box")]
    around: [f32; 4],
    search_area_factor: f32,
    output_sz: usize,
    mode: String,
    crop_box: [f32; 4],
    gt_box: [f32; 4],
    gt_box_in_crop: [f32; 4],
    pixels_at_yxc: Vec<[usize; 3]>,
    pixel_values_u8_opencv: Vec<i32>,
}

fn bbox([x, y, w, h]: [f32; 4]) -> BBox {
    BBox::new(x, y, w, h)
}

/// The reference's picture of this size; see `tests/golden/trainer/README.md`.
fn recipe(height: usize, width: usize) -> Picture {
    let hash = "image.0"
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3));
    let noise = |i: usize| {
        let mut z = hash.wrapping_add((i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 58) as usize
    };
    let tri = |t: usize, p: usize| (t % (2 * p)).abs_diff(p);
    let mut data = Vec::with_capacity(height * width * 3);
    for y in 0..height {
        for x in 0..width {
            for c in 0..3 {
                let v = tri(3 * x + 5 * y + 40 * c, 128)
                    + tri(x + 2 * y, 64)
                    + noise((c * height + y) * width + x);
                data.push(v.min(255) as u8);
            }
        }
    }
    Picture { width, height, channels: 3, data }
}

#[test]
fn crops_equal_the_reference() {
    let path =
        concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden/trainer/train_crop_cases.json");
    let cases: Vec<Case> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(cases.len(), 28);
    let (mut edge, mut grey, mut exact, mut pixels) = (0.0f32, 0, 0, 0);
    for (n, case) in cases.iter().enumerate() {
        let [height, width] = case.image_hw;
        let rule = CropRule {
            search_factor: case.search_area_factor,
            output: case.output_sz,
            // "replicate" shifts as well, but never shrinks; "inside" would take the larger ratio of
            // both axes, which the limit makes the same in these cases. Training uses neither.
            max_scale_change: if case.mode == "replicate" { 1.0 } else { 1.5 },
            stretch: 0.0,
        };
        let window = CropWindow::around((width, height), &bbox(case.around), &rule);
        let got = [window.x, window.y, window.w, window.h].map(|v| v as f32);
        assert_eq!(got, case.crop_box, "window of case {n}");
        let target = window.to_crop(&bbox(case.gt_box), case.output_sz);
        let want = bbox(case.gt_box_in_crop);
        for (a, b) in
            [(target.x, want.x), (target.y, want.y), (target.w, want.w), (target.h, want.h)]
        {
            edge = edge.max((a - b).abs());
            assert!((a - b).abs() < 2e-3, "case {n}: {target:?} {want:?}");
        }
        let picture = recipe(height, width);
        let crop = window.cut(&picture, case.output_sz, false);
        for ([y, x, c], want) in case.pixels_at_yxc.iter().zip(&case.pixel_values_u8_opencv) {
            let got = i32::from(crop[(y * case.output_sz + x) * 3 + c]);
            grey = grey.max((got - want).abs());
            (exact, pixels) = (exact + usize::from(got == *want), pixels + 1);
            assert!((got - want).abs() <= 1, "case {n} at {y},{x},{c}: {got} {want}");
        }
    }
    println!(
        "{} crops: windows equal, boxes within {edge:.1e} px, {exact} of {pixels} pixels equal, \
         the others within {grey} grey level",
        cases.len()
    );
}

#[test]
fn a_mirrored_cut_is_the_cut_of_the_mirrored_picture() {
    let picture = recipe(50, 70);
    let mut mirrored = picture.clone();
    for y in 0..50 {
        for x in 0..70 {
            for c in 0..3 {
                mirrored.data[(y * 70 + x) * 3 + c] = picture.data[(y * 70 + 69 - x) * 3 + c];
            }
        }
    }
    for window in [
        CropWindow { x: 5, y: 4, w: 30, h: 30 },
        CropWindow { x: -20, y: -9, w: 110, h: 80 },
        CropWindow { x: 40, y: 20, w: 30, h: 30 },
    ] {
        assert!(window.cut(&picture, 32, true) == window.cut(&mirrored, 32, false), "{window:?}");
    }
}

#[test]
fn windows_of_any_box_can_be_cut() {
    let picture = Picture { width: 9, height: 7, channels: 1, data: vec![100; 63] };
    for (x, y, w, h) in [
        (0.0, 0.0, 1.0, 1.0),
        (-500.0, 300.0, 2.0, 3.0),
        (4.0, 3.0, 400.0, 300.0),
        (8.5, 6.5, 0.1, 0.1),
        (1e7, 1e7, 5.0, 5.0),
    ] {
        for stretch in [0.0, 0.4, -0.4] {
            let rule = CropRule { search_factor: 4.0, output: 16, max_scale_change: 1.5, stretch };
            let window = CropWindow::around((9, 7), &BBox::new(x, y, w, h), &rule);
            let crop = window.cut(&picture, 16, false);
            assert!(crop.len() == 256 && crop.iter().all(|v| *v == 100), "{window:?}");
        }
    }
}

#[test]
fn a_stretch_changes_the_aspect_and_the_box_with_it() {
    let rule = CropRule { search_factor: 4.0, output: 160, max_scale_change: 1.5, stretch: 0.2 };
    let b = BBox::new(300.0, 200.0, 40.0, 40.0);
    let window = CropWindow::around((640, 480), &b, &rule);
    let ratio = window.w as f32 / window.h as f32;
    assert!((ratio.ln() - 0.2).abs() < 0.02, "{window:?}");
    let inside = window.to_crop(&b, 160);
    assert!(inside.w < 40.0 && inside.h > 40.0 && (inside.area().sqrt() - 40.0).abs() < 0.5);
}

#[test]
fn jitter_has_the_configured_spread_and_none_at_zero() {
    let b = BBox::new(10.0, 20.0, 30.0, 40.0);
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let still = JitterConfig { scale: 0.0, centre: 0.0, aspect: 0.0 };
    let same = jittered(&b, &still, &mut rng);
    assert!((same.x - b.x).abs() < 1e-4 && (same.w - b.w).abs() < 1e-4);
    let jitter = JitterConfig { scale: 0.2, centre: 3.0, aspect: 0.0 };
    let (mut log, mut reach) = (0.0, 0.0f32);
    for _ in 0..2000 {
        let j = jittered(&b, &jitter, &mut rng);
        log += (j.w / b.w).ln().powi(2);
        let d = (j.centre().0 - b.centre().0).abs() / j.area().sqrt();
        reach = reach.max(d);
    }
    let sigma = (log / 2000.0).sqrt();
    assert!((sigma - 0.2).abs() < 0.02, "{sigma}");
    assert!(reach <= 1.5 + 1e-3 && reach > 1.4, "{reach}");
}
