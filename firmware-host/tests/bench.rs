//! `tsda bench`: the shape of its figures. Times are not judged here, counts are.

use serde_json::Value;
use std::process::{Command, Output};

fn bench(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tsda"))
        .arg("bench")
        .args(args)
        .env("TSDA_ORT_LIB", "absent.so")
        .output()
        .expect("the program starts")
}

#[test]
fn every_engine_gets_its_figures_or_a_reason() {
    let dir = tempfile::tempdir().expect("temp");
    let path = dir.path().join("bench.json");
    let file = path.to_str().expect("path");
    let mut args = vec!["--frames", "4", "--threads", "1,2", "--json", file];
    for engine in ["native", "tract", "tract,pool=0", "ort"] {
        if cfg!(feature = "ort") || engine != "ort" {
            args.extend(["--engine", engine]);
        }
    }
    let output = bench(&args);
    let table = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{table}{}", String::from_utf8_lossy(&output.stderr));
    let json: Value =
        serde_json::from_slice(&std::fs::read(&path).expect("the file is there")).expect("JSON");

    assert_eq!(json["frames"], 4);
    assert!(json["cpu"].as_str().is_some_and(|s| !s.is_empty()) && json["isa"].is_string());
    let rows = json["engines"].as_array().expect("rows");
    assert_eq!(rows.len(), args.iter().filter(|a| **a == "--engine").count() * 2);
    let row = |engine: &str, threads: u64| {
        let found = rows.iter().find(|r| r["engine"] == engine && r["threads"] == threads);
        found.unwrap_or_else(|| panic!("{engine} {threads}: {json}"))
    };
    for (engine, threads) in [("native", 1), ("native", 2), ("tract", 1)] {
        let row = row(engine, threads);
        let number = |key: &str| row[key].as_f64().unwrap_or_else(|| panic!("{key} in {row}"));
        assert!(row.get("unavailable").is_none() && row["preset"] == "nano", "{row}");
        for key in
            ["cpu_ms_p50", "wall_ms_p50", "peak_rss_mb", "load_ms", "cpu_ratio", "wall_ratio"]
        {
            assert!(number(key) > 0.0, "{key} in {row}");
        }
        assert!(number("wall_ms_p50") <= number("p95") && number("p95") <= number("p99"));
        for stage in ["crop", "features", "predict", "post", "frame", "template"] {
            let ms = row["stages"][stage]["wall_ms_p50"].as_f64();
            assert!(ms.is_some_and(|ms| ms > 0.0), "{stage} in {row}");
        }
        let native = engine.starts_with("native");
        for key in ["allocs_per_frame", "bytes_per_frame"] {
            assert_eq!(number(key) == 0.0, native, "{key} in {row}");
        }
    }
    // tract asks a thousand times per frame, and its pool answers.
    let (pooled, plain) = (row("tract", 1), row("tract,pool=0", 1));
    assert_eq!(pooled["system_allocs_per_frame"], 0.0, "{pooled}");
    assert_eq!(pooled["pool"]["overflows"], 0, "{pooled}");
    let bytes = |key: &str| pooled["pool"][key].as_u64().unwrap_or_default();
    assert!(bytes("high_water") > 0 && bytes("high_water") <= bytes("capacity"), "{pooled}");
    assert!(
        plain["pool"].is_null() && plain["system_allocs_per_frame"] == plain["allocs_per_frame"]
    );
    // What cannot be measured says why.
    let reason = |engine, threads| row(engine, threads)["unavailable"].as_str().unwrap_or_default();
    assert!(reason("tract", 2).contains("one thread"));
    if cfg!(feature = "ort") {
        assert!(reason("ort", 1).contains("absent.so") && table.contains("not measured: ort 1T"));
    }
    let crops = json["crops"].as_array().expect("crops");
    assert!(crops.iter().any(|c| c["format"] == "yuyv" && c["height"] == 1080));
    assert!(crops.iter().all(|c| c["wall_ms_p50"].as_f64().is_some_and(|ms| ms > 0.0)));
}

#[test]
fn every_step_of_the_native_engine_has_its_time() {
    let output = bench(&["--nodes", "2", "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let json: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(json["preset"], "nano");
    let steps = json["steps"].as_array().expect("steps");
    for (graph, kind) in [
        ("features.onnx", "depthwise"),
        ("template.onnx", "linear"),
        ("predict2.onnx", "attention"),
    ] {
        let found = steps.iter().find(|s| s["graph"] == graph && s["kind"] == kind);
        let step = found.unwrap_or_else(|| panic!("{kind} in {graph}: {json}"));
        assert!(step["wall_us"].as_f64().is_some_and(|us| us > 0.0), "{step}");
        assert!(step["node"].as_str().is_some_and(|node| !node.is_empty()), "{step}");
    }
    let table = bench(&["--nodes", "1"]);
    assert!(String::from_utf8_lossy(&table.stdout).contains("predict2.onnx"));
}

#[test]
fn bad_bundles_and_arguments_end_with_one_message() {
    for (args, code, word) in [
        (&["--bundle", "absent.tsda"][..], 2, "absent.tsda"),
        (&["--frames", "0"], 2, "--frames"),
        (&["--engine", "abacus"], 2, "abacus"),
        (&["--nodes", "--engine", "native", "--engine", "native"], 2, "--nodes"),
    ] {
        let output = bench(args);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{message}");
        assert!(message.contains(word), "{message}");
    }
}
