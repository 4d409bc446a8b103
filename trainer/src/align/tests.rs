use super::*;
use crate::config::{AdversarialConfig, AlignPreset, ContrastiveConfig};
use burn::module::Param;
use burn::nn::Linear;
use serde_json::Value;
use std::path::Path;

fn golden() -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/align/align.json");
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn numbers(value: &Value) -> Vec<f32> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap() as f32).collect()
}

fn flags(value: &Value) -> Vec<bool> {
    numbers(value).iter().map(|v| *v != 0.0).collect()
}

fn values<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().iter::<f32>().collect()
}

/// Largest difference, relative to the largest wanted number.
fn assert_close(what: &str, got: &[f32], want: &[f32]) {
    assert_eq!(got.len(), want.len(), "{what}: length");
    let scale = want.iter().fold(1e-12f32, |m, v| m.max(v.abs()));
    let off = got.iter().zip(want).fold(0.0f32, |m, (g, w)| m.max((g - w).abs())) / scale;
    println!("{what}: within {off:.1e} of {scale:.2e}");
    assert!(off <= 1e-5, "{what}: {got:?}, not {want:?}");
}

fn device() -> Device {
    Device::flex().autodiff()
}

const WIDTH: usize = 8;

fn preset(preset: AlignPreset) -> AlignConfig {
    let row = AlignConfig { preset, ..Default::default() };
    AlignConfig {
        preset,
        adversarial_table: row
            .adversarial()
            .map(|_| AdversarialConfig { hidden: Some(vec![6]), ..Default::default() }),
        contrastive_table: row.contrastive().map(|_| ContrastiveConfig {
            hidden: Some(vec![6]),
            dim: Some(4),
            ..Default::default()
        }),
        ..Default::default()
    }
}

/// The configuration of every golden case.
fn cases() -> Vec<(&'static str, AlignConfig)> {
    let mut normalised = preset(AlignPreset::PreAfa);
    normalised.adversarial_table.as_mut().unwrap().normalise = Some(true);
    let both = AlignConfig {
        adversarial_table: Some(AdversarialConfig {
            stage: Some(AlignStage::Encoder),
            weight: Some(0.7),
            reversal: Some(1.3),
            hidden: Some(vec![6]),
            ..Default::default()
        }),
        contrastive_table: Some(ContrastiveConfig {
            stage: Some(AlignStage::Encoder),
            weight: Some(0.2),
            temperature: Some(0.5),
            hidden: Some(vec![6]),
            dim: Some(4),
            normalise: None,
        }),
        ..Default::default()
    };
    let mut normalised_cfa = preset(AlignPreset::PreCfa);
    normalised_cfa.contrastive_table.as_mut().unwrap().normalise = Some(true);
    vec![
        ("pre-afa", preset(AlignPreset::PreAfa)),
        ("enc-afa", preset(AlignPreset::EncAfa)),
        ("pre-afa-normalised", normalised),
        ("pre-cfa-normalised", normalised_cfa),
        ("pre-cfa", preset(AlignPreset::PreCfa)),
        ("enc-cfa", preset(AlignPreset::EncCfa)),
        ("joint", preset(AlignPreset::Joint)),
        ("both-encoder", both),
    ]
}

/// Puts the golden parameters into layers of a branch.
fn fill(layers: &mut [Linear], name: &str, parameters: &Value) {
    for (i, layer) in layers.iter_mut().enumerate() {
        let [inp, out] = layer.weight.dims();
        let weight = numbers(&parameters[format!("{name}.{i}.weight")]);
        let weight =
            Tensor::<2>::from_data(TensorData::new(weight, [out, inp]), &device()).transpose();
        layer.weight = Param::from_tensor(weight);
        let bias = numbers(&parameters[format!("{name}.{i}.bias")]);
        let bias = Tensor::<1>::from_data(TensorData::new(bias, [out]), &device());
        layer.bias = Some(Param::from_tensor(bias));
    }
}

fn branches(config: &AlignConfig, golden: &Value) -> Branches {
    let mut branches = Branches::new(config, WIDTH, &device()).unwrap();
    if let Some(d) = &mut branches.discriminator {
        fill(&mut d.layers, "discriminator", &golden["parameters"]);
    }
    if let Some(p) = &mut branches.projection {
        fill(&mut p.layers, "projection", &golden["parameters"]);
    }
    branches
}

fn check_layers(name: &str, layers: &[Linear], got: &GradientsParams, want: &Value) {
    for (i, layer) in layers.iter().enumerate() {
        let weight = got.get::<2>(layer.weight.id).unwrap().transpose();
        let key = format!("{name}.{i}.weight");
        assert_close(&key, &values(weight), &numbers(&want[&key]));
        let bias = got.get::<1>(layer.bias.as_ref().unwrap().id).unwrap();
        let key = format!("{name}.{i}.bias");
        assert_close(&key, &values(bias), &numbers(&want[&key]));
    }
}

#[test]
fn losses_and_all_gradients_equal_pytorch() {
    let golden = golden();
    let thermal = [flags(&golden["thermal"]["template"]), flags(&golden["thermal"]["search"])];
    let mut compared = 0;
    for (name, config) in cases() {
        println!("{name}");
        let want = &golden["cases"][name];
        let branches = branches(&config, &golden);
        let leaf = |name: &str| {
            let data = TensorData::new(numbers(&golden["inputs"][name]), [5, WIDTH]);
            Tensor::<2>::from_data(data, &device()).require_grad()
        };
        let inputs = ["pre.template", "pre.search", "encoder.template", "encoder.search"]
            .map(|name| (name, leaf(name)));
        let descriptors = |stage| {
            let at = if stage == AlignStage::Pre { 0 } else { 2 };
            (inputs[at].1.clone(), inputs[at + 1].1.clone())
        };
        let step =
            align_descriptors(&branches, &config, 1.0, descriptors, [&thermal[0], &thermal[1]])
                .unwrap();
        for figure in ["adversarial", "contrastive", "discriminator_accuracy"] {
            assert_eq!(step.figures.contains_key(figure), want.get(figure).is_some(), "{figure}");
            if let Some(got) = step.figures.get(figure) {
                assert_close(figure, &[*got as f32], &[want[figure].as_f64().unwrap() as f32]);
            }
        }
        assert_close("loss", &[step.loss as f32], &[want["loss"].as_f64().unwrap() as f32]);
        // The value of the bridge means nothing, its gradients are what the network gets.
        let gradients = step.bridge.backward();
        let mut squares = 0.0;
        for (input, leaf) in &inputs {
            let got = leaf.grad(&gradients).map(values);
            let want = want["gradients"].get(input).map(numbers);
            assert_eq!(got.is_some(), want.is_some(), "{input}");
            if let (Some(got), Some(want)) = (got, want) {
                squares += got.iter().map(|v| v * v).sum::<f32>();
                assert_close(input, &got, &want);
            }
            compared += 1;
        }
        let pulls: f64 = ["adversarial_pull", "contrastive_pull"]
            .iter()
            .filter_map(|n| step.figures.get(n).map(|v| v * v))
            .sum();
        // Pulls of two branches on one descriptor do not add up.
        if name != "both-encoder" {
            assert!((pulls.sqrt() - f64::from(squares.sqrt())).abs() < 1e-6, "{name}");
        }
        if let Some(d) = &branches.discriminator {
            let got = step.discriminator.as_ref().unwrap();
            check_layers("discriminator", &d.layers, got, &want["gradients"]);
        }
        if let Some(p) = &branches.projection {
            let got = step.projection.as_ref().unwrap();
            check_layers("projection", &p.layers, got, &want["gradients"]);
        }
    }
    assert_eq!(compared, 8 * 4);
}

#[test]
fn the_factor_scales_weights_and_gradients_but_not_the_figures() {
    let golden = golden();
    let config = preset(AlignPreset::Joint);
    let branches = branches(&config, &golden);
    let x = |name: &str| {
        let data = TensorData::new(numbers(&golden["inputs"][name]), [5, WIDTH]);
        Tensor::<2>::from_data(data, &device())
    };
    let run = |factor| {
        let of = |stage| match stage {
            AlignStage::Pre => (x("pre.template"), x("pre.search")),
            AlignStage::Encoder => (x("encoder.template"), x("encoder.search")),
        };
        let thermal = [true, false, true, false, true];
        align_descriptors(&branches, &config, factor, of, [&thermal, &thermal]).unwrap()
    };
    let (whole, half) = (run(1.0), run(0.5));
    assert!((whole.loss - 2.0 * half.loss).abs() < 1e-6);
    for (name, value) in &whole.figures {
        let scale = if name.ends_with("pull") { 2.0 } else { 1.0 };
        assert!((value - scale * half.figures[name]).abs() < 1e-6, "{name}");
    }
}

#[test]
fn extreme_inputs_give_finite_losses_and_gradients() {
    let device = device();
    let row = |v: [f32; 2]| Tensor::<2>::from_data(TensorData::new(v.to_vec(), [2, 1]), &device);
    // Surely right, surely wrong: 0 and the logit itself.
    let sure = discriminator_loss([row([90.0, -90.0]), row([90.0, -90.0])], [&[true, false]; 2]);
    assert!(sure.into_scalar::<f32>().abs() < 1e-6);
    let logits = row([90.0, -90.0]).require_grad();
    let wrong = discriminator_loss([logits.clone(), logits.clone()], [&[false, true]; 2]);
    let gradient = values(logits.grad(&wrong.backward()).unwrap());
    assert!((wrong.into_scalar::<f32>() - 90.0).abs() < 1e-4);
    assert!(gradient.iter().zip([0.5, -0.5]).all(|(g, w)| (g - w).abs() < 1e-6), "{gradient:?}");
    assert_eq!(
        discriminator_accuracy(&[row([1.0, 1.0]), row([0.0, -1.0])], [&[true, false]; 2]),
        0.5
    );

    // A projection that has died.
    let zero = Tensor::<2>::zeros([3, 4], &device).require_grad();
    let loss = info_nce(zero.clone(), Tensor::ones([3, 4], &device), 0.01);
    let gradient = values(zero.grad(&loss.backward()).unwrap());
    assert!(gradient.iter().all(|v| v.is_finite()));
    assert!((loss.into_scalar::<f32>() - 3f32.ln()).abs() < 1e-6);
    // Perfect partners at a low temperature.
    let eye = Tensor::<2>::eye(4, &device);
    assert!(info_nce(eye.clone(), eye, 0.01).into_scalar::<f32>() < 1e-6);
}
