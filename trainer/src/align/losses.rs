//! The two alignment losses.

use burn::prelude::*;
use burn::tensor::activation::{log_sigmoid, log_softmax};

/// Added to squared lengths so that a zero vector has a direction (none) and a gradient.
const TINY: f64 = 1e-24;

/// Labels `(B, 1)`: 1 for thermal.
fn labels(thermal: &[bool], device: &Device) -> Tensor<2> {
    let values: Vec<f32> = thermal.iter().map(|t| f32::from(u8::from(*t))).collect();
    Tensor::from_data(TensorData::new(values, [thermal.len(), 1]), device)
}

/// Binary cross-entropy of logits `(B, 1)` (positive: thermal), mean over the batch.
fn binary_cross_entropy(logits: Tensor<2>, thermal: &[bool]) -> Tensor<1> {
    let label = labels(thermal, &logits.device());
    let other = label.clone().neg().add_scalar(1.0);
    (label * log_sigmoid(logits.clone()) + other * log_sigmoid(logits.neg())).mean().neg()
}

/// The discriminator's loss: half the sum of the binary cross-entropies of templates and of search
/// frames. Logits are `(B, 1)`, positive for thermal; `thermal` are the sensors, `B` each.
pub fn discriminator_loss(logits: [Tensor<2>; 2], thermal: [&[bool]; 2]) -> Tensor<1> {
    let [template, search] = logits;
    let sum = binary_cross_entropy(template, thermal[0]) + binary_cross_entropy(search, thermal[1]);
    sum.mul_scalar(0.5)
}

/// Share of the descriptors, templates and search frames together, whose sensor is told.
pub fn discriminator_accuracy(logits: &[Tensor<2>; 2], thermal: [&[bool]; 2]) -> f64 {
    let (mut right, mut all) = (0usize, 0usize);
    for (logits, thermal) in logits.iter().zip(thermal) {
        let values = logits.clone().inner().into_data();
        right += values.iter::<f32>().zip(thermal).filter(|(v, t)| (*v > 0.0) == **t).count();
        all += thermal.len();
    }
    right as f64 / all.max(1) as f64
}

/// Rows of unit length.
fn unit(x: Tensor<2>) -> Tensor<2> {
    let length = x.clone().powi_scalar(2).sum_dim(1).add_scalar(TINY).sqrt();
    x / length
}

/// Symmetric InfoNCE of `(B, k)` projections, each row brought to unit length: the mean of the
/// cross-entropies of finding, by `cosine / temperature`, a template's search frame among all search
/// frames of the batch and a search frame's template among all templates.
pub fn info_nce(template: Tensor<2>, search: Tensor<2>, temperature: f64) -> Tensor<1> {
    let b = template.dims()[0];
    let device = template.device();
    let logits = unit(template).matmul(unit(search).transpose()).div_scalar(temperature);
    let both = log_softmax(logits.clone(), 1) + log_softmax(logits, 0);
    // The diagonal: every sample's own partner.
    let own = Tensor::from_inner(Tensor::<2>::eye(b, &device.inner()));
    (both * own).sum().mul_scalar(-0.5 / b as f64)
}
