use super::profile::{Celsius, Rows};
use super::*;
use proptest::prelude::*;

fn bytes(values: &[u16]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn y16(data: &[u8], width: usize, height: usize) -> FrameView<'_> {
    let format = PixelFormat::Y16 { low: 0, high: u16::MAX };
    FrameView::new(data, width, height, width * 2, format).expect("view")
}

fn seconds(s: f64) -> Duration {
    Duration::from_secs_f64(s)
}

#[test]
fn buffers_are_taken_apart_by_camera() {
    let rows = |first, count| Rows { first, count };
    // profile, width, height, 16 bit; picture, data, telemetry rows, degrees at raw 29815.
    let kelvin = Some(25.0);
    for (profile, width, height, sixteen, picture, data, telemetry, celsius) in [
        (Profile::Generic, 320, 240, true, rows(0, 240), Some(rows(0, 240)), None, None),
        (Profile::Generic, 320, 240, false, rows(0, 240), None, None, None),
        (Profile::Lepton, 160, 120, true, rows(0, 120), Some(rows(0, 120)), None, kelvin),
        (
            Profile::Lepton,
            160,
            122,
            true,
            rows(0, 120),
            Some(rows(0, 120)),
            Some(rows(120, 2)),
            kelvin,
        ),
        (Profile::Lepton, 80, 63, true, rows(0, 60), Some(rows(0, 60)), Some(rows(60, 3)), kelvin),
        (Profile::Lepton, 160, 120, false, rows(0, 120), None, None, None),
        (
            Profile::Boson,
            640,
            514,
            true,
            rows(0, 512),
            Some(rows(0, 512)),
            Some(rows(512, 2)),
            None,
        ),
        (Profile::Boson, 320, 256, true, rows(0, 256), Some(rows(0, 256)), None, None),
        (Profile::P2, 256, 384, false, rows(0, 192), Some(rows(192, 192)), None, Some(192.709)),
        (
            Profile::P2,
            256,
            386,
            false,
            rows(0, 192),
            Some(rows(192, 192)),
            Some(rows(384, 2)),
            Some(192.709),
        ),
        (Profile::P2, 256, 384, true, rows(192, 192), Some(rows(192, 192)), None, Some(192.709)),
        (Profile::P2, 256, 192, false, rows(0, 192), None, None, None),
    ] {
        let what = format!("{profile:?} {width} x {height}");
        let layout = profile.layout(width, height, sixteen, u16::MAX).expect(&what);
        assert_eq!((layout.rows, layout.data), (picture, data), "{what}");
        assert_eq!(layout.telemetry.map(|t| t.0), telemetry, "{what}");
        let got = layout.celsius.map(|c: Celsius| c.from_raw(29815.0));
        assert_eq!(got.is_some(), celsius.is_some(), "{what}");
        if let (Some(a), Some(b)) = (got, celsius) {
            assert!((a - b).abs() < 0.01, "{what}: {a}");
        }
    }
    for (profile, width, height, sixteen) in [
        (Profile::Lepton, 160, 121, true),
        (Profile::Boson, 640, 480, true),
        (Profile::P2, 320, 240, false),
    ] {
        let error = profile.layout(width, height, sixteen, u16::MAX).expect_err("refused");
        assert!(error.to_string().contains(&format!("{width} x {height}")), "{error}");
    }
}

#[test]
fn the_lepton_says_when_its_shutter_is_closed() {
    let layout = Profile::Lepton.layout(160, 122, true, u16::MAX).expect("layout");
    let mut thermal = Thermal::new(layout, AgcOptions::default()).expect("thermal");
    let mut values = vec![29_815u16; 160 * 122];
    for (status, shutter) in [(0u16, false), (1 << 4, false), (2 << 4, true), (3 << 4, false)] {
        values[160 * 120 + 3] = status;
        values[160 * 120 + 20] = 0x5678;
        values[160 * 120 + 21] = 0x12;
        let data = bytes(&values);
        let got = thermal.follow(&y16(&data, 160, 122), seconds(1.0), false).expect("follows");
        assert_eq!(got, Status { shutter, counter: Some(0x12_5678) }, "{status:#x}");
    }
    let data = bytes(&values);
    assert_eq!(thermal.picture(&y16(&data, 160, 122)).expect("picture").height(), 120);
}

#[test]
fn the_lepton_says_whether_it_measures_temperatures() {
    let celsius = Some(Celsius { scale: 0.1, offset: -273.15 });
    for (width, rows, height) in [(160, 120, 122), (80, 60, 63)] {
        let plain = Profile::Lepton.layout(width, height, true, u16::MAX).expect("layout");
        let stated = plain.with_celsius(celsius);
        let mut values = vec![2_981u16; width * height];
        // on, resolution; degrees by the telemetry
        for (on, resolution, degrees) in
            [(0, 0, None), (0, 1, None), (1, 0, Some(24.95)), (1, 1, Some(-243.34)), (7, 1, None)]
        {
            values[width * rows + 208] = on;
            values[width * rows + 209] = resolution;
            let data = bytes(&values);
            let measure = |layout| {
                let thermal = Thermal::new(layout, AgcOptions::default()).expect("thermal");
                let at = BBox::new(20.0, 20.0, 10.0, 10.0);
                thermal.temperature(&y16(&data, width, height), &at).map(|t| t.mean)
            };
            let got = measure(plain);
            assert_eq!(got.is_some(), degrees.is_some(), "{width}: {on} {resolution}");
            assert!(
                got.zip(degrees).is_none_or(|(a, b): (f32, f32)| (a - b).abs() < 0.01),
                "{width}: {on} {resolution}: {got:?}"
            );
            let by_hand = measure(stated).expect("stated");
            assert!((by_hand - 24.95).abs() < 0.01, "{width}: {on} {resolution}: {by_hand}");
        }
        // Nobody says it without telemetry.
        let bare = Profile::Lepton.layout(width, rows, true, u16::MAX).expect("layout");
        let thermal = Thermal::new(bare, AgcOptions::default()).expect("thermal");
        let data = bytes(&values[..width * rows]);
        assert_eq!(
            thermal.temperature(&y16(&data, width, rows), &BBox::new(9.0, 9.0, 9.0, 9.0)),
            None
        );
        let grey = Profile::Lepton.layout(width, rows, false, 255).expect("layout");
        assert_eq!(grey.with_celsius(celsius), grey, "8 bits are no temperatures");
    }
}

#[test]
fn limits_follow_slowly_and_stand_still_behind_the_shutter() {
    let layout = Profile::Lepton.layout(160, 122, true, u16::MAX).expect("layout");
    let mut thermal = Thermal::new(layout, AgcOptions::default()).expect("thermal");
    let scene = |low: u16, shutter: bool| {
        let mut v: Vec<u16> = (0..160 * 122).map(|i| low + (i % 1000) as u16).collect();
        v[160 * 120..].fill(0);
        v[160 * 120 + 3] = u16::from(shutter) << 5;
        bytes(&v)
    };
    let mut follow = |data: &[u8], t: f64| {
        thermal.follow(&y16(data, 160, 122), seconds(t), false).expect("follows");
        thermal.agc.limits()
    };
    let first = follow(&scene(29_000, false), 0.1);
    assert!(first.0.abs_diff(29_005) <= 3 && first.1.abs_diff(29_994) <= 3, "{first:?}");
    assert_eq!(follow(&scene(40_000, true), 0.2), first, "the shutter is no scene");
    let second = follow(&scene(31_000, false), 0.2 + 0.7 / 100.0);
    assert!(second.0.abs_diff(first.0 + 20) <= 3, "1 % of the time constant: {second:?}");
    let third = follow(&scene(31_000, false), 9.0);
    assert!(third.0.abs_diff(31_005) <= 3, "{third:?}");
}

#[test]
fn a_flat_scene_is_not_blown_up_and_a_window_is_kept() {
    let layout = Profile::Lepton.layout(160, 120, true, u16::MAX).expect("layout");
    let data = bytes(&[29_815; 160 * 120]);
    let mut thermal = Thermal::new(layout, AgcOptions::default()).expect("thermal");
    thermal.follow(&y16(&data, 160, 120), seconds(0.1), false).expect("follows");
    assert_eq!(thermal.agc.limits(), (29_565, 30_065), "5 K");
    let window = Some(Window { low: 0.0, high: 100.0 });
    let mut fixed =
        Thermal::new(layout, AgcOptions { window, ..AgcOptions::default() }).expect("window");
    fixed.follow(&y16(&data, 160, 120), seconds(0.1), false).expect("follows");
    assert_eq!(fixed.agc.limits(), (27_315, 37_315));
}

#[test]
fn senseless_options_are_refused() {
    let layout = Profile::Lepton.layout(160, 120, true, u16::MAX).expect("layout");
    let base = AgcOptions::default();
    for (options, key) in [
        (AgcOptions { clip: 0.6, ..base }, "agc.clip"),
        (AgcOptions { clip: f64::NAN, ..base }, "agc.clip"),
        (AgcOptions { time_s: -1.0, ..base }, "agc.time_s"),
        (AgcOptions { min_span: Some(0.0), ..base }, "agc.min_span"),
        (AgcOptions { window: Some(Window { low: 30.0, high: 30.0 }), ..base }, "agc.window"),
    ] {
        let error = Thermal::new(layout, options).expect_err(key).to_string();
        assert!(error.contains(key), "{error}");
    }
}

#[test]
fn the_targets_temperature_is_read_from_the_data_rows() {
    let layout = Profile::P2.layout(256, 384, false, u16::MAX).expect("layout");
    let thermal = Thermal::new(layout, AgcOptions::default()).expect("thermal");
    let raw = |c: f64| ((c + 273.15) * 64.0).round() as u16;
    let mut values = vec![0x8010u16; 256 * 192];
    values.extend((0..256 * 192).map(|i| {
        let (x, y) = (i % 256, i / 256);
        if (100..120).contains(&x) && (50..70).contains(&y) { raw(36.5) } else { raw(20.0) }
    }));
    values[256 * (192 + 60) + 110] = raw(40.0);
    let data = bytes(&values);
    let whole = FrameView::new(&data, 256, 384, 512, PixelFormat::Yuyv).expect("view");
    let t = thermal.temperature(&whole, &BBox::new(100.0, 50.0, 20.0, 20.0)).expect("measures");
    assert!((t.mean - 36.535).abs() < 0.02 && (t.max - 40.0).abs() < 0.02, "{t:?}");
    let off = thermal.temperature(&whole, &BBox::new(-500.0, 900.0, 20.0, 20.0)).expect("edge");
    assert!((off.mean - 20.0).abs() < 0.02, "{off:?}");
    assert_eq!(thermal.picture(&whole).expect("picture").height(), 192);
}

proptest! {
    /// Whatever the pictures and times are, the limits are a range no smaller than the minimum.
    #[test]
    fn limits_are_always_a_range(
        pictures in prop::collection::vec((any::<u16>(), any::<u16>(), 0f64..5.0), 1..12),
        clip in 0f64..0.25, time_s in 0f64..3.0, full in 1023u16..,
    ) {
        let layout = Profile::Generic.layout(20, 10, true, full).expect("layout");
        let options = AgcOptions { clip, time_s, ..AgcOptions::default() };
        let mut agc = Agc::new(&layout, options).expect("agc");
        let mut t = 0.0;
        for (a, b, dt) in pictures {
            t += dt;
            let (a, b) = (a.min(full), b.min(full));
            let values: Vec<u16> = (0..200).map(|i| if i % 3 == 0 { a } else { b }).collect();
            agc.follow(&y16(&bytes(&values), 20, 10), seconds(t));
            let (low, high) = agc.limits();
            prop_assert!(low < high && high <= full, "{low} {high} {full}");
            prop_assert!(f64::from(high - low) >= f64::from(full) / 256.0 - 1.0);
        }
    }
}
