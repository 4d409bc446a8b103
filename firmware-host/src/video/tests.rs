use super::*;
use crate::picture::Picture;
use crate::track::Step;
use tsda_runtime::{BBox, FrameView, Modality, PixelFormat, TrackState};

fn step(frame: usize, modality: Modality) -> Step {
    Step {
        frame,
        name: "a</script>b.png".into(),
        modality,
        bbox: BBox::new(20.0, 30.0, 40.0, 50.0),
        score: 0.8,
        confidence: None,
        state: TrackState::Tracking,
        ms: 1.0,
    }
}

fn grey(width: usize, height: usize) -> Picture {
    let mut p = Picture::default();
    p.reset(width, height, 1);
    p
}

#[test]
fn every_format_shows_the_same_picture() {
    let (w, h) = (4, 2);
    let red = [200u8, 30, 40];
    let bgr: Vec<u8> = [40u8, 30, 200].repeat(8);
    // BT.601 limited range of that red.
    let (y, u, v) = (86u8, 107u8, 202u8);
    let yuyv = [y, u, y, v].repeat(4);
    let uyvy = [u, y, v, y].repeat(4);
    let nv12 = [vec![y; 8], [u, v].repeat(2)].concat();
    for (data, format) in [
        (red.repeat(8), PixelFormat::Rgb8),
        (bgr, PixelFormat::Bgr8),
        (yuyv, PixelFormat::Yuyv),
        (uyvy, PixelFormat::Uyvy),
        (nv12, PixelFormat::Nv12),
    ] {
        let view = FrameView::new(&data, w, h, format.row_bytes(w), format).expect("view");
        let mut out = Picture::default();
        assert_eq!(scaled(&view, w, &mut out), 1.0);
        for pixel in out.data.chunks_exact(3) {
            for (a, b) in pixel.iter().zip(red) {
                assert!(a.abs_diff(b) <= 6, "{format:?}: {pixel:?}");
            }
        }
    }
    let raw: Vec<u8> = [1000u16, 1500, 2000, 9000].iter().flat_map(|v| v.to_le_bytes()).collect();
    let format = PixelFormat::Y16 { low: 1000, high: 2000 };
    let mut out = Picture::default();
    scaled(&FrameView::new(&raw, 4, 1, 8, format).expect("view"), 4, &mut out);
    assert_eq!([out.data[0], out.data[3], out.data[6], out.data[9]], [0, 127, 255, 255]);
}

#[test]
fn scaling_keeps_shape_and_mean() {
    let mut p = grey(90, 60);
    p.data.iter_mut().enumerate().for_each(|(i, v)| *v = (i % 90) as u8);
    for width in [30, 45, 89, 90, 91, 180] {
        let mut out = Picture::default();
        let scale = scaled(&p.view().expect("view"), width, &mut out);
        assert_eq!((out.width, out.height), (width, (60.0 * scale + 0.5) as usize));
        let mean = out.data.iter().map(|v| f32::from(*v)).sum::<f32>() / out.data.len() as f32;
        assert!((mean - 44.5).abs() < 1.0, "{width}: {mean}");
    }
}

#[test]
fn a_box_is_drawn_on_its_edges_only() {
    let mut p = Picture::default();
    p.reset(40, 30, 3);
    outline(&mut p, &BBox::new(5.0, 6.0, 10.0, 12.0), [9, 8, 7], 1);
    let lit = |x: usize, y: usize| p.rgb(x, y) == [9, 8, 7];
    assert!(lit(5, 6) && lit(14, 6) && lit(5, 17) && lit(14, 17) && lit(10, 6));
    assert!(!lit(10, 10) && !lit(4, 6) && !lit(15, 6) && !lit(5, 18));
    // Partly and wholly outside: clipped, no panic.
    for b in [
        BBox::new(-5.0, -5.0, 10.0, 10.0),
        BBox::new(1e9, 1e9, 5.0, 5.0),
        BBox::new(-1e30, 0.0, 2e30, 10.0),
        BBox::new(f32::NAN, 0.0, 1.0, 1.0),
    ] {
        outline(&mut p, &b, [1, 1, 1], 2);
    }
}

#[test]
fn overlay_shows_sensor_and_score() {
    let p = grey(320, 200);
    let view = p.view().expect("view");
    let mut overlay = Overlay::new(Limits { min: 320, max: 480 }, Some(2));
    let mut draw = |i, m| overlay.draw(&view, &step(i, m), None).clone();
    let (rgb, thermal) = (draw(0, Modality::Rgb), draw(1, Modality::Thermal));
    assert!(rgb.height > 200, "there is a line of scores below the picture");
    let close = |a: [u8; 3], b: [u8; 3]| a.iter().zip(b).all(|(a, b)| a.abs_diff(b) < 40);
    assert!(close(rgb.rgb(1, 1), sensor_colour(Modality::Rgb)));
    assert!(close(thermal.rgb(1, 1), sensor_colour(Modality::Thermal)));
    // The second half of the line below turned from empty to the colour of the second sensor.
    assert_ne!(rgb.rgb(300, 201), thermal.rgb(300, 201));
}

#[test]
fn glyphs_are_all_different() {
    let signs: Vec<char> = ('A'..='Z').chain('0'..='9').chain(".,:-+/%=()><_#".chars()).collect();
    for (i, a) in signs.iter().enumerate() {
        assert!(font::glyph(*a).iter().any(|r| *r != 0), "{a}");
        assert!(font::glyph(*a).iter().all(|r| *r < 32), "{a}");
        for b in &signs[i + 1..] {
            assert_ne!(font::glyph(*a), font::glyph(*b), "{a} {b}");
        }
    }
    assert_eq!(font::glyph('q'), font::glyph('Q'));
    assert_eq!(font::glyph('é'), [0; 7]);
}

#[test]
fn base64_is_rfc_4648() {
    for (plain, coded) in
        [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")]
    {
        assert_eq!(html::base64(plain.as_bytes()), coded);
    }
    assert_eq!(html::base64(&[0xFB, 0xFF]), "+/8=");
}

#[test]
fn a_file_name_cannot_break_out_of_the_page() {
    let dir = tempfile::tempdir().expect("temp");
    let path = dir.path().join("p.html");
    let mut page = open(&path, None).expect("page");
    let p = grey(16, 16);
    page.frame(&p.view().expect("view"), &step(0, Modality::Rgb), None).expect("frame");
    page.finish().expect("finish");
    let text = std::fs::read_to_string(path).expect("read");
    assert_eq!(text.matches("</script>").count(), 1);
    assert!(text.contains("a\\u003c/script>b.png"));
}

/// A strip of a long clip stays small and shows the first frame after each switch.
#[test]
fn a_strip_takes_eight_frames_of_any_clip() {
    for frames in [1, 5, 8, 9, 300] {
        let dir = tempfile::tempdir().expect("temp");
        let path = dir.path().join("s.png");
        let mut strip = open(&path, None).expect("strip");
        let p = grey(32, 16);
        for i in 0..frames {
            let m = if i < 150 { Modality::Rgb } else { Modality::Thermal };
            strip.frame(&p.view().expect("view"), &step(i, m), None).expect("frame");
        }
        strip.finish().expect("finish");
        let sheet = image::open(path).expect("png");
        let across = frames.min(4) as u32;
        let down = frames.div_ceil(4).min(2) as u32;
        assert_eq!((sheet.width(), sheet.height()), (across * 324 - 4, down * 164 - 4), "{frames}");
    }
}

#[test]
fn unknown_kinds_are_refused() {
    let e = open("x.mp4".as_ref(), None).err().expect("refused");
    assert!(e.to_string().contains(".gif"), "{e}");
    assert_eq!(e.exit_code(), 2);
}
