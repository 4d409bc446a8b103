//! Ranges of activations, measured while the network of floats tracks real material.

use super::QuantizeError;
use super::graph::{File, Product};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;
use tsda_eval::RuntimeTracker;
use tsda_eval::dataset::Dataset;
use tsda_eval::protocol::{Protocol, TrackerError, TrackerUnderTest as _};
use tsda_runtime::bundle::{Bundle, Manifest, SectionKind};
use tsda_runtime::engine::native::{GraphSession, Isa};
use tsda_runtime::engine::{Engine, EngineError, Maps, Stage, TemplateInput};
use tsda_runtime::{ModelSpec, Tracker, TrackerParams};

/// Frames tracked of a clip, so that many clips are seen.
const PER_CLIP: usize = 20;
/// Halves of a histogram.
const HALF: usize = 2048;
/// Ranges tried, as shares of the one seen.
const TRIED: usize = 80;

/// How an activation becomes bytes: `round(x / scale) + zero`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rounding {
    /// Step.
    pub scale: f32,
    /// The byte for 0.
    pub zero: u8,
}

/// Of every input of a product that becomes one of bytes, by index of its graph and name.
pub type Roundings = BTreeMap<(usize, String), Rounding>;

/// How often values occur. Zeros are left out: they cost nothing.
#[derive(Clone, Debug)]
pub struct Histogram {
    counts: Vec<u64>,
    /// Largest magnitude that has a place.
    reach: f32,
    low: f32,
    high: f32,
    finite: bool,
    calls: usize,
}

impl Default for Histogram {
    fn default() -> Self {
        let counts = vec![0; 2 * HALF];
        Self { counts, reach: 0.0, low: 0.0, high: 0.0, finite: true, calls: 0 }
    }
}

impl Histogram {
    /// Counts values.
    pub fn add(&mut self, values: &[f32]) {
        self.calls += 1;
        let (mut low, mut high) = (0f32, 0f32);
        for &v in values {
            (low, high) = (low.min(v), high.max(v));
            self.finite &= v.is_finite();
        }
        if !self.finite {
            return;
        }
        (self.low, self.high) = (self.low.min(low), self.high.max(high));
        self.stretch(high.max(-low));
        if self.reach == 0.0 {
            return;
        }
        let per = HALF as f32 / self.reach;
        for &v in values.iter().filter(|v| **v != 0.0) {
            let at = (v * per + HALF as f32) as usize;
            self.counts[at.min(2 * HALF - 1)] += 1;
        }
    }

    /// Makes room for a magnitude by doubling the width of the bins.
    fn stretch(&mut self, reach: f32) {
        if self.reach == 0.0 {
            self.reach = reach;
        }
        while self.reach < reach {
            let mut wider = vec![0; 2 * HALF];
            for (i, n) in self.counts.iter().enumerate() {
                // Distances from the middle halve.
                wider[HALF / 2 + i / 2] += n;
            }
            self.counts = wider;
            self.reach *= 2.0;
        }
    }

    /// The rounding with the least mean squared error: wide ranges make large steps, narrow ones
    /// cut off what lies outside.
    ///
    /// # Errors
    /// What keeps it from having one.
    pub fn rounding(&self) -> Result<Rounding, &'static str> {
        if !self.finite {
            return Err("it was not finite in some frame");
        }
        if self.low == self.high {
            return Err("it was 0 in every frame");
        }
        let width = self.reach / HALF as f32;
        let error = |low: f32, high: f32| -> f64 {
            let step = f64::from(high - low) / 255.0;
            let bins = self.counts.iter().enumerate().filter(|(_, n)| **n > 0);
            let of = |(i, n): (usize, &u64)| {
                let x = f64::from((i as f32 + 0.5 - HALF as f32) * width);
                let off = x - x.clamp(f64::from(low), f64::from(high));
                *n as f64 * if off == 0.0 { step * step / 12.0 } else { off * off }
            };
            bins.map(of).sum()
        };
        let ranges = (TRIED / 5..=TRIED).map(|i| {
            let share = i as f32 / TRIED as f32;
            (self.low * share, self.high * share)
        });
        let best = ranges.map(|(l, h)| (error(l, h), l, h)).min_by(|a, b| a.0.total_cmp(&b.0));
        let (low, high) = best.map_or((self.low, self.high), |(_, l, h)| (l, h));
        let scale = (high - low) / 255.0;
        if !(scale.is_normal()) {
            return Err("its values are too small for a step");
        }
        let zero = (-low / scale).round_ties_even().clamp(0.0, 255.0) as u8;
        Ok(Rounding { scale, zero })
    }
}

/// Histograms by graph and tensor.
type Seen = BTreeMap<(usize, String), Histogram>;

/// A graph of the bundle with the tensors that are watched as outputs.
struct Watched {
    file: usize,
    session: GraphSession,
    taps: Vec<String>,
}

impl Watched {
    fn new(
        files: &[File],
        kind: SectionKind,
        weights: &[u8],
        products: &[Product],
    ) -> Result<Self, QuantizeError> {
        let found = files.iter().position(|f| f.kind == kind);
        let file = found.ok_or(tsda_runtime::bundle::BundleError::Missing(kind))?;
        let mut taps: Vec<String> = products
            .iter()
            .filter(|p| p.file == file && p.kept.is_none())
            .map(|p| p.input.clone())
            .collect();
        taps.sort_unstable();
        taps.dedup();
        let onnx = files[file].with_outputs(&taps)?;
        let session = GraphSession::with_weights(&onnx, weights, Isa::best())?;
        Ok(Self { file, session, taps })
    }

    fn set(&mut self, name: &str, values: &[f32]) -> Result<(), EngineError> {
        match self.session.input_mut(name) {
            Some(to) if to.len() == values.len() => to.copy_from_slice(values),
            _ => return Err(fault(format_args!("no input `{name}` of {} numbers", values.len()))),
        }
        Ok(())
    }

    fn get(&self, name: &str) -> Result<&[f32], EngineError> {
        self.session.output(name).ok_or_else(|| fault(format_args!("no output `{name}`")))
    }

    fn run(&mut self, seen: &RefCell<Seen>) {
        self.session.run();
        let mut seen = seen.borrow_mut();
        for tap in &self.taps {
            if let Some(values) = self.session.output(tap) {
                seen.entry((self.file, tap.clone())).or_default().add(values);
            }
        }
    }
}

fn fault(detail: std::fmt::Arguments<'_>) -> EngineError {
    EngineError::new("calibration", Stage::Load, detail)
}

/// An engine that runs the graphs of floats and watches their activations.
struct Watching {
    spec: ModelSpec,
    features: Watched,
    template: Watched,
    predict: Vec<Watched>,
    crop: Vec<f32>,
    feature: Vec<f32>,
    label: Vec<f32>,
    ltrb: Vec<f32>,
    slots: Vec<Vec<f32>>,
    seen: Rc<RefCell<Seen>>,
}

impl Watching {
    fn new(
        bundle: &Bundle<'_>,
        files: &[File],
        products: &[Product],
        seen: Rc<RefCell<Seen>>,
    ) -> Result<Self, QuantizeError> {
        let spec = bundle.manifest().spec;
        let weights = bundle.require(SectionKind::Weights)?;
        let watched = |kind| Watched::new(files, kind, weights, products);
        let predict = (1..=spec.templates).map(|k| watched(SectionKind::PredictOnnx(k)));
        let side = spec.crop_side();
        Ok(Self {
            spec,
            features: watched(SectionKind::FeaturesOnnx)?,
            template: watched(SectionKind::TemplateOnnx)?,
            predict: predict.collect::<Result<_, _>>()?,
            crop: vec![0.0; 3 * side * side],
            feature: Vec::new(),
            label: vec![0.0; spec.cells()],
            ltrb: vec![0.0; 4 * spec.cells()],
            slots: vec![Vec::new(); spec.templates.into()],
            seen,
        })
    }
}

impl Engine for Watching {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    fn name(&self) -> &'static str {
        "calibration"
    }

    fn crop_mut(&mut self) -> &mut [f32] {
        &mut self.crop
    }

    fn features(&mut self) -> Result<(), EngineError> {
        self.features.set("crop", &self.crop)?;
        self.features.run(&self.seen);
        self.feature = self.features.get("feature")?.to_vec();
        Ok(())
    }

    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        TemplateInput { label: &mut self.label, ltrb: &mut self.ltrb }
    }

    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        self.template.set("feature", &self.feature)?;
        self.template.set("label", &self.label)?;
        self.template.set("ltrb", &self.ltrb)?;
        self.template.run(&self.seen);
        let tokens = self.template.get("tokens")?.to_vec();
        match self.slots.get_mut(slot) {
            Some(to) => *to = tokens,
            None => return Err(fault(format_args!("no slot {slot}"))),
        }
        Ok(())
    }

    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        let most = self.predict.len();
        let Some(graph) = filled.checked_sub(1).and_then(|i| self.predict.get_mut(i)) else {
            return Err(fault(format_args!("{filled} templates of {most}")));
        };
        for (i, slot) in self.slots[..filled].iter().enumerate() {
            graph.set(&format!("template{i}"), slot)?;
        }
        graph.set("feature", &self.feature)?;
        graph.run(&self.seen);
        Ok(Maps { scores: graph.get("scores")?, ltrb: graph.get("ltrb")? })
    }
}

/// Tracks up to `frames` frames of the data and gives the rounding of every input of a product that
/// becomes one of bytes, by graph and name; and how many frames there were. Every other clip is
/// tracked with each found frame remembered, so that the graphs for several templates are seen.
///
/// # Errors
/// When the data cannot be read, a graph is not run by any frame, or an activation has no range.
pub fn ranges(
    bundle: &Bundle<'_>,
    files: &[File],
    products: &[Product],
    data: &Dataset,
    frames: usize,
) -> Result<(Roundings, usize), QuantizeError> {
    let seen = Rc::new(RefCell::new(Seen::new()));
    let deployed = bundle.manifest().tracker;
    let eager = TrackerParams { not_found: 0.0, write_confidence: 0.0, ..deployed };
    let mut runners = Vec::with_capacity(2);
    for params in [deployed, eager] {
        let engine = Watching::new(bundle, files, products, seen.clone())?;
        let manifest = Manifest { tracker: params, ..bundle.manifest().clone() };
        let tracker =
            Tracker::from_manifest(engine, &manifest).map_err(|e| QuantizeError::Track {
                sequence: data.name.clone(),
                frame: 0,
                source: TrackerError::new(e),
            })?;
        runners.push(RuntimeTracker::new("bundle", tracker));
    }
    let tracked = track(&mut runners, data, frames)?;
    let seen = seen.borrow();
    let mut roundings = Roundings::new();
    for product in products.iter().filter(|p| p.kept.is_none()) {
        let kind = files[product.file].kind;
        let key = (product.file, product.input.clone());
        let histogram = seen.get(&key).ok_or(QuantizeError::Unseen { kind })?;
        let tensor = product.input.clone();
        let rounding =
            histogram.rounding().map_err(|reason| QuantizeError::Range { kind, tensor, reason })?;
        roundings.insert(key, rounding);
    }
    Ok((roundings, tracked))
}

fn track(
    runners: &mut [RuntimeTracker<Watching>],
    data: &Dataset,
    frames: usize,
) -> Result<usize, QuantizeError> {
    let clips: Vec<(usize, usize)> = (data.sequences.iter().enumerate())
        .flat_map(|(i, s)| (0..s.targets()).map(move |target| (i, target)))
        .collect();
    let unusable =
        |reason: &str| QuantizeError::Data { data: data.name.clone(), reason: reason.into() };
    if clips.is_empty() || frames == 0 {
        return Err(unusable("no target to track"));
    }
    // Spread over all of the data.
    let wanted = frames.div_ceil(PER_CLIP).min(clips.len());
    let each = frames.div_ceil(wanted);
    let mut tracked = 0;
    for n in 0..wanted {
        let (index, target) = clips[n * clips.len() / wanted];
        let sequence = &data.sequences[index];
        let every = each.div_ceil(4).max(1);
        let protocol =
            [Protocol::RgbToThermal, Protocol::ThermalToRgb, Protocol::Switch { every }][n % 3];
        let sensor = |i: usize| {
            let wanted = protocol.modality(i);
            let there = sequence.modalities();
            if there.contains(&wanted) { Some(wanted) } else { there.first().copied() }
        };
        let Some(first) = sensor(0) else { continue };
        let has_box = |frame: &usize| sequence.truth(target, *frame, first).is_some();
        let Some(start) = (0..sequence.frames()).find(has_box) else { continue };
        let Some(bbox) = sequence.truth(target, start, first) else { continue };
        let runner = &mut runners[n % 2];
        for i in 0..each.min(sequence.frames() - start) {
            let Some(modality) = sensor(i) else { break };
            let picture =
                sequence.picture(start + i, modality).map_err(|e| unusable(&e.to_string()))?;
            let done = if i == 0 {
                runner.init(&picture, bbox, modality)
            } else {
                runner.update(&picture, modality).map(|_| ())
            };
            done.map_err(|source| QuantizeError::Track {
                sequence: sequence.id().into(),
                frame: start + i,
                source,
            })?;
            tracked += 1;
        }
    }
    if tracked == 0 {
        return Err(unusable("no sequence has a box to start from"));
    }
    Ok(tracked)
}
