use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::sync::atomic::AtomicUsize;

use super::*;
use crate::attributes::Attributes;
use crate::baselines::{MatchOn, TemplateMatcher};
use crate::dataset::Picture;
use crate::dataset::testing::{open, text};
use crate::metrics::Convention;
use crate::report_data::DataOptions;
use crate::run_summary::{RunContext, sum_up};
use crate::store::{ResultStore, RunManifest, STORE_VERSION};
use tsda_runtime::{BBox, Modality};

const FRAMES: usize = 12;

/// GTOT folders: a bright square on texture that moves one pixel per frame.
fn write_gtot(root: &Path, names: &[&str]) {
    for (n, name) in names.iter().enumerate() {
        let (mut boxes, mut init) = (String::new(), String::new());
        for (folder, bright) in [("v", 220u8), ("i", 180)] {
            fs::create_dir_all(root.join(name).join(folder)).unwrap();
            for i in 0..FRAMES {
                let left = 12 + i as u32 + 2 * n as u32;
                let picture = image::GrayImage::from_fn(64, 48, |x, y| {
                    let inside = (left..left + 10).contains(&x) && (14..24).contains(&y);
                    image::Luma([if inside { bright } else { (x * 3 + y * 5 % 17) as u8 / 2 }])
                });
                picture.save(root.join(name).join(format!("{folder}/{i:05}.png"))).unwrap();
            }
        }
        for i in 0..FRAMES {
            let left = 12 + i + 2 * n;
            boxes += &format!("{left} 14 {} 24\n", left + 10);
            init += &format!("{left}\t14\t10\t10\n");
        }
        text(root.join(name).join("groundTruth_v.txt"), &boxes);
        text(root.join(name).join("groundTruth_i.txt"), &boxes);
        text(root.join(name).join("init.txt"), &init);
    }
}

fn store(folder: &Path, data: &Dataset, protocol: Protocol) -> ResultStore {
    let manifest = RunManifest {
        version: STORE_VERSION,
        program: "0".into(),
        tracker: "matcher".into(),
        model: "m".into(),
        engine: String::new(),
        settings: String::new(),
        dataset: data.name.clone(),
        dataset_hash: crate::fingerprint::of_dataset(data),
        protocol: protocol.to_string(),
    };
    let sequences = data.sequences.iter().map(|s| (s.id(), s.targets()));
    let store = ResultStore::plan(folder.to_owned(), manifest, sequences, false).unwrap();
    store.prepare(false).unwrap();
    store
}

/// Template matching that can be told to go wrong; counts the sequences it starts.
struct Matcher<'a> {
    inner: TemplateMatcher,
    started: &'a AtomicUsize,
    wrong: Option<(usize, &'static str)>,
    /// Is this the second sequence, the one to go wrong in?
    second: bool,
    frame: usize,
}

impl TrackerUnderTest for Matcher<'_> {
    fn name(&self) -> &str {
        "matcher"
    }
    fn init(&mut self, p: &Picture, b: BBox, m: Modality) -> Result<(), TrackerError> {
        self.started.fetch_add(1, Ordering::Relaxed);
        self.frame = 0;
        self.second = b.x == 14.0;
        self.inner.init(p, b, m)
    }
    fn update(&mut self, p: &Picture, m: Modality) -> Result<(BBox, f32), TrackerError> {
        self.frame += 1;
        match self.wrong.filter(|_| self.second) {
            Some((frame, "panic")) if frame == self.frame => panic!("index out of bounds"),
            Some((frame, why)) if frame == self.frame => Err(TrackerError::new(why)),
            _ => self.inner.update(p, m),
        }
    }
}

struct Nothing;
impl Observer for Nothing {}

/// A matcher lives as long as the program: counters are leaked, tests are few.
fn maker(
    wrong: Option<(usize, &'static str)>,
) -> (&'static AtomicUsize, Box<MakeTracker<'static>>) {
    let started: &'static AtomicUsize = Box::leak(Box::default());
    let make = move || -> Result<Box<dyn TrackerUnderTest>, TrackerError> {
        let inner = TemplateMatcher::new(MatchOn::Grey);
        Ok(Box::new(Matcher { inner, started, wrong, second: false, frame: 0 }))
    };
    (started, Box::new(make))
}

/// Everything but times.
fn essence(evaluation: &Evaluation) -> String {
    let results: Vec<_> = evaluation
        .results
        .iter()
        .map(|r| (r.label(), r.start, &r.modalities, &r.truth, &r.predicted, &r.confidence))
        .collect();
    format!("{results:?} {:?} {:?}", evaluation.scores, evaluation.failed)
}

const SWITCH: Protocol = Protocol::Switch { every: 4 };

#[test]
fn jobs_and_interruptions_change_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    write_gtot(&at("set"), &["a", "b", "c", "d", "e"]);
    let data = open("gtot", &at("set"), "").unwrap();
    let options = |threads| Options { threads, ..Options::default() };

    let (_, make) = maker(None);
    let single = store(&at("one"), &data, SWITCH);
    let one = evaluate_all(&data, SWITCH, &*make, options(1), Some(&single), &Nothing).unwrap();
    assert_eq!((one.results.len(), one.tracker.as_str()), (5, "matcher"));
    assert!(one.scores.iter().all(|s| s.frames == FRAMES - 1 && s.mean_iou > 0.3), "{one:?}");

    let many = store(&at("many"), &data, SWITCH);
    let four = evaluate_all(&data, SWITCH, &*make, options(4), Some(&many), &Nothing).unwrap();
    assert_eq!(essence(&four), essence(&one));
    for name in ["a.txt", "e.txt", "c_modality.txt"] {
        assert_eq!(
            fs::read(at("one").join(name)).unwrap(),
            fs::read(at("many").join(name)).unwrap()
        );
    }

    /// Asks to stop once two sequences are done.
    #[derive(Default)]
    struct StopAfterTwo(AtomicUsize, AtomicUsize);
    impl Observer for StopAfterTwo {
        fn planned(&self, all: Extent, kept: Extent) {
            assert_eq!(all, Extent { targets: 5, frames: 5 * FRAMES });
            self.1.store(kept.frames, Ordering::Relaxed);
        }
        fn finished(&self, _: Progress<'_>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
        fn stop(&self) -> bool {
            self.0.load(Ordering::Relaxed) == 2
        }
    }
    let parts = store(&at("parts"), &data, SWITCH);
    let e = evaluate_all(&data, SWITCH, &*make, options(1), Some(&parts), &StopAfterTwo::default());
    let e = e.unwrap_err().to_string();
    assert_eq!(e, "interrupted: 2 of 5 sequences of protocol switch:4 are finished");
    assert!(at("parts/b.json").is_file() && !at("parts/c.json").exists());

    let (started, make) = maker(None);
    let parts = store(&at("parts"), &data, SWITCH);
    let again = evaluate_all(&data, SWITCH, &*make, options(2), Some(&parts), &Nothing).unwrap();
    assert_eq!((started.load(Ordering::Relaxed), essence(&again)), (3, essence(&one)));
    // All there: no tracker is needed any more.
    let no_tracker = || Err(TrackerError::new("none"));
    let whole = StopAfterTwo::default();
    let kept = evaluate_all(&data, SWITCH, &no_tracker, options(2), Some(&parts), &whole).unwrap();
    assert_eq!((whole.1.into_inner(), essence(&kept)), (5 * FRAMES, essence(&one)));
    assert!(evaluate_all(&data, SWITCH, &no_tracker, options(2), None, &Nothing).is_err());
}

#[test]
fn what_fails_is_named_and_the_rest_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    write_gtot(&root, &["a", "b", "c"]);
    fs::write(root.join("a/i/00003.png"), "no picture").unwrap();
    let data = open("gtot", &root, "").unwrap();
    for (wrong, words) in [
        ((4, "out of memory"), "matcher on sequence b, frame 4: out of memory"),
        ((4, "panic"), "sequence b: panicked: index out of bounds"),
    ] {
        let (started, make) = maker(Some(wrong));
        let options = Options { threads: 2, ..Options::default() };
        let run = evaluate_all(&data, Protocol::RgbToThermal, &*make, options, None, &Nothing);
        let run = run.unwrap();
        assert_eq!(started.load(Ordering::Relaxed), 3);
        assert_eq!(run.results.iter().map(SequenceResult::label).collect::<Vec<_>>(), ["c"]);
        let [a, b] = run.failed.as_slice() else { panic!("{:?}", run.failed) };
        assert_eq!((a.sequence.as_str(), a.frame), ("a", Some(3)));
        assert!(a.path.as_deref().is_some_and(|p| p.ends_with("a/i/00003.png")), "{a:?}");
        assert!(a.reason.starts_with("sequence a, frame 3: cannot decode picture"), "{a:?}");
        assert_eq!((b.sequence.as_str(), b.reason.as_str()), ("b", words));
    }
    // The RGB pictures are fine.
    let (_, make) = maker(None);
    let options = Options::default();
    let rgb = evaluate_all(&data, Protocol::Rgb, &*make, options, None, &Nothing).unwrap();
    assert_eq!((rgb.results.len(), rgb.failed.len()), (3, 0));
    let e = evaluate(&data, Protocol::Thermal, &*make, options, &|_| {}).unwrap_err().to_string();
    assert!(e.contains("00003.png"), "{e}");
}

#[test]
fn a_failure_of_one_tracker_leaves_the_target_out_for_all() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("set");
    write_gtot(&root, &["a", "b", "c"]);
    let data = open("gtot", &root, "").unwrap();
    let run = |wrong, protocol| {
        let (_, make) = maker(wrong);
        evaluate_all(&data, protocol, &*make, Options::default(), None, &Nothing).unwrap()
    };
    let name = |mut e: Evaluation| {
        e.tracker = "other".into();
        e
    };
    let first = vec![run(Some((2, "gone")), SWITCH), run(None, Protocol::Rgb)];
    let second = vec![name(run(None, SWITCH)), name(run(None, Protocol::Rgb))];
    let options = DataOptions { convention: Convention::Gtot, ..DataOptions::default() };
    let record = |t: &str, p: &str, l: &str| Some(format!("{t}/{p}/{l}.json"));
    let context = RunContext { jobs: 3, ..RunContext::default() };
    let (summary, report) = sum_up(&data, vec![first, second], options, context, &record).unwrap();

    let switch = &summary.main.protocols["switch:4"];
    assert_eq!((switch.sequences, switch.failed[0].sequence.as_str()), (2, "b"));
    let other = &summary.baselines[0].protocols["switch:4"];
    assert_eq!((other.sequences, other.failed.len()), (2, 0));
    assert_eq!(other.left_out[0].tracker.as_deref(), Some("matcher"));
    assert_eq!((summary.failures, summary.jobs, summary.any_result()), (1, 3, true));
    assert_eq!(summary.baselines[0].protocols["rgb"].sequences, 3);
    // GTOT's own figures: the first frame counts, 5 px.
    let gtot = switch.benchmark.unwrap();
    assert_eq!(gtot.figures.scores.frames, 2 * FRAMES);
    assert_eq!((gtot.mpr, gtot.msr), (gtot.figures.pr5, Some(gtot.figures.scores.auc)));
    assert!(gtot.mpr > Some(0.3), "{gtot:?}");
    assert_eq!(switch.mean.frames, 2 * (FRAMES - 1));
    let groups: Vec<&str> = switch.switches.iter().map(|g| g.group.as_str()).collect();
    assert_eq!(groups, ["3"]);
    // Four frames to a switch are fewer than the five that make a recovery.
    assert_eq!(switch.recovery, None);
    assert!(switch.fps.is_some_and(|fps| fps > 0.0));

    let data = &report.protocols[0];
    assert_eq!((data.protocol.as_deref(), data.sequences.len()), (Some("switch:4"), 2));
    assert_eq!(data.left_out.len(), 1);
    let tracker = &data.trackers[1];
    assert_eq!(tracker.sequences["c"].record.as_deref(), Some("other/switch:4/c.json"));
    assert_eq!(tracker.latencies_ms.as_ref().unwrap().frames, 2 * (FRAMES as u64 - 1));
    let json = serde_json::to_value(&summary).unwrap();
    assert_eq!(json["protocols"]["switch:4"]["sequences"], 2);
    assert_eq!(json["tracker"], "matcher");
}

#[test]
fn what_a_protocol_cannot_run_on_is_skipped_with_a_reason() {
    let dir = tempfile::tempdir().unwrap();
    let picture = image::GrayImage::new(8, 8);
    for (name, folders, boxes) in [
        ("both", &["visible", "infrared"][..], "1,1,4,4\n1,1,4,4\n"),
        ("late", &["visible", "infrared"], "0,0,0,0\n1,1,4,4\n"),
        ("gone", &["visible", "infrared"], "0,0,0,0\n0,0,0,0\n"),
        ("rgb", &["visible"], "1,1,4,4\n1,1,4,4\n"),
    ] {
        for folder in folders {
            let folder_path = dir.path().join(name).join(folder);
            fs::create_dir_all(&folder_path).unwrap();
            for i in 0..2 {
                picture.save(folder_path.join(format!("{i}.png"))).unwrap();
            }
            text(dir.path().join(name).join(format!("{folder}.txt")), boxes);
        }
    }
    let data = open("sequences", dir.path(), "").unwrap();
    let (_, make) = maker(None);
    let protocol = Protocol::RgbToThermal;
    let run = evaluate_all(&data, protocol, &*make, Options::default(), None, &Nothing).unwrap();
    let labels: BTreeSet<String> = run.results.iter().map(SequenceResult::label).collect();
    assert_eq!(labels, BTreeSet::from(["both".to_owned(), "late".to_owned()]));
    let late = run.results.iter().find(|r| r.sequence == "late").unwrap();
    assert_eq!((late.start, late.predicted.len()), (1, 1));
    let reasons: Vec<(&str, &str)> =
        run.skipped.iter().map(|s| (s.sequence.as_str(), s.reason.as_str())).collect();
    assert_eq!(reasons, [("gone", "no rgb box to start from"), ("rgb", "no thermal frames")]);
    assert!(can_run(&data, protocol) && Attributes::of_dataset(&data).is_empty());
}
