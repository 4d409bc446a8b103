//! The per-frame path allocates nothing of its own, with a real engine behind it; what the engine
//! library does inside is counted apart and printed, per engine. Only Rust's allocator is counted:
//! what ONNX Runtime takes from C++'s is not seen.

mod synthetic;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use tsda_export::quantize::{QuantizeOptions, quantize_on};
use tsda_runtime::bundle::{Bundle, BundleFile};
use tsda_runtime::engine::{EngineChoice, Maps, NativeOptions, TemplateInput};
use tsda_runtime::{BBox, Engine, EngineError, FrameView, ModelSpec, Tracker, probe};

struct Counting;

#[derive(Clone, Copy)]
enum Counter {
    Off,
    Tracker,
    Engine,
}

thread_local! {
    static ACTIVE: Cell<Counter> = const { Cell::new(Counter::Off) };
    static TRACKER: Cell<usize> = const { Cell::new(0) };
    static ENGINE: Cell<usize> = const { Cell::new(0) };
    static ENGINE_BYTES: Cell<usize> = const { Cell::new(0) };
}

fn note(bytes: usize) {
    // A thread that is being torn down has no counters any more, and nothing to count either.
    let _ = ACTIVE.try_with(|active| match active.get() {
        Counter::Off => {}
        Counter::Tracker => TRACKER.set(TRACKER.get() + 1),
        Counter::Engine => {
            ENGINE.set(ENGINE.get() + 1);
            ENGINE_BYTES.set(ENGINE_BYTES.get() + bytes);
        }
    });
}

#[allow(unsafe_code)]
// SAFETY: every call is passed on unchanged to the system allocator, which keeps the contract;
// counting touches plain thread-local numbers and never allocates.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        // SAFETY: the caller's promises are passed on unchanged.
        unsafe { System.alloc(layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        note(layout.size());
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note(size);
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

/// Books everything the inner engine allocates on the engine's account.
struct Booked<E>(E);

impl<E> Booked<E> {
    fn inside<T>(&mut self, work: impl FnOnce(&mut E) -> T) -> T {
        let before = ACTIVE.replace(Counter::Engine);
        let result = work(&mut self.0);
        ACTIVE.set(before);
        result
    }
}

impl<E: Engine> Engine for Booked<E> {
    fn spec(&self) -> &ModelSpec {
        self.0.spec()
    }
    fn name(&self) -> &'static str {
        self.0.name()
    }
    fn crop_mut(&mut self) -> &mut [f32] {
        self.0.crop_mut()
    }
    fn features(&mut self) -> Result<(), EngineError> {
        self.inside(Engine::features)
    }
    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        self.0.template_input_mut()
    }
    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        self.inside(|e| e.write_template(slot))
    }
    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        let before = ACTIVE.replace(Counter::Engine);
        let maps = self.0.predict(filled);
        ACTIVE.set(before);
        maps
    }
}

#[test]
fn updates_with_the_shipped_model_allocate_nothing_outside_the_engine() {
    let file = BundleFile::open(tsda_tests::shipped_bundle()).unwrap();
    let bundle = file.bundle().unwrap();
    for choice in EngineChoice::compiled() {
        allocates_nothing(&bundle, &choice);
    }
}

#[test]
fn updates_with_a_network_of_bytes_allocate_nothing() {
    let file = BundleFile::open(tsda_tests::shipped_bundle()).unwrap();
    let floats = file.bundle().unwrap();
    let clips = synthetic::clips();
    let options = QuantizeOptions { frames: 30, ..QuantizeOptions::default() };
    let calib = Some(("clips".to_owned(), &clips));
    let (bytes, _) = quantize_on(&floats, &options, calib, &[], &mut |_| {}).unwrap();
    let bundle = Bundle::parse(&bytes).unwrap();
    for threads in [1, 2] {
        let options = NativeOptions { threads, ..NativeOptions::default() };
        allocates_nothing(&bundle, &EngineChoice::Native(options));
    }
}

fn allocates_nothing(bundle: &Bundle<'_>, choice: &EngineChoice) {
    let engine = match choice.open(bundle) {
        Ok(engine) => Booked(engine),
        Err(e) if e.is_unasked() => {
            println!("{choice} skipped: {e}");
            return;
        }
        Err(e) => panic!("{choice}: {e}"),
    };
    // Every found frame is written, so that memory writes are in the count.
    let mut params = bundle.manifest().tracker;
    params.not_found = 0.0;
    params.write_confidence = 0.0;
    let mut tracker = Tracker::new(engine, params).unwrap();

    let (w, h) = (320, 240);
    let mut data = vec![0; w * h * 3];
    probe::recipe_image(5, w, h, &mut data);
    let view = FrameView::rgb(&data, w, h).unwrap();
    tracker.init(&view, BBox::new(130.0, 90.0, 48.0, 40.0), None).unwrap();
    for counter in [&TRACKER, &ENGINE, &ENGINE_BYTES] {
        counter.set(0);
    }
    let frames = 30;
    let mut writes = 0;
    for _ in 0..frames {
        ACTIVE.set(Counter::Tracker);
        let track = tracker.update(&view, None);
        ACTIVE.set(Counter::Off);
        writes += usize::from(track.unwrap().wrote_memory);
    }
    println!(
        "{choice}: tracker {} allocations in {frames} frames ({writes} memory writes); \
             engine {} allocations, {} bytes per frame",
        TRACKER.get(),
        ENGINE.get() / frames,
        ENGINE_BYTES.get() / frames,
    );
    assert_eq!(TRACKER.get(), 0, "{choice}: the tracker allocated in its per-frame path");
    assert!(writes > 0, "{choice}: no memory write was counted");
    // Bound once: what is left are the lists of outputs that the `ort` crate makes for each of
    // the three graph calls. Anything more would be a new binding or a copy.
    match choice {
        EngineChoice::Native(_) => assert_eq!(ENGINE.get(), 0, "{choice}"),
        EngineChoice::Ort(_) => {
            assert!(ENGINE.get() <= 8 * frames && ENGINE_BYTES.get() <= 2048 * frames);
        }
        _ => assert!(ENGINE.get() > 0, "the counter sees nothing: tract allocates"),
    }
}
