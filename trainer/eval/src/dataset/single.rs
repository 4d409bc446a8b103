//! Folders of one sensor: OTB style and GOT-10k style.
//!
//! ```text
//! OTB      <name>/img/0001.jpg ..     or the pictures in the folder itself
//!          <name>/groundtruth_rect.txt, or .1.txt and .2.txt for two targets, or groundtruth.txt
//! GOT-10k  <split>/<name>/00000001.jpg ..
//!          <split>/<name>/groundtruth.txt, absence.label, cover.label, cut_by_image.label
//!          <split>/list.txt           order of the sequences
//! ```
//! OTB boxes count pixels from 1 and come out from 0 (option `zero-based` for copies that already
//! do). Clips annotated only from a later frame on (`David` from 300, ..) are cut to what is
//! annotated. GOT-10k frames with `absence` 1 or `cover` 0 are absent; a test clip has only its
//! first box. Both styles hold RGB unless the option `thermal` says otherwise (PTB-TIR, LSOTB-TIR).

use std::path::{Path, PathBuf};
use std::sync::Arc;

use tsda_runtime::{BBox, Modality};

use super::clip::{ClipSequence, Labels, Parts, Pictures, Stream};
use super::layout::Jobs;
use super::text::{read_flags, read_numbers};
use super::tree::{Listing, find_sequences, in_split, select};
use super::{DatasetError, Note, Split, read_boxes};
use crate::boxes::Layout as BoxLayout;

/// OTB clips whose first row does not belong to their first picture, with the number of the picture
/// it belongs to.
const STARTS: [(&str, u64); 4] =
    [("David", 300), ("BlurCar1", 247), ("BlurCar3", 3), ("BlurCar4", 18)];

/// OTB clips that are annotated only at their beginning.
const CUT: [&str; 4] = ["Football1", "Freeman3", "Freeman4", "Diving"];

fn parts(id: String, dir: &Path, stream: Stream, modality: Modality, notes: Vec<Note>) -> Parts {
    let (rgb, thermal) = match modality {
        Modality::Rgb => (Some(stream), None),
        Modality::Thermal => (None, Some(stream)),
    };
    Parts { id, dir: dir.to_owned(), rgb, thermal, notes, ..Parts::default() }
}

/// `groundtruth_rect.txt`, `groundtruth_rect.2.txt`, .., else `groundtruth.txt`.
fn otb_files(listing: &Listing) -> Vec<PathBuf> {
    let rect = |name: &str| {
        let name = name.to_ascii_lowercase();
        name.starts_with("groundtruth_rect") && name.ends_with(".txt")
    };
    let all: Vec<PathBuf> =
        listing.texts().filter(|(name, _)| rect(name)).map(|(_, path)| path).collect();
    if all.is_empty() { listing.find_file(&["groundtruth.txt"]).into_iter().collect() } else { all }
}

pub(crate) fn otb(
    root: &Path,
    split: Split,
    modality: Modality,
    zero_based: bool,
) -> Result<Jobs, DatasetError> {
    let what = "groundtruth_rect.txt and img/";
    let dirs = find_sequences(root, what, &|l| !otb_files(l).is_empty())?;
    let dirs = in_split(root, dirs, split, "splits are folders named train, val and test")?;
    Ok(Jobs::clips(root, dirs, move |dir, id| {
        let listing = Listing::of(dir)?;
        let mut pictures = match listing.find_dir(&["img", "imgs", "images"]) {
            Some(folder) => Pictures::read(&folder)?,
            None => Pictures::of(dir, listing.pictures())?,
        };
        let mut labels = Vec::new();
        for path in otb_files(&listing) {
            let mut rows = read_boxes(&path, BoxLayout::Xywh)?;
            if !zero_based {
                for b in rows.iter_mut().filter(|b| b.is_valid()) {
                    *b = BBox::new(b.x - 1.0, b.y - 1.0, b.w, b.h);
                }
            }
            labels.push(Labels::of(path, rows));
        }
        let rows = labels.iter().map(|l| l.rows.len()).max().unwrap_or(0);
        let mut notes = Vec::new();
        if let Some(from) = window(&id, &pictures, rows) {
            let n = pictures.len();
            notes.push(Note::quirk(dir, format!("annotated from picture {} of {n} on", from + 1)));
            pictures.window(from, rows);
        }
        let labels = labels.into_iter().map(Arc::new).collect();
        let stream = Stream { pictures, labels };
        ClipSequence::build(parts(id, dir, stream, modality, notes), what)
    }))
}

/// Where the annotated part of a clip begins, for the clips known to have less than all of it
/// annotated.
fn window(id: &str, pictures: &Pictures, rows: usize) -> Option<usize> {
    if rows >= pictures.len() {
        return None;
    }
    if CUT.contains(&id) {
        return Some(0);
    }
    let (_, start) = STARTS.iter().find(|(name, _)| *name == id)?;
    let from = pictures.numbers().position(|n| n == Some(*start))?;
    (from + rows <= pictures.len()).then_some(from)
}

pub(crate) fn got10k(root: &Path, split: Split, modality: Modality) -> Result<Jobs, DatasetError> {
    let what = "groundtruth.txt and pictures";
    let dirs = find_sequences(root, what, &|l| l.find_file(&["groundtruth.txt"]).is_some())?;
    let dirs = in_split(root, dirs, split, "splits are folders named train, val and test")?;
    let (dirs, problems) = in_listed_order(dirs)?;
    let mut found = Jobs::clips(root, dirs, move |dir, id| read_got10k(dir, id, modality, what));
    found.problems = problems;
    Ok(found)
}

/// `list.txt` beside the sequences names them in the publisher's order.
fn in_listed_order(dirs: Vec<PathBuf>) -> Result<(Vec<PathBuf>, Vec<DatasetError>), DatasetError> {
    let (mut ordered, mut problems) = (Vec::new(), Vec::new());
    let mut rest = &dirs[..];
    while let Some(parent) = rest.first().and_then(|d| d.parent()) {
        let n = rest.iter().take_while(|d| d.parent() == Some(parent)).count();
        let (together, others) = rest.split_at(n);
        rest = others;
        let list = parent.join("list.txt");
        if list.is_file() {
            let (kept, missing) = select(&list, together)?;
            ordered.extend(kept);
            problems.extend(missing);
        } else {
            ordered.extend_from_slice(together);
        }
    }
    Ok((ordered, problems))
}

fn read_got10k(
    dir: &Path,
    id: String,
    modality: Modality,
    what: &str,
) -> Result<ClipSequence, DatasetError> {
    let listing = Listing::of(dir)?;
    let pictures = Pictures::of(dir, listing.pictures())?;
    let mut notes = Vec::new();
    let truth = dir.join("groundtruth.txt");
    let mut labels = Labels::of(&truth, read_boxes(&truth, BoxLayout::Xywh)?);
    labels.partial = labels.rows.len() == 1;
    let rows = labels.rows.len();
    // A flag per row; a file of another length cannot be trusted row by row.
    let mut check = |path: &Path, n: usize| {
        if n != rows {
            notes.push(Note::broken(path, format!("{n} entries for {rows} boxes: not used")));
        }
        n == rows
    };
    if let Some(path) = listing.find_file(&["absence.label"]) {
        let flags = read_flags(&path)?;
        if check(&path, flags.len()) {
            labels.absent = flags;
        }
    }
    if let Some(path) = listing.find_file(&["cover.label"]) {
        let cover = read_numbers(&path)?;
        if check(&path, cover.len()) {
            labels.absent.resize(rows, false);
            for (gone, cover) in labels.absent.iter_mut().zip(&cover) {
                *gone |= *cover <= 0.0;
            }
            labels.visibility = cover.iter().map(|c| (c / 8.0).clamp(0.0, 1.0) as f32).collect();
        }
    }
    let mut tags = Vec::new();
    if let Some(path) = listing.find_file(&["cut_by_image.label"]) {
        let flags = read_flags(&path)?;
        if check(&path, flags.len()) {
            tags.push(("cut_by_image".to_owned(), flags));
        }
    }
    let stream = Stream { pictures, labels: vec![Arc::new(labels)] };
    let mut parts = parts(id, dir, stream, modality, notes);
    parts.tags = tags;
    ClipSequence::build(parts, what)
}

#[cfg(test)]
#[path = "single_tests.rs"]
mod tests;
