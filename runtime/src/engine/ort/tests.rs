//! The hand-written network of tract's tests, on both engines. Without a library the tests say
//! "skipped".

use super::*;
use crate::bundle::SectionKind as Kind;
use crate::engine::tract::tests::{SPEC, external, features_with, load, parts, write as bundle_of};
use crate::probe;
use prost::Message as _;

fn library() -> Option<&'static OrtLibrary> {
    match OrtLibrary::get() {
        Ok(library) => Some(library),
        Err(e) => {
            println!("skipped: {e}");
            None
        }
    }
}

fn open(parts: &[(Kind, Vec<u8>)]) -> Result<OrtEngine, OrtError> {
    let bytes = bundle_of(parts);
    OrtEngine::with_options(&Bundle::parse(&bytes).unwrap(), &OrtOptions::default())
}

#[test]
fn it_computes_what_tract_computes_however_inputs_get_there() {
    let Some(library) = library() else { return };
    println!(
        "ONNX Runtime {}, {:?}, {}",
        library.version(),
        library.providers(),
        library.path().display()
    );
    let boxes = probe::default_boxes(&SPEC);
    let section = probe::capture(&mut load(&parts()).unwrap(), &boxes).unwrap();
    let probe = probe::Probe::parse(&section, &SPEC).unwrap();
    let bytes = bundle_of(&parts());
    let bundle = Bundle::parse(&bytes).unwrap();
    for optimisation in Optimisation::ALL {
        let options = OrtOptions { threads: 2, optimisation, ..OrtOptions::default() };
        let loader = Loader { library, bundle: &bundle, options: &options, cache: None };
        // The road of a GPU, inputs bound before each run, gives the same on the processor.
        for upload in [false, true] {
            let mut engine = OrtEngine::assemble(&loader, upload).unwrap();
            for _ in 0..2 {
                let report = probe::run(&mut engine, &probe).unwrap();
                assert!(report.max() < 1e-5, "{optimisation:?}, {upload}: {}", report.max());
            }
        }
    }
}

#[test]
fn providers_that_the_library_lacks_are_refused_by_name() {
    let Some(library) = library() else { return };
    let bytes = bundle_of(&parts());
    let bundle = Bundle::parse(&bytes).unwrap();
    for provider in [Provider::Cuda, Provider::TensorRt] {
        if library.providers().contains(&provider.runtime_name()) {
            println!("skipped: this library has {}", provider.runtime_name());
            continue;
        }
        let options = OrtOptions { provider, ..OrtOptions::default() };
        let error = OrtEngine::with_options(&bundle, &options).unwrap_err();
        assert!(error.is_absent() && !error.is_unasked());
        let text = error.to_string();
        println!("{text}");
        for part in [
            provider.runtime_name(),
            "CPUExecutionProvider",
            library.version(),
            library.path().to_str().unwrap(),
            "fetch_onnxruntime.sh --gpu",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }
}

#[test]
fn calls_out_of_order_are_errors() {
    if library().is_none() {
        return;
    }
    let mut engine = open(&parts()).unwrap();
    assert_eq!(engine.name(), "ort");
    let message = |e: EngineError| e.to_string();
    assert!(message(engine.predict(1).unwrap_err()).contains("features"));
    assert!(message(engine.write_template(0).unwrap_err()).contains("features"));
    engine.features().unwrap();
    assert!(message(engine.predict(1).unwrap_err()).contains("slot 0 was never written"));
    assert!(message(engine.write_template(2).unwrap_err()).contains("slot 2"));
    for filled in [0, 3] {
        assert!(message(engine.predict(filled).unwrap_err()).contains("1 to 2"));
    }
    engine.write_template(0).unwrap();
    engine.predict(1).unwrap();
    assert!(message(engine.predict(2).unwrap_err()).contains("slot 1 was never written"));
}

#[test]
fn what_is_wrong_with_a_bundle_is_named() {
    if library().is_none() {
        return;
    }
    let with = |at: usize, bytes: Vec<u8>| {
        let mut parts = parts();
        parts[at].1 = bytes;
        let error = open(&parts).unwrap_err();
        assert!(!error.is_absent(), "{error}");
        error.to_string()
    };
    let far = features_with(external("64", "999999")).encode_to_vec();
    let swapped = parts()[3].1.clone();
    for (message, wants) in [
        (with(0, b"\xff\xff".to_vec()), &["features.onnx"][..]),
        (with(0, far), &["features.onnx", "`kernel`", "outside"]),
        (with(2, swapped), &["predict1.onnx", "input"]),
    ] {
        assert!(wants.iter().all(|want| message.contains(want)), "{message}");
    }
}

#[test]
fn options_that_do_not_go_together_are_refused_before_anything_is_loaded() {
    let bytes = bundle_of(&parts());
    let options = OrtOptions { fp16: true, ..OrtOptions::default() };
    let error = OrtEngine::with_options(&Bundle::parse(&bytes).unwrap(), &options).unwrap_err();
    assert!(matches!(&error, OrtError::Options(text) if text.contains("fp16")), "{error}");
}

#[test]
fn two_trainings_of_one_network_do_not_share_cached_engines() {
    let dir = std::env::temp_dir().join(format!("tsda-ort-cache-{}", std::process::id()));
    let folder = |weights: Option<Vec<u8>>, fp16: bool| {
        let mut parts = parts();
        if let Some(weights) = weights {
            parts[4].1 = weights;
        }
        let bytes = bundle_of(&parts);
        let cache = Some(dir.clone());
        let options =
            OrtOptions { cache, fp16, provider: Provider::TensorRt, ..OrtOptions::default() };
        cache_folder(&Bundle::parse(&bytes).unwrap(), &options).unwrap().unwrap()
    };
    let first = folder(None, false);
    assert!(first.is_dir());
    assert_eq!(folder(None, false), first);
    assert_ne!(folder(None, true), first);
    assert_ne!(folder(Some(vec![1; 64]), false), first);
    std::fs::remove_dir_all(&dir).unwrap();
}
