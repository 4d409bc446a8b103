//! The branches' parameters.

use crate::config::AlignConfig;
use crate::model::linear_layer;
use burn::module::Module;
use burn::nn::Linear;
use burn::prelude::*;
use burn::tensor::activation::relu;

/// Linear layers with a ReLU between each two.
fn layers(widths: &[usize], device: &Device) -> Vec<Linear> {
    widths.windows(2).map(|w| linear_layer(w[0], w[1], device)).collect()
}

fn forward(layers: &[Linear], x: Tensor<2>, normalise: bool) -> Tensor<2> {
    let x = if normalise { standardised(x) } else { x };
    layers.iter().enumerate().fold(x, |x, (i, layer)| {
        let x = if i == 0 { x } else { relu(x) };
        layer.forward(x)
    })
}

/// Says from which sensor a descriptor comes.
#[derive(Module, Debug)]
pub struct Discriminator {
    pub(crate) layers: Vec<Linear>,
    normalise: bool,
}

impl Discriminator {
    /// Logits `(B, 1)`, positive for thermal, of descriptors `(B, d)`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        forward(&self.layers, x, self.normalise)
    }
}

/// Rows of mean 0 and variance 1.
fn standardised(x: Tensor<2>) -> Tensor<2> {
    let x = x.clone() - x.mean_dim(1);
    let variance = x.clone().powi_scalar(2).mean_dim(1);
    // Descriptors' variances are around 1e-3 and below; a larger number would not leave them alone.
    x / variance.add_scalar(1e-8).sqrt()
}

/// Maps descriptors to where they are compared; one for templates and search frames.
#[derive(Module, Debug)]
pub struct Projection {
    pub(crate) layers: Vec<Linear>,
    normalise: bool,
}

impl Projection {
    /// Projections `(B, k)`, of any length, of descriptors `(B, d)`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        forward(&self.layers, x, self.normalise)
    }
}

/// All that alignment adds to a training run.
#[derive(Module, Debug)]
pub struct Branches {
    /// Of the adversarial branch.
    pub discriminator: Option<Discriminator>,
    /// Of the contrastive branch.
    pub projection: Option<Projection>,
}

impl Branches {
    /// Fresh branches for descriptors of `width` numbers (PyTorch's default initialisation);
    /// randomness comes from `device.seed`. `None` when the run has none.
    pub fn new(config: &AlignConfig, width: usize, device: &Device) -> Option<Self> {
        let widths = |hidden: &[usize], out: usize| -> Vec<usize> {
            [width].into_iter().chain(hidden.iter().copied()).chain([out]).collect()
        };
        let discriminator = config.adversarial().map(|b| Discriminator {
            layers: layers(&widths(&b.hidden, 1), device),
            normalise: b.normalise,
        });
        let projection = config.contrastive().map(|b| Projection {
            layers: layers(&widths(&b.hidden, b.dim), device),
            normalise: b.normalise,
        });
        let any = discriminator.is_some() || projection.is_some();
        any.then_some(Self { discriminator, projection })
    }
}
