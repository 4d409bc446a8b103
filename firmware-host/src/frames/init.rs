//! The first box, and box files of the benchmarks.

use super::SourceError;
use std::path::{Path, PathBuf};
use tsda_runtime::BBox;

/// Reads `x,y,w,h`; comma, semicolon, TAB or space between. Eight numbers are taken for the corners
/// of a polygon (VOT) and become the box around it.
///
/// # Errors
/// Says what was found instead.
pub fn parse_box(text: &str) -> Result<BBox, String> {
    let mut numbers = Vec::with_capacity(8);
    for word in text.split([',', ';', '\t', ' ']).map(str::trim).filter(|w| !w.is_empty()) {
        numbers.push(word.parse::<f32>().map_err(|_| format!("\"{word}\" is not a number"))?);
    }
    match numbers[..] {
        [x, y, w, h] => Ok(BBox::new(x, y, w, h)),
        [x0, y0, x1, y1, x2, y2, x3, y3] => {
            let low = |v: [f32; 4]| v.into_iter().fold(f32::INFINITY, f32::min);
            let high = |v: [f32; 4]| v.into_iter().fold(f32::NEG_INFINITY, f32::max);
            let (xs, ys) = ([x0, x1, x2, x3], [y0, y1, y2, y3]);
            let (x, y) = (low(xs), low(ys));
            Ok(BBox::new(x, y, high(xs) - x, high(ys) - y))
        }
        _ => Err(format!("{} numbers found, expected four: x,y,w,h", numbers.len())),
    }
}

/// A box file, one line per frame. Absent targets (no area, `nan`) are `None`; empty lines at the
/// end are passed over.
///
/// # Errors
/// Names the file and the line that cannot be read.
pub fn read_boxes(path: &Path) -> Result<Vec<Option<BBox>>, SourceError> {
    let text = std::fs::read_to_string(path)
        .map_err(|source| SourceError::Io { path: path.to_path_buf(), source })?;
    let mut boxes = Vec::new();
    for (i, line) in text.trim_end().lines().enumerate() {
        let b = parse_box(line).map_err(|reason| SourceError::Line {
            path: path.to_path_buf(),
            line: i + 1,
            reason,
        })?;
        boxes.push(b.is_valid().then_some(b));
    }
    Ok(boxes)
}

/// Looks for the first box beside the frames: in the folder itself, then in the folder above, where
/// `<folder>.txt` is tried as well (LasHeR's `visible.txt` for `visible/`).
///
/// # Errors
/// When a box file is there but its first line cannot be read.
pub fn find_init(frames: &Path) -> Result<Option<(PathBuf, BBox)>, SourceError> {
    const NAMES: [&str; 4] =
        ["groundtruth.txt", "groundtruth_rect.txt", "init.txt", "groundTruth.txt"];
    let mut places: Vec<PathBuf> = Vec::new();
    if frames.is_dir() {
        places.extend(NAMES.iter().map(|n| frames.join(n)));
        // `frames` may be "." or end in "..": only the real path has a name and a parent.
        let real = frames.canonicalize().unwrap_or_else(|_| frames.to_path_buf());
        if let (Some(above), Some(name)) = (real.parent(), real.file_name()) {
            places.push(above.join(format!("{}.txt", name.to_string_lossy())));
            places.extend(NAMES.iter().map(|n| above.join(n)));
        }
    } else {
        let base = frames.parent().unwrap_or(Path::new(""));
        places.extend(NAMES.iter().map(|n| base.join(n)));
    }
    for path in places {
        if path.is_file() && path != frames {
            let text = std::fs::read_to_string(&path)
                .map_err(|source| SourceError::Io { path: path.clone(), source })?;
            let first = text.lines().next().unwrap_or_default();
            return match parse_box(first) {
                Ok(b) => Ok(Some((path, b))),
                Err(reason) => Err(SourceError::Line { path, line: 1, reason }),
            };
        }
    }
    Ok(None)
}
