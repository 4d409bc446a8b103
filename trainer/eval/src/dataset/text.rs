//! Annotation texts beside pictures: boxes, flags, numbers and lists of names, all read by the rules
//! of [`crate::boxes`].

use std::path::Path;

use tsda_runtime::BBox;

use super::DatasetError;
use crate::boxes::{self, BadLine, Layout, fields, lines, read_text, shown};
use crate::metrics::score::bbox;

/// Boxes of a file, one per line, as they stand: with or without area.
///
/// # Errors
/// When the file cannot be read or does not hold boxes ([`boxes::parse`]), or a number does not fit
/// in a [`BBox`]; names file and line.
pub fn read_boxes(path: &Path, layout: Layout) -> Result<Vec<BBox>, DatasetError> {
    let row = |(i, row): (usize, [f64; 4])| match row.iter().find(|v| (**v as f32).is_infinite()) {
        Some(v) => {
            let reason = format!("{v:e} is too large for a coordinate");
            Err(BadLine { line: Some(i + 1), reason }.in_file(path))
        }
        None => Ok(bbox(row)),
    };
    boxes::read(path, layout)?.into_iter().enumerate().map(row).collect()
}

/// Numbers of a text, however they are spread over lines.
///
/// # Errors
/// When something is no finite number.
fn parse_numbers(text: &str) -> Result<Vec<f64>, BadLine> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let mut numbers = Vec::new();
    for (i, line) in lines(text).enumerate() {
        for field in fields(line) {
            match field.trim().parse::<f64>() {
                Ok(v) if v.is_finite() => numbers.push(v),
                _ => {
                    let reason = format!("'{}' is not a number", shown(field));
                    return Err(BadLine { line: Some(i + 1), reason });
                }
            }
        }
    }
    Ok(numbers)
}

/// [`parse_numbers`] of a file.
pub(crate) fn read_numbers(path: &Path) -> Result<Vec<f64>, DatasetError> {
    parse_numbers(&read_text(path)?).map_err(|bad| bad.in_file(path))
}

/// A file of 0/1 flags.
pub(crate) fn read_flags(path: &Path) -> Result<Vec<bool>, DatasetError> {
    Ok(read_numbers(path)?.into_iter().map(|v| v != 0.0).collect())
}

/// Names, one per line, with their 1-based lines; blank lines are passed over.
pub(crate) fn read_names(path: &Path) -> Result<Vec<(usize, String)>, DatasetError> {
    let text = read_text(path)?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let names = lines(text).enumerate().map(|(i, line)| (i + 1, line.trim().to_owned()));
    Ok(names.filter(|(_, name)| !name.is_empty()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn boxes_of(text: &str, layout: Layout) -> Result<Vec<BBox>, DatasetError> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("b.txt");
        std::fs::write(&path, text).unwrap();
        read_boxes(&path, layout)
    }

    #[test]
    fn boxes_without_area_and_with_nan_are_kept_as_they_stand() {
        let boxes = boxes_of("1,2,3,4.5\n0,0,0,0\r\n", Layout::Xywh).unwrap();
        assert_eq!(boxes, [BBox::new(1.0, 2.0, 3.0, 4.5), BBox::default()]);
        let boxes = boxes_of("10 20 14 26\n14 26 10 20\nnan nan 3 4\n", Layout::GTOT).unwrap();
        assert_eq!(boxes[0], BBox::new(10.0, 20.0, 4.0, 6.0));
        assert_eq!(boxes[1], boxes[0]);
        assert!(!boxes[2].is_valid());
    }

    #[test]
    fn what_is_wrong_is_named_with_file_and_line() {
        let e = boxes_of("1,2,3,4\n1,2,3\n", Layout::Xywh).unwrap_err().to_string();
        assert!(e.contains("b.txt, line 2") && e.contains("found 3"), "{e}");
        let e = boxes_of("1,2,3,4\n1,2,1e60,4\n", Layout::Xywh).unwrap_err().to_string();
        assert!(e.contains("b.txt, line 2") && e.contains("1e60 is too large"), "{e}");
        assert_eq!(parse_numbers("0\n1, 1\r\n8\n").unwrap(), [0.0, 1.0, 1.0, 8.0]);
        assert_eq!(parse_numbers("0\nyes\n").unwrap_err().line, Some(2));
    }

    proptest! {
        /// Texts made of what annotation files are made of get further than arbitrary ones.
        #[test]
        fn almost_number_files_never_panic(text in "[0-9eEnaNif.,;\t \r\n\u{feff}+-]{0,200}") {
            let _ = parse_numbers(&text);
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
            let read = boxes::parse(&text, Layout::Xywh).unwrap();
            prop_assert_eq!(read.into_iter().map(bbox).collect::<Vec<_>>(), want);
        }
    }
}
