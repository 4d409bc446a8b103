//! The whole road on generated pictures: pairs folder, training, bundle, check, evaluation.

use prost::Message as _;
use std::path::{Path, PathBuf};
use tsda_eval::dataset;
use tsda_eval::metrics::Scores;
use tsda_eval::protocol::{Protocol, TrackerError, TrackerUnderTest};
use tsda_eval::{Options, RuntimeTracker, evaluate};
use tsda_export::build::{BuildOptions, build};
use tsda_export::check::check;
use tsda_export::onnx::proto::ModelProto;
use tsda_host::picture::Picture;
use tsda_host::render::{Clip, ClipConfig};
use tsda_runtime::bundle::BundleFile;
use tsda_runtime::engine::tract::TractEngine;
use tsda_runtime::{Modality, Tracker};
use tsda_trainer::config::Experiment;
use tsda_trainer::fit::{FitOptions, Outcome, fit};

const CONFIG: &str = r#"
[model]
preset = "nano"
crop = 96
width = 32
heads = 2
feed_forward = 32
encoder_layers = 1
decoder_layers = 1

[tracker]
not_found = 0.0

[[data]]
kind = "pairs"
path = "pairs"
split = "train"
validation_split = "val"

[init]
backbone = "scratch"

[run]
steps = 3
batch = 2
workers = 1
out = "OUT"
checkpoint_every = 2
log_every = 1
validate_every = 3
validation_samples = 2
"#;

fn save(picture: &Picture, path: &Path) {
    let (w, h) = (picture.width as u32, picture.height as u32);
    let colour = if picture.channels == 1 { image::ColorType::L8 } else { image::ColorType::Rgb8 };
    image::save_buffer(path, &picture.data, w, h, colour).unwrap();
}

/// Frames of the rendered clip as a pack of registered pairs.
fn write_pairs(dir: &Path) {
    let clip = Clip::new(ClipConfig::default());
    let mut pairs = Vec::new();
    for (i, split) in [(0, "train"), (10, "train"), (20, "val")] {
        let mut picture = Picture::default();
        for (folder, modality) in [("visible", Modality::Rgb), ("infrared", Modality::Thermal)] {
            std::fs::create_dir_all(dir.join(folder)).unwrap();
            clip.render(i, modality, &mut picture);
            save(&picture, &dir.join(folder).join(format!("{i}.png")));
        }
        let truth = clip.truth(i);
        pairs.push(serde_json::json!({
            "id": format!("clip{i}"), "split": split,
            "visible": format!("visible/{i}.png"), "infrared": format!("infrared/{i}.png"),
            "width": picture.width, "height": picture.height,
            "boxes": [{ "xywh": [truth.x, truth.y, truth.w, truth.h], "cls": "person" }],
        }));
    }
    let index = serde_json::json!({ "pairs": pairs });
    std::fs::write(dir.join("index.json"), index.to_string()).unwrap();
}

/// Bundles the final weights of a run.
fn bundle_of(weights: PathBuf, run: &Path, out: &Path) {
    build(&BuildOptions {
        weights,
        config: Some(run.join("config.resolved.toml")),
        preset: None,
        out: out.to_owned(),
        name: None,
        card: None,
        figures: None,
        data_sources: None,
        licence: "none".into(),
        trained_on: Default::default(),
        motion: None,
        remember_above: None,
    })
    .unwrap();
}

/// Sections of a bundle, and of every graph its inputs, outputs, nodes and weights by name and
/// shape.
fn inventory(bundle: &Path) -> Vec<String> {
    let file = BundleFile::open(bundle).unwrap();
    let bundle = file.bundle().unwrap();
    let mut all = Vec::new();
    for (kind, bytes) in bundle.sections() {
        all.push(format!("{kind}: {} bytes", bytes.len()));
        let Some(graph) = ModelProto::decode(bytes).ok().and_then(|m| m.graph) else { continue };
        let values =
            graph.input.iter().chain(&graph.output).map(|v| format!("{kind} {:?}", v.name));
        all.extend(values);
        all.extend(graph.node.iter().map(|n| format!("{kind} {:?} {:?}", n.op_type, n.output)));
        let weights = graph.initializer.iter();
        all.extend(weights.map(|w| format!("{kind} weight {:?} {:?}", w.name, w.dims)));
    }
    all
}

#[test]
fn alignment_never_reaches_a_bundle() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    write_pairs(&at("pairs"));
    let text = CONFIG.replace("validate_every = 3", "validate_every = 0");
    let mut found = Vec::new();
    for row in ["cm", "joint"] {
        let config = at(&format!("{row}.toml"));
        let align = format!("\n[align]\npreset = \"{row}\"\nstart_step = 1\n");
        std::fs::write(&config, text.replace("OUT", at(row).to_str().unwrap()) + &align).unwrap();
        let experiment = Experiment::load(&config).unwrap();
        let Outcome::Finished { model, .. } = fit(&experiment, &FitOptions::default()).unwrap()
        else {
            panic!("{row} did not finish")
        };
        let log = std::fs::read_to_string(at(row).join("log.jsonl")).unwrap();
        assert_eq!(log.contains("discriminator_accuracy"), row == "joint");
        assert_eq!(at(row).join("checkpoint-000003/align.bpk").exists(), row == "joint");
        let out = at(&format!("{row}.tsda"));
        bundle_of(model, &at(row), &out);
        found.push(inventory(&out));
    }
    assert!(found[0].iter().filter(|line| line.contains(" weight ")).count() > 100);
    assert_eq!(found[0], found[1]);
}

#[test]
fn pairs_are_trained_on_exported_and_tracked() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    write_pairs(&at("pairs"));
    let config = at("config.toml");
    std::fs::write(&config, CONFIG.replace("OUT", at("out").to_str().unwrap())).unwrap();

    let experiment = Experiment::load(&config).unwrap();
    let outcome = fit(&experiment, &FitOptions::default()).unwrap();
    let Outcome::Finished { model, validation } = outcome else { panic!("{outcome:?}") };
    assert!(validation.unwrap().all.cls.is_finite());

    let out = at("road.tsda");
    bundle_of(model, &at("out"), &out);
    let file = BundleFile::open(&out).unwrap();
    let bundle = file.bundle().unwrap();
    assert_eq!(bundle.manifest().provenance.steps, 3);
    let report = check(&bundle).unwrap();
    assert!(report.max() <= 1e-4, "{report}");

    let clips = dataset::open(&format!("pseudo:{}@val", at("pairs").display())).unwrap();
    let make = || {
        let engine = TractEngine::from_bundle(&bundle).map_err(TrackerError::new)?;
        let tracker = Tracker::new(engine, bundle.manifest().tracker).map_err(TrackerError::new)?;
        Ok(Box::new(RuntimeTracker::new("road", tracker)) as Box<dyn TrackerUnderTest>)
    };
    let options = Options { threads: 2, ..Options::default() };
    for protocol in Protocol::CROSS_MODAL {
        let result = evaluate(&clips, protocol, &make, options, &|_| {}).unwrap();
        let scores = Scores::mean(&result.scores);
        println!("{protocol}: {scores:?}");
        assert!(scores.frames > 0 && (0.0..=1.0).contains(&scores.sr50), "{scores:?}");
    }
}
