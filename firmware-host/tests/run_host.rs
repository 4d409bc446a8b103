//! `tsda run` on two drawn sensors of one scene: a thermal camera that is smaller and looks elsewhere,
//! changes by the clock, by failure and by what is seen; boxes are compared with the truth.

use serde_json::Value;
use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use tsda_host::render::{Clip, ClipConfig};
use tsda_host::switch::Homography;
use tsda_runtime::BBox;

/// The thermal picture: the drawn one of 240 x 180 less a margin.
const TO_THERMAL: Homography = Homography([[0.75, 0.0, -12.0], [0.0, 0.75, -6.0], [0.0, 0.0, 1.0]]);

const SENSORS: &str = r#"
[[source]]
name = "rgb"
sensor = "rgb"
render = { size = [320, 240] }
faults = [RGB_FAULTS]
[[source]]
name = "thermal"
sensor = "thermal"
render = { size = [240, 180], raw16 = true }
crop = [12, 6, 220, 170]
[[registration]]
from = "rgb"
to = "thermal"
matrix = [[0.75, 0, -12], [0, 0.75, -6], [0, 0, 1]]
[[output.json]]
to = "stdout"
queue = 4096
"#;

fn tsda(dir: &Path, config: &str, args: &[&str]) -> Output {
    let path = dir.join("host.toml");
    fs::write(&path, config).expect("write");
    Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(["run", "--config"])
        .arg(&path)
        .args(args)
        .output()
        .expect("the program starts")
}

fn lines(output: &Output) -> Vec<Value> {
    let text = String::from_utf8_lossy(&output.stdout);
    text.lines().map(|l| serde_json::from_str(l).unwrap_or_else(|e| panic!("{e}: {l}"))).collect()
}

/// Both sensors begin anew after their last picture.
fn endless() -> String {
    SENSORS
        .replace("RGB_FAULTS", "")
        .replace("[320, 240] }", "[320, 240], frames = 20, repeat = true }")
        .replace("raw16 = true }", "raw16 = true, frames = 20, repeat = true }")
}

struct Ran {
    frames: Vec<Value>,
    events: Vec<Value>,
    log: String,
}

fn run(head: &str, faults: &str, tail: &str) -> Ran {
    let dir = tempfile::tempdir().expect("temp");
    let sensors = SENSORS.replace("RGB_FAULTS", faults);
    let output = tsda(dir.path(), &format!("{head}\n{sensors}\n{tail}"), &[]);
    let log = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{log}");
    let (frames, events) = lines(&output).into_iter().partition(|v| v["type"] == "frame");
    Ran { frames, events, log }
}

/// Mean overlap with the truth, over the frames that `which` picks.
fn overlap(frames: &[Value], which: impl Fn(&Value) -> bool) -> f32 {
    let clip = Clip::new(ClipConfig::default());
    let (mut sum, mut n) = (0.0, 0);
    for frame in frames.iter().filter(|f| which(f)) {
        let index = (frame["t"].as_f64().expect("t") * 25.0).round() as usize;
        let truth = clip.truth(index);
        let truth = if frame["source"] == "rgb" { truth } else { TO_THERMAL.map_box(&truth) };
        let b: Vec<f32> = frame["box"]
            .as_array()
            .expect("box")
            .iter()
            .map(|v| v.as_f64().expect("number") as f32)
            .collect();
        sum += truth.iou(&BBox::new(b[0], b[1], b[2], b[3]));
        n += 1;
    }
    assert!(n > 0, "no such frame");
    sum / n as f32
}

fn switches(events: &[Value]) -> Vec<(u64, String, String)> {
    let text = |v: &Value| v.as_str().unwrap_or_default().to_owned();
    let switched = events.iter().filter(|e| e["event"] == "switched");
    switched
        .map(|e| (e["frame"].as_u64().expect("frame"), text(&e["to"]), text(&e["reason"])))
        .collect()
}

#[test]
fn the_target_is_kept_through_planned_changes() {
    let tail = "[switch]\nschedule = [{ at_s = 1.0, to = \"thermal\" }, { at_s = 1.6, to = \"rgb\" }, \
                { at_s = 1.8, to = \"thermal\" }]";
    let ran = run("clock = \"frames\"", "", tail);
    assert_eq!(ran.frames.len(), 96, "{}", ran.log);
    let got = switches(&ran.events);
    let want = [(25, "thermal"), (40, "rgb"), (45, "thermal")];
    let want = want.map(|(f, to)| (f, to.to_owned(), "schedule".to_owned()));
    assert_eq!(got, want);
    let (all, thermal) =
        (overlap(&ran.frames, |_| true), overlap(&ran.frames, |f| f["source"] == "thermal"));
    println!("planned: mean IoU {all:.3}, thermal {thermal:.3}");
    assert!(all > 0.45 && thermal > 0.4, "{all} {thermal}");
    assert_eq!(ran.frames[30]["size"], serde_json::json!([220, 170]));
    assert!(ran.frames.iter().all(|f| f["predicted"] == false));
}

#[test]
fn the_target_is_kept_when_the_sensor_fails() {
    // Fault, what the events call it, frames that may pass before the change.
    for (kind, name, frames) in [
        ("stop", "late", 24),
        ("unplug", "gone", 2),
        ("freeze", "frozen", 24),
        ("dark", "dark", 10),
        ("saturate", "saturated", 10),
        ("damage", "damaged", 10),
        ("shutter", "shutter", 10),
    ] {
        let faults = format!("{{ kind = \"{kind}\", at = 20, frames = 30 }}");
        let tail = "[switch.failure]\nafter_s = 0.2\nreturn_after_s = 0.4";
        let ran = run("clock = \"frames\"", &faults, tail);
        let got = switches(&ran.events);
        let (away, back) = (&got[0], &got[1]);
        assert_eq!(
            (away.1.as_str(), away.2.as_str()),
            ("thermal", format!("failure: {name}").as_str())
        );
        assert_eq!((back.1.as_str(), back.2.as_str(), got.len()), ("rgb", "recovered", 2));
        let lost = ran.events.iter().find(|e| e["event"] == "camera_lost").expect("lost");
        assert_eq!((lost["source"].as_str(), lost["reason"].as_str()), (Some("rgb"), Some(name)));
        assert!(ran.events.iter().any(|e| e["event"] == "camera_back"), "{kind}");
        let changed = ran.frames.iter().find(|f| f["source"] == "thermal").expect("thermal");
        let index = (changed["t"].as_f64().expect("t") * 25.0).round() as i64;
        assert!((20..=20 + frames).contains(&index), "{kind}: changed at {index}");
        // Until then the target is predicted, not looked for in what is no picture.
        let unseen: Vec<&Value> = ran.frames.iter().filter(|f| f["picture"] != "good").collect();
        assert!(
            unseen.iter().all(|f| f["predicted"] == true && f["state"] == "searching"),
            "{kind}"
        );
        // Without new pictures there is nothing to report until the change.
        let silent = ["stop", "unplug", "freeze"].contains(&kind);
        assert!(silent || !unseen.is_empty(), "{kind}");
        let thermal = overlap(&ran.frames, |f| f["source"] == "thermal");
        println!(
            "{kind}: changed at {index}, {} predicted, thermal IoU {thermal:.3}",
            unseen.len()
        );
        assert!(thermal > 0.4, "{kind}: {thermal}");
    }
}

#[test]
fn a_dark_scene_changes_the_sensor() {
    // Night falls in the drawn scene.
    let tail = "[switch.scene]\nwatch = \"rgb\"\notherwise = \"thermal\"\nbelow = 0.16\nabove = 0.3\nhold_s = 0.2";
    let ran = run("clock = \"frames\"", "", tail);
    let got = switches(&ran.events);
    assert_eq!(got.len(), 1, "{got:?}");
    assert!(got[0].1 == "thermal" && got[0].2.starts_with("scene: 0.1"), "{got:?}");
}

#[test]
fn temperatures_are_reported_by_cameras_that_measure_them() {
    let dir = tempfile::tempdir().expect("temp");
    let config = "clock = \"frames\"\nframes = 3\n[[source]]\nname = \"t\"\nsensor = \"thermal\"\n\
                  profile = \"lepton\"\nrender = { size = [160, 120], raw16 = true }\n\
                  CELSIUS\n[[output.json]]\nto = \"stdout\"\n";
    let frames = |celsius: &str| {
        let output = tsda(dir.path(), &config.replace("CELSIUS", celsius), &[]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        lines(&output).into_iter().filter(|v| v["type"] == "frame").collect::<Vec<_>>()
    };
    // No telemetry says so, nor does anybody else.
    assert!(frames("").iter().all(|f| f["celsius"].is_null()));
    let measured = frames("celsius = { scale = 0.01, offset = -273.15 }");
    assert_eq!(measured.len(), 3);
    for frame in measured {
        let mean = frame["celsius"]["mean"].as_f64().expect("measured");
        let max = frame["celsius"]["max"].as_f64().expect("measured");
        assert!((20.0..40.5).contains(&mean) && max >= mean && max < 40.5, "{frame}");
    }
}

#[test]
fn recordings_are_read_by_other_peoples_software() {
    let python = std::env::var("TSDA_PYTHON").unwrap_or_else(|_| "python3".into());
    let packages = "import mcap, jsonschema, foxglove_schemas_protobuf";
    let have = Command::new(&python).args(["-c", packages]).output();
    if !have.is_ok_and(|o| o.status.success()) {
        println!("skipped: {python} has not all of mcap, jsonschema, foxglove-schemas-protobuf");
        return;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scripts/mcap_check.py");
    let checked = Command::new(&python)
        .arg(script)
        .args(["--tsda", env!("CARGO_BIN_EXE_tsda")])
        .output()
        .expect("runs");
    let said = String::from_utf8_lossy(&checked.stdout);
    println!("{said}");
    assert!(checked.status.success(), "{said}{}", String::from_utf8_lossy(&checked.stderr));
    assert!(said.contains("recovered: "), "{said}");
}

#[test]
fn without_pictures_the_program_gives_up_with_its_own_code() {
    let dir = tempfile::tempdir().expect("temp");
    let sensors = SENSORS.replace("RGB_FAULTS", "{ kind = \"stop\", at = 5, frames = 90 }");
    let sensors =
        sensors.replace("crop =", "faults = [{ kind = \"unplug\", at = 6, frames = 90 }]\ncrop =");
    let config = format!("clock = \"frames\"\ngive_up_s = 1.0\n{sensors}\n[switch.failure]\n");
    let output = tsda(dir.path(), &config, &[]);
    assert_eq!(output.status.code(), Some(4), "{}", String::from_utf8_lossy(&output.stderr));
    let last = lines(&output).pop().expect("lines");
    assert_eq!(last["reason"], "no usable pictures");
}

#[test]
fn commands_select_switch_and_end() {
    let dir = tempfile::tempdir().expect("temp");
    let config = format!("{}\n[control]\nstdin = true\n", endless());
    let path = dir.path().join("host.toml");
    fs::write(&path, config).expect("write");
    let mut child = Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(["run", "--config"])
        .arg(&path)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let mut stdin = child.stdin.take().expect("stdin");
    let mut lines = BufReader::new(child.stdout.take().expect("stdout"))
        .lines()
        .map(|l| serde_json::from_str::<Value>(&l.expect("line")).expect("json"));
    let mut until = |want: &dyn Fn(&Value) -> bool| {
        lines.by_ref().take(400).find(|v| want(v)).expect("this line comes")
    };
    until(&|v| v["event"] == "selected");
    writeln!(stdin, r#"{{"cmd":"stop"}}"#).expect("write");
    until(&|v| v["event"] == "released");
    until(&|v| v["state"] == "idle" && v["box"].is_null());
    writeln!(stdin, r#"{{"cmd":"switch","to":"nowhere"}}"#).expect("write");
    until(&|v| v["event"] == "refused");
    writeln!(stdin, r#"{{"cmd":"switch","to":"thermal"}}"#).expect("write");
    assert_eq!(until(&|v| v["event"] == "switched")["reason"], "command");
    // Given in pixels of the other sensor, taken in those of the active one.
    writeln!(stdin, r#"{{"cmd":"select","box":[100,80,40,40],"source":"rgb"}}"#).expect("write");
    let selected = until(&|v| v["event"] == "selected");
    assert_eq!(selected["box"], serde_json::json!([63.0, 54.0, 30.0, 30.0]), "{selected}");
    writeln!(stdin, r#"{{"cmd":"quit"}}"#).expect("write");
    until(&|v| v["event"] == "ended");
    assert_eq!(child.wait().expect("ends").code(), Some(0));
}

#[test]
fn a_signal_ends_the_run_cleanly() {
    let dir = tempfile::tempdir().expect("temp");
    let socket = dir.path().join("out.sock");
    let config =
        endless().replace("to = \"stdout\"", &format!("to = \"unix:{}\"", socket.display()));
    let path = dir.path().join("host.toml");
    fs::write(&path, config).expect("write");
    let mut child = Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(["run", "--config"])
        .arg(&path)
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let start = std::time::Instant::now();
    let stream = loop {
        if let Ok(stream) = std::os::unix::net::UnixStream::connect(&socket) {
            break stream;
        }
        assert!(start.elapsed().as_secs() < 300, "the socket never came");
        std::thread::sleep(std::time::Duration::from_millis(20));
    };
    let mut lines = BufReader::new(stream).lines();
    // Whoever connects early sees the first events, whoever connects late does not.
    let frame = lines.by_ref().take(50).any(|l| l.expect("read").contains("\"type\":\"frame\""));
    assert!(frame, "frames arrive");
    let killed = Command::new("kill").arg(child.id().to_string()).status().expect("kill");
    assert!(killed.success());
    assert_eq!(child.wait().expect("ends").code(), Some(0));
    let last = lines.map_while(Result::ok).last().expect("line");
    assert!(last.contains("\"ended\"") && last.contains("signal"), "{last}");
    assert!(!socket.exists(), "the socket is removed");
}

#[test]
fn a_check_opens_everything_and_runs_nothing() {
    let dir = tempfile::tempdir().expect("temp");
    let good = SENSORS.replace("RGB_FAULTS", "");
    let output = tsda(dir.path(), &good, &["--check"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && text.trim_end().ends_with("ok"), "{text}");
    assert!(text.contains("drawn scene") && text.contains("native"), "{text}");
    for (config, word) in [
        (good.replace("queue =", "depth ="), "line 18"),
        (good.replace("stdout", "carrier pigeon"), "carrier pigeon"),
        (format!("model = \"no.tsda\"\n{good}"), "no.tsda"),
    ] {
        let output = tsda(dir.path(), &config, &["--check"]);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(error.contains(word) && error.lines().count() == 1, "{word}: {error}");
    }
}

#[test]
fn frames_are_left_out_while_it_is_too_warm() {
    let dir = tempfile::tempdir().expect("temp");
    let zone = dir.path().join("thermal_zone0");
    fs::create_dir(&zone).expect("folder");
    fs::write(zone.join("temp"), "91000").expect("temp");
    let config = format!(
        "clock = \"frames\"\n{}\n[process]\nmlockall = true\nsched_fifo = 1\n\
         [process.temperature]\npath = \".\"\nlimit = 90\nrate = 5",
        SENSORS.replace("RGB_FAULTS", "").replace("[320, 240] }", "[320, 240], frames = 20 }")
    );
    let output = tsda(dir.path(), &config, &[]);
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{log}");
    let (frames, events): (Vec<_>, Vec<_>) =
        lines(&output).into_iter().partition(|v| v["type"] == "frame");
    let at: Vec<u64> = frames.iter().map(|f| f["sequence"].as_u64().expect("sequence")).collect();
    // Every fifth of 25 per second.
    assert_eq!(at, [0, 5, 10, 15], "{log}");
    assert!(events.iter().any(|e| e["event"] == "throttled"), "{log}");
    // With or without the right to it, the run goes on.
    println!("{log}");
}
