//! Engines by name, and what the program says when one is not there.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// Runs the program with this library for ONNX Runtime; without one, none is named.
fn tsda(dir: &Path, library: Option<&str>, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tsda"));
    command.args(args).current_dir(dir).env_remove("TSDA_ORT_LIB").env_remove("ORT_DYLIB_PATH");
    if let Some(library) = library {
        command.env("TSDA_ORT_LIB", library);
    }
    command.output().expect("the program starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The library the tests were given.
#[cfg(feature = "ort")]
fn library() -> Option<String> {
    let library = std::env::var("TSDA_ORT_LIB").ok().filter(|l| !l.is_empty());
    if library.is_none() {
        println!("skipped: TSDA_ORT_LIB names no ONNX Runtime library");
    }
    library
}

#[test]
fn unknown_engines_and_threads_are_refused() {
    let dir = tempfile::tempdir().expect("temp");
    for (args, words) in [
        (&["demo", "--engine", "abacus"][..], &["`abacus`", "tract"][..]),
        (&["demo", "--engine", "tract,fast"], &["`fast`", "pool=MIB"]),
        (&["demo", "--engine", "tract", "--threads", "2"], &["--threads 2", "one thread"]),
        (&["verify", "--engine", "ort:gpu"], &["ort:gpu"]),
    ] {
        let output = tsda(dir.path(), None, args);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
        assert!(words.iter().all(|w| message.contains(w)), "{args:?}: {message}");
        assert_eq!(fs::read_dir(dir.path()).expect("folder").count(), 0, "{args:?}");
    }
}

#[cfg(feature = "ort")]
#[test]
fn a_library_that_is_not_there_does_not_hide_the_other_engines() {
    let dir = tempfile::tempdir().expect("temp");
    // Nobody asked for ONNX Runtime: a remark. On a machine that has it in its system folders it is
    // simply checked.
    let output = tsda(dir.path(), None, &["verify"]);
    let shown = text(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{shown}");
    assert!(
        shown.contains("ort      not checked: no ONNX Runtime library")
            || shown.contains("ort: ok")
    );

    // Somebody did: tract's figures come first, then the message, and the code says so.
    let output = tsda(dir.path(), Some("absent.so"), &["verify"]);
    let (shown, message) = (text(&output.stdout), text(&output.stderr));
    assert_eq!(output.status.code(), Some(2), "{shown}{message}");
    let (tract, ort) = (shown.find("tract    "), shown.find("ort      FAILED"));
    assert!(tract.is_some() && tract < ort, "{shown}");
    assert_eq!(message.lines().count(), 1, "{message}");
    for word in ["absent.so", "TSDA_ORT_LIB", "fetch_onnxruntime.sh"] {
        assert!(message.contains(word), "{word}: {message}");
    }

    let output = tsda(dir.path(), Some("absent.so"), &["demo", "--engine", "ort", "--out", "r"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(!dir.path().join("r").exists(), "nothing is made for an engine that is not there");
}

#[cfg(feature = "ort")]
#[test]
fn a_provider_that_the_library_lacks_is_named_with_what_it_has() {
    let Some(library) = library() else { return };
    let dir = tempfile::tempdir().expect("temp");
    let about = text(&tsda(dir.path(), Some(&library), &["info", "--engine", "ort"]).stdout);
    assert!(about.contains("ONNX Runtime") && about.contains("CPUExecutionProvider"), "{about}");
    for graph in ["features", "template", "predict1"] {
        assert!(about.contains(&format!("  {graph:<10} ")), "{graph}: {about}");
    }
    if about.contains("CUDAExecutionProvider") {
        println!("skipped: this library has CUDA");
        return;
    }
    for (engine, provider) in
        [("ort:cuda", "CUDAExecutionProvider"), ("ort:tensorrt,fp16", "TensorrtExecutionProvider")]
    {
        let output = tsda(dir.path(), Some(&library), &["verify", "--engine", engine]);
        let message = text(&output.stderr);
        println!("{message}");
        assert_eq!(output.status.code(), Some(2), "{message}");
        for word in [provider, "only", "CPUExecutionProvider", "fetch_onnxruntime.sh --gpu"] {
            assert!(message.contains(word), "{word}: {message}");
        }
    }
}

#[cfg(feature = "ort")]
#[test]
fn both_engines_track_the_same_boxes() {
    use tsda_host::picture::Picture;
    use tsda_host::render::{Clip, ClipConfig};
    use tsda_runtime::Modality;
    let Some(library) = library() else { return };
    let dir = tempfile::tempdir().expect("temp");
    let clip = Clip::new(ClipConfig::default());
    let mut list = String::new();
    for i in 0..10 {
        let modality = if i < 5 { Modality::Rgb } else { Modality::Thermal };
        let mut p = Picture::default();
        clip.render(i, modality, &mut p);
        let colour = if p.channels == 1 { image::ColorType::L8 } else { image::ColorType::Rgb8 };
        let (w, h) = (p.width as u32, p.height as u32);
        let name = format!("{i}.png");
        image::save_buffer(dir.path().join(&name), &p.data, w, h, colour).expect("png");
        list += &format!("{name}\t{modality}\n");
    }
    fs::write(dir.path().join("clip.txt"), list).expect("write");
    let first = clip.truth(0);
    let init = format!("{},{},{},{}", first.x, first.y, first.w, first.h);
    let boxes = |engine: &[&str]| -> Vec<f32> {
        let args = ["track", "--frames", "clip.txt", "--init", &init, "--out", "boxes.txt"];
        let output = tsda(dir.path(), Some(&library), &[&args[..], engine].concat());
        assert!(output.status.success(), "{engine:?}: {}", text(&output.stderr));
        let text = fs::read_to_string(dir.path().join("boxes.txt")).expect("boxes");
        text.split([',', '\n']).filter_map(|n| n.parse().ok()).collect()
    };
    let tract = boxes(&[]);
    assert_eq!(tract.len(), 40);
    for engine in [&["--engine", "ort"][..], &["--engine", "ort,opt=basic", "--threads", "2"]] {
        for (a, b) in boxes(engine).iter().zip(&tract) {
            assert!((a - b).abs() <= 0.02, "{engine:?}: {a} and {b}");
        }
    }
}
