//! Clips in LasHeR-like folders.
//!
//! ```text
//! <root>/[<tier>/]<name>/visible/v000.jpg ...     pictures, natural order of their names
//!                       /infrared/i000.jpg ...
//!                       /visible.txt              x,y,w,h per line, one line per frame
//!                       /infrared.txt
//! <root>/index.json                               optional: {"sequences": [{"name", "path", "split"}]}
//! ```
//! One of the two sensors may be missing. A sensor without a box file of its own takes the other's
//! (registered sets often hold one). Frames of the two sensors are paired by position, never by
//! name, and cut to the shorter folder. Lines may be separated by commas, tabs, semicolons or
//! spaces and end in CRLF; blank lines at the end are ignored. A line with NaN, or with a width or
//! height that is not positive (`0,0,0,0`), means the target is absent; frames after the last line
//! are not annotated.

use std::path::{Path, PathBuf};

use serde_json::Value;
use tsda_runtime::{BBox, Modality};

use super::picture::is_picture;
use super::{DatasetError, Picture, Sequence, Split, decode_picture, natural_cmp};

/// How deep below the root sequence folders are looked for: `<root>/<tier>/<name>`.
const DEPTH: usize = 2;

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

/// Pictures and boxes of one sensor.
#[derive(Clone, Debug)]
struct Stream {
    pictures: Vec<PathBuf>,
    boxes: Vec<Option<BBox>>,
}

/// One clip with one target.
#[derive(Clone, Debug)]
pub struct ClipSequence {
    id: String,
    dir: PathBuf,
    frames: usize,
    modalities: Vec<Modality>,
    rgb: Option<Stream>,
    thermal: Option<Stream>,
    notes: Vec<String>,
}

impl ClipSequence {
    /// Reads one sequence folder; the id is the folder's name.
    ///
    /// # Errors
    /// When there are no pictures, no box file, or a box file has a line that cannot be read.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self, DatasetError> {
        let dir = dir.as_ref();
        let id = match dir.file_name() {
            Some(name) => name.to_string_lossy().into_owned(),
            None => dir.display().to_string(),
        };
        let mut notes = Vec::new();
        let rgb = read_stream(dir, Modality::Rgb, &mut notes)?;
        let thermal = read_stream(dir, Modality::Thermal, &mut notes)?;
        let lengths: Vec<usize> =
            [&rgb, &thermal].into_iter().flatten().map(|s| s.pictures.len()).collect();
        let Some(&frames) = lengths.iter().min() else {
            return Err(DatasetError::Format {
                path: dir.to_owned(),
                line: None,
                reason: "not a sequence folder: it has neither visible/ nor infrared/".into(),
            });
        };
        if lengths.iter().any(|&n| n != frames) {
            notes.push(format!(
                "visible/ and infrared/ hold {} and {} pictures: cut to {frames}",
                lengths[0], lengths[1]
            ));
        }
        for (stream, name) in [(&rgb, "visible"), (&thermal, "infrared")] {
            if let Some(s) = stream
                && s.boxes.len() != frames
            {
                notes.push(format!("{name}: {} boxes for {frames} frames", s.boxes.len()));
            }
        }
        let modalities = [(Modality::Rgb, rgb.is_some()), (Modality::Thermal, thermal.is_some())]
            .into_iter()
            .filter_map(|(m, there)| there.then_some(m))
            .collect();
        Ok(Self { id, dir: dir.to_owned(), frames, modalities, rgb, thermal, notes })
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// What did not fit and was cut (different numbers of pictures or boxes), in words.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// File of one frame of one sensor.
    pub fn path(&self, frame: usize, modality: Modality) -> Option<&Path> {
        if frame >= self.frames {
            return None;
        }
        self.stream(modality)?.pictures.get(frame).map(PathBuf::as_path)
    }

    fn stream(&self, modality: Modality) -> Option<&Stream> {
        match modality {
            Modality::Rgb => self.rgb.as_ref(),
            Modality::Thermal => self.thermal.as_ref(),
        }
    }
}

impl Sequence for ClipSequence {
    fn id(&self) -> &str {
        &self.id
    }

    fn frames(&self) -> usize {
        self.frames
    }

    fn modalities(&self) -> &[Modality] {
        &self.modalities
    }

    fn targets(&self) -> usize {
        1
    }

    fn truth(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox> {
        if target != 0 || frame >= self.frames {
            return None;
        }
        self.stream(modality)?.boxes.get(frame).copied().flatten()
    }

    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        match self.path(frame, modality) {
            Some(path) => decode_picture(path, modality),
            None => Err(DatasetError::NoSuchFrame { sequence: self.id.clone(), frame, modality }),
        }
    }
}

/// A folder of clips.
#[derive(Clone, Debug)]
pub struct SequencesDataset {
    sequences: Vec<ClipSequence>,
}

impl SequencesDataset {
    /// Reads the sequences of `dir` that pass `filter`: those its `index.json` lists, in that
    /// order; without one, every folder up to two levels down that holds `visible/` or
    /// `infrared/`, in natural order. `dir` may also be one sequence folder itself.
    ///
    /// # Errors
    /// When the folder, the index or a box file cannot be read, when a split is asked for and no
    /// index names splits, or when nothing is left.
    pub fn open(dir: impl AsRef<Path>, filter: &SequenceFilter) -> Result<Self, DatasetError> {
        let dir = dir.as_ref();
        let format = |path: &Path, reason: String| DatasetError::Format {
            path: path.to_owned(),
            line: None,
            reason,
        };
        let index = dir.join("index.json");
        let (folders, listed) = if is_sequence(dir) {
            (vec![(dir.to_owned(), None)], false)
        } else if index.is_file() {
            (read_index(dir, &index)?, true)
        } else {
            let mut found = Vec::new();
            find(dir, DEPTH, &mut found)?;
            (found.into_iter().map(|d| (d, None)).collect(), false)
        };
        if !listed && filter.split != Split::All {
            return Err(format(
                dir,
                format!(
                    "split '{}' asked for, but there is no index.json that names splits; \
                     ask for 'all' or add one",
                    filter.split
                ),
            ));
        }
        let total = folders.len();
        let mut sequences = Vec::new();
        for (folder, split) in folders {
            if filter.split != Split::All
                && !split.as_deref().is_some_and(|s| filter.split.takes(s))
            {
                continue;
            }
            let name = folder.file_name().map(|n| n.to_string_lossy().into_owned());
            if let (Some(part), Some(name)) = (&filter.name_contains, name)
                && !name.contains(part.as_str())
            {
                continue;
            }
            let sequence = ClipSequence::open(&folder)?;
            if !filter.both_sensors || sequence.modalities.len() == 2 {
                sequences.push(sequence);
            }
        }
        if sequences.is_empty() {
            return Err(format(
                dir,
                format!(
                    "none of its {total} sequence folders is left (split '{}', both sensors: {}, \
                     name contains: {:?}); a sequence folder holds visible/ or infrared/",
                    filter.split, filter.both_sensors, filter.name_contains
                ),
            ));
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

fn is_sequence(dir: &Path) -> bool {
    dir.join("visible").is_dir() || dir.join("infrared").is_dir()
}

/// Names in `dir`, natural order, without hidden ones.
fn list(dir: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    let io = |source| DatasetError::Io { path: dir.to_owned(), source };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(io)? {
        let name = entry.map_err(io)?.file_name();
        if !name.to_string_lossy().starts_with('.') {
            names.push(name);
        }
    }
    names.sort_by(|a, b| natural_cmp(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(names.into_iter().map(|n| dir.join(n)).collect())
}

fn find(dir: &Path, depth: usize, found: &mut Vec<PathBuf>) -> Result<(), DatasetError> {
    for path in list(dir)?.into_iter().filter(|p| p.is_dir()) {
        if is_sequence(&path) {
            found.push(path);
        } else if depth > 1 {
            find(&path, depth - 1, found)?;
        }
    }
    Ok(())
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
        if !is_sequence(&folder) {
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

/// Pictures and boxes of one sensor; `None` when its folder is not there.
fn read_stream(
    dir: &Path,
    modality: Modality,
    notes: &mut Vec<String>,
) -> Result<Option<Stream>, DatasetError> {
    let (own, other) = match modality {
        Modality::Rgb => ("visible", "infrared"),
        Modality::Thermal => ("infrared", "visible"),
    };
    let folder = dir.join(own);
    if !folder.is_dir() {
        return Ok(None);
    }
    let pictures: Vec<PathBuf> = list(&folder)?.into_iter().filter(|p| is_picture(p)).collect();
    if pictures.is_empty() {
        return Err(DatasetError::Format {
            path: folder,
            line: None,
            reason: "no pictures in it (jpg, png or bmp)".into(),
        });
    }
    let mut file = dir.join(format!("{own}.txt"));
    if !file.is_file() {
        let second = dir.join(format!("{other}.txt"));
        if second.is_file() {
            notes.push(format!("no {own}.txt: boxes of {other}.txt used for both sensors"));
            file = second;
        }
    }
    let boxes = read_boxes(&file)?;
    Ok(Some(Stream { pictures, boxes }))
}

/// Reads one box per line, `None` where the target is absent; see the module for what is
/// tolerated.
///
/// # Errors
/// When the file cannot be read, holds no line, or a line does not hold four numbers.
pub fn read_boxes(path: &Path) -> Result<Vec<Option<BBox>>, DatasetError> {
    let rows = crate::otb::read_rows(path)?;
    Ok(rows.into_iter().map(|b| b.is_valid().then_some(b)).collect())
}

#[cfg(test)]
#[path = "sequences_tests.rs"]
mod tests;
