//! EfficientNet-Lite0 up to its last stride-16 stage.
//!
//! No squeeze-excite, ReLU6, batch-norm eps 1e-3, TensorFlow "SAME" padding. Crops are multiples of
//! 16, so every stride-2 layer sees an even side and its padding is a constant.

use super::layers::{Activation, Conv, FrozenBatchNorm, Geometry, WideConv, conv_bn};
use burn::prelude::*;
use rayon::prelude::*;

const EPSILON: f64 = 1e-3;

/// One stage: kernel, stride of its first block, expansion, channels in and out, blocks.
struct Stage {
    kernel: usize,
    stride: usize,
    expand: usize,
    inp: usize,
    out: usize,
    blocks: usize,
}

/// The stages up to stride 16; the published network goes on with two more at stride 32.
const STAGES: [Stage; 5] = [
    Stage { kernel: 3, stride: 1, expand: 1, inp: 32, out: 16, blocks: 1 },
    Stage { kernel: 3, stride: 2, expand: 6, inp: 16, out: 24, blocks: 2 },
    Stage { kernel: 5, stride: 2, expand: 6, inp: 24, out: 40, blocks: 2 },
    Stage { kernel: 3, stride: 2, expand: 6, inp: 40, out: 80, blocks: 3 },
    Stage { kernel: 5, stride: 1, expand: 6, inp: 80, out: 112, blocks: 3 },
];

/// Blocks of the cut network, 0..=10.
pub(crate) const BLOCKS: usize = 11;

/// Inverted residual: 1x1 expansion, depthwise, 1x1 projection without activation.
#[derive(Module, Debug)]
pub(crate) struct MbConv {
    expand_conv: Option<Conv>,
    bn0: Option<FrozenBatchNorm>,
    depthwise_conv: Conv,
    bn1: FrozenBatchNorm,
    project_conv: Conv,
    bn2: FrozenBatchNorm,
    residual: bool,
}

impl MbConv {
    fn new(stage: &Stage, first: bool, device: &Device) -> Self {
        let (inp, stride) = if first { (stage.inp, stage.stride) } else { (stage.out, 1) };
        let mid = inp * stage.expand;
        let expands = stage.expand != 1;
        let pointwise = |i, o| Conv::new(i, o, Geometry::same(1, 1, 1), false, device);
        let bn = |c| FrozenBatchNorm::new(c, EPSILON, device);
        let depthwise = Geometry::same(stage.kernel, stride, mid);
        Self {
            expand_conv: expands.then(|| pointwise(inp, mid)),
            bn0: expands.then(|| bn(mid)),
            depthwise_conv: Conv::new(mid, mid, depthwise, false, device),
            bn1: bn(mid),
            project_conv: pointwise(mid, stage.out),
            bn2: bn(stage.out),
            residual: stride == 1 && inp == stage.out,
        }
    }

    fn forward(&self, x: Tensor<4>, on_graph: bool) -> Tensor<4> {
        let y = match (&self.expand_conv, &self.bn0) {
            (Some(conv), Some(bn)) => conv_bn(conv, bn, Activation::Relu6, on_graph, x.clone()),
            _ => x.clone(),
        };
        let y = conv_bn(&self.depthwise_conv, &self.bn1, Activation::Relu6, on_graph, y);
        let y = conv_bn(&self.project_conv, &self.bn2, Activation::Identity, on_graph, y);
        if self.residual { y + x } else { y }
    }

    /// Ready for batch-wide maps.
    fn wide(&self, on_graph: bool) -> WideMbConv {
        let fold = |conv, bn| WideConv::new(conv, bn, on_graph);
        WideMbConv {
            expand: self.expand_conv.as_ref().zip(self.bn0.as_ref()).map(|(c, b)| fold(c, b)),
            depthwise: fold(&self.depthwise_conv, &self.bn1),
            project: fold(&self.project_conv, &self.bn2),
            residual: self.residual,
        }
    }
}

/// [`MbConv`] on batch-wide maps `(C, N, H, W)`.
struct WideMbConv {
    expand: Option<WideConv>,
    depthwise: WideConv,
    project: WideConv,
    residual: bool,
}

impl WideMbConv {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let y = match &self.expand {
            Some(expand) => expand.pointwise_relu6(x.clone()),
            None => x.clone(),
        };
        let y = self.project.pointwise(self.depthwise.depthwise_relu6(y));
        if self.residual { y + x } else { y }
    }
}

/// Stem and blocks 0..=10.
#[derive(Module, Debug)]
pub(crate) struct EfficientNetLite0 {
    conv_stem: Conv,
    bn0: FrozenBatchNorm,
    blocks: Vec<MbConv>,
}

impl EfficientNetLite0 {
    /// Random weights.
    pub fn new(device: &Device) -> Self {
        Self {
            conv_stem: Conv::new(3, 32, Geometry::same(3, 2, 1), false, device),
            bn0: FrozenBatchNorm::new(32, EPSILON, device),
            blocks: STAGES
                .iter()
                .flat_map(|stage| {
                    (0..stage.blocks).map(move |i| MbConv::new(stage, i == 0, device))
                })
                .collect(),
        }
    }

    /// `(B, 3, S, S)` to `(B, 112, S/16, S/16)`. With `frozen` > 0 the stem and the first
    /// `frozen - 1` blocks stay outside autodiff.
    pub fn forward(&self, x: Tensor<4>, frozen: usize) -> Tensor<4> {
        let stem = frozen < 1;
        let x = if stem { x } else { x.inner() };
        let mut x = conv_bn(&self.conv_stem, &self.bn0, Activation::Relu6, stem, x);
        for (i, block) in self.blocks.iter().enumerate() {
            x = block.forward(x, frozen < i + 2);
        }
        x
    }

    /// [`Self::forward`] for training on the CPU, as a batch-wide map `(112, B, S/16, S/16)`. At
    /// least the stem has to be frozen.
    pub fn forward_wide(&self, x: Tensor<4>, frozen: usize) -> Tensor<4> {
        let leading = frozen.saturating_sub(1).min(self.blocks.len());
        let wide = |blocks: &[MbConv], on_graph| -> Vec<WideMbConv> {
            blocks.iter().map(|block| block.wide(on_graph)).collect()
        };
        let frozen = wide(&self.blocks[..leading], false);
        let trained = wide(&self.blocks[leading..], true);
        // Image by image: the large early maps stay in the cache, and every core has its own.
        let images: Vec<Tensor<4>> = x.inner().split(1, 0);
        let maps: Vec<Tensor<4>> = images
            .into_par_iter()
            .map(|image| {
                let x = conv_bn(&self.conv_stem, &self.bn0, Activation::Relu6, false, image);
                frozen.iter().fold(x.swap_dims(0, 1), |x, block| block.forward(x))
            })
            .collect();
        trained.iter().fold(Tensor::cat(maps, 1), |x, block| block.forward(x))
    }
}
