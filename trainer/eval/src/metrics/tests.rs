use super::*;
use proptest::prelude::*;
use serde_json::Value;
use std::path::Path;

const T: BBox = BBox::new(10.0, 10.0, 20.0, 20.0);

/// Truth 20 x 20 at (10, 10). IoU values as the got10k and VOT toolkits give them for these boxes.
#[test]
fn one_frame_against_known_values() {
    for (p, iou, centre, norm) in [
        (T, 1.0, 0.0, 0.0),
        (BBox::new(30.0, 10.0, 20.0, 20.0), 0.0, 20.0, 1.0),
        (BBox::new(29.0, 10.0, 20.0, 20.0), 0.025_641, 19.0, 0.95),
        (BBox::new(10.0, 10.0, 0.0, 0.0), 0.0, 14.1421, 0.5f64.sqrt()),
        (BBox::new(200.0, 200.0, 20.0, 20.0), 0.0, 268.7006, 13.435),
        (BBox::new(10.0, 10.0, 40.0, 20.0), 0.5, 10.0, 0.5),
        (BBox::new(10.4, 10.4, 20.2, 19.6), 0.932_971, 0.5385, 0.0269),
        (BBox::new(10.0, 10.0, -5.0, 20.0), 0.0, 12.5, 0.625),
        (BBox::new(f32::NAN, 10.0, 20.0, 20.0), 0.0, f64::INFINITY, f64::INFINITY),
        (BBox::new(0.0, 0.0, f32::INFINITY, 20.0), 0.0, f64::INFINITY, f64::INFINITY),
    ] {
        let e = frame_errors(T, p);
        assert!((e.iou - iou).abs() < 1e-4, "{p:?}: {e:?}");
        let near = |a: f64, b: f64| a == b || (a - b).abs() < 1e-3;
        assert!(near(e.centre, centre) && near(e.normalised, norm), "{p:?}: {e:?}");
    }
}

/// The eight boxes of the toolkits' own synthetic case, with the averages `rgbt` 1.0.1 gives.
#[test]
fn eight_boxes_against_toolkit_averages() {
    let predicted = [
        T,
        T,
        BBox::new(30.0, 10.0, 20.0, 20.0),
        BBox::new(29.0, 10.0, 20.0, 20.0),
        BBox::new(10.0, 10.0, 0.0, 0.0),
        BBox::new(200.0, 200.0, 20.0, 20.0),
        BBox::new(10.0, 10.0, 40.0, 20.0),
        BBox::new(10.4, 10.4, 20.2, 19.6),
    ];
    let s = measure(&[Some(T); 8], &predicted, FirstFrame::Truth).unwrap();
    assert_eq!((s.pr20, s.npr, s.sr50), (0.875, 0.375, 0.375));
    // The toolkit replaces the box without area by the one before it (IoU 0.026); here it has none.
    assert!((s.auc - (0.422_619_047_619_047_6 - 1.0 / (8.0 * 21.0))).abs() < 1e-12, "{}", s.auc);
}

#[test]
fn thresholds_are_strict_for_success_and_inclusive_for_precision() {
    let half = BBox::new(10.0, 10.0, 40.0, 20.0);
    let at_20px = BBox::new(30.0, 10.0, 20.0, 20.0);
    let at_fifth = BBox::new(14.0, 10.0, 20.0, 20.0);
    for (p, sr50, pr20, npr) in
        [(half, 0.0, 1.0, 0.0), (at_20px, 0.0, 1.0, 0.0), (at_fifth, 1.0, 1.0, 1.0)]
    {
        let s = measure(&[Some(T); 2], &[T, p], FirstFrame::Excluded).unwrap();
        assert_eq!((s.sr50, s.pr20, s.npr, s.frames), (sr50, pr20, npr, 1), "{p:?}");
    }
    // A perfect tracker cannot beat "IoU > 1".
    let s = measure(&[Some(T); 3], &[T; 3], FirstFrame::Excluded).unwrap();
    assert!((s.auc - 20.0 / 21.0).abs() < 1e-12 && s.mean_iou == 1.0);
}

#[test]
fn the_first_frame_never_counts_as_predicted() {
    let far = BBox::new(200.0, 200.0, 20.0, 20.0);
    let truth = [Some(T); 4];
    for first_prediction in [T, far] {
        let predicted = [first_prediction, T, far, far];
        let excluded = measure(&truth, &predicted, FirstFrame::Excluded).unwrap();
        assert_eq!((excluded.frames, excluded.sr50), (3, 1.0 / 3.0));
        let replaced = measure(&truth, &predicted, FirstFrame::Truth).unwrap();
        assert_eq!((replaced.frames, replaced.sr50), (4, 0.5));
    }
}

#[test]
fn frames_without_the_target_do_not_count() {
    let far = BBox::new(200.0, 200.0, 20.0, 20.0);
    let s = measure(&[Some(T), None, Some(T), None], &[T, far, T, far], FirstFrame::Excluded);
    let s = s.unwrap();
    assert_eq!((s.frames, s.sr50, s.pr20), (1, 1.0, 1.0));
    let s = measure(&[Some(T), None], &[T, far], FirstFrame::Excluded).unwrap();
    assert_eq!(s, Scores::default());
    assert_eq!(
        measure(&[Some(T)], &[], FirstFrame::Truth),
        Err(LengthMismatch { predicted: 0, truth: 1 })
    );
}

#[test]
fn averages_weigh_sequences_or_frames() {
    let a = Scores { sr50: 1.0, auc: 0.9, pr20: 1.0, npr: 1.0, mean_iou: 0.9, frames: 10 };
    let b = Scores { sr50: 0.0, auc: 0.1, pr20: 0.5, npr: 0.0, mean_iou: 0.1, frames: 30 };
    let empty = Scores::default();
    let mean = Scores::mean([&a, &b, &empty]);
    assert_eq!((mean.sr50, mean.pr20, mean.frames), (0.5, 0.75, 40));
    let pooled = Scores::pooled([&a, &b, &empty]);
    assert_eq!((pooled.sr50, pooled.pr20, pooled.frames), (0.25, 0.625, 40));
    assert_eq!(Scores::mean([&empty]), empty);
}

proptest! {
    #[test]
    fn pooling_equals_measuring_everything_at_once(
        ious in proptest::collection::vec(0.0f64..1.0, 2..40), cut in 1usize..39,
    ) {
        let errors: Vec<FrameErrors> = ious
            .iter()
            .map(|&iou| FrameErrors { iou, centre: 40.0 * (1.0 - iou), normalised: 1.0 - iou })
            .collect();
        let (a, b) = errors.split_at(cut.min(errors.len() - 1));
        let (whole, parts) =
            (Scores::of(&errors), Scores::pooled([&Scores::of(a), &Scores::of(b)]));
        prop_assert!((whole.auc - parts.auc).abs() < 1e-9);
        prop_assert!((whole.sr50 - parts.sr50).abs() < 1e-9);
        prop_assert!((whole.mean_iou - parts.mean_iou).abs() < 1e-9);
        prop_assert!((whole.pr20 - parts.pr20).abs() < 1e-9);
    }
}

/// Figures computed by the toolkits themselves on published results. Those of the LasHeR and
/// RGBT210 kind replace the first frame by the truth and do not round in their `raw` variant.
#[test]
fn agrees_with_the_toolkits_on_published_results() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/golden/metrics/cases");
    if !dir.exists() {
        println!("skipped: {} is not there", dir.display());
        return;
    }
    let mut checked = 0;
    for entry in std::fs::read_dir(&dir).unwrap() {
        let path = entry.unwrap().path();
        let case: Value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
        let boxes = |key: &str| -> Vec<BBox> {
            let rows = case[key].as_array().unwrap();
            let number = |v: &Value| v.as_f64().unwrap() as f32;
            rows.iter()
                .map(|r| BBox::new(number(&r[0]), number(&r[1]), number(&r[2]), number(&r[3])))
                .collect()
        };
        let truth: Vec<Option<BBox>> =
            boxes("gt_visible").into_iter().map(|b| b.is_valid().then_some(b)).collect();
        let predicted = boxes("pred");
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        // Absent frames count in those toolkits and not here, by decision (see the module).
        let raw = &case["expected_rgbt"]["raw_unrounded"];
        let comparable = raw.get("PR_20px").is_some()
            && truth.iter().all(|t| t.is_some_and(|b| b.x > 0.0 && b.y > 0.0));
        if comparable {
            let s = measure(&truth, &predicted, FirstFrame::Truth).unwrap();
            // A frame that lies exactly on a threshold goes either way by their last bit.
            let on_threshold = |e: &FrameErrors| {
                let t = e.iou * 20.0;
                (t - t.round()).abs() < 1e-9 && t > 0.5 && t < 19.5
            };
            let frames = errors(&truth, &predicted, FirstFrame::Truth).unwrap();
            let ties = frames.iter().filter(|e| on_threshold(e)).count();
            let slack = ties as f64 / (frames.len() * SUCCESS_POINTS) as f64;
            for (key, got) in [
                ("PR_20px", s.pr20),
                ("SR_mean21", s.auc),
                ("NPR_0_2", s.npr),
                ("success_iou_gt_0_5", s.sr50),
            ] {
                if let Some(want) = raw.get(key).and_then(Value::as_f64) {
                    let slack = if key == "SR_mean21" { slack } else { 0.0 };
                    assert!((got - want).abs() < 1e-6 + slack, "{name} {key}: {got} {want}");
                    checked += 1;
                }
            }
        }
        // Errors of single frames hold for every protocol (six and four decimals are given; frame
        // 0 is overwritten there).
        let listed = |key: &str| case["expected_got10k_toolkit"][key].as_array().cloned();
        for (key, get) in [
            ("per_frame_iou", (|e| e.iou) as fn(FrameErrors) -> f64),
            ("per_frame_center_error", |e| e.centre),
        ] {
            for (i, want) in listed(key).unwrap_or_default().iter().enumerate().skip(1) {
                if let (Some(t), Some(want)) = (truth[i], want.as_f64()) {
                    let got = get(frame_errors(t, predicted[i]));
                    let near = 1e-4 * want.max(1.0);
                    assert!((got - want).abs() < near, "{name} {key} {i}: {got} {want}");
                    checked += 1;
                }
            }
        }
    }
    println!("{checked} figures compared");
    assert!(checked > 500, "only {checked} figures compared");
}
