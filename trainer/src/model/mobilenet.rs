//! MobileNetV3-small up to stride 16, with the channels of NanoTrack's backbones.
//!
//! Inverted residuals with ReLU early and hard-swish later, squeeze-excite with hard-sigmoid gates,
//! batch-norm eps 1e-5, symmetric padding `kernel / 2`. In blocks that expand, the gate comes before
//! the activation; the first block does not expand and gates behind it.

use super::kernels::mobile;
use super::layers::{Activation, Conv, FrozenBatchNorm, Geometry, WideConv, conv_bn};
use super::transformer::linear_layer;
use burn::nn::Linear;
use burn::prelude::*;
use burn::tensor::activation::{hard_sigmoid, relu};
use burn::tensor::module::adaptive_avg_pool2d;
use rayon::prelude::*;

const EPSILON: f64 = 1e-5;

/// Channels of the stem.
const STEM: usize = 16;

/// One block: side of the depthwise kernel, expanded channels, channels out, width of the gate's
/// hidden layer (0: no gate), activation, stride.
struct Row {
    kernel: usize,
    mid: usize,
    out: usize,
    gate: usize,
    activation: Activation,
    stride: usize,
}

const fn row(
    kernel: usize,
    mid: usize,
    out: usize,
    gate: usize,
    activation: Activation,
    stride: usize,
) -> Row {
    Row { kernel, mid, out, gate, activation, stride }
}

/// The blocks up to stride 16; the first 8 have 48 channels, all 9 have 96. In MobileNetV3-small the
/// ninth goes down to stride 32, in NanoTrack it does not.
const ROWS: [Row; 9] = [
    row(3, 16, 16, 8, Activation::Relu, 2),
    row(3, 72, 24, 0, Activation::Relu, 2),
    row(3, 88, 24, 0, Activation::Relu, 1),
    row(5, 96, 40, 24, Activation::HardSwish, 2),
    row(5, 240, 40, 64, Activation::HardSwish, 1),
    row(5, 240, 40, 64, Activation::HardSwish, 1),
    row(5, 120, 48, 32, Activation::HardSwish, 1),
    row(5, 144, 48, 40, Activation::HardSwish, 1),
    row(5, 288, 96, 72, Activation::HardSwish, 1),
];

/// Blocks of NanoTrack v2's backbone.
pub(crate) const BLOCKS_V2: usize = 8;
/// Blocks of NanoTrack v3's backbone.
pub(crate) const BLOCKS_V3: usize = 9;
/// Blocks before the first one with stride-16 maps.
pub(crate) const BEFORE_STRIDE16: usize = 3;

/// Squeeze-excite: a factor from 0 to 1 per channel, from the mean of every channel.
#[derive(Module, Debug)]
pub(crate) struct Gate {
    reduce: Linear,
    restore: Linear,
}

impl Gate {
    fn new(channels: usize, hidden: usize, device: &Device) -> Self {
        Self {
            reduce: linear_layer(channels, hidden, device),
            restore: linear_layer(hidden, channels, device),
        }
    }

    /// Factors `(B, C)` from means `(B, C)`.
    fn factors(&self, means: Tensor<2>, on_graph: bool) -> Tensor<2> {
        let layer = |linear: &Linear, x: Tensor<2>| {
            let y = x.matmul(off_graph(linear.weight.val(), on_graph));
            match &linear.bias {
                Some(bias) => y + off_graph(bias.val(), on_graph).unsqueeze::<2>(),
                None => y,
            }
        };
        let hidden = relu(layer(&self.reduce, means));
        hard_sigmoid(layer(&self.restore, hidden), 1.0 / 6.0, 0.5)
    }

    /// `(B, C, H, W)` with every channel scaled.
    fn forward(&self, x: Tensor<4>, on_graph: bool) -> Tensor<4> {
        let [b, c, _, _] = x.dims();
        let means = adaptive_avg_pool2d(x.clone(), [1, 1]).reshape([b, c]);
        x * self.factors(means, on_graph).reshape([b, c, 1, 1])
    }
}

/// The tensor, outside autodiff unless it is to be on the graph.
fn off_graph<const D: usize>(t: Tensor<D>, on_graph: bool) -> Tensor<D> {
    if on_graph { t } else { t.inner() }
}

/// Inverted residual: 1x1 expansion, depthwise, gate, 1x1 projection without activation.
#[derive(Module, Debug)]
pub(crate) struct Block {
    expand: Option<Conv>,
    bn0: Option<FrozenBatchNorm>,
    depthwise: Conv,
    bn1: FrozenBatchNorm,
    gate: Option<Gate>,
    project: Conv,
    bn2: FrozenBatchNorm,
    residual: bool,
    #[module(skip)]
    activation: Activation,
}

impl Block {
    fn new(index: usize, device: &Device) -> Self {
        let row = &ROWS[index];
        let inp = if index == 0 { STEM } else { ROWS[index - 1].out };
        let expands = index > 0;
        let pointwise = |i, o| Conv::new(i, o, Geometry::centred(1, 1), false, device);
        let bn = |c| FrozenBatchNorm::new(c, EPSILON, device);
        let depthwise = Geometry::centred(row.kernel, row.stride).grouped(row.mid);
        Self {
            expand: expands.then(|| pointwise(inp, row.mid)),
            bn0: expands.then(|| bn(row.mid)),
            depthwise: Conv::new(row.mid, row.mid, depthwise, false, device),
            bn1: bn(row.mid),
            gate: (row.gate > 0).then(|| Gate::new(row.mid, row.gate, device)),
            project: pointwise(row.mid, row.out),
            bn2: bn(row.out),
            residual: row.stride == 1 && inp == row.out,
            activation: row.activation,
        }
    }

    fn forward(&self, x: Tensor<4>, on_graph: bool) -> Tensor<4> {
        let gated = |y: Tensor<4>| match &self.gate {
            Some(gate) => gate.forward(y, on_graph),
            None => y,
        };
        let y = match (&self.expand, &self.bn0) {
            (Some(conv), Some(bn)) => {
                let y = conv_bn(conv, bn, self.activation, on_graph, x.clone());
                let y = conv_bn(&self.depthwise, &self.bn1, Activation::Identity, on_graph, y);
                self.activation.apply(gated(y))
            }
            _ => gated(conv_bn(&self.depthwise, &self.bn1, self.activation, on_graph, x.clone())),
        };
        let y = conv_bn(&self.project, &self.bn2, Activation::Identity, on_graph, y);
        if self.residual { y + x } else { y }
    }

    /// Ready for batch-wide maps.
    fn wide(&self, on_graph: bool) -> WideBlock<'_> {
        let fold = |conv, bn| WideConv::new(conv, bn, on_graph);
        WideBlock {
            expand: self.expand.as_ref().zip(self.bn0.as_ref()).map(|(c, b)| fold(c, b)),
            depthwise: fold(&self.depthwise, &self.bn1),
            gate: self.gate.as_ref(),
            project: fold(&self.project, &self.bn2),
            residual: self.residual,
            activation: self.activation,
            on_graph,
        }
    }
}

/// [`Block`] on batch-wide maps `(C, N, H, W)`.
struct WideBlock<'a> {
    expand: Option<WideConv>,
    depthwise: WideConv,
    gate: Option<&'a Gate>,
    project: WideConv,
    residual: bool,
    activation: Activation,
    on_graph: bool,
}

impl WideBlock<'_> {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let y = match &self.expand {
            Some(expand) => {
                let y = match self.activation {
                    Activation::HardSwish => expand.pointwise_hard_swish(x.clone()),
                    other => other.apply(expand.pointwise(x.clone())),
                };
                self.gated_activation(self.depthwise.depthwise(y))
            }
            None => self.gated(self.activation.apply(self.depthwise.depthwise(x.clone()))),
        };
        let y = self.project.pointwise(y);
        if self.residual { y + x } else { y }
    }

    /// Factors `(C * N)` of rows `(C * N, P)`.
    fn factors(&self, gate: &Gate, rows: Tensor<2>, [c, n]: [usize; 2]) -> Tensor<1> {
        let means = rows.mean_dim(1).reshape([c, n]).swap_dims(0, 1);
        gate.factors(means, self.on_graph).swap_dims(0, 1).reshape([c * n])
    }

    fn gated(&self, y: Tensor<4>) -> Tensor<4> {
        let Some(gate) = self.gate else { return y };
        let [c, n, h, w] = y.dims();
        let rows = y.reshape([c * n, h * w]);
        let factors = self.factors(gate, rows.clone(), [c, n]).reshape([c * n, 1]);
        (rows * factors).reshape([c, n, h, w])
    }

    /// Gate, then activation.
    fn gated_activation(&self, y: Tensor<4>) -> Tensor<4> {
        match (self.gate, self.activation) {
            (Some(gate), Activation::HardSwish) => {
                let [c, n, h, w] = y.dims();
                let rows = y.reshape([c * n, h * w]);
                let factors = self.factors(gate, rows.clone(), [c, n]);
                mobile::gated_hard_swish(rows, factors).reshape([c, n, h, w])
            }
            (_, activation) => activation.apply(self.gated(y)),
        }
    }
}

/// Stem and the first 8 or 9 blocks.
#[derive(Module, Debug)]
pub(crate) struct MobileNetV3 {
    stem: Conv,
    bn: FrozenBatchNorm,
    blocks: Vec<Block>,
}

impl MobileNetV3 {
    /// Random weights; `blocks` is [`BLOCKS_V2`] or [`BLOCKS_V3`].
    pub fn new(blocks: usize, device: &Device) -> Self {
        Self {
            stem: Conv::new(3, STEM, Geometry::centred(3, 2), false, device),
            bn: FrozenBatchNorm::new(STEM, EPSILON, device),
            blocks: (0..blocks.min(ROWS.len())).map(|i| Block::new(i, device)).collect(),
        }
    }

    /// `(B, 3, S, S)` to `(B, C, S/16, S/16)`. With `frozen` > 0 the stem and the first `frozen - 1`
    /// blocks stay outside autodiff.
    pub fn forward(&self, x: Tensor<4>, frozen: usize) -> Tensor<4> {
        let stem = frozen < 1;
        let x = if stem { x } else { x.inner() };
        let mut x = conv_bn(&self.stem, &self.bn, Activation::HardSwish, stem, x);
        for (i, block) in self.blocks.iter().enumerate() {
            x = block.forward(x, frozen < i + 2);
        }
        x
    }
}

impl MobileNetV3 {
    /// [`Self::forward`] for training on the CPU, as a batch-wide map `(C, B, S/16, S/16)`. At least
    /// the stem has to be frozen.
    pub fn forward_wide(&self, x: Tensor<4>, frozen: usize) -> Tensor<4> {
        let leading = frozen.saturating_sub(1).min(self.blocks.len());
        let (frozen, trained) = self.blocks.split_at(leading);
        let frozen: Vec<_> = frozen.iter().map(|block| block.wide(false)).collect();
        let trained: Vec<_> = trained.iter().map(|block| block.wide(true)).collect();
        // Image by image: the large early maps stay in the cache, and every core has its own.
        let images: Vec<Tensor<4>> = x.inner().split(1, 0);
        let maps: Vec<Tensor<4>> = images
            .into_par_iter()
            .map(|image| {
                let x = conv_bn(&self.stem, &self.bn, Activation::HardSwish, false, image);
                frozen.iter().fold(x.swap_dims(0, 1), |x, block| block.forward(x))
            })
            .collect();
        trained.iter().fold(Tensor::cat(maps, 1), |x, block| block.forward(x))
    }
}

/// Name in NanoTrack's state dict of the layer at this path below the backbone, as in
/// `["blocks", "3", "gate", "reduce"]` to `features.4.conv.5.fc.0`. `None` for what is no layer of it.
pub(crate) fn published_name(path: &[String]) -> Option<String> {
    let parts: Vec<&str> = path.iter().map(String::as_str).collect();
    let (index, layer) = match *parts {
        ["stem"] => return Some("features.0.0".into()),
        ["bn"] => return Some("features.0.1".into()),
        ["blocks", index, ref layer @ ..] => (index.parse::<usize>().ok()?, layer),
        _ => return None,
    };
    // Activations have numbers too; without expansion there are three layers fewer in front, and the
    // gate stands behind the activation.
    let (first, gate, project) = if index == 0 { (0, 3, 4) } else { (3, 5, 7) };
    let place = match *layer {
        ["expand"] => "0".into(),
        ["bn0"] => "1".into(),
        ["depthwise"] => first.to_string(),
        ["bn1"] => (first + 1).to_string(),
        ["gate", "reduce"] => format!("{gate}.fc.0"),
        ["gate", "restore"] => format!("{gate}.fc.2"),
        ["project"] => project.to_string(),
        ["bn2"] => (project + 1).to_string(),
        _ => return None,
    };
    Some(format!("features.{}.conv.{place}", index + 1))
}
