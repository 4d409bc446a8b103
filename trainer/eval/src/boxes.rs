//! Box files as text: every separator and layout in use, in double precision.
//!
//! One line per frame. Commas, tabs, semicolons and spaces separate, also mixed; CRLF, CR, a
//! byte-order mark, a trailing separator and blank lines at the end are fine; a blank line elsewhere is an
//! error, because it would shift every frame behind it. `NaN` is kept, infinity is not a number
//! here. Four numbers are a box in the stated [`Layout`], eight the corners of a polygon, of which
//! the enclosing box is taken.

use std::fmt::Write as _;
use std::path::Path;

use crate::dataset::DatasetError;
use crate::metrics::Row;

/// What the four numbers of a line are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Layout {
    /// `x, y, w, h`.
    #[default]
    Xywh,
    /// `x1, y1, x2, y2`: two opposite corners in any order, as GTOT's truth has them.
    Corners {
        /// The corners are the outermost pixels, so one pixel is added to each side (LasHeR's
        /// toolkit does so with results of corners, GTOT's does not).
        inclusive: bool,
        /// Round the numbers before they become sides, as the `rgbt` toolkit does.
        round: bool,
    },
}

impl Layout {
    /// GTOT's truth.
    pub const GTOT: Self = Self::Corners { inclusive: false, round: false };

    /// The numbers of a line, in words.
    const fn expected(self) -> &'static str {
        match self {
            Self::Xywh => "x,y,w,h",
            Self::Corners { .. } => "x1 y1 x2 y2",
        }
    }

    fn box_of(self, n: [f64; 4]) -> Row {
        let Self::Corners { inclusive, round } = self else { return n };
        let n = if round { n.map(|v| f64::from((v as f32).round_ties_even())) } else { n };
        enclosing(&n, inclusive)
    }
}

/// Box around points `x, y, x, y, ..`; NaN in any of them makes all of it NaN.
fn enclosing(points: &[f64], inclusive: bool) -> Row {
    if points.iter().any(|v| v.is_nan()) {
        return [f64::NAN; 4];
    }
    let axis = |first: usize| {
        let values = points.iter().skip(first).step_by(2);
        values.fold((f64::MAX, f64::MIN), |(low, high), &v| (low.min(v), high.max(v)))
    };
    let ((left, right), (top, bottom)) = (axis(0), axis(1));
    let pixel = if inclusive { 1.0 } else { 0.0 };
    [left, top, right - left + pixel, bottom - top + pixel]
}

/// What a text of boxes lacks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BadLine {
    /// 1-based line; `None`: the text as a whole.
    pub line: Option<usize>,
    /// What is wrong and what was expected.
    pub reason: String,
}

impl BadLine {
    /// The same, of a file.
    pub(crate) fn in_file(self, path: &Path) -> DatasetError {
        DatasetError::Format { path: path.to_owned(), line: self.line, reason: self.reason }
    }
}

/// Reads boxes from a text; see the [module](self).
///
/// # Errors
/// For a text without lines, or the first line that is no box.
pub fn parse(text: &str, layout: Layout) -> Result<Vec<Row>, BadLine> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text).trim_end();
    if text.is_empty() {
        return Err(BadLine {
            line: None,
            reason: format!("no boxes in it: expected {} per line", layout.expected()),
        });
    }
    lines(text)
        .enumerate()
        .map(|(i, line)| {
            parse_line(line, layout).map_err(|reason| BadLine { line: Some(i + 1), reason })
        })
        .collect()
}

/// Lines ended by LF, CRLF or a lone CR, which stands in RGBT234's `kite2/infrared.txt`; taken for a
/// blank it would make one line of two boxes.
pub(crate) fn lines(text: &str) -> impl Iterator<Item = &str> {
    text.lines().flat_map(|line| line.trim_end_matches('\r').split('\r'))
}

/// What stands between separators.
pub(crate) fn fields(line: &str) -> impl Iterator<Item = &str> {
    line.split([',', '\t', ' ', ';']).filter(|f| !f.is_empty())
}

fn parse_line(line: &str, layout: Layout) -> Result<Row, String> {
    let mut numbers = [0.0; 8];
    let mut n = 0;
    for field in fields(line) {
        let value: f64 =
            field.parse().map_err(|_| format!("'{}' is not a number", shown(field)))?;
        if value.is_infinite() {
            return Err(format!("'{}' is not finite", shown(field)));
        }
        if let Some(slot) = numbers.get_mut(n) {
            *slot = value;
        }
        n += 1;
    }
    let [a, b, c, d, ..] = numbers;
    match n {
        4 => Ok(layout.box_of([a, b, c, d])),
        8 => Ok(enclosing(&numbers, false)),
        0 => Err(format!(
            "expected four numbers {}, found 0: an empty line between boxes",
            layout.expected()
        )),
        _ => Err(format!(
            "expected four numbers {}, found {n} in '{}'",
            layout.expected(),
            shown(line.trim())
        )),
    }
}

/// As much of a text as fits in a message.
pub(crate) fn shown(text: &str) -> String {
    let mut short: String = text.chars().take(60).collect();
    if short.len() < text.len() {
        short.push_str("..");
    }
    short
}

/// Reads a file of boxes.
///
/// # Errors
/// When the file cannot be read or does not hold boxes; the error names file and line.
pub fn read(path: &Path, layout: Layout) -> Result<Vec<Row>, DatasetError> {
    let text = read_text(path)?;
    parse(&text, layout).map_err(|bad| bad.in_file(path))
}

/// A file as text; a stray byte makes one bad number with its line, not an unreadable file.
pub(crate) fn read_text(path: &Path) -> Result<String, DatasetError> {
    let bytes =
        std::fs::read(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

/// How a box file writes its lines.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Style {
    /// `x,y,w,h` with three decimals: OTB, GOT-10k and LasHeR results.
    #[default]
    Comma,
    /// Tab between whole numbers: GTOT's `init.txt`.
    TabWhole,
    /// Space between the corners `x1 y1 x2 y2`: GTOT's truth.
    SpaceCorners,
}

/// The text of a box file.
pub fn format(rows: &[Row], style: Style) -> String {
    let mut text = String::with_capacity(rows.len() * 32);
    for &[x, y, w, h] in rows {
        // Writing into a String cannot fail.
        let _ = match style {
            Style::Comma => writeln!(text, "{x:.3},{y:.3},{w:.3},{h:.3}"),
            Style::TabWhole => writeln!(text, "{x:.0}\t{y:.0}\t{w:.0}\t{h:.0}"),
            Style::SpaceCorners => writeln!(text, "{x} {y} {} {}", x + w, y + h),
        };
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_layout_in_use() {
        let b = [1.0, 2.0, 3.0, 4.0];
        let corners = |inclusive, round| Layout::Corners { inclusive, round };
        for (text, layout, want) in [
            ("1,2,3,4", Layout::Xywh, b),
            ("1\t2\t3\t4\n\n", Layout::Xywh, b),
            ("\u{feff}1 2  3 4\r\n", Layout::Xywh, b),
            ("1, 2, 3, 4,", Layout::Xywh, b),
            ("1;2;3;4", Layout::Xywh, b),
            ("1e0,2.0,+3,4.", Layout::Xywh, b),
            ("1 2 4 6", Layout::GTOT, b),
            ("4 6 1 2", Layout::GTOT, b),
            ("1,2,3,5", corners(true, false), b),
            ("1.4,1.5,3.6,6.4", corners(false, true), [1.0, 2.0, 3.0, 4.0]),
            ("1,2,4,2,4,6,1,6", Layout::Xywh, b),
        ] {
            assert_eq!(parse(text, layout).unwrap(), [want], "{text}");
        }
        for text in ["nan,1,2,3", "NaN NaN NaN NaN"] {
            assert!(parse(text, Layout::Xywh).unwrap()[0][0].is_nan());
            assert!(parse(text, Layout::GTOT).unwrap()[0].iter().all(|v| v.is_nan()));
        }
    }

    #[test]
    fn every_line_end_is_one() {
        let rows =
            parse("1,2,3,4\r\n1,2,3,4\r1,2,3,4\n1,2,3,4\r\r\n1,2,3,4", Layout::Xywh).unwrap();
        assert_eq!(rows, [[1.0, 2.0, 3.0, 4.0]; 5]);
        let bad = parse("1,2,3,4\r1,2\r\n", Layout::Xywh).unwrap_err();
        assert_eq!(bad.line, Some(2));
    }

    #[test]
    fn what_is_no_box_is_named_with_its_line() {
        for (text, line, words) in [
            ("", None, "no boxes"),
            ("\n \r\n", None, "no boxes"),
            ("1,2,3,4\n1,2,3\n", Some(2), "found 3 in '1,2,3'"),
            ("1,2,3,4\n\n1,2,3,4\n", Some(2), "empty line"),
            ("1,2,3,4,5", Some(1), "found 5"),
            ("1,2,3,x", Some(1), "'x' is not a number"),
            ("1,2,3,inf", Some(1), "not finite"),
        ] {
            let bad = parse(text, Layout::Xywh).unwrap_err();
            assert_eq!(bad.line, line, "{text:?}");
            assert!(bad.reason.contains(words), "{text:?}: {}", bad.reason);
        }
        let long = parse(&"y".repeat(1000), Layout::Xywh).unwrap_err();
        assert!(long.reason.len() < 100, "{}", long.reason);
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "[0-9eE.,;\\- \tNaif\r\nx\u{feff}é]{0,60}") {
            for layout in [Layout::Xywh, Layout::GTOT] {
                if let Ok(rows) = parse(&text, layout) {
                    prop_assert!(!rows.is_empty());
                }
            }
        }

        #[test]
        fn what_is_written_is_read(
            rows in proptest::collection::vec(proptest::array::uniform4(-1000i32..1000), 1..9),
        ) {
            let rows: Vec<Row> = rows
                .iter()
                .map(|r| [r[0], r[1], r[2].abs(), r[3].abs()].map(f64::from))
                .collect();
            for (style, layout) in [
                (Style::Comma, Layout::Xywh),
                (Style::TabWhole, Layout::Xywh),
                (Style::SpaceCorners, Layout::GTOT),
            ] {
                prop_assert_eq!(&parse(&format(&rows, style), layout).unwrap(), &rows);
            }
        }
    }
}
