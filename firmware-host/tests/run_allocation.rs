//! The loop of `tsda run` allocates nothing once it runs: two sensors, the native engine, JSON lines,
//! a thermal camera's gain, predictions during a fault, changes of sensors.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use tsda_host::host::config::JsonConfig;
use tsda_host::host::json::JsonLines;
use tsda_host::host::plan::Plan;
use tsda_host::host::{Host, HostConfig, Output, control};
use tsda_host::model;

struct Counting;

thread_local! {
    /// Of this thread: the loop's, not that of the writers behind the queues.
    static COUNT: Cell<usize> = const { Cell::new(0) };
}

fn note() {
    let _ = COUNT.try_with(|c| c.set(c.get() + 1));
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

const CONFIG: &str = r#"
clock = "frames"
[[source]]
name = "rgb"
sensor = "rgb"
render = { repeat = true }
faults = [{ kind = "stop", at = 40, frames = 20 }]
[[source]]
name = "thermal"
sensor = "thermal"
profile = "lepton"
render = { size = [160, 120], raw16 = true, repeat = true }
[switch]
every_s = 0.5
[switch.failure]
"#;

#[test]
fn the_loop_allocates_nothing() {
    let config = HostConfig::parse(CONFIG, "test").expect("config");
    let plan = Plan::new(&config).expect("plan");
    let tracker = model::tracker(&model::load(None).expect("model")).expect("tracker");
    let sources = plan.sensors.iter().map(|s| s.info().clone()).collect();
    // Nobody listens there: sending costs the same.
    let to = JsonConfig { to: "udp:127.0.0.1:9".into(), queue: 4096 };
    let outputs: Vec<Box<dyn Output>> = vec![Box::new(JsonLines::open(&to, sources).expect("udp"))];
    let (_commands, inbox) = control::channel();
    let mut host = Host::new(plan, tracker, outputs, inbox);
    let (mut steps, mut allocations) = (0u32, 0usize);
    host.start();
    for frame in 0..150 {
        let before = COUNT.get();
        assert!(host.step().expect("steps").is_none(), "the pictures repeat");
        host.tick();
        // The first frames of each sensor set up what depends on their size.
        if frame >= 30 {
            steps += 1;
            let n = COUNT.get() - before;
            assert_eq!(n, 0, "{n} allocations in frame {frame}");
            allocations += n;
        }
    }
    println!("{allocations} allocations in {steps} frames");
    assert!(COUNT.get() > 0, "the counter counts");
}

#[test]
fn limits_of_a_thermal_camera_follow_without_allocating() {
    use std::time::Duration;
    use tsda_host::thermal::{AgcOptions, Profile, Thermal};
    use tsda_runtime::{BBox, FrameView, PixelFormat};
    let layout = Profile::Lepton.layout(160, 122, true, u16::MAX).expect("layout");
    let mut thermal = Thermal::new(layout, AgcOptions::default()).expect("thermal");
    let data: Vec<u8> =
        (0..160 * 122).flat_map(|i: u32| (29_000 + (i % 900) as u16).to_le_bytes()).collect();
    let format = PixelFormat::Y16 { low: 0, high: u16::MAX };
    let view = FrameView::new(&data, 160, 122, 320, format).expect("view");
    let before = COUNT.get();
    for i in 0..200 {
        thermal.follow(&view, Duration::from_millis(i * 111), false).expect("follows");
        assert!(thermal.temperature(&view, &BBox::new(40.0, 30.0, 20.0, 20.0)).is_some());
        assert_eq!(thermal.picture(&view).expect("picture").height(), 120);
    }
    assert_eq!(COUNT.get() - before, 0);
}
