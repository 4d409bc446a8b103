use super::*;
use crate::frames::SourceError;
use crate::picture::Picture;
use crate::render::{Clip, ClipConfig};
use crate::sequence::{ClipFrames, Switching};
use std::fs;
use std::path::PathBuf;
use tsda_runtime::engine::{Maps, Stage, TemplateInput};
use tsda_runtime::{EngineError, ModelSpec, TrackerParams};

/// Finds bright warm things: scores are the brightness of a cell above the crop's mean, boxes are constant.
/// Enough to drive the real tracker without a network.
struct BrightEngine {
    spec: ModelSpec,
    crop: Vec<f32>,
    label: Vec<f32>,
    ltrb_in: Vec<f32>,
    scores: Vec<f32>,
    ltrb: Vec<f32>,
    fail_after: usize,
}

impl BrightEngine {
    fn new() -> Self {
        let spec = ModelSpec::NANO;
        Self {
            spec,
            crop: vec![0.0; spec.crop_len()],
            label: vec![0.0; spec.cells()],
            ltrb_in: vec![0.0; 4 * spec.cells()],
            scores: vec![0.0; spec.cells()],
            ltrb: vec![0.1; 4 * spec.cells()],
            fail_after: usize::MAX,
        }
    }
}

impl Engine for BrightEngine {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    fn name(&self) -> &'static str {
        "bright"
    }

    fn crop_mut(&mut self) -> &mut [f32] {
        &mut self.crop
    }

    fn features(&mut self) -> Result<(), EngineError> {
        if self.fail_after == 0 {
            return Err(EngineError::new("bright", Stage::Features, format_args!("as asked")));
        }
        self.fail_after -= 1;
        Ok(())
    }

    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        TemplateInput { label: &mut self.label, ltrb: &mut self.ltrb_in }
    }

    fn write_template(&mut self, _: usize) -> Result<(), EngineError> {
        Ok(())
    }

    fn predict(&mut self, _: usize) -> Result<Maps<'_>, EngineError> {
        let (f, side) = (self.spec.map_side(), self.spec.crop_side());
        let mean = self.crop[..side * side].iter().sum::<f32>() / (side * side) as f32;
        for (i, score) in self.scores.iter_mut().enumerate() {
            let (row, column) = (i / f * 16, i % f * 16);
            let mut sum = 0.0;
            for y in row..row + 16 {
                sum += self.crop[y * side + column..y * side + column + 16].iter().sum::<f32>();
            }
            *score = sum / 256.0 - mean;
        }
        Ok(Maps { scores: &self.scores, ltrb: &self.ltrb })
    }
}

/// Pictures from memory.
struct Pictures {
    pictures: Vec<(Picture, Modality)>,
    next: usize,
}

impl FrameSource for Pictures {
    fn len_hint(&self) -> Option<usize> {
        Some(self.pictures.len())
    }

    fn next_frame(&mut self) -> Result<Option<Frame<'_>>, SourceError> {
        let Some((picture, modality)) = self.pictures.get(self.next) else { return Ok(None) };
        self.next += 1;
        let view = picture
            .view()
            .map_err(|source| SourceError::Frame { name: "memory".into(), source })?;
        Ok(Some(Frame { index: self.next - 1, name: "memory", modality: *modality, view }))
    }
}

fn tracker() -> Tracker<BrightEngine> {
    Tracker::new(BrightEngine::new(), TrackerParams::default()).expect("tracker")
}

static GO: AtomicBool = AtomicBool::new(false);

fn short_clip() -> ClipFrames {
    let config = ClipConfig { frames: 8, ..ClipConfig::default() };
    ClipFrames::new(Clip::new(config), Switching::Every(3))
}

fn run<'a>(init: BBox, truth: &'a [Option<BBox>]) -> Run<'a> {
    Run { init, init_from: "test", truth, stop: &GO }
}

fn sinks(dir: &Path) -> Vec<Box<dyn Sink>> {
    let at = |n: &str| dir.join(n);
    let video = |n: &str| crate::video::open(&at(n), Some(8)).expect(n);
    vec![
        Box::new(BoxesFile::create(&at("boxes.txt")).expect("boxes")),
        Box::new(JsonLines::create(&at("track.jsonl")).expect("json")),
        video("clip.gif"),
        video("clip.html"),
        video("strip.png"),
        video("frames"),
    ]
}

fn names(dir: &Path) -> Vec<PathBuf> {
    fs::read_dir(dir).expect("folder").map(|e| e.expect("entry").path()).collect()
}

#[test]
fn every_output_holds_every_frame() {
    let dir = tempfile::tempdir().expect("temp");
    let mut source = short_clip();
    let truth = source.truth();
    let init = truth[0].expect("box");
    let steps = run(init, &truth)
        .drive(&mut tracker(), &mut source, sinks(dir.path()), |_| {})
        .expect("track");
    assert_eq!(steps.len(), 8);
    assert_eq!((steps[0].bbox, steps[0].score), (init, 1.0));
    let sensors: Vec<&str> = steps.iter().map(|s| s.modality.as_str()).collect();
    assert_eq!(sensors, ["rgb", "rgb", "rgb", "thermal", "thermal", "thermal", "rgb", "rgb"]);

    let read = |n: &str| fs::read_to_string(dir.path().join(n)).expect(n);
    let boxes = read("boxes.txt");
    assert_eq!(boxes.lines().count(), 8);
    for (line, step) in boxes.lines().zip(&steps) {
        let b = crate::frames::parse_box(line).expect("box");
        assert!((b.x - step.bbox.x).abs() < 0.01 && (b.h - step.bbox.h).abs() < 0.01);
    }
    for (i, line) in read("track.jsonl").lines().enumerate() {
        let row: serde_json::Value = serde_json::from_str(line).expect("json");
        assert_eq!(row["frame"], i);
        assert_eq!(row["modality"], sensors[i]);
        assert_eq!(row["box"].as_array().map(Vec::len), Some(4));
        assert!(row["state"].is_string() && row["score"].is_number() && row["ms"].is_number());
    }
    let page = read("clip.html");
    assert_eq!(page.matches("\"/9j/").count(), 8, "JPEG frames in the page");
    assert_eq!(page.matches("\"g\":[").count(), 8, "truth in the page");
    assert!(!page.contains("http"), "the page must not load anything");
    let file = fs::File::open(dir.path().join("clip.gif")).expect("gif");
    let mut gif = gif::Decoder::new(file).expect("gif");
    let mut frames = 0;
    while gif.read_next_frame().expect("frame").is_some() {
        frames += 1;
    }
    assert_eq!((frames, gif.width()), (8, 320));
    assert_eq!(names(&dir.path().join("frames")).len(), 8);
    let strip = image::open(dir.path().join("strip.png")).expect("strip");
    assert_eq!(strip.width(), 4 * 324 - 4);
    assert_eq!(names(dir.path()).len(), 6, "{:?}", names(dir.path()));
}

#[test]
fn nothing_is_left_behind_when_a_run_fails() {
    let truth = short_clip().truth();
    let init = truth[0].expect("box");
    let stop = AtomicBool::new(false);
    let good = run(init, &truth);
    let cases: [(&str, Run<'_>, usize, u8); 4] = [
        ("engine", good, 4, 3),
        ("interrupted", Run { stop: &stop, ..good }, usize::MAX, 3),
        ("outside", run(BBox::new(900.0, 10.0, 20.0, 20.0), &truth), usize::MAX, 2),
        ("no area", run(BBox::new(10.0, 10.0, 0.0, 20.0), &truth), usize::MAX, 2),
    ];
    for (name, run, fail_after, code) in cases {
        let dir = tempfile::tempdir().expect("temp");
        let mut tracker = tracker();
        tracker.engine_mut().fail_after = fail_after;
        let e = run
            .drive(&mut tracker, &mut short_clip(), sinks(dir.path()), |step| {
                stop.store(name == "interrupted" && step.frame == 2, Ordering::Relaxed);
            })
            .expect_err(name);
        assert_eq!(e.exit_code(), code, "{name}: {e}");
        assert_eq!(names(dir.path()), Vec::<PathBuf>::new(), "{name}");
    }
}

#[test]
fn the_box_follows_when_the_sensors_differ_in_size() {
    let clip = Clip::new(ClipConfig::default());
    let mut small = Picture::default();
    clip.render(0, Modality::Thermal, &mut small);
    let mut large = Picture::default();
    large.reset(640, 480, 1);
    for (i, v) in large.data.iter_mut().enumerate() {
        *v = small.data[(i / 640 / 2) * 320 + i % 640 / 2];
    }
    let pictures = vec![(small, Modality::Rgb), (large, Modality::Thermal)];
    let init = clip.truth(0);
    let steps = run(init, &[])
        .drive(&mut tracker(), &mut Pictures { pictures, next: 0 }, Vec::new(), |_| {})
        .expect("track");
    let (want, found) = (init.centre(), steps[1].bbox.centre());
    let off = (want.0 * 2.0 - found.0).hypot(want.1 * 2.0 - found.1);
    assert!(off < 60.0, "{:?} after {init:?}", steps[1].bbox);
}

#[test]
fn no_frames_is_an_error() {
    let mut source = Pictures { pictures: Vec::new(), next: 0 };
    let e = run(BBox::new(0.0, 0.0, 9.0, 9.0), &[])
        .drive(&mut tracker(), &mut source, Vec::new(), |_| {})
        .expect_err("empty");
    assert_eq!(e.exit_code(), 2, "{e}");
}

/// The rendered target is warm: even brightness alone follows it through the thermal half.
#[test]
fn the_rendered_target_can_be_followed_in_thermal() {
    let mut source = ClipFrames::new(Clip::new(ClipConfig::default()), Switching::Every(1));
    let truth = source.truth();
    let mut pictures = Vec::new();
    while let Some(frame) = source.next_frame().expect("frame") {
        if frame.modality == Modality::Thermal {
            let (width, height, channels) = (frame.view.width(), frame.view.height(), 1);
            let data = frame.view.data().to_vec();
            pictures.push((Picture { width, height, channels, data }, Modality::Thermal));
        }
    }
    let init = truth[1].expect("box");
    let steps = run(init, &[])
        .drive(&mut tracker(), &mut Pictures { pictures, next: 0 }, Vec::new(), |_| {})
        .expect("track");
    let near = steps.iter().zip(truth.iter().skip(1).step_by(2)).filter(|(s, t)| {
        let (a, b) = (s.bbox.centre(), t.unwrap_or_default().centre());
        (a.0 - b.0).hypot(a.1 - b.1) < 30.0
    });
    assert!(near.count() > 24, "{:?}", steps.iter().map(|s| s.bbox).collect::<Vec<_>>());
}
