//! The stages one by one, written as in the reference: batch norms stand by themselves, nothing is
//! folded.

use super::super::layers::{Conv, FrozenBatchNorm};
use super::{Bottleneck, EPSILON, ResNet};
use burn::prelude::*;
use burn::tensor::activation::relu;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;

/// Batch norm with its running statistics.
fn norm(bn: &FrozenBatchNorm, x: Tensor<4>) -> Tensor<4> {
    let c = x.dims()[1];
    let per_channel = |t: Tensor<1>| t.reshape([1, c, 1, 1]);
    let scale = bn.weight.val() / bn.running_var.val().add_scalar(EPSILON).sqrt();
    let shift = bn.bias.val() - bn.running_mean.val() * scale.clone();
    x * per_channel(scale) + per_channel(shift)
}

fn step(conv: &Conv, bn: &FrozenBatchNorm, x: Tensor<4>) -> Tensor<4> {
    norm(bn, conv.forward(x))
}

impl Bottleneck {
    fn inspect(&self, x: Tensor<4>) -> Tensor<4> {
        let shortcut = match &self.downsample {
            Some(d) => step(&d.conv, &d.bn, x.clone()),
            None => x.clone(),
        };
        let y = relu(step(&self.conv1, &self.bn1, x));
        let y = relu(step(&self.conv2, &self.bn2, y));
        relu(step(&self.conv3, &self.bn3, y) + shortcut)
    }
}

impl ResNet {
    /// Output of the pooled stem and of stages one to three, by the names of the golden figures.
    pub fn inspect(&self, crops: Tensor<4>) -> Vec<(&'static str, Tensor<4>)> {
        let pool = MaxPoolOptions {
            kernel_size: [3; 2],
            stride: [2; 2],
            padding: [(1, 1); 2],
            dilation: [1; 2],
            ceil_mode: false,
        };
        let mut x = max_pool2d(relu(step(&self.conv1, &self.bn1, crops)), pool);
        let mut maps = vec![("bb.maxpool", x.clone())];
        for (name, stage) in
            [("bb.layer1", &self.layer1), ("bb.layer2", &self.layer2), ("bb.layer3", &self.layer3)]
        {
            for block in stage {
                x = block.inspect(x);
            }
            maps.push((name, x.clone()));
        }
        maps
    }
}
