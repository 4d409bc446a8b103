use super::*;
use crate::engine::Stage;
use crate::testing::ScriptedEngine;
use proptest::prelude::*;

const SPEC: ModelSpec = ModelSpec { crop: 80, templates: 3, ..ModelSpec::NANO };
const SIZE: (usize, usize) = (120, 90);
const BOX: BBox = BBox::new(40.0, 30.0, 20.0, 24.0);

fn picture() -> Vec<u8> {
    crate::testing::recipe(0, SIZE.0, SIZE.1)
}

fn started() -> (Tracker<ScriptedEngine>, Vec<u8>) {
    let mut tracker = Tracker::new(ScriptedEngine::new(SPEC), TrackerParams::default()).unwrap();
    let picture = picture();
    tracker.init(&view(&picture), BOX, None).unwrap();
    (tracker, picture)
}

fn view(picture: &[u8]) -> FrameView<'_> {
    FrameView::rgb(picture, SIZE.0, SIZE.1).unwrap()
}

/// Maps with one peak at a cell and a box of `target` crop pixels around every cell.
fn answer(engine: &mut ScriptedEngine, cell: (usize, usize), score: f32, target: f32) {
    let side = engine.spec.map_side();
    engine.answer.0.fill(0.0);
    engine.answer.0[cell.0 * side + cell.1] = score;
    let half = target * 0.5 / f32::from(engine.spec.crop);
    engine.answer.1.fill(half);
}

#[test]
fn an_odd_map_needs_no_shift_and_a_still_target_stays() {
    let (mut tracker, picture) = started();
    // Small enough for the search area to lie inside the picture.
    tracker.init(&view(&picture), BBox::new(50.0, 40.0, 10.0, 12.0), None).unwrap();
    // 5 x 5 cells: the middle one is at the middle of the crop.
    answer(tracker.engine_mut(), (2, 2), 0.8, 80.0 / 4.0);
    let before = tracker.target().unwrap().pos();
    tracker.update(&view(&picture), None).unwrap();
    assert_eq!(tracker.last_search().unwrap().centre, before);
    let after = tracker.target().unwrap().pos();
    assert!((after.y - before.y).abs() < 1.1 && (after.x - before.x).abs() < 1.1, "{after:?}");
}

#[test]
fn an_even_map_shifts_the_search_by_half_a_cell() {
    let spec = ModelSpec { crop: 96, ..SPEC };
    let mut tracker = Tracker::new(ScriptedEngine::new(spec), TrackerParams::default()).unwrap();
    let picture = picture();
    tracker.init(&view(&picture), BOX, None).unwrap();
    let (pos, scale) = (tracker.target().unwrap().pos(), tracker.target().unwrap().scale());
    tracker.update(&view(&picture), None).unwrap();
    let centre = tracker.last_search().unwrap().centre;
    assert_eq!((centre.y, centre.x), (pos.y + 8.0 * scale, pos.x + 8.0 * scale));
}

#[test]
fn confident_frames_fill_the_slots_and_then_replace_the_oldest() {
    let (mut tracker, picture) = started();
    answer(tracker.engine_mut(), (2, 2), 0.95, 20.0);
    for _ in 0..4 {
        assert!(tracker.update(&view(&picture), Some(Modality::Thermal)).unwrap().wrote_memory);
    }
    assert_eq!(tracker.engine().written, [0, 1, 2, 1, 2]);
    assert_eq!(tracker.engine().asked, [1, 2, 3, 3]);
    let held: Vec<_> = tracker.memory().templates().iter().map(|t| (t.frame, t.modality)).collect();
    assert_eq!(held, [(0, None), (3, Some(Modality::Thermal)), (4, Some(Modality::Thermal))]);
    // Exactly at the threshold is not above it.
    answer(tracker.engine_mut(), (2, 2), 0.9, 20.0);
    assert!(!tracker.update(&view(&picture), None).unwrap().wrote_memory);
}

#[test]
fn states_follow_flag_score_and_time() {
    let (mut tracker, picture) = started();
    tracker.params.lost_after = 3;
    let mut step = |score: f32| {
        answer(tracker.engine_mut(), (2, 2), score, 20.0);
        let track = tracker.update(&view(&picture), None).unwrap();
        (track.state, track.missing)
    };
    use TrackState::{Lost, Searching, Tracking, Uncertain};
    for (i, (score, want)) in [
        (0.8, (Tracking, 0)),
        (0.4, (Uncertain, 0)),
        (0.1, (Searching, 1)),
        (0.1, (Searching, 2)),
        (0.8, (Tracking, 0)),
        (0.1, (Searching, 1)),
        (0.1, (Searching, 2)),
        (0.1, (Lost, 3)),
        (0.1, (Lost, 4)),
        (0.8, (Uncertain, 0)),
        (0.8, (Tracking, 0)),
    ]
    .into_iter()
    .enumerate()
    {
        assert_eq!(step(score), want, "step {i}");
    }
}

#[test]
fn a_missing_target_keeps_its_box_and_its_templates() {
    let (mut tracker, picture) = started();
    answer(tracker.engine_mut(), (2, 3), 0.95, 30.0);
    let seen = tracker.update(&view(&picture), None).unwrap();
    answer(tracker.engine_mut(), (0, 0), 0.1, 60.0);
    for _ in 0..40 {
        let track = tracker.update(&view(&picture), None).unwrap();
        assert_eq!(track.bbox, seen.bbox);
        assert!(track.score < 0.25 && !track.wrote_memory);
    }
    assert_eq!(tracker.target().unwrap().state(), TrackState::Lost);
    assert_eq!(tracker.memory().filled(), 2);
}

/// The memory of scales is 60 long; the newest must survive the wrap.
#[test]
fn old_scales_are_forgotten() {
    let mut target = Target::new(&BOX, &SPEC);
    let scaled = |f: f32| BBox::new(0.0, 0.0, 20.0 * f, 24.0 * f);
    let unit = target.scale();
    target.accept(&scaled(9.0));
    for _ in 0..59 {
        target.accept(&scaled(1.0));
    }
    let mut all = target;
    for _ in 0..30 {
        all.miss();
    }
    assert!((all.scale() / unit - 1.0).abs() < 1e-5, "30 of the newest: {}", all.scale() / unit);
    target.accept(&scaled(2.0));
    for _ in 0..5 {
        target.miss();
        // The scale of 9 is 61 acceptances ago; nothing else is above 2.
        assert!((target.scale() / unit - 2.0).abs() < 1e-5);
    }
    let mut growing = Target::new(&BOX, &SPEC);
    growing.miss();
    assert_eq!((growing.not_found(), growing.scale()), (0, unit));
    for f in [1.0, 3.0, 2.0] {
        growing.accept(&scaled(f));
    }
    growing.miss();
    assert!((growing.scale() / unit - 2.5).abs() < 1e-5);
}

#[test]
fn a_switch_moves_the_target_and_keeps_what_was_learnt() {
    let (mut tracker, picture) = started();
    assert_eq!(tracker.target().unwrap().bbox(), BOX);
    answer(tracker.engine_mut(), (2, 2), 0.95, 20.0);
    let track = tracker.update(&view(&picture), Some(Modality::Rgb)).unwrap();
    let scale = tracker.target().unwrap().scale();
    // The other sensor sees everything twice as large.
    let b = track.bbox;
    let moved = BBox::new(2.0 * b.x, 2.0 * b.y, 2.0 * b.w, 2.0 * b.h);
    tracker.set_box(moved).unwrap();
    let target = tracker.target().unwrap();
    assert!((target.scale() / scale - 2.0).abs() < 1e-5);
    let back = target.bbox();
    assert!((back.x - moved.x).abs() < 1e-4 && (back.h - moved.h).abs() < 1e-4);
    assert_eq!(tracker.memory().filled(), 2);
    // A picture of another size and format is searched where the target was put.
    let grey = vec![90; 240 * 180];
    let frame = FrameView::gray(&grey, 240, 180).unwrap();
    answer(tracker.engine_mut(), (4, 4), 0.1, 20.0);
    let track = tracker.update(&frame, Some(Modality::Thermal)).unwrap();
    assert_eq!(track.state, TrackState::Searching);
    assert!((tracker.target().unwrap().scale() / scale - 2.0).abs() < 1e-4);
    assert!(tracker.set_box(BBox::new(f32::NAN, 0.0, 1.0, 1.0)).is_err());
}

#[test]
fn unusable_boxes_are_refused_by_name() {
    let (mut tracker, picture) = started();
    let cases: [(BBox, &str); 8] = [
        (BBox::new(f32::NAN, 0.0, 5.0, 5.0), "finite"),
        (BBox::new(0.0, 0.0, f32::INFINITY, 5.0), "finite"),
        (BBox::new(0.0, 0.0, 0.0, 5.0), "no area"),
        (BBox::new(0.0, 0.0, 5.0, -5.0), "no area"),
        (BBox::new(0.0, 0.0, 1e7, 5.0), "longer than"),
        (BBox::new(120.0, 0.0, 5.0, 5.0), "outside the picture of 120 x 90"),
        (BBox::new(0.0, -5.0, 5.0, 5.0), "outside"),
        (BBox::new(-9.0, 90.0, 5.0, 5.0), "outside"),
    ];
    for (bbox, want) in cases {
        let error = tracker.init(&view(&picture), bbox, None).unwrap_err();
        assert!(matches!(error, TrackError::Box(_)));
        assert!(error.to_string().contains(want), "{error}");
    }
    // A refused box leaves the old target alone.
    assert!(tracker.target().is_some());
}

#[test]
fn a_failing_engine_changes_nothing() {
    let (mut tracker, picture) = started();
    answer(tracker.engine_mut(), (3, 2), 0.95, 20.0);
    for stage in [Stage::Features, Stage::Predict, Stage::Template] {
        let (target, memory) = (*tracker.target().unwrap(), tracker.memory().clone());
        tracker.engine_mut().fail = Some(stage);
        let error = tracker.update(&view(&picture), None).unwrap_err();
        assert!(matches!(error, TrackError::Engine(ref e) if e.stage == stage), "{error}");
        assert_eq!((tracker.target(), tracker.memory()), (Some(&target), &memory));
    }
    tracker.engine_mut().fail = None;
    assert_eq!(tracker.update(&view(&picture), None).unwrap().frame, 1);
    tracker.engine_mut().fail = Some(Stage::Template);
    tracker.init(&view(&picture), BOX, None).unwrap_err();
    assert_eq!(tracker.update(&view(&picture), None).unwrap_err(), TrackError::NoTarget);
}

#[test]
fn answers_that_are_no_numbers_are_errors() {
    for what in ["score map", "ltrb map"] {
        for bad in [f32::NAN, f32::INFINITY] {
            let (mut tracker, picture) = started();
            answer(tracker.engine_mut(), (2, 2), 0.8, 20.0);
            let answer = &mut tracker.engine_mut().answer;
            if what == "score map" {
                answer.0[0] = bad
            } else {
                answer.1.fill(bad)
            }
            let error = tracker.update(&view(&picture), None).unwrap_err();
            assert_eq!(error, TrackError::NotFinite { engine: "scripted", what });
            assert_eq!(tracker.target().unwrap().frame(), 0);
        }
    }
}

#[test]
fn what_does_not_fit_is_named_before_the_first_frame() {
    let params = TrackerParams::default();
    let mut engine = ScriptedEngine::new(SPEC);
    engine.label.pop();
    let error = Tracker::new(engine, params).unwrap_err();
    assert!(error.to_string().contains("template label has 24"), "{error}");
    let bad = TrackerParams { min_size: f32::NAN, ..params };
    let error = Tracker::new(ScriptedEngine::new(SPEC), bad).unwrap_err();
    assert!(error.to_string().contains("min_size"), "{error}");
    let mut engine = ScriptedEngine::new(SPEC);
    engine.spec.heads = 7;
    assert!(matches!(Tracker::new(engine, params).unwrap_err(), TrackError::Spec(_)));

    let mut tracker = Tracker::new(ScriptedEngine::new(SPEC), params).unwrap();
    let picture = picture();
    assert_eq!(tracker.update(&view(&picture), None).unwrap_err(), TrackError::NoTarget);
    assert_eq!(tracker.set_box(BOX).unwrap_err(), TrackError::NoTarget);
    tracker.init(&view(&picture), BOX, None).unwrap();
    tracker.engine_mut().answer.0.pop();
    let error = tracker.update(&view(&picture), None).unwrap_err();
    assert!(matches!(error, TrackError::Buffer { what: "score map", len: 24, needed: 25, .. }));
}

proptest! {
    /// Whatever the network says, the box stays a box that touches the picture.
    #[test]
    fn any_answer_keeps_the_box_sane(
        answers in proptest::collection::vec(
            (0usize..5, 0usize..5, 0f32..1.2, prop_oneof![0.0f32..1.0, 0f32..1e20]), 1..25),
        bbox in (-30f32..119.0, -30f32..89.0, 31f32..200.0, 31f32..200.0),
        sizes in proptest::collection::vec((1usize..150, 1usize..150), 25),
    ) {
        let mut tracker = Tracker::new(ScriptedEngine::new(SPEC), TrackerParams::default()).unwrap();
        let first = picture();
        let bbox = BBox::new(bbox.0, bbox.1, bbox.2, bbox.3);
        tracker.init(&view(&first), bbox, None).unwrap();
        for ((row, col, score, edge), (w, h)) in answers.into_iter().zip(sizes) {
            let engine = tracker.engine_mut();
            engine.answer.0.fill(0.0);
            engine.answer.0[row * 5 + col] = score;
            engine.answer.1.fill(edge);
            let data = vec![1; w * h];
            let frame = FrameView::gray(&data, w, h).unwrap();
            let track = tracker.update(&frame, None).unwrap();
            prop_assert!(track.bbox.is_valid());
            if track.flag != Flag::NotFound {
                prop_assert!(track.bbox.overlaps_image(w, h));
                prop_assert!(track.bbox.w >= 9.999 && track.bbox.w <= (w as f32).max(10.001));
            }
            let target = tracker.target().unwrap();
            prop_assert!(target.scale().is_finite() && target.scale() > 0.0);
        }
    }
}

/// A tracker whose target has been gone for long enough to be lost.
fn lost(options: Option<RedetectOptions>) -> (Tracker<ScriptedEngine>, Vec<u8>) {
    let (mut tracker, picture) = started();
    tracker.params.lost_after = 2;
    tracker.init(&view(&picture), BBox::new(20.0, 20.0, 6.0, 6.0), None).unwrap();
    tracker.set_redetection(options).unwrap();
    answer(tracker.engine_mut(), (0, 0), 0.1, 20.0);
    for _ in 0..2 {
        tracker.update(&view(&picture), None).unwrap();
    }
    assert_eq!(tracker.target().unwrap().state(), TrackState::Lost);
    tracker.engine_mut().asked.clear();
    (tracker, picture)
}

#[test]
fn a_lost_target_is_looked_for_over_the_frame_at_a_bounded_cost() {
    for (positions_per_frame, runs) in [(1, 2), (3, 4)] {
        let options = RedetectOptions { positions_per_frame, threshold: 0.5 };
        let (mut tracker, picture) = lost(Some(options));
        let before = *tracker.target().unwrap();
        let track = tracker.update(&view(&picture), None).unwrap();
        assert_eq!((track.state, track.redetected), (TrackState::Lost, false));
        assert_eq!((track.bbox, track.score), (before.bbox(), 0.1));
        assert_eq!(tracker.engine().asked.len(), runs);
    }
    // Off, the default: one run, the same answer.
    let (mut tracker, picture) = lost(None);
    tracker.update(&view(&picture), None).unwrap();
    assert_eq!((tracker.engine().asked.len(), tracker.redetection()), (1, None));
}

/// Scores by how bright the middle of the crop is: a target that can be drawn into the picture.
#[derive(Debug)]
struct Bright(ScriptedEngine);

impl Engine for Bright {
    fn spec(&self) -> &ModelSpec {
        self.0.spec()
    }
    fn name(&self) -> &'static str {
        "bright"
    }
    fn crop_mut(&mut self) -> &mut [f32] {
        self.0.crop_mut()
    }
    fn features(&mut self) -> Result<(), EngineError> {
        let (side, map) = (self.0.spec.crop_side(), self.0.spec.map_side());
        for row in 0..map {
            for col in 0..map {
                let at = (row * 16 + 8) * side + col * 16 + 8;
                let white = (1.0 - 0.485) / 0.229;
                self.0.answer.0[row * map + col] = self.0.crop[at] / white * 0.95;
            }
        }
        Ok(())
    }
    fn template_input_mut(&mut self) -> crate::engine::TemplateInput<'_> {
        self.0.template_input_mut()
    }
    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        self.0.write_template(slot)
    }
    fn predict(&mut self, filled: usize) -> Result<crate::engine::Maps<'_>, EngineError> {
        self.0.predict(filled)
    }
}

/// Frames until a target that comes back in the opposite corner is found; 100 when it never is.
fn frames_to_find(options: Option<RedetectOptions>) -> (usize, Vec<usize>) {
    let (w, h) = (160, 120);
    let draw = |at: Option<(usize, usize)>| {
        let mut data = vec![0u8; w * h];
        if let Some((y, x)) = at {
            for row in y..y + 12 {
                data[row * w + x..row * w + x + 12].fill(255);
            }
        }
        data
    };
    let engine = Bright(ScriptedEngine::new(SPEC));
    let params = TrackerParams { lost_after: 3, min_size: 4.0, ..TrackerParams::default() };
    let mut tracker = Tracker::new(engine, params).unwrap();
    tracker.set_redetection(options).unwrap();
    let seen = draw(Some((10, 10)));
    let frame = FrameView::gray(&seen, w, h).unwrap();
    tracker.init(&frame, BBox::new(10.0, 10.0, 12.0, 12.0), None).unwrap();
    let empty = draw(None);
    let frame = FrameView::gray(&empty, w, h).unwrap();
    for _ in 0..6 {
        tracker.update(&frame, None).unwrap();
    }
    let back = draw(Some((96, 130)));
    let frame = FrameView::gray(&back, w, h).unwrap();
    for i in 0..100 {
        let track = tracker.update(&frame, None).unwrap();
        if track.flag != Flag::NotFound {
            assert_eq!((track.redetected, track.wrote_memory), (options.is_some(), false));
            assert!(track.bbox.overlaps_image(w, h) && track.bbox.x > 100.0 && track.bbox.y > 70.0);
            assert!(matches!(track.state, TrackState::Uncertain | TrackState::Tracking));
            let again = tracker.update(&frame, None).unwrap();
            assert!(again.flag != Flag::NotFound && !again.redetected);
            return (i, tracker.engine().0.written.clone());
        }
    }
    (100, tracker.engine().0.written.clone())
}

#[test]
fn a_target_that_returns_elsewhere_is_found_by_the_scan_only() {
    let (without, written) = frames_to_find(None);
    assert_eq!((without, written), (100, vec![0]));
    let scan = |n| Some(RedetectOptions { positions_per_frame: n, threshold: 0.6 });
    let (slow, _) = frames_to_find(scan(1));
    let (fast, _) = frames_to_find(scan(4));
    println!("frames to find: {slow} with 1 position per frame, {fast} with 4");
    assert!(slow < 40 && fast <= slow.div_ceil(4));
    // Above what the target scores: never.
    let (deaf, _) =
        frames_to_find(Some(RedetectOptions { positions_per_frame: 4, threshold: 1.5 }));
    assert_eq!(deaf, 100);
}

#[test]
fn confidence_is_there_with_a_calibration_only() {
    let (mut tracker, picture) = started();
    answer(tracker.engine_mut(), (2, 2), 0.5, 20.0);
    assert_eq!(tracker.update(&view(&picture), None).unwrap().confidence, None);
    let good = ScoreCalibration { slope: 4.0, bias: -2.0 };
    tracker.set_calibration(Some(good)).unwrap();
    let p = tracker.update(&view(&picture), None).unwrap().confidence.unwrap();
    assert!((p - 0.5).abs() < 1e-6, "{p}");
    let bad = ScoreCalibration { slope: -1.0, bias: 0.0 };
    let error = tracker.set_calibration(Some(bad)).unwrap_err();
    assert_eq!((error.field, tracker.calibration()), ("calibration.slope", Some(good)));
    // Far out in both directions it stays a probability.
    assert_eq!((good.probability(-1e30), good.probability(1e30)), (0.0, 1.0));
}
