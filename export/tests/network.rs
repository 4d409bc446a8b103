//! The tracker's network through the whole road: record, write, read back, run in tract, unpack,
//! and in Python where it has onnx and onnxruntime.

use std::path::Path;
use std::process::Command;
use tsda_export::build::{BuildOptions, build};
use tsda_export::check::check;
use tsda_export::unpack::unpack;
use tsda_export::{bundle, network};
use tsda_runtime::bundle::{Bundle, BundleFile, Manifest, Provenance, SectionKind, TrainedOn};
use tsda_runtime::engine::EngineChoice;
use tsda_runtime::probe;
use tsda_runtime::{Backbone, ModelSpec};
use tsda_trainer::burn_engine::BurnEngine;
use tsda_trainer::import::save_weights;

/// Parity that the project promises.
const TOLERANCE: f32 = 1e-4;

/// A small member of the ResNet branch of the family.
fn small_resnet() -> ModelSpec {
    ModelSpec {
        backbone: Backbone::ResNet { base_channels: 8, blocks: [1, 2, 1] },
        crop: 96,
        width: 32,
        heads: 4,
        feed_forward: 48,
        encoder_layers: 2,
        decoder_layers: 2,
        ltrb_hidden: 8,
        test_embedding: false,
        templates: 3,
        ..ModelSpec::NANO
    }
}

/// A bundle with random weights.
fn random_bundle(name: &str, spec: &ModelSpec) -> (Vec<u8>, usize) {
    let net = network::untrained(spec, 5).unwrap();
    let graphs = network::graphs(&net).unwrap();
    for g in &graphs {
        println!("{name} {}: {} recorded, {} nodes", g.kind, g.recorded, g.graph.nodes.len());
    }
    let mut sections = network::files(&graphs);
    let boxes = probe::default_boxes(spec);
    let outputs = probe::capture(&mut BurnEngine::new(&net), &boxes).unwrap();
    sections.push((SectionKind::Probe, outputs));
    let manifest = Manifest { card: "# Random", ..Manifest::new(name, *spec) };
    (bundle::encode(&manifest, &sections).unwrap(), network::parameters(&net))
}

#[test]
fn tract_equals_burn_and_weights_are_stored_once() {
    // A crop of odd rows and columns on the smallest maps, for MobileNet's larger padding.
    let pico = ModelSpec { crop: 112, ..ModelSpec::PICO_V3 };
    let cases = [("nano", ModelSpec::NANO), ("pico-v3", pico), ("small resnet", small_resnet())];
    for (name, spec) in cases {
        let (bytes, parameters) = random_bundle(name, &spec);
        let file = Bundle::parse(&bytes).unwrap();
        let report = check(&file).unwrap();
        println!("{name}: {} parameters, bundle of {} bytes\n{report}", parameters, bytes.len());
        // Every engine compiled in but an ONNX Runtime without library, two maps for every number
        // of templates.
        assert!(report.failure().is_none(), "{report}");
        let engines = EngineChoice::compiled().len() - report.unchecked.len();
        assert_eq!(report.differences.len(), engines * 2 * usize::from(spec.templates));
        assert!(report.max() <= TOLERANCE, "{name}: differs by {}", report.max());
        // Each parameter once, though three or four graphs use them; beside them the positional
        // code, its products in every encoder layer (once for all graphs), folded constants, the
        // graphs themselves and the probe.
        let code = 4 * spec.cells() * usize::from(spec.width);
        let codes = (3 * usize::from(spec.encoder_layers) + 1) * code;
        let graphs = 3 + usize::from(spec.templates);
        let most = 4 * parameters + codes + 50_000 * graphs;
        assert!(bytes.len() < most, "{name}: {} bytes, at most {most} expected", bytes.len());
        let weights = file.require(SectionKind::Weights).unwrap().len();
        assert!(weights > 4 * parameters * 9 / 10, "{name}: only {weights} bytes of weights");
    }
}

#[test]
fn graphs_hold_only_operations_of_inference() {
    let net = network::untrained(&small_resnet(), 1).unwrap();
    for g in network::graphs(&net).unwrap() {
        for node in &g.graph.nodes {
            assert!(node.op != "BatchNormalization", "{}: a batch norm was not folded", g.kind);
            assert!(!["Identity", "Cast", "Pad"].contains(&node.op), "{}: {}", g.kind, node.op);
        }
    }
}

/// The files `tsda-export build` is given, in a fresh folder.
fn inputs(dir: &Path, spec: &ModelSpec) -> BuildOptions {
    let net = network::untrained(spec, 9).unwrap();
    save_weights(&net, &dir.join("w.safetensors")).unwrap();
    std::fs::write(dir.join("c.toml"), config()).unwrap();
    std::fs::write(dir.join("card.md"), "# Small\n").unwrap();
    std::fs::write(dir.join("f.json"), r#"{"SR0.5 val": 0.75}"#).unwrap();
    std::fs::write(dir.join("d.txt"), "somewhere (CC0)\n").unwrap();
    BuildOptions {
        weights: dir.join("w.safetensors"),
        config: Some(dir.join("c.toml")),
        preset: None,
        out: dir.join("small.tsda"),
        name: None,
        card: Some(dir.join("card.md")),
        figures: Some(dir.join("f.json")),
        data_sources: Some(dir.join("d.txt")),
        licence: "CC0-1.0".into(),
        motion: None,
        remember_above: None,
        trained_on: TrainedOn::default(),
    }
}

fn config() -> &'static str {
    r#"
[model]
backbone = { res_net = { base_channels = 8, blocks = [1, 2, 1] } }
crop = 96
width = 32
heads = 4
feed_forward = 48
encoder_layers = 2
decoder_layers = 2
ltrb_hidden = 8
test_embedding = false
templates = 3

[[data]]
kind = "pairs"
path = "/somewhere/private/pairs"

[sampler]
cross_modal_p = 0.5

[run]
seed = 42
steps = 7
"#
}

fn tool() -> Command {
    Command::new(env!("CARGO_BIN_EXE_tsda-export"))
}

#[test]
fn built_checked_and_unpacked() {
    let dir = tempfile::tempdir().unwrap();
    let options = inputs(dir.path(), &small_resnet());
    let report = build(&options).unwrap();
    assert_eq!(report.graphs.len(), 5);
    let file = BundleFile::open(&options.out).unwrap();
    let bundle = file.bundle().unwrap();
    let manifest = bundle.manifest();
    assert_eq!(manifest.name, "small");
    assert_eq!(manifest.spec, small_resnet());
    assert_eq!((manifest.provenance.seed, manifest.provenance.steps), (42, 7));
    assert_eq!(manifest.provenance.data, "somewhere (CC0)\n");
    assert_eq!((manifest.figures[0].name, manifest.figures[0].value), ("SR0.5 val", 0.75));
    assert_eq!((manifest.card, manifest.licence), ("# Small\n", "CC0-1.0"));
    assert!(manifest.trained_on.cross_modal);
    // Paths of this machine stay here.
    assert!(manifest.provenance.config.contains("path = \"pairs\""));
    assert!(!manifest.provenance.config.contains("private"));

    let out = tool().arg("check").arg(&options.out).output().unwrap();
    println!("{}", String::from_utf8_lossy(&out.stdout));
    assert_eq!(out.status.code(), Some(0));
    let strict = tool().arg("check").arg(&options.out).args(["--tolerance", "0"]).output().unwrap();
    assert_eq!(strict.status.code(), Some(1));

    let unpacked = dir.path().join("unpacked");
    let files = unpack(&bundle, &unpacked).unwrap();
    assert_eq!(files.len(), 10);
    for kind in manifest.sections.iter().map(|s| s.kind) {
        let written = std::fs::read(unpacked.join(kind.to_string())).unwrap();
        assert_eq!(Some(&written[..]), bundle.section(kind), "{kind}");
    }
    let json = std::fs::read_to_string(unpacked.join("manifest.json")).unwrap();
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["spec"]["crop"], 96);
    assert_eq!(std::fs::read_to_string(unpacked.join("card.md")).unwrap(), "# Small\n");
    assert!(std::fs::read_to_string(unpacked.join("config.toml")).unwrap().contains("seed = 42"));
    python_agrees(&unpacked);
}

/// onnx.checker and ONNX Runtime on the unpacked files, where Python has them.
fn python_agrees(folder: &Path) {
    let python = std::env::var("TSDA_PYTHON").unwrap_or_else(|_| "python3".into());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scripts/onnx_check.py");
    let Ok(out) = Command::new(&python).arg(script).arg(folder).output() else {
        println!("skipped: no {python}");
        return;
    };
    let text = String::from_utf8_lossy(&out.stdout);
    let errors = String::from_utf8_lossy(&out.stderr);
    if out.status.code() == Some(3) {
        println!("skipped: {errors}");
        return;
    }
    println!("{text}");
    assert_eq!(out.status.code(), Some(0), "{text}{errors}");
}

#[test]
fn bad_input_is_named_and_leaves_no_file() {
    let dir = tempfile::tempdir().unwrap();
    let good = inputs(dir.path(), &small_resnet());
    let put = |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    let weights = std::fs::read(&good.weights).unwrap();
    let mut poisoned = weights.clone();
    let last = poisoned.len() - 4;
    poisoned[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    let other = dir.path().join("other.safetensors");
    let wider = ModelSpec { feed_forward: 64, test_embedding: true, ..small_resnet() };
    save_weights(&network::untrained(&wider, 1).unwrap(), &other).unwrap();
    type Change<'a> = Box<dyn Fn(&mut BuildOptions) + 'a>;
    let cases: Vec<(&str, Change<'_>, Vec<&str>)> = vec![
        (
            "no weights",
            Box::new(|o| o.weights = dir.path().join("absent.safetensors")),
            vec!["absent.safetensors", "read"],
        ),
        (
            "truncated weights",
            Box::new(|o| o.weights = put("cut.safetensors", &weights[..weights.len() / 2])),
            vec!["cut.safetensors"],
        ),
        (
            "weights of another network",
            Box::new(|o| o.weights = other.clone()),
            vec!["other.safetensors", "linear1.weight", "[64, 32]", "[48, 32]"],
        ),
        (
            "weights that are not numbers",
            Box::new(|o| o.weights = put("nan.safetensors", &poisoned)),
            vec!["nan.safetensors", "NaN"],
        ),
        (
            "unknown key",
            Box::new(|o| {
                let text = config().replace("steps = 7", "stpes = 7");
                o.config = Some(put("typo.toml", text.as_bytes()));
            }),
            vec!["typo.toml", "stpes", "line"],
        ),
        (
            "number out of range",
            Box::new(|o| {
                let text = config().replace("crop = 96", "crop = 95");
                o.config = Some(put("range.toml", text.as_bytes()));
            }),
            vec!["range.toml", "crop", "95"],
        ),
        (
            "figures of another kind",
            Box::new(|o| o.figures = Some(put("text.json", br#"{"a": "b"}"#))),
            vec!["text.json", "expected"],
        ),
        (
            "no card",
            Box::new(|o| o.card = Some(dir.path().join("absent.md"))),
            vec!["absent.md", "read"],
        ),
        (
            "no folder to write to",
            Box::new(|o| o.out = dir.path().join("absent/x.tsda")),
            vec!["x.tsda", "write"],
        ),
    ];
    for (name, change, parts) in cases {
        let mut options = good.clone();
        change(&mut options);
        let mut command = tool();
        command.arg("build");
        command.arg("--weights").arg(&options.weights);
        command.arg("--config").arg(options.config.as_ref().unwrap());
        command.arg("--out").arg(&options.out);
        command.arg("--card").arg(options.card.as_ref().unwrap());
        command.arg("--figures").arg(options.figures.as_ref().unwrap());
        let out = command.output().unwrap();
        let text = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(2), "{name}: {text}");
        for part in parts {
            assert!(text.contains(part), "{name}: `{part}` is not in: {text}");
        }
        let left: Vec<_> = std::fs::read_dir(dir.path())
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .filter(|n| n.contains(".tsda") || n.contains(".part"))
            .collect();
        assert!(left.is_empty(), "{name} left {left:?}");
    }
}

#[test]
fn a_damaged_bundle_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (bytes, _) = random_bundle("damaged", &small_resnet());
    let path = dir.path().join("x.tsda");
    let mut altered = bytes.clone();
    let middle = altered.len() / 2;
    altered[middle] ^= 1;
    for (name, bytes, part) in [
        ("empty", Vec::new(), "truncated"),
        ("cut in the header", bytes[..20].to_vec(), "truncated"),
        ("cut in the weights", bytes[..bytes.len() / 2].to_vec(), "weights.bin"),
        ("altered", altered, "altered"),
        ("something else", b"PK\x03\x04 not a bundle".to_vec(), "signature"),
    ] {
        std::fs::write(&path, bytes).unwrap();
        for command in ["check", "unpack"] {
            let mut tool = tool();
            tool.arg(command).arg(&path);
            if command == "unpack" {
                tool.arg(dir.path().join("unpacked"));
            }
            let out = tool.output().unwrap();
            let text = String::from_utf8_lossy(&out.stderr).into_owned();
            assert_eq!(out.status.code(), Some(2), "{name}, {command}: {text}");
            assert!(text.contains(part) && text.contains("x.tsda"), "{name}, {command}: {text}");
            assert!(!dir.path().join("unpacked").exists(), "{name}");
        }
    }
}

#[test]
fn the_written_bundle_reads_back() {
    let sections = vec![
        (SectionKind::FeaturesOnnx, vec![1u8; 100]),
        (SectionKind::PredictOnnx(1), vec![]),
        (SectionKind::Weights, vec![2u8; 70_000]),
    ];
    for card in ["", "x", &"card ".repeat(2000)] {
        let manifest = Manifest {
            trained_on: TrainedOn { rgb: true, thermal: false, cross_modal: false },
            provenance: Provenance { seed: u64::MAX, ..Default::default() },
            licence: "MIT",
            card,
            ..Manifest::new("m", ModelSpec::NANO)
        };
        let bytes = bundle::encode(&manifest, &sections).unwrap();
        let read = Bundle::parse(&bytes).unwrap();
        assert_eq!(read.manifest().card, card);
        for (kind, body) in &sections {
            assert_eq!(read.section(*kind), Some(&body[..]), "{kind}");
        }
    }
    let twice = [sections[0].clone(), sections[0].clone()];
    assert!(bundle::encode(&empty(), &twice).unwrap_err().to_string().contains("twice"));
    let many: Vec<_> = (0..17).map(|k| (SectionKind::PredictOnnx(k), vec![])).collect();
    assert!(bundle::encode(&empty(), &many).unwrap_err().to_string().contains("17 sections"));
}

fn empty() -> Manifest<'static> {
    Manifest { licence: "", ..Manifest::new("m", ModelSpec::NANO) }
}

/// A missing library is an error, not a panic, and does not hide what tract computes.
#[cfg(feature = "ort")]
#[test]
fn a_missing_onnx_runtime_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("x.tsda");
    std::fs::write(&path, random_bundle("any", &small_resnet()).0).unwrap();
    let absent = dir.path().join("libabsent.so");
    let out = tool().arg("check").arg(&path).env("TSDA_ORT_LIB", &absent).output().unwrap();
    let text = String::from_utf8_lossy(&out.stderr).into_owned();
    assert_eq!(out.status.code(), Some(2), "{text}");
    assert!(text.contains("libabsent.so") && text.contains("TSDA_ORT_LIB"), "{text}");
    let shown = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(shown.contains("tract    predict1") && shown.contains("ort      FAILED"), "{shown}");
    // By its name, alone: nothing else is checked, and tract needs no library.
    let out = tool()
        .args(["check", "--engine", "tract"])
        .arg(&path)
        .env("TSDA_ORT_LIB", &absent)
        .output()
        .unwrap();
    let shown = String::from_utf8_lossy(&out.stdout).into_owned();
    assert_eq!(out.status.code(), Some(0), "{shown}");
    assert!(!shown.contains("ort "), "{shown}");
}
