//! Several batches per step, on one device and on several.

use super::step::{Gradients, StepFigures, gradients};
use super::throughput::synthetic_batch;
use super::*;
use crate::config::AlignPreset;
use crate::import::{StateDict, state_dict};
use crate::model::tests::{self as model, NO_DROPOUT, difference, recipe_net, values};
use burn::module::ParamGroup;
use tsda_runtime::ModelSpec;

const TEMPLATES: usize = 2;

fn tiny() -> ModelSpec {
    ModelSpec { crop: 64, width: 32, feed_forward: 64, ltrb_hidden: 16, ..ModelSpec::NANO }
}

/// A state on the CPU. `frozen`: the batch norms of the box MLP use their running statistics.
fn state(experiment: &Experiment, frozen: bool) -> State {
    let device = Device::flex().autodiff();
    let net = recipe_net(&tiny(), &NO_DROPOUT, &device);
    let group = ParamGroup::from_regex(r"box_encoding\.bn").unwrap();
    State::start(experiment, if frozen { net.freeze_group(group) } else { net }, &device)
}

/// Eight samples of both sensors.
fn batch() -> Batch {
    let mut batch = synthetic_batch(&tiny(), 8, TEMPLATES);
    batch.thermal = (0..8).map(|i| i % 3 == 0).collect();
    batch.cross = (0..8).map(|i| i % 2 == 0).collect();
    batch
}

/// Consecutive parts of a batch.
fn parts(batch: &Batch, count: usize) -> Vec<Batch> {
    let size = batch.size / count;
    (0..count)
        .map(|i| {
            fn part<T: Clone>(all: &[T], of: usize, i: usize) -> Vec<T> {
                all.chunks_exact(all.len() / of).nth(i).unwrap().to_vec()
            }
            Batch {
                size,
                templates: batch.templates,
                ids: part(&batch.ids, count, i),
                cross: part(&batch.cross, count, i),
                thermal: part(&batch.thermal, count, i),
                template_crops: part(&batch.template_crops, count, i),
                template_labels: part(&batch.template_labels, count, i),
                template_ltrb: part(&batch.template_ltrb, count, i),
                search_crops: part(&batch.search_crops, count, i),
                search_labels: part(&batch.search_labels, count, i),
                search_ltrb: part(&batch.search_ltrb, count, i),
                region: part(&batch.region, count, i),
                present: part(&batch.present, count, i),
                search_boxes: part(&batch.search_boxes, count, i),
            }
        })
        .collect()
}

/// Alignment without in-batch negatives, from the first step on.
fn adversarial() -> Experiment {
    let mut experiment = Experiment::default();
    experiment.align.preset = AlignPreset::PreAfa;
    experiment.align.start_step = Some(0);
    experiment
}

fn run(state: &State, batches: &[Batch], experiment: &Experiment) -> (Gradients, StepFigures) {
    let devices = [Device::flex().autodiff()];
    let mut figures = StepFigures::default();
    let weights = LossWeights { classification: 100.0, giou: 5.0 };
    let found = gradients(state, batches, experiment, weights, &devices, &mut figures).unwrap();
    (found, figures)
}

/// The largest difference of two sets of gradients, relative to each tensor's maximum.
fn worst(got: &StateDict, want: &StateDict) -> (f32, String) {
    assert!(want.names().count() > 40);
    assert_eq!(got.names().collect::<Vec<_>>(), want.names().collect::<Vec<_>>());
    let off = |(name, want): (&str, &crate::import::StateTensor)| {
        let scale = want.values.iter().fold(1e-6f32, |m, v| m.max(v.abs()));
        (difference(&got.get(name).unwrap().values, &want.values) / scale, name.to_owned())
    };
    want.iter().map(off).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap()
}

#[test]
fn two_batches_of_four_have_the_gradients_of_one_of_eight() {
    let experiment = adversarial();
    let whole = batch();
    // Box regions of very different size, and none at all in the second half.
    let mut uneven = whole.clone();
    let cells = uneven.region.len() / 8;
    uneven.region[..3 * cells].fill(false);
    let mut half = whole.clone();
    half.region[4 * cells..].fill(false);
    let mut none = whole.clone();
    none.region.fill(false);
    let mut absent = none.clone();
    absent.present.fill(false);
    absent.search_labels.fill(0.0);
    let cases = [
        ("even", whole, &[2, 4][..]),
        ("uneven", uneven, &[2]),
        ("half", half, &[4]),
        ("none", none, &[2]),
        ("absent", absent, &[2]),
    ];
    for (what, batch, counts) in cases {
        let state = state(&experiment, true);
        let (one, one_figures) = run(&state, std::slice::from_ref(&batch), &experiment);
        for &count in counts {
            let (many, figures) = run(&state, &parts(&batch, count), &experiment);
            let dict = |g: &Gradients| model::gradients(&state.net, &g.net);
            let (off, name) = worst(&dict(&many), &dict(&one));
            println!("{what}, {count} parts: within {off:.1e} ({name})");
            assert!(off <= 2e-4, "{what}, {count} parts: {name} is off by {off}");
            let near = |a: f64, b: f64| (a - b).abs() <= 1e-5 * b.abs().max(1e-3);
            assert!(near(figures.loss, one_figures.loss), "{figures:?} {one_figures:?}");
            assert!(near(figures.cls, one_figures.cls) && near(figures.giou, one_figures.giou));
            assert_eq!(one_figures.align.len(), 3);
            for (name, want) in &one_figures.align {
                assert!((figures.align[name] - want).abs() <= 1e-4 * want, "{name}: {figures:?}");
            }
            // The discriminator's own.
            let branches = &state.align.as_ref().unwrap().branches;
            let layer = &branches.discriminator.as_ref().unwrap().layers[0].weight;
            let of = |g: &Gradients| values(g.align.discriminator.get::<2>(layer.id).unwrap());
            let (many, one) = (of(&many), of(&one));
            let scale = one.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            assert!(difference(&many, &one) <= 1e-4 * scale, "{what}, {count} parts");
        }
    }
    // With statistics of their own, batches of four are not a batch of eight.
    let state = state(&experiment, false);
    let (one, _) = run(&state, &[batch()], &experiment);
    let (many, _) = run(&state, &parts(&batch(), 2), &experiment);
    let dict = |g: &Gradients| model::gradients(&state.net, &g.net);
    assert!(worst(&dict(&many), &dict(&one)).0 > 1e-2);
}

#[test]
fn several_devices_take_the_step_of_one() {
    let mut experiment = Experiment::default();
    experiment.align.preset = AlignPreset::Joint;
    experiment.align.start_step = Some(0);
    experiment.optim.clip_norm = 1.0;
    let batches = parts(&batch(), 4);
    // Drawn once: burn's random generator is shared with the tests beside this one.
    let branches = state(&experiment, false).align.unwrap().branches;
    let stepped = |devices: usize| {
        let devices = vec![Device::flex().autodiff(); devices];
        let mut state = state(&experiment, false);
        state.align.as_mut().unwrap().branches = branches.clone();
        let mut losses = Vec::new();
        for _ in 0..2 {
            let rates = Rates {
                net: optim::learning_rate(
                    &experiment.optim,
                    &optim::backbone_group().unwrap(),
                    1.0,
                ),
                align: 1e-3,
            };
            let weights = LossWeights::default();
            let figures =
                train_step(&mut state, &batches, &experiment, weights, rates, &devices).unwrap();
            losses.push(figures.loss);
            state.step += 1;
        }
        let branches = state.align.as_ref().unwrap().branches.clone();
        let branch = values(branches.projection.unwrap().layers[0].weight.val());
        (state_dict(&state.net.valid()), branch, losses)
    };
    let (one, one_branch, one_losses) = stepped(1);
    for count in [2, 4] {
        let (many, branch, losses) = stepped(count);
        assert_eq!(losses, one_losses, "{count} devices");
        assert!(branch == one_branch, "{count} devices");
        let mut statistics = 0;
        for (name, want) in one.iter() {
            let same = many.get(name).unwrap().values == want.values;
            // Those of the batches on the first device.
            let own = name.contains("box_encoding") && name.contains("running_");
            assert_eq!(same, !own, "{count} devices: {name}");
            statistics += usize::from(own);
        }
        assert_eq!(statistics, 4);
    }
}

#[test]
fn batches_that_cannot_be_spread_evenly_are_refused() {
    let options = FitOptions { more_devices: vec![Device::flex(); 2], ..Default::default() };
    for accumulate in [1, 2, 4] {
        let mut experiment = Experiment::default();
        experiment.run.accumulate = accumulate;
        let e = fit(&experiment, &options).unwrap_err();
        assert!(matches!(e, FitError::Devices { devices: 3, .. }), "{e}");
        let text = e.to_string();
        assert!(text.contains(&format!("run.accumulate = {accumulate} cannot")), "{text}");
    }
}
