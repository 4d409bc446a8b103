//! `tsda score` and `tsda compare` as programs: output, exit codes, messages.
#![cfg(feature = "eval")]

use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn tsda(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(args)
        .current_dir(dir)
        .output()
        .expect("the program runs")
}

fn write(dir: &Path, file: &str, text: &str) {
    let path = dir.join(file);
    fs::create_dir_all(path.parent().expect("parent")).expect("mkdir");
    fs::write(path, text).expect("write");
}

/// Exit code 2 and one line with these words.
fn refused(dir: &Path, args: &[&str], words: &[&str]) {
    let output = tsda(dir, args);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
    for word in words {
        assert!(message.contains(word), "{args:?}: no \"{word}\" in: {message}");
    }
    assert_eq!(message.trim_end().lines().count(), 1, "{args:?}: {message}");
}

const TRUTH: &str = "10,10,20,20\n10,10,20,20\n10,10,20,20\n10,10,20,20\n";
/// One exact, one off by 20 px, one of NaN.
const RESULT: &str = "10 10 20 20\n10\t10\t20\t20\r\n30,10,20,20\nnan,nan,nan,nan\n\n";

#[test]
fn one_pair_of_files() {
    let dir = tempfile::tempdir().expect("temp");
    let at = dir.path();
    write(at, "gt.txt", TRUTH);
    write(at, "gt_corners.txt", "10 10 30 30\n30 30 10 10\n10 10 30 30\n10 10 30 30\n");
    write(at, "pred.txt", RESULT);
    write(at, "cover.label", "8\n8\n0\n8\n");
    let json = |args: &[&str]| -> Value {
        let mut all = vec!["score", "--pred", "pred.txt", "--json"];
        all.extend(args);
        let output = tsda(at, &all);
        assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(String::from_utf8_lossy(&output.stderr).contains("1 boxes are not finite"));
        serde_json::from_slice(&output.stdout).expect("JSON")
    };
    let third = 1.0 / 3.0;
    for (args, frames, sr50, pr20, points) in [
        (&["--gt", "gt.txt"][..], 3, third, 2.0 * third, 21),
        (&["--gt", "gt.txt", "--convention", "lasher"], 4, 0.5, 0.75, 21),
        (&["--gt", "gt.txt", "--convention", "rgbt210", "--no-rounding"], 4, 0.5, 0.75, 21),
        (&["--gt", "gt.txt", "--gt2", "gt.txt", "--convention", "rgbt234"], 4, 0.5, 0.75, 21),
        // Below 20 px, not at most.
        (
            &["--gt", "gt_corners.txt", "--gt2", "gt_corners.txt", "--convention", "gtot"],
            4,
            0.5,
            0.5,
            21,
        ),
        (
            &[
                "--gt",
                "gt.txt",
                "--convention",
                "got10k",
                "--cover",
                "cover.label",
                "--image-size",
                "64x48",
            ],
            2,
            0.5,
            0.5,
            101,
        ),
        (&["--gt", "gt.txt", "--convention", "otb", "--attributes", "OCC,LI"], 4, 0.5, 0.75, 21),
    ] {
        let v = json(args);
        assert_eq!(v["frames"], frames, "{args:?}");
        for (key, want) in [("sr50", sr50), ("pr20", pr20)] {
            let got = v[key].as_f64().expect("number");
            assert!((got - want).abs() < 1e-9, "{args:?} {key}: {got}");
        }
        for key in ["auc", "npr", "mean_iou"] {
            assert!(v[key].is_number(), "{args:?} {key}");
        }
        let length = |v: &Value| v.as_array().expect("list").len();
        for (key, n) in [("success", points), ("precision", 51), ("normalised_precision", 51)] {
            assert_eq!(length(&v["curves"][key]), n, "{args:?} {key}");
            assert_eq!(length(&v["thresholds"][key]), n, "{args:?} {key}");
        }
        assert_eq!(v["pr5"].is_number(), args.contains(&"gtot"));
        assert_eq!(v["ao"].is_number(), args.contains(&"got10k"));
        assert_eq!((&v["nan_rows"], &v["cut_rows"]), (&Value::from(1), &Value::from(0)));
    }
    let output =
        tsda(at, &["score", "--gt", "gt.txt", "--pred", "gt.txt", "--convention", "lasher"]);
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(text.contains("convention lasher, 4 frames") && text.contains("SR    95.2"), "{text}");
}

#[test]
fn what_cannot_be_scored() {
    let dir = tempfile::tempdir().expect("temp");
    let at = dir.path();
    write(at, "gt.txt", TRUTH);
    write(at, "short.txt", "10,10,20,20\n10,10,20,20\n");
    write(at, "bad.txt", "10,10,20,20\n10,10,20\n");
    write(at, "empty.txt", "\n");
    let score = |gt, pred, more: &[&'static str], words: &[&str]| {
        let mut args = vec!["score", "--gt", gt, "--pred", pred];
        args.extend(more);
        refused(at, &args, words);
    };
    score("none.txt", "gt.txt", &[], &["--gt", "none.txt"]);
    score("gt.txt", "bad.txt", &[], &["--pred", "bad.txt, line 2", "found 3"]);
    score("gt.txt", "empty.txt", &[], &["empty.txt", "no boxes"]);
    score("gt.txt", "short.txt", &[], &["short.txt, line 3", "2 predicted boxes for 4 frames"]);
    score("short.txt", "gt.txt", &[], &["gt.txt, line 3", "4 predicted boxes for 2 frames"]);
    score("gt.txt", "gt.txt", &["--convention", "rgbt234"], &["rgbt234", "--gt2 FILE"]);
    score("gt.txt", "gt.txt", &["--convention", "lasher", "--gt2", "gt.txt"], &["leave out --gt2"]);
    score(
        "gt.txt",
        "gt.txt",
        &["--convention", "gtot", "--gt2", "short.txt"],
        &["short.txt, line 3", "gt.txt has 4"],
    );
    score("gt.txt", "gt.txt", &["--image-size", "64x48"], &["--image-size", "got10k"]);
    score(
        "gt.txt",
        "gt.txt",
        &["--convention", "got10k", "--cover", "bad.txt"],
        &["--cover", "bad.txt, line 1"],
    );
    let more = ["score", "--gt", "gt.txt", "--pred", "short.txt", "--lengths", "toolkit"];
    let rgbt210 = ["--convention", "rgbt210"];
    assert_eq!(tsda(at, &[&more[..], &rgbt210].concat()).status.code(), Some(0));
    for args in [["--convention", "votlt"], ["--image-size", "0x4"]] {
        let all = [&["score", "--gt", "gt.txt", "--pred", "gt.txt"][..], &args].concat();
        assert_eq!(tsda(at, &all).status.code(), Some(2), "{args:?}");
    }
}

#[test]
fn trackers_side_by_side() {
    let dir = tempfile::tempdir().expect("temp");
    let at = dir.path();
    for s in ["s0", "s1"] {
        write(at, &format!("gt/{s}/visible.txt"), TRUTH);
        write(at, &format!("gt/{s}/infrared.txt"), TRUTH);
        write(at, &format!("a/{s}.txt"), TRUTH);
        write(at, &format!("b/B_{s}.txt"), RESULT);
    }
    write(at, "attributes.json", r#"{"s0": ["OCC"], "s1": ["OCC", "LI"]}"#);
    let args = [
        "compare",
        "--gt",
        "gt",
        "--results",
        "a=ours",
        "--results",
        "b",
        "--protocol",
        "switch:1",
        "--hold",
        "1",
        "--attributes",
        "attributes.json",
        "--out",
        "new/folder",
    ];
    let output = tsda(at, &args);
    let table = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    for line in ["| ours | **100.0** |", "| b | 33.3 |", "| OCC | ours |", "| 3 | b | 33.3 |"] {
        assert!(table.contains(line), "no {line} in\n{table}");
    }
    let read = |name: &str| fs::read_to_string(at.join("new/folder").join(name)).expect("file");
    assert_eq!(read("comparison.md"), table);
    assert!(read("comparison.csv").starts_with("protocol,table,group,tracker,"));
    let v: Value = serde_json::from_str(&read("comparison.json")).expect("JSON");
    assert_eq!((&v["version"], &v["convention"]), (&Value::from(1), &Value::from("tsda")));
    let protocol = &v["protocols"][0];
    assert_eq!(protocol["protocol"], "switch:1");
    assert_eq!(protocol["trackers"][0]["recovery"]["switches"], 6);
    assert_eq!(protocol["best"]["sr50"][0], "ours");

    fs::remove_file(at.join("b/B_s1.txt")).expect("remove");
    let less = |more: &[&str]| tsda(at, &[&args[..7], more].concat());
    refused(at, &args[..7], &["b: s1: no result", "--partial"]);
    let output = less(&["--partial"]);
    assert!(String::from_utf8_lossy(&output.stdout).contains("- s1 (b): no result"));
    write(at, "b/B_s0.txt", "1,2\n");
    refused(at, &args[..7], &["B_s0.txt, line 1"]);
    refused(at, &["compare", "--gt", "gt", "--results", "none"], &["--results none", "none"]);
    refused(at, &["compare", "--gt", "none", "--results", "a"], &["--gt", "none"]);
    refused(at, &["compare", "--dataset", "video:x", "--results", "a"], &["--dataset", "video:x"]);
    assert_eq!(tsda(at, &["compare", "--results", "a"]).status.code(), Some(2));
}
