//! From a pytracking checkpoint to a checked bundle in three steps: import, build, check.

use std::path::{Path, PathBuf};
use std::process::Command;
use tsda_export::build::{BuildError, BuildOptions, build};
use tsda_export::check::check;
use tsda_runtime::bundle::{BundleFile, TrainedOn};
use tsda_runtime::{Backbone, ModelSpec, TrackerParams};
use tsda_trainer::import::{self, Given, ImportOptions, Metadata, StateDict, WeightsError};

const RGB: TrainedOn = TrainedOn { rgb: true, thermal: false, cross_modal: false };

fn torch_file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/import").join(name)
}

fn imported(input: &Path, output: &Path) -> ModelSpec {
    let options = ImportOptions {
        kind: None,
        input: input.into(),
        output: output.into(),
        given: Given::Nothing,
    };
    import::run(&options).unwrap().network.unwrap().spec
}

fn options(weights: &Path, out: &Path, preset: Option<&str>) -> BuildOptions {
    BuildOptions {
        weights: weights.into(),
        config: None,
        preset: preset.map(str::to_owned),
        out: out.into(),
        name: None,
        card: None,
        figures: None,
        data_sources: None,
        licence: "see the original".into(),
        trained_on: RGB,
        motion: None,
        remember_above: None,
    }
}

/// Import, build and check; the largest difference between engines and the burn network.
fn road(input: &Path, dir: &Path) -> (ModelSpec, f32) {
    let (weights, out) = (dir.join("imported.safetensors"), dir.join("imported.tsda"));
    let spec = imported(input, &weights);
    build(&options(&weights, &out, None)).unwrap();
    let file = BundleFile::open(&out).unwrap();
    let bundle = file.bundle().unwrap();
    let manifest = bundle.manifest();
    assert_eq!(manifest.spec, spec);
    assert_eq!((manifest.tracker, manifest.trained_on), (TrackerParams::default(), RGB));
    let name = input.file_name().unwrap().to_str().unwrap();
    assert!(manifest.provenance.trainer.contains(name), "{}", manifest.provenance.trainer);
    assert!(manifest.provenance.config.contains(&format!("crop = {}", spec.crop)));
    let report = check(&bundle).unwrap();
    println!("{name}: {report}");
    (spec, report.max())
}

#[test]
fn a_checkpoint_becomes_a_bundle_without_a_configuration() {
    let dir = tempfile::tempdir().unwrap();
    let (spec, worst) = road(&torch_file("pytracking.pth.tar"), dir.path());
    assert_eq!((spec.filter_size, spec.heads, spec.crop), (3, 2, 64));
    assert_eq!(spec.backbone, Backbone::ResNet { base_channels: 1, blocks: [1, 2, 1] });
    assert!(worst <= 1e-4, "{worst}");
}

#[test]
fn the_thresholds_are_the_reference_s() {
    let p = TrackerParams::default();
    let got = [
        p.not_found,
        p.distractor,
        p.hard_negative,
        p.neighbourhood,
        p.displacement,
        p.write_confidence,
        p.min_size,
        p.max_scale_change,
    ];
    // Spec 3.1.
    assert_eq!(got, [0.25, 0.8, 0.5, 2.2, 0.8, 0.9, 10.0, 1.5]);
}

#[test]
fn presets_and_configurations_are_checked_against_the_weights() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (weights, out) = (at("w.safetensors"), at("m.tsda"));
    imported(&torch_file("pytracking.pth.tar"), &weights);
    let error = build(&options(&weights, &out, Some("tomp101"))).unwrap_err();
    let BuildError::Weights(WeightsError::Conflict { field, by, .. }) = &error else {
        panic!("{error}")
    };
    assert_eq!((*field, by.as_str()), ("backbone", "preset tomp101"));
    // A configuration with another filter size than the checkpoint's (quirk Q1).
    let stored = Metadata::read(&weights).unwrap().spec.unwrap();
    let tables = import::model_toml(&stored, &TrackerParams::default()).unwrap();
    let data = "\n[[data]]\nkind = \"pairs\"\npath = \"pairs\"\n";
    let configured = |text: &str| {
        std::fs::write(at("c.toml"), format!("{text}{data}")).unwrap();
        build(&BuildOptions { config: Some(at("c.toml")), ..options(&weights, &out, None) })
    };
    let error = configured(&tables.replace("filter_size = 3", "filter_size = 1")).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("filter_size is 3") && text.contains("c.toml"), "{text}");
    assert!(!out.exists());
    configured(&tables).unwrap();
    // Weights that say nothing.
    let dict = StateDict::read(&weights).unwrap();
    dict.write(&weights, &Metadata::default()).unwrap();
    let error = build(&options(&weights, &out, None)).unwrap_err();
    assert!(matches!(error, BuildError::NoSpec { .. }), "{error}");
    let text = error.to_string();
    assert!(text.contains("--preset") && text.contains("weights-import"), "{text}");
}

#[test]
fn the_commands_do_it() {
    let dir = tempfile::tempdir().unwrap();
    let (weights, out) = (dir.path().join("w.safetensors"), dir.path().join("m.tsda"));
    imported(&torch_file("pytracking.pth.tar"), &weights);
    let tool = || Command::new(env!("CARGO_BIN_EXE_tsda-export"));
    let built = tool().arg("build").arg("--weights").arg(&weights).arg("--out").arg(&out).output();
    let built = built.unwrap();
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    let checked = tool().arg("check").arg(&out).output().unwrap();
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stdout));
    let mut wrong = tool();
    wrong.args(["build", "--preset", "nano", "--weights"]).arg(&weights).arg("--out").arg(&out);
    let wrong = wrong.output().unwrap();
    assert_eq!(wrong.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("backbone"));
}

#[test]
fn the_small_golden_checkpoint_of_torch_goes_the_whole_road() {
    let python = ["TSDA_TORCH_PYTHON", "TSDA_PYTHON"].iter().find_map(|name| {
        let python = std::env::var(name).ok()?;
        let out = Command::new(&python).args(["-c", "import torch, numpy"]).output().ok()?;
        out.status.success().then_some(python)
    });
    let Some(python) = python else {
        println!("skipped: neither TSDA_TORCH_PYTHON nor TSDA_PYTHON names a Python with torch");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let script = torch_file("make_torch_files.py");
    let made = Command::new(python).arg("-B").arg(script).arg(dir.path()).arg("small").output();
    let made = made.unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    for (file, test_embedding) in [("small.pth.tar", true), ("small_no_test.pth.tar", false)] {
        let (spec, worst) = road(&dir.path().join(file), dir.path());
        assert_eq!((spec.crop, spec.heads, spec.test_embedding), (144, 4, test_embedding));
        assert!(worst <= 2e-5, "{file}: {worst}");
    }
}
