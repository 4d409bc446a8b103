//! Clips in LasHeR-like folders.
//!
//! ```text
//! <root>/[<tier>/]<name>/visible/v000.jpg ...     pictures, natural order of their names
//!                       /infrared/i000.jpg ...
//!                       /visible.txt              x,y,w,h per line, one line per frame
//!                       /infrared.txt
//! <root>/index.json                               optional: {"sequences": [{"name", "path", "split"}]}
//! ```
//! One of the two sensors may be missing. A sensor without a box file of its own takes the other's,
//! or `init.txt` (registered sets often hold one). Frames of the two sensors are paired by position, never by
//! name, and cut to the shorter folder. Lines may be separated by commas, tabs, semicolons or
//! spaces and end in CRLF; blank lines at the end are ignored. A line with NaN, or with a width or
//! height that is not positive (`0,0,0,0`), means the target is absent; frames after the last line
//! are not annotated.

use std::path::{Path, PathBuf};

use serde_json::Value;

use super::layout::{Jobs, Layout, Side};
use super::tree::{Listing, find_sequences, name_of};
use super::{ClipSequence, DatasetError, Sequence, Split};
use crate::boxes::Layout as BoxLayout;

const LAYOUT: Layout = Layout {
    rgb: Side {
        folders: &["visible"],
        files: &[
            ("visible.txt", BoxLayout::Xywh),
            ("infrared.txt", BoxLayout::Xywh),
            ("init.txt", BoxLayout::Xywh),
        ],
    },
    thermal: Side {
        folders: &["infrared"],
        files: &[
            ("infrared.txt", BoxLayout::Xywh),
            ("visible.txt", BoxLayout::Xywh),
            ("init.txt", BoxLayout::Xywh),
        ],
    },
    both: false,
    what: "visible/ nor infrared/",
};

/// Which sequences to keep.
#[derive(Clone, Debug, Default)]
pub struct SequenceFilter {
    /// Split; anything but [`Split::All`] needs an `index.json` that names splits.
    pub split: Split,
    /// Only sequences with both sensors.
    pub both_sensors: bool,
    /// Only sequences whose name contains this text.
    pub name_contains: Option<String>,
}

impl ClipSequence {
    /// Reads one folder of this layout; the id is the folder's name.
    ///
    /// # Errors
    /// When there are no pictures, no box file, or a box file has a line that cannot be read.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self, DatasetError> {
        let dir = dir.as_ref();
        LAYOUT.open(dir, name_of(dir))
    }
}

/// A folder of clips.
#[derive(Clone, Debug)]
pub struct SequencesDataset {
    sequences: Vec<ClipSequence>,
}

impl SequencesDataset {
    /// Reads the sequences of `dir` that pass `filter`: those its `index.json` lists, in that
    /// order; without one, every folder up to three levels down that holds `visible/` or
    /// `infrared/`, in natural order. `dir` may also be one sequence folder itself.
    ///
    /// # Errors
    /// When the folder, the index or a box file cannot be read, when a split is asked for and no
    /// index names splits, or when nothing is left.
    pub fn open(dir: impl AsRef<Path>, filter: &SequenceFilter) -> Result<Self, DatasetError> {
        let dir = dir.as_ref();
        let (folders, total) = folders(dir, filter)?;
        let mut sequences = Vec::new();
        for folder in folders {
            let sequence = ClipSequence::open(&folder)?;
            if !filter.both_sensors || sequence.modalities().len() == 2 {
                sequences.push(sequence);
            }
        }
        if sequences.is_empty() {
            return Err(none_left(dir, total, filter));
        }
        Ok(Self { sequences })
    }

    /// The sequences.
    pub fn sequences(&self) -> &[ClipSequence] {
        &self.sequences
    }

    /// The sequences, by value.
    pub fn into_sequences(self) -> Vec<ClipSequence> {
        self.sequences
    }
}

/// Folders that `filter` takes by split and name; with how many there are in all.
fn folders(dir: &Path, filter: &SequenceFilter) -> Result<(Vec<PathBuf>, usize), DatasetError> {
    let index = dir.join("index.json");
    let own = Listing::of(dir).is_ok_and(|l| LAYOUT.is_sequence(&l));
    let all: Vec<(PathBuf, Option<String>)> = if !own && index.is_file() {
        read_index(dir, &index)?
    } else if filter.split == Split::All {
        let found = find_sequences(dir, "visible/ or infrared/", &|l| LAYOUT.is_sequence(l))?;
        found.into_iter().map(|d| (d, None)).collect()
    } else {
        return Err(DatasetError::Format {
            path: dir.to_owned(),
            line: None,
            reason: format!(
                "split '{}' asked for, but there is no index.json that names splits; ask for \
                 'all' or add one",
                filter.split
            ),
        });
    };
    let total = all.len();
    let takes = |(folder, split): &(PathBuf, Option<String>)| {
        let in_split =
            filter.split == Split::All || split.as_deref().is_some_and(|s| filter.split.takes(s));
        let part = filter.name_contains.as_deref().unwrap_or("");
        in_split && name_of(folder).contains(part)
    };
    Ok((all.into_iter().filter(takes).map(|(folder, _)| folder).collect(), total))
}

fn none_left(dir: &Path, total: usize, filter: &SequenceFilter) -> DatasetError {
    DatasetError::Format {
        path: dir.to_owned(),
        line: None,
        reason: format!(
            "none of its {total} sequence folders is left (split '{}', both sensors: {}, name \
             contains: {:?}); a sequence folder holds visible/ or infrared/",
            filter.split, filter.both_sensors, filter.name_contains
        ),
    }
}

/// Sequences of `split`.
pub(crate) fn jobs(dir: &Path, split: Split) -> Result<Jobs, DatasetError> {
    let filter = SequenceFilter { split, ..SequenceFilter::default() };
    let (folders, total) = folders(dir, &filter)?;
    if folders.is_empty() {
        return Err(none_left(dir, total, &filter));
    }
    Ok(Jobs::clips(dir, folders, |dir, id| LAYOUT.open(dir, id)))
}

/// Folders and splits an index lists.
fn read_index(dir: &Path, index: &Path) -> Result<Vec<(PathBuf, Option<String>)>, DatasetError> {
    let text = std::fs::read_to_string(index)
        .map_err(|source| DatasetError::Io { path: index.to_owned(), source })?;
    let format =
        |line, reason: String| DatasetError::Format { path: index.to_owned(), line, reason };
    let root: Value = serde_json::from_str(&text)
        .map_err(|e| format(Some(e.line()), format!("not JSON: {e}")))?;
    let entries = root
        .get("sequences")
        .and_then(Value::as_array)
        .ok_or_else(|| format(None, "field 'sequences' is missing or not a list".into()))?;
    let mut folders = Vec::with_capacity(entries.len());
    for (i, entry) in entries.iter().enumerate() {
        let text = |field: &str| entry.get(field).and_then(Value::as_str);
        let path = text("path").or_else(|| text("name")).ok_or_else(|| {
            format(None, format!("sequences[{i}]: one of 'path' and 'name' is required"))
        })?;
        let folder = dir.join(path);
        if !Listing::of(&folder).is_ok_and(|l| LAYOUT.is_sequence(&l)) {
            return Err(format(
                None,
                format!(
                    "sequences[{i}]: {} holds neither visible/ nor infrared/",
                    folder.display()
                ),
            ));
        }
        folders.push((folder, text("split").map(str::to_owned)));
    }
    Ok(folders)
}

#[cfg(test)]
#[path = "sequences_tests.rs"]
mod tests;
