//! Golden parity: one table of cases, every back end.
//!
//! `TSDA_GOLDEN_DIR` (with `TSDA_GOLDEN_PRESET`, `tomp101` unless given) adds a folder of one's own;
//! docs/parity.md describes it.

use std::path::{Path, PathBuf};
use tsda_export::golden::{self, EngineKind, GoldenError, Report, Selection};
use tsda_runtime::ModelSpec;
use tsda_trainer::import::{StateDict, StateTensor, state_dict};
use tsda_trainer::model::{NetOptions, TrackerNet};

/// The back ends of this build. ONNX Runtime only where its library is found.
fn engines() -> Vec<EngineKind> {
    let mut engines = vec![EngineKind::Burn, EngineKind::Native, EngineKind::Tract];
    match std::env::var_os("TSDA_ORT_LIB").or_else(|| std::env::var_os("ORT_DYLIB_PATH")) {
        Some(_) => engines.push(EngineKind::Ort),
        None => println!("skipped: ort, TSDA_ORT_LIB does not say where ONNX Runtime is"),
    }
    engines
}

fn selection(dir: &Path, preset: &str) -> Selection {
    Selection {
        dir: dir.into(),
        preset: preset.into(),
        spec: ModelSpec::preset(preset).unwrap_or_else(|| panic!("no preset {preset}")),
        case: None,
        test_embedding: None,
        filter_size: None,
    }
}

fn committed() -> PathBuf {
    tsda_tests::workspace().join("tests/golden/parity/small")
}

fn passes(dir: &Path, preset: &str) -> Report {
    let report = golden::run(&selection(dir, preset), &engines()).unwrap();
    print!("{report}");
    assert!(report.passed(false), "{}: see the lines above", dir.display());
    assert!(report.not_computed.is_empty(), "{:?}", report.not_computed);
    report
}

#[test]
fn the_small_network_equals_the_reference_on_every_back_end() {
    let report = passes(&committed(), "small");
    // burn as written and re-arranged, and every engine.
    assert_eq!(report.engines().len(), 1 + engines().len());
    for engine in report.engines() {
        for (case, tensor) in [
            ("case_a_parallel_2train_1gt", "scores"),
            ("case_a_parallel_2train_1gt", "ltrb"),
            ("case_a_parallel_2train_1gt", "cls_filter"),
            ("case_a_parallel_2train_1gt", "reg_enc.ch_step16"),
            ("case_b_parallel_1train_1gt", "scores"),
            ("case_c_single_pass_batch3", "scores"),
            ("case_d_parallel_no_test_encoding", "ltrb"),
        ] {
            let about = |l: &&golden::Line| l.engine == engine && l.case == case;
            let found = report.lines.iter().filter(about).any(|l| l.tensor == tensor);
            assert!(found, "{engine} was not compared on {tensor} of {case}");
        }
    }
}

#[test]
fn the_whole_small_set_equals_the_reference() {
    match tsda_tests::shared("golden/small") {
        Some(dir) => _ = passes(&dir, "small"),
        None => println!("skipped: the reference's whole small set is not here"),
    }
}

/// Real size: 50 million weights on four back ends.
#[test]
#[ignore = "a minute of CPU time and 4 GB; run with --ignored"]
fn tomp101_equals_the_reference() {
    match tsda_tests::shared("golden/full") {
        Some(dir) => _ = passes(&dir, "tomp101"),
        None => println!("skipped: the reference's full set is not here"),
    }
}

#[test]
fn a_folder_of_ones_own_is_met() {
    let Some(dir) = std::env::var_os("TSDA_GOLDEN_DIR") else {
        println!("skipped: TSDA_GOLDEN_DIR names no folder");
        return;
    };
    let preset = std::env::var("TSDA_GOLDEN_PRESET").unwrap_or_else(|_| "tomp101".into());
    passes(Path::new(&dir), &preset);
}

#[test]
fn more_templates_equal_the_network_as_written() {
    // No reference figures exist for these numbers: the masked rows over all tokens are computed in
    // burn, the shorter sequences everywhere else.
    for (test_embedding, filter_size, templates) in [(true, 1, 4), (false, 3, 3)] {
        let spec = ModelSpec { test_embedding, filter_size, ..ModelSpec::SMALL };
        let report = golden::run_without_reference("small", &spec, templates, &engines()).unwrap();
        print!("{report}");
        assert!(report.passed(false), "{templates} templates: see the lines above");
        let want = format!("parallel{templates}.scores");
        assert!(report.lines.iter().any(|l| l.tensor == want && l.engine == "tract"));
    }
}

/// A copy of the committed folder, changed.
struct Copy(tempfile::TempDir);

impl Copy {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        for entry in std::fs::read_dir(committed()).unwrap() {
            let path = entry.unwrap().path();
            // Case b is quick.
            let name = path.file_name().unwrap().to_str().unwrap();
            if name.starts_with("inputs") || name.starts_with("case_b") {
                std::fs::copy(&path, dir.path().join(name)).unwrap();
            }
        }
        Self(dir)
    }

    fn change(&self, file: &str, change: impl FnOnce(&mut StateDict)) {
        let path = self.0.path().join(file);
        let mut dict = StateDict::read(&path).unwrap();
        change(&mut dict);
        dict.write(&path, &Default::default()).unwrap();
    }

    fn run(&self) -> Result<Report, GoldenError> {
        golden::run(&selection(self.0.path(), "small"), &[EngineKind::Burn])
    }
}

const CASE_B: &str = "case_b_parallel_1train_1gt.safetensors";

fn shifted(dict: &mut StateDict, name: &str, by: f32) {
    let mut tensor = dict.get(name).unwrap().clone();
    tensor.values[3] += by;
    dict.insert(name.into(), tensor);
}

#[test]
fn a_figure_that_is_off_fails() {
    for (name, by) in [
        ("scores", 1e-4),
        ("ltrb", -1e-4),
        ("cls_filter", 5e-5),
        ("test_feat.ch_step16", 3e-6),
        ("inter.encoder.layer0.attn.tok_step27", 1e-4),
        ("scores", f32::NAN),
    ] {
        let copy = Copy::new();
        copy.change(CASE_B, |dict| shifted(dict, name, by));
        let report = copy.run().unwrap();
        assert!(!report.passed(true), "{name}");
        assert!(report.failures().all(|l| l.tensor == name), "{name}: {report}");
    }
}

#[test]
fn a_weight_that_is_off_fails() {
    let copy = Copy::new();
    let net = TrackerNet::new(&ModelSpec::SMALL, &NetOptions::default(), &burn_device());
    let mut dict = state_dict(&golden::recipe::fill(net.unwrap()).unwrap());
    let path = copy.0.path().join("weights.safetensors");
    dict.write(&path, &Default::default()).unwrap();
    assert!(copy.run().unwrap().passed(false), "the recipe's own weights");
    let name = "head.filter_predictor.transformer.encoder.layers.1.linear1.bias";
    shifted(&mut dict, name, 0.05);
    dict.write(&path, &Default::default()).unwrap();
    let report = copy.run().unwrap();
    let off: Vec<&str> = report.failures().map(|l| l.tensor.as_str()).collect();
    assert!(off.contains(&"scores") && off.contains(&"cls_filter"), "{off:?}");
    assert!(!off.contains(&"test_feat.ch_step16"), "{off:?}");
    // Weights of another network are refused by name.
    dict.retain(|n| n != name);
    dict.write(&path, &Default::default()).unwrap();
    let error = copy.run().unwrap_err().to_string();
    assert!(error.contains(name) && error.contains("1 missing"), "{error}");
}

fn burn_device() -> burn::tensor::Device {
    burn::tensor::Device::flex()
}

#[test]
fn unknown_tensors_and_missing_inputs_are_named() {
    let copy = Copy::new();
    let stranger = StateTensor { shape: vec![1], values: vec![0.0] };
    copy.change(CASE_B, |dict| dict.insert("inter.encoder.layer2".into(), stranger.clone()));
    copy.change("inputs.safetensors", |dict| dict.insert("seq0.weather".into(), stranger));
    let report = copy.run().unwrap();
    let names: Vec<&str> = report.unknown.iter().map(|(_, name)| name.as_str()).collect();
    assert_eq!(names, ["seq0.weather", "inter.encoder.layer2"]);
    assert!(!report.passed(false) && report.passed(true));
    assert!(report.to_string().contains("inter.encoder.layer2  UNKNOWN tensor"));

    // Boxes stand in for labels and distances; without them the missing tensor is named.
    copy.change("inputs.safetensors", |dict| dict.retain(|n| !n.ends_with("train_label")));
    assert!(copy.run().unwrap().passed(true));
    copy.change("inputs.safetensors", |dict| dict.retain(|n| !n.ends_with("train_box")));
    let error = copy.run().unwrap_err().to_string();
    assert!(error.contains("`seq0.train_label`"), "{error}");

    let empty = tempfile::tempdir().unwrap();
    let error = golden::run(&selection(empty.path(), "small"), &[]).unwrap_err().to_string();
    assert!(error.contains("inputs.safetensors"), "{error}");
}
