//! `tsda eval` as a program, with the model that is built into it: files, exit codes, taking up.
#![cfg(feature = "eval")]

use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn eval(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tsda"))
        .arg("eval")
        .args(args)
        .current_dir(dir)
        .output()
        .expect("the program runs")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn json(path: &Path) -> Value {
    let text = fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_slice(&text).expect("JSON")
}

const FRAMES: u32 = 8;

/// LasHeR sequences: a bright square on texture that moves two pixels per frame.
fn lasher(dir: &Path, names: &[&str]) {
    for name in names {
        let own = dir.join("set/TestingSet/testingset").join(name);
        for (folder, bright) in [("visible", 230u8), ("infrared", 200)] {
            fs::create_dir_all(own.join(folder)).expect("mkdir");
            let mut boxes = String::new();
            for i in 0..FRAMES {
                let left = 40 + 2 * i;
                image::GrayImage::from_fn(120, 96, |x, y| {
                    let inside = (left..left + 20).contains(&x) && (36..56).contains(&y);
                    image::Luma([if inside { bright } else { ((x * 7 + y * 13) % 60) as u8 }])
                })
                .save(own.join(folder).join(format!("{i:05}.png")))
                .expect("png");
                boxes += &format!("{left},36,20,20\n");
            }
            fs::write(own.join(format!("{folder}.txt")), &boxes).expect("txt");
        }
        let flags = "0,1,0,0,0,0,0,0,0,0,0,1,0,1,0,0,0,1,0";
        fs::create_dir_all(dir.join("set/AttriSeqsTxt")).expect("mkdir");
        fs::write(dir.join(format!("set/AttriSeqsTxt/{name}.txt")), flags).expect("flags");
    }
}

const SWITCH: [&str; 6] =
    ["--dataset", "lasher:set@test", "--protocol", "switch:3", "--out", "out"];

#[test]
fn a_benchmark_from_folder_to_summary() {
    let dir = tempfile::tempdir().expect("temp");
    lasher(dir.path(), &["a", "b'c", "d"]);
    let output = eval(dir.path(), &[&SWITCH[..], &["--baselines", "--jobs", "2"]].concat());
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let out = dir.path().join("out");
    let summary = json(&out.join("summary.json"));
    let protocol = &summary["protocols"]["switch:3"];
    for key in ["sr50", "auc", "pr20", "npr", "mean_iou"] {
        let value = protocol[key].as_f64().expect(key);
        assert!((0.0..=1.0).contains(&value), "{key} {value}");
    }
    assert_eq!((&protocol["sequences"], &protocol["frames"]), (&3.into(), &21.into()));
    assert!(protocol["fps"].as_f64().expect("fps") > 0.0);
    assert_eq!(protocol["benchmark"]["convention"], "lasher");
    assert_eq!(protocol["benchmark"]["frames"], 24, "LasHeR counts the first frame");
    assert_eq!(protocol["attributes"].as_array().expect("attributes").len(), 4);
    assert_eq!(protocol["switches"][0]["group"], "3");
    assert_eq!((&summary["failures"], &summary["jobs"]), (&0.into(), &2.into()));
    // A box that does nothing has no frame rate.
    assert_eq!(summary["baselines"][0]["tracker"], "static box");
    assert!(summary["baselines"][0]["protocols"]["switch:3"]["fps"].is_null());
    assert!(String::from_utf8_lossy(&output.stdout).contains("| static box |"));

    let report = json(&out.join("report.json"));
    let tracker = &report["protocols"][0]["trackers"][0];
    assert_eq!(tracker["latencies_ms"]["frames"], 21);
    let sequence = &tracker["sequences"]["b'c"];
    assert_eq!(sequence["iou"].as_array().expect("iou").len(), 8);
    let record = json(&out.join(sequence["record"].as_str().expect("record")));
    assert_eq!(record["boxes"].as_array().expect("boxes").len(), 8);
    assert_eq!(record["modalities"][1], "thermal");

    // What was written is what `compare` reads.
    let name = summary["tracker"].as_str().expect("tracker");
    let results = format!("out/boxes/{name}/switch_3");
    let compare = Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(["compare", "--dataset", "lasher:set@test", "--protocol", "switch:3"])
        .args(["--convention", "lasher", "--results", &results, "--out", "cmp"])
        .current_dir(dir.path())
        .output()
        .expect("the program runs");
    assert_eq!(compare.status.code(), Some(0), "{}", said(&compare));
    let compared = json(&dir.path().join("cmp/comparison.json"));
    let overall = &compared["protocols"][0]["trackers"][0]["overall"];
    let auc = |v: &Value| v["auc"].as_f64().expect("auc");
    assert!((auc(overall) - auc(&protocol["benchmark"])).abs() < 1e-9);
}

#[test]
fn runs_are_taken_up_kept_apart_and_started_over() {
    let dir = tempfile::tempdir().expect("temp");
    lasher(dir.path(), &["a", "b"]);
    let out = dir.path().join("out");
    let run = |more: &[&str]| eval(dir.path(), &[&SWITCH[..], more].concat());
    let first = run(&[]);
    assert_eq!(first.status.code(), Some(0), "{}", said(&first));
    let whole = fs::read(out.join("summary.json")).expect("summary");
    let folder =
        fs::read_dir(out.join("boxes")).expect("boxes").next().expect("one").expect("entry");
    let folder = folder.path().join("switch_3");
    fs::remove_file(folder.join("b.json")).expect("record");

    let second = run(&[]);
    assert!(said(&second).contains("1 of 2 sequences taken up"), "{}", said(&second));
    let third = run(&["--threads", "1"]);
    assert!(said(&third).contains("2 of 2 sequences taken up"), "{}", said(&third));
    let without_times = |bytes: &[u8]| -> Value {
        let mut v: Value = serde_json::from_slice(bytes).expect("JSON");
        v["protocols"]["switch:3"]["fps"] = Value::Null;
        v
    };
    let again = fs::read(out.join("summary.json")).expect("summary");
    assert_eq!(without_times(&again), without_times(&whole));
    // The times of what was kept are kept as well.
    let fps = |bytes: &[u8]| {
        serde_json::from_slice::<Value>(bytes).expect("JSON")["protocols"]["switch:3"]["fps"]
            .as_f64()
    };
    assert!(fps(&again).is_some());

    // Another truth is another run.
    let boxes = dir.path().join("set/TestingSet/testingset/a/visible.txt");
    let text = fs::read_to_string(&boxes).expect("boxes").replacen("40,36", "41,36", 1);
    fs::write(&boxes, text).expect("boxes");
    let other = run(&[]);
    assert_eq!(other.status.code(), Some(2), "{}", said(&other));
    assert!(said(&other).contains("dataset contents") && said(&other).contains("--fresh"));
    assert_eq!(said(&other).trim_end().lines().count(), 1);
    let fresh = run(&["--fresh"]);
    assert_eq!(fresh.status.code(), Some(0), "{}", said(&fresh));
    assert!(!said(&fresh).contains("taken up"), "{}", said(&fresh));
}

#[test]
fn what_fails_is_listed_and_the_rest_is_kept() {
    let dir = tempfile::tempdir().expect("temp");
    lasher(dir.path(), &["a", "b", "c"]);
    let set = dir.path().join("set/TestingSet/testingset");
    fs::write(set.join("a/infrared/00002.png"), "no picture").expect("broken");
    fs::write(set.join("c/visible.txt"), "40,36,20,20\n40,36,x,20\n").expect("broken");
    let output = eval(dir.path(), &SWITCH);
    let text = said(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    for words in
        ["sequence a, frame 2", "infrared/00002.png", "c/visible.txt, line 2", "2 sequences failed"]
    {
        assert!(text.contains(words), "no {words} in {text}");
    }
    let summary = json(&dir.path().join("out/summary.json"));
    let failed = &summary["protocols"]["switch:3"]["failed"];
    assert_eq!((&failed[0]["sequence"], &failed[0]["frame"]), (&"a".into(), &2.into()));
    assert_eq!((&summary["broken"][0]["line"], &summary["failures"]), (&2.into(), &2.into()));
    assert_eq!(summary["protocols"]["switch:3"]["sequences"], 1);

    // With nothing left to track, the work failed.
    fs::write(set.join("b/infrared/00001.png"), "no picture").expect("broken");
    let output = eval(dir.path(), &[&SWITCH[..], &["--fresh"]].concat());
    assert_eq!(output.status.code(), Some(3), "{}", said(&output));
    assert_eq!(json(&dir.path().join("out/summary.json"))["failures"], 3);
}

#[test]
fn what_cannot_be_evaluated_ends_with_2_and_one_line() {
    let dir = tempfile::tempdir().expect("temp");
    lasher(dir.path(), &["a"]);
    let own = dir.path().join("set/TestingSet/testingset/a");
    fs::create_dir_all(dir.path().join("one/x")).expect("mkdir");
    fs::rename(own.join("visible"), dir.path().join("one/x/visible")).expect("move");
    fs::rename(own.join("visible.txt"), dir.path().join("one/x/visible.txt")).expect("move");
    for (args, words) in [
        (&["--dataset", "lasher:nowhere", "--out", "out"][..], "nowhere"),
        (&["--dataset", "sequences:one", "--out", "out", "--protocol", "rgb2t"], "protocol rgb2t"),
        (&["--dataset", "sequences:one", "--out", "one/x/visible.txt"], "one/x/visible.txt"),
    ] {
        let output = eval(dir.path(), args);
        let text = said(&output);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {text}");
        assert!(text.contains(words) && text.trim_end().lines().count() == 1, "{args:?}: {text}");
    }
    // Without --protocol, what fits the data.
    let output = eval(dir.path(), &["--dataset", "sequences:one", "--out", "out"]);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let summary = json(&dir.path().join("out/summary.json"));
    let protocols: Vec<&String> =
        summary["protocols"].as_object().expect("object").keys().collect();
    assert_eq!(protocols, ["rgb"]);
}

#[test]
fn options_of_the_scan_belong_to_the_run() {
    let dir = tempfile::tempdir().expect("temp");
    lasher(dir.path(), &["a"]);
    let run = |more: &[&str]| eval(dir.path(), &[&SWITCH[..], more].concat());
    let scan = ["--scan-when-lost=3", "--scan-threshold", "0.75"];
    let first = run(&scan);
    assert_eq!(first.status.code(), Some(0), "{}", said(&first));
    let settings = "scan {\"positions_per_frame\":3,\"threshold\":0.75}";
    let summary = || json(&dir.path().join("out/summary.json"));
    assert_eq!(summary()["settings"], settings);
    assert!(said(&run(&scan)).contains("1 of 1 sequences taken up"));
    for (more, now) in [
        (&[][..], "none"),
        (&["--scan-when-lost"], "\"positions_per_frame\":2"),
        (&["--scan-when-lost=3", "--scan-threshold", "0.8"], "\"threshold\":0.8"),
    ] {
        let output = run(more);
        let text = said(&output);
        assert_eq!(output.status.code(), Some(2), "{more:?}: {text}");
        let difference = format!("settings {settings}, now ");
        assert!(text.contains(&difference) && text.contains(now), "{more:?}: {text}");
    }
    let plain = run(&["--fresh"]);
    assert_eq!(plain.status.code(), Some(0), "{}", said(&plain));
    assert!(summary().get("settings").is_none());
    let output = run(&["--fresh", "--scan-when-lost", "--scan-threshold", "nan"]);
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    assert!(said(&output).contains("--scan-threshold"), "{}", said(&output));
    // Refused before anything was thrown away.
    assert!(said(&run(&[])).contains("1 of 1 sequences taken up"));
}

/// Registered stills of 160 x 128 with one target each.
fn pairs(dir: &Path, ids: &[&str]) {
    fs::create_dir_all(dir.join("pairs")).expect("mkdir");
    let mut entries = Vec::new();
    for id in ids {
        for sensor in ["v", "i"] {
            let picture = image::GrayImage::from_fn(160, 128, |x, y| {
                let inside = (60..90).contains(&x) && (50..76).contains(&y);
                image::Luma([if inside { 220 } else { ((x * 7 + y * 13) % 60) as u8 }])
            });
            picture.save(dir.join(format!("pairs/{id}_{sensor}.png"))).expect("png");
        }
        entries.push(serde_json::json!({
            "id": id, "split": "val", "visible": format!("{id}_v.png"),
            "infrared": format!("{id}_i.png"), "width": 160, "height": 128,
            "boxes": [{"xywh": [60, 50, 30, 26], "cls": "x"}],
        }));
    }
    let index = serde_json::json!({ "pairs": entries }).to_string();
    fs::write(dir.join("pairs/index.json"), index).expect("index");
}

#[test]
fn a_broken_still_costs_its_clips_only() {
    let dir = tempfile::tempdir().expect("temp");
    pairs(dir.path(), &["a", "b", "c", "d"]);
    fs::write(dir.path().join("pairs/b_i.png"), "no picture").expect("broken");
    image::GrayImage::new(80, 64).save(dir.path().join("pairs/c_v.png")).expect("png");
    let set = ["--dataset", "pseudo:pairs@val", "--pseudo-frames", "4", "--out", "out"];
    let output = eval(dir.path(), &set);
    let text = said(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    for words in ["b_i.png", "c_v.png", "2 sequences failed"] {
        assert!(text.contains(words), "no {words} in {text}");
    }
    // Too short for the default: said, not hidden.
    assert!(text.contains("switch:200: the longest sequence has 4 frames"), "{text}");
    let summary = json(&dir.path().join("out/summary.json"));
    let protocols: Vec<_> = summary["protocols"].as_object().expect("object").keys().collect();
    assert_eq!(protocols, ["rgb2t", "switch:200", "t2rgb"]);
    assert_eq!(summary["protocols"]["rgb2t"]["sequences"], 2);
    assert_eq!(summary["broken"].as_array().expect("broken").len(), 2);
    assert!(summary["broken"][0]["path"].as_str().expect("path").ends_with("b_i.png"));

    // All broken: nothing to track, one line.
    for id in ["a", "d"] {
        fs::write(dir.path().join(format!("pairs/{id}_v.png")), "no picture").expect("broken");
    }
    let output = eval(dir.path(), &[&set[..], &["--fresh"]].concat());
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    assert_eq!(said(&output).trim_end().lines().count(), 1, "{}", said(&output));
}

/// Ctrl-C: code 3, one line, finished sequences kept, the same command goes on.
#[cfg(unix)]
#[test]
fn an_interrupted_run_goes_on_later() {
    let dir = tempfile::tempdir().expect("temp");
    let names: Vec<String> = (0..40).map(|i| format!("s{i:02}")).collect();
    lasher(dir.path(), &names.iter().map(String::as_str).collect::<Vec<_>>());
    let child = Command::new(env!("CARGO_BIN_EXE_tsda"))
        .arg("eval")
        .args(SWITCH)
        .current_dir(dir.path())
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("the program starts");
    let finished = || {
        let Ok(trackers) = fs::read_dir(dir.path().join("out/boxes")) else { return 0 };
        let folders = trackers.flatten().map(|t| t.path().join("switch_3"));
        let files = folders.filter_map(|f| fs::read_dir(f).ok()).flatten().flatten();
        let records = files.filter(|f| f.path().extension().is_some_and(|e| e == "json"));
        records.count().saturating_sub(1)
    };
    let start = std::time::Instant::now();
    while finished() < 2 {
        assert!(start.elapsed().as_secs() < 120, "no sequence was finished");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(killed.expect("kill").success());
    let output = child.wait_with_output().expect("the program ends");
    let text = said(&output);
    assert_eq!(output.status.code(), Some(3), "{text}");
    assert!(text.contains("interrupted") && text.contains("of 40 sequences"), "{text}");
    assert!(!dir.path().join("out/summary.json").exists());
    let kept = finished();
    assert!((2..40).contains(&kept), "{kept}");
    let output = eval(dir.path(), &SWITCH);
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    assert!(
        said(&output).contains(&format!("{kept} of 40 sequences taken up")),
        "{}",
        said(&output)
    );
    let summary = json(&dir.path().join("out/summary.json"));
    assert_eq!(summary["protocols"]["switch:3"]["sequences"], 40);
}
