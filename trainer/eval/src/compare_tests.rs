use super::*;
use crate::results::{write_got10k, write_otb};
use std::path::Path;
use tsda_runtime::{BBox, Modality};

const B: BBox = BBox::new(10.0, 10.0, 20.0, 20.0);
const FAR: BBox = BBox::new(200.0, 200.0, 20.0, 20.0);

/// Truth of three sequences of five frames; tracker `a` is perfect, `b` (GOT-10k layout, two
/// repetitions) loses the target in the second one, `c` (prefixed) lacks `s2` and half of `s1`.
fn workplace() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    for name in ["gt", "a", "b", "c"] {
        std::fs::create_dir(at(name)).unwrap();
    }
    let sensors =
        [Modality::Rgb, Modality::Thermal, Modality::Thermal, Modality::Rgb, Modality::Rgb];
    for s in ["s0", "s1", "s2"] {
        write_otb(&at("gt"), s, &[B; 5], None).unwrap();
        write_otb(&at("a"), s, &[B; 5], Some(&sensors)).unwrap();
        write_got10k(&at("b"), s, 1, &[B; 5], Some(&[0.1; 5])).unwrap();
        write_got10k(&at("b"), s, 2, &[B, FAR, FAR, FAR, FAR], None).unwrap();
    }
    write_otb(&at("c"), "C_s0", &[B; 5], None).unwrap();
    write_otb(&at("c"), "C_s1", &[B; 3], None).unwrap();
    dir
}

fn run(dir: &Path, trackers: &[&str], options: CompareOptions) -> Result<ReportData, CompareError> {
    let truth =
        TruthSet::read_folder(&dir.join("gt"), options.data.convention, None, None).unwrap();
    let folders: Vec<ResultFolder> =
        trackers.iter().map(|t| ResultFolder::open(&dir.join(t), None).unwrap()).collect();
    compare(&truth, &folders, &Attributes::default(), None, options)
}

#[test]
fn folders_of_any_layout_stand_side_by_side() {
    let dir = workplace();
    let report = run(dir.path(), &["a", "b"], CompareOptions::default()).unwrap();
    let protocol = &report.protocols[0];
    assert_eq!(protocol.sequences, ["s0", "s1", "s2"]);
    let [a, b] = &protocol.trackers[..] else { panic!() };
    let sr50 = |t: &TrackerData| t.overall.figures.scores.sr50;
    assert_eq!((sr50(a), sr50(b)), (1.0, 0.5));
    assert_eq!((a.switches.len(), b.switches.len()), (1, 0));
    assert_eq!((a.switches[0].group.as_str(), a.switches[0].sequences), ("2", 3));
    // Segments of two frames are too short for the default of five.
    assert_eq!(a.recovery, None);
}

#[test]
fn what_a_tracker_lacks_is_refused_or_left_out_for_all() {
    let dir = workplace();
    let e = run(dir.path(), &["a", "c"], CompareOptions::default()).unwrap_err();
    let text = e.to_string();
    for words in ["c: s1: 3 of 5 frames", "c: s2: no result", "--partial"] {
        assert!(text.contains(words), "{text}");
    }
    let partial = CompareOptions { partial: true, ..CompareOptions::default() };
    let report = run(dir.path(), &["a", "c"], partial).unwrap();
    let protocol = &report.protocols[0];
    assert_eq!(protocol.sequences, ["s0"]);
    assert!(protocol.trackers.iter().all(|t| t.sequences.len() == 1));
    let left: Vec<_> = protocol.left_out.iter().map(|l| l.sequence.as_str()).collect();
    assert_eq!(left, ["s1", "s2"]);

    std::fs::write(dir.path().join("c/C_s0.txt"), "1,1,1,1\n").unwrap();
    let e = run(dir.path(), &["a", "c"], partial).unwrap_err().to_string();
    assert!(e.contains("no sequence of") && e.contains("first box only"), "{e}");
}

#[test]
fn results_that_cannot_be_read_or_are_too_long_are_named() {
    let dir = workplace();
    let path = dir.path().join("a/s1.txt");
    std::fs::write(&path, "1,1,1,1\n1,1\n").unwrap();
    let e = run(dir.path(), &["a"], CompareOptions::default()).unwrap_err().to_string();
    assert!(e.contains("s1.txt, line 2"), "{e}");
    std::fs::write(&path, "1,1,1,1\n".repeat(6)).unwrap();
    let e = run(dir.path(), &["a"], CompareOptions::default()).unwrap_err().to_string();
    assert!(e.contains("s1.txt, line 6: 6 predicted boxes for 5 frames"), "{e}");
    let e = run(dir.path(), &["b", "b"], CompareOptions::default()).unwrap_err().to_string();
    assert!(e.contains("two trackers are named 'b'"), "{e}");
}
