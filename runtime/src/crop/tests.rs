use super::*;
use crate::frame::PixelFormat;
use crate::testing::{floats, golden_json, recipe};
use proptest::prelude::*;
use std::collections::BTreeMap;

/// Makes the output plain 0..255 values.
fn raw_values(crop: u16) -> ModelSpec {
    ModelSpec { crop, input_mean: [0.0; 3], input_std: [1.0 / 255.0; 3], ..ModelSpec::TOMP101 }
}

fn cut(frame: &FrameView<'_>, window: &Window) -> Vec<f32> {
    let mut out = vec![0.0; 3 * window.output() * window.output()];
    reference(frame, window, &raw_values(288), &mut out).unwrap();
    out
}

#[test]
fn all_reference_crops_are_met() {
    let mut pictures = BTreeMap::new();
    let mut worst = 0f64;
    let cases = golden_json("sample_patch_cases.json");
    let cases = cases.as_array().unwrap();
    assert_eq!(cases.len(), 66);
    for (i, case) in cases.iter().enumerate() {
        let hw = floats(&case["image_hw"]);
        let (h, w) = (hw[0] as usize, hw[1] as usize);
        let picture = pictures.entry((h, w)).or_insert_with(|| recipe(0, w, h));
        let frame = FrameView::rgb(picture, w, h).unwrap();
        let pos = floats(&case["pos_yx"]);
        let size = floats(&case["sample_sz"]);
        assert_eq!(size[0], size[1], "crops are square");
        let max = case["max_scale_change"].as_f64().unwrap_or(1.0) as f32;
        let border = match case["mode"].as_str().unwrap() {
            "replicate" => Border::Replicate,
            "inside" => Border::Inside { max_scale_change: max },
            "inside_major" => Border::InsideMajor { max_scale_change: max },
            other => panic!("unknown mode {other}"),
        };
        let side = case["output_sz"].as_u64().unwrap() as usize;
        let pos = Yx::new(pos[0] as f32, pos[1] as f32);
        let window = Window::new(&frame, pos, size[0] as f32, side, border).unwrap();

        let p = window.patch();
        let corners = [p.tl.y, p.tl.x, p.br.y, p.br.x];
        let want = floats(&case["patch_coord_y1x1y2x2"]);
        for (a, b) in corners.iter().zip(&want) {
            assert_eq!(f64::from(*a), *b, "case {i}: {corners:?} {want:?}");
        }
        let len = [window.y.len as f64, window.x.len as f64];
        assert_eq!(len[..], floats(&case["patch_hw"])[..], "case {i}: window");
        let image = [window.y.image as f64, window.x.image as f64];
        assert_eq!(image[..], floats(&case["downsampled_src_hw"])[..], "case {i}: picture");

        let out = cut(&frame, &window);
        let values = floats(&case["pixel_values"]);
        for (at, want) in case["pixels_at"].as_array().unwrap().iter().zip(values) {
            let at = floats(at);
            let index = (at[0] as usize * side + at[1] as usize) * side + at[2] as usize;
            let d = (f64::from(out[index]) - want).abs();
            assert!(d < 0.02, "case {i} at {at:?}: {} instead of {want}", out[index]);
            worst = worst.max(d);
        }
        let mean = out.iter().map(|&v| f64::from(v)).sum::<f64>() / out.len() as f64;
        let want = case["patch_mean"].as_f64().unwrap();
        assert!((mean - want).abs() < 1e-3, "case {i}: mean {mean} instead of {want}");
    }
    println!("largest difference over 66 crops: {worst:.6} grey levels");
    assert!(worst < 0.001, "{worst}");
}

#[test]
fn the_first_template_is_the_middle_of_the_double_crop() {
    let (w, h) = (203, 161);
    let picture = recipe(3, w, h);
    let frame = FrameView::rgb(&picture, w, h).unwrap();
    for crop in [48, 160] {
        let spec = raw_values(crop);
        let (side, half) = (usize::from(crop), usize::from(crop) / 2);
        for (y, x, scale) in [(80.0, 100.0, 0.7), (-5.0, 3.0, 1.3), (150.0, 210.0, 2.9)] {
            let pos = Yx::new(y, x);
            let window = Window::first(&frame, pos, scale, &spec).unwrap();
            let double = 2 * side;
            let whole = Window::new(&frame, pos, scale * double as f32, double, Border::Replicate);
            let (middle, whole) = (cut(&frame, &window), cut(&frame, &whole.unwrap()));
            for c in 0..3 {
                for r in 0..side {
                    let a = &middle[(c * side + r) * side..][..side];
                    let b = &whole[(c * double + r + half) * double + half..][..side];
                    assert_eq!(a, b, "crop {crop}, row {r}");
                }
            }
        }
    }
}

/// The same grey picture in every format gives the same crop.
#[test]
fn formats_agree_on_a_grey_picture() {
    let (w, h) = (64, 48);
    let luma: Vec<u8> = recipe(1, w, h).chunks_exact(3).map(|p| 16 + p[1] % 220).collect();
    // What the limited-range luma looks like in full range.
    let grey = |y: u8| (1.164_383_6 * (f32::from(y) - 16.0)).clamp(0.0, 255.0);
    let stride = 150;
    let mut nv12 = vec![0; stride * (h + h / 2)];
    let mut yuyv = vec![0; stride * h];
    let mut uyvy = vec![0; stride * h];
    let mut y16 = vec![0; stride * h];
    let mut y10 = vec![0; stride * h];
    let mut bgr = vec![0; 3 * w * h];
    for y in 0..h {
        for x in 0..w {
            let v = luma[y * w + x];
            nv12[y * stride + x] = v;
            yuyv[y * stride + 2 * x] = v;
            yuyv[y * stride + 2 * x + 1] = 128;
            uyvy[y * stride + 2 * x] = 128;
            uyvy[y * stride + 2 * x + 1] = v;
            let raw = 200 + 3 * u16::from(v);
            assert!(raw < 1024, "ten bits");
            y10[y * stride + 2 * x..][..2].copy_from_slice(&raw.to_le_bytes());
            let raw = 1000 + 20 * u16::from(v);
            y16[y * stride + 2 * x..][..2].copy_from_slice(&raw.to_le_bytes());
            bgr[3 * (y * w + x)..][..3].fill(v);
        }
    }
    nv12[h * stride..].fill(128);
    let view = |data, stride, format| FrameView::new(data, w, h, stride, format).unwrap();
    let frames = [
        (view(&nv12, stride, PixelFormat::Nv12), true),
        (view(&yuyv, stride, PixelFormat::Yuyv), true),
        (view(&uyvy, stride, PixelFormat::Uyvy), true),
        (view(&y10, stride, PixelFormat::Y16 { low: 200, high: 200 + 3 * 255 }), false),
        (view(&y16, stride, PixelFormat::Y16 { low: 1000, high: 1000 + 20 * 255 }), false),
        (view(&bgr, 3 * w, PixelFormat::Bgr8), false),
        (view(&bgr, 3 * w, PixelFormat::Rgb8), false),
    ];
    let grey_frame = view(&luma, w, PixelFormat::Gray8);
    let border = Border::InsideMajor { max_scale_change: 1.5 };
    let window = |f: &FrameView<'_>| Window::new(f, Yx::new(20.0, 30.0), 31.0, 48, border).unwrap();
    let want = cut(&grey_frame, &window(&grey_frame));
    for (frame, limited) in frames {
        let out = cut(&frame, &window(&frame));
        for (a, b) in out.iter().zip(&want) {
            let b = if limited { 1.164_383_6 * (b - 16.0) } else { *b };
            assert!((a - b).abs() < 0.01, "{:?}: {a} {b}", frame.format());
        }
    }
    assert!((grey(235) - 255.0).abs() < 0.01);
}

#[test]
fn colours_are_read_in_the_right_order() {
    // BT.601 limited range of pure red, green, blue: Y, U, V.
    for (rgb, yuv) in [
        ([255, 0, 0], [82u8, 90, 240]),
        ([0, 255, 0], [145, 54, 34]),
        ([0, 0, 255], [41, 240, 110]),
        ([255, 255, 255], [235, 128, 128]),
    ] {
        let rgb8: Vec<u8> = rgb.iter().copied().cycle().take(4 * 4 * 3).collect();
        let bgr8: Vec<u8> = rgb.iter().rev().copied().cycle().take(4 * 4 * 3).collect();
        let yuyv: Vec<u8> = [yuv[0], yuv[1], yuv[0], yuv[2]].into_iter().cycle().take(32).collect();
        let uyvy: Vec<u8> = [yuv[1], yuv[0], yuv[2], yuv[0]].into_iter().cycle().take(32).collect();
        let mut nv12 = vec![yuv[0]; 16];
        nv12.extend([yuv[1], yuv[2]].into_iter().cycle().take(8));
        for (data, stride, format) in [
            (&rgb8, 12, PixelFormat::Rgb8),
            (&bgr8, 12, PixelFormat::Bgr8),
            (&yuyv, 8, PixelFormat::Yuyv),
            (&uyvy, 8, PixelFormat::Uyvy),
            (&nv12, 4, PixelFormat::Nv12),
        ] {
            let frame = FrameView::new(data, 4, 4, stride, format).unwrap();
            let window =
                Window::new(&frame, Yx::new(1.0, 1.0), 4.0, 16, Border::Replicate).unwrap();
            let out = cut(&frame, &window);
            for (plane, want) in out.chunks_exact(256).zip(rgb) {
                assert!(plane.iter().all(|v| (v - want as f32).abs() < 2.5), "{format:?} {rgb:?}");
            }
        }
    }
}

#[test]
fn normalisation_follows_the_specification() {
    let frame = FrameView::gray(&[100; 16], 4, 4).unwrap();
    let window = Window::new(&frame, Yx::new(1.0, 1.0), 4.0, 16, Border::Replicate).unwrap();
    let mut out = vec![0.0; 3 * 256];
    reference(&frame, &window, &ModelSpec::NANO, &mut out).unwrap();
    for c in 0..3 {
        let (mean, std) = (ModelSpec::NANO.input_mean[c], ModelSpec::NANO.input_std[c]);
        assert!((out[c * 256] - (100.0 / 255.0 - mean) / std).abs() < 1e-6);
    }
    assert_eq!(
        reference(&frame, &window, &ModelSpec::NANO, &mut out[1..]).unwrap_err(),
        CropError::Output { len: 767, needed: 768 }
    );
}

#[test]
fn halves_round_to_even() {
    for (v, want) in [(0.5, 0.0), (1.5, 2.0), (2.5, 2.0), (-0.5, 0.0), (-1.5, -2.0), (2.6, 3.0)] {
        assert_eq!(round_half_even(v), want, "{v}");
    }
}

#[test]
fn senseless_positions_are_refused() {
    let frame = FrameView::gray(&[0; 4], 2, 2).unwrap();
    for (pos, size) in [
        (Yx::new(f32::NAN, 0.0), 1.0),
        (Yx::new(0.0, f32::INFINITY), 1.0),
        (Yx::default(), 0.0),
        (Yx::default(), f32::NAN),
    ] {
        let error = Window::new(&frame, pos, size, 16, Border::Replicate).unwrap_err();
        assert!(matches!(error, CropError::Position { .. }));
    }
}

/// A pixel of a picture, read by itself.
fn pixel(frame: &FrameView<'_>, y: usize, x: usize) -> [f32; 3] {
    let at = |i: usize| f32::from(frame.data()[i]);
    let line = y * frame.stride();
    let yuv = |y: f32, u: f32, v: f32| {
        let y = 1.164_383_6 * (y - 16.0);
        let (u, v) = (u - 128.0, v - 128.0);
        [y + 1.596_026_8 * v, y - 0.391_762_3 * u - 0.812_967_65 * v, y + 2.017_232_2 * u]
            .map(|v| v.clamp(0.0, 255.0))
    };
    let pair = line + x / 2 * 4;
    match frame.format() {
        PixelFormat::Rgb8 => [0, 1, 2].map(|c| at(line + 3 * x + c)),
        PixelFormat::Bgr8 => [2, 1, 0].map(|c| at(line + 3 * x + c)),
        PixelFormat::Gray8 => [at(line + x); 3],
        PixelFormat::Y16 { low, high } => {
            let (low, high) = (f32::from(low), f32::from(high));
            let raw = at(line + 2 * x) + 256.0 * at(line + 2 * x + 1);
            [(raw.clamp(low, high) - low) * 255.0 / (high - low); 3]
        }
        PixelFormat::Yuyv => yuv(at(line + 2 * x), at(pair + 1), at(pair + 3)),
        PixelFormat::Uyvy => yuv(at(line + 2 * x + 1), at(pair), at(pair + 2)),
        PixelFormat::Nv12 => {
            let chroma = (frame.height() + y / 2) * frame.stride() + x / 2 * 2;
            yuv(at(line + x), at(chroma), at(chroma + 1))
        }
    }
}

/// A number of the output, computed by itself in double precision.
fn single(frame: &FrameView<'_>, window: &Window, channel: usize, r: usize, c: usize) -> f64 {
    let taps = |axis: &Axis, i: usize| {
        let ratio = axis.len as f64 / window.side as f64;
        let source = (ratio * ((i + window.margin) as f64 + 0.5) - 0.5).max(0.0);
        let index = (source.floor() as i64).min(axis.len as i64 - 1);
        let at = |i: i64| {
            let inside = (axis.start + i.min(axis.len as i64 - 1)).clamp(0, axis.image as i64 - 1);
            axis.offset + window.decimation * inside as usize
        };
        (at(index), at(index + 1), source - index as f64)
    };
    let ((top, bottom, v), (left, right, h)) = (taps(&window.y, r), taps(&window.x, c));
    let at = |y, x| f64::from(pixel(frame, y, x)[channel]);
    let across = |y| (1.0 - h) * at(y, left) + h * at(y, right);
    (1.0 - v) * across(top) + v * across(bottom)
}

proptest! {
    /// Rows that are kept and stripes of any width give what every pixel by itself gives.
    #[test]
    fn every_format_is_sampled_as_pixel_by_pixel(
        (w, h) in (1usize..150, 1usize..60).prop_map(|(w, h)| (2 * w, 2 * h)),
        format in prop_oneof![
            Just(PixelFormat::Rgb8), Just(PixelFormat::Bgr8), Just(PixelFormat::Gray8),
            Just(PixelFormat::Y16 { low: 9000, high: 60000 }), Just(PixelFormat::Yuyv),
            Just(PixelFormat::Uyvy), Just(PixelFormat::Nv12),
        ],
        padding in 0usize..5,
        output in prop_oneof![1usize..8, 40..200usize],
        (y, x) in (-0.3f32..1.3, -0.3f32..1.3),
        size in prop_oneof![1f32..60.0, 60f32..900.0],
        replicate: bool,
    ) {
        let stride = format.row_bytes(w) + padding;
        let data: Vec<u8> = (0..stride * 2 * h).map(|i| (i * i / 7 + i * 31) as u8).collect();
        let frame = FrameView::new(&data, w, h, stride, format).unwrap();
        let border =
            if replicate { Border::Replicate } else { Border::InsideMajor { max_scale_change: 1.5 } };
        let centre = Yx::new(y * h as f32, x * w as f32);
        let window = Window::new(&frame, centre, size, output, border).unwrap();
        let out = cut(&frame, &window);
        for channel in 0..3 {
            for r in 0..output {
                for c in (0..output).step_by(1 + output / 20) {
                    let got = f64::from(out[(channel * output + r) * output + c]);
                    let want = single(&frame, &window, channel, r, c);
                    // A coordinate's own rounding moves the weights.
                    prop_assert!((got - want).abs() < 0.02, "{channel} {r} {c}: {got} {want}");
                }
            }
        }
    }

    /// Whatever is asked for, the sampler stays inside the buffer and returns picture values.
    #[test]
    fn any_crop_of_any_picture_is_computed(
        w in 1usize..40, h in 1usize..40,
        y in prop_oneof![-100f32..100.0, -1e30f32..1e30],
        x in prop_oneof![-100f32..100.0, -1e30f32..1e30],
        size in prop_oneof![0.01f32..300.0, 0.01f32..1e30],
        mode in 0..3,
    ) {
        let data: Vec<u8> = (0..w * h).map(|i| 50 + (i % 100) as u8).collect();
        let frame = FrameView::gray(&data, w, h).unwrap();
        let border = match mode {
            0 => Border::Replicate,
            1 => Border::InsideMajor { max_scale_change: 1.5 },
            _ => Border::Inside { max_scale_change: 1.5 },
        };
        let window = Window::new(&frame, Yx::new(y, x), size, 16, border).unwrap();
        let out = cut(&frame, &window);
        prop_assert!(out.iter().all(|v| (49.99..150.01).contains(v)));
    }

    /// A search area not larger than the picture lies inside it, up to the reference's extra row.
    #[test]
    fn search_areas_move_inside(y in -50f32..250.0, x in -50f32..350.0, size in 4f32..150.0) {
        let data = vec![0; 200 * 300];
        let frame = FrameView::gray(&data, 300, 200).unwrap();
        let border = Border::InsideMajor { max_scale_change: 1.5 };
        let window = Window::new(&frame, Yx::new(y, x), size, 288, border).unwrap();
        let p = window.patch();
        prop_assert!(p.tl.y >= -0.5 && p.tl.x >= -0.5 && p.br.y <= 200.5 && p.br.x <= 300.5);
        let scale = p.sample_scale(288.0);
        prop_assert!((scale * 288.0 - size).abs() < 1.6, "{} {}", scale * 288.0, size);
        // A box mapped to the image and back is the same.
        let image = p.to_image(&BBox::new(0.0, 0.0, 288.0, 288.0), 288.0);
        prop_assert!((image.x - p.tl.x).abs() < 1e-3 && (image.right() - p.br.x).abs() < 1e-3);
    }
}
