//! Validation on drawn samples: losses and the overlap of the box at the highest score.

use super::tensors::Inputs;
use super::{FitError, device_error};
use crate::losses::{LossWeights, losses};
use crate::model::TrackerNet;
use crate::processing::{Batch, BatchMaker};
use burn::prelude::*;
use serde::Serialize;
use tsda_runtime::{BBox, ModelSpec};

/// Figures of one group of validation samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Group {
    /// Samples whose target lies in the search crop.
    pub samples: usize,
    /// Mean classification loss.
    pub cls: f64,
    /// Mean box loss over the samples that have cells to take it at.
    pub giou: f64,
    /// Mean overlap of the predicted and the true box.
    pub iou: f64,
    /// Share of samples with an overlap of at least 0.5.
    pub success: f64,
}

/// Figures of one validation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Validation {
    /// All samples.
    pub all: Group,
    /// Templates and search frame from one sensor.
    pub same: Group,
    /// Search frame from the other sensor.
    pub cross: Group,
}

#[derive(Default)]
struct Sums {
    samples: usize,
    boxed: usize,
    cls: f64,
    giou: f64,
    iou: f64,
    success: usize,
}

impl Sums {
    fn mean(&self) -> Group {
        let per = |sum: f64, n: usize| if n == 0 { 0.0 } else { sum / n as f64 };
        Group {
            samples: self.samples,
            cls: per(self.cls, self.samples),
            giou: per(self.giou, self.boxed),
            iou: per(self.iou, self.samples),
            success: per(self.success as f64, self.samples),
        }
    }
}

/// Box in crop pixels at the cell with the highest score. `scores` is `(F, F)`, `ltrb`
/// `(4, F, F)` in crop sides.
pub fn best_box(spec: &ModelSpec, scores: &[f32], ltrb: &[f32]) -> BBox {
    let (side, cells, crop) = (spec.map_side(), spec.cells(), spec.crop_side() as f32);
    let best = (0..cells).fold(0, |best, i| if scores[i] > scores[best] { i } else { best });
    let x = tsda_runtime::labels::cell_centre(best % side);
    let y = tsda_runtime::labels::cell_centre(best / side);
    let [l, t, r, b] = std::array::from_fn(|i| ltrb[i * cells + best] * crop);
    BBox::new(x - l, y - t, l + r, t + b)
}

/// Runs the network (an inference copy) over the first `samples` samples of `maker`.
pub(super) fn validate(
    net: &TrackerNet,
    maker: &BatchMaker,
    samples: usize,
    batch: usize,
    weights: LossWeights,
    device: &Device,
) -> Result<Validation, FitError> {
    let mut sums = [Sums::default(), Sums::default()];
    let mut done = 0;
    while done < samples {
        let count = batch.min(samples - done);
        let data = maker.range(done as u64, count)?;
        add(net, &data, weights, device, &mut sums)?;
        done += count;
    }
    let [same, cross] = &sums;
    let all = Sums {
        samples: same.samples + cross.samples,
        boxed: same.boxed + cross.boxed,
        cls: same.cls + cross.cls,
        giou: same.giou + cross.giou,
        iou: same.iou + cross.iou,
        success: same.success + cross.success,
    };
    Ok(Validation { all: all.mean(), same: same.mean(), cross: cross.mean() })
}

fn add(
    net: &TrackerNet,
    data: &Batch,
    weights: LossWeights,
    device: &Device,
    sums: &mut [Sums; 2],
) -> Result<(), FitError> {
    let spec = net.spec();
    let inputs = Inputs::new(data, spec, device);
    let output = net.forward_train(
        inputs.template_crops,
        inputs.search_crops,
        inputs.template_labels,
        inputs.template_ltrb,
    );
    let read = |t: TensorData| t.try_to_vec::<f32>().map_err(device_error);
    let all_scores = read(output.scores.clone().into_data())?;
    let all_ltrb = read(output.ltrb.clone().into_data())?;
    let cells = spec.cells();
    for i in 0..data.size {
        let truth = data.search_boxes[i];
        let (cx, cy) = truth.centre();
        let side = spec.crop_side() as f32;
        // A target jittered out of the crop cannot be found; its overlap would mean nothing.
        if !(0.0..side).contains(&cx) || !(0.0..side).contains(&cy) {
            continue;
        }
        let region = &data.region[i * cells..][..cells];
        let one = losses(
            weights,
            output.scores.clone().narrow(0, i, 1),
            inputs.search_labels.clone().narrow(0, i, 1),
            output.ltrb.clone().narrow(0, i, 1),
            inputs.search_ltrb.clone().narrow(0, i, 1),
            region,
        );
        let sum = &mut sums[usize::from(data.cross[i])];
        sum.samples += 1;
        sum.cls += f64::from(one.classification.into_scalar::<f32>());
        if region.contains(&true) {
            sum.boxed += 1;
            sum.giou += f64::from(one.giou.into_scalar::<f32>());
        }
        let found = best_box(
            spec,
            &all_scores[i * cells..][..cells],
            &all_ltrb[i * 4 * cells..][..4 * cells],
        );
        let iou = found.iou(&truth);
        sum.iou += f64::from(iou);
        sum.success += usize::from(iou >= 0.5);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_box_of_the_best_cell_is_read() {
        let spec = ModelSpec::NANO; // 160 px, 10 x 10 cells
        let mut scores = vec![0.0; 100];
        scores[3 * 10 + 4] = 1.0;
        let mut ltrb = vec![0.0; 400];
        for (i, v) in [0.1, 0.05, 0.2, 0.15].into_iter().enumerate() {
            ltrb[i * 100 + 34] = v;
        }
        let b = best_box(&spec, &scores, &ltrb);
        for (a, w) in [(b.x, 72.0 - 16.0), (b.y, 56.0 - 8.0), (b.w, 48.0), (b.h, 32.0)] {
            assert!((a - w).abs() < 1e-3, "{b:?}");
        }
    }
}
