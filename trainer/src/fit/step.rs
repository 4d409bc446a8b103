//! One optimiser step.

use super::state::State;
use super::tensors::Inputs;
use super::throughput::StepTimes;
use super::{FitError, optim};
use crate::align::{Figures, align_step};
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

/// Takes a step on a batch. When a loss or a gradient is not finite, nothing is changed.
pub(super) fn train_step(
    state: &mut State,
    batch: &Batch,
    experiment: &Experiment,
    weights: LossWeights,
    rates: Rates,
    device: &Device,
) -> Result<StepFigures, FitError> {
    let step = state.step;
    let finite = |what: &'static str, value: f32| {
        if value.is_finite() {
            return Ok(f64::from(value));
        }
        Err(FitError::NotFinite { step, what, value, ids: batch.ids.clone() })
    };
    let started = Instant::now();
    let inputs = Inputs::new(batch, state.net.spec(), device);
    let output = state.net.forward_train(
        inputs.template_crops,
        inputs.search_crops,
        inputs.template_labels,
        inputs.template_ltrb,
    );
    let aligned =
        state.align.as_ref().zip(experiment.align_factor(step)).and_then(|(a, factor)| {
            let search: Vec<bool> = batch
                .thermal
                .iter()
                .zip(&batch.cross)
                .map(|(thermal, cross)| thermal ^ cross)
                .collect();
            align_step(&a.branches, &experiment.align, factor, &output, [&batch.thermal, &search])
        });
    let l = losses(
        weights,
        output.scores,
        inputs.search_labels,
        output.ltrb,
        inputs.search_ltrb,
        &batch.region,
    );
    let mut loss = finite("loss", l.total.clone().into_scalar::<f32>())?;
    let cls = f64::from(l.classification.into_scalar::<f32>());
    let giou = f64::from(l.giou.into_scalar::<f32>());
    let mut root = l.total;
    let mut align = Figures::new();
    if let (Some(aligned), Some(branches)) = (&aligned, &state.align) {
        loss += finite("alignment loss", aligned.loss as f32)?;
        root = root + aligned.bridge.clone();
        align.extend(&aligned.figures);
        for (name, norm) in branches.gradient_norms(aligned) {
            align.insert(name, finite(name, norm)?);
        }
    }
    let forward = started.elapsed();
    let gradients = GradientsParams::from_grads(root.backward(), &state.net);
    let backward = started.elapsed() - forward;
    let gradients = optim::complete(&state.net, gradients);
    let norm = optim::gradient_norm(&state.net, &gradients);
    let grad_norm = finite("gradient norm", norm)?;
    let clip = experiment.optim.clip_norm;
    let gradients = optim::clip(&state.net, gradients, norm, clip);
    if let (Some(aligned), Some(branches)) = (aligned, &mut state.align) {
        branches.update(rates.align, aligned, clip);
    }
    state.update(rates.net, gradients, experiment.optim.ema_decay);
    let times = StepTimes { forward, backward, update: started.elapsed() - forward - backward };
    Ok(StepFigures { loss, cls, giou, grad_norm, align, times })
}
