//! Alignment of the two sensors' descriptors, in training only (paper, sections 3 and 4).
//!
//! Two branches, each optional and each on descriptors of its own stage
//! ([`crate::model::TrainOutput::pooled_features`] or `pooled_encoded`):
//!
//! * **adversarial**: a discriminator has to tell the sensor of a descriptor, and through gradient
//!   reversal the network is trained to make that impossible;
//! * **contrastive**: symmetric InfoNCE between the template and the search descriptor of a sample,
//!   with the other samples of the batch as negatives.
//!
//! A branch is computed on copies of the descriptors that are cut off from the network. Its backward
//! pass gives the gradients of its own parameters and of the descriptors; the latter, times minus
//! the reversal coefficient for the adversarial branch, enter the network's backward pass as the
//! gradient of `sum(descriptor * constant)`. So reversal is exact (no value changes, no rounding in
//! the forward pass), the parameters of network and branches cannot get into each other's gradients,
//! and what alignment asks of the network can be logged on its own.
//!
//! [`Branches`] are no part of [`crate::model::TrackerNet`]: weights files and bundles never hold
//! them.

mod branches;
mod losses;
#[cfg(test)]
mod tests;

pub use branches::{Branches, Discriminator, Projection};
pub use losses::{discriminator_accuracy, discriminator_loss, info_nce};

use crate::config::{AlignConfig, AlignStage};
use crate::model::TrainOutput;
use burn::module::Module;
use burn::optim::GradientsParams;
use burn::prelude::*;
use std::collections::BTreeMap;

/// Figures of a step by the names they have in logs.
pub type Figures = BTreeMap<&'static str, f64>;

/// Templates' and search frames' descriptors of a batch, `(B, d)` each.
pub type Descriptors = (Tensor<2>, Tensor<2>);

/// What the branches say about a batch.
pub struct AlignStep {
    /// Weighted sum of the branches' losses.
    pub loss: f64,
    /// To be added to what the network runs its backward pass on: a scalar whose gradients are what
    /// the branches send into the descriptors. Its value means nothing.
    pub bridge: Tensor<1>,
    /// Gradients of the discriminator's parameters.
    pub discriminator: Option<GradientsParams>,
    /// Gradients of the projection's parameters.
    pub projection: Option<GradientsParams>,
    /// `adversarial` and `contrastive` (unweighted losses), `discriminator_accuracy`, and
    /// `adversarial_pull`, `contrastive_pull`: the norm of the gradient that each branch sends into
    /// the descriptors, weight and reversal included.
    pub figures: Figures,
}

/// One branch's contribution.
struct Part {
    /// Unweighted.
    loss: f64,
    bridge: Tensor<1>,
    pull: f64,
    /// Of the branch's own parameters.
    gradients: GradientsParams,
}

/// Runs `loss` on cut-off copies of the descriptors. The network gets `sign` times the gradient of
/// `weight * loss`.
fn part<M: Module>(
    branch: &M,
    descriptors: &Descriptors,
    weight: f64,
    sign: f64,
    loss: impl FnOnce(&M, Tensor<2>, Tensor<2>) -> Tensor<1>,
) -> Part {
    let leaf = |t: &Tensor<2>| Tensor::from_inner(t.clone().inner()).require_grad();
    let leaves = [leaf(&descriptors.0), leaf(&descriptors.1)];
    let loss = loss(branch, leaves[0].clone(), leaves[1].clone());
    let value = f64::from(loss.clone().into_scalar::<f32>());
    let mut gradients = loss.mul_scalar(weight).backward();
    let mut bridge = Tensor::zeros([1], &descriptors.0.device());
    let mut squares = 0.0;
    for (leaf, descriptor) in leaves.iter().zip([&descriptors.0, &descriptors.1]) {
        // None when the loss does not depend on the descriptor.
        let Some(gradient) = leaf.grad_remove(&mut gradients) else { continue };
        let gradient = gradient.mul_scalar(sign);
        squares += f64::from(gradient.clone().powi_scalar(2).sum().into_scalar::<f32>());
        bridge = bridge + (descriptor.clone() * Tensor::from_inner(gradient)).sum();
    }
    let gradients = GradientsParams::from_grads(gradients, branch);
    Part { loss: value, bridge, pull: squares.sqrt(), gradients }
}

/// Losses and gradients of all branches for a batch. `factor` scales both weights; `thermal` says
/// which samples have thermal templates and which have a thermal search frame, `B` each. `None` when
/// there are no branches.
pub fn align_step(
    branches: &Branches,
    config: &AlignConfig,
    factor: f64,
    output: &TrainOutput,
    thermal: [&[bool]; 2],
) -> Option<AlignStep> {
    let descriptors = |stage| match stage {
        AlignStage::Pre => output.pooled_features(),
        AlignStage::Encoder => output.pooled_encoded(),
    };
    align_descriptors(branches, config, factor, descriptors, thermal)
}

/// [`align_step`] on the descriptors of a stage, wherever they are from.
fn align_descriptors(
    branches: &Branches,
    config: &AlignConfig,
    factor: f64,
    descriptors: impl Fn(AlignStage) -> Descriptors,
    thermal: [&[bool]; 2],
) -> Option<AlignStep> {
    let mut figures = Figures::new();
    let adversarial = config.adversarial().zip(branches.discriminator.as_ref()).map(|(b, d)| {
        let weight = factor * b.weight;
        let mut accuracy = 0.0;
        let part = part(d, &descriptors(b.stage), weight, -b.reversal, |d, template, search| {
            let logits = [d.forward(template), d.forward(search)];
            accuracy = discriminator_accuracy(&logits, thermal);
            discriminator_loss(logits, thermal)
        });
        figures.insert("adversarial", part.loss);
        figures.insert("discriminator_accuracy", accuracy);
        figures.insert("adversarial_pull", part.pull);
        (weight, part)
    });
    let contrastive = config.contrastive().zip(branches.projection.as_ref()).map(|(b, p)| {
        let weight = factor * b.weight;
        let part = part(p, &descriptors(b.stage), weight, 1.0, |p, template, search| {
            info_nce(p.forward(template), p.forward(search), b.temperature)
        });
        figures.insert("contrastive", part.loss);
        figures.insert("contrastive_pull", part.pull);
        (weight, part)
    });
    let parts = || [&adversarial, &contrastive].into_iter().flatten();
    let loss = parts().map(|(weight, part)| weight * part.loss).sum();
    let bridge = parts().map(|(_, part)| part.bridge.clone()).reduce(|a, b| a + b)?;
    Some(AlignStep {
        loss,
        bridge,
        discriminator: adversarial.map(|(_, part)| part.gradients),
        projection: contrastive.map(|(_, part)| part.gradients),
        figures,
    })
}
