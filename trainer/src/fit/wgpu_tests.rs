//! Training steps on a graphics device against the same steps on the CPU.
//!
//! `tests/wgpu/run.sh` runs these on Mesa's software driver. Without any device they say "skipped",
//! unless `TSDA_REQUIRE_WGPU` is set.

use super::step::{Gradients, StepFigures, gradients};
use super::step_tests::{NOISE, golden_batch};
use super::throughput::synthetic_batch;
use super::*;
use crate::config::AlignPreset;
use crate::import::StateDict;
use crate::model::tests::{self as model, NO_DROPOUT, difference, recipe_net, small};
use burn::tensor::DeviceKind;
use std::sync::OnceLock;
use tsda_runtime::ModelSpec;

/// Loss and figures, relative (measured: 5e-6).
const LOSS_TOLERANCE: f64 = 1e-4;
/// Gradients, relative to the largest one of the tensor (measured: 1.1e-5).
const GRADIENT_TOLERANCE: f32 = 2e-4;
/// Losses after optimiser steps, relative (measured: 3e-5).
const STEPS_TOLERANCE: f64 = 1e-3;

/// The graphics device, opened once (burn refuses to open one twice).
fn wgpu() -> Option<Device> {
    static DEVICE: OnceLock<Result<Device, String>> = OnceLock::new();
    let device = DEVICE.get_or_init(|| Device::wgpu_options().init().map_err(|e| e.to_string()));
    match device {
        Ok(device) => Some(device.clone()),
        Err(e) if std::env::var_os("TSDA_REQUIRE_WGPU").is_none() => {
            println!("skipped: no graphics device ({e})");
            None
        }
        Err(e) => panic!("no graphics device: {e}"),
    }
}

/// Both alignment branches, from the first step on; AdamW as shipped.
fn joint() -> Experiment {
    let mut experiment = Experiment::default();
    experiment.align.preset = AlignPreset::Joint;
    experiment.align.start_step = Some(0);
    experiment
}

fn tiny(spec: ModelSpec) -> ModelSpec {
    ModelSpec { crop: 64, width: 32, feed_forward: 64, ltrb_hidden: 16, ..spec }
}

/// Samples of both sensors.
fn batch(spec: &ModelSpec) -> Batch {
    sensors(synthetic_batch(spec, 2, 2))
}

fn sensors(mut batch: Batch) -> Batch {
    batch.thermal = (0..batch.size).map(|i| i % 2 == 0).collect();
    batch.cross = (0..batch.size).map(|i| i % 3 == 0).collect();
    batch
}

/// The recipe's weights on a device. Branches are drawn on the CPU, whose generator differs.
fn state(experiment: &Experiment, spec: &ModelSpec, device: &Device) -> State {
    let cpu = Device::flex().autodiff();
    let net = recipe_net(spec, &NO_DROPOUT, device);
    let mut state = State::start(experiment, net, device);
    let drawn = State::start(experiment, recipe_net(spec, &NO_DROPOUT, &cpu), &cpu);
    if let (Some(align), Some(drawn)) = (&mut state.align, drawn.align) {
        align.branches = drawn.branches.valid().fork(&device.clone().inner()).train();
    }
    state
}

fn first_gradients(
    experiment: &Experiment,
    spec: &ModelSpec,
    batches: &[Batch],
    devices: &[Device],
) -> (StateDict, StepFigures) {
    let state = state(experiment, spec, &devices[0]);
    let mut figures = StepFigures::default();
    let weights = LossWeights { classification: 100.0, giou: 5.0 };
    let Gradients { net, .. } =
        gradients(&state, batches, experiment, weights, devices, &mut figures).unwrap();
    (model::gradients(&state.net, &net), figures)
}

/// Differences relative to each tensor's largest value, the largest difference first.
fn differences(got: &StateDict, want: &StateDict) -> Vec<(f32, f32, String)> {
    assert_eq!(got.names().collect::<Vec<_>>(), want.names().collect::<Vec<_>>());
    let mut rows: Vec<_> = want
        .iter()
        .filter(|(name, _)| !NOISE.contains(name))
        .map(|(name, want)| {
            let scale = want.values.iter().fold(f32::MIN_POSITIVE, |m, v| m.max(v.abs()));
            let off = difference(&got.get(name).unwrap().values, &want.values);
            (off / scale, scale, name.to_owned())
        })
        .collect();
    rows.sort_by(|a, b| b.0.total_cmp(&a.0));
    rows
}

fn near(what: &str, got: f64, want: f64, tolerance: f64) {
    let off = (got - want).abs() / want.abs().max(1e-3);
    println!("{what}: {got:.7} against {want:.7} on the CPU, {off:.1e}");
    assert!(off <= tolerance, "{what}: {got} against {want}");
}

#[test]
fn losses_and_gradients_equal_those_of_the_cpu() {
    let Some(device) = wgpu() else { return };
    let experiment = joint();
    let (nano, pico) = (tiny(ModelSpec::NANO), tiny(ModelSpec::PICO_V3));
    // One network per backbone family.
    let cases = [
        ("ResNet", small(true), sensors(golden_batch())),
        ("EfficientNet-Lite0", nano, batch(&nano)),
        ("MobileNetV3", pico, batch(&pico)),
    ];
    for (name, spec, batch) in cases {
        let batches = [batch];
        let run = |device: &Device| {
            first_gradients(&experiment, &spec, &batches, &[device.clone().autodiff()])
        };
        let (want, want_figures) = run(&Device::flex());
        let (got, figures) = run(&device);
        near(&format!("{name} loss"), figures.loss, want_figures.loss, LOSS_TOLERANCE);
        near(&format!("{name} cls"), figures.cls, want_figures.cls, LOSS_TOLERANCE);
        near(&format!("{name} giou"), figures.giou, want_figures.giou, LOSS_TOLERANCE);
        for (figure, want) in &want_figures.align {
            near(&format!("{name} {figure}"), figures.align[figure], *want, LOSS_TOLERANCE);
        }
        let rows = differences(&got, &want);
        println!("{name}: {} gradients, the largest differences:", rows.len());
        for (off, scale, tensor) in rows.iter().take(4) {
            println!("  {off:.1e} of {scale:.3e} {tensor}");
        }
        assert!(rows.len() > 100 && rows[0].0 <= GRADIENT_TOLERANCE, "{name}: {:?}", rows[0]);
    }
}

#[test]
fn optimiser_steps_go_where_those_of_the_cpu_go() {
    let Some(device) = wgpu() else { return };
    let mut experiment = joint();
    experiment.optim.lr_head = 1e-3;
    experiment.optim.clip_norm = 10.0;
    experiment.optim.ema_decay = 0.9;
    let spec = tiny(ModelSpec::NANO);
    let batches = [batch(&spec), batch(&spec)];
    let run = |device: &Device| {
        let device = device.clone().autodiff();
        let mut state = state(&experiment, &spec, &device);
        let mut step = || {
            let rates = Rates {
                net: optim::learning_rate(
                    &experiment.optim,
                    &optim::backbone_group().unwrap(),
                    1.0,
                ),
                align: 1e-3,
            };
            let devices = std::slice::from_ref(&device);
            let weights = LossWeights::default();
            let figures =
                train_step(&mut state, &batches, &experiment, weights, rates, devices).unwrap();
            state.step += 1;
            figures.loss
        };
        let losses: Vec<f64> = (0..5).map(|_| step()).collect();
        losses
    };
    let (want, got) = (run(&Device::flex()), run(&device));
    for (step, (got, want)) in got.iter().zip(&want).enumerate() {
        near(&format!("loss of step {step}"), *got, *want, STEPS_TOLERANCE);
    }
    assert!(got[4] < 0.9 * got[0], "nothing learned: {got:?}");
}

#[test]
fn two_graphics_devices_give_the_gradients_of_one() {
    let Some(device) = wgpu() else { return };
    // A second queue on a software adapter; a machine whose only adapter is a GPU has none.
    let other = Device::wgpu_options().device_kind(DeviceKind::Cpu).init();
    let Ok(other) = other else {
        println!("skipped: no second graphics device");
        return;
    };
    let experiment = joint();
    let spec = tiny(ModelSpec::PICO_V3);
    let batches = [(); 4].map(|()| batch(&spec));
    let (one, other) = (device.autodiff(), other.autodiff());
    let (want, _) = first_gradients(&experiment, &spec, &batches, std::slice::from_ref(&one));
    let (got, _) = first_gradients(&experiment, &spec, &batches, &[one, other]);
    let rows = differences(&got, &want);
    println!("largest difference of {}: {:?}", rows.len(), rows[0]);
    assert!(rows[0].0 <= 1e-5, "{:?}", rows[0]);
}
