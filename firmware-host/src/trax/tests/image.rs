//! Pictures in messages.

use super::*;
use crate::frames::Decoded;
use proptest::prelude::*;
use tsda_runtime::PixelFormat;

fn decoded(text: &str) -> Result<Decoded, ImageError> {
    let arg = ImageArg::parse(text)?;
    let picture = arg.decode()?;
    let view = picture.view()?;
    assert_eq!(arg.size()?, (view.width(), view.height()), "size() of {text:.60}");
    Ok(picture)
}

#[test]
fn every_way_a_picture_can_come() {
    let dir = tempfile::tempdir().expect("temp");
    let picture = pattern(12, 8);
    // The name has what URLs would escape.
    let path = dir.path().join("frame 100% ä=1.png");
    std::fs::write(&path, png(&picture)).expect("write");
    let path = path.to_str().expect("text");
    let raw = encode_base64(picture.as_raw());
    let (png, jpeg) = (encode_base64(&png(&picture)), encode_base64(&jpeg(&picture)));
    for (name, text, exact) in [
        ("path", format!("file://{path}"), true),
        ("bare path", path.to_owned(), true),
        ("memory", format!("image:12;8;rgb;{raw}"), true),
        ("png", format!("data:image/png;{png}"), true),
        ("png as the protocol's text shows it", format!("data:image/png;base64;{png}"), true),
        ("png as a data URL", format!("data:image/png;base64,{png}"), true),
        ("jpeg", format!("data:image/jpeg;{jpeg}"), false),
    ] {
        let Ok(Decoded::Eight(got)) = decoded(&text) else { panic!("{name}") };
        assert_eq!((got.width, got.height, got.channels), (12, 8, 3), "{name}");
        let off = got.data.iter().zip(picture.as_raw()).map(|(a, b)| a.abs_diff(*b));
        let mean = off.map(f32::from).sum::<f32>() / got.data.len() as f32;
        assert!(if exact { mean == 0.0 } else { mean < 25.0 }, "{name}: {mean}");
    }

    let grey: Vec<u8> = (0..96).collect();
    let text = format!("image:12;8;gray8;{}", encode_base64(&grey));
    let Ok(Decoded::Eight(got)) = decoded(&text) else { panic!("gray8") };
    assert_eq!((got.channels, &got.data), (1, &grey));

    // 0x0100 + i, low byte first.
    let raw: Vec<u8> = (0..96).flat_map(|i| [i, 1]).collect();
    let got = decoded(&format!("image:12;8;gray16;{}", encode_base64(&raw))).expect("gray16");
    let PixelFormat::Y16 { low, high } = got.view().expect("view").format() else {
        panic!("format")
    };
    assert_eq!((low, high), (256, 256 + 95));
    // A picture of one value still has a range.
    let flat = decoded(&format!("image:2;1;gray16;{}", encode_base64(&[255; 4]))).expect("flat");
    assert!(flat.view().is_ok());
}

#[test]
fn pictures_that_cannot_be_used_say_why() {
    let raw = encode_base64(&[1, 2, 3]);
    let cut = encode_base64(&png(&pattern(12, 8))[..40]);
    for (text, words) in [
        ("".to_owned(), "empty text"),
        ("file://".to_owned(), "empty text"),
        ("file:///no/such/picture.png".to_owned(), "/no/such/picture.png"),
        ("http://host/a.jpg".to_owned(), "not fetched"),
        ("s3:bucket/a.jpg".to_owned(), "not fetched"),
        ("image:".to_owned(), "a side is not a number of pixels: \"\""),
        ("image:1".to_owned(), "too few parts"),
        ("image:1;1;rgb".to_owned(), "too few parts"),
        (format!("image:0;1;rgb;{raw}"), "a side is not a number of pixels: \"0\""),
        (format!("image:-1;1;rgb;{raw}"), "\"-1\""),
        (format!("image:1;1;bgr;{raw}"), "unknown format \"bgr\""),
        (format!("image:2;1;rgb;{raw}"), "2 x 1 pixels of 3 bytes has 3 bytes instead of 6"),
        (format!("image:1;1;gray8;{raw}"), "3 bytes instead of 1"),
        (format!("image:99999999999;99999999999;rgb;{raw}"), "instead of"),
        ("image:1;1;rgb;A*AA".to_owned(), "character 1 (0x2a)"),
        ("image:1;1;rgb;AAA=A".to_owned(), "5 characters"),
        ("data:image/png;AAAAA".to_owned(), "5 characters"),
        ("data:image/png;".to_owned(), "expected data:image/jpeg;BASE64"),
        ("data:text/plain;AAAA".to_owned(), "expected data:image/jpeg;BASE64"),
        ("data:image/png".to_owned(), "expected data:image/jpeg;BASE64"),
        ("data:image/png;AAAA".to_owned(), "not a picture that can be read"),
        (format!("data:image/png;{cut}"), "buffer picture"),
    ] {
        let e = ImageArg::parse(&text).and_then(|a| a.decode()).expect_err(&text);
        let line = crate::error::one_line(&e);
        assert!(line.contains(words), "{text}: no \"{words}\" in: {line}");
        assert!(line.len() < 300, "{line}");
    }
}

#[test]
fn a_drive_letter_is_no_scheme() {
    assert_eq!(ImageArg::parse("C:\\a.jpg").expect("path"), ImageArg::Path("C:\\a.jpg".into()));
}

proptest! {
    #[test]
    fn base64_gives_the_bytes_back(bytes in prop::collection::vec(any::<u8>(), 0..40)) {
        let text = encode_base64(&bytes);
        prop_assert_eq!(decode_base64(&text), Ok(bytes.clone()));
        prop_assert_eq!(decode_base64(text.trim_end_matches('=')), Ok(bytes));
    }

    #[test]
    fn no_argument_panics(
        head in prop::sample::select(vec!["", "image:", "image:2;2;", "data:", "data:image/png;", "file://"]),
        tail in "[ -~ä]{0,30}",
    ) {
        let text = format!("{head}{tail}");
        if let Ok(arg) = ImageArg::parse(&text) {
            let _ = (arg.decode(), arg.size());
        }
    }

    #[test]
    fn no_file_content_panics(bytes in prop::collection::vec(any::<u8>(), 0..200), png_like: bool) {
        let mut file = if png_like { png(&pattern(8, 8)) } else { Vec::new() };
        let keep = file.len().saturating_sub(bytes.len());
        file.truncate(keep);
        file.extend(bytes);
        let text = format!("data:image/png;{}", encode_base64(&file));
        if let Ok(arg) = ImageArg::parse(&text) {
            let _ = (arg.decode(), arg.size());
        }
    }
}
