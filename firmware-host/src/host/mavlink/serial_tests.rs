//! The serial line, played by a pseudo-terminal.

use super::super::control::channel;
use super::super::sys;
use super::tests::{End, Station, record};
use super::*;
use std::fs::{self, File};
use std::io::{Read as _, Write as _};
use std::os::unix::fs::symlink;
use std::path::Path;
use tsda_runtime::Modality;

impl End for File {
    fn send(&mut self, bytes: &[u8]) {
        self.write_all(bytes).expect("sends");
    }

    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        assert!(sys::readable(self, Duration::from_secs(20)).expect("a line"), "nothing comes");
        self.read(bytes).expect("answers")
    }
}

/// Plugs an autopilot in under a lasting name.
fn plug(name: &Path) -> Station<File> {
    let (ours, theirs) = sys::pseudo_terminal().expect("pseudo-terminal");
    let _ = fs::remove_file(name);
    symlink(theirs, name).expect("link");
    Station::at(ours)
}

fn track(station: &mut Station<File>) {
    // No answer but "not now" until the first record was taken up.
    while station.ask(TRACK_RECTANGLE, [0.25, 0.5, 0.375, 0.75]) != 0 {}
}

#[test]
fn an_autopilot_on_a_serial_line_may_be_pulled_out_and_come_back() {
    let dir = tempfile::tempdir().expect("temp");
    let name = dir.path().join("ttyUSB0");
    let mut station = plug(&name);
    let (commands, inbox) = channel();
    let sources = vec![SourceInfo { name: "rgb".into(), sensor: Modality::Rgb }];
    let config = MavlinkConfig {
        to: format!("serial:{}:57600", name.display()),
        status_rate: 200.0,
        queue: 1 << 16,
        ..MavlinkConfig::default()
    };
    let mut output = Mavlink::open(&config, sources, commands).expect("opens");
    let tracking = record(Some(TrackState::Tracking), false);
    let want = Command::Select { bbox: [160.0, 240.0, 80.0, 120.0], source: Some("rgb".into()) };

    // Heartbeats, a command, and where the target is.
    station.next(wire::HEARTBEAT);
    output.frame(&tracking, &Views(&[]));
    track(&mut station);
    assert_eq!(inbox.try_iter().last(), Some(want.clone()));
    let status = station.next(wire::CAMERA_TRACKING_IMAGE_STATUS).payload;
    let number = |at: usize| f32::from_le_bytes([0, 1, 2, 3].map(|i| status[at + i]));
    assert_eq!([12, 16, 20, 24].map(number), [0.25, 0.5, 0.375, 0.75]);

    // An autopilot that reads nothing until the line is full, and the loop's time meanwhile.
    let mut longest = Duration::ZERO;
    let mut turns = |output: &mut Mavlink, time: Duration| {
        let end = Instant::now() + time;
        while Instant::now() < end {
            let start = Instant::now();
            output.frame(&tracking, &Views(&[]));
            longest = longest.max(start.elapsed());
            thread::sleep(Duration::from_millis(2));
        }
    };
    turns(&mut output, Duration::from_millis(1500));
    station.next(wire::HEARTBEAT);
    track(&mut station);

    // Pulled out, gone by its name, and back as another device of that name; twice.
    for _ in 0..2 {
        drop(station);
        fs::remove_file(&name).expect("removes");
        turns(&mut output, Duration::from_millis(700));
        station = plug(&name);
        turns(&mut output, Duration::from_millis(100));
        station.next(wire::HEARTBEAT);
        let _ = inbox.try_iter().count();
        track(&mut station);
        assert_eq!(inbox.try_iter().last(), Some(want.clone()));
        station.next(wire::CAMERA_TRACKING_IMAGE_STATUS);
    }
    println!("longest time in the loop: {longest:?}");
    // Handing a record over takes microseconds; the rest is what a busy machine does.
    assert!(longest < Duration::from_millis(500), "the loop waited {longest:?}");
    assert_eq!(output.dropped(), 0);
    let start = Instant::now();
    output.finish();
    assert!(start.elapsed() < LINGER, "it ends by itself");
}
