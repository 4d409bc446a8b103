use super::*;
use crate::picture::Picture;
use proptest::prelude::*;
use std::cmp::Ordering;
use std::fs;
use std::io::Cursor;
use std::path::Path;
use tsda_runtime::{BBox, PixelFormat};

#[test]
fn numbers_are_compared_by_value() {
    let mut names = vec!["f10.png", "f9.png", "F1.png", "f010.png", "e2", "f"];
    names.sort_by(|a, b| natural_cmp(a, b));
    assert_eq!(names, ["e2", "f", "F1.png", "f9.png", "f010.png", "f10.png"]);
    let long = "9".repeat(60);
    assert_eq!(natural_cmp(&format!("a{long}"), &format!("a1{long}")), Ordering::Less);
}

proptest! {
    #[test]
    fn natural_order_is_total(a in "[a-cA-C0-3]{0,6}", b in "[a-cA-C0-3]{0,6}", c in "[a-cA-C0-3]{0,6}") {
        prop_assert_eq!(natural_cmp(&a, &b), natural_cmp(&b, &a).reverse());
        prop_assert_eq!(natural_cmp(&a, &b) == Ordering::Equal, a == b);
        if natural_cmp(&a, &b).is_le() && natural_cmp(&b, &c).is_le() {
            prop_assert!(natural_cmp(&a, &c).is_le());
        }
    }

    #[test]
    fn no_header_makes_the_parser_panic(line in "(YUV4MPEG2 )?[ -~é]{0,60}") {
        let _ = Y4mHeader::parse(&line);
    }
}

fn png(path: &Path, width: u32, height: u32, colour: [u8; 3]) {
    image::RgbImage::from_pixel(width, height, image::Rgb(colour)).save(path).expect("png");
}

fn all(source: &mut dyn FrameSource) -> Result<Vec<(String, Modality, usize)>, SourceError> {
    let mut out = Vec::new();
    while let Some(f) = source.next_frame()? {
        assert_eq!(f.index, out.len());
        out.push((f.name.to_owned(), f.modality, f.view.width()));
    }
    Ok(out)
}

#[test]
fn a_folder_gives_its_pictures_in_natural_order() {
    let dir = tempfile::tempdir().expect("temp");
    for (name, width) in [("f10.png", 30), ("f2.png", 20), ("f1.PNG", 10)] {
        png(&dir.path().join(name), width, 8, [200, 10, 10]);
    }
    fs::write(dir.path().join("notes.txt"), "x").expect("write");
    let mut source = PictureFiles::folder(dir.path()).expect("folder");
    assert_eq!(source.len_hint(), Some(3));
    let frames = all(&mut source).expect("frames");
    assert_eq!(frames.iter().map(|f| f.2).collect::<Vec<_>>(), [10, 20, 30]);
    assert!(frames.iter().all(|f| f.1 == Modality::Rgb));
}

#[test]
fn the_sensor_is_told_by_tag_then_folder_then_pixels() {
    let dir = tempfile::tempdir().expect("temp");
    for sub in ["infrared", "visible", "x"] {
        fs::create_dir(dir.path().join(sub)).expect("mkdir");
    }
    png(&dir.path().join("infrared/a.png"), 8, 8, [200, 10, 10]);
    png(&dir.path().join("visible/a.png"), 8, 8, [90, 90, 90]);
    png(&dir.path().join("x/grey.png"), 8, 8, [90, 91, 92]);
    png(&dir.path().join("x/red.png"), 8, 8, [200, 10, 10]);
    png(&dir.path().join("x/thermal_3.png"), 8, 8, [200, 10, 10]);
    image::GrayImage::new(8, 8).save(dir.path().join("x/one.png")).expect("png");
    let list = dir.path().join("list.txt");
    let text = "# a clip\ninfrared/a.png\nvisible/a.png\r\n\nx/grey.png\nx/red.png\nx/thermal_3.png\n\
                x/one.png\nx/red.png\tthermal\ninfrared/a.png\tRGB\n";
    fs::write(&list, text).expect("write");
    use Modality::{Rgb, Thermal};
    let sensors: Vec<Modality> = all(&mut PictureFiles::list(&list).expect("list"))
        .expect("frames")
        .iter()
        .map(|f| f.1)
        .collect();
    assert_eq!(sensors, [Thermal, Rgb, Thermal, Rgb, Thermal, Thermal, Thermal, Rgb]);
}

#[test]
fn sixteen_bits_are_read_without_conversion() {
    let dir = tempfile::tempdir().expect("temp");
    let path = dir.path().join("raw.png");
    image::ImageBuffer::from_fn(100, 1, |x, _| image::Luma([3000u16 + x as u16]))
        .save(&path)
        .expect("png");
    let mut source = PictureFiles::new(vec![Listed { path, modality: None }]);
    let frame = source.next_frame().expect("read").expect("frame");
    assert_eq!(frame.modality, Modality::Thermal);
    assert_eq!(frame.view.format(), PixelFormat::Y16 { low: 3001, high: 3099 });
    assert_eq!(&frame.view.data()[..4], &[0xB8, 0x0B, 0xB9, 0x0B]);
}

#[test]
fn broken_lists_and_pictures_name_file_and_line() {
    let dir = tempfile::tempdir().expect("temp");
    let at = |name: &str| dir.path().join(name);
    png(&at("good.png"), 40, 40, [1, 2, 3]);
    let bytes = fs::read(at("good.png")).expect("read");
    fs::write(at("short.png"), &bytes[..bytes.len() / 2]).expect("write");
    fs::write(at("empty.jpg"), "").expect("write");
    fs::write(at("text.jpg"), "hello, this is text").expect("write");
    let mut zero = vec![0u8; 54];
    zero[..2].copy_from_slice(b"BM");
    (zero[10], zero[14], zero[26], zero[28]) = (54, 40, 1, 24);
    fs::write(at("zero.bmp"), zero).expect("write");
    for (text, want) in [
        ("good.png\nmissing.png\n", "list.txt, line 2: there is no file"),
        ("good.png\tradar\n", "line 1: sensor \"radar\""),
        ("\n# only a comment\n", "list.txt: the list names no picture"),
        ("short.png\n", "short.png: not a picture"),
        ("empty.jpg\n", "empty.jpg: not a picture that can be read: the file is empty"),
        ("text.jpg\n", "text.jpg: not a picture"),
        ("zero.bmp\n", "zero.bmp"),
    ] {
        fs::write(at("list.txt"), text).expect("write");
        let e = PictureFiles::list(&at("list.txt")).and_then(|mut s| all(&mut s)).expect_err(text);
        assert!(e.to_string().contains(want), "{text:?}: {e}");
    }
    fs::write(at("list.txt"), [0xFF, 0xFE, 0x00]).expect("write");
    assert!(
        PictureFiles::list(&at("list.txt")).expect_err("bytes").to_string().contains("text list")
    );
    fs::create_dir_all(at("seq/visible")).expect("mkdir");
    let e = PictureFiles::folder(&at("seq")).expect_err("sequence").to_string();
    assert!(e.contains("it has visible"), "{e}");
}

#[test]
fn boxes_are_read_as_people_write_them() {
    for (text, want) in [
        ("1,2,3,4", BBox::new(1.0, 2.0, 3.0, 4.0)),
        (" 1.5\t2  3 , 4 ", BBox::new(1.5, 2.0, 3.0, 4.0)),
        ("-1;2;3;4", BBox::new(-1.0, 2.0, 3.0, 4.0)),
        ("0,0,10,0,10,5,0,5", BBox::new(0.0, 0.0, 10.0, 5.0)),
    ] {
        assert_eq!(parse_box(text), Ok(want), "{text}");
    }
    for (text, want) in [("1,2,3", "3 numbers"), ("", "0 numbers"), ("a,2,3,4", "\"a\"")] {
        assert!(parse_box(text).expect_err(text).contains(want), "{text}");
    }
}

#[test]
fn the_first_box_is_found_beside_the_frames() {
    let dir = tempfile::tempdir().expect("temp");
    let frames = dir.path().join("visible");
    fs::create_dir(&frames).expect("mkdir");
    assert_eq!(find_init(&frames).expect("none"), None);
    for (name, x) in [("init.txt", 1.0), ("visible.txt", 2.0), ("visible/groundtruth.txt", 3.0)] {
        fs::write(dir.path().join(name), format!("{x},2,3,4\n9,9,9,9\n")).expect("write");
        let (path, b) = find_init(&frames).expect("read").expect("found");
        assert_eq!((path.ends_with(name), b.x), (true, x), "{}", path.display());
    }
    fs::write(dir.path().join("visible/groundtruth.txt"), "oops\n").expect("write");
    let e = find_init(&frames).expect_err("unreadable").to_string();
    assert!(e.contains("groundtruth.txt, line 1"), "{e}");
}

/// A stream of one 4 x 2 frame with these planes.
fn y4m(header: &str, planes: &[&[u8]]) -> Vec<u8> {
    let mut bytes = format!("{header}\nFRAME\n").into_bytes();
    planes.iter().for_each(|p| bytes.extend_from_slice(p));
    bytes
}

#[test]
fn y4m_planes_arrive_where_the_format_wants_them() {
    let y = [10, 20, 30, 40, 50, 60, 70, 80];
    let cases: [(&str, Vec<u8>, PixelFormat, Vec<u8>); 3] = [
        (
            "YUV4MPEG2 W4 H2 F25:1 Ip A1:1 C420jpeg",
            y4m("YUV4MPEG2 W4 H2 F25:1 Ip A1:1 C420jpeg", &[&y, &[1, 2], &[3, 4]]),
            PixelFormat::Nv12,
            [&y[..], &[1, 3, 2, 4]].concat(),
        ),
        (
            "C422",
            y4m("YUV4MPEG2 W4 H2 C422", &[&y, &[1, 2, 3, 4], &[5, 6, 7, 8]]),
            PixelFormat::Yuyv,
            vec![10, 1, 20, 5, 30, 2, 40, 6, 50, 3, 60, 7, 70, 4, 80, 8],
        ),
        ("Cmono", y4m("YUV4MPEG2 W4 H2 Cmono", &[&y]), PixelFormat::Gray8, y.to_vec()),
    ];
    for (name, bytes, format, want) in cases {
        let mut source = Y4m::open(Cursor::new(bytes), "stdin", None).expect(name);
        let frame = source.next_frame().expect(name).expect(name);
        assert_eq!((frame.view.format(), frame.view.data()), (format, &want[..]), "{name}");
        assert!(source.next_frame().expect(name).is_none());
    }
}

#[test]
fn y4m_becomes_rgb_where_no_format_fits() {
    let y = [235u8; 6];
    for (header, planes, want) in [
        ("YUV4MPEG2 W3 H2 C420", vec![&y[..], &[128, 128], &[128, 128]], [255, 255, 255]),
        ("YUV4MPEG2 W3 H2 C444 XCOLORRANGE=FULL", vec![&y[..], &[128; 6], &[128; 6]], [235; 3]),
        ("YUV4MPEG2 W3 H2 C444", vec![&[81; 6][..], &[90; 6], &[240; 6]], [255, 0, 0]),
    ] {
        let mut source = Y4m::open(Cursor::new(y4m(header, &planes)), "stdin", None).expect(header);
        let frame = source.next_frame().expect(header).expect(header);
        assert_eq!(frame.view.format(), PixelFormat::Rgb8);
        for (found, want) in frame.view.data()[..3].iter().zip(want) {
            assert!(found.abs_diff(want) <= 1, "{header}: {:?}", &frame.view.data()[..3]);
        }
    }
}

#[test]
fn colour_tells_the_sensor_of_a_stream() {
    let bytes = |u: u8| y4m("YUV4MPEG2 W4 H2", &[&[90; 8], &[u; 2], &[128; 2]]);
    for (u, given, want) in [
        (128, None, Modality::Thermal),
        (60, None, Modality::Rgb),
        (128, Some(Modality::Rgb), Modality::Rgb),
    ] {
        let mut source = Y4m::open(Cursor::new(bytes(u)), "stdin", given).expect("header");
        assert_eq!(source.next_frame().expect("read").expect("frame").modality, want);
    }
}

#[test]
fn damaged_streams_say_where() {
    for (bytes, want) in [
        (&b""[..], "stdin, Y4M header: the stream is empty"),
        (b"RIFF....", "the line does not end"),
        (b"RIFF\n", "does not start with YUV4MPEG2"),
        (b"YUV4MPEG2 W4\n", "height (H) is missing"),
        (b"YUV4MPEG2 W0 H2\n", "W0 is not a size"),
        (b"YUV4MPEG2 W4 H2 C420p10\n", "C420p10 is not read"),
        (b"YUV4MPEG2 W99999999999999999999 H2\n", "is not a size"),
        (b"YUV4MPEG2 W4 H2\nFRAME\nabc", "frame 0: the stream ends within the picture"),
        (b"YUV4MPEG2 W2 H2\nFRAME\nabcdefFRAMX\n", "frame 1: a FRAME line was expected"),
    ] {
        let e = Y4m::open(Cursor::new(bytes), "stdin", None)
            .and_then(|mut s| all(&mut s))
            .expect_err("damaged");
        assert!(e.to_string().contains(want), "{e}");
    }
    let endless = vec![b'x'; 100_000];
    assert!(Y4m::open(Cursor::new(endless), "stdin", None).is_err());
}

#[test]
fn a_little_colour_is_still_grey() {
    let mut p = Picture::default();
    p.reset(64, 64, 3);
    assert!(looks_grey(&p));
    p.data.iter_mut().step_by(3).for_each(|v| *v = 5);
    assert!(looks_grey(&p));
    p.data.iter_mut().step_by(3).take(600).for_each(|v| *v = 90);
    assert!(!looks_grey(&p));
}
