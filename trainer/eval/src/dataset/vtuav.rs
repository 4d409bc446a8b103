//! VTUAV: RGB-thermal clips from a drone, 1920 x 1080 in both sensors, separate boxes.
//!
//! ```text
//! <root>/test_ST_001/animal_001/rgb/000000.jpg ..   also train_.., testingset/.., any depth to 3
//!                              /ir/000000.jpg ..    or ir_gray/
//!                              /rgb.txt, ir.txt     x y w h, spaces, a row per TENTH frame
//! <root>/ST_val_split.txt, ST_train_split.txt       optional lists of names, LT_.. likewise
//! <root>/init_frame.json                            optional: {"animal_001": 3}
//! ```
//! Row `k` belongs to the frame whose file number is `offset + 10 k`; the offset is the number of
//! the first file unless `init_frame.json` says otherwise. (The publisher's `init_frame.npy` is a
//! Python pickle: convert it once, see `docs/datasets.md`; only training clips need it.) Frames in
//! between are not annotated; with the option `interpolated` they get a box where both neighbours
//! have one. Copies that hold only the annotated frames are recognised by their counts.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::clip::{ClipSequence, Labels, Stream};
use super::layout::{Jobs, Layout, Side};
use super::tree::{find_sequences, in_split, locate, name_of, select, split_of};
use super::{DatasetError, Note, Split};
use crate::boxes::Layout as BoxLayout;

/// Frames from annotated row to row.
pub const EVERY: usize = 10;

const LAYOUT: Layout = Layout {
    rgb: Side { folders: &["rgb"], files: &[("rgb.txt", BoxLayout::Xywh)] },
    thermal: Side { folders: &["ir", "ir_gray"], files: &[("ir.txt", BoxLayout::Xywh)] },
    both: true,
    what: "rgb/ nor ir/",
};

pub(crate) fn jobs(root: &Path, split: Split, interpolate: bool) -> Result<Jobs, DatasetError> {
    let dirs = find_sequences(root, "rgb/ and ir/", &|l| LAYOUT.is_sequence(l))?;
    let (dirs, problems) = by_split(root, dirs, split)?;
    let offsets = read_offsets(root)?;
    let unread = offsets.is_empty() && locate(root, &["init_frame.npy"]).is_some();
    let own_root = root.to_owned();
    let read = move |dir: &Path, id: String| {
        let mut parts = LAYOUT.read(dir, id)?;
        let offset = offsets.get(&name_of(dir)).copied();
        for stream in [&mut parts.rgb, &mut parts.thermal].into_iter().flatten() {
            place_rows(stream, offset, interpolate, &mut parts.notes);
        }
        if unread && split_of(&own_root, dir) == Some(Split::Train) {
            let text = "init_frame.npy is not read: rows are counted from the first frame; convert \
                        it to init_frame.json";
            parts.notes.push(Note::quirk(&own_root, text));
        }
        ClipSequence::build(parts, LAYOUT.what)
    };
    let mut found = Jobs::clips(root, dirs, read);
    found.problems = problems;
    Ok(found)
}

/// Lists of names where there are some, folders otherwise.
fn by_split(
    root: &Path,
    dirs: Vec<PathBuf>,
    split: Split,
) -> Result<(Vec<PathBuf>, Vec<DatasetError>), DatasetError> {
    if matches!(split, Split::Train | Split::Val) {
        let (mut kept, mut missing) = (Vec::new(), Vec::new());
        for part in ["ST", "LT"] {
            if let Some(list) = locate(root, &[&format!("{part}_{split}_split.txt")]) {
                let (some, without) = select(&list, &dirs)?;
                // A list without any folder belongs to a part that was not downloaded.
                if !some.is_empty() {
                    kept.extend(some);
                    missing.extend(without);
                }
            }
        }
        if !kept.is_empty() {
            return Ok((kept, missing));
        }
    }
    let how = "folders named train.. and test.. make splits, ST_train_split.txt and \
               ST_val_split.txt (LT_..) divide the training clips";
    Ok((in_split(root, dirs, split, how)?, Vec::new()))
}

/// File number of the first annotated frame, by sequence.
fn read_offsets(root: &Path) -> Result<HashMap<String, u64>, DatasetError> {
    let Some(path) = locate(root, &["init_frame.json"]) else { return Ok(HashMap::new()) };
    let bytes =
        std::fs::read(&path).map_err(|source| DatasetError::Io { path: path.clone(), source })?;
    serde_json::from_slice(&bytes).map_err(|e| DatasetError::Format {
        path,
        line: Some(e.line()),
        reason: format!("expected {{\"sequence\": first annotated frame, ..}}: {e}"),
    })
}

/// Tells the labels which frames their rows speak of.
fn place_rows(stream: &mut Stream, offset: Option<u64>, interpolate: bool, notes: &mut Vec<Note>) {
    let pictures = stream.pictures.len();
    let numbers: Vec<Option<u64>> = stream.pictures.numbers().collect();
    let (first, last) = (numbers.first().copied().flatten(), numbers.last().copied().flatten());
    for labels in &mut stream.labels {
        let labels: &mut Labels = Arc::make_mut(labels);
        let start = match (offset, first) {
            (Some(offset), Some(first)) => match offset.checked_sub(first) {
                Some(start) => usize::try_from(start).unwrap_or(usize::MAX),
                None => {
                    notes.push(Note::broken(
                        &labels.path,
                        format!("rows begin with frame {offset}, pictures only with {first}"),
                    ));
                    0
                }
            },
            _ => 0,
        };
        if labels.rows.len() == pictures && pictures > 1 {
            // Only annotated frames were kept.
            continue;
        }
        (labels.first, labels.every, labels.interpolate) = (start, EVERY, interpolate);
        if let (Some(first), Some(last)) = (first, last)
            && last.checked_sub(first).and_then(|n| usize::try_from(n).ok()) != Some(pictures - 1)
        {
            notes.push(Note::broken(
                &labels.path,
                format!(
                    "{pictures} pictures numbered {first} to {last}: frames are missing, so rows \
                     placed by position may be off"
                ),
            ));
        }
    }
}

#[cfg(test)]
#[path = "vtuav_tests.rs"]
mod tests;
