//! Registered RGB-thermal still pairs: a folder with an `index.json`.
//!
//! ```text
//! {"pairs": [{"id": "a1", "split": "train", "visible": "train/visible/a1.jpg",
//!             "infrared": "train/infrared/a1.jpg", "width": 640, "height": 480,
//!             "boxes": [{"xywh": [435.0, 161.6, 39.3, 18.0], "cls": "car"}]}]}
//! ```
//! Paths are relative to the folder. `id`, `split`, `visible`, `infrared` and `boxes` (may be
//! empty) with their `xywh` are required; `width`/`height` are checked against the pictures when
//! given; everything else is left alone. Both pictures have one size and share the boxes.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use serde_json::Value;
use tsda_runtime::{BBox, Modality};

use super::{DatasetError, Picture, Sequence, Split, decode_picture};

/// Name of the index inside the folder.
pub const INDEX: &str = "index.json";

/// One annotated box, valid in both pictures.
#[derive(Clone, Debug, PartialEq)]
pub struct PairBox {
    /// Position in pixels.
    pub bbox: BBox,
    /// Object class, where the index names one.
    pub class: Option<String>,
}

/// One registered pair: a sequence of one frame with both sensors.
#[derive(Clone, Debug)]
pub struct Pair {
    id: String,
    split: String,
    visible: PathBuf,
    infrared: PathBuf,
    size: Option<(usize, usize)>,
    boxes: Vec<PairBox>,
}

impl Pair {
    /// Split the index puts it in.
    pub fn split(&self) -> &str {
        &self.split
    }

    /// `(width, height)` in pixels, where the index gives it (no decoding).
    pub fn size(&self) -> Option<(usize, usize)> {
        self.size
    }

    /// All boxes.
    pub fn boxes(&self) -> &[PairBox] {
        &self.boxes
    }

    /// File of one sensor's picture.
    pub fn path(&self, modality: Modality) -> &Path {
        match modality {
            Modality::Rgb => &self.visible,
            Modality::Thermal => &self.infrared,
        }
    }
}

impl Sequence for Pair {
    fn id(&self) -> &str {
        &self.id
    }

    fn frames(&self) -> usize {
        1
    }

    fn modalities(&self) -> &[Modality] {
        &[Modality::Rgb, Modality::Thermal]
    }

    fn targets(&self) -> usize {
        self.boxes.len()
    }

    fn truth(&self, target: usize, frame: usize, _modality: Modality) -> Option<BBox> {
        if frame == 0 { self.boxes.get(target).map(|b| b.bbox) } else { None }
    }

    fn picture_path(&self, frame: usize, modality: Modality) -> Option<PathBuf> {
        (frame == 0).then(|| self.path(modality).to_owned())
    }

    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        if frame != 0 {
            return Err(DatasetError::NoSuchFrame { sequence: self.id.clone(), frame, modality });
        }
        let path = self.path(modality);
        let picture = decode_picture(path, modality)?;
        match self.size {
            // A picture of another size would put every box in the wrong place, silently.
            Some((w, h)) if (picture.width, picture.height) != (w, h) => {
                Err(DatasetError::Picture {
                    path: path.to_owned(),
                    reason: format!(
                        "it is {} x {}, but the index says {w} x {h} (pair '{}')",
                        picture.width, picture.height, self.id
                    ),
                })
            }
            _ => Ok(picture),
        }
    }
}

/// A folder of registered pairs, one split of it.
#[derive(Clone, Debug)]
pub struct PairsDataset {
    pairs: Vec<Pair>,
}

impl PairsDataset {
    /// Reads `dir/index.json` and keeps the pairs of `split`, in the order of the index. Pictures
    /// are only looked for, not decoded.
    ///
    /// # Errors
    /// When the index cannot be read, a required field is missing or of the wrong kind, a box is
    /// not a box or lies outside its picture, an id stands twice, a picture file is missing, or
    /// no pair is in `split`. Each names the index and the pair.
    pub fn open(dir: impl AsRef<Path>, split: Split) -> Result<Self, DatasetError> {
        let (set, problems) = Self::scan(dir.as_ref(), split)?;
        match problems.into_iter().next() {
            Some(first) => Err(first),
            None => Ok(set),
        }
    }

    /// As [`Self::open`], but passes over pairs that cannot be used and says what is wrong.
    pub(crate) fn scan(
        dir: &Path,
        split: Split,
    ) -> Result<(Self, Vec<DatasetError>), DatasetError> {
        let path = dir.join(INDEX);
        let text = std::fs::read_to_string(&path)
            .map_err(|source| DatasetError::Io { path: path.clone(), source })?;
        let root: Value = serde_json::from_str(&text).map_err(|e| DatasetError::Format {
            path: path.clone(),
            line: Some(e.line()),
            reason: format!("not JSON: {e}"),
        })?;
        let format =
            |reason: String| DatasetError::Format { path: path.clone(), line: None, reason };
        let entries = root
            .get("pairs")
            .and_then(Value::as_array)
            .ok_or_else(|| format("field 'pairs' is missing or not a list".into()))?;
        let mut pairs = Vec::with_capacity(entries.len());
        let mut seen = HashSet::new();
        let mut problems = Vec::new();
        for (i, entry) in entries.iter().enumerate() {
            let pair = match read_pair(dir, entry) {
                Ok(pair) => pair,
                Err(reason) => {
                    let who = match entry.get("id").and_then(Value::as_str) {
                        Some(id) => format!("pair '{id}'"),
                        None => format!("pair number {i} (0-based)"),
                    };
                    problems.push(format(format!("{who}: {reason}")));
                    continue;
                }
            };
            if !seen.insert(pair.id.clone()) {
                problems.push(format(format!("pair '{}' stands twice: ids must differ", pair.id)));
                continue;
            }
            if split.takes(&pair.split) {
                let missing = [&pair.visible, &pair.infrared].into_iter().find(|f| !f.is_file());
                let problem = missing.map(|file| {
                    let file = file.display();
                    format(format!("pair '{}': picture {file} does not exist", pair.id))
                });
                match problem {
                    Some(problem) => problems.push(problem),
                    None => pairs.push(pair),
                }
            }
        }
        if pairs.is_empty() && problems.is_empty() {
            return Err(format(format!(
                "none of the {} pairs is in split '{split}'",
                entries.len()
            )));
        }
        Ok((Self { pairs }, problems))
    }

    /// The pairs.
    pub fn pairs(&self) -> &[Pair] {
        &self.pairs
    }

    /// The pairs, by value.
    pub fn into_pairs(self) -> Vec<Pair> {
        self.pairs
    }
}

/// One entry of the index; the error text says what is wrong with which field.
fn read_pair(dir: &Path, entry: &Value) -> Result<Pair, String> {
    let text = |field: &str| match entry.get(field) {
        Some(Value::String(s)) if !s.is_empty() => Ok(s.clone()),
        Some(other) => Err(format!("field '{field}' must be a non-empty text, found {other}")),
        None => Err(format!("required field '{field}' is missing")),
    };
    let side = |field: &str| match entry.get(field) {
        None | Some(Value::Null) => Ok(None),
        Some(v) => match v.as_u64().and_then(|n| usize::try_from(n).ok()) {
            Some(n) if n > 0 => Ok(Some(n)),
            _ => Err(format!("field '{field}' must be a positive whole number, found {v}")),
        },
    };
    let size = side("width")?.zip(side("height")?);
    let listed = match entry.get("boxes") {
        Some(Value::Array(list)) => list,
        Some(other) => return Err(format!("field 'boxes' must be a list, found {other}")),
        None => return Err("required field 'boxes' is missing ([] for none)".into()),
    };
    let mut boxes = Vec::with_capacity(listed.len());
    for (i, item) in listed.iter().enumerate() {
        let bbox = read_xywh(item).map_err(|e| format!("boxes[{i}]: {e}"))?;
        if let Some((w, h)) = size
            && !bbox.overlaps_image(w, h)
        {
            return Err(format!("boxes[{i}]: {bbox:?} lies outside the {w} x {h} picture"));
        }
        let class = item.get("cls").and_then(Value::as_str).map(str::to_owned);
        boxes.push(PairBox { bbox, class });
    }
    Ok(Pair {
        id: text("id")?,
        split: text("split")?,
        visible: dir.join(text("visible")?),
        infrared: dir.join(text("infrared")?),
        size,
        boxes,
    })
}

fn read_xywh(item: &Value) -> Result<BBox, String> {
    let found = item.get("xywh").ok_or("required field 'xywh' is missing")?;
    let numbers: Option<Vec<f32>> = found
        .as_array()
        .and_then(|list| list.iter().map(|v| v.as_f64().map(|n| n as f32)).collect());
    match numbers.as_deref() {
        Some(&[x, y, w, h]) if BBox::new(x, y, w, h).is_valid() => Ok(BBox::new(x, y, w, h)),
        _ => Err(format!(
            "field 'xywh' must be four finite numbers with positive width and height, found {found}"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn write(dir: &Path, index: &Value) {
        for (folder, id) in [("train", "a"), ("val", "b")] {
            for kind in ["visible", "infrared"] {
                let to = dir.join(folder).join(kind);
                std::fs::create_dir_all(&to).unwrap();
                image::RgbImage::from_pixel(8, 6, image::Rgb([9, 9, 9]))
                    .save(to.join(format!("{id}.png")))
                    .unwrap();
            }
        }
        std::fs::write(dir.join(INDEX), index.to_string()).unwrap();
    }

    fn index() -> Value {
        json!({"version": 1, "pairs": [
            {"id": "a", "split": "train", "visible": "train/visible/a.png",
             "infrared": "train/infrared/a.png", "width": 8, "height": 6, "night": null,
             "boxes": [{"xywh": [1, 2.5, 3, 3], "cls": "car", "score": 0.5},
                       {"xywh": [-1.0, 0, 3, 3]}]},
            {"id": "b", "split": "val", "visible": "val/visible/b.png",
             "infrared": "val/infrared/b.png", "boxes": []},
        ]})
    }

    #[test]
    fn reads_pairs_of_one_split_with_their_boxes() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), &index());
        let train = PairsDataset::open(dir.path(), Split::Train).unwrap();
        assert_eq!(train.pairs().len(), 1);
        let pair = &train.pairs()[0];
        assert_eq!((pair.id(), pair.frames(), pair.targets()), ("a", 1, 2));
        assert_eq!(pair.truth(0, 0, Modality::Rgb), Some(BBox::new(1.0, 2.5, 3.0, 3.0)));
        assert_eq!(pair.truth(0, 0, Modality::Rgb), pair.truth(0, 0, Modality::Thermal));
        assert_eq!(pair.truth(0, 1, Modality::Rgb), None);
        assert_eq!(pair.truth(2, 0, Modality::Rgb), None);
        assert_eq!(pair.boxes()[0].class.as_deref(), Some("car"));
        assert_eq!(pair.picture(0, Modality::Rgb).unwrap().channels, 3);
        let thermal = pair.picture(0, Modality::Thermal).unwrap();
        assert_eq!((thermal.channels, thermal.data.len()), (1, 48));
        assert!(matches!(
            pair.picture(1, Modality::Rgb),
            Err(DatasetError::NoSuchFrame { frame: 1, .. })
        ));
        let all = PairsDataset::open(dir.path(), Split::All).unwrap();
        assert_eq!(all.pairs()[1].targets(), 0);
    }

    #[test]
    fn every_defect_names_the_index_and_the_pair() {
        type Edit = fn(&mut Value);
        let edits: [(&str, Edit); 11] = [
            ("field 'pairs'", |v| *v = json!({"items": []})),
            ("pair number 1 (0-based): required field 'id'", |v| {
                v["pairs"][1].as_object_mut().unwrap().remove("id");
            }),
            ("pair 'b': required field 'split'", |v| {
                v["pairs"][1].as_object_mut().unwrap().remove("split");
            }),
            ("pair 'a': required field 'infrared'", |v| {
                v["pairs"][0].as_object_mut().unwrap().remove("infrared");
            }),
            ("pair 'a': required field 'boxes'", |v| {
                v["pairs"][0].as_object_mut().unwrap().remove("boxes");
            }),
            ("pair 'a': boxes[1]: required field 'xywh'", |v| {
                v["pairs"][0]["boxes"][1] = json!({"cls": "car"});
            }),
            ("pair 'a': boxes[0]: field 'xywh' must be four", |v| {
                v["pairs"][0]["boxes"][0]["xywh"] = json!([1, 2, 0, 3]);
            }),
            ("boxes[0]: BBox", |v| v["pairs"][0]["boxes"][0]["xywh"] = json!([8, 0, 3, 3])),
            ("field 'width'", |v| v["pairs"][0]["width"] = json!(0)),
            ("stands twice", |v| v["pairs"][1]["id"] = json!("a")),
            ("nowhere.png does not exist", |v| v["pairs"][0]["visible"] = json!("nowhere.png")),
        ];
        for (want, edit) in edits {
            let dir = tempfile::tempdir().unwrap();
            let mut v = index();
            edit(&mut v);
            write(dir.path(), &v);
            let e = PairsDataset::open(dir.path(), Split::All).unwrap_err().to_string();
            assert!(e.contains(want) && e.contains(INDEX), "{want}: {e}");
        }
    }

    #[test]
    fn unreadable_indices_and_empty_splits_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let e = PairsDataset::open(dir.path(), Split::All).unwrap_err();
        assert!(matches!(e, DatasetError::Io { .. }) && e.to_string().contains(INDEX));
        std::fs::write(dir.path().join(INDEX), "{\n\"pairs\": [,]}").unwrap();
        let e = PairsDataset::open(dir.path(), Split::All).unwrap_err().to_string();
        assert!(e.contains("line 2"), "{e}");
        write(dir.path(), &index());
        let e = PairsDataset::open(dir.path(), Split::Test).unwrap_err().to_string();
        assert!(e.contains("none of the 2 pairs is in split 'test'"), "{e}");
    }

    #[test]
    fn a_picture_of_another_size_than_the_index_says_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let mut v = index();
        v["pairs"][0]["width"] = json!(9);
        write(dir.path(), &v);
        let train = PairsDataset::open(dir.path(), Split::Train).unwrap();
        let e = train.pairs()[0].picture(0, Modality::Rgb).unwrap_err().to_string();
        assert!(e.contains("8 x 6") && e.contains("9 x 6") && e.contains("a.png"), "{e}");
    }

    #[test]
    fn opens_the_shared_pack() {
        let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/pairs");
        if !dir.exists() {
            println!("skipped: {} is not there", dir.display());
            return;
        }
        for (split, pairs) in [(Split::Train, 232), (Split::Val, 38), (Split::All, 270)] {
            assert_eq!(PairsDataset::open(&dir, split).unwrap().pairs().len(), pairs, "{split}");
        }
        let val = PairsDataset::open(&dir, Split::Val).unwrap();
        for modality in [Modality::Rgb, Modality::Thermal] {
            val.pairs()[0].picture(0, modality).unwrap();
        }
    }
}
