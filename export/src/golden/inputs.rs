//! Crops, labels and boxes the cases are run with.

use super::error::GoldenError;
use super::figure::{difference, peak};
use std::path::Path;
use tsda_runtime::{BBox, ModelSpec, labels, probe};
use tsda_trainer::import::{StateDict, StateTensor};

/// One template or search frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Unique among all frames of a folder.
    pub id: usize,
    /// Network input `(3, S, S)`.
    pub crop: Vec<f32>,
}

/// A template: its frame, label `(F, F)` and distances `(4, F, F)`.
#[derive(Clone, Debug, PartialEq)]
pub struct TemplateFrame {
    /// The frame.
    pub frame: Frame,
    /// Gaussian label.
    pub label: Vec<f32>,
    /// Box as distances in crop sides.
    pub ltrb: Vec<f32>,
}

/// Templates and one search frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Sequence {
    /// Before the names of its tensors: `seq0.` or nothing.
    pub prefix: String,
    /// In slot order.
    pub templates: Vec<TemplateFrame>,
    /// The search frame.
    pub search: Frame,
}

impl Sequence {
    /// Cells of a map.
    pub fn cells(&self) -> usize {
        self.templates.first().map_or(1, |t| t.label.len())
    }
}

/// What was read.
pub struct Inputs {
    /// All sequences, in order.
    pub sequences: Vec<Sequence>,
    /// Stored inputs against those made here: name, difference, bound.
    pub checks: Vec<(String, f32, f32)>,
    /// Names that are not known.
    pub unknown: Vec<String>,
}

/// `S` of `seqS.name`.
pub fn sequence_of(name: &str) -> Option<usize> {
    name.strip_prefix("seq")?.split_once('.')?.0.parse().ok()
}

/// Network input of a recipe image.
fn recipe_crop(spec: &ModelSpec, index: usize) -> Vec<f32> {
    let mut crop = vec![0.0; spec.crop_len()];
    probe::crop_input(spec, index, &mut crop);
    crop
}

/// Reads the inputs; see [`super::folder`] for the two layouts.
///
/// # Errors
/// Names the tensor that is missing or has the wrong shape.
pub fn read(
    dict: &StateDict,
    path: &Path,
    spec: &ModelSpec,
    sequential: bool,
) -> Result<Inputs, GoldenError> {
    let reader = Reader { dict, path, spec };
    let mut inputs = Inputs { sequences: Vec::new(), checks: Vec::new(), unknown: Vec::new() };
    if sequential {
        let last = dict.names().filter_map(sequence_of).max().unwrap_or(0);
        for s in 0..=last {
            let prefix = format!("seq{s}.");
            // Recipe frames 10 s, 10 s + 1, ..: templates first, the search frame behind them.
            reader.sequence(&prefix, s * 100, 10 * s, &mut inputs)?;
        }
    } else {
        reader.sequence("", 0, 0, &mut inputs)?;
    }
    let known = |name: &str| {
        let rest = match sequence_of(name) {
            Some(_) if sequential => name.split_once('.').map_or(name, |(_, rest)| rest),
            _ => name,
        };
        matches!(rest, "train_img" | "test_img" | "train_label" | "train_ltrb")
            || matches!(rest, "train_box" | "test_box" | "boxes" | "test_label" | "test_ltrb")
            || rest == "test_region"
            || image_index(rest, "_u8").is_some()
            || image_index(rest, "_prep_ch0").is_some()
    };
    inputs.unknown = dict.names().filter(|n| !known(n)).map(str::to_string).collect();
    Ok(inputs)
}

/// `K` of `imageK<suffix>`.
fn image_index(name: &str, suffix: &str) -> Option<usize> {
    name.strip_prefix("image")?.strip_suffix(suffix)?.parse().ok()
}

struct Reader<'a> {
    dict: &'a StateDict,
    path: &'a Path,
    spec: &'a ModelSpec,
}

impl Reader<'_> {
    fn missing(&self, name: String, why: &str) -> GoldenError {
        GoldenError::MissingInput { path: self.path.into(), name, why: why.into() }
    }

    /// Rows of `numbers` values each, or nothing if the tensor is not there.
    fn rows(&self, name: &str, numbers: usize) -> Result<Option<Vec<Vec<f32>>>, GoldenError> {
        let Some(tensor) = self.dict.get(name) else { return Ok(None) };
        if numbers == 0 || tensor.values.is_empty() || !tensor.values.len().is_multiple_of(numbers)
        {
            return Err(GoldenError::Shape {
                path: self.path.into(),
                name: name.into(),
                found: tensor.shape.clone(),
                expected: format!("rows of {numbers} numbers"),
            });
        }
        Ok(Some(tensor.values.chunks_exact(numbers).map(<[f32]>::to_vec).collect()))
    }

    /// One sequence with the frame numbers of the recipe from `image`.
    fn sequence(
        &self,
        prefix: &str,
        id: usize,
        image: usize,
        inputs: &mut Inputs,
    ) -> Result<(), GoldenError> {
        let (spec, cells) = (self.spec, self.spec.cells());
        let name = |what: &str| format!("{prefix}{what}");
        let boxes = match self.rows(&name("train_box"), 4)? {
            Some(boxes) => Some(boxes),
            None => self.rows(&name("boxes"), 4)?,
        };
        let stored_labels = self.rows(&name("train_label"), cells)?;
        let stored_ltrb = self.rows(&name("train_ltrb"), 4 * cells)?;
        let count = [stored_labels.as_ref().map(Vec::len), boxes.as_ref().map(Vec::len)];
        let Some(count) = count.into_iter().flatten().next() else {
            let why = "every template is run with (or `train_box`, to make it from)";
            return Err(self.missing(name("train_label"), why));
        };
        // From the boxes, should labels or distances not be stored; else to compare with them.
        let made: Option<Vec<(Vec<f32>, Vec<f32>)>> = boxes.map(|boxes| {
            let maps = |b: &Vec<f32>| {
                let (mut label, mut ltrb) = (vec![0.0; cells], vec![0.0; 4 * cells]);
                let bbox = BBox::new(b[0], b[1], b[2], b[3]);
                labels::template_maps(spec, &bbox, &mut label, &mut ltrb);
                (label, ltrb)
            };
            boxes.iter().map(maps).collect()
        });
        if let Some(made) = &made {
            let labels: Vec<f32> = made.iter().flat_map(|(l, _)| l.clone()).collect();
            let ltrb: Vec<f32> = made.iter().flat_map(|(_, l)| l.clone()).collect();
            for (what, made, stored) in
                [("train_label", labels, &stored_labels), ("train_ltrb", ltrb, &stored_ltrb)]
            {
                if let Some(stored) = stored {
                    let stored: Vec<f32> = stored.concat();
                    let bound = 2e-6 * peak(&stored).max(1.0);
                    inputs.checks.push((name(what), difference(&made, &stored), bound));
                }
            }
        }
        let half = |stored: Option<Vec<Vec<f32>>>, first: bool, what: &str| match (stored, &made) {
            (Some(rows), _) => Ok(rows),
            (None, Some(made)) => Ok(made
                .iter()
                .map(|(label, ltrb)| if first { label.clone() } else { ltrb.clone() })
                .collect()),
            (None, None) => {
                Err(self.missing(name(what), "every template is run with (or `train_box`)"))
            }
        };
        let labels = half(stored_labels, true, "train_label")?;
        let ltrb = half(stored_ltrb, false, "train_ltrb")?;

        let crops = self.rows(&name("train_img"), spec.crop_len())?;
        let search = self.rows(&name("test_img"), spec.crop_len())?;
        // In the preset layout the stored images may say which one is searched.
        let images = self.dict.names().filter_map(|n| image_index(n, "_u8"));
        let search_image = images.filter(|k| prefix.is_empty() && *k >= count).max();
        let search_image = search_image.unwrap_or(image + count);
        let frame = |index: usize| -> Result<Vec<f32>, GoldenError> {
            match self.dict.get(&format!("image{index}_u8")) {
                Some(tensor) if prefix.is_empty() => self.bytes(tensor, index),
                _ => Ok(recipe_crop(spec, index)),
            }
        };
        let mut templates = Vec::new();
        for (i, (label, ltrb)) in labels.into_iter().zip(ltrb).enumerate().take(count) {
            let crop = match &crops {
                Some(crops) => crops.get(i).cloned().ok_or_else(|| {
                    self.missing(format!("{prefix}train_img[{i}]"), "is a template with a label")
                })?,
                None => frame(image + i)?,
            };
            templates.push(TemplateFrame { frame: Frame { id: id + i, crop }, label, ltrb });
        }
        if templates.len() < count {
            return Err(self.missing(name("train_ltrb"), "every labelled template is run with"));
        }
        let crop = match search.and_then(|rows| rows.into_iter().next()) {
            Some(crop) => crop,
            None => frame(search_image)?,
        };
        for index in 0..=search_image {
            self.check_image(prefix, index, inputs);
        }
        let search = Frame { id: id + 99, crop };
        inputs.sequences.push(Sequence { prefix: prefix.into(), templates, search });
        Ok(())
    }

    /// Stored images against the recipe.
    fn check_image(&self, prefix: &str, index: usize, inputs: &mut Inputs) {
        if !prefix.is_empty() {
            return;
        }
        let name = format!("image{index}_prep_ch0");
        if let Some(stored) = self.dict.get(&name) {
            let crop = recipe_crop(self.spec, index);
            let plane = &crop[..crop.len() / 3];
            inputs.checks.push((name, difference(plane, &stored.values), 1e-6));
        }
        let name = format!("image{index}_u8");
        if let Some(stored) = self.dict.get(&name) {
            let side = self.spec.crop_side();
            let mut bytes = vec![0; self.spec.crop_len()];
            probe::recipe_image(index, side, side, &mut bytes);
            let bytes: Vec<f32> = bytes.into_iter().map(f32::from).collect();
            inputs.checks.push((name, difference(&bytes, &stored.values), 0.0));
        }
    }

    /// Network input of a stored image `(S, S, 3)`.
    fn bytes(&self, tensor: &StateTensor, index: usize) -> Result<Vec<f32>, GoldenError> {
        let side = self.spec.crop_side();
        if tensor.shape != [side, side, 3] {
            return Err(GoldenError::Shape {
                path: self.path.into(),
                name: format!("image{index}_u8"),
                found: tensor.shape.clone(),
                expected: format!("[{side}, {side}, 3]"),
            });
        }
        let (mean, std) = (&self.spec.input_mean, &self.spec.input_std);
        let plane = side * side;
        let value = |i: usize| {
            let (c, pixel) = (i / plane, i % plane);
            (tensor.values[3 * pixel + c] / 255.0 - mean[c]) / std[c]
        };
        Ok((0..3 * plane).map(value).collect())
    }
}

/// The sequence a preset is compared on when there is no folder: recipe images, probe boxes.
pub fn own(spec: &ModelSpec, templates: usize) -> Sequence {
    let spec = ModelSpec { templates: templates as u8, ..*spec };
    let cells = spec.cells();
    let template = |(i, bbox): (usize, BBox)| {
        let (mut label, mut ltrb) = (vec![0.0; cells], vec![0.0; 4 * cells]);
        labels::template_maps(&spec, &bbox, &mut label, &mut ltrb);
        TemplateFrame { frame: Frame { id: i, crop: recipe_crop(&spec, i) }, label, ltrb }
    };
    let boxes = probe::default_boxes(&spec);
    Sequence {
        prefix: String::new(),
        templates: boxes.into_iter().enumerate().map(template).collect(),
        search: Frame { id: 99, crop: recipe_crop(&spec, templates) },
    }
}
