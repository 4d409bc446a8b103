//! Decoding picture files and putting their names in order.

use std::cmp::Ordering;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use image::ImageReader;
use tsda_runtime::Modality;

use super::{DatasetError, Picture};

/// File name endings the loaders take for pictures (any case).
const ENDINGS: [&str; 4] = ["jpg", "jpeg", "png", "bmp"];

/// Does the name end like a picture this crate can decode?
pub(crate) fn is_picture(path: &Path) -> bool {
    path.extension()
        .and_then(|e| e.to_str())
        .is_some_and(|e| ENDINGS.iter().any(|known| e.eq_ignore_ascii_case(known)))
}

/// Decodes a JPEG, PNG or BMP file as a picture of `modality`: three channels for RGB, one for
/// thermal (many thermal sets are stored as three equal channels; pseudo-colour becomes luma).
///
/// # Errors
/// [`DatasetError::Io`] when the file cannot be opened, [`DatasetError::Picture`] when it is not a
/// picture, or a damaged one.
pub fn decode_picture(path: &Path, modality: Modality) -> Result<Picture, DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    let reader = ImageReader::open(path).map_err(io)?.with_guessed_format().map_err(io)?;
    let decoded = reader
        .decode()
        .map_err(|e| DatasetError::Picture { path: path.to_owned(), reason: e.to_string() })?;
    let (width, height) = (decoded.width() as usize, decoded.height() as usize);
    let (channels, data) = match modality {
        Modality::Rgb => (3, decoded.into_rgb8().into_raw()),
        Modality::Thermal => (1, decoded.into_luma8().into_raw()),
    };
    Ok(Picture { width, height, channels, data })
}

/// `(width, height)` of a JPEG, PNG or BMP file from its header, some hundred bytes read, nothing
/// decoded. A PNG or JPEG file that stops before its end marker is refused too: cut off files are
/// the commonest damage of large downloads.
///
/// # Errors
/// [`DatasetError::Io`] when the file cannot be read, [`DatasetError::Picture`] when it is not a
/// picture or ends too early.
pub fn picture_size(path: &Path) -> Result<(usize, usize), DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    let broken =
        |reason: &str| DatasetError::Picture { path: path.to_owned(), reason: reason.to_owned() };
    let mut file = BufReader::with_capacity(1024, File::open(path).map_err(io)?);
    let (size, end) = match header(&mut file) {
        Ok(Some(found)) => found,
        Ok(None) => return Err(broken("not a JPEG, PNG or BMP picture")),
        Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => {
            return Err(broken("the file ends within its header"));
        }
        Err(e) => return Err(io(e)),
    };
    if size.0 == 0 || size.1 == 0 {
        return Err(broken("its header says that it has no pixels"));
    }
    if !end.is_empty() {
        let length = file.seek(SeekFrom::End(0)).map_err(io)?;
        // Some cameras and tools put a little behind the marker.
        file.seek(SeekFrom::Start(length.saturating_sub(TAIL))).map_err(io)?;
        let mut tail = Vec::new();
        file.read_to_end(&mut tail).map_err(io)?;
        if !tail.windows(end.len()).any(|w| w == end) {
            return Err(broken("the file is cut off: no end marker"));
        }
    }
    Ok(size)
}

/// Where the end marker of a picture is looked for, in bytes from the end of the file.
const TAIL: u64 = 256;

/// Size and end marker (empty: none to look for); `None` for other formats.
type Header = Option<((usize, usize), &'static [u8])>;

fn header(file: &mut (impl Read + Seek)) -> io::Result<Header> {
    let mut magic = [0u8; 2];
    file.read_exact(&mut magic)?;
    let be32 = |b: &[u8]| b.iter().fold(0usize, |n, &v| n << 8 | usize::from(v));
    match magic {
        [0xFF, 0xD8] => Ok(jpeg_size(file)?.map(|size| (size, &[0xFF, 0xD9][..]))),
        [0x89, b'P'] => {
            let mut rest = [0u8; 22];
            file.read_exact(&mut rest)?;
            let is_png = rest[..6] == *b"NG\r\n\x1a\n" && rest[10..14] == *b"IHDR";
            Ok(is_png.then(|| ((be32(&rest[14..18]), be32(&rest[18..22])), &b"IEND"[..])))
        }
        [b'B', b'M'] => {
            let mut rest = [0u8; 24];
            file.read_exact(&mut rest)?;
            let le = |at: usize| {
                i32::from_le_bytes([rest[at], rest[at + 1], rest[at + 2], rest[at + 3]])
            };
            // A negative height means rows from the top.
            let side = |v: i32| v.unsigned_abs() as usize;
            Ok(Some(((side(le(16)), side(le(20))), &[])))
        }
        _ => Ok(None),
    }
}

/// Walks the segments up to the frame header.
fn jpeg_size(file: &mut (impl Read + Seek)) -> io::Result<Option<(usize, usize)>> {
    let mut byte = [0u8; 1];
    loop {
        file.read_exact(&mut byte)?;
        if byte[0] != 0xFF {
            return Ok(None);
        }
        while byte[0] == 0xFF {
            file.read_exact(&mut byte)?;
        }
        match byte[0] {
            // Standalone markers.
            0x01 | 0xD0..=0xD8 => continue,
            // End of the picture, or its data, before any frame header.
            0xD9 | 0xDA | 0x00 => return Ok(None),
            _ => {}
        }
        let mut length = [0u8; 2];
        file.read_exact(&mut length)?;
        let Some(rest) = u16::from_be_bytes(length).checked_sub(2) else { return Ok(None) };
        // SOF0..SOF15 without DHT, JPG and DAC.
        if matches!(byte[0], 0xC0..=0xCF) && !matches!(byte[0], 0xC4 | 0xC8 | 0xCC) {
            let mut sof = [0u8; 5];
            file.read_exact(&mut sof)?;
            let side = |at: usize| usize::from(u16::from_be_bytes([sof[at], sof[at + 1]]));
            return Ok(Some((side(3), side(1))));
        }
        file.seek(SeekFrom::Current(i64::from(rest)))?;
    }
}

/// Orders names as a person would: runs of digits by value (`f2` before `f10`), the rest by byte.
/// Names equal in that sense (`01`, `1`) are ordered by length, so the order is total.
pub fn natural_cmp(a: &str, b: &str) -> Ordering {
    let (mut x, mut y) = (a.as_bytes(), b.as_bytes());
    while let (Some(&p), Some(&q)) = (x.first(), y.first()) {
        if p.is_ascii_digit() && q.is_ascii_digit() {
            let (nx, rx) = split_number(x);
            let (ny, ry) = split_number(y);
            // Without leading zeros, a longer run is a larger number.
            match nx.len().cmp(&ny.len()).then_with(|| nx.cmp(ny)) {
                Ordering::Equal => (x, y) = (rx, ry),
                other => return other,
            }
        } else if p == q {
            (x, y) = (&x[1..], &y[1..]);
        } else {
            return p.cmp(&q);
        }
    }
    x.len().cmp(&y.len()).then_with(|| a.len().cmp(&b.len())).then_with(|| a.cmp(b))
}

/// The leading run of digits without its leading zeros, and what follows.
fn split_number(s: &[u8]) -> (&[u8], &[u8]) {
    let end = s.iter().position(|c| !c.is_ascii_digit()).unwrap_or(s.len());
    let start = s[..end].iter().position(|&c| c != b'0').unwrap_or(end);
    (&s[start..end], &s[end..])
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn names_sort_by_the_value_of_their_numbers() {
        let mut names =
            vec!["img10.jpg", "img2.jpg", "img1.jpg", "IMG3.jpg", "img02.jpg", "img2b.jpg", "a"];
        names.sort_by(|a, b| natural_cmp(a, b));
        assert_eq!(
            names,
            ["IMG3.jpg", "a", "img1.jpg", "img2.jpg", "img02.jpg", "img2b.jpg", "img10.jpg"]
        );
    }

    proptest! {
        #[test]
        fn natural_order_is_antisymmetric(a in "[a-c0-2]{0,8}", b in "[a-c0-2]{0,8}") {
            prop_assert_eq!(natural_cmp(&a, &b), natural_cmp(&b, &a).reverse());
            prop_assert_eq!(natural_cmp(&a, &b) == Ordering::Equal, a == b);
        }
    }

    #[test]
    fn thermal_becomes_one_channel_and_rgb_three_whatever_the_file_holds() {
        let dir = tempfile::tempdir().unwrap();
        let grey3 = dir.path().join("t.png");
        image::RgbImage::from_fn(4, 2, |x, y| {
            let v = (40 * x + 10 * y) as u8;
            image::Rgb([v, v, v])
        })
        .save(&grey3)
        .unwrap();
        let t = decode_picture(&grey3, Modality::Thermal).unwrap();
        assert_eq!((t.width, t.height, t.channels), (4, 2, 1));
        assert_eq!(t.data, [0, 40, 80, 120, 10, 50, 90, 130]);
        assert_eq!(decode_picture(&grey3, Modality::Rgb).unwrap().data.len(), 24);
    }

    #[test]
    fn unreadable_pictures_name_their_file() {
        let dir = tempfile::tempdir().unwrap();
        let bad = dir.path().join("bad.jpg");
        std::fs::write(&bad, b"not a jpeg").unwrap();
        let e = decode_picture(&bad, Modality::Rgb).unwrap_err();
        assert!(matches!(e, DatasetError::Picture { .. }) && e.to_string().contains("bad.jpg"));
        let e = decode_picture(&dir.path().join("none.png"), Modality::Rgb).unwrap_err();
        assert!(matches!(e, DatasetError::Io { .. }) && e.to_string().contains("none.png"));
    }

    #[test]
    fn sizes_come_from_headers() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["a.png", "a.jpg", "a.bmp"] {
            let path = dir.path().join(name);
            image::RgbImage::new(31, 7).save(&path).unwrap();
            assert_eq!(picture_size(&path).unwrap(), (31, 7), "{name}");
            let bytes = std::fs::read(&path).unwrap();
            for (cut, want) in [(1, "header"), (20, "header"), (bytes.len() - 12, "cut off")] {
                std::fs::write(&path, &bytes[..cut]).unwrap();
                // BMP has no end marker, and JPEG more than 20 bytes before its size.
                match picture_size(&path) {
                    Err(e) => assert!(
                        e.to_string().contains(want) && e.to_string().contains(name),
                        "{name} {cut}: {e}"
                    ),
                    Ok(_) => assert!(name == "a.bmp" && want == "cut off", "{name} {cut}"),
                }
            }
        }
        let text = dir.path().join("t.jpg");
        std::fs::write(&text, "a text").unwrap();
        assert!(picture_size(&text).unwrap_err().to_string().contains("not a JPEG"));
    }

    proptest! {
        #[test]
        fn headers_never_panic(
            start in prop_oneof![
                Just(&[0xFFu8, 0xD8, 0xFF][..]),
                Just(&b"\x89PNG\r\n\x1a\n"[..]),
                Just(&b"BM"[..]),
                Just(&b""[..]),
            ],
            rest in proptest::collection::vec(any::<u8>(), 0..80),
        ) {
            let bytes = [start, &rest[..]].concat();
            let _ = header(&mut io::Cursor::new(bytes));
        }
    }
}
