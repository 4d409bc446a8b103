//! `Tracker::init` and `Tracker::update` never allocate: a counting allocator sits under the whole
//! test program.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use tsda_runtime::bundle::ScoreCalibration;
use tsda_runtime::engine::{Maps, TemplateInput};
use tsda_runtime::{
    BBox, Engine, EngineError, Flag, FrameView, Modality, ModelSpec, PixelFormat, RedetectOptions,
    TrackState, Tracker, TrackerParams,
};

struct Counting;

thread_local! {
    /// Allocations of this thread while it counts; `None` while it does not. Per thread, because the
    /// test harness has threads of its own.
    static COUNT: Cell<Option<usize>> = const { Cell::new(None) };
}

fn note() {
    // A thread that is being torn down has no counter any more, and nothing to count either.
    let _ = COUNT.try_with(|c| c.set(c.get().map(|n| n + 1)));
}

#[allow(unsafe_code)]
// SAFETY: every call is passed on unchanged to the system allocator, which keeps the contract;
// counting touches a plain thread-local number and never allocates.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note();
        // SAFETY: the caller's promises are passed on unchanged.
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        note();
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note();
        // SAFETY: as above.
        unsafe { System.realloc(ptr, layout, size) }
    }
    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(ptr, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations during `work`.
fn count<T>(work: impl FnOnce() -> T) -> (T, usize) {
    COUNT.set(Some(0));
    let result = work();
    (result, COUNT.replace(None).unwrap_or_default())
}

/// An engine that answers from its buffers.
struct Scripted {
    spec: ModelSpec,
    crop: Vec<f32>,
    label: Vec<f32>,
    ltrb_in: Vec<f32>,
    scores: Vec<f32>,
    ltrb: Vec<f32>,
}

impl Scripted {
    fn new(spec: ModelSpec) -> Self {
        let cells = spec.cells();
        Self {
            spec,
            crop: vec![0.0; spec.crop_len()],
            label: vec![0.0; cells],
            ltrb_in: vec![0.0; 4 * cells],
            scores: vec![0.0; cells],
            ltrb: vec![0.12; 4 * cells],
        }
    }

    /// One peak of this height near the middle, wandering, and a lower second one.
    fn answer(&mut self, step: usize, first: f32, second: f32) {
        let side = self.spec.map_side();
        self.scores.fill(0.0);
        self.scores[1] = second;
        self.scores[(side / 2 + step % 2) * side + side / 2] = first;
    }
}

impl Engine for Scripted {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }
    fn name(&self) -> &'static str {
        "scripted"
    }
    fn crop_mut(&mut self) -> &mut [f32] {
        &mut self.crop
    }
    fn features(&mut self) -> Result<(), EngineError> {
        Ok(())
    }
    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        TemplateInput { label: &mut self.label, ltrb: &mut self.ltrb_in }
    }
    fn write_template(&mut self, _: usize) -> Result<(), EngineError> {
        Ok(())
    }
    fn predict(&mut self, _: usize) -> Result<Maps<'_>, EngineError> {
        Ok(Maps { scores: &self.scores, ltrb: &self.ltrb })
    }
}

#[test]
fn the_counter_counts() {
    assert_eq!(count(|| std::hint::black_box(vec![1u8; 100]).len()).1, 1);
    assert_eq!(count(|| 1 + 1).1, 0);
}

#[test]
fn hundreds_of_frames_in_every_format_allocate_nothing() {
    let formats = [
        (PixelFormat::Rgb8, 3),
        (PixelFormat::Bgr8, 3),
        (PixelFormat::Gray8, 1),
        (PixelFormat::Y16 { low: 100, high: 60_000 }, 2),
        (PixelFormat::Yuyv, 2),
        (PixelFormat::Uyvy, 2),
        (PixelFormat::Nv12, 1),
    ];
    for spec in [ModelSpec::NANO, ModelSpec { crop: 96, templates: 4, ..ModelSpec::NANO }] {
        // Soon lost, so that the scan for a lost target is in the count.
        let params = TrackerParams { lost_after: 2, ..TrackerParams::default() };
        let mut tracker = Tracker::new(Scripted::new(spec), params).unwrap();
        tracker.set_redetection(Some(RedetectOptions::default())).unwrap();
        tracker.set_calibration(Some(ScoreCalibration { slope: 5.0, bias: -2.0 })).unwrap();
        let mut lost = 0;
        let (mut frames, mut writes, mut missed, mut rivals) = (0, 0, 0, 0);
        for (i, (format, bytes)) in formats.into_iter().cycle().take(12).enumerate() {
            // Two sizes, so that the switch between formats also changes the geometry.
            let (w, h) = if i % 2 == 0 { (640, 480) } else { (320, 256) };
            let data: Vec<u8> = (0..w * h * 3).map(|b| (b * 31 % 251) as u8).collect();
            let frame = FrameView::new(&data, w, h, w * bytes, format).unwrap();
            let bbox = BBox::new(100.5, 80.25, 60.0, 45.0);
            if i % 3 == 0 {
                let (result, n) = count(|| tracker.init(&frame, bbox, Some(Modality::Rgb)));
                result.unwrap();
                assert_eq!(n, 0, "init allocated, {format:?}");
            } else {
                let (result, n) = count(|| tracker.set_box(bbox));
                result.unwrap();
                assert_eq!(n, 0, "set_box allocated");
            }
            for step in 0..50 {
                let (first, second) = match step % 10 {
                    0..4 => (0.97, 0.1),
                    4 | 5 => (0.95, 0.93),
                    6 => (0.6, 0.4),
                    _ => (0.1, 0.05),
                };
                tracker.engine_mut().answer(step, first, second);
                let (track, n) = count(|| tracker.update(&frame, Some(Modality::Thermal)));
                let track = track.unwrap();
                assert_eq!(n, 0, "update allocated in step {step}, {format:?}");
                frames += 1;
                writes += usize::from(track.wrote_memory);
                missed += usize::from(track.flag == Flag::NotFound);
                lost += usize::from(track.state == TrackState::Lost);
                assert!(track.confidence.is_some());
                rivals += usize::from(matches!(track.flag, Flag::Uncertain | Flag::HardNegative));
            }
        }
        println!("{frames} frames, {writes} memory writes, {missed} not found: 0 allocations");
        assert!(frames == 600 && writes > 100 && missed > 100 && rivals > 50 && lost > 50);
    }
}
