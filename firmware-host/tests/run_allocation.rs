//! The loop of `tsda run` allocates nothing once it runs: two sensors, the native engine, all outputs
//! with somebody looking at the preview, a thermal camera's gain, predictions during a fault, changes
//! of sensors.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use tsda_host::host::plan::Plan;
use tsda_host::host::{Host, HostConfig, control, outputs};
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
# Nobody listens there: sending costs the same.
[[output.json]]
to = "udp:127.0.0.1:9"
queue = 4096
[output.preview]
bind = "127.0.0.1:0"
rate = 120
[output.metrics]
[output.mavlink]
to = "udp:127.0.0.1:9"
[output.mcap]
dir = "recording"
rate = 1000
[process.temperature]
"#;

/// Looks at the preview until told to stop; answers the pictures seen.
fn look(address: &str, stop: &AtomicBool) -> usize {
    let mut seen = 0;
    while !stop.load(Ordering::Relaxed) {
        let mut stream = TcpStream::connect(address).expect("connects");
        let ask = "GET /picture HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
        stream.write_all(ask.as_bytes()).expect("asks");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("answers");
        seen += usize::from(answer.starts_with(b"HTTP/1.1 200"));
    }
    seen
}

#[test]
fn the_loop_allocates_nothing() {
    let dir = tempfile::tempdir().expect("temp");
    let mut config = HostConfig::parse(CONFIG, "test").expect("config");
    config.base = dir.path().to_path_buf();
    let plan = Plan::new(&config).expect("plan");
    let tracker = model::tracker(&model::load(None).expect("model")).expect("tracker");
    let sources: Vec<_> = plan.sensors.iter().map(|s| s.info().clone()).collect();
    let (commands, inbox) = control::channel();
    let zones = outputs::zones(&config).expect("zones");
    let outputs = outputs::open(&config, &sources, &commands, zones.as_ref()).expect("outputs");
    let address = outputs.iter().find_map(|o| o.name().strip_prefix("preview at http://"));
    let address = address.expect("preview").to_owned();
    let (stop, seen) = (AtomicBool::new(false), AtomicUsize::new(0));
    let mut host = Host::new(plan, tracker, outputs, inbox).with_zones(zones);
    thread::scope(|scope| {
        scope.spawn(|| seen.store(look(&address, &stop), Ordering::Relaxed));
        run(&mut host);
        stop.store(true, Ordering::Relaxed);
    });
    let seen = seen.load(Ordering::Relaxed);
    println!("{seen} pictures seen");
    assert!(seen > 0, "nobody looked");
    let recorded = std::fs::read_dir(dir.path().join("recording")).expect("folder").count();
    assert_eq!(recorded, 1);
}

fn run<E: tsda_runtime::Engine>(host: &mut Host<E>) {
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
    // Words 208 and 209 of the telemetry: raw values are temperatures, of 0.01 K.
    let said = |i: u32| matches!(i.checked_sub(160 * 120), Some(208 | 209));
    let data: Vec<u8> = (0..160 * 122)
        .flat_map(|i: u32| if said(i) { 1u16 } else { 29_000 + (i % 900) as u16 }.to_le_bytes())
        .collect();
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
