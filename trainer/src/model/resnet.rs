//! Bottleneck ResNet up to its third stage (spec 1.2).

mod inspect;

use super::layers::{Activation, Conv, FrozenBatchNorm, Geometry, conv_bn};
use burn::prelude::*;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;

const EPSILON: f64 = 1e-5;

/// Projection shortcut.
#[derive(Module, Debug)]
pub(crate) struct Downsample {
    conv: Conv,
    bn: FrozenBatchNorm,
}

/// 1x1, 3x3 (carries the stride), 1x1, each with batch norm, and the shortcut.
#[derive(Module, Debug)]
pub(crate) struct Bottleneck {
    conv1: Conv,
    bn1: FrozenBatchNorm,
    conv2: Conv,
    bn2: FrozenBatchNorm,
    conv3: Conv,
    bn3: FrozenBatchNorm,
    downsample: Option<Downsample>,
}

impl Bottleneck {
    fn new(inp: usize, mid: usize, stride: usize, project: bool, device: &Device) -> Self {
        let out = 4 * mid;
        let conv = |i, o, k, s| Conv::new(i, o, Geometry::centred(k, s), false, device);
        let bn = |c| FrozenBatchNorm::new(c, EPSILON, device);
        Self {
            conv1: conv(inp, mid, 1, 1),
            bn1: bn(mid),
            conv2: conv(mid, mid, 3, stride),
            bn2: bn(mid),
            conv3: conv(mid, out, 1, 1),
            bn3: bn(out),
            downsample: project
                .then(|| Downsample { conv: conv(inp, out, 1, stride), bn: bn(out) }),
        }
    }

    fn forward(&self, x: Tensor<4>, on_graph: bool) -> Tensor<4> {
        let shortcut = match &self.downsample {
            Some(d) => conv_bn(&d.conv, &d.bn, Activation::Identity, on_graph, x.clone()),
            None => x.clone(),
        };
        let y = conv_bn(&self.conv1, &self.bn1, Activation::Relu, on_graph, x);
        let y = conv_bn(&self.conv2, &self.bn2, Activation::Relu, on_graph, y);
        let y = conv_bn(&self.conv3, &self.bn3, Activation::Identity, on_graph, y);
        Activation::Relu.apply(y + shortcut)
    }
}

/// Stem and stages one to three.
#[derive(Module, Debug)]
pub(crate) struct ResNet {
    conv1: Conv,
    bn1: FrozenBatchNorm,
    layer1: Vec<Bottleneck>,
    layer2: Vec<Bottleneck>,
    layer3: Vec<Bottleneck>,
}

impl ResNet {
    /// Random weights; `base` channels in the stem, `blocks` bottlenecks per stage.
    pub fn new(base: usize, blocks: [u8; 3], device: &Device) -> Self {
        let stage = |index: usize| -> Vec<Bottleneck> {
            let mid = base << index;
            (0..blocks[index])
                .map(|i| {
                    let inp = match (i, index) {
                        (0, 0) => base,
                        (0, _) => 2 * mid,
                        _ => 4 * mid,
                    };
                    let stride = if i == 0 && index > 0 { 2 } else { 1 };
                    Bottleneck::new(inp, mid, stride, i == 0, device)
                })
                .collect()
        };
        Self {
            conv1: Conv::new(3, base, Geometry::centred(7, 2), false, device),
            bn1: FrozenBatchNorm::new(base, EPSILON, device),
            layer1: stage(0),
            layer2: stage(1),
            layer3: stage(2),
        }
    }

    /// `(B, 3, S, S)` to `(B, 16 base, S/16, S/16)`. The first `frozen` stages (0 to 4, the stem
    /// counts as one) stay outside autodiff.
    pub fn forward(&self, x: Tensor<4>, frozen: usize) -> Tensor<4> {
        let stem = frozen < 1;
        let x = if stem { x } else { x.inner() };
        let x = conv_bn(&self.conv1, &self.bn1, Activation::Relu, stem, x);
        let pool = MaxPoolOptions {
            kernel_size: [3; 2],
            stride: [2; 2],
            padding: [(1, 1); 2],
            dilation: [1; 2],
            ceil_mode: false,
        };
        let mut x = max_pool2d(x, pool);
        for (i, stage) in [&self.layer1, &self.layer2, &self.layer3].into_iter().enumerate() {
            let on_graph = frozen < i + 2;
            for block in stage {
                x = block.forward(x, on_graph);
            }
        }
        x
    }
}
