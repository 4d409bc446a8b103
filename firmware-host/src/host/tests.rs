use super::clock::ClockKind;
use super::motion::{Motion, kept_inside};
use super::output::queue;
use super::plan::Plan;
use super::source::{Fault, FaultKind, Held, Polled, Raw16Folder, Reel, Source};
use super::*;
use crate::frames::FrameSource as _;
use crate::switch::Homography;
use std::time::Duration;
use tsda_runtime::{BBox, FrameView};

const GOOD: &str = r#"
[[source]]
name = "rgb"
sensor = "rgb"
render = { frames = 2, size = [64, 48] }
[[source]]
name = "thermal"
sensor = "thermal"
render = { frames = 2, size = [64, 48], raw16 = true }
"#;

fn plan(text: &str) -> Result<Plan, String> {
    HostConfig::parse(text, "host.toml").and_then(|c| Plan::new(&c)).map_err(|e| {
        assert_eq!(e.exit_code(), 2, "{e}");
        e.to_string()
    })
}

#[test]
fn a_small_configuration_is_enough() {
    let plan = plan(GOOD).expect("plan");
    assert_eq!(plan.sensors.len(), 2);
    assert_eq!(plan.clock, (ClockKind::Wall, 25.0));
    assert!(plan.target.is_some_and(|(source, _)| source == 0), "the drawn scene knows its target");
}

#[test]
fn the_example_in_the_documentation_is_understood() {
    let text = include_str!("../../../docs/examples/host.toml");
    let config = HostConfig::parse(text, "host.toml").expect("parses");
    assert!(config.sources.iter().any(|s| s.v4l2.is_some()));
    assert!(config.switch.failure.is_some() && !config.registrations.is_empty());
    let output = &config.output;
    assert!(output.preview.is_some() && output.metrics.is_some());
    assert!(output.mavlink.is_some() && output.mcap.is_some());
    assert!(config.process.temperature.is_some());
}

#[test]
fn what_makes_no_sense_is_refused_by_its_name() {
    let camera = "[[source]]\nname = \"a\"\nsensor = \"rgb\"\n";
    for (text, words) in [
        (String::new(), &["missing field", "source"][..]),
        ("source = []".into(), &["source", "at least"]),
        (format!("{GOOD}\n[switch]\nprefered = \"rgb\""), &["line 12", "prefered"]),
        (format!("{GOOD}\n[switch.failure]\nafter = 1"), &["line 12", "after"]),
        (GOOD.replace("\"thermal\"\nrender", "\"infrared\"\nrender"), &["line 8", "infrared"]),
        (GOOD.replace("name = \"thermal\"", "name = \"rgb\""), &["`rgb`", "twice"]),
        (camera.into(), &["`a`", "v4l2", "render"]),
        (format!("{camera}render = {{}}\ny4m = {{ path = \"a\" }}"), &["y4m and render"]),
        (format!("{camera}files = {{ path = \"no/such/folder\" }}"), &["no/such/folder"]),
        (format!("{camera}render = {{ rate = 0 }}"), &["rate", "0 pictures"]),
        (format!("{camera}render = {{}}\ncrop = [0, 0, 0, 5]"), &["crop"]),
        (format!("{camera}render = {{}}\nagc = {{ clip = 0.4 }}"), &["agc.clip"]),
        (format!("{camera}render = {{}}\nhealth = {{ timeout_s = -1 }}"), &["timeout_s"]),
        (format!("engine = \"abacus\"\n{GOOD}"), &["engine", "abacus"]),
        (format!("give_up_s = -1\n{GOOD}"), &["give_up_s"]),
        (format!("{GOOD}\n[target]\nbox = [1, 2, 0, 4]"), &["target.box"]),
        (format!("{GOOD}\n[target]\nsource = \"x\""), &["target.source", "`x`", "rgb, thermal"]),
        (format!("{GOOD}\n[switch]\npreferred = \"x\""), &["switch.preferred", "`x`"]),
        (
            format!(
                "{GOOD}\n[switch]\nschedule = [{{at_s=2, to=\"rgb\"}}, {{at_s=1, to=\"rgb\"}}]"
            ),
            &["switch.schedule", "order"],
        ),
        (
            format!(
                "{GOOD}\n[switch.scene]\nwatch=\"rgb\"\notherwise=\"thermal\"\nbelow=0.5\nabove=0.4"
            ),
            &["switch.scene", "below 0.5"],
        ),
        (
            format!(
                "{GOOD}\n[[registration]]\nfrom=\"rgb\"\nto=\"rgb\"\nmatrix=[[1,0,0],[0,1,0],[0,0,1]]"
            ),
            &["registration from rgb to rgb"],
        ),
        (
            format!(
                "{GOOD}\n[[registration]]\nfrom=\"rgb\"\nto=\"thermal\"\nmatrix=[[1,0,0],[1,0,0],[0,0,1]]"
            ),
            &["registration from rgb to thermal", "cannot be inverted"],
        ),
        (
            format!("{GOOD}\n[[registration]]\nfrom=\"rgb\"\nto=\"thermal\"\nmatrix=[[1,0],[0,1]]"),
            &["line 14"],
        ),
    ] {
        let error = plan(&text).expect_err(&text);
        for word in words {
            assert!(error.contains(word), "`{word}` in `{error}` of\n{text}");
        }
    }
}

#[cfg(not(feature = "camera"))]
#[test]
fn cameras_need_their_feature() {
    let text = "[[source]]\nname='a'\nsensor='rgb'\nv4l2={device='/dev/video0'}";
    let error = plan(text).expect_err("no cameras");
    assert!(error.contains("--features camera"), "{error}");
}

#[test]
fn commands_are_read_and_refused() {
    let select = Command::Select { bbox: [1.0, 2.0, 3.0, 4.0], source: Some("rgb".into()) };
    for (line, want) in [
        (r#"{"cmd":"select","box":[1,2,3,4],"source":"rgb"}"#, select),
        (r#"{"cmd":"switch","to":"thermal"}"#, Command::Switch { to: "thermal".into() }),
        (r#"{"cmd":"stop"}"#, Command::Stop),
        (r#"{"cmd":"auto"}"#, Command::Auto),
        (r#"{"cmd":"quit"}"#, Command::Quit),
    ] {
        assert_eq!(Command::parse(line), Ok(want), "{line}");
    }
    for line in ["", "{}", "stop", r#"{"cmd":"jump"}"#, r#"{"cmd":"select","box":[1,2,3]}"#] {
        assert!(Command::parse(line).is_err(), "{line}");
    }
}

#[test]
fn a_full_queue_loses_and_counts_and_never_waits() {
    let (mut feeder, receiver) = queue(2);
    (0..5).for_each(|i| feeder.offer(i));
    assert_eq!(feeder.losses().count(), 3);
    assert_eq!(receiver.try_iter().collect::<Vec<i32>>(), [0, 1]);
    drop(receiver);
    feeder.offer(9);
    assert_eq!(feeder.losses().count(), 4, "nobody reads any more");
}

fn pictures(n: u8) -> Vec<Held> {
    (0..n)
        .map(|i| {
            let data = vec![10 + i; 12];
            Held::of(&FrameView::gray(&data, 4, 3).expect("view"))
        })
        .collect()
}

/// What a source delivers in each step: first byte of a new picture, or what else.
fn play(reel: &mut Reel, rate: f64, steps: usize) -> Vec<Result<u8, Polled>> {
    let mut clock = Clock::start(ClockKind::Frames, rate);
    (0..steps)
        .map(|_| {
            let polled = reel.poll(&clock, Duration::ZERO).expect("plays");
            clock.tick();
            match polled {
                Polled::Fresh => Ok(reel.frame().expect("frame").view.data()[0]),
                other => Err(other),
            }
        })
        .collect()
}

#[test]
fn reels_play_at_their_rate_repeat_and_end() {
    let reel = || Reel::loaded(pictures(3), 10.0, "test".into());
    let (none, end) = (Err(Polled::Nothing), Err(Polled::Ended));
    assert_eq!(play(&mut reel(), 10.0, 4), [Ok(10), Ok(11), Ok(12), end]);
    assert_eq!(play(&mut reel(), 20.0, 5), [Ok(10), none, Ok(11), none, Ok(12)]);
    let mut half = reel();
    assert_eq!(play(&mut half, 5.0, 3), [Ok(10), Ok(12), end]);
    assert_eq!(half.counters().skipped, 1, "older ones are passed over");
    assert_eq!(play(&mut reel().repeated(true), 10.0, 5), [Ok(10), Ok(11), Ok(12), Ok(10), Ok(11)]);
}

#[test]
fn faults_are_rehearsed() {
    for (kind, want) in [
        (FaultKind::Stop, [Ok(11), Err(Polled::Nothing), Err(Polled::Nothing), Ok(14)]),
        (FaultKind::Unplug, [Ok(11), Err(Polled::Gone), Err(Polled::Gone), Ok(14)]),
        (FaultKind::Freeze, [Ok(11), Ok(11), Ok(11), Ok(14)]),
        (FaultKind::Dark, [Ok(11), Ok(0), Ok(0), Ok(14)]),
        (FaultKind::Saturate, [Ok(11), Ok(255), Ok(255), Ok(14)]),
        (FaultKind::Damage, [Ok(11), Ok(12), Ok(13), Ok(14)]),
        (FaultKind::Shutter, [Ok(11), Ok(0x71), Ok(0x71), Ok(14)]),
    ] {
        let faults = vec![Fault { kind, at: 2, frames: 2 }];
        let mut reel = Reel::loaded(pictures(6), 10.0, "test".into()).with_faults(faults);
        assert_eq!(play(&mut reel, 10.0, 5)[1..], want, "{kind:?}");
    }
}

#[test]
fn raw_folders_are_read_in_order_and_checked() {
    let dir = tempfile::tempdir().expect("temp");
    for (name, value) in [("f2.raw", 2u8), ("f10.raw", 10), ("f1.raw", 1)] {
        std::fs::write(dir.path().join(name), vec![value; 24]).expect("write");
    }
    let mut folder = Raw16Folder::open(dir.path(), (4, 3)).expect("opens");
    let mut seen = Vec::new();
    while let Some(frame) = folder.next_frame().expect("reads") {
        seen.push(frame.view.data()[0]);
    }
    assert_eq!(seen, [1, 2, 10]);
    let error = Raw16Folder::open(dir.path(), (4, 4)).expect_err("size").to_string();
    assert!(error.contains("24 bytes") && error.contains("32"), "{error}");
}

#[test]
fn motion_goes_on_and_is_mapped() {
    let mut motion = Motion::default();
    assert_eq!(motion.predict(Duration::ZERO), None);
    let at = |i: u32| Duration::from_millis(40) * i;
    motion.start(at(0), BBox::new(10.0, 20.0, 4.0, 6.0));
    for i in 1..60 {
        motion.seen(at(i), BBox::new(10.0 + i as f32, 20.0, 4.0, 6.0));
    }
    let b = motion.predict(at(69)).expect("predicts");
    assert!((b.x - 79.0).abs() < 0.1 && b.y == 20.0 && (b.w, b.h) == (4.0, 6.0), "{b:?}");
    let far = motion.predict(at(10_000)).expect("predicts");
    assert!((far.x - (69.0 + 1.5 * 25.0)).abs() < 0.1, "no farther than the horizon: {far:?}");
    motion.map(&Homography::scaling(2.0, 0.5));
    let b = motion.predict(at(69)).expect("predicts");
    assert!((b.x - 158.0).abs() < 0.2 && (b.w, b.h) == (8.0, 3.0), "{b:?}");
    let b = kept_inside(BBox::new(-50.0, 300.0, 10.0, 20.0), 64, 48);
    assert_eq!(b.centre(), (0.0, 48.0));
}

#[test]
fn outputs_that_make_no_sense_are_refused_by_their_key() {
    let (commands, _inbox) = control::channel();
    for (text, words) in [
        ("[output.preview]\nbind = \"0.0.0.0:0\"", &["output.preview.token", "other machines"][..]),
        ("[output.preview]\nbind = \"127.0.0.1:0\"\nquality = 0", &["output.preview.quality"]),
        ("[output.preview]\nbind = \"127.0.0.1:0\"\nrate = 0", &["output.preview.rate"]),
        ("[output.metrics]", &["output.metrics.bind"]),
        ("[output.metrics]\nbind = \"0.0.0.0:0\"", &["output.metrics.token"]),
        ("[output.mavlink]\nto = \"tcp:1\"", &["output.mavlink.to"]),
        ("[output.mcap]", &["output.mcap.dir"]),
        ("[output.mcap]\ndir = \"x\"\ntotal_mb = 300", &["output.mcap.total_mb"]),
    ] {
        let config = HostConfig::parse(&format!("{GOOD}{text}"), "host.toml").expect("parses");
        let error = outputs::open(&config, &[], &commands, None).map(drop).expect_err(text);
        assert_eq!(error.exit_code(), 2);
        for word in words {
            assert!(error.to_string().contains(word), "`{word}` in `{error}`");
        }
    }
    let config = format!("{GOOD}[process]\nsched_fifo = 100");
    let config = HostConfig::parse(&config, "host.toml").expect("parses");
    assert!(outputs::prepare(&config).expect_err("range").to_string().contains("sched_fifo"));
}
