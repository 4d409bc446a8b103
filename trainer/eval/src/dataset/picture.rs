//! Decoding picture files and putting their names in order.

use std::cmp::Ordering;
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
}
