use super::*;
use crate::import::StateDict;
use std::path::Path;

fn golden() -> StateDict {
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/trainer/losses.safetensors");
    StateDict::read(&path).unwrap()
}

fn tensor<const D: usize>(dict: &StateDict, name: &str, shape: [usize; D]) -> Tensor<D> {
    let values = dict.get(name).unwrap().values.clone();
    Tensor::from_data(TensorData::new(values, shape), &Device::flex().autodiff())
}

/// Largest difference relative to the largest wanted value.
fn assert_close(what: &str, got: &[f32], want: &[f32], tolerance: f32) {
    assert_eq!(got.len(), want.len(), "{what}: length");
    let scale = want.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let worst = got.iter().zip(want).fold(0.0f32, |m, (g, w)| m.max((g - w).abs()));
    println!("{what}: within {:.1e} of the largest, {scale:.3}", worst / scale);
    assert!(worst <= tolerance * scale, "{what}: off by {worst} of {scale}");
}

fn values<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().iter::<f32>().collect()
}

#[test]
fn giou_and_its_gradient_equal_the_reference() {
    let dict = golden();
    let mask: Vec<bool> = dict.get("giou.mask").unwrap().values.iter().map(|v| *v != 0.0).collect();
    let regions = [
        ("masked", mask.clone()),
        ("empty_mask", vec![false; mask.len()]),
        ("no_mask", vec![true; mask.len()]),
    ];
    for (case, region) in regions {
        let prediction = tensor(&dict, "giou.pred", [6, 4, 5, 6]).require_grad();
        let target = tensor(&dict, "giou.target", [6, 4, 5, 6]);
        let loss = giou_loss(prediction.clone(), target, &region);
        let gradients = loss.backward();
        let name = |what| format!("giou.{case}.{what}");
        assert_close(&name("loss"), &values(loss), &dict.get(&name("loss")).unwrap().values, 1e-5);
        let gradient = prediction.grad(&gradients).unwrap();
        assert_close(
            &name("grad_pred"),
            &values(gradient),
            &dict.get(&name("grad_pred")).unwrap().values,
            1e-4,
        );
    }
}

#[test]
fn classification_and_its_gradient_equal_the_reference() {
    let dict = golden();
    let prediction = tensor(&dict, "lbhinge.pred", [1, 4, 18, 18]).require_grad();
    let label = tensor(&dict, "lbhinge.label", [1, 4, 18, 18]);
    let loss = classification_loss(prediction.clone(), label);
    let gradients = loss.backward();
    assert_close("lbhinge.loss", &values(loss), &dict.get("lbhinge.loss").unwrap().values, 1e-6);
    let gradient = prediction.grad(&gradients).unwrap();
    let want = &dict.get("lbhinge.grad_pred").unwrap().values;
    assert_close("lbhinge.grad_pred", &values(gradient), want, 1e-6);
}

#[test]
fn small_cases_by_hand() {
    let device = Device::flex();
    let map = |v: [f32; 4]| Tensor::<3>::from_data(TensorData::new(v.to_vec(), [1, 2, 2]), &device);
    // Background: only the positive excess counts. Target: squared error either way.
    let loss = classification_loss(map([0.5, -2.0, 0.8, 1.5]), map([0.0, 0.04, 1.0, 1.0]));
    let want = (0.25 + 0.0 + 0.04 + 0.25) / 4.0;
    assert!((loss.into_scalar::<f32>() - want).abs() < 1e-6);

    // Equal boxes lose nothing; a box twice as wide has IoU 1/2 and a hull of its own size.
    let ltrb =
        |v: [f32; 4]| Tensor::<4>::from_data(TensorData::new(v.to_vec(), [1, 4, 1, 1]), &device);
    let target = || ltrb([0.1, 0.1, 0.1, 0.1]);
    for (prediction, want) in [([0.1; 4], 0.0), ([0.2, 0.1, 0.2, 0.1], 0.5)] {
        let loss = giou_loss(ltrb(prediction), target(), &[true]).into_scalar::<f32>();
        assert!((loss - want).abs() < 1e-4, "{prediction:?}: {loss}, not {want}");
    }
}

#[test]
fn weights_scale_the_total() {
    let device = Device::flex();
    let scores = Tensor::<3>::full([1, 2, 2], 0.5, &device);
    let label = Tensor::<3>::zeros([1, 2, 2], &device);
    let ltrb = Tensor::<4>::full([1, 4, 2, 2], 0.2, &device);
    let target = Tensor::<4>::full([1, 4, 2, 2], 0.1, &device);
    let weights = LossWeights { classification: 3.0, giou: 2.0 };
    let l = losses(weights, scores, label, ltrb, target, &[true; 4]);
    let [total, c, g] = [l.total, l.classification, l.giou].map(|t| t.into_scalar::<f32>());
    assert!((total - (3.0 * c + 2.0 * g)).abs() < 1e-5);
    assert!(c > 0.2 && g > 0.5);
}
