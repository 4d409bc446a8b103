//! One run through the public tracker, frame by frame.

use super::engine::Scripted;
use super::error::ReplayError;
use super::fields::Fields;
use super::report::{Comparer, Report, RunReport};
use super::script::{Picture, Run, Script};
use super::tensors::{Tensor, Tensors};
use super::{
    GREY_TOLERANCE, LABEL_TOLERANCE, POSITION_TOLERANCE, SCALE_TOLERANCE, SCORE_TOLERANCE,
};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::Path;
use tsda_runtime::{BBox, FrameView, Modality, ModelSpec, Tracker, Yx, probe};

/// Known fields of a frame's memory that this tracker has no counterpart of (quirk Q12).
const BOOKKEEPING: [&str; 2] = ["learning_rate", "weights"];

/// Replays all runs of a script.
pub(super) fn replay(script: &Script<'_>, tensors: &Tensors) -> Result<Report, ReplayError> {
    let mut report = Report { unknown: script.unknown.clone(), ..Report::default() };
    let mut used = BTreeSet::new();
    for run in &script.runs {
        let mut player = Player {
            path: &script.path,
            run,
            tensors,
            used: &mut used,
            unknown: &mut report.unknown,
            not_compared: &mut report.not_compared,
        };
        let found = player.play()?;
        report.runs.push(found);
    }
    let left = tensors.names().filter(|name| !used.contains(*name));
    report.unknown.extend(left.map(|name| format!("tensor {name}")));
    Ok(report)
}

struct Player<'a> {
    path: &'a Path,
    run: &'a Run<'a>,
    tensors: &'a Tensors,
    used: &'a mut BTreeSet<String>,
    unknown: &'a mut BTreeSet<String>,
    not_compared: &'a mut BTreeSet<&'static str>,
}

fn yx(v: Yx) -> [f32; 2] {
    [v.y, v.x]
}

fn xywh(b: BBox) -> [f32; 4] {
    [b.x, b.y, b.w, b.h]
}

/// Where a script's nine pixels lie: channel `k`, three rows, one column per channel.
fn sample_places(side: usize) -> Vec<[usize; 3]> {
    let (rows, cols) = ([0, side / 2 - 1, side - 1], [0, 100.min(side - 1), side - 1]);
    (0..3).flat_map(|k| rows.map(|row| [k, row, cols[k]])).collect()
}

impl Player<'_> {
    fn wrong_tensor(&self, name: &str, detail: String) -> ReplayError {
        ReplayError::Tensor { path: self.tensors.path.clone(), name: name.into(), detail }
    }

    /// A map of a frame.
    fn map(&mut self, frame: u64, kind: &str) -> Result<&Tensor, ReplayError> {
        let name = format!("{}.f{frame}.{kind}", self.run.name);
        let Some(map) = self.tensors.get(&name) else {
            let why = format!("it is missing; frame {frame} of run {} needs it", self.run.name);
            return Err(self.wrong_tensor(&name, why));
        };
        self.used.insert(name);
        Ok(map)
    }

    /// Shape of the network: the maps say how large they are.
    fn spec(&mut self, first: Option<u64>) -> Result<ModelSpec, ReplayError> {
        let mut spec = self.run.shape.spec;
        let run = &self.run.name;
        if let (Some(frame), false) = (first, self.run.shape.crop_stated) {
            let map = self.map(frame, "scores")?;
            let side = map.shape.last().copied().unwrap_or(0) * ModelSpec::STRIDE;
            spec.crop = u16::try_from(side).unwrap_or(u16::MAX);
        }
        spec.validate().map_err(|e| ReplayError::Field {
            path: self.path.into(),
            at: format!("run {run}, shape of the network (by its fields or its score map)"),
            detail: e.to_string(),
        })?;
        Ok(spec)
    }

    /// Score map and distances of a frame.
    fn answer(
        &mut self,
        frame: u64,
        spec: &ModelSpec,
    ) -> Result<(Vec<f32>, Vec<f32>), ReplayError> {
        let (run, f, cells) = (self.run.name.clone(), spec.map_side(), spec.cells());
        let mut read = |kind: &str, count: usize| {
            let map = self.map(frame, kind)?;
            if map.values.len() == count {
                return Ok(map.values.clone());
            }
            let detail =
                format!("shape {:?}, expected {count} numbers for maps of {f} x {f}", map.shape);
            Err(self.wrong_tensor(&format!("{run}.f{frame}.{kind}"), detail))
        };
        Ok((read("scores", cells)?, read("ltrb", 4 * cells)?))
    }

    fn play(&mut self) -> Result<RunReport, ReplayError> {
        let run = self.run;
        let mut numbers = Vec::new();
        for (i, frame) in run.frames.iter().enumerate() {
            let mut fields = Fields::new(frame, self.path, self.at(&format!("frames[{i}]")))?;
            let number = fields.whole("frame")?;
            numbers.push(fields.need("frame", number)?);
        }
        let spec = self.spec(numbers.first().copied())?;
        let failed = |frame: u64| {
            let run = run.name.clone();
            move |source| ReplayError::Tracker { run, frame, source: Box::new(source) }
        };
        let mut tracker = Tracker::new(Scripted::new(spec), run.params).map_err(failed(0))?;
        let mut report = RunReport { name: run.name.clone(), ..RunReport::default() };
        let mut bytes = vec![0; run.width * run.height * 3];

        self.picture(0, &mut bytes);
        let view = self.view(&bytes)?;
        tracker.init(&view, run.first, Some(Modality::Rgb)).map_err(failed(0))?;
        let mut compare = Comparer { run: &mut report, frame: 0 };
        self.compare_init(&tracker, &mut compare)?;

        // A script that never speaks of the memory does not mean that it is never written.
        let speaks = |f: &Value| f.get("memory").is_some() || f.get("updated").is_some();
        let about_memory = run.frames.iter().any(speaks);
        let mut stored = 1;
        for (value, number) in run.frames.iter().zip(&numbers) {
            tracker.engine_mut().answer = self.answer(*number, &spec)?;
            self.picture(*number, &mut bytes);
            let filled = tracker.memory().filled();
            let view = self.view(&bytes)?;
            let track = tracker.update(&view, None).map_err(failed(*number))?;
            stored += u64::from(track.wrote_memory);
            report.frames += 1;
            let mut compare = Comparer { run: &mut report, frame: *number };
            compare.exact("slots the network was asked with", tracker.engine().asked, Some(filled));
            let mut fields = Fields::new(value, self.path, self.at(&format!("frame {number}")))?;
            fields.ignore(&["frame", "note"]);
            self.compare_search(&tracker, &mut fields, &mut compare)?;
            let after = After { track: &track, about_memory, stored, frame: *number };
            self.compare_state(&tracker, after, &mut fields, &mut compare)?;
            self.leave(fields, "frames[]");
        }
        Ok(report)
    }

    fn at(&self, what: &str) -> String {
        format!("run {}, {what}", self.run.name)
    }

    /// Notes what nobody asked for.
    fn leave(&mut self, fields: Fields<'_>, object: &str) {
        let mut left = BTreeSet::new();
        fields.finish(&mut left);
        self.unknown.extend(left.into_iter().map(|field| format!("{object}.{field}")));
    }

    fn picture(&self, frame: u64, bytes: &mut [u8]) {
        let index = match self.run.picture {
            Picture::OfFrame => usize::try_from(frame).unwrap_or(usize::MAX),
            Picture::Always(index) => index,
        };
        probe::recipe_image(index, self.run.width, self.run.height, bytes);
    }

    fn view<'b>(&self, bytes: &'b [u8]) -> Result<FrameView<'b>, ReplayError> {
        FrameView::rgb(bytes, self.run.width, self.run.height)
            .map_err(|source| ReplayError::Picture { run: self.run.name.clone(), source })
    }

    fn compare_init(
        &mut self,
        tracker: &Tracker<Scripted>,
        compare: &mut Comparer<'_>,
    ) -> Result<(), ReplayError> {
        let Some(init) = self.run.init else { return Ok(()) };
        let mut f = Fields::new(init, self.path, self.at("init"))?;
        let Some(target) = tracker.target() else { return Ok(()) };
        let pos = target.pos();
        position(compare, &mut f, "pos_yx", &yx(pos))?;
        position(compare, &mut f, "target_sz_hw", &yx(target.size()))?;
        scale(compare, &mut f, "target_scale", target.scale())?;
        position(compare, &mut f, "base_target_sz_hw", &yx(target.base()))?;
        if let Some(template) = tracker.memory().templates().first() {
            // Where the first crop was cut, from where the target lies in it.
            let spec = tracker.spec();
            let per_cell = target.scale() * f32::from(spec.crop) / spec.map_side() as f32;
            let centre = template.label_centre;
            let sample = [pos.y - centre.y * per_cell, pos.x - centre.x * per_cell];
            position(compare, &mut f, "init_sample_pos_yx", &sample)?;
            position(compare, &mut f, "target_box_xywh", &xywh(template.bbox))?;
        }
        let sigma = tracker.spec().label_sigma_cells();
        let want = f.numbers("sigma")?;
        compare.numbers("label", "sigma", &[sigma; 2], want.as_deref(), LABEL_TOLERANCE);
        let filled = tracker.memory().filled() as u64;
        compare.exact("num_gth_frames", filled, f.whole("num_gth_frames")?);
        self.compare_label(tracker, &mut f, compare)?;
        self.compare_whole_label(tracker, "init_label", compare);
        self.compare_patch(tracker, &mut f, compare)?;
        f.ignore(&["note"]);
        self.leave(f, "init");
        Ok(())
    }

    /// The label of the template written last.
    fn compare_label(
        &mut self,
        tracker: &Tracker<Scripted>,
        f: &mut Fields<'_>,
        compare: &mut Comparer<'_>,
    ) -> Result<(), ReplayError> {
        let (max, at) = tracker.engine().label_peak();
        let want = f.number("label_max")?;
        compare.numbers(
            "label",
            "label_max",
            &[max],
            want.as_ref().map(std::slice::from_ref),
            LABEL_TOLERANCE,
        );
        compare.exact("label_argmax", at as u64, f.whole("label_argmax")?);
        Ok(())
    }

    /// The same, cell by cell, where the tensors have it.
    fn compare_whole_label(
        &mut self,
        tracker: &Tracker<Scripted>,
        what: &str,
        compare: &mut Comparer<'_>,
    ) {
        let name = format!("{}.{what}", self.run.name);
        if let Some(label) = self.tensors.get(&name) {
            let want: Vec<f64> = label.values.iter().map(|v| f64::from(*v)).collect();
            let got = &tracker.engine().label;
            compare.numbers("label", what, got, Some(&want), LABEL_TOLERANCE);
            self.used.insert(name);
        }
    }

    /// Pixels and mean of the crop the network got.
    fn compare_patch(
        &mut self,
        tracker: &Tracker<Scripted>,
        f: &mut Fields<'_>,
        compare: &mut Comparer<'_>,
    ) -> Result<(), ReplayError> {
        let engine = tracker.engine();
        let want = f.number("patch_mean")?;
        let want = want.as_ref().map(std::slice::from_ref);
        compare.numbers("crop (grey)", "patch_mean", &[engine.mean()], want, GREY_TOLERANCE);
        let places = match f.list("patch_samples_at")? {
            None => sample_places(tracker.spec().crop_side()),
            Some(list) => {
                let place = |v: &Value| -> Option<[usize; 3]> {
                    let numbers = v.as_array()?.iter().map(|n| n.as_u64().map(|n| n as usize));
                    numbers.collect::<Option<Vec<_>>>()?.try_into().ok()
                };
                let places: Option<Vec<_>> = list.iter().map(place).collect();
                let wrong =
                    || f.wrong("patch_samples_at", "expected [[channel, row, column], ..]".into());
                places.ok_or_else(wrong)?
            }
        };
        let Some(list) = f.list("patch_samples")? else { return Ok(()) };
        let mut want = Vec::new();
        for value in list {
            match value.as_array() {
                Some(inner) => {
                    for v in inner {
                        want.push(f.to_number("patch_samples", v)?);
                    }
                }
                None => want.push(f.to_number("patch_samples", value)?),
            }
        }
        let got: Option<Vec<f32>> = places.iter().map(|at| engine.grey(*at)).collect();
        let side = tracker.spec().crop_side();
        let got = got.ok_or_else(|| {
            f.wrong("patch_samples_at", format!("outside a crop of 3 x {side} x {side}"))
        })?;
        compare.numbers("crop (grey)", "patch_samples", &got, Some(&want), GREY_TOLERANCE);
        Ok(())
    }

    /// What was looked at, and what was seen there.
    fn compare_search(
        &mut self,
        tracker: &Tracker<Scripted>,
        f: &mut Fields<'_>,
        compare: &mut Comparer<'_>,
    ) -> Result<(), ReplayError> {
        let Some(search) = tracker.last_search() else { return Ok(()) };
        position(compare, f, "search_center_yx", &yx(search.centre))?;
        scale(compare, f, "search_scale", search.scale)?;
        let p = search.patch;
        position(compare, f, "patch_coord_y1x1y2x2", &[p.tl.y, p.tl.x, p.br.y, p.br.x])?;
        position(compare, f, "sample_pos_yx", &yx(search.sample_pos))?;
        scale(compare, f, "sample_scale", search.sample_scale)?;
        self.compare_patch(tracker, f, compare)?;
        compare.exact("flag", search.located.flag.as_str(), f.text("flag")?);
        let cell = [search.located.cell.row as f64, search.located.cell.col as f64];
        compare.exact("max_disp_rc", cell, f.array::<2>("max_disp_rc")?);
        position(compare, f, "bbox_raw_xywh", &xywh(search.raw))?;
        position(compare, f, "bbox_clipped_xywh", &xywh(search.clipped))
    }

    /// What the tracker made of it.
    fn compare_state(
        &mut self,
        tracker: &Tracker<Scripted>,
        after: After<'_>,
        f: &mut Fields<'_>,
        compare: &mut Comparer<'_>,
    ) -> Result<(), ReplayError> {
        let track = after.track;
        let want = f.number("object_presence_score")?;
        let want = want.as_ref().map(std::slice::from_ref);
        compare.numbers("score", "object_presence_score", &[track.score], want, SCORE_TOLERANCE);
        position(compare, f, "output_bbox_xywh", &xywh(track.bbox))?;
        if let Some(target) = tracker.target() {
            position(compare, f, "pos_yx", &yx(target.pos()))?;
            position(compare, f, "target_sz_hw", &yx(target.size()))?;
            scale(compare, f, "target_scale", target.scale())?;
            let counter = f.whole("not_found_counter")?;
            compare.exact("not_found_counter", u64::from(target.not_found()), counter);
        }
        let memory = f.value("memory");
        let updated = f.flag("updated")?;
        if after.about_memory {
            compare.exact("updated", track.wrote_memory, updated);
            compare.exact("memory", track.wrote_memory, Some(memory.is_some()));
        }
        let Some(memory) = memory else { return Ok(()) };
        let mut m = Fields::new(memory, self.path, format!("{}, memory", f.at()))?;
        let slot = m.whole("replaced_slot")?;
        if track.wrote_memory {
            let engine = tracker.engine();
            compare.exact("memory.replaced_slot", engine.slot.map(|s| s as u64), slot.map(Some));
            let templates = tracker.memory().templates();
            if let Some(template) = engine.slot.and_then(|s| templates.get(s)) {
                position(compare, &mut m, "target_box_xywh", &xywh(template.bbox))?;
            }
            let held: Vec<f64> = templates.iter().map(|t| t.frame as f64).collect();
            compare.exact("memory.slots_hold_frame", held, m.numbers("slots_hold_frame")?);
            // The reference counts every write.
            compare.exact("memory.num_stored", after.stored, m.whole("num_stored")?);
            self.compare_label(tracker, &mut m, compare)?;
            self.compare_whole_label(tracker, &format!("f{}.new_label", after.frame), compare);
        } else {
            // Compared in vain above; these are known all the same.
            m.ignore(&["target_box_xywh", "slots_hold_frame", "num_stored"]);
            m.ignore(&["label_max", "label_argmax"]);
        }
        for name in BOOKKEEPING {
            if m.value(name).is_some() {
                self.not_compared.insert(name);
            }
        }
        self.leave(m, "frames[].memory");
        Ok(())
    }
}

/// What happened in a frame.
#[derive(Clone, Copy)]
struct After<'a> {
    track: &'a tsda_runtime::Track,
    about_memory: bool,
    /// Templates written so far, the first one included.
    stored: u64,
    frame: u64,
}

/// Positions, sizes and boxes.
fn position(
    compare: &mut Comparer<'_>,
    f: &mut Fields<'_>,
    name: &str,
    got: &[f32],
) -> Result<(), ReplayError> {
    let want = f.numbers(name)?;
    compare.numbers("position (px)", name, got, want.as_deref(), POSITION_TOLERANCE);
    Ok(())
}

fn scale(
    compare: &mut Comparer<'_>,
    f: &mut Fields<'_>,
    name: &str,
    got: f32,
) -> Result<(), ReplayError> {
    let want = f.number(name)?;
    let tolerance = SCALE_TOLERANCE * want.map_or(1.0, |v| v.abs().max(1.0));
    let want = want.as_ref().map(std::slice::from_ref);
    compare.numbers("scale", name, &[got], want, tolerance);
    Ok(())
}
