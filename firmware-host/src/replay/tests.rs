use super::*;
use serde_json::json;
use std::path::PathBuf;

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/runtime").join(name)
}

fn read(name: &str) -> Value {
    serde_json::from_slice(&std::fs::read(golden(name)).unwrap()).unwrap()
}

#[test]
fn the_reference_runs_are_repeated_frame_by_frame() {
    let report = replay(&golden("tracker_script.json"), None).unwrap();
    print!("{report}");
    assert!(report.passed(), "{report}");
    let frames: Vec<usize> = report.runs.iter().map(|run| run.frames).collect();
    assert_eq!(frames, [33, 5]);
    assert!(report.unknown.is_empty(), "{:?}", report.unknown);
    assert_eq!(report.not_compared, ["learning_rate", "weights"].into());
    // A flag, a cell, a counter, a write and the slots asked with, in every frame.
    assert!(report.runs[0].exact >= 5 * 33);
}

#[test]
fn a_script_of_its_own_shape_and_thresholds_is_met() {
    let report = replay(&golden("second_script.json"), None).unwrap();
    print!("{report}");
    assert!(report.passed(), "{report}");
    let frames: Vec<usize> = report.runs.iter().map(|run| run.frames).collect();
    assert_eq!(frames, [6, 21, 3]);
    assert!(report.unknown.is_empty() && report.not_compared.is_empty());
}

#[test]
fn crops_are_recognised_by_their_pixels() {
    let report = replay(&golden("sample_patch_cases.json"), None).unwrap();
    assert!(report.passed(), "{report}");
    assert_eq!(report.runs[0].frames, 66);
}

/// Replays the first frames of a changed script.
fn changed(change: impl FnOnce(&mut Value)) -> Result<Report, ReplayError> {
    let mut script = read("tracker_script.json");
    for (run, frames) in [(0, 4), (1, 2)] {
        script[run]["frames"].as_array_mut().unwrap().truncate(frames);
    }
    change(&mut script);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("changed.json");
    std::fs::write(&path, script.to_string()).unwrap();
    replay(&path, Some(&golden("tracker_script.safetensors")))
}

#[test]
fn every_kind_of_difference_is_a_violation() {
    let shift = |v: &Value, by: f64| json!(v.as_f64().unwrap() + by);
    for (field, new) in [
        ("flag", json!("uncertain")),
        ("max_disp_rc", json!([8, 9])),
        ("updated", json!(false)),
        ("not_found_counter", json!(1)),
        ("pos_yx", json!([226.996, 281.464])),
        ("sample_pos_yx", json!([230.0, 289.0, 1.0])),
        ("target_scale", json!(1.38333)),
        ("patch_mean", json!(127.4)),
        (
            "patch_samples",
            json!([
                [100.09, 165.134, 73.715],
                [172.26, 36.917, 174.038],
                [145.1, 110.215, 135.376]
            ]),
        ),
    ] {
        let report = changed(|s| s[0]["frames"][0][field] = new).unwrap();
        let found: Vec<&Violation> = report.violations().collect();
        let about = |v: &&Violation| v.frame == 1 && v.run == "main_480x640";
        assert!(!found.is_empty() && found.iter().all(about), "{field}: {report}");
        assert!(found.iter().any(|v| v.field == field), "{field}: {report}");
    }
    for field in ["target_box_xywh", "label_max", "replaced_slot", "num_stored"] {
        let report = changed(|s| {
            let old = &s[0]["frames"][0]["memory"][field];
            let new = match old.as_array() {
                Some(list) => json!([shift(&list[0], 0.01), list[1], list[2], list[3]]),
                None => json!(old.as_f64().unwrap() + 1.0),
            };
            s[0]["frames"][0]["memory"][field] = new;
        });
        assert_eq!(report.unwrap().violations().count(), 1, "{field}");
    }
    // A threshold decides otherwise from the first frame on.
    let report = changed(|s| s[0]["params"] = json!({"write_confidence": 0.96})).unwrap();
    assert!(report.violations().any(|v| v.frame == 1 && v.field == "updated"), "{report}");
}

#[test]
fn what_is_not_known_is_reported() {
    let report = changed(|s| {
        s[0]["frames"][3]["shininess"] = json!(1);
        s[1]["params"] = json!({"gravity": 9.81, "conf_ths": 0.9});
    });
    let report = report.unwrap();
    assert!(report.passed(), "{report}");
    // Maps of the frames cut off are left over.
    let (maps, fields): (Vec<&str>, Vec<&str>) =
        report.unknown.iter().map(String::as_str).partition(|name| name.starts_with("tensor "));
    assert_eq!(fields, ["frames[].shininess", "params.gravity"]);
    assert!(maps.contains(&"tensor main_480x640.f5.scores"), "{maps:?}");
}

#[test]
fn unusable_scripts_say_where() {
    type Change = fn(&mut Value);
    let cases: [(Change, &str); 12] = [
        (|s| *s = json!([]), "the script: it has no runs"),
        (|s| *s = json!(7), "expected a list of runs, found the number 7"),
        (|s| s[0] = json!("run"), "run 0: expected an object, found the text \"run\""),
        (|s| s[1]["name"] = json!(null), "run 1, name: is missing"),
        (|s| s[0]["image_hw"] = json!([480]), "run 0, image_hw: expected 2 numbers, found 1"),
        (|s| s[0]["image_hw"] = json!([480, 1e9]), "is no side of a picture"),
        (|s| s[0]["init_bbox_xywh"] = json!([1, 1, 0, 5]), "has no area"),
        (|s| s[0]["frames"][2]["frame"] = json!(-1), "frames[2], frame: expected a whole number"),
        (|s| s[0]["frames"][2]["flag"] = json!(3), "frame 3, flag: expected a text"),
        (|s| s[0]["name"] = json!("other"), "tensor `other.f1.scores`: it is missing"),
        (|s| s[0]["templates"] = json!(9), "run 0, templates: expected 1 to 8 slots"),
        (|s| s[0]["image_formula"] = json!("noise"), "\"noise\" is not known"),
    ];
    for (change, text) in cases {
        let error = changed(change).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(text), "{text:?} is not in {error:?}");
    }
    let dir = tempfile::tempdir().unwrap();
    let broken = dir.path().join("broken.json");
    std::fs::write(&broken, "[\n  {\"name\": }]").unwrap();
    let error = replay(&broken, None).unwrap_err().to_string();
    assert!(error.contains("broken.json, line 2, column 12"), "{error}");
    let crops = golden("../trainer/train_crop_cases.json");
    let error = replay(&crops, None).unwrap_err().to_string();
    assert!(error.contains("training crops"), "{error}");
}

#[test]
fn damaged_tensor_files_say_where() {
    let whole = std::fs::read(golden("second_script.safetensors")).unwrap();
    let path = Path::new("maps.safetensors");
    assert!(Tensors::parse(&whole, path).is_ok());
    for (bytes, text) in [
        (whole[..5].to_vec(), "5 bytes are no safetensors file"),
        (whole[..100].to_vec(), "in a file of 100"),
        (whole[..whole.len() - 4].to_vec(), "ends at"),
        ([&16u64.to_le_bytes()[..], b"{\"a\": nonsense}  "].concat(), "byte 15: header"),
        ([&u64::MAX.to_le_bytes()[..], b"{}"].concat(), "a header of"),
    ] {
        let error = Tensors::parse(&bytes, path).unwrap_err().to_string();
        assert!(error.contains(text), "{text:?} is not in {error:?}");
    }
}
