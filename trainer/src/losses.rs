//! Losses of spec 2.5.

use burn::prelude::*;
use burn::tensor::activation::relu;

/// Cells whose label is below this are background (spec 2.5).
pub const LABEL_THRESHOLD: f32 = 0.05;

/// Factors of the two losses in the total.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Of [`classification_loss`]; 100 in ToMP and TSDA-Track.
    pub classification: f64,
    /// Of [`giou_loss`]; 1 in ToMP, 5 in TSDA-Track.
    pub giou: f64,
}

impl Default for LossWeights {
    fn default() -> Self {
        Self { classification: 100.0, giou: 1.0 }
    }
}

/// The losses of one batch, each a tensor of one element.
#[derive(Clone, Debug)]
pub struct Losses {
    /// Weighted sum; call `backward` on it.
    pub total: Tensor<1>,
    /// Unweighted classification loss.
    pub classification: Tensor<1>,
    /// Unweighted box loss.
    pub giou: Tensor<1>,
}

/// Both losses of a batch and their weighted sum.
///
/// `scores` and `label` are `(B, F, F)`; `ltrb` and `ltrb_target` are `(B, 4, F, F)`, `region` is
/// `(B, F, F)` row-major, true where a cell takes part in the box loss (spec 2.4).
pub fn losses(
    weights: LossWeights,
    scores: Tensor<3>,
    label: Tensor<3>,
    ltrb: Tensor<4>,
    ltrb_target: Tensor<4>,
    region: &[bool],
) -> Losses {
    let classification = classification_loss(scores, label);
    let giou = giou_loss(ltrb, ltrb_target, region);
    let total = classification.clone().mul_scalar(weights.classification)
        + giou.clone().mul_scalar(weights.giou);
    Losses { total, classification, giou }
}

/// Hinge on the background, squared error on the target (spec 2.5), mean over all cells.
///
/// Shapes of `scores` and `label` are equal.
pub fn classification_loss<const D: usize>(scores: Tensor<D>, label: Tensor<D>) -> Tensor<1> {
    let background = label.clone().lower_scalar(LABEL_THRESHOLD);
    let hinged = relu(scores.clone());
    let prediction = scores.mask_where(background.clone(), hinged);
    let target = label.mask_fill(background, 0.0);
    (prediction - target).powi_scalar(2).mean()
}

/// Generalised IoU loss of distances at the same cell, mean over the region's cells of the whole
/// batch; over **all** cells when the region is empty (spec 2.5, quirk Q10).
///
/// `prediction` and `target` are `(B, 4, H, W)`; `region` holds `B * H * W` flags, row-major. A
/// region of another length counts as empty where it is too short.
pub fn giou_loss(prediction: Tensor<4>, target: Tensor<4>, region: &[bool]) -> Tensor<1> {
    let flat = |t: Tensor<4>| {
        let [b, c, h, w] = t.dims();
        t.permute([0, 2, 3, 1]).reshape([b * h * w, c])
    };
    let (mut prediction, mut target) = (flat(prediction), flat(target));
    let cells = prediction.dims()[0];
    let chosen: Vec<i32> =
        region.iter().take(cells).enumerate().filter(|(_, r)| **r).map(|(i, _)| i as i32).collect();
    if !chosen.is_empty() {
        // Selecting, rather than multiplying by a mask, keeps cells outside the region (whose
        // targets may be negative) from turning the loss into NaN.
        let index = Tensor::<1, Int>::from_data(chosen.as_slice(), &prediction.device());
        prediction = prediction.select(0, index.clone());
        target = target.select(0, index);
    }
    giou_terms(prediction, target).mean()
}

/// `1 - GIoU` per row of two `(N, 4)` tensors of distances. Intersections are not clamped.
fn giou_terms(prediction: Tensor<2>, target: Tensor<2>) -> Tensor<2> {
    // Sum of opposite distances, (N, 1): width from 0 + 2, height from 1 + 3.
    let side = |t: &Tensor<2>, i: usize| t.clone().narrow(1, i, 1) + t.clone().narrow(1, i + 2, 1);
    let least = prediction.clone().min_pair(target.clone());
    let most = prediction.clone().max_pair(target.clone());
    let intersection = side(&least, 0) * side(&least, 1);
    let union = side(&target, 0) * side(&target, 1) + side(&prediction, 0) * side(&prediction, 1)
        - intersection.clone();
    let union = union.add_scalar(1e-7);
    let hull = (side(&most, 0) * side(&most, 1)).add_scalar(1e-7);
    let giou = intersection / union.clone() - (hull.clone() - union) / hull;
    giou.neg().add_scalar(1.0)
}

#[cfg(test)]
mod tests;
