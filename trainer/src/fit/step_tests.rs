//! One training step against the reference (golden case t), through the code `fit` uses.
//!
//! `tests/golden/model/training_step.safetensors` holds a thinned copy of the reference's figures;
//! `make_training_step.py` beside it says how it was made.

use super::tensors::Inputs;
use super::*;
use crate::align::{Branches, align_step, discriminator_loss, info_nce};
use crate::config::AlignPreset;
use crate::import::{StateDict, state_dict};
use crate::losses::losses;
use crate::model::tests::{
    NO_DROPOUT, committed, compact, difference, gradients, recipe, recipe_image, recipe_net, small,
    values,
};
use crate::processing::Batch;
use tsda_runtime::BBox;

/// Gradients without a mathematical value: biases in front of a batch norm, which takes them out
/// again. What is left is rounding noise.
pub(super) const NOISE: [&str; 2] =
    ["head.filter_predictor.box_encoding.0.bias", "head.filter_predictor.box_encoding.3.bias"];
/// Weights on the zero token: no gradient at all (spec 2.6).
const DEAD: &str = "head.filter_predictor.transformer.decoder.layers.0.self_attn.in_proj_weight";

/// The three golden sequences.
pub(super) fn golden_batch() -> Batch {
    let (dict, spec) = (compact(), small(true));
    let each = |name: &str| -> Vec<f32> {
        (0..3).flat_map(|q| dict.get(&format!("seq{q}.{name}")).unwrap().values.clone()).collect()
    };
    let images = |frames: &[usize]| -> Vec<f32> {
        let frames = (0..3).flat_map(|q| frames.iter().map(move |f| 10 * q + f));
        frames.flat_map(|frame| recipe_image(frame, spec.crop_side())).collect()
    };
    let boxes = each("test_box");
    Batch {
        size: 3,
        templates: 2,
        ids: (0..3).map(|q| format!("seq{q}")).collect(),
        cross: vec![false; 3],
        thermal: vec![false; 3],
        template_crops: images(&[0, 1]),
        template_labels: each("train_label"),
        template_ltrb: each("train_ltrb"),
        search_crops: images(&[2]),
        search_labels: each("test_label"),
        search_ltrb: each("test_ltrb"),
        present: vec![true; 3],
        region: each("test_region").iter().map(|v| *v != 0.0).collect(),
        search_boxes: boxes.chunks_exact(4).map(|b| BBox::new(b[0], b[1], b[2], b[3])).collect(),
    }
}

/// The elements a thinned tensor keeps, and the largest absolute value of all.
fn thinned(values: &[f32]) -> (f32, Vec<f32>) {
    let n = values.len();
    let samples = match n {
        0..=48 => values.to_vec(),
        _ => (0..48).map(|k| values[k * 2_654_435_761 % n]).collect(),
    };
    (values.iter().fold(0.0, |m, v| m.max(v.abs())), samples)
}

fn net() -> TrackerNet {
    recipe_net(&small(true), &NO_DROPOUT, &Device::flex().autodiff())
}

#[test]
fn losses_and_all_gradients_equal_the_reference() {
    let (case, batch, net) = (committed("training_step.safetensors"), golden_batch(), net());
    let want = |name: &str| case.get(name).unwrap().values.as_slice();
    let device = Device::flex().autodiff();
    let inputs = Inputs::new(&batch, net.spec(), &device);
    let out = net.forward_train(
        inputs.template_crops,
        inputs.search_crops,
        inputs.template_labels,
        inputs.template_ltrb,
    );
    let off = |name: &str, got: Vec<f32>| {
        let off = difference(&got, want(name));
        println!("{name}: within {off:.1e}");
        off
    };
    assert!(off("scores", values(out.scores.clone())) <= 2e-5);
    assert!(off("ltrb", values(out.ltrb.clone())) <= 2e-5);
    let weights = LossWeights::default();
    let l = losses(
        weights,
        out.scores,
        inputs.search_labels,
        out.ltrb,
        inputs.search_ltrb,
        &batch.region,
    );
    for (name, got) in [("loss", &l.total), ("loss_clf", &l.classification), ("loss_giou", &l.giou)]
    {
        assert!(off(name, values(got.clone())) <= 1e-5 * want(name)[0], "{name}");
    }
    let got = gradients(&net, &l.total.backward());
    let mut rows = Vec::new();
    for (name, want) in case.iter().filter_map(|(n, t)| Some((n.strip_prefix("grad.")?, t))) {
        let (scale, want) = (want.values[0], &want.values[1..]);
        let Some(tensor) = got.get(name) else {
            assert!(name == DEAD && scale == 0.0, "no gradient for {name}");
            continue;
        };
        let (peak, got) = thinned(&tensor.values);
        if NOISE.contains(&name) {
            assert!(peak < 1e-3 && scale < 1e-3, "{name}: {peak} {scale}");
            continue;
        }
        let off = difference(&got, want).max((peak - scale).abs());
        rows.push((off / scale, scale, name));
    }
    rows.sort_by(|a, b| b.0.total_cmp(&a.0));
    println!(
        "{} gradients; the largest differences, relative to each tensor's maximum:",
        rows.len()
    );
    for (off, scale, name) in rows.iter().take(8) {
        println!("  {off:.1e} of {scale:9.3e} {name}");
    }
    assert_eq!(rows.len(), 124);
    assert!(rows[0].0 <= 1e-4, "{:?}", rows[0]);
    // Frozen layers and statistics have none.
    let trains = |name: &str| !name.starts_with("feature_extractor.") || name.contains(".layer3.");
    assert!(got.names().all(|name| trains(name) && !name.contains("running_")));

    // Statistics of the box MLP's batch norms after the forward pass.
    let after = state_dict(&net.valid());
    for (name, want) in case.iter().filter_map(|(n, t)| Some((n.strip_prefix("after.")?, t))) {
        let off = difference(&after.get(name).unwrap().values, &want.values);
        println!("after.{name}: within {off:.1e}");
        assert!(off <= 1e-6, "{name}: {off}");
    }
}

/// The parameters after one step as `fit` takes it.
fn stepped(experiment: &Experiment) -> StateDict {
    let device = Device::flex().autodiff();
    let mut state = State::start(experiment, net(), &device);
    let net_rate = optim::learning_rate(&experiment.optim, &optim::backbone_group().unwrap(), 1.0);
    let rates = Rates { net: net_rate, align: experiment.optim.lr_head };
    let weights = LossWeights { classification: experiment.loss.cls, giou: experiment.loss.reg };
    let figures =
        train_step(&mut state, &[golden_batch()], experiment, weights, rates, &[device]).unwrap();
    assert!((figures.loss - 322.776).abs() < 1e-2, "{figures:?}");
    state_dict(&state.net.valid())
}

#[test]
fn the_optimiser_step_equals_the_reference() {
    let case = committed("training_step.safetensors");
    // The defaults are the reference's (spec 2.7).
    let experiment = Experiment::default();
    let after = stepped(&experiment);
    let mut compared = 0;
    for (name, want) in case.iter().filter_map(|(n, t)| Some((n.strip_prefix("after_step.")?, t))) {
        let tensor = after.get(name).unwrap();
        let (peak, got) = thinned(&tensor.values);
        let (scale, want) = (want.values[0], &want.values[1..]);
        let off = difference(&got, want).max((peak - scale).abs()) / scale;
        // A first step is the learning rate times the gradient's sign, so compare the steps too.
        let (_, before) = thinned(&recipe(name, &tensor.shape));
        let optim = &experiment.optim;
        let rate = if name.starts_with("head.") { optim.lr_head } else { optim.lr_backbone } as f32;
        let steps = got.iter().zip(want).zip(&before);
        let same = steps.filter(|((g, w), b)| ((*g - *b) - (*w - *b)).abs() <= 0.01 * rate).count();
        let longest = want.iter().zip(&before).fold(0.0f32, |m, (w, b)| m.max((w - b).abs()));
        println!(
            "{name}: within {off:.1e} of its maximum; {same} of {} steps within 1 % of {rate:.0e}",
            got.len()
        );
        assert!(off <= 1e-4, "{name}: {off}");
        assert!(same * 100 >= got.len() * 98, "{name}: {same} of {}", got.len());
        assert!((longest / rate - 1.0).abs() < 0.01, "{name}: {longest}");
        compared += 1;
    }
    assert_eq!(compared, 5);
    // What is frozen, and the backbone's statistics, are as they were (spec 2.6).
    let mut frozen = 0;
    for (name, tensor) in after.iter().filter(|(name, _)| name.starts_with("feature_extractor.")) {
        if !name.contains(".layer3.") || name.contains("running_") {
            assert!(tensor.values == recipe(name, &tensor.shape), "{name} has changed");
            frozen += 1;
        }
    }
    assert!(frozen > 40, "{frozen}");
}

#[test]
fn weight_decay_acts_on_every_parameter_that_trains() {
    let mut experiment = Experiment::default();
    // A tenth of every weight of the head in one step, 2 % of the backbone's.
    experiment.optim.weight_decay = 1000.0;
    let after = stepped(&experiment);
    let mut decayed = 0;
    for (name, tensor) in after.iter() {
        let head = name.starts_with("head.");
        if name.contains("running_") || !(head || name.contains(".layer3.")) {
            continue;
        }
        let (keep, rate) = if head { (0.9, 1e-4) } else { (0.98, 2e-5) };
        let before = recipe(name, &tensor.shape);
        for (a, b) in tensor.values.iter().zip(&before) {
            assert!((a - keep * b).abs() <= 1.01 * rate + 1e-6, "{name}: {b} to {a}");
        }
        decayed += 1;
    }
    // All 127 tensors of the reference's gradients, with the weights nothing reaches.
    assert_eq!(decayed, 127);
    let dead = after.get(DEAD).unwrap();
    let before = recipe(DEAD, &dead.shape);
    assert!(dead.values.iter().zip(&before).all(|(a, b)| (a - 0.9 * b).abs() <= 1e-6));
}

/// Gradient `-coefficient` through a value that stays the same but for rounding.
fn reversed(x: Tensor<2>, coefficient: f64) -> Tensor<2> {
    let negative = x.clone().mul_scalar(-coefficient);
    negative.clone() + (x - negative).detach()
}

/// The golden step with alignment from the first step on.
fn joint() -> Experiment {
    let mut experiment = Experiment::default();
    experiment.align.preset = AlignPreset::Joint;
    experiment.align.start_step = Some(0);
    experiment
}

#[test]
fn alignment_in_parts_equals_one_graph() {
    let (experiment, batch, net) = (joint(), golden_batch(), net());
    let device = Device::flex().autodiff();
    device.seed(3);
    let width = usize::from(net.spec().width);
    let branches = Branches::new(&experiment.align, width, &device).unwrap();
    let (template, search) = ([true, false, true], [true, true, false]);
    let forward = || {
        let inputs = Inputs::new(&batch, net.spec(), &device);
        net.forward_train(
            inputs.template_crops,
            inputs.search_crops,
            inputs.template_labels,
            inputs.template_ltrb,
        )
    };
    let output = forward();
    // What the training pass keeps is what the report's own functions compute.
    let inputs = Inputs::new(&batch, net.spec(), &device);
    let [b, t, d, f, _] = output.template_features.dims();
    let templates = output.template_features.clone().reshape([b * t, d, f, f]);
    let search_features = output.search_features.clone();
    let (want_template, want_search) = net.pool_encoded(
        templates.clone(),
        search_features.clone(),
        inputs.template_labels,
        inputs.template_ltrb,
    );
    let (pre, post) = (output.pooled_features(), output.pooled_encoded());
    for (got, want) in [
        (&pre.0, TrackerNet::pool_features(templates, t)),
        (&pre.1, TrackerNet::pool_features(search_features, 1)),
        (&post.0, want_template),
        (&post.1, want_search),
    ] {
        assert!(difference(&values(got.clone()), &values(want)) <= 1e-6);
    }
    let sensors: [&[bool]; 2] = [&template, &search];
    let step = align_step(&branches, &experiment.align, 1.0, &output, sensors).unwrap();
    let got = gradients(&net, &step.bridge.backward());

    // All in one graph, through the discriminator and the projection.
    let output = forward();
    let (pre, post) = (output.pooled_features(), output.pooled_encoded());
    let discriminator = branches.discriminator.as_ref().unwrap();
    let projection = branches.projection.as_ref().unwrap();
    let logits = [pre.0, pre.1].map(|x| discriminator.forward(reversed(x, 0.1)));
    let total = discriminator_loss(logits, sensors).mul_scalar(0.3)
        + info_nce(projection.forward(post.0), projection.forward(post.1), 0.1).mul_scalar(0.1);
    assert!((f64::from(total.clone().into_scalar::<f32>()) - step.loss).abs() < 1e-5);
    let want = gradients(&net, &total.backward());
    let mut reached = 0;
    for (name, want) in want.iter() {
        let got = &got.get(name).unwrap().values;
        let scale = want.values.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        let off = difference(got, &want.values);
        // Mathematically zero gradients (biases in front of norms, keys) are rounding noise.
        assert!(off <= 2e-5 * scale + 1e-8, "{name}: {off:.1e} of {scale:.1e}");
        reached += 1;
    }
    // The encoder and the backbone are reached, the decoder and the heads are not.
    assert!(reached > 30, "{reached}");
    assert!(want.names().any(|n| n.starts_with("feature_extractor.")));
    assert!(got.names().any(|n| n.contains("transformer.encoder.")));
    assert!(!got.names().any(|n| n.contains("decoder.") || n.contains("bb_regressor")));
}

#[test]
fn a_step_with_alignment_moves_both_branches_and_reports_them() {
    let device = Device::flex().autodiff();
    let take = |experiment: &Experiment, batch: &Batch| {
        let mut state = State::start(experiment, net(), &device);
        let before = state.align.as_ref().map(|a| a.branches.clone());
        let rates = Rates {
            net: optim::learning_rate(&experiment.optim, &optim::backbone_group().unwrap(), 1.0),
            align: 1e-3,
        };
        let weights = LossWeights::default();
        let (batch, devices) = (std::slice::from_ref(batch), std::slice::from_ref(&device));
        let figures = train_step(&mut state, batch, experiment, weights, rates, devices);
        (figures, before, state)
    };
    let mut batch = golden_batch();
    batch.thermal = vec![true, false, false];
    batch.cross = vec![true, true, false];
    let (plain, _, _) = take(&Experiment::default(), &batch);
    let plain = plain.unwrap();
    assert!(plain.align.is_empty());
    let (figures, before, state) = take(&joint(), &batch);
    let figures = figures.unwrap();
    let names: Vec<&str> = figures.align.keys().copied().collect();
    let want = [
        "adversarial",
        "adversarial_pull",
        "contrastive",
        "contrastive_pull",
        "discriminator_accuracy",
        "discriminator_grad_norm",
        "projection_grad_norm",
    ];
    assert_eq!(names, want);
    let aligned = 0.3 * figures.align["adversarial"] + 0.1 * figures.align["contrastive"];
    assert!((figures.loss - plain.loss - aligned).abs() < 1e-4 * plain.loss);
    assert!((figures.cls - plain.cls).abs() < 1e-9);
    let (before, after) = (before.unwrap(), state.align.unwrap().branches);
    let moved = |a: &burn::nn::Linear, b: &burn::nn::Linear| {
        let off = difference(&values(a.weight.val().inner()), &values(b.weight.val().inner()));
        assert!((5e-4..2e-3).contains(&off), "{off}");
    };
    let layers = |b: &Branches| {
        let first = &b.discriminator.as_ref().unwrap().layers[0];
        (first.clone(), b.projection.as_ref().unwrap().layers[1].clone())
    };
    moved(&layers(&before).0, &layers(&after).0);
    moved(&layers(&before).1, &layers(&after).1);
    // Before its start, a run with alignment is a run without.
    let mut later = joint();
    later.align.start_step = Some(1);
    let (figures, _, _) = take(&later, &batch);
    let figures = figures.unwrap();
    assert_eq!((figures.loss, figures.align.len()), (plain.loss, 0));
}

#[test]
fn a_step_that_is_not_finite_changes_nothing() {
    let device = Device::flex().autodiff();
    let experiment = joint();
    let mut state = State::start(&experiment, net(), &device);
    let before = state_dict(&state.net.valid());
    // The tracker's losses are fine, only alignment is not.
    let branches = &mut state.align.as_mut().unwrap().branches;
    let layer = &mut branches.discriminator.as_mut().unwrap().layers[0];
    layer.weight = layer.weight.clone().map(|w| w.mul_scalar(f32::INFINITY));
    let rates = Rates {
        net: optim::learning_rate(&experiment.optim, &optim::backbone_group().unwrap(), 1.0),
        align: 1e-3,
    };
    let batch = golden_batch();
    let weights = LossWeights::default();
    let ids = batch.ids.clone();
    let e = train_step(&mut state, &[batch], &experiment, weights, rates, &[device]).unwrap_err();
    let FitError::NotFinite { what, ids: named, .. } = e else { panic!("{e}") };
    assert_eq!((what, named), ("alignment loss", ids));
    let after = state_dict(&state.net.valid());
    for (name, tensor) in before.iter() {
        // Statistics of the box MLP follow the forward pass.
        let same = tensor.values == after.get(name).unwrap().values;
        assert!(same || name.contains("running_"), "{name} has changed");
    }
}
