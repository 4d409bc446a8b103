//! `tsda data-check`: exit codes and what it prints.
#![cfg(feature = "eval")]

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn data_check(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tsda"))
        .arg("data-check")
        .args(args)
        .current_dir(dir)
        .output()
        .expect("the program runs")
}

/// One RGBT234 sequence of three frames with an attribute.
fn dataset() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("temp");
    let own = dir.path().join("set/car10");
    for (folder, letter) in [("visible", 'v'), ("infrared", 'i')] {
        fs::create_dir_all(own.join(folder)).expect("mkdir");
        for i in 0..3 {
            image::GrayImage::new(32, 24)
                .save(own.join(folder).join(format!("{i:05}{letter}.jpg")))
                .expect("jpg");
        }
        fs::write(own.join(format!("{folder}.txt")), "1,2,3,4\n0,0,0,0\n1,2,3,4\n").expect("txt");
    }
    fs::create_dir(dir.path().join("set/attr_txt")).expect("mkdir");
    fs::write(dir.path().join("set/attr_txt/SequencesName.txt"), "car10\n").expect("txt");
    fs::write(dir.path().join("set/attr_txt/TC.txt"), "1\n").expect("txt");
    dir
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn a_sound_dataset_ends_with_0() {
    let dir = dataset();
    let out = data_check(dir.path(), &["rgbt234:set", "--decode", "all"]);
    let printed = text(&out.stdout);
    assert_eq!(out.status.code(), Some(0), "{printed} {}", text(&out.stderr));
    for want in [
        "1 (1 rgb+thermal)",
        "3 annotated, of these 1 absent",
        "thermal 32 x 24 (3)",
        "TC 1",
        "6 headers, 6 decoded",
        "sound",
    ] {
        assert!(printed.contains(want), "{want}: {printed}");
    }
}

#[test]
fn a_broken_one_ends_with_1_and_names_everything() {
    let dir = dataset();
    fs::write(dir.path().join("set/car10/infrared.txt"), "1,2,3,4\n").expect("txt");
    fs::write(dir.path().join("set/car10/visible/00001v.jpg"), "x").expect("jpg");
    let out = data_check(dir.path(), &["rgbt234:set", "--json"]);
    assert_eq!(out.status.code(), Some(1), "{}", text(&out.stderr));
    let report: serde_json::Value = serde_json::from_slice(&out.stdout).expect("JSON");
    assert_eq!(report["attributes"]["TC"], 1);
    assert_eq!(report["annotation"]["rgb"]["absent"], 1);
    let findings = report["findings"].as_array().expect("list");
    assert_eq!(findings.len(), 2, "{findings:?}");
    let all = report["findings"].to_string();
    assert!(
        all.contains("infrared.txt: 1 boxes for 3 frames") && all.contains("00001v.jpg"),
        "{all}"
    );
    let out = data_check(dir.path(), &["rgbt234:set"]);
    assert!(text(&out.stdout).contains("BROKEN (2):"), "{}", text(&out.stdout));
}

#[test]
fn nothing_to_look_at_ends_with_2_and_one_line() {
    let dir = dataset();
    for (args, want) in [
        (&["rgbt234:nowhere"][..], "nowhere"),
        (&["betamax:set"], "sequences, pairs, pseudo"),
        (&["rgbt234:set@train"], "RGBT234 is a test set"),
        (&["gtot:set"], "no sequence folder"),
    ] {
        let out = data_check(dir.path(), args);
        let said = text(&out.stderr);
        assert_eq!(out.status.code(), Some(2), "{args:?}: {said}");
        assert!(said.contains(want) && said.trim_end().lines().count() == 1, "{args:?}: {said}");
        assert!(out.stdout.is_empty());
    }
}

#[test]
fn what_is_written_is_read_back_as_it_was() {
    let dir = dataset();
    let write = |out: &str| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_tsda"));
        program.args(["data-write", "rgbt234:set", "--out", out]).current_dir(dir.path());
        program.output().expect("the program runs")
    };
    let first = write("plain");
    assert_eq!(first.status.code(), Some(0), "{}", text(&first.stderr));
    let own = dir.path().join("plain/car10");
    for (folder, letter) in [("visible", 'v'), ("infrared", 'i')] {
        let boxes = fs::read_to_string(own.join(format!("{folder}.txt"))).expect("boxes");
        assert_eq!(boxes, "1.000,2.000,3.000,4.000\n0,0,0,0\n1.000,2.000,3.000,4.000\n");
        for i in 0..3 {
            let source = dir.path().join(format!("set/car10/{folder}/{i:05}{letter}.jpg"));
            let source = image::open(source).expect("jpg").into_rgb8();
            let written = own.join(format!("{folder}/{:06}.png", i + 1));
            assert_eq!(image::open(written).expect("png").into_rgb8(), source);
        }
    }
    let out = data_check(dir.path(), &["sequences:plain", "--decode", "all"]);
    let printed = text(&out.stdout);
    assert_eq!(out.status.code(), Some(0), "{printed}");
    assert!(printed.contains("3 annotated, of these 1 absent"), "{printed}");

    // A run that is called again leaves what is there, and says what it cannot write.
    fs::write(own.join("visible.txt"), "mine\n").expect("edit");
    assert_eq!(write("plain").status.code(), Some(0));
    assert_eq!(fs::read_to_string(own.join("visible.txt")).expect("boxes"), "mine\n");
    let into_file = write("plain/index.json");
    assert_eq!(into_file.status.code(), Some(2), "{}", text(&into_file.stderr));
    assert!(text(&into_file.stderr).contains("index.json"));
}
