//! Stills with boxes: COCO annotation files, and plain lists.
//!
//! ```text
//! coco     annotations/instances_train2017.json + train2017/, <split>/_annotations.coco.json,
//!          <part>/coco.json + <part>/data/.., or the JSON file itself
//! stills   index.json: [{"id", "infrared" and/or "visible", "boxes": [{"xywh", "cls"}],
//!                        "split"?, "width"?, "height"?}], or {"stills": [..]}
//! ```
//! A still is a sequence of one frame; every box is a target. COCO pictures are RGB unless the
//! option `thermal` says otherwise (FLIR ADAS). COCO crowds are left out, boxes without area too.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;
use tsda_runtime::{BBox, Modality};

use super::layout::{Job, Jobs};
use super::tree::{Listing, name_of};
use super::{DatasetError, Note, Picture, Sequence, Split, decode_picture};

/// One still.
#[derive(Clone, Debug)]
pub struct Still {
    id: String,
    modalities: Vec<Modality>,
    paths: Vec<PathBuf>,
    size: Option<(usize, usize)>,
    boxes: Vec<(BBox, Option<String>)>,
    notes: Vec<Note>,
}

impl Still {
    /// Class of a target, where the annotation names one.
    pub fn class(&self, target: usize) -> Option<&str> {
        self.boxes.get(target)?.1.as_deref()
    }

    /// Checks that the pictures are there; notes boxes that cannot be right.
    fn checked(mut self, index: &Path) -> Result<Self, DatasetError> {
        for path in &self.paths {
            if !path.is_file() {
                return Err(DatasetError::Format {
                    path: index.to_owned(),
                    line: None,
                    reason: format!("'{}': picture {} does not exist", self.id, path.display()),
                });
            }
        }
        let before = self.boxes.len();
        self.boxes.retain(|(b, _)| b.is_valid());
        let empty = before - self.boxes.len();
        if empty > 0 {
            let text = format!("'{}': {empty} boxes without area left out", self.id);
            self.notes.push(Note::quirk(index, text));
        }
        if let Some((w, h)) = self.size {
            let outside = self.boxes.iter().filter(|(b, _)| !b.overlaps_image(w, h)).count();
            if outside > 0 {
                let text = format!("'{}': {outside} boxes outside its {w} x {h} picture", self.id);
                self.notes.push(Note::broken(index, text));
            }
        }
        Ok(self)
    }
}

impl Sequence for Still {
    fn id(&self) -> &str {
        &self.id
    }

    fn frames(&self) -> usize {
        1
    }

    fn modalities(&self) -> &[Modality] {
        &self.modalities
    }

    fn targets(&self) -> usize {
        self.boxes.len()
    }

    fn truth(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox> {
        let there = frame == 0 && self.modalities.contains(&modality);
        self.boxes.get(target).filter(|_| there).map(|(b, _)| *b)
    }

    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        let Some(path) = self.picture_path(frame, modality) else {
            return Err(DatasetError::NoSuchFrame { sequence: self.id.clone(), frame, modality });
        };
        let picture = decode_picture(&path, modality)?;
        match self.size {
            // A picture of another size would put every box in the wrong place, silently.
            Some(size) if size != (picture.width, picture.height) => Err(DatasetError::Picture {
                path,
                reason: format!(
                    "it is {} x {}, but the annotation says {} x {}",
                    picture.width, picture.height, size.0, size.1
                ),
            }),
            _ => Ok(picture),
        }
    }

    fn notes(&self) -> &[Note] {
        &self.notes
    }

    fn picture_path(&self, frame: usize, modality: Modality) -> Option<PathBuf> {
        let i = self.modalities.iter().position(|m| *m == modality)?;
        self.paths.get(i).filter(|_| frame == 0).cloned()
    }
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path, want: &str) -> Result<T, DatasetError> {
    let bytes =
        std::fs::read(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&bytes);
    serde_json::from_slice(bytes).map_err(|e| DatasetError::Format {
        path: path.to_owned(),
        line: Some(e.line()),
        reason: format!("expected {want}: {e}"),
    })
}

#[derive(Deserialize)]
#[serde(untagged)]
enum StillIndex {
    List(Vec<Value>),
    Named { stills: Vec<Value> },
}

#[derive(Deserialize)]
struct Entry {
    id: String,
    visible: Option<String>,
    infrared: Option<String>,
    split: Option<String>,
    width: Option<usize>,
    height: Option<usize>,
    boxes: Vec<EntryBox>,
}

#[derive(Deserialize)]
struct EntryBox {
    xywh: [f32; 4],
    cls: Option<String>,
}

/// Stills of an `index.json`.
pub(crate) fn stills(root: &Path, split: Split) -> Result<Jobs, DatasetError> {
    let path = if root.is_dir() { root.join(super::pairs::INDEX) } else { root.to_owned() };
    let base = path.parent().unwrap_or(root).to_owned();
    let format = |reason: String| DatasetError::Format { path: path.clone(), line: None, reason };
    let entries = match read_json(&path, "a list of stills, or {\"stills\": [..]}")? {
        StillIndex::List(list) | StillIndex::Named { stills: list } => list,
    };
    let total = entries.len();
    let mut found = Jobs::default();
    for (i, value) in entries.into_iter().enumerate() {
        let id = value.get("id").and_then(Value::as_str).unwrap_or("?").to_owned();
        let problem = |reason: String| format(format!("still {i} (0-based, id '{id}'): {reason}"));
        let entry = match serde_json::from_value::<Entry>(value) {
            Ok(entry) => entry,
            Err(e) => {
                found.problems.push(problem(e.to_string()));
                continue;
            }
        };
        if split != Split::All && !entry.split.as_deref().is_some_and(|s| split.takes(s)) {
            continue;
        }
        let sides = [(Modality::Rgb, entry.visible), (Modality::Thermal, entry.infrared)];
        let (modalities, paths): (Vec<_>, Vec<_>) =
            sides.into_iter().filter_map(|(m, p)| Some((m, base.join(p?)))).unzip();
        if paths.is_empty() {
            found.problems.push(problem("one of 'visible' and 'infrared' is required".into()));
            continue;
        }
        let boxes = entry.boxes.into_iter().map(|b| {
            let [x, y, w, h] = b.xywh;
            (BBox::new(x, y, w, h), b.cls)
        });
        let still = Still {
            id: entry.id,
            modalities,
            paths,
            size: entry.width.zip(entry.height),
            boxes: boxes.collect(),
            notes: Vec::new(),
        };
        found.jobs.push(job(still, path.clone()));
    }
    if found.jobs.is_empty() && found.problems.is_empty() {
        return Err(format(format!("none of the {total} stills is in split '{split}'")));
    }
    Ok(found)
}

fn job(still: Still, index: PathBuf) -> Job {
    Box::new(move || Ok(Box::new(still.checked(&index)?)))
}

#[derive(Deserialize)]
struct Coco {
    images: Vec<CocoImage>,
    #[serde(default)]
    annotations: Vec<CocoBox>,
    #[serde(default)]
    categories: Vec<CocoClass>,
}

#[derive(Deserialize)]
struct CocoImage {
    id: Value,
    file_name: String,
    width: Option<usize>,
    height: Option<usize>,
}

#[derive(Deserialize)]
struct CocoBox {
    image_id: Value,
    bbox: Option<Vec<f64>>,
    category_id: Option<Value>,
    iscrowd: Option<Value>,
}

#[derive(Deserialize)]
struct CocoClass {
    id: Value,
    name: String,
}

/// Stills of one or several COCO files.
pub(crate) fn coco(root: &Path, split: Split, modality: Modality) -> Result<Jobs, DatasetError> {
    let all = if root.is_dir() { coco_files(root)? } else { vec![root.to_owned()] };
    let none = |reason: String| DatasetError::Format { path: root.to_owned(), line: None, reason };
    if all.is_empty() {
        return Err(none(
            "no annotation file in it: expected annotations/instances_*.json, \
             <split>/_annotations.coco.json, coco.json or another *.json"
                .into(),
        ));
    }
    let total = all.len();
    let files: Vec<PathBuf> =
        all.into_iter().filter(|f| split == Split::All || coco_split(f) == Some(split)).collect();
    if files.is_empty() {
        return Err(none(format!(
            "none of its {total} annotation files is of split '{split}': file or folder names must \
             contain train, val or test"
        )));
    }
    let mut found = Jobs::default();
    let several = files.len() > 1;
    for file in files {
        // Pictures of two files may share their names.
        let below = file.strip_prefix(root).unwrap_or(&file).with_extension("");
        let prefix = if several { format!("{}/", below.display()) } else { String::new() };
        read_coco(&file, modality, &prefix, &mut found)?;
    }
    Ok(found)
}

/// Annotation files in a folder and the folders in it; captions and the like are passed over.
fn coco_files(root: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    let here = Listing::of(root)?;
    let mut files = Vec::new();
    let inner: Vec<Listing> = here.dirs().filter_map(|d| Listing::of(&d).ok()).collect();
    for listing in std::iter::once(&here).chain(&inner) {
        let json: Vec<(String, PathBuf)> = listing
            .texts()
            .map(|(name, path)| (name.to_ascii_lowercase(), path))
            .filter(|(name, _)| {
                let other = ["captions", "keypoints", "panoptic", "stuff", "image_info", "meta"];
                name.ends_with(".json") && !other.iter().any(|o| name.contains(o))
            })
            .collect();
        let instances = json.iter().any(|(name, _)| name.starts_with("instances"));
        let wanted = json.into_iter().filter(|(n, _)| !instances || n.starts_with("instances"));
        files.extend(wanted.map(|(_, path)| path));
    }
    Ok(files)
}

fn coco_split(file: &Path) -> Option<Split> {
    let parts = [Some(file), file.parent()];
    parts.into_iter().flatten().find_map(|p| {
        let name = name_of(p).to_ascii_lowercase();
        [("train", Split::Train), ("val", Split::Val), ("test", Split::Test)]
            .into_iter()
            .find_map(|(part, split)| name.contains(part).then_some(split))
    })
}

fn read_coco(
    file: &Path,
    modality: Modality,
    prefix: &str,
    found: &mut Jobs,
) -> Result<(), DatasetError> {
    let coco: Coco = read_json(file, "{\"images\": [..], \"annotations\": [..]}")?;
    let problem =
        |reason: String| DatasetError::Format { path: file.to_owned(), line: None, reason };
    let Some(first) = coco.images.first() else {
        return Err(problem("'images' is empty".into()));
    };
    let base = picture_folder(file, &first.file_name);
    let classes: HashMap<String, String> =
        coco.categories.into_iter().map(|c| (c.id.to_string(), c.name)).collect();
    let mut boxes: HashMap<String, Vec<(BBox, Option<String>)>> = HashMap::new();
    for (i, annotation) in coco.annotations.into_iter().enumerate() {
        let crowd = annotation.iscrowd.is_some_and(|v| v == 1 || v == true);
        let Some(bbox) = annotation.bbox.filter(|_| !crowd) else { continue };
        let [x, y, w, h] = bbox[..] else {
            let n = bbox.len();
            found.problems.push(problem(format!("annotations[{i}]: bbox has {n} numbers")));
            continue;
        };
        let class = annotation.category_id.and_then(|c| classes.get(&c.to_string()).cloned());
        let bbox = BBox::new(x as f32, y as f32, w as f32, h as f32);
        boxes.entry(annotation.image_id.to_string()).or_default().push((bbox, class));
    }
    for image in coco.images {
        let name = Path::new(&image.file_name).with_extension("").display().to_string();
        let still = Still {
            id: format!("{prefix}{name}"),
            modalities: vec![modality],
            paths: vec![base.join(&image.file_name)],
            size: image.width.zip(image.height),
            boxes: boxes.remove(&image.id.to_string()).unwrap_or_default(),
            notes: Vec::new(),
        };
        found.jobs.push(job(still, file.to_owned()));
    }
    if !boxes.is_empty() {
        let n: usize = boxes.values().map(Vec::len).sum();
        found.problems.push(problem(format!("{n} annotations name an image that is not listed")));
    }
    Ok(())
}

/// Folder that `file_name`s are relative to: the first of the usual ones that holds the picture.
fn picture_folder(file: &Path, first: &str) -> PathBuf {
    let own = file.parent().unwrap_or(Path::new("")).to_owned();
    let stem = name_of(&file.with_extension(""));
    let part = stem.strip_prefix("instances_").unwrap_or(&stem);
    let up = own.parent().unwrap_or(&own);
    let usual = [
        own.clone(),
        own.join("images"),
        own.join("data"),
        own.join(part),
        up.join(part),
        up.to_owned(),
        up.join("images"),
        up.join("images").join(part),
    ];
    usual.into_iter().find(|d| d.join(first).is_file()).unwrap_or(own)
}

#[cfg(test)]
#[path = "stills_tests.rs"]
mod tests;
