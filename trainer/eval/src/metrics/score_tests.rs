use super::super::FirstFrame;
use super::super::overlap::vot_overlap;
use super::*;
use proptest::prelude::*;
use serde_json::Value;
use std::path::{Path, PathBuf};

fn rows(v: &Value) -> Option<Vec<Row>> {
    let number = |v: &Value| v.as_f64().unwrap_or(f64::NAN);
    let list = v.as_array()?;
    Some(
        list.iter().map(|r| [number(&r[0]), number(&r[1]), number(&r[2]), number(&r[3])]).collect(),
    )
}

fn read(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn root(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path)
}

/// Collects every difference, so that one run shows all of them.
#[derive(Default)]
struct Differences {
    compared: usize,
    largest: f64,
    found: Vec<String>,
}

impl Differences {
    fn check(&mut self, what: &str, got: f64, want: &Value, tolerance: f64) {
        let Some(want) = want.as_f64() else { return };
        self.compared += 1;
        self.largest = self.largest.max((got - want).abs());
        if (got - want).abs() > tolerance {
            self.found.push(format!("{what}: got {got}, toolkit {want}"));
        }
    }

    fn curve(&mut self, what: &str, got: &[f64], want: &Value, tolerance: f64) {
        let Some(list) = want.as_array() else { return };
        if list.len() != got.len() {
            self.found.push(format!("{what}: {} points, toolkit {}", got.len(), list.len()));
        }
        for (i, (got, want)) in got.iter().zip(list).enumerate() {
            self.check(&format!("{what} {i}"), *got, want, tolerance);
        }
    }
}

/// One case of three toolkits: `rgbt` with and without its rounding, GOT-10k, VOT.
fn toolkit_case(path: &Path, all: &mut Differences) {
    let case = read(path);
    let name = path.file_stem().unwrap().to_string_lossy().into_owned();
    let convention: Convention = case["protocol"].as_str().unwrap().to_lowercase().parse().unwrap();
    let (visible, predicted) = (rows(&case["gt_visible"]).unwrap(), rows(&case["pred"]).unwrap());
    let infrared = rows(&case["gt_infrared"]);
    let truth = Truth { infrared: infrared.as_deref(), ..Truth::one(&visible) };
    for (variant, round) in [("as_rgbt_loads_results_rounded", true), ("raw_unrounded", false)] {
        let want = &case["expected_rgbt"][variant];
        let options = ScoreOptions { round, ..ScoreOptions::default() };
        let s = score(convention, truth, &predicted, options).unwrap();
        let f = s.figures.scores;
        let before = all.compared;
        for (key, got) in [
            ("PR_20px", f.pr20),
            ("MPR_20px", f.pr20),
            ("MPR_5px", s.figures.pr5.unwrap_or(f64::NAN)),
            ("SR_mean21", f.auc),
            ("MSR_mean21", f.auc),
            ("MSR_auc", f.auc),
            ("NPR_0_2", f.npr),
            ("success_iou_gt_0_5", f.sr50),
        ] {
            all.check(&format!("{name} {variant} {key}"), got, &want[key], 1e-6);
        }
        assert!(all.compared >= before + 3, "{name} {variant}");
        for key in ["PR_curve_0_50", "MPR_curve_0_50"] {
            all.curve(&format!("{name} {variant} {key}"), &s.curves.precision, &want[key], 1e-6);
        }
        for key in ["SR_curve", "MSR_curve"] {
            all.curve(&format!("{name} {variant} {key}"), &s.curves.success, &want[key], 1e-6);
        }
    }

    let one = Truth::one(&visible);
    let want = &case["expected_got10k_toolkit"];
    let otb = score(Convention::Otb, one, &predicted, ScoreOptions::default()).unwrap().figures;
    let got = score(Convention::Got10k, one, &predicted, ScoreOptions::default()).unwrap().figures;
    for (key, value) in [
        ("OTB_success_score_auc21", otb.scores.auc),
        ("OTB_success_rate_0_5", otb.scores.sr50),
        ("OTB_precision_20px", otb.scores.pr20),
        ("LaSOT_norm_precision_0_2", otb.scores.npr),
        ("GOT10k_AO_excl_first", got.ao.unwrap()),
        ("GOT10k_SR0_5", got.scores.sr50),
        ("GOT10k_SR0_75", got.sr75.unwrap()),
    ] {
        all.check(&format!("{name} {key}"), value, &want[key], 1e-6);
    }
    // Written with six and four decimals, of predictions that are given with four.
    let frames = errors(Convention::Otb, one, &predicted, ScoreOptions::default()).unwrap();
    for (key, get, tolerance) in [
        ("per_frame_iou", (|e| e.iou) as fn(&FrameErrors) -> f64, 1e-5),
        ("per_frame_center_error", |e| e.centre, 2e-4),
    ] {
        let values: Vec<f64> = frames.iter().map(get).collect();
        all.curve(&format!("{name} {key}"), &values, &want[key], tolerance);
    }
    // Five decimals.
    for (key, image) in
        [("overlaps_unbounded", None), ("overlaps_bounded_640x480", Some((640, 480)))]
    {
        for (i, (t, p)) in visible.iter().zip(&predicted).enumerate() {
            let want = &case["expected_vot_toolkit"][key][i];
            all.check(&format!("{name} {key} {i}"), vot_overlap(*t, *p, image), want, 5.1e-6);
        }
    }
}

fn all_cases(folder: &Path) -> usize {
    let mut all = Differences::default();
    let mut cases = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if name.ends_with(".json") && name != "rgbt.json" {
            toolkit_case(&path, &mut all);
            cases += 1;
        }
    }
    println!("{cases} cases, {} figures, largest difference {:.1e}", all.compared, all.largest);
    assert!(all.found.is_empty(), "{} differ:\n{}", all.found.len(), all.found.join("\n"));
    cases
}

#[test]
fn synthetic_cases_of_three_toolkits() {
    assert_eq!(all_cases(&root("tests/golden/metrics")), 3);
}

#[test]
fn published_results_scored_by_three_toolkits() {
    let folder = root("../shared/golden/metrics/cases");
    if !folder.exists() {
        println!("skipped: {} is not there", folder.display());
        return;
    }
    assert!(all_cases(&folder) >= 17);
}

/// Averages over sequences, with absences, boxes without area and of NaN, by `rgbt`'s own classes.
#[test]
fn synthetic_benchmarks_scored_by_rgbt() {
    let file = read(&root("tests/golden/metrics/rgbt.json"));
    let mut all = Differences::default();
    for case in file["cases"].as_array().unwrap() {
        let convention: Convention = case["convention"].as_str().unwrap().parse().unwrap();
        let scores: Vec<Score> = case["sequences"]
            .as_object()
            .unwrap()
            .values()
            .map(|s| {
                let (visible, predicted) =
                    (rows(&s["visible"]).unwrap(), rows(&s["pred"]).unwrap());
                let infrared = rows(&s["infrared"]);
                let truth = Truth { infrared: infrared.as_deref(), ..Truth::one(&visible) };
                score(convention, truth, &predicted, ScoreOptions::default()).unwrap()
            })
            .collect();
        let mean = Score::average(convention, &scores);
        let f = mean.figures;
        for (key, got, curve) in [
            ("pr20", f.scores.pr20, &mean.curves.precision),
            ("pr5", f.pr5.unwrap_or(f64::NAN), &mean.curves.precision),
            ("npr", f.scores.npr, &mean.curves.normalised_precision),
            ("auc", f.scores.auc, &mean.curves.success),
        ] {
            let want = &case["expected"];
            all.check(&format!("{convention} {key}"), got, &want[key], 1e-9);
            let points = &want[format!("{key}_curve")];
            all.curve(&format!("{convention} {key} curve"), curve, points, 1e-9);
        }
    }
    assert!(all.found.is_empty(), "{} differ:\n{}", all.found.len(), all.found.join("\n"));
    assert!(all.compared > 300, "{}", all.compared);
}

const T: Row = [10.0, 10.0, 20.0, 20.0];
const FAR: Row = [200.0, 200.0, 20.0, 20.0];

fn truth_of(convention: Convention, boxes: &[Row]) -> Truth<'_> {
    let two = convention.truths() == Truths::Two;
    Truth { infrared: two.then_some(boxes), ..Truth::one(boxes) }
}

fn scored(convention: Convention, truth: &[Row], predicted: &[Row]) -> Result<Score, ScoreError> {
    score(convention, truth_of(convention, truth), predicted, ScoreOptions::default())
}

#[test]
fn lengths_follow_each_toolkit() {
    use Convention::*;
    let toolkit = ScoreOptions { lengths: Lengths::Toolkit, ..ScoreOptions::default() };
    for convention in Convention::ALL {
        let rgbt = matches!(convention, Lasher | Rgbt234 | Rgbt210 | Gtot);
        let longer = scored(convention, &[T; 3], &[T, T, T, FAR]);
        assert_eq!(longer.is_ok(), rgbt, "{convention}");
        if let Ok(s) = longer {
            assert_eq!((s.figures.scores.frames, s.figures.scores.sr50), (3, 1.0));
        }
        let short = scored(convention, &[T; 3], &[T, T]).unwrap_err();
        assert_eq!(short, ScoreError::Length(LengthMismatch { predicted: 2, truth: 3 }));
        let truth = [T; 3];
        let loose = score(convention, truth_of(convention, &truth), &[T, T], toolkit);
        assert_eq!(loose.is_ok(), matches!(convention, Rgbt234 | Rgbt210 | Gtot), "{convention}");
        assert!(score(convention, truth_of(convention, &truth), &[], toolkit).is_err());
        assert_eq!(scored(convention, &[], &[]).unwrap_err(), ScoreError::Empty);
    }
}

#[test]
fn truths_must_fit_the_convention() {
    let truth = [T; 3];
    let score = |convention, truth| score(convention, truth, &[T; 3], ScoreOptions::default());
    let two = Truth { infrared: Some(&truth), ..Truth::one(&truth) };
    for c in [Convention::Rgbt234, Convention::Gtot] {
        assert_eq!(score(c, Truth::one(&truth)).unwrap_err(), ScoreError::SecondTruthMissing(c));
        let uneven = Truth { infrared: Some(&truth[1..]), ..Truth::one(&truth) };
        assert_eq!(score(c, uneven).unwrap_err(), ScoreError::Truths { visible: 3, infrared: 2 });
    }
    for c in [Convention::Lasher, Convention::Rgbt210, Convention::Otb, Convention::Got10k] {
        assert_eq!(score(c, two).unwrap_err(), ScoreError::SecondTruth(c));
    }
    let cover = Truth { cover: Some(&[8, 8]), ..Truth::one(&truth) };
    let e = score(Convention::Got10k, cover).unwrap_err();
    assert_eq!(e, ScoreError::Cover { cover: 2, truth: 3 });
}

#[test]
fn the_better_sensor_counts_frame_by_frame() {
    let shifted = [40.0, 10.0, 20.0, 20.0];
    let (visible, infrared) = ([T, T, T, [0.0; 4]], [shifted; 4]);
    let truth = Truth { infrared: Some(&infrared), ..Truth::one(&visible) };
    let predicted = [T, T, shifted, shifted];
    for c in [Convention::Rgbt234, Convention::Gtot, Convention::Tsda] {
        let s = score(c, truth, &predicted, ScoreOptions::default()).unwrap().figures.scores;
        assert_eq!((s.sr50, s.pr20), (1.0, 1.0), "{c}");
    }
}

#[test]
fn got10k_cuts_to_the_picture_and_leaves_hidden_frames_out() {
    let edge = [90.0, 0.0, 20.0, 10.0];
    let (truth, predicted) = ([edge; 4], [FAR, edge, [90.0, 0.0, 40.0, 10.0], FAR]);
    let cover = [8, 8, 8, 0];
    let of = |image| {
        let truth = Truth { cover: Some(&cover), image, ..Truth::one(&truth) };
        let s = score(Convention::Got10k, truth, &predicted, ScoreOptions::default()).unwrap();
        (s.figures.ao.unwrap(), s.figures.scores.frames)
    };
    assert_eq!(of(None), (0.75, 2));
    assert_eq!(of(Some([100.0, 100.0])), (1.0, 2));
}

#[test]
fn boxes_of_nan_are_misses_everywhere() {
    for convention in Convention::ALL {
        let nan = [f64::NAN, 10.0, 20.0, 20.0];
        let s = scored(convention, &[T; 5], &[T, nan, [f64::NAN; 4], T, T]).unwrap();
        let f = s.figures.scores;
        assert_eq!((f.frames as f64 * (1.0 - f.sr50)).round(), 2.0, "{convention}");
        assert!((f.pr20 - f.sr50).abs() < 1e-12 && f.mean_iou.is_finite(), "{convention}");
    }
}

#[test]
fn a_perfect_result_has_the_best_figures() {
    for convention in Convention::ALL {
        let s = scored(convention, &[T; 6], &[T; 6]).unwrap();
        let f = s.figures.scores;
        assert_eq!((f.sr50, f.pr20, f.npr, f.mean_iou), (1.0, 1.0, 1.0, 1.0), "{convention}");
        let best = match convention {
            // The last point of the curve asks for more than 1.
            Convention::Gtot => 1.0 - 0.5 / 20.0,
            Convention::Got10k => 100.0 / 101.0,
            _ => 20.0 / 21.0,
        };
        assert!((f.auc - best).abs() < 1e-12, "{convention}: {}", f.auc);
        assert_eq!(s.figures.pr5.is_some(), convention == Convention::Gtot);
        assert_eq!(s.figures.ao.is_some(), convention == Convention::Got10k);
    }
}

#[test]
fn names_of_conventions_read_back() {
    for c in Convention::ALL {
        assert_eq!(c.to_string().parse(), Ok(c));
        assert_eq!(serde_json::to_value(c).unwrap(), c.as_str());
    }
    let e = "votlt".parse::<Convention>().unwrap_err().to_string();
    assert!(e.contains("votlt") && e.contains("got10k"), "{e}");
}

fn boxes(n: usize) -> impl Strategy<Value = Vec<Row>> {
    let side = prop_oneof![
        8 => 1.0f64..60.0,
        1 => Just(0.0),
        1 => Just(-3.0),
        1 => Just(f64::NAN),
        1 => Just(1e30),
    ];
    let place = prop_oneof![8 => -20.0f64..120.0, 1 => Just(f64::NAN), 1 => Just(-1e30)];
    proptest::collection::vec((place.clone(), place, side.clone(), side), n)
        .prop_map(|v| v.into_iter().map(|(x, y, w, h)| [x, y, w, h]).collect())
}

/// Values of vot-toolkit 0.7.4; 0.9.0 gives the same.
/// Two boxes, the picture's size when it cuts them, the toolkit's overlap.
type Case = (Row, Row, Option<(u32, u32)>, f64);

#[test]
fn vot_overlap_left_of_and_above_the_picture() {
    let cut = Some((20, 14));
    let cases: [Case; 21] = [
        ([0.0, 308.0, 349.0, 161.0], [-3.0, 287.0, 345.0, 180.0], None, 0.857319),
        ([0.0, 0.0, 10.0, 10.0], [-1.0, 0.0, 11.0, 10.0], None, 0.900000),
        ([0.0, 0.0, 10.0, 10.0], [-4.0, 0.0, 12.0, 10.0], None, 0.600000),
        ([0.0, 0.0, 10.0, 10.0], [-1.0, 0.0, 12.0, 10.0], None, 0.909091),
        ([-20.0, 3.0, 11.0, 6.0], [-15.0, 3.0, 6.0, 6.0], None, 0.000000),
        ([-21.0, 3.0, 19.0, 6.0], [-12.0, 3.0, 9.0, 6.0], None, 0.470588),
        ([-20.0, 3.0, 11.0, 6.0], [-22.0, 3.0, 22.0, 6.0], None, 0.000000),
        ([-9.0, -7.0, 14.0, 12.0], [-4.0, -12.0, 9.0, 20.0], None, 0.000000),
        ([5.0, 2.0, 2.0, 1.0], [12.0, 2.0, 6.0, 1.0], None, 1.000000),
        ([6.0, 5.0, 1.0, 10.0], [6.0, 2.0, 1.0, 5.0], None, 1.000000),
        ([3.0, 3.0, 0.0, 0.0], [3.0, 3.0, 0.0, 0.0], None, 1.000000),
        ([3.0, 3.0, 0.0, 4.0], [1.0, 2.0, 5.0, 6.0], None, 0.000000),
        ([-6.5, -11.5, 5.25, 14.0], [-10.5, -11.0, 0.5, 12.5], None, 0.000000),
        ([-7.0, -1.25, 0.5, 5.0], [-11.75, -0.25, 9.0, 2.75], None, 0.157895),
        ([2.5, 1.75, 6.75, 8.5], [3.75, 6.0, 9.5, 2.5], None, 0.151515),
        ([-2.5, -0.5, 6.5, 9.5], [0.49, -3.75, 4.25, 8.5], None, 0.250000),
        ([0.0, 0.0, 10.0, 10.0], [-4.0, 0.0, 12.0, 10.0], cut, 0.800000),
        ([-10.0, 9.0, 11.0, 4.0], [-10.0, 11.0, 11.0, 14.0], cut, 0.000000),
        ([-3.0, 0.0, 1.0, 13.0], [-9.0, -7.0, 8.0, 3.0], cut, 0.000000),
        ([15.0, 9.0, 9.0, 9.0], [17.0, 8.0, 20.0, 4.0], cut, 0.321429),
        ([5.0, 4.0, 3.0, 0.0], [-2.0, 4.0, 0.0, 1.0], cut, 1.000000),
    ];
    for (truth, predicted, image, want) in cases {
        for (a, b) in [(truth, predicted), (predicted, truth)] {
            let got = vot_overlap(a, b, image);
            assert!((got - want).abs() < 1e-6, "{a:?} {b:?} {image:?}: {got}, not {want}");
        }
    }
    assert_eq!(vot_overlap([f64::NAN; 4], [0.0, 0.0, 9.0, 9.0], None), 0.0);
}

proptest! {
    /// Whatever the boxes: every figure and curve within [0, 1], success falling, precision rising.
    #[test]
    fn figures_stay_in_bounds(truth in boxes(12), predicted in boxes(12)) {
        for convention in Convention::ALL {
            let mut t = truth_of(convention, &truth);
            t.image = Some([100.0, 80.0]);
            let s = score(convention, t, &predicted, ScoreOptions::default()).unwrap();
            for (key, _, get) in Figures::columns(convention) {
                let v = get(&s.figures);
                prop_assert!((0.0..=1.0).contains(&v), "{} {}: {}", convention, key, v);
            }
            let c = &s.curves;
            for list in [&c.success, &c.precision, &c.normalised_precision] {
                prop_assert!(list.iter().all(|v| (0.0..=1.0).contains(v)));
            }
            prop_assert!(c.success.windows(2).all(|w| w[0] >= w[1]));
            prop_assert!(c.precision.windows(2).all(|w| w[0] <= w[1]));
            for image in [None, Some((100, 80))] {
                let o = vot_overlap(truth[0], predicted[0], image);
                prop_assert!((0.0..=1.0).contains(&o));
            }
        }
    }

    /// The rules of `tsda` are those of `measure`, however the boxes are held.
    #[test]
    fn own_convention_equals_measure(truth in boxes(12), predicted in boxes(12)) {
        let t: Vec<_> = truth.iter().map(|r| Some(bbox(*r)).filter(BBox::is_valid)).collect();
        let p: Vec<_> = predicted.iter().map(|r| bbox(*r)).collect();
        let want = super::super::measure(&t, &p, FirstFrame::Excluded).unwrap();
        let got = scored(Convention::Tsda, &truth, &predicted).unwrap().figures.scores;
        prop_assert_eq!(got, want);
    }

    /// Neither the order of frames (the first and LasHeR's look back aside) nor that of sequences
    /// matters, and pooling equals scoring everything at once.
    #[test]
    fn order_does_not_matter(truth in boxes(12), predicted in boxes(12), by in 1usize..11) {
        let turn = |v: &[Row]| {
            let mut v = v.to_vec();
            v[1..].rotate_left(by);
            v
        };
        for convention in Convention::ALL {
            let a = scored(convention, &truth, &predicted).unwrap();
            if convention != Convention::Lasher {
                let b = scored(convention, &turn(&truth), &turn(&predicted)).unwrap();
                prop_assert_eq!(&a.curves, &b.curves);
                let (x, y) = (a.figures.scores, b.figures.scores);
                prop_assert!((x.mean_iou - y.mean_iou).abs() < 1e-9);
                prop_assert_eq!((x.sr50, x.pr20, x.npr), (y.sr50, y.pr20, y.npr));
            }
            let c = scored(convention, &truth[by..], &predicted[by..]).unwrap();
            let (ab, ba) =
                (Score::average(convention, [&a, &c]), Score::average(convention, [&c, &a]));
            prop_assert!((ab.figures.scores.auc - ba.figures.scores.auc).abs() < 1e-12);

            let mut frames = errors(convention, truth_of(convention, &truth), &predicted,
                ScoreOptions::default()).unwrap();
            let rest = Score::of_frames(convention, &frames.split_off(frames.len() / 2));
            let halves = Score::pooled([&Score::of_frames(convention, &frames), &rest]);
            prop_assert!((halves.figures.scores.auc - a.figures.scores.auc).abs() < 1e-9);
        }
    }
}
