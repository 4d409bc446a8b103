use super::*;
use proptest::prelude::*;

const TARGET: BBox = BBox::new(140.0, 90.0, 40.0, 30.0);

/// A dark picture with a bright target in both sensors (exactly on the box), and a slow ramp.
fn still(width: usize, height: usize) -> Arc<RegisteredStill> {
    let inside = |x: usize, y: usize| {
        let (x, y) = (x as f32 + 0.5, y as f32 + 0.5);
        x > TARGET.x && x < TARGET.right() && y > TARGET.y && y < TARGET.bottom()
    };
    let value = |i: usize| {
        let (x, y) = (i % width, i / width);
        if inside(x, y) { 220 } else { (20 + x * 40 / width) as u8 }
    };
    let grey: Vec<u8> = (0..width * height).map(value).collect();
    let rgb = grey.iter().flat_map(|&v| [v; 3]).collect();
    let picture = |channels, data| Picture { width, height, channels, data };
    Arc::new(RegisteredStill::new("s", picture(3, rgb), picture(1, grey)).unwrap())
}

fn clip(options: PseudoOptions) -> PseudoClip {
    PseudoClip::new(still(400, 300), 0, TARGET, options).unwrap()
}

/// Bounding box of bright pixels of one channel.
fn bright(p: &Picture) -> BBox {
    let (mut x0, mut y0, mut x1, mut y1) = (p.width, p.height, 0, 0);
    for (i, pixel) in p.data.chunks_exact(p.channels).enumerate() {
        if pixel[0] > 125 {
            let (x, y) = (i % p.width, i / p.width);
            (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1));
        }
    }
    BBox::new(x0 as f32, y0 as f32, (x1 - x0) as f32, (y1 - y0) as f32)
}

#[test]
fn the_truth_lies_where_the_target_is_drawn_in_both_sensors() {
    let clip = clip(PseudoOptions { noise: 2.0, ..PseudoOptions::default() });
    for frame in (0..clip.frames()).step_by(7) {
        let truth = clip.truth(0, frame, Modality::Rgb).unwrap();
        for modality in [Modality::Rgb, Modality::Thermal] {
            assert_eq!(clip.truth(0, frame, modality), Some(truth));
            let p = clip.picture(frame, modality).unwrap();
            assert_eq!((p.width, p.height), (320, 256));
            assert_eq!(p.channels, if modality == Modality::Rgb { 3 } else { 1 });
            let found = bright(&p);
            let off = [
                found.x - truth.x,
                found.y - truth.y,
                found.right() - truth.right(),
                found.bottom() - truth.bottom(),
            ];
            assert!(off.iter().all(|d| d.abs() <= 1.0), "frame {frame}: {found:?} {truth:?}");
        }
    }
}

#[test]
fn the_target_moves_smoothly_and_far_and_changes_size() {
    for seed in 0..8 {
        let clip = clip(PseudoOptions { seed, ..PseudoOptions::default() });
        let boxes: Vec<BBox> =
            (0..60).map(|f| clip.truth(0, f, Modality::Thermal).unwrap()).collect();
        for pair in boxes.windows(2) {
            let ((ax, ay), (bx, by)) = (pair[0].centre(), pair[1].centre());
            assert!((ax - bx).hypot(ay - by) < 30.0, "seed {seed}: {pair:?}");
            assert!((pair[1].w / pair[0].w - 1.0).abs() < 0.06, "seed {seed}: {pair:?}");
        }
        let spread = |get: fn(&BBox) -> f32| {
            let values = boxes.iter().map(get);
            values.clone().fold(f32::MIN, f32::max) - values.fold(f32::MAX, f32::min)
        };
        assert!(spread(|b| b.centre().0) > 60.0, "seed {seed}");
        let ratio = boxes.iter().map(|b| b.w).fold(f32::MIN, f32::max)
            / boxes.iter().map(|b| b.w).fold(f32::MAX, f32::min);
        assert!((1.1..=1.7).contains(&ratio), "seed {seed}: {ratio}");
    }
}

#[test]
fn clips_follow_their_seed_and_no_two_frames_are_alike() {
    let a = clip(PseudoOptions::default());
    let again = clip(PseudoOptions::default());
    let other = clip(PseudoOptions { seed: 1, ..PseudoOptions::default() });
    let rgb = |c: &PseudoClip, f| c.picture(f, Modality::Rgb).unwrap();
    assert_eq!(rgb(&a, 5), rgb(&again, 5));
    assert_ne!(a.truth(0, 5, Modality::Rgb), other.truth(0, 5, Modality::Rgb));
    // Even a still window: no zoom and no room to pan.
    let options = PseudoOptions { zoom: 1.0, width: 400, height: 300, ..PseudoOptions::default() };
    let still_window = clip(options);
    assert_ne!(rgb(&still_window, 5).data, rgb(&still_window, 6).data);
}

#[test]
fn stills_that_do_not_fit_are_refused() {
    let picture =
        |w, h, channels| Picture { width: w, height: h, channels, data: vec![0; w * h * channels] };
    for (rgb, thermal) in [
        (picture(8, 6, 3), picture(8, 7, 1)),
        (picture(8, 6, 1), picture(8, 6, 1)),
        (picture(8, 6, 3), picture(8, 6, 3)),
        (picture(1, 1, 3), picture(1, 1, 1)),
        (Picture { data: vec![0; 3], ..picture(8, 6, 3) }, picture(8, 6, 1)),
    ] {
        let e = RegisteredStill::new("x", rgb, thermal).unwrap_err();
        assert!(matches!(e, PseudoError::Pictures { .. }) && e.to_string().contains("still x"));
    }
    let still = still(400, 300);
    for bbox in [BBox::new(401.0, 0.0, 5.0, 5.0), BBox::new(0.0, 0.0, 0.0, 5.0)] {
        let e = PseudoClip::new(still.clone(), 0, bbox, PseudoOptions::default()).unwrap_err();
        assert!(matches!(e, PseudoError::Target { .. }), "{e}");
    }
    let default = PseudoOptions::default();
    for (field, bad) in [
        ("frames", PseudoOptions { frames: 0, ..default }),
        ("width", PseudoOptions { width: 3, ..default }),
        ("zoom", PseudoOptions { zoom: 0.5, ..default }),
        ("noise", PseudoOptions { noise: f64::NAN, ..default }),
        ("max_share", PseudoOptions { max_share: 0.0, ..default }),
    ] {
        let e = PseudoClip::new(still.clone(), 0, TARGET, bad).unwrap_err().to_string();
        assert!(e.contains(field), "{e}");
    }
    let e = clip(default).picture(60, Modality::Rgb);
    assert!(matches!(e, Err(DatasetError::NoSuchFrame { frame: 60, .. })));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn windows_stay_inside_the_still_and_keep_the_target(
        (w, h) in (200usize..700, 150usize..600),
        (x, y) in (0.0f32..0.95, 0.0f32..0.95),
        (bw, bh) in (4f32..60.0, 4f32..60.0),
        seed in any::<u64>(),
    ) {
        let grey = |c| Picture { width: w, height: h, channels: c, data: vec![0; w * h * c] };
        let still = Arc::new(RegisteredStill::new("p", grey(3), grey(1)).unwrap());
        let bbox = BBox::new(x * (w as f32 - bw), y * (h as f32 - bh), bw, bh);
        let options = PseudoOptions { seed, ..PseudoOptions::default() };
        let clip = PseudoClip::new(still, 0, bbox, options).unwrap();
        for f in 0..60 {
            let v = clip.window(f);
            prop_assert!(v.left >= 0.0 && v.left + 320.0 * v.zoom <= w as f64 + 1e-6);
            prop_assert!(v.top >= 0.0 && v.top + 256.0 * v.zoom <= h as f64 + 1e-6);
            let t = clip.truth(0, f, Modality::Rgb).unwrap();
            let (cx, cy) = t.centre();
            prop_assert!((0.0..=320.0).contains(&cx) && (0.0..=256.0).contains(&cy), "{:?}", t);
        }
    }
}
