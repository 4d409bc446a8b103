use std::fs;

use super::*;
use crate::dataset::testing::{open, pictures, text};
use crate::fingerprint;

fn manifest() -> RunManifest {
    RunManifest {
        version: STORE_VERSION,
        program: "1".into(),
        tracker: "t".into(),
        model: "00ff".into(),
        engine: "tract".into(),
        settings: String::new(),
        dataset: "gtot:here".into(),
        dataset_hash: "abcd".into(),
        protocol: "rgb2t".into(),
    }
}

fn plan(folder: &Path, manifest: RunManifest, fresh: bool) -> Result<ResultStore, StoreError> {
    ResultStore::plan(folder.to_owned(), manifest, [("s", 2)], fresh)
}

#[test]
fn results_of_another_run_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    plan(dir.path(), manifest(), false).unwrap().prepare(false).unwrap();
    let moved = RunManifest { dataset: "gtot:there".into(), ..manifest() };
    assert!(plan(dir.path(), moved, false).is_ok(), "folders may move");
    for (other, words) in [
        (RunManifest { model: "11".into(), ..manifest() }, "bundle 00ff, now 11"),
        (RunManifest { engine: "ort".into(), ..manifest() }, "engine tract, now ort"),
        (RunManifest { dataset_hash: "x".into(), ..manifest() }, "dataset contents abcd, now x"),
        (RunManifest { protocol: "rgb".into(), ..manifest() }, "protocol rgb2t, now rgb"),
        (RunManifest { settings: "a=1".into(), ..manifest() }, "settings none, now a=1"),
        (RunManifest { program: "2".into(), ..manifest() }, "program version 1, now 2"),
        (RunManifest { version: 9, ..manifest() }, "version of the files 1, now 9"),
    ] {
        let e = plan(dir.path(), other.clone(), false).unwrap_err().to_string();
        assert!(e.contains(words) && e.contains("--fresh") && e.contains("run.json"), "{e}");
        assert!(plan(dir.path(), other, true).is_ok());
    }
    fs::write(dir.path().join("run.json"), "{\n  \"version\": x").unwrap();
    let e = plan(dir.path(), manifest(), false).unwrap_err().to_string();
    assert!(e.contains("run.json, line 2") && e.contains("--fresh"), "{e}");
}

#[test]
fn a_result_comes_back_to_the_last_bit() {
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("set/s");
    pictures(&own.join("visible"), &["1.png", "2.png", "3.png"]);
    text(own.join("visible.txt"), "0,0,0,0\n1,1,2,2\n1,1,2,2\n");
    let data = open("sequences", &dir.path().join("set"), "").unwrap();
    let sequence = data.sequences[0].as_ref();
    let results = dir.path().join("out");
    let store = plan(&results, manifest(), false).unwrap();
    store.prepare(false).unwrap();
    let saved = SequenceResult {
        sequence: "s".into(),
        target: 0,
        start: 1,
        modalities: vec![Modality::Rgb; 2],
        truth: vec![Some(BBox::new(1.0, 1.0, 2.0, 2.0)); 2],
        predicted: vec![BBox::new(1.0, 1.0, 2.0, 2.0), BBox::new(0.1, f32::NAN, 1.0 / 3.0, 1e-7)],
        confidence: vec![1.0, f32::NAN],
        milliseconds: vec![1.5, 0.1],
    };
    assert!(store.load(sequence, 0, Protocol::Rgb).is_none());
    store.save(&saved).unwrap();
    let loaded = store.load(sequence, 0, Protocol::Rgb).unwrap();
    // NaN is no more equal to itself than in the original.
    assert_eq!(format!("{loaded:?}"), format!("{saved:?}"));
    assert_eq!(fs::read_to_string(results.join("s_modality.txt")).unwrap(), "rgb\nrgb\n");

    // What does not fit is not taken up.
    assert!(store.load(sequence, 0, Protocol::Thermal).is_none());
    assert!(store.load(sequence, 1, Protocol::Rgb).is_none());
    let json = fs::read_to_string(results.join("s.json")).unwrap();
    for (from, to) in [("\"start\":1", "\"start\":0"), ("[1.5,0.1]", "[1.5]"), ("{", "")] {
        fs::write(results.join("s.json"), json.replacen(from, to, 1)).unwrap();
        assert!(store.load(sequence, 0, Protocol::Rgb).is_none(), "{from}");
    }
    fs::write(results.join("s.json"), &json).unwrap();
    fs::write(results.join("notes.md"), "mine").unwrap();
    assert!(store.load(sequence, 0, Protocol::Rgb).is_some());
    store.prepare(true).unwrap();
    assert!(store.load(sequence, 0, Protocol::Rgb).is_none());
    let left: BTreeSet<String> = fs::read_dir(&results)
        .unwrap()
        .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    assert_eq!(left, BTreeSet::from(["notes.md".to_owned(), "run.json".to_owned()]));

    let hash = fingerprint::of_dataset(&data);
    text(own.join("visible.txt"), "0,0,0,0\n1,1,2,2\n1,1,2,3\n");
    let other = open("sequences", &dir.path().join("set"), "").unwrap();
    assert_ne!(fingerprint::of_dataset(&other), hash);
}

#[test]
fn no_two_sequences_share_a_file() {
    let labels = ["a b", "a_b", "A_B", "x", "x_modality", "run", "..", "é"].map(String::from);
    let stems = stems(labels.clone().into_iter());
    let of = |label: &str| stems[label].as_str();
    assert_eq!((of("a b"), of("a_b"), of("A_B")), ("a_b", "a_b~2", "A_B~3"));
    assert_eq!((of("x_modality"), of("run"), of("..")), ("x_modality~2", "run~2", "_.."));
    assert_eq!(stems.values().collect::<BTreeSet<_>>().len(), labels.len());
}
