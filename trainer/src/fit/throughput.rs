//! How fast a training step is, without data: the step [`super::fit`] runs, on one made-up batch.

use super::step::{Rates, StepFigures, train_step};
use super::{FitError, optim};
use crate::config::Experiment;
use crate::fit::state::State;
use crate::losses::LossWeights;
use crate::processing::Batch;
use burn::prelude::*;
use serde::Serialize;
use std::time::{Duration, Instant};
use tsda_runtime::labels::{box_centre, gaussian, ltrb, template_maps};
use tsda_runtime::{BBox, ModelSpec};

/// Wall times of the parts of a step.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StepTimes {
    /// Tensors of the batch, network and losses.
    pub forward: Duration,
    /// All gradients.
    pub backward: Duration,
    /// Their norm, the optimiser and the running average.
    pub update: Duration,
}

/// What was measured; times are means over the timed steps.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Throughput {
    /// Samples per batch.
    pub batch: usize,
    /// Batches per step.
    pub accumulate: usize,
    /// Steps timed.
    pub steps: usize,
    /// Samples per second of wall time.
    pub samples_per_s: f64,
    /// User and system time of the process per sample, in milliseconds, where the system tells it
    /// (Linux); the figure to compare on a machine with other work.
    pub cpu_ms_per_sample: Option<f64>,
    /// Milliseconds of a step: batch to device, network and losses.
    pub forward_ms: f64,
    /// Milliseconds of a step: gradients.
    pub backward_ms: f64,
    /// Milliseconds of a step: gradient norm, optimiser and running average.
    pub update_ms: f64,
    /// Milliseconds of the fastest step.
    pub best_step_ms: f64,
    /// Loss of the last step, to see that a faster step still trains the same.
    pub last_loss: f64,
}

/// Times `steps` training steps of `experiment` after `warm_up` others. Its data is not read; batch
/// size, network, losses and optimiser are.
///
/// # Errors
/// As [`super::fit`], data apart.
pub fn throughput(
    experiment: &Experiment,
    device: &Device,
    warm_up: usize,
    steps: usize,
) -> Result<Throughput, FitError> {
    let device = device.clone().autodiff();
    let net = super::initial_net(experiment, &device)?;
    let mut state = State::start(experiment, net, &device);
    let (size, accumulate) = (experiment.run.batch, experiment.run.accumulate);
    let batch = synthetic_batch(&experiment.model_spec()?, size, experiment.sampler.templates);
    let batches = vec![batch; accumulate];
    let weights = LossWeights { classification: experiment.loss.cls, giou: experiment.loss.reg };
    let backbone = optim::backbone_group().map_err(FitError::Device)?;
    let mut step = || -> Result<StepFigures, FitError> {
        let net = optim::learning_rate(&experiment.optim, &backbone, 1.0);
        let rates = Rates { net, align: experiment.align.lr.unwrap_or(experiment.optim.lr_head) };
        let devices = std::slice::from_ref(&device);
        let figures = train_step(&mut state, &batches, experiment, weights, rates, devices)?;
        state.step += 1;
        Ok(figures)
    };
    for _ in 0..warm_up {
        step()?;
    }
    let steps = steps.max(1);
    let mut sum = StepTimes::default();
    let (mut last_loss, mut best) = (0.0, Duration::MAX);
    let (cpu, wall) = (cpu_time(), Instant::now());
    for _ in 0..steps {
        let started = Instant::now();
        let figures = step()?;
        best = best.min(started.elapsed());
        last_loss = figures.loss;
        sum.forward += figures.times.forward;
        sum.backward += figures.times.backward;
        sum.update += figures.times.update;
    }
    let wall = wall.elapsed();
    let cpu = cpu.zip(cpu_time()).map(|(before, after)| after.saturating_sub(before));
    let samples = (steps * size * accumulate) as f64;
    let milliseconds = |t: Duration, n: f64| t.as_secs_f64() * 1e3 / n;
    Ok(Throughput {
        batch: size,
        accumulate,
        steps,
        samples_per_s: samples / wall.as_secs_f64(),
        cpu_ms_per_sample: cpu.map(|t| milliseconds(t, samples)),
        forward_ms: milliseconds(sum.forward, steps as f64),
        backward_ms: milliseconds(sum.backward, steps as f64),
        update_ms: milliseconds(sum.update, steps as f64),
        best_step_ms: milliseconds(best, 1.0),
        last_loss,
    })
}

/// Pixels from a fixed generator, roughly normal as real crops are; boxes around the middle.
pub(super) fn synthetic_batch(spec: &ModelSpec, size: usize, templates: usize) -> Batch {
    let mut seed = 0u64;
    let mut pixels = |count: usize| -> Vec<f32> {
        (0..count)
            .map(|_| {
                seed += 1;
                let bits = super::mix(0, seed);
                // Four uniform numbers of 16 bits: variance 1 after scaling.
                let sum: f32 = (0..4).map(|i| ((bits >> (16 * i)) & 0xffff) as f32 / 65535.0).sum();
                (sum - 2.0) * 3f32.sqrt()
            })
            .collect()
    };
    let side = spec.crop_side() as f32;
    let target = |i: usize| {
        let shift = (i % 5) as f32 * 0.04 - 0.08;
        BBox::new((0.38 + shift) * side, (0.4 - shift) * side, 0.22 * side, 0.2 * side)
    };
    let (mut label, mut edges) = (vec![0.0; spec.cells()], vec![0.0; 4 * spec.cells()]);
    let mut batch = Batch {
        size,
        templates,
        ids: (0..size).map(|i| format!("synthetic {i}")).collect(),
        cross: vec![false; size],
        thermal: vec![false; size],
        template_crops: pixels(size * templates * spec.crop_len()),
        template_labels: Vec::new(),
        template_ltrb: Vec::new(),
        search_crops: pixels(size * spec.crop_len()),
        search_labels: Vec::new(),
        search_ltrb: Vec::new(),
        region: Vec::new(),
        present: vec![true; size],
        search_boxes: (0..size).map(target).collect(),
    };
    for i in 0..size * templates {
        template_maps(spec, &target(i), &mut label, &mut edges);
        batch.template_labels.extend_from_slice(&label);
        batch.template_ltrb.extend_from_slice(&edges);
    }
    for bbox in &batch.search_boxes {
        gaussian(box_centre(spec, bbox), spec.label_sigma_cells(), spec.map_side(), &mut label);
        batch.search_labels.extend_from_slice(&label);
        ltrb(spec, bbox, &mut edges);
        batch.search_ltrb.extend_from_slice(&edges);
        batch.region.extend(label.iter().map(|v| *v > 0.05));
    }
    batch
}

/// User and system time of this process so far.
fn cpu_time() -> Option<Duration> {
    // Fields 14 and 15 behind the name in brackets, in hundredths of a second (USER_HZ of every
    // Linux architecture Rust runs on).
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<u64>().ok();
    Some(Duration::from_millis((ticks()? + ticks()?) * 10))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tiny_network_is_timed() {
        let text = "[model]\npreset = \"nano\"\ncrop = 32\nwidth = 16\nheads = 2\nfeed_forward = 16\n\
            encoder_layers = 1\ndecoder_layers = 1\n[[data]]\nkind = \"pairs\"\npath = \"none\"\n[init]\n\
            backbone = \"scratch\"\n[run]\nbatch = 2\nsteps = 4\n";
        let experiment = Experiment::parse(text, std::path::Path::new("tiny.toml")).unwrap();
        let figures = throughput(&experiment, &Device::flex(), 1, 2).unwrap();
        assert_eq!((figures.batch, figures.steps), (2, 2));
        assert!(figures.last_loss.is_finite() && figures.samples_per_s > 0.0);
        let parts = figures.forward_ms + figures.backward_ms + figures.update_ms;
        assert!(parts * 2.0 <= 2.0 * 2.0 * 1e3 / figures.samples_per_s + 1.0, "{figures:?}");
        if cfg!(target_os = "linux") {
            assert!(cpu_time().is_some() && figures.cpu_ms_per_sample.is_some());
        }
    }
}
