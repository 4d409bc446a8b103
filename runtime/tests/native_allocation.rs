//! `Tracker::update` on the native engine never allocates, on any of its threads: a counting
//! allocator sits under the whole program, which for that reason has no test harness: its thread
//! would be counted too.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use tsda_runtime::bundle::BundleFile;
use tsda_runtime::engine::native::{NativeEngine, NativeOptions};
use tsda_runtime::{BBox, Flag, FrameView, Modality, PixelFormat, Tracker, TrackerParams};

struct Counting;

/// Whether allocations of any thread are counted.
static ON: AtomicBool = AtomicBool::new(false);
static COUNT: AtomicUsize = AtomicUsize::new(0);

fn note() {
    if ON.load(Ordering::Relaxed) {
        COUNT.fetch_add(1, Ordering::Relaxed);
    }
}

#[allow(unsafe_code)]
// SAFETY: every call is passed on unchanged to the system allocator, which keeps the contract;
// counting touches atomic numbers only.
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

/// Allocations of all threads during `work`.
fn count<T>(work: impl FnOnce() -> T) -> (T, usize) {
    COUNT.store(0, Ordering::SeqCst);
    ON.store(true, Ordering::SeqCst);
    let result = work();
    ON.store(false, Ordering::SeqCst);
    (result, COUNT.load(Ordering::SeqCst))
}

const WIDTH: usize = 320;
const HEIGHT: usize = 240;

/// A checked square on a plain ground, or the ground alone.
fn picture(x: usize, y: usize, there: bool, bytes: usize) -> Vec<u8> {
    let mut data = Vec::with_capacity(WIDTH * HEIGHT * bytes);
    for row in 0..HEIGHT {
        for column in 0..WIDTH {
            let inside = there && (x..x + 40).contains(&column) && (y..y + 40).contains(&row);
            let check = (column.wrapping_sub(x) / 8 + row.wrapping_sub(y) / 8) % 2 == 0;
            let value = if inside && check {
                230
            } else if inside {
                20
            } else {
                120
            };
            data.extend((0..bytes).map(|_| value));
        }
    }
    data
}

/// A thousand frames.
fn main() {
    assert_eq!(count(|| std::hint::black_box(vec![1u8; 100]).len()).1, 1);
    let file =
        BundleFile::open(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/nano.tsda")).unwrap();
    let bundle = file.bundle().unwrap();
    let (mut frames, mut writes, mut missed, mut switches) = (0, 0, 0, 0);
    for (threads, steps) in [(1, 600), (2, 250), (3, 150)] {
        let options = NativeOptions { threads, ..NativeOptions::default() };
        let engine = NativeEngine::with_options(&bundle, options).unwrap();
        // A drawn square is no sight that the network is sure of.
        let params = TrackerParams { write_confidence: 0.3, ..bundle.manifest().tracker };
        let mut tracker = Tracker::new(engine, params).unwrap();
        let first = picture(100, 80, true, 3);
        let first = FrameView::rgb(&first, WIDTH, HEIGHT).unwrap();
        let bbox = BBox::new(100.0, 80.0, 40.0, 40.0);
        let (result, n) = count(|| tracker.init(&first, bbox, Some(Modality::Rgb)));
        result.unwrap();
        assert_eq!(n, 0, "init allocated");
        let mut sensor = Modality::Rgb;
        for step in 0..steps {
            // The target wanders, is away for a while now and then, and the sensor changes.
            let (x, y) = (100 + step % 30, 80 + step / 3 % 20);
            let (there, thermal) = (step % 50 < 42, step % 60 >= 30);
            let now = if thermal { Modality::Thermal } else { Modality::Rgb };
            switches += usize::from(now != sensor);
            sensor = now;
            let bytes = if thermal { 1 } else { 3 };
            let data = picture(x, y, there, bytes);
            let format = if thermal { PixelFormat::Gray8 } else { PixelFormat::Rgb8 };
            let frame = FrameView::new(&data, WIDTH, HEIGHT, WIDTH * bytes, format).unwrap();
            let (track, n) = count(|| tracker.update(&frame, Some(now)));
            let track = track.unwrap();
            assert_eq!(n, 0, "update allocated in step {step} with {threads} threads");
            frames += 1;
            writes += usize::from(track.wrote_memory);
            missed += usize::from(track.flag == Flag::NotFound);
        }
    }
    println!(
        "{frames} frames, {writes} memory writes, {missed} not found, {switches} sensor switches: 0 \
         allocations"
    );
    assert!(frames == 1000 && writes > 20 && missed > 20 && switches > 20);
}
