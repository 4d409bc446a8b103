//! `Tracker::update` on the native engine makes no system call, but for those that wake and put to
//! sleep its threads: this program runs itself under strace and reads what happened between two
//! marks. Without strace, or where it may not watch other processes, it says so and ends.

use std::collections::BTreeMap;
use std::io::Write as _;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tsda_runtime::bundle::BundleFile;
use tsda_runtime::engine::native::{NativeEngine, NativeOptions};
use tsda_runtime::{BBox, FrameView, Modality, PixelFormat, Tracker, TrackerParams, probe};

const FRAMES: usize = 200;
/// They take under a second; a hang shall not use up the time of all tests.
const LIMIT: Duration = Duration::from_secs(300);
const BEGIN: &str = "tsda-frames-begin";
const END: &str = "tsda-frames-end";
const WIDTH: usize = 320;
const HEIGHT: usize = 240;

fn main() {
    if let Ok(threads) = std::env::var("TSDA_TRACE_THREADS") {
        track(threads.parse().unwrap());
        return;
    }
    let log = std::env::temp_dir().join(format!("tsda-strace-{}", std::process::id()));
    for threads in [1, 2] {
        let child = Command::new("strace")
            .args(["-f", "-qq", "-o"])
            .arg(&log)
            .arg(std::env::current_exe().unwrap())
            .env("TSDA_TRACE_THREADS", threads.to_string())
            .stderr(Stdio::piped())
            .spawn();
        let mut child = match child {
            Ok(child) => child,
            Err(e) => return println!("skipped: strace cannot be started ({e}); install strace"),
        };
        let begin = Instant::now();
        while child.try_wait().unwrap().is_none() {
            if begin.elapsed() > LIMIT {
                child.kill().unwrap();
                panic!("{threads} thread(s): {FRAMES} frames under strace took over {LIMIT:?}");
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        if !said.contains(END) {
            assert!(!said.contains(BEGIN), "the frames were not finished: {said}");
            return println!("skipped: strace cannot watch here: {}", said.trim());
        }
        let calls = between_marks(&std::fs::read_to_string(&log).unwrap());
        println!("{threads} thread(s), {FRAMES} frames: system calls {calls:?}");
        let wakes = if threads > 1 { calls.get("futex").copied().unwrap_or(0) } else { 0 };
        assert_eq!(calls.values().sum::<usize>(), wakes, "{threads} threads: {calls:?}");
    }
    std::fs::remove_file(&log).unwrap();
    // The reader must be able to fail.
    let sample = "7 write(2, \"tsda-frames-begin\\n\", 18) = 18\n7 futex(0x1, 2) = 0\n8 <... futex \
                  resumed>) = 0\n7 brk(NULL) = 1\n7 write(2, \"tsda-frames-end\\n\", 16) = 16\n7 \
                  munmap(1, 2) = 0\n";
    let found = between_marks(sample);
    assert_eq!(found.into_iter().collect::<Vec<_>>(), [("brk".into(), 1), ("futex".into(), 1)]);
}

/// Number of calls by name; those that began before the first mark are not counted.
fn between_marks(log: &str) -> BTreeMap<String, usize> {
    let lines = log.lines().skip_while(|l| !l.contains(BEGIN)).skip(1);
    let mut calls = BTreeMap::new();
    for line in lines.take_while(|l| !l.contains(END)) {
        let call = line.split_once(' ').map_or("", |(_, call)| call.trim_start());
        // `<... futex resumed>` is the rest of a call that was counted; `---` and `+++` are signals.
        if let Some((name, _)) = call.split_once('(')
            && !call.starts_with(['<', '-', '+'])
        {
            *calls.entry(name.to_owned()).or_default() += 1;
        }
    }
    calls
}

/// A line in a single call: `eprintln` would make one more for its end.
fn mark(text: &str) {
    std::io::stderr().write_all(format!("{text}\n").as_bytes()).unwrap();
}

/// Tracks between the marks: both sensors, memory writes, frames without the target.
fn track(threads: usize) {
    let file =
        BundleFile::open(concat!(env!("CARGO_MANIFEST_DIR"), "/../models/nano.tsda")).unwrap();
    let bundle = file.bundle().unwrap();
    let options = NativeOptions { threads, ..NativeOptions::default() };
    let engine = NativeEngine::with_options(&bundle, options).unwrap();
    let params = TrackerParams { write_confidence: 0.0, ..bundle.manifest().tracker };
    let mut tracker = Tracker::new(engine, params).unwrap();
    let mut colour = vec![0; WIDTH * HEIGHT * 3];
    probe::recipe_image(5, WIDTH, HEIGHT, &mut colour);
    let grey: Vec<u8> = colour.iter().step_by(3).copied().collect();
    let plain = vec![90; WIDTH * HEIGHT];
    let rgb = FrameView::rgb(&colour, WIDTH, HEIGHT).unwrap();
    let thermal = FrameView::gray(&grey, WIDTH, HEIGHT).unwrap();
    let y16 = PixelFormat::Y16 { low: 0, high: u16::MAX };
    let empty = FrameView::new(&plain, WIDTH / 2, HEIGHT, WIDTH, y16).unwrap();
    tracker.init(&rgb, BBox::new(130.0, 90.0, 48.0, 40.0), Some(Modality::Rgb)).unwrap();
    tracker.update(&rgb, Some(Modality::Rgb)).unwrap();
    mark(BEGIN);
    let mut writes = 0;
    for frame in 0..FRAMES {
        let (view, modality) = match frame % 20 {
            0..10 => (&rgb, Modality::Rgb),
            10..18 => (&thermal, Modality::Thermal),
            _ => (&empty, Modality::Thermal),
        };
        writes += usize::from(tracker.update(view, Some(modality)).unwrap().wrote_memory);
    }
    mark(END);
    assert!(writes > 0, "no memory write was among the frames");
}
