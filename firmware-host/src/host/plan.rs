//! From [`HostConfig`] to what runs: names become numbers, sources are opened, everything that
//! makes no sense is refused with the key it stands under.

use super::clock::ClockKind;
use super::config::{HostConfig, RenderConfig, SourceConfig};
use super::output::SourceInfo;
use super::sensor::Sensor;
use super::source::{Held, Raw16Folder, Reel, Source};
use crate::error::HostError;
use crate::frames::{FrameSource, PictureFiles, Y4m, find_init};
use crate::picture::Picture;
use crate::render::{Clip, ClipConfig};
use crate::switch::policy::{FailurePlan, ScenePlan};
use crate::switch::{Homography, SwitchPlan};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;
use std::time::Duration;
use tsda_runtime::engine::EngineChoice;
use tsda_runtime::{BBox, Modality};

/// What a run needs besides tracker and outputs.
#[derive(Debug)]
pub struct Plan {
    /// Sensors in the order of the configuration.
    pub sensors: Vec<Sensor>,
    /// When to change them.
    pub switch: SwitchPlan,
    /// Registration from sensor to sensor, where given.
    pub registrations: Registrations,
    /// First box and the sensor whose pixels it is in.
    pub target: Option<(usize, BBox)>,
    /// Engine.
    pub engine: EngineChoice,
    /// Time of the run and steps per second.
    pub clock: (ClockKind, f64),
    /// End after so many records.
    pub frames: Option<u64>,
    /// End after so long without any usable picture.
    pub give_up: Option<Duration>,
}

/// Registrations of all ordered pairs.
#[derive(Clone, Debug, Default)]
pub struct Registrations(Vec<(usize, usize, Homography)>);

impl Registrations {
    /// From pairs of numbers.
    pub fn new(given: Vec<(usize, usize, Homography)>) -> Self {
        Self(given)
    }

    /// From one sensor's picture to another's: the one given, else the inverse of the opposite one.
    /// `None`: the same field of view is assumed.
    pub fn between(&self, from: usize, to: usize) -> Option<Homography> {
        let find = |a, b| self.0.iter().find(|(f, t, _)| (*f, *t) == (a, b)).map(|r| r.2);
        find(from, to).or_else(|| find(to, from)?.inverse().ok())
    }
}

fn refuse<T>(what: impl Into<String>, reason: impl Into<String>) -> Result<T, HostError> {
    Err(HostError::Argument { what: what.into(), reason: reason.into() })
}

fn seconds(key: &str, value: f64) -> Result<Duration, HostError> {
    match Duration::try_from_secs_f64(value) {
        Ok(time) if time < Duration::from_secs(1_000_000_000) => Ok(time),
        _ => refuse(key, format!("{value} is no time in seconds")),
    }
}

impl Plan {
    /// Checks a configuration and opens its sources.
    ///
    /// # Errors
    /// Names the key, file or device that cannot be used.
    pub fn new(config: &HostConfig) -> Result<Self, HostError> {
        if config.sources.is_empty() {
            return refuse("source", "no source is given; one [[source]] at least is needed");
        }
        for (i, source) in config.sources.iter().enumerate() {
            if source.name.is_empty() || source.name.contains(char::is_control) {
                return refuse(format!("source {i}: name"), "a name has to be given");
            }
            if config.sources[..i].iter().any(|s| s.name == source.name) {
                return refuse("source", format!("the name `{}` is used twice", source.name));
            }
        }
        // Everything that costs nothing is checked before a camera is touched.
        let switch = switch_plan(config)?;
        let registrations = registrations(config)?;
        let preferred = switch.preferred;
        let target_source = match &config.target.source {
            Some(name) => number(config, "target.source", name)?,
            None => preferred,
        };
        let given = match config.target.bbox {
            Some([x, y, w, h]) if BBox::new(x, y, w, h).is_valid() => Some(BBox::new(x, y, w, h)),
            Some(b) => {
                return refuse("target.box", format!("{b:?} is no box: x, y, width, height"));
            }
            None => None,
        };
        let text = config.engine.as_deref().unwrap_or_default();
        let engine = match text {
            "" => EngineChoice::default(),
            text => text.parse().map_err(|e| HostError::Argument {
                what: "engine".into(),
                reason: format!("{e}"),
            })?,
        };
        if config.clock == ClockKind::Frames
            && let Some(s) = config.sources.iter().find(|s| s.v4l2.is_some())
        {
            let reason = format!("`frames` is not for cameras, and `{}` is one", s.name);
            return refuse("clock", reason);
        }
        let give_up = config.give_up_s.map(|s| seconds("give_up_s", s)).transpose()?;

        let mut sensors = Vec::with_capacity(config.sources.len());
        for source in &config.sources {
            sensors.push(sensor(config, source)?);
        }
        let known = given.or_else(|| sensors[target_source].source().known_box());
        let rate = sensors.iter().filter_map(|s| s.source().rate()).fold(0.0, f64::max);
        Ok(Self {
            target: known.map(|b| (target_source, b)),
            sensors,
            switch,
            registrations,
            engine,
            clock: (config.clock, if rate > 0.0 { rate } else { 30.0 }),
            frames: config.frames,
            give_up,
        })
    }
}

fn number(config: &HostConfig, key: &str, name: &str) -> Result<usize, HostError> {
    config.sources.iter().position(|s| s.name == name).ok_or_else(|| {
        let known: Vec<&str> = config.sources.iter().map(|s| s.name.as_str()).collect();
        HostError::Argument {
            what: key.to_owned(),
            reason: format!("there is no source `{name}`; there are {}", known.join(", ")),
        }
    })
}

fn switch_plan(config: &HostConfig) -> Result<SwitchPlan, HostError> {
    let switch = &config.switch;
    let preferred = match &switch.preferred {
        Some(name) => number(config, "switch.preferred", name)?,
        None => 0,
    };
    let failure = match &switch.failure {
        None => None,
        Some(f) => Some(FailurePlan {
            after: seconds("switch.failure.after_s", f.after_s)?,
            return_after: if f.return_after_s < 0.0 {
                None
            } else {
                Some(seconds("switch.failure.return_after_s", f.return_after_s)?)
            },
        }),
    };
    let mut schedule = Vec::new();
    for entry in &switch.schedule {
        let at = seconds("switch.schedule.at_s", entry.at_s)?;
        schedule.push((at, number(config, "switch.schedule.to", &entry.to)?));
    }
    if !schedule.is_sorted_by_key(|(at, _)| *at) {
        return refuse("switch.schedule", "entries have to be in the order of time");
    }
    let every = switch.every_s.map(|s| seconds("switch.every_s", s)).transpose()?;
    if every.is_some_and(|e| e < Duration::from_millis(10)) {
        return refuse("switch.every_s", "at least 0.01 seconds");
    }
    let scene = match &switch.scene {
        None => None,
        Some(s) => {
            if !(s.below < s.above && s.below >= 0.0 && s.above <= 1.0) {
                let reason = format!(
                    "below {} and above {} have to be 0 <= below < above <= 1: between them \
                     nothing changes",
                    s.below, s.above
                );
                return refuse("switch.scene", reason);
            }
            let watch = number(config, "switch.scene.watch", &s.watch)?;
            let otherwise = number(config, "switch.scene.otherwise", &s.otherwise)?;
            if watch == otherwise {
                return refuse("switch.scene", "`watch` and `otherwise` are the same source");
            }
            let hold = seconds("switch.scene.hold_s", s.hold_s)?;
            let (measure, below, above) = (s.measure, s.below, s.above);
            Some(ScenePlan { watch, otherwise, measure, below, above, hold })
        }
    };
    Ok(SwitchPlan { preferred, failure, schedule, every, scene })
}

fn registrations(config: &HostConfig) -> Result<Registrations, HostError> {
    let mut given: Vec<(usize, usize, Homography)> = Vec::new();
    for r in &config.registrations {
        let key = format!("registration from {} to {}", r.from, r.to);
        let from = number(config, "registration.from", &r.from)?;
        let to = number(config, "registration.to", &r.to)?;
        if from == to {
            return refuse(key, "a source is not registered with itself");
        }
        if given.iter().any(|g| (g.0, g.1) == (from, to)) {
            return refuse(key, "given twice");
        }
        if let Err(e) = r.matrix.validate() {
            return refuse(key, e.to_string());
        }
        given.push((from, to, r.matrix));
    }
    Ok(Registrations(given))
}

fn sensor(config: &HostConfig, source: &SourceConfig) -> Result<Sensor, HostError> {
    let key = |part: &str| format!("source `{}`{part}", source.name);
    let kinds = [
        ("v4l2", source.v4l2.is_some()),
        ("files", source.files.is_some()),
        ("y4m", source.y4m.is_some()),
        ("raw16", source.raw16.is_some()),
        ("render", source.render.is_some()),
    ];
    let given: Vec<&str> = kinds.iter().filter(|k| k.1).map(|k| k.0).collect();
    match given[..] {
        [_] => {}
        [] => return refuse(key(""), "one of v4l2, files, y4m, raw16, render has to be given"),
        _ => return refuse(key(""), format!("{} exclude each other", given.join(" and "))),
    }
    if source.v4l2.is_some() && !source.faults.is_empty() {
        return refuse(key(".faults"), "faults are rehearsed with files and drawn scenes only");
    }
    if source.crop.is_some_and(|c| c[2] == 0 || c[3] == 0) {
        return refuse(key(".crop"), "x, y, width, height: width and height of at least 1");
    }
    if let Some(c) = &source.celsius
        && !(c.scale.is_finite() && c.scale > 0.0 && c.offset.is_finite())
    {
        return refuse(key(".celsius"), "scale has to be above 0: kelvin per raw step");
    }
    let health = &source.health;
    for (name, value) in [("timeout_s", health.timeout_s), ("frozen_s", health.frozen_s)] {
        seconds(&key(&format!(".health.{name}")), value)?;
    }
    let opened: Box<dyn Source> = if let Some(camera) = &source.v4l2 {
        open_camera(&source.name, camera)?
    } else {
        Box::new(open_reel(config, source)?.with_faults(source.faults.clone()))
    };
    let info = SourceInfo { name: source.name.clone(), sensor: source.sensor };
    let meaning = (source.profile, source.celsius);
    Sensor::new(info, opened, meaning, source.agc, *health, source.crop)
}

#[cfg(feature = "camera")]
fn open_camera(
    name: &str,
    camera: &super::config::V4l2Config,
) -> Result<Box<dyn Source>, HostError> {
    Ok(Box::new(crate::camera::CameraSource::open(name, camera)?))
}

#[cfg(not(feature = "camera"))]
fn open_camera(name: &str, _: &super::config::V4l2Config) -> Result<Box<dyn Source>, HostError> {
    refuse(
        format!("source `{name}`.v4l2"),
        "this program was built without cameras; build it with `--features camera` (docs/board.md)",
    )
}

fn rate(source: &SourceConfig, rate: f64) -> Result<f64, HostError> {
    if rate.is_finite() && (0.01..=10_000.0).contains(&rate) {
        return Ok(rate);
    }
    refuse(format!("source `{}`: rate", source.name), format!("{rate} pictures per second"))
}

fn open_reel(config: &HostConfig, source: &SourceConfig) -> Result<Reel, HostError> {
    let name = |path: &Path| path.display().to_string();
    if let Some(files) = &source.files {
        let (path, rate) = (config.path(&files.path), rate(source, files.rate)?);
        let known = find_init(&path)?.map(|(_, b)| b);
        let what = name(&path);
        let open = move || -> Result<Box<dyn FrameSource>, HostError> {
            let files = if path.is_dir() {
                PictureFiles::folder(&path)?
            } else {
                PictureFiles::list(&path)?
            };
            Ok(Box::new(files))
        };
        let reel = if files.preload {
            Reel::loaded(load(open()?.as_mut())?, rate, what)
        } else {
            Reel::stream(Box::new(open), rate, what)?
        };
        return Ok(reel.repeated(files.repeat).with_box(known));
    }
    if let Some(y4m) = &source.y4m {
        let (path, sensor, what) = (config.path(&y4m.path), source.sensor, name(&y4m.path));
        let open = move || -> Result<Box<dyn FrameSource>, HostError> {
            let io = |source| crate::frames::SourceError::Io { path: path.clone(), source };
            let reader = BufReader::new(File::open(&path).map_err(io)?);
            Ok(Box::new(Y4m::open(reader, &name(&path), Some(sensor))?))
        };
        let reel = Reel::stream(Box::new(open), rate(source, y4m.rate)?, what)?;
        return Ok(reel.repeated(y4m.repeat));
    }
    if let Some(raw) = &source.raw16 {
        if !(8..=16).contains(&raw.bits) {
            let reason = format!("{} is not between 8 and 16", raw.bits);
            return refuse(format!("source `{}`.raw16.bits", source.name), reason);
        }
        let (path, size) = (config.path(&raw.path), (raw.size[0], raw.size[1]));
        let (what, full) = (name(&path), u16::MAX >> (16 - raw.bits));
        let open = move || -> Result<Box<dyn FrameSource>, HostError> {
            Ok(Box::new(Raw16Folder::open(&path, size)?))
        };
        let reel = Reel::stream(Box::new(open), rate(source, raw.rate)?, what)?;
        return Ok(reel.repeated(raw.repeat).with_full(full));
    }
    let drawn = source.render.clone().unwrap_or_default();
    let rate = rate(source, drawn.rate)?;
    Ok(render(&drawn, source.sensor, rate).repeated(drawn.repeat))
}

fn load(source: &mut dyn FrameSource) -> Result<Vec<Held>, HostError> {
    let mut pictures = Vec::new();
    while let Some(frame) = source.next_frame()? {
        pictures.push(Held::of(&frame.view));
    }
    Ok(pictures)
}

/// Raw value of black in a drawn 16-bit picture: 20 degrees Celsius in steps of 0.01 K.
pub const RAW_FIRST: u16 = 29_315;
/// Raw steps per grey level.
pub const RAW_STEP: u16 = 8;

/// Draws the whole scene beforehand: drawing takes longer than tracking.
fn render(drawn: &RenderConfig, sensor: Modality, rate: f64) -> Reel {
    let clip = Clip::new(ClipConfig {
        width: drawn.size[0].max(16),
        height: drawn.size[1].max(16),
        frames: drawn.frames.max(2),
        seed: drawn.seed,
        screen: false,
    });
    let mut picture = Picture::default();
    let mut pictures = Vec::with_capacity(clip.frames());
    for frame in 0..clip.frames() {
        clip.render(frame, sensor, &mut picture);
        if let Ok(view) = picture.view() {
            let mut held = Held::of(&view);
            if drawn.raw16 && sensor == Modality::Thermal {
                held.widen(RAW_FIRST, RAW_STEP);
            }
            pictures.push(held);
        }
    }
    let what = format!("drawn scene, seed {}, {} frames", drawn.seed, clip.frames());
    Reel::loaded(pictures, rate, what).with_box(Some(clip.truth(0)))
}
