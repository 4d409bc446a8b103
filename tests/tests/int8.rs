//! Bundles of 8-bit numbers: made from a bundle of floats, run by every engine, through the tracker.

mod synthetic;

use synthetic::{HEIGHT, Moving, WIDTH, clips};
use tsda_eval::dataset::Sequence as _;
use tsda_export::quantize::{QuantizeError, QuantizeOptions, quantize, quantize_on};
use tsda_export::{bundle, network};
use tsda_runtime::bundle::{Bundle, BundleFile, Manifest, Numbers, SectionKind};
use tsda_runtime::engine::native::Isa;
use tsda_runtime::engine::{EngineChoice, NativeEngine, NativeOptions};
use tsda_runtime::probe::{self, Probe};
use tsda_runtime::{Backbone, FrameView, Modality, ModelSpec, Tracker, TrackerParams};
use tsda_trainer::burn_engine::BurnEngine;

fn small() -> ModelSpec {
    ModelSpec {
        backbone: Backbone::ResNet { base_channels: 8, blocks: [1, 2, 1] },
        crop: 96,
        width: 32,
        heads: 4,
        feed_forward: 48,
        ..ModelSpec::NANO
    }
}

/// A bundle of floats with random weights.
fn random(spec: &ModelSpec) -> Vec<u8> {
    let net = network::untrained(spec, 5).unwrap();
    let mut sections = network::files(&network::graphs(&net).unwrap());
    let boxes = probe::default_boxes(spec);
    let outputs = probe::capture(&mut BurnEngine::new(&net), &boxes).unwrap();
    sections.push((SectionKind::Probe, outputs));
    let manifest = Manifest {
        tracker: TrackerParams { not_found: 0.0, write_confidence: 0.0, ..Default::default() },
        ..Manifest::new("random", *spec)
    };
    bundle::encode(&manifest, &sections).unwrap()
}

fn narrow(bytes: &[u8], options: &QuantizeOptions) -> Vec<u8> {
    let data = clips();
    let calib = Some(("moving clips".to_owned(), &data));
    let (out, report) =
        quantize_on(&Bundle::parse(bytes).unwrap(), options, calib, &[], &mut |_| {}).unwrap();
    println!("{report}");
    out
}

/// Largest difference from the outputs stored in the bundle.
fn off(bundle: &Bundle<'_>, choice: &EngineChoice) -> f32 {
    let spec = bundle.manifest().spec;
    let probe = Probe::parse(bundle.require(SectionKind::Probe).unwrap(), &spec).unwrap();
    probe::run(&mut choice.open(bundle).unwrap(), &probe).unwrap().max()
}

#[test]
fn engines_agree_on_a_network_of_bytes() {
    // Trained weights: a random network finds nothing, and the graph for two templates is not run.
    let file = BundleFile::open(tsda_tests::shipped_bundle()).unwrap();
    let floats = file.bytes();
    for numbers in [Numbers::Int8, Numbers::Int8Half] {
        let options = QuantizeOptions { numbers, frames: 60, ..QuantizeOptions::default() };
        let bytes = narrow(floats, &options);
        assert!(bytes.len() < floats.len() * 6 / 10, "{} of {}", bytes.len(), floats.len());
        let bundle = Bundle::parse(&bytes).unwrap();
        let precision = bundle.manifest().precision.clone().unwrap();
        assert_eq!((precision.numbers, precision.data), (numbers, "moving clips"));
        assert!(precision.layers > 20 && precision.frames == 60, "{precision:?}");
        for isa in Isa::available() {
            let options = NativeOptions { isa: Some(isa), threads: 2, ..Default::default() };
            let engine = NativeEngine::with_options(&bundle, options).unwrap();
            let plan = engine.plan_summary().to_string();
            assert!(plan.contains("convolution of bytes") && plan.contains("linear of bytes"));
            let off = off(&bundle, &EngineChoice::Native(options));
            println!("{numbers}, native on {}: {off:e}", isa.name());
            assert!(off <= bundle.manifest().probe_tolerance(), "{}: {off}", isa.name());
        }
        for choice in EngineChoice::compiled() {
            if matches!(choice, EngineChoice::Native(_)) {
                continue;
            }
            match choice.open(&bundle) {
                Err(e) if e.is_unasked() => println!("{choice} skipped: {e}"),
                Err(e) => panic!("{choice}: {e}"),
                Ok(_) => {
                    let off = off(&bundle, &choice);
                    println!("{numbers}, {choice}: {off:e}");
                    assert!(off <= bundle.manifest().probe_tolerance(), "{choice}: {off}");
                }
            }
        }
    }
}

#[test]
fn halves_change_little_and_take_half_the_room() {
    let floats = random(&small());
    let options = QuantizeOptions { numbers: Numbers::Half, ..QuantizeOptions::default() };
    let bundle = Bundle::parse(&floats).unwrap();
    let (bytes, report) = quantize_on(&bundle, &options, None, &[], &mut |_| {}).unwrap();
    assert!(report.probe.into_iter().all(|d| d > 0.0 && d < 1e-2), "{:?}", report.probe);
    let weights =
        |bytes: &[u8]| Bundle::parse(bytes).unwrap().require(SectionKind::Weights).unwrap().len();
    assert!(weights(&bytes) < weights(&floats) * 55 / 100);
    let narrow = Bundle::parse(&bytes).unwrap();
    for choice in [EngineChoice::default(), EngineChoice::Tract(Default::default())] {
        let off = off(&narrow, &choice);
        assert!(off <= 1e-4, "{choice}: {off}");
    }
}

#[test]
fn what_cannot_be_made_narrow_is_told() {
    let floats = random(&small());
    let bundle = Bundle::parse(&floats).unwrap();
    let mut quiet = |_: &str| {};
    let none = QuantizeOptions::default();
    let error = quantize(&bundle, &none, &mut quiet).unwrap_err();
    assert!(error.to_string().contains("--calib"), "{error}");
    let missing = QuantizeOptions { calib: Some("pseudo:not/there".into()), ..none.clone() };
    let error = quantize(&bundle, &missing, &mut quiet).unwrap_err().to_string();
    assert!(error.contains("not/there"), "{error}");
    let data = clips();
    let on = |bundle: &Bundle<'_>, options: &QuantizeOptions| {
        let calib = Some(("clips".to_owned(), &data));
        quantize_on(bundle, options, calib, &[], &mut |_| {}).map(|r| r.0)
    };
    let named = QuantizeOptions { keep: vec!["no_such_layer".into()], ..none.clone() };
    let error = on(&bundle, &named).unwrap_err().to_string();
    assert!(error.contains("`no_such_layer`"), "{error}");
    let few = QuantizeOptions { frames: 1, smallest: 0, ..none.clone() };
    let error = on(&bundle, &few).unwrap_err();
    assert!(matches!(error, QuantizeError::Unseen { .. }), "{error}");
    let half = QuantizeOptions { numbers: Numbers::Half, ..none.clone() };
    let done = on(&bundle, &half).unwrap();
    let error = on(&Bundle::parse(&done).unwrap(), &none).unwrap_err();
    assert!(matches!(error, QuantizeError::Already(Numbers::Half)), "{error}");
}

/// The shipped model, and what an update allocates: see `allocation.rs` for the one of floats.
#[test]
fn the_shipped_model_in_bytes_follows_like_the_one_of_floats() {
    let file = BundleFile::open(tsda_tests::shipped_bundle()).unwrap();
    let options = QuantizeOptions { frames: 40, ..QuantizeOptions::default() };
    let bytes = narrow(file.bytes(), &options);
    let mut tracks = Vec::new();
    for bundle in [file.bundle().unwrap(), Bundle::parse(&bytes).unwrap()] {
        let engine = NativeEngine::from_bundle(&bundle).unwrap();
        let mut tracker = Tracker::new(engine, bundle.manifest().tracker).unwrap();
        let clip = Moving(1);
        let mut boxes = Vec::new();
        for frame in 0..12 {
            let data = clip.rgb(frame);
            let view = FrameView::rgb(&data, WIDTH, HEIGHT).unwrap();
            match (frame, clip.truth(0, frame, Modality::Rgb)) {
                (0, Some(bbox)) => tracker.init(&view, bbox, Some(Modality::Rgb)).unwrap(),
                _ => boxes.push(tracker.update(&view, Some(Modality::Rgb)).unwrap().bbox),
            }
        }
        tracks.push(boxes);
    }
    for (i, (a, b)) in tracks[0].iter().zip(&tracks[1]).enumerate() {
        assert!(a.iou(b) > 0.6, "frame {}: {a:?} and {b:?}", i + 1);
    }
}
