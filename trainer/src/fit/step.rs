//! One optimiser step.

use super::alignment::AlignGradients;
use super::replica::Replica;
use super::state::State;
use super::tensors::Inputs;
use super::throughput::StepTimes;
use super::{FitError, mix, optim};
use crate::align::{AlignStep, Figures, align_step};
use crate::config::Experiment;
use crate::losses::{LossWeights, losses};
use crate::processing::Batch;
use burn::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::GradientsParams;
use burn::prelude::*;
use std::time::Instant;

/// Figures of one step.
#[derive(Clone, Debug, Default)]
pub(super) struct StepFigures {
    /// The total, alignment included.
    pub loss: f64,
    pub cls: f64,
    pub giou: f64,
    /// Of the network, alignment included.
    pub grad_norm: f64,
    /// Of the alignment branches, while they are on.
    pub align: Figures,
    /// What its parts took.
    pub times: StepTimes,
}

/// Learning rates of a step.
pub(super) struct Rates {
    pub net: ModuleLearningRate,
    pub align: f64,
}

/// Takes a step on batches of one size: the gradient is that of the mean over all their samples,
/// batch statistics and in-batch negatives apart, which stay within a batch. When a loss or a
/// gradient is not finite, nothing is changed.
///
/// Batch `k` is computed on device `k % devices.len()`, autodiff devices all; the state lives on the
/// first. Gradients are added in the order of the batches, so on devices of one kind their number
/// changes nothing but batch statistics.
pub(super) fn train_step(
    state: &mut State,
    batches: &[Batch],
    experiment: &Experiment,
    weights: LossWeights,
    rates: Rates,
    devices: &[Device],
) -> Result<StepFigures, FitError> {
    let mut figures = StepFigures::default();
    let Gradients { net: gradients, align } =
        gradients(state, batches, experiment, weights, devices, &mut figures)?;
    let started = Instant::now();
    let ids = || batches.iter().flat_map(|batch| batch.ids.iter().cloned()).collect();
    let step = state.step;
    if let Some(alignment) = &state.align {
        for (name, norm) in alignment.gradient_norms(&align) {
            figures.align.insert(name, finite(step, name, norm, ids)?);
        }
    }
    let gradients = optim::complete(&state.net, gradients);
    let norm = optim::gradient_norm(&state.net, &gradients);
    figures.grad_norm = finite(step, "gradient norm", norm, ids)?;
    let clip = experiment.optim.clip_norm;
    let gradients = optim::clip(&state.net, gradients, norm, clip);
    if let Some(alignment) = &mut state.align {
        alignment.update(rates.align, align, clip);
    }
    state.update(rates.net, gradients, experiment.optim.ema_decay);
    figures.times.update = started.elapsed();
    Ok(figures)
}

/// Gradients of a step, on the device of the state.
pub(super) struct Gradients {
    /// Of the network's parameters.
    pub net: GradientsParams,
    /// Of the alignment branches'.
    pub align: AlignGradients,
}

/// The gradients of [`train_step`]; losses and times are added to `figures`.
pub(super) fn gradients(
    state: &State,
    batches: &[Batch],
    experiment: &Experiment,
    weights: LossWeights,
    devices: &[Device],
    figures: &mut StepFigures,
) -> Result<Gradients, FitError> {
    let home = devices[0].clone().inner();
    let replicas = Replica::all(state, devices);
    let (count, step) = (batches.len() as f64, state.step);
    let shares = giou_shares(batches);
    let mut sum = Gradients { net: GradientsParams::new(), align: AlignGradients::default() };
    let mut jobs = batches.iter().zip(&shares).enumerate();
    loop {
        // One batch per device. Devices that queue their work get all of it before the first
        // result is waited for.
        let started = Instant::now();
        let mut passes = Vec::with_capacity(replicas.len());
        for (replica, (k, (batch, &share))) in replicas.iter().zip(jobs.by_ref()) {
            let index = step * batches.len() as u64 + k as u64;
            replica.device.seed(mix(experiment.run.seed, index));
            let parts = Parts { weights, count, share };
            passes.push((replica, batch, Pass::forward(replica, batch, experiment, step, parts)));
        }
        if passes.is_empty() {
            break;
        }
        for (_, batch, pass) in &passes {
            pass.add_to(figures, step, batch)?;
        }
        let forward = started.elapsed();
        for (replica, _, pass) in passes {
            let new = GradientsParams::from_grads(pass.root.backward(), &replica.net);
            sum.net = optim::add(&state.net, sum.net, new.to_device(&home, &state.net));
            if let (Some(aligned), Some(alignment)) = (pass.aligned, &state.align) {
                sum.align.add(aligned, &alignment.branches, &home);
            }
        }
        figures.times.forward += forward;
        figures.times.backward += started.elapsed() - forward;
    }
    for (name, value) in &mut figures.align {
        // The norm over the descriptors of all batches, summed as squares; the rest are means.
        *value = if is_norm(name) { value.sqrt() } else { *value / count };
    }
    Ok(sum)
}

/// Figures of alignment that are norms of gradients in the descriptors.
fn is_norm(name: &str) -> bool {
    name.ends_with("_pull")
}

/// How much a batch counts in the box loss: its part of the region's cells of all batches, over which
/// the mean is taken. Equal parts where there are none at all (spec 2.5, quirk Q10), and no part where that
/// is because no search crop shows its target.
fn giou_shares(batches: &[Batch]) -> Vec<f64> {
    let cells = |batch: &Batch| batch.region.iter().filter(|r| **r).count() as f64;
    let total: f64 = batches.iter().map(cells).sum();
    let present = batches.iter().any(|batch| batch.present.contains(&true));
    let none = if present { 1.0 / batches.len() as f64 } else { 0.0 };
    let share = |batch| if total > 0.0 { cells(batch) / total } else { none };
    batches.iter().map(share).collect()
}

/// What a batch contributes to the mean over the step.
#[derive(Clone, Copy)]
struct Parts {
    weights: LossWeights,
    /// Batches of the step.
    count: f64,
    /// Of the box loss.
    share: f64,
}

/// The forward pass of one batch.
struct Pass {
    /// What the backward pass starts from.
    root: Tensor<1>,
    /// Weighted tracking losses.
    total: Tensor<1>,
    /// Unweighted, of this batch alone.
    classification: Tensor<1>,
    /// Likewise; `None` where the batch has no part in it.
    giou: Option<Tensor<1>>,
    aligned: Option<AlignStep>,
    parts: Parts,
}

impl Pass {
    fn forward(
        replica: &Replica,
        batch: &Batch,
        experiment: &Experiment,
        step: u64,
        parts: Parts,
    ) -> Self {
        let Parts { weights, count, share } = parts;
        let inputs = Inputs::new(batch, replica.net.spec(), replica.device);
        let output = replica.net.forward_train(
            inputs.template_crops,
            inputs.search_crops,
            inputs.template_labels,
            inputs.template_ltrb,
        );
        let factor = experiment.align_factor(step).map(|factor| factor / count);
        let aligned = replica.branches.as_ref().zip(factor).and_then(|(branches, factor)| {
            let search: Vec<bool> = batch
                .thermal
                .iter()
                .zip(&batch.cross)
                .map(|(thermal, cross)| thermal ^ cross)
                .collect();
            let sensors: [&[bool]; 2] = [&batch.thermal, &search];
            align_step(branches, &experiment.align, factor, &output, sensors)
        });
        let weights = LossWeights {
            classification: weights.classification / count,
            giou: weights.giou * share,
        };
        let l = losses(
            weights,
            output.scores,
            inputs.search_labels,
            output.ltrb,
            inputs.search_ltrb,
            &batch.region,
        );
        // Not times zero: without cells of its own, a batch's box loss would be that of all cells,
        // targets without meaning included.
        let (total, giou) = if share > 0.0 {
            (l.total, Some(l.giou))
        } else {
            (l.classification.clone().mul_scalar(weights.classification), None)
        };
        let root = match &aligned {
            Some(aligned) => total.clone() + aligned.bridge.clone(),
            None => total.clone(),
        };
        Self { root, total, classification: l.classification, giou, aligned, parts }
    }

    /// Adds its losses, waiting for them; refuses those that are not finite.
    fn add_to(&self, figures: &mut StepFigures, step: u64, batch: &Batch) -> Result<(), FitError> {
        let read = |t: &Tensor<1>| t.clone().into_scalar::<f32>();
        let ids = || batch.ids.clone();
        figures.loss += finite(step, "loss", read(&self.total), ids)?;
        figures.cls += f64::from(read(&self.classification)) / self.parts.count;
        if let Some(giou) = &self.giou {
            figures.giou += f64::from(read(giou)) * self.parts.share;
        }
        if let Some(aligned) = &self.aligned {
            figures.loss += finite(step, "alignment loss", aligned.loss as f32, ids)?;
            for (name, value) in &aligned.figures {
                let value = if is_norm(name) { value * value } else { *value };
                *figures.align.entry(name).or_default() += value;
            }
        }
        Ok(())
    }
}

fn finite(
    step: u64,
    what: &'static str,
    value: f32,
    ids: impl Fn() -> Vec<String>,
) -> Result<f64, FitError> {
    if value.is_finite() {
        return Ok(f64::from(value));
    }
    Err(FitError::NotFinite { step, what, value, ids: ids() })
}
