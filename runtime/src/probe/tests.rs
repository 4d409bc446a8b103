use super::*;
use crate::testing::ScriptedEngine;

const SPEC: ModelSpec = ModelSpec { crop: 64, ..ModelSpec::NANO };

fn engine() -> ScriptedEngine {
    let mut engine = ScriptedEngine::new(SPEC);
    for (i, v) in engine.answer.0.iter_mut().chain(&mut engine.answer.1).enumerate() {
        *v = i as f32 / 64.0;
    }
    engine
}

/// First bytes and sums computed once with an independent program.
#[test]
fn the_recipe_is_the_documented_one() {
    let mut z = recipe_seed(2);
    assert_eq!(
        z,
        b"image.2".iter().fold(0xcbf29ce484222325, |h: u64, &b| {
            (h ^ u64::from(b)).wrapping_mul(0x100000001b3)
        })
    );
    z = recipe_seed(12);
    assert_ne!(z, recipe_seed(2));
    let mut image = vec![0; 288 * 288 * 3];
    recipe_image(2, 288, 288, &mut image);
    let sum: u64 = image.iter().map(|&v| u64::from(v)).sum();
    assert_eq!(sum, 31709212);
    assert_eq!(image[..6], [156, 57, 91, 101, 67, 98]);
    let mut crop = vec![0.0; ModelSpec::TOMP101.crop_len()];
    crop_input(&ModelSpec::TOMP101, 2, &mut crop);
    let back = |c: usize, at: usize| {
        let spec = ModelSpec::TOMP101;
        (crop[c * 288 * 288 + at] * spec.input_std[c] + spec.input_mean[c]) * 255.0
    };
    for at in [0, 1, 5000, 288 * 288 - 1] {
        for c in 0..3 {
            assert!((back(c, at) - f32::from(image[3 * at + c])).abs() < 1e-3);
        }
    }
}

#[test]
fn a_captured_probe_is_met_exactly_and_differences_are_measured() {
    let boxes = default_boxes(&SPEC);
    let bytes = capture(&mut engine(), &boxes).unwrap();
    let probe = Probe::parse(&bytes, &SPEC).unwrap();
    assert_eq!(probe.bbox(1), Some(boxes[1]));
    assert_eq!(probe.bbox(2), None);
    let mut checked = engine();
    let report = run(&mut checked, &probe).unwrap();
    assert_eq!((report.max(), report.diffs.len()), (0.0, 2));
    assert_eq!((checked.written, checked.asked), (vec![0, 1], vec![1, 2]));

    let mut other = engine();
    other.answer.0[0] += 0.5;
    other.answer.1[0] += 0.25;
    let report = run(&mut other, &probe).unwrap();
    assert_eq!(report.diffs[1], ProbeDiff { templates: 2, scores: 0.5, ltrb: 0.25 });
    other.answer.0[0] = f32::NAN;
    assert_eq!(run(&mut other, &probe).unwrap().max(), f32::INFINITY);
}

#[test]
fn damaged_sections_are_refused() {
    let bytes = capture(&mut engine(), &default_boxes(&SPEC)).unwrap();
    for len in 0..bytes.len() {
        assert!(Probe::parse(&bytes[..len], &SPEC).is_err(), "cut at {len}");
    }
    let change = |at: usize, with: &[u8]| {
        let mut b = bytes.clone();
        b[at..at + with.len()].copy_from_slice(with);
        Probe::parse(&b, &SPEC).unwrap_err().to_string()
    };
    assert!(change(0, b"X").contains("signature"));
    assert!(change(4, &[9]).contains("number of templates is 9"));
    assert!(change(8, &[9]).contains("side of the maps is 9"));
    assert!(change(20, &(-1f32).to_le_bytes()).contains("box"));
    assert!(change(60, &f32::NAN.to_le_bytes()).contains("number"));
}

#[test]
fn capture_and_run_name_what_does_not_fit() {
    let error = capture(&mut engine(), &[]).unwrap_err();
    assert!(matches!(error, ProbeError::Shape { field: "number of boxes", .. }));
    let bytes = capture(&mut engine(), &default_boxes(&SPEC)).unwrap();
    let probe = Probe::parse(&bytes, &SPEC).unwrap();
    let mut short = engine();
    short.crop.pop();
    let error = run(&mut short, &probe).unwrap_err();
    assert!(error.to_string().contains("crop"), "{error}");
    let mut broken = engine();
    broken.fail = Some(crate::engine::Stage::Predict);
    assert!(matches!(run(&mut broken, &probe).unwrap_err(), ProbeError::Run(_)));
}
