//! Annotation texts: boxes, flags and lists of names, tolerant of the field's separators.
//!
//! Commas, tabs, semicolons and spaces separate, a separator at the end of a line is fine, so are a
//! byte order mark, CRLF, a lone CR for a line end (RGBT234's `kite2` has one) and blank lines at
//! the end. NaN is kept; infinity is an error.

use std::path::Path;

use tsda_runtime::BBox;

use super::DatasetError;

/// What the four numbers of a row mean.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum BoxFormat {
    /// Left, top, width, height.
    #[default]
    Xywh,
    /// Two opposite corners `x1 y1 x2 y2` in any order; the width is `x2 - x1` (GTOT).
    Corners,
}

impl BoxFormat {
    fn bbox(self, [a, b, c, d]: [f32; 4]) -> BBox {
        match self {
            Self::Xywh => BBox::new(a, b, c, d),
            // `min` would swallow a NaN, and with it the absence it stands for.
            Self::Corners if [a, b, c, d].iter().any(|v| v.is_nan()) => {
                BBox::new(f32::NAN, f32::NAN, f32::NAN, f32::NAN)
            }
            Self::Corners => BBox::new(a.min(c), b.min(d), (c - a).abs(), (d - b).abs()),
        }
    }

    const fn expected(self) -> &'static str {
        match self {
            Self::Xywh => "x,y,w,h",
            Self::Corners => "x1 y1 x2 y2",
        }
    }
}

/// A text that does not say what it should.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{}{reason}", .line.map(|l| format!("line {l}: ")).unwrap_or_default())]
pub struct TextError {
    /// 1-based line, where one can be named.
    pub line: Option<usize>,
    /// What is wrong and what was expected.
    pub reason: String,
}

/// Boxes of a text, one per line, as they stand: with or without area.
///
/// # Errors
/// When there is no line, or one does not hold four finite numbers (or NaN).
pub fn parse_boxes(bytes: &[u8], format: BoxFormat) -> Result<Vec<BBox>, TextError> {
    // Lossy: a stray byte makes one bad number with its line, not an unreadable file.
    let text = String::from_utf8_lossy(bytes);
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text).trim_end();
    if text.is_empty() {
        let reason = format!("no boxes in it: expected {} per line", format.expected());
        return Err(TextError { line: None, reason });
    }
    lines(text)
        .enumerate()
        .map(|(i, line)| {
            parse_row(line, format).map_err(|reason| TextError { line: Some(i + 1), reason })
        })
        .collect()
}

/// Lines ended by LF, CRLF or CR.
fn lines(text: &str) -> impl Iterator<Item = &str> {
    text.split('\n').flat_map(|line| line.strip_suffix('\r').unwrap_or(line).split('\r'))
}

fn fields(line: &str) -> impl Iterator<Item = &str> {
    line.split([',', '\t', ' ', ';']).filter(|f| !f.is_empty())
}

fn parse_row(line: &str, format: BoxFormat) -> Result<BBox, String> {
    let mut numbers = [0f32; 4];
    let mut n = 0;
    for field in fields(line) {
        let value: f32 = field.parse().map_err(|_| format!("'{field}' is not a number"))?;
        if value.is_infinite() {
            return Err(format!("'{field}' is not finite"));
        }
        if let Some(slot) = numbers.get_mut(n) {
            *slot = value;
        }
        n += 1;
    }
    if n != 4 {
        return Err(format!(
            "expected four numbers {}, found {n} in '{}'",
            format.expected(),
            line.trim()
        ));
    }
    Ok(format.bbox(numbers))
}

/// Numbers of a text, however they are spread over lines.
///
/// # Errors
/// When something is no finite number.
pub(crate) fn parse_numbers(bytes: &[u8]) -> Result<Vec<f64>, TextError> {
    let text = String::from_utf8_lossy(bytes);
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let mut numbers = Vec::new();
    for (i, line) in lines(text).enumerate() {
        for field in fields(line) {
            match field.trim().parse::<f64>() {
                Ok(v) if v.is_finite() => numbers.push(v),
                _ => {
                    let reason = format!("'{field}' is not a number");
                    return Err(TextError { line: Some(i + 1), reason });
                }
            }
        }
    }
    Ok(numbers)
}

fn read(path: &Path) -> Result<Vec<u8>, DatasetError> {
    std::fs::read(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })
}

fn at(path: &Path) -> impl Fn(TextError) -> DatasetError {
    move |e| DatasetError::Format { path: path.to_owned(), line: e.line, reason: e.reason }
}

/// [`parse_boxes`] of a file.
///
/// # Errors
/// When the file cannot be read, or as [`parse_boxes`]; names file and line.
pub fn read_boxes(path: &Path, format: BoxFormat) -> Result<Vec<BBox>, DatasetError> {
    parse_boxes(&read(path)?, format).map_err(at(path))
}

/// [`parse_numbers`] of a file.
pub(crate) fn read_numbers(path: &Path) -> Result<Vec<f64>, DatasetError> {
    parse_numbers(&read(path)?).map_err(at(path))
}

/// A file of 0/1 flags.
pub(crate) fn read_flags(path: &Path) -> Result<Vec<bool>, DatasetError> {
    Ok(read_numbers(path)?.into_iter().map(|v| v != 0.0).collect())
}

/// Names, one per line, with their 1-based lines; blank lines are passed over.
pub(crate) fn read_names(path: &Path) -> Result<Vec<(usize, String)>, DatasetError> {
    let bytes = read(path)?;
    let text = String::from_utf8_lossy(&bytes);
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let names = lines(text).enumerate().map(|(i, line)| (i + 1, line.trim().to_owned()));
    Ok(names.filter(|(_, name)| !name.is_empty()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_separator_and_line_end_of_the_field() {
        let want = [BBox::new(1.0, 2.0, 3.0, 4.5), BBox::new(0.0, 0.0, 0.0, 0.0)];
        for text in [
            "1,2,3,4.5\n0,0,0,0\n",
            "1\t2\t3\t4.5\r\n0\t0\t0\t0\r\n\r\n",
            "\u{feff}1 2 3 4.5\n0 0 0 0",
            " 1, 2, 3, 4.5,\n0;0;0;0;\n\n\n",
            "1,2,3,4.5\r0,0,0,0\r\n",
        ] {
            assert_eq!(parse_boxes(text.as_bytes(), BoxFormat::Xywh).unwrap(), want, "{text:?}");
        }
    }

    #[test]
    fn corners_in_any_order_and_absent() {
        let boxes = parse_boxes(b"10 20 14 26\n14 26 10 20\nnan nan 3 4\n", BoxFormat::Corners);
        let boxes = boxes.unwrap();
        assert_eq!(boxes[0], BBox::new(10.0, 20.0, 4.0, 6.0));
        assert_eq!(boxes[1], boxes[0]);
        assert!(!boxes[2].is_valid());
    }

    #[test]
    fn defects_name_their_line() {
        for (text, line, want) in [
            ("1,2,3,4\n1,2,3\n", Some(2), "found 3"),
            ("1,2,3,4,5\n", Some(1), "found 5"),
            ("1,2,3,4\n\n1,2,3,4\n", Some(2), "found 0"),
            ("1,2,x3,4\n", Some(1), "'x3' is not a number"),
            ("1,2,1e60,4\n", Some(1), "not finite"),
            ("\r\n\n", None, "no boxes"),
        ] {
            let e = parse_boxes(text.as_bytes(), BoxFormat::Xywh).unwrap_err();
            assert!(e.line == line && e.reason.contains(want), "{text:?}: {e}");
        }
        assert_eq!(parse_numbers(b"0\n1, 1\r\n8\n").unwrap(), [0.0, 1.0, 1.0, 8.0]);
        assert_eq!(parse_numbers(b"0\nyes\n").unwrap_err().line, Some(2));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            let _ = parse_boxes(&bytes, BoxFormat::Xywh);
            let _ = parse_boxes(&bytes, BoxFormat::Corners);
            let _ = parse_numbers(&bytes);
        }

        /// Texts made of what annotation files are made of get further than arbitrary bytes.
        #[test]
        fn almost_box_files_never_panic(text in "[0-9eEnaNif.,;\t \r\n\u{feff}+-]{0,200}") {
            let _ = parse_boxes(text.as_bytes(), BoxFormat::Xywh);
            let _ = parse_boxes(text.as_bytes(), BoxFormat::Corners);
            let _ = parse_numbers(text.as_bytes());
        }

        #[test]
        fn box_files_round_trip(
            rows in proptest::collection::vec([-1e4f32..1e4, -1e4f32..1e4, 0f32..1e4, 0f32..1e4], 1..20),
            separator in prop_oneof![Just(","), Just("\t"), Just(" "), Just(", "), Just(";")],
            end in prop_oneof![Just("\n"), Just("\r\n"), Just("\r")],
            mark in any::<bool>(),
            tail in any::<bool>(),
        ) {
            let mut text = String::from(if mark { "\u{feff}" } else { "" });
            for row in &rows {
                text += &row.map(|v| v.to_string()).join(separator);
                text += if tail { separator } else { "" };
                text += end;
            }
            let want: Vec<BBox> = rows.iter().map(|&[x, y, w, h]| BBox::new(x, y, w, h)).collect();
            prop_assert_eq!(parse_boxes(text.as_bytes(), BoxFormat::Xywh).unwrap(), want);
        }
    }
}
