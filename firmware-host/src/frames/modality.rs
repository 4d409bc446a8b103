//! Which sensor a picture came from, when nobody says.

use crate::picture::Picture;
use std::path::Path;
use tsda_runtime::Modality;

/// Folder names of the data sets (LasHeR, RGBT234, GTOT, VTUAV, VOT) and those people use.
const THERMAL: [&str; 8] = ["infrared", "ir", "thermal", "i", "lwir", "tir", "ir_gray", "t"];
const RGB: [&str; 7] = ["visible", "rgb", "v", "vis", "color", "colour", "eo"];

/// From the name of the folder, else from the start of the file's name (`infrared0001.jpg`).
pub(super) fn from_path(path: &Path) -> Option<Modality> {
    let lower = |s: &std::ffi::OsStr| s.to_string_lossy().to_lowercase();
    let folder = path.parent().and_then(Path::file_name).map(lower).unwrap_or_default();
    if THERMAL.contains(&folder.as_str()) {
        return Some(Modality::Thermal);
    }
    if RGB.contains(&folder.as_str()) {
        return Some(Modality::Rgb);
    }
    let stem = path.file_stem().map(lower).unwrap_or_default();
    let starts = |names: &[&str]| names.iter().any(|n| n.len() > 2 && stem.starts_with(n));
    if starts(&THERMAL) {
        Some(Modality::Thermal)
    } else if starts(&RGB) {
        Some(Modality::Rgb)
    } else {
        None
    }
}

/// From the pixels: one channel, or three that hardly differ, is taken for thermal.
pub(super) fn from_pixels(picture: &Picture) -> Modality {
    if picture.channels == 1 || looks_grey(picture) { Modality::Thermal } else { Modality::Rgb }
}

/// Do the channels agree on a grid of some thousand pixels? JPEG may make them differ a little.
pub fn looks_grey(picture: &Picture) -> bool {
    if picture.channels == 1 {
        return true;
    }
    let step = (picture.width.max(picture.height) / 64).max(1);
    let (mut coloured, mut seen) = (0usize, 0usize);
    for y in (0..picture.height).step_by(step) {
        for x in (0..picture.width).step_by(step) {
            let [r, g, b] = picture.rgb(x, y);
            seen += 1;
            coloured += usize::from(r.max(g).max(b) - r.min(g).min(b) > 6);
        }
    }
    coloured * 200 <= seen
}
