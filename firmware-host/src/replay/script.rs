//! Runs, their network shape and thresholds.

use super::error::ReplayError;
use super::fields::Fields;
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use tsda_runtime::spec::{MAX_TEMPLATES, TrackerParams};
use tsda_runtime::{BBox, ModelSpec};

/// A script; its frames are read while they are replayed.
pub(super) struct Script<'a> {
    /// Where it was read from.
    pub path: PathBuf,
    /// In order.
    pub runs: Vec<Run<'a>>,
    /// Fields this version does not know.
    pub unknown: BTreeSet<String>,
}

/// Which recipe image a frame shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Picture {
    /// That of the frame's number.
    OfFrame,
    /// The same in all frames.
    Always(usize),
}

/// One run.
pub(super) struct Run<'a> {
    /// Its name; prefix of its maps.
    pub name: String,
    /// Rows and columns of the pictures.
    pub height: usize,
    /// Columns of the pictures.
    pub width: usize,
    /// What they show.
    pub picture: Picture,
    /// The annotated box.
    pub first: BBox,
    /// What is expected after the annotated frame.
    pub init: Option<&'a Value>,
    /// The later frames.
    pub frames: &'a [Value],
    /// Shape of the network, as far as the run states it.
    pub shape: Shape,
    /// Thresholds.
    pub params: TrackerParams,
}

/// What a run says about the network; ToMP where it says nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shape {
    /// The network, but for the crop.
    pub spec: ModelSpec,
    /// Whether the side of the crop was stated; else it follows from the maps.
    pub crop_stated: bool,
}

/// Largest side of a picture that a script may ask for.
const MAX_SIDE: u64 = 16_384;

impl<'a> Script<'a> {
    /// Checks the structure of a script.
    ///
    /// # Errors
    /// Names the field that is missing or wrong.
    pub fn read(value: &'a Value, path: &'a Path) -> Result<Self, ReplayError> {
        let mut unknown = BTreeSet::new();
        let whole = |detail: String| ReplayError::Field {
            path: path.into(),
            at: "the script".into(),
            detail,
        };
        let mut shared = (TrackerParams::default(), start());
        let list = match value {
            Value::Array(list) => list.as_slice(),
            Value::Object(_) => {
                let mut fields = Fields::new(value, path, "the script".into())?;
                let runs = fields.list("runs")?;
                let runs = fields.need("runs", runs)?;
                settings(&mut fields, path, &mut shared, &mut unknown)?;
                fields.ignore(&["note", "version", "description"]);
                fields.finish(&mut unknown);
                runs
            }
            other => {
                let found = super::fields::kind(other);
                return Err(whole(format!("expected a list of runs, found {found}")));
            }
        };
        if list.is_empty() {
            return Err(whole("it has no runs".into()));
        }
        let runs = list
            .iter()
            .enumerate()
            .map(|(i, run)| Run::read(run, i, path, shared, &mut unknown))
            .collect::<Result<_, _>>()?;
        Ok(Self { path: path.into(), runs, unknown })
    }
}

fn start() -> Shape {
    Shape { spec: ModelSpec::TOMP101, crop_stated: false }
}

/// Thresholds and shape as stated in `fields` itself or in its `params`.
fn settings(
    fields: &mut Fields<'_>,
    path: &Path,
    (params, shape): &mut (TrackerParams, Shape),
    unknown: &mut BTreeSet<String>,
) -> Result<(), ReplayError> {
    if let Some(name) = fields.text("preset")? {
        shape.spec = ModelSpec::preset(name).ok_or_else(|| {
            fields.wrong("preset", format!("{name:?} is none of tomp101, tomp50, nano, small"))
        })?;
        shape.crop_stated = true;
    }
    stated(fields, params, shape)?;
    if let Some((name, inner)) = fields.any(&["params", "parameters"]) {
        let mut inner = Fields::new(inner, path, format!("{}, {name}", fields.at()))?;
        stated(&mut inner, params, shape)?;
        let mut left = BTreeSet::new();
        inner.finish(&mut left);
        unknown.extend(left.into_iter().map(|field| format!("{name}.{field}")));
    }
    let at = fields.at().to_string();
    let wrong = |detail: String| ReplayError::Field { path: path.into(), at, detail };
    params.validate().map_err(|e| wrong(e.to_string()))
}

/// Own names first, then those that are usual elsewhere.
fn stated(
    fields: &mut Fields<'_>,
    params: &mut TrackerParams,
    shape: &mut Shape,
) -> Result<(), ReplayError> {
    let thresholds: [(&[&'static str], &mut f32); 8] = [
        (&["not_found", "target_not_found_threshold"], &mut params.not_found),
        (&["distractor", "distractor_threshold"], &mut params.distractor),
        (&["hard_negative", "hard_negative_threshold"], &mut params.hard_negative),
        (&["neighbourhood", "target_neighborhood_scale"], &mut params.neighbourhood),
        (&["displacement", "displacement_scale", "dispalcement_scale"], &mut params.displacement),
        (&["write_confidence", "conf_ths"], &mut params.write_confidence),
        (&["min_size", "minimum_size"], &mut params.min_size),
        (&["max_scale_change", "patch_max_scale_change"], &mut params.max_scale_change),
    ];
    for (names, target) in thresholds {
        if let Some((name, value)) = fields.any(names) {
            *target = fields.to_number(name, value)? as f32;
        }
    }
    if let Some(n) = fields.whole("lost_after")? {
        params.lost_after = u16::try_from(n).unwrap_or(u16::MAX);
    }
    if let Some((name, value)) = fields.any(&["search_factor", "search_area_scale"]) {
        shape.spec.search_factor = fields.to_number(name, value)? as f32;
    }
    if let Some((name, value)) = fields.any(&["label_sigma", "output_sigma_factor"]) {
        shape.spec.label_sigma = fields.to_number(name, value)? as f32;
    }
    if let Some((name, _)) = fields.any(&["crop", "image_sample_size"]) {
        let side = fields.whole(name)?.and_then(|n| u16::try_from(n).ok());
        shape.spec.crop = fields.need(name, side)?;
        shape.crop_stated = true;
    }
    let slots = ["templates", "slots", "memory_slots", "memory_size", "sample_memory_size"];
    if let Some((name, _)) = fields.any(&slots) {
        let count = fields.whole(name)?.filter(|n| (1..=MAX_TEMPLATES as u64).contains(n));
        let count = count.and_then(|n| u8::try_from(n).ok());
        let wrong = || fields.wrong(name, format!("expected 1 to {MAX_TEMPLATES} slots"));
        shape.spec.templates = count.ok_or_else(wrong)?;
    }
    Ok(())
}

impl<'a> Run<'a> {
    fn read(
        value: &'a Value,
        index: usize,
        path: &'a Path,
        mut shared: (TrackerParams, Shape),
        unknown: &mut BTreeSet<String>,
    ) -> Result<Self, ReplayError> {
        let mut fields = Fields::new(value, path, format!("run {index}"))?;
        let name = fields.text("name")?;
        let name = fields.need("name", name)?.to_string();
        let size = fields.array::<2>("image_hw")?;
        let [height, width] = fields.need("image_hw", size)?;
        for side in [height, width] {
            if !(side >= 1.0 && side.fract() == 0.0 && side <= MAX_SIDE as f64) {
                let detail = format!("{side} is no side of a picture (1 to {MAX_SIDE})");
                return Err(fields.wrong("image_hw", detail));
            }
        }
        let picture = match fields.text("image_formula")? {
            None | Some("image_u8(frame_number)") => Picture::OfFrame,
            Some(formula) => {
                let number = formula.strip_prefix("image_u8(").and_then(|f| f.strip_suffix(')'));
                let number = number.and_then(|n| n.trim().parse().ok());
                let detail = format!(
                    "{formula:?} is not known: expected `image_u8(frame_number)` or `image_u8(N)`"
                );
                Picture::Always(number.ok_or_else(|| fields.wrong("image_formula", detail))?)
            }
        };
        let first = fields.array::<4>("init_bbox_xywh")?;
        let [x, y, w, h] = fields.need("init_bbox_xywh", first)?.map(|v| v as f32);
        let init = fields.value("init");
        let frames = fields.list("frames")?;
        let frames = fields.need("frames", frames)?;
        settings(&mut fields, path, &mut shared, unknown)?;
        fields.ignore(&["note"]);
        let (params, shape) = shared;
        let mut left = BTreeSet::new();
        fields.finish(&mut left);
        unknown.extend(left.into_iter().map(|field| format!("run {name}, {field}")));
        Ok(Self {
            name,
            height: height as usize,
            width: width as usize,
            picture,
            first: BBox::new(x, y, w, h),
            init,
            frames,
            shape,
            params,
        })
    }
}
