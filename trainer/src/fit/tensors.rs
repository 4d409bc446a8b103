//! A batch on a device.

use crate::processing::Batch;
use burn::prelude::*;
use tsda_runtime::ModelSpec;

/// Tensors of one [`Batch`]; shapes as written there.
pub(super) struct Inputs {
    pub template_crops: Tensor<4>,
    pub template_labels: Tensor<3>,
    pub template_ltrb: Tensor<4>,
    pub search_crops: Tensor<4>,
    pub search_labels: Tensor<3>,
    pub search_ltrb: Tensor<4>,
}

impl Inputs {
    pub fn new(batch: &Batch, spec: &ModelSpec, device: &Device) -> Self {
        let (side, map) = (spec.crop_side(), spec.map_side());
        let (b, t) = (batch.size, batch.size * batch.templates);
        let tensor4 = |v: &[f32], shape: [usize; 4]| {
            Tensor::<4>::from_data(TensorData::new(v.to_vec(), shape), device)
        };
        let tensor3 = |v: &[f32], n: usize| {
            Tensor::<3>::from_data(TensorData::new(v.to_vec(), [n, map, map]), device)
        };
        Self {
            template_crops: tensor4(&batch.template_crops, [t, 3, side, side]),
            template_labels: tensor3(&batch.template_labels, t),
            template_ltrb: tensor4(&batch.template_ltrb, [t, 4, map, map]),
            search_crops: tensor4(&batch.search_crops, [b, 3, side, side]),
            search_labels: tensor3(&batch.search_labels, b),
            search_ltrb: tensor4(&batch.search_ltrb, [b, 4, map, map]),
        }
    }
}
