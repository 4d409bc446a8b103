use super::*;
use crate::tables::{csv, markdown};
use Modality::{Rgb, Thermal};
use serde_json::Value;

const T: Row = [10.0, 10.0, 20.0, 20.0];
const FAR: Row = [200.0, 200.0, 20.0, 20.0];

fn options() -> DataOptions {
    DataOptions { hold: 2, frames: true, ..DataOptions::default() }
}

fn sequence(predicted: &[Row], modalities: &[Modality]) -> SequenceData {
    let truth = vec![T; predicted.len()];
    SequenceData::of(Truth::one(&truth), predicted, Some(modalities), options()).unwrap()
}

fn report() -> ReportData {
    let mut attributes = Attributes::default();
    attributes.insert("a", "OCC");
    attributes.insert("b", "OCC");
    attributes.insert("b", "LI,x");
    let once = [Rgb, Thermal, Thermal, Thermal];
    let never = [Rgb; 4];
    let good = [("a", sequence(&[T; 4], &once)), ("b", sequence(&[T; 4], &never))];
    let bad = [("a", sequence(&[T, FAR, T, T], &once)), ("b", sequence(&[T, T, FAR, FAR], &never))];
    let tracker = |name: &str, list: [(&str, SequenceData); 2]| {
        let sequences = list.into_iter().map(|(n, s)| (n.to_owned(), s)).collect();
        TrackerData::of(name, sequences, &attributes, options())
    };
    let mut report = ReportData::new("set|1", Convention::Tsda, 2);
    let left_out = vec![LeftOut {
        sequence: "c".into(),
        tracker: Some("bad".into()),
        reason: "no result".into(),
    }];
    let trackers = vec![tracker("good", good), tracker("bad", bad)];
    let protocol = Some("switch:20".to_owned());
    report.protocols.push(ProtocolData::new(Convention::Tsda, protocol, trackers, left_out));
    report
}

#[test]
fn groups_and_recovery() {
    let report = report();
    let protocol = &report.protocols[0];
    assert_eq!(protocol.sequences, ["a", "b"]);
    let bad = &protocol.trackers[1];
    assert!((bad.overall.figures.scores.sr50 - 0.5).abs() < 1e-12);
    let names: Vec<&str> = bad.attributes.iter().map(|g| g.group.as_str()).collect();
    assert_eq!(names, ["LI,x", "OCC"]);
    assert_eq!((bad.attributes[1].sequences, bad.attributes[0].sequences), (2, 1));
    assert!((bad.attributes[0].figures.scores.sr50 - 1.0 / 3.0).abs() < 1e-12);
    let names: Vec<&str> = bad.switches.iter().map(|g| g.group.as_str()).collect();
    assert_eq!(names, ["0", "1"]);
    assert!((bad.switches[1].figures.scores.sr50 - 2.0 / 3.0).abs() < 1e-12);
    assert_eq!(bad.switches[0].recovery, None);
    let recovery = bad.recovery.unwrap();
    assert_eq!((recovery.switches, recovery.mean_frames), (1, Some(1.0)));
    assert_eq!(bad.sequences["a"].switches, Some(1));
    assert_eq!(bad.sequences["a"].iou, [Some(1.0), Some(0.0), Some(1.0), Some(1.0)]);
    assert_eq!(protocol.best["sr50"], ["good"]);
}

#[test]
fn json_comes_back() {
    let report = report();
    let text = serde_json::to_string(&report).unwrap();
    // Through text the last bit of a figure may change; six decimals may not.
    let back: ReportData = serde_json::from_str(&text).unwrap();
    assert_eq!(csv(&back), csv(&report));
    assert_eq!(markdown(&back), markdown(&report));
    assert_eq!(back.protocols[0].left_out, report.protocols[0].left_out);
    let recoveries = |r: &ReportData| r.protocols[0].trackers[1].sequences["a"].recoveries.clone();
    assert_eq!(recoveries(&back), recoveries(&report));
    let v: Value = serde_json::from_str(&text).unwrap();
    let tracker = &v["protocols"][0]["trackers"][0];
    assert_eq!(v["convention"], "tsda");
    assert_eq!(v["thresholds"]["success"].as_array().unwrap().len(), 21);
    assert_eq!(tracker["overall"]["sr50"], 1.0);
    assert_eq!(tracker["overall"]["curves"]["precision"].as_array().unwrap().len(), 51);
    assert_eq!(tracker["sequences"]["a"]["attributes"][0], "OCC");
}

#[test]
fn the_tables_mark_the_best() {
    let text = markdown(&report());
    for line in [
        "| good | **100.0** | **95.2** | **100.0** | **100.0** | **100.0** | 2 | 6 |",
        "| OCC | bad | 50.0 | 47.6 | 50.0 | 50.0 | 50.0 | 2 |",
        "| 1 | bad | 66.7 | 63.5 | 66.7 | 66.7 | 66.7 | 1 |",
        "| bad | 1 | 100.0 | 0.0 | 1.0 | 1.0 |",
        "- c (bad): no result",
    ] {
        assert!(text.contains(line), "no {line} in\n{text}");
    }
    for table in text.split("\n\n") {
        let bars = |l: &str| l.replace("\\|", "").matches('|').count();
        let counts: BTreeSet<usize> =
            table.lines().filter(|l| l.starts_with('|')).map(bars).collect();
        assert!(counts.len() <= 1, "{table}");
    }

    let text = csv(&report());
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[0].split(',').next_back(), Some("best"));
    // 2 trackers x (overall + 2 attributes + 2 groups of switches + 2 sequences).
    assert_eq!(lines.len(), 1 + 2 * 7);
    assert!(lines[1].starts_with("switch:20,overall,,good,2,6,1.000000,0.952381,"), "{}", lines[1]);
    assert!(lines[1].ends_with(",1,1,0,0,auc mean_iou npr pr20 sr50"), "{}", lines[1]);
    assert!(lines[2].ends_with(",1,1,1,1,"), "{}", lines[2]);
    assert!(text.contains("attribute,\"LI,x\",good"), "{text}");
}

#[test]
fn many_switches_share_groups() {
    for (n, name) in [(0, "0"), (3, "3"), (4, "4-7"), (7, "4-7"), (8, "8-15"), (40, "32-63")] {
        assert_eq!(switch_group(n).1, name);
    }
}

#[test]
fn repetitions_count_as_one_result() {
    let m = [Rgb, Thermal, Thermal, Thermal];
    let merged =
        SequenceData::merge(vec![sequence(&[T; 4], &m), sequence(&[T, FAR, FAR, FAR], &m)]);
    assert_eq!(merged.score.figures.scores.frames, 6);
    assert!((merged.score.figures.scores.sr50 - 0.5).abs() < 1e-12);
    assert_eq!((merged.switches, merged.recoveries.len()), (Some(1), 2));
    assert_eq!(SequenceData::merge(Vec::new()), SequenceData::default());
}

#[test]
fn an_evaluation_becomes_data() {
    use crate::protocol::{Protocol, SequenceResult};
    use tsda_runtime::BBox;
    let b = BBox::new(10.0, 10.0, 20.0, 20.0);
    let result = SequenceResult {
        sequence: "a".into(),
        target: 0,
        start: 0,
        modalities: vec![Rgb, Thermal, Thermal, Thermal],
        truth: vec![Some(b), None, Some(b), Some(b)],
        predicted: vec![b; 4],
        confidence: vec![1.0; 4],
        milliseconds: vec![9000.0, 500.0, 250.0, 750.0],
    };
    let scores = result.scores(Default::default()).unwrap();
    let evaluation = Evaluation {
        tracker: "x".into(),
        dataset: "d".into(),
        protocol: Protocol::RgbToThermal,
        first_frame: Default::default(),
        results: vec![result],
        scores: vec![scores],
        skipped: Vec::new(),
        failed: Vec::new(),
    };
    let data = TrackerData::of_evaluation(&evaluation, &Attributes::default(), options()).unwrap();
    assert_eq!((data.tracker.as_str(), data.fps), ("x", Some(2.0)));
    assert_eq!(data.overall.figures.scores, scores);
    assert_eq!(data.recovery.map(|r| r.switches), Some(1));
    let two = DataOptions { convention: Convention::Gtot, ..options() };
    assert!(TrackerData::of_evaluation(&evaluation, &Attributes::default(), two).is_err());

    use crate::truth::{SequenceTruth, TruthSet};
    let visible = vec![T, [0.0; 4], T, T];
    let one = SequenceTruth { name: "a".into(), visible, ..SequenceTruth::default() };
    let mut truth = TruthSet { sequences: vec![one], ..TruthSet::default() };
    let none = Attributes::default();
    let of_run = |truth: &TruthSet| {
        let file = |label: &str| Some(format!("x/{label}.json"));
        TrackerData::of_run(&evaluation, truth, &none, options(), &file)
    };
    let (same, left_out) = of_run(&truth).unwrap();
    assert_eq!((same.overall, same.fps, left_out), (data.overall, data.fps, vec![]));
    assert_eq!(same.scores.map(|s| (s.on_target[19], s.absent[19])), Some((2, 1)));
    assert_eq!(same.latencies_ms.map(|l| l.p50), Some(500.0));
    let a = &same.sequences["a"];
    assert_eq!(
        (a.record.as_deref(), a.mean_score, a.fps),
        (Some("x/a.json"), Some(1.0), Some(2.0))
    );
    truth.sequences[0].visible.pop();
    assert!(of_run(&truth).unwrap_err().to_string().starts_with("sequence a: 4 predicted"));
    truth.sequences.clear();
    let (empty, left_out) = of_run(&truth).unwrap();
    assert_eq!((empty.sequences.len(), left_out[0].sequence.as_str()), (0, "a"));
}
