//! One engine in a process of its own: loads, then runs a round of frames for every line it reads,
//! and answers each with a line of JSON.

use super::{Answer, FRAME, Loaded, Round, STAGES, Sample, TEMPLATE, pool};
use crate::error::HostError;
use crate::model;
use crate::picture::Picture;
use crate::render::{Clip, ClipConfig};
use std::io::{self, BufRead, Write};
use std::path::Path;
use std::time::{Duration, Instant};
use tsda_runtime::engine::{AnyEngine, EngineChoice, Maps, TemplateInput};
use tsda_runtime::system::{count, peak_rss, process_cpu};
use tsda_runtime::{Engine, EngineError, FrameView, Modality, ModelSpec, TrackError, Tracker};

/// A moment by both clocks.
#[derive(Clone, Copy)]
struct Moment {
    wall: Instant,
    cpu: Duration,
}

/// Time between two moments in milliseconds.
#[derive(Clone, Copy, Default)]
struct Span {
    wall: f64,
    cpu: f64,
}

impl Moment {
    fn now() -> Self {
        Self { wall: Instant::now(), cpu: process_cpu() }
    }

    fn since(self) -> Span {
        let ms = |d: Duration| d.as_secs_f64() * 1e3;
        Span { wall: ms(self.wall.elapsed()), cpu: ms(process_cpu().saturating_sub(self.cpu)) }
    }
}

impl core::ops::AddAssign for Span {
    fn add_assign(&mut self, other: Self) {
        self.wall += other.wall;
        self.cpu += other.cpu;
    }
}

/// Notes how long the parts of a frame take in the engine it wraps.
struct Timed<E> {
    engine: E,
    start: Moment,
    crop: Option<Span>,
    features: Span,
    predict: Span,
    template: Option<Span>,
}

impl<E: Engine> Timed<E> {
    fn new(engine: E) -> Self {
        let (start, none) = (Moment::now(), Span::default());
        Self { engine, start, crop: None, features: none, predict: none, template: None }
    }

    fn begin(&mut self) {
        (self.crop, self.template) = (None, None);
        (self.features, self.predict) = (Span::default(), Span::default());
        self.start = Moment::now();
    }

    fn end(&self) -> Sample {
        let whole = self.start.since();
        let crop = self.crop.unwrap_or_default();
        let inside = |of: fn(&Span) -> f64| {
            let template = self.template.as_ref().map(of);
            let frame = of(&whole) - template.unwrap_or(0.0);
            let parts = [of(&crop), of(&self.features), of(&self.predict)];
            // Clocks are read in between, so the rest is never below zero but for rounding.
            let post = (frame - parts.iter().sum::<f64>()).max(0.0);
            let mut all = [None; STAGES.len()];
            for (to, value) in all.iter_mut().zip(parts.into_iter().chain([post])) {
                *to = Some(value);
            }
            all[FRAME] = Some(frame);
            all[TEMPLATE] = template;
            all
        };
        Sample { wall: inside(|s| s.wall), cpu: inside(|s| s.cpu) }
    }
}

impl<E: Engine> Engine for Timed<E> {
    fn spec(&self) -> &ModelSpec {
        self.engine.spec()
    }
    fn name(&self) -> &'static str {
        self.engine.name()
    }
    fn crop_mut(&mut self) -> &mut [f32] {
        self.engine.crop_mut()
    }
    fn features(&mut self) -> Result<(), EngineError> {
        self.crop.get_or_insert(self.start.since());
        let start = Moment::now();
        let result = self.engine.features();
        self.features += start.since();
        result
    }
    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        self.engine.template_input_mut()
    }
    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        let start = Moment::now();
        let result = self.engine.write_template(slot);
        *self.template.get_or_insert_default() += start.since();
        result
    }
    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        let start = Moment::now();
        let maps = self.engine.predict(filled);
        self.predict += start.since();
        maps
    }
}

/// Frames that are drawn before they are measured one after the other: drawing takes longer than tracking
/// and leaves nothing of the engine in the caches, which a median then has no part in. Few, as their
/// memory is in the figures.
const AHEAD: usize = 4;

/// Frames of the rendered clip, back and forth: the sensor changes in the middle of the clip.
struct Scene {
    clip: Clip,
    pictures: [(Picture, Modality); AHEAD],
    at: usize,
}

impl Scene {
    fn new() -> Self {
        let config = ClipConfig { width: 640, height: 480, ..ClipConfig::default() };
        let pictures = core::array::from_fn(|_| (Picture::default(), Modality::Rgb));
        Self { clip: Clip::new(config), pictures, at: 0 }
    }

    fn draw(&mut self) {
        let last = self.clip.frames() - 1;
        for (i, (picture, modality)) in self.pictures.iter_mut().enumerate() {
            let turn = (self.at + i) % (2 * last);
            let frame = turn.min(2 * last - turn);
            *modality = if frame * 2 < last { Modality::Rgb } else { Modality::Thermal };
            self.clip.render(frame, *modality, picture);
        }
    }

    fn next(&mut self) -> Result<(FrameView<'_>, Modality), HostError> {
        if self.at.is_multiple_of(AHEAD) {
            self.draw();
        }
        let (picture, modality) = &self.pictures[self.at % AHEAD];
        self.at += 1;
        let view = picture.view().map_err(|e| HostError::Argument {
            what: "rendered frame".into(),
            reason: e.to_string(),
        })?;
        Ok((view, *modality))
    }
}

struct Bench {
    tracker: Tracker<Timed<AnyEngine>>,
    scene: Scene,
}

impl Bench {
    /// Loads the bundle and takes the target; every slot is filled when it returns.
    fn load(path: Option<&Path>, choice: &EngineChoice) -> Result<(Self, Loaded), HostError> {
        let start = Moment::now();
        let file = model::load(path)?;
        let bundle = file.bundle()?;
        let engine = model::engine(&file, &bundle, choice)?;
        let isa = match &engine {
            AnyEngine::Native(native) => Some(native.plan_summary().isa.to_owned()),
            _ => None,
        };
        // Every frame counts as found and is remembered, so that writes are in the figures.
        let mut manifest = bundle.manifest().clone();
        manifest.tracker.not_found = 0.0;
        manifest.tracker.write_confidence = 0.0;
        let templates = manifest.spec.templates;
        let preset = manifest.name.to_owned();
        let tracker = Tracker::from_manifest(Timed::new(engine), &manifest).map_err(failed)?;
        drop(manifest);
        drop(bundle);
        drop(file);
        let span = start.since();
        let loaded = Loaded { preset, isa, load_ms: span.wall, load_cpu_ms: span.cpu };
        let mut bench = Self { tracker, scene: Scene::new() };
        let first = bench.scene.clip.truth(0);
        let (view, modality) = bench.scene.next()?;
        bench.tracker.init(&view, first, Some(modality)).map_err(failed)?;
        for _ in 0..=templates {
            bench.frame()?;
        }
        Ok((bench, loaded))
    }

    fn frame(&mut self) -> Result<Sample, HostError> {
        let (view, modality) = self.scene.next()?;
        self.tracker.engine_mut().begin();
        self.tracker.update(&view, Some(modality)).map_err(failed)?;
        Ok(self.tracker.engine_mut().end())
    }

    fn round(&mut self, frames: usize) -> Result<Round, HostError> {
        let mut round = Round::default();
        for _ in 0..frames {
            let (view, modality) = self.scene.next()?;
            let tracker = &mut self.tracker;
            let (result, counts) = count(|| {
                tracker.engine_mut().begin();
                tracker.update(&view, Some(modality))
            });
            result.map_err(failed)?;
            round.frames.push(tracker.engine_mut().end());
            round.allocations += counts.allocations;
            round.bytes += counts.bytes;
            round.system += counts.system;
        }
        round.peak_rss = peak_rss();
        round.pool = pool();
        Ok(round)
    }
}

fn failed(source: TrackError) -> HostError {
    HostError::Tracker { frame: 0, source: Box::new(source) }
}

/// Answers lines of `input`, each a number of frames, until it ends.
///
/// # Errors
/// When the engine fails in a frame, or nobody reads the answers. An engine that cannot be loaded is
/// an answer.
pub fn serve(
    bundle: Option<&Path>,
    choice: &EngineChoice,
    input: impl BufRead,
    mut output: impl Write,
) -> Result<(), HostError> {
    let pipe = |source: io::Error| HostError::Write { path: "standard output".into(), source };
    let mut say = |answer: &Answer| -> Result<(), HostError> {
        let text = serde_json::to_string(answer).map_err(|e| pipe(e.into()))?;
        writeln!(output, "{text}").and_then(|()| output.flush()).map_err(pipe)
    };
    let mut bench = match Bench::load(bundle, choice) {
        Ok((bench, loaded)) => {
            say(&Answer::Loaded(loaded))?;
            bench
        }
        Err(e) => return say(&Answer::Unavailable(crate::error::one_line(&e))),
    };
    for line in input.lines() {
        let line = line.map_err(pipe)?;
        let frames = line.trim().parse().map_err(|_| HostError::Argument {
            what: "worker of `tsda bench`".into(),
            reason: format!("`{line}` is no number of frames"),
        })?;
        say(&Answer::Round(bench.round(frames)?))?;
    }
    Ok(())
}
