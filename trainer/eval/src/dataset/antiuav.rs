//! Anti-UAV: drones seen by an RGB and a thermal camera of different resolution and view, or by a
//! thermal camera alone (Anti-UAV410).
//!
//! ```text
//! <root>/[test/]<name>/visible/visibleI0000.jpg ..   or RGB/; digits of any width
//!                     /infrared/infraredI0000.jpg .. or IR/; or *.jpg in the folder itself
//!                     /visible.json, infrared.json   or RGB_label.json, IR_label.json
//!                     /registration.txt              optional: a b tx c d ty, RGB to thermal
//! ```
//! A label file is `{"exist": [1, 0, ..], "gt_rect": [[x, y, w, h], [], ..]}`. `exist` decides: a
//! stale box of an absent frame is no truth, and absent frames mostly hold an empty list. The
//! published clips are videos (`visible.mp4`), which must be turned into pictures first; the error
//! names the command.
//!
//! As opened by `antiuav`, both sensors keep their own pixels and boxes. The option `registered`
//! warps RGB onto the thermal frame, see [`super::registered`].

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;
use tsda_runtime::BBox;

use super::clip::{ClipSequence, Labels, Parts, Pictures, Stream};
use super::layout::Jobs;
use super::registered::RegisteredClip;
use super::tree::{Listing, find_sequences, in_split, name_of};
use super::{DatasetError, Note, Registration, Split};

struct Side {
    folders: &'static [&'static str],
    labels: &'static [&'static str],
    videos: &'static [&'static str],
    /// How names of pictures in the sequence folder itself begin.
    prefixes: &'static [&'static str],
}

const RGB: Side = Side {
    folders: &["visible", "rgb"],
    labels: &["visible.json", "RGB_label.json"],
    videos: &["visible.mp4", "RGB.mp4"],
    prefixes: &["visible", "rgb"],
};

const THERMAL: Side = Side {
    folders: &["infrared", "ir"],
    labels: &["infrared.json", "IR_label.json"],
    videos: &["infrared.mp4", "IR.mp4"],
    prefixes: &["infrared", "ir"],
};

fn is_sequence(listing: &Listing) -> bool {
    [RGB, THERMAL].iter().any(|s| {
        listing.find_file(s.labels).is_some()
            || listing.find_file(s.videos).is_some()
            || listing.find_dir(s.folders).is_some()
    })
}

pub(crate) fn jobs(root: &Path, split: Split, registered: bool) -> Result<Jobs, DatasetError> {
    let dirs = find_sequences(root, "visible.json or infrared.json (IR_label.json)", &is_sequence)?;
    let dirs = in_split(root, dirs, split, "splits are folders named train, val and test")?;
    Ok(if registered {
        Jobs::clips(root, dirs, |dir, id| RegisteredClip::new(open(dir, id)?))
    } else {
        Jobs::clips(root, dirs, open)
    })
}

fn open(dir: &Path, id: String) -> Result<ClipSequence, DatasetError> {
    let listing = Listing::of(dir)?;
    let mut notes = Vec::new();
    let alone = listing.find_file(RGB.labels).is_none();
    let rgb = read_side(&listing, &RGB, false, &mut notes)?;
    let thermal = read_side(&listing, &THERMAL, alone, &mut notes)?;
    let registration = match listing.find_file(&["registration.txt"]) {
        Some(file) => Registration::Affine(super::registered::read_affine(&file)?),
        None if rgb.is_some() && thermal.is_some() => Registration::Unknown,
        None => Registration::Aligned,
    };
    let parts =
        Parts { id, dir: dir.to_owned(), rgb, thermal, registration, notes, ..Parts::default() };
    ClipSequence::build(parts, "pictures of the RGB nor of the thermal camera")
}

/// One camera; `None` when neither pictures nor labels of it are there. Pictures of any name in the
/// sequence folder count when the camera is `alone`.
fn read_side(
    listing: &Listing,
    side: &Side,
    alone: bool,
    notes: &mut Vec<Note>,
) -> Result<Option<Stream>, DatasetError> {
    let labels = listing.find_file(side.labels);
    let pictures = match listing.find_dir(side.folders) {
        Some(folder) => Some(Pictures::read(&folder)?),
        None => loose(listing, side, alone && labels.is_some())?,
    };
    match (pictures, labels) {
        (Some(pictures), Some(path)) => {
            let labels = read_label(&path, notes)?;
            Ok(Some(Stream { pictures, labels: vec![Arc::new(labels)] }))
        }
        (None, None) => Ok(None),
        (Some(_), None) => Err(DatasetError::Format {
            path: listing.dir().to_owned(),
            line: None,
            reason: format!("pictures but no labels: expected {}", side.labels.join(" or ")),
        }),
        (None, Some(_)) => {
            let folder = side.folders[0];
            let reason = match listing.find_file(side.videos) {
                Some(video) => {
                    let name = name_of(&video);
                    format!(
                        "{name} is a video, and only pictures are read; extract its frames: \
                         mkdir {folder} && ffmpeg -i {name} -q:v 2 {folder}/%06d.jpg"
                    )
                }
                None => format!("labels but no pictures: expected a folder {folder}/"),
            };
            Err(DatasetError::Format { path: listing.dir().to_owned(), line: None, reason })
        }
    }
}

/// Pictures in the sequence folder itself.
fn loose(listing: &Listing, side: &Side, any: bool) -> Result<Option<Pictures>, DatasetError> {
    let mut names = listing.pictures();
    if !any {
        names.retain(|n| {
            let name = n.to_string_lossy().to_ascii_lowercase();
            side.prefixes.iter().any(|p| name.starts_with(p))
        });
    }
    if names.is_empty() { Ok(None) } else { Pictures::of(listing.dir(), names).map(Some) }
}

#[derive(Deserialize)]
struct Label {
    exist: Vec<Flag>,
    gt_rect: Vec<Option<Vec<f64>>>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(untagged)]
enum Flag {
    Number(f64),
    Bool(bool),
}

/// Reads a label file.
///
/// # Errors
/// When it is not JSON of that form, the two lists differ in length, or a box has another number of
/// entries than four or none.
fn read_label(path: &Path, notes: &mut Vec<Note>) -> Result<Labels, DatasetError> {
    let bytes =
        std::fs::read(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
    let (rows, absent, lost) = parse_label(&bytes)
        .map_err(|(line, reason)| DatasetError::Format { path: path.to_owned(), line, reason })?;
    if lost > 0 {
        let text = format!("{lost} frames are marked as visible but have no box: taken for absent");
        notes.push(Note::quirk(path, text));
    }
    let mut labels = Labels::of(PathBuf::from(path), rows);
    labels.absent = absent;
    Ok(labels)
}

/// Boxes, absence by frame, and how many visible frames have no box.
type Parsed = (Vec<BBox>, Vec<bool>, usize);

fn parse_label(bytes: &[u8]) -> Result<Parsed, (Option<usize>, String)> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let label: Label = serde_json::from_slice(bytes).map_err(|e| {
        (Some(e.line()), format!("expected {{\"exist\": [..], \"gt_rect\": [[x,y,w,h], ..]}}: {e}"))
    })?;
    if label.exist.len() != label.gt_rect.len() {
        let (a, b) = (label.exist.len(), label.gt_rect.len());
        return Err((None, format!("'exist' has {a} entries and 'gt_rect' {b}: expected as many")));
    }
    let absent: Vec<bool> = label
        .exist
        .iter()
        .map(|flag| match flag {
            Flag::Number(v) => *v == 0.0,
            Flag::Bool(there) => !there,
        })
        .collect();
    let mut rows = Vec::with_capacity(label.gt_rect.len());
    for (i, rect) in label.gt_rect.iter().enumerate() {
        rows.push(match rect.as_deref() {
            None | Some([]) => BBox::default(),
            Some(&[x, y, w, h]) => BBox::new(x as f32, y as f32, w as f32, h as f32),
            // Some absent frames hold a single 0.
            Some(_) if absent[i] => BBox::default(),
            Some(other) => {
                let n = other.len();
                return Err((None, format!("gt_rect[{i}] has {n} numbers: expected x, y, w, h")));
            }
        });
    }
    let lost = rows.iter().zip(&absent).filter(|(b, gone)| !**gone && !b.is_valid()).count();
    Ok((rows, absent, lost))
}

#[cfg(test)]
#[path = "antiuav_tests.rs"]
mod tests;
