//! Layers both backbones and the head are made of.
//!
//! All of them run unchanged on a plain, an autodiff and a capture device. Convolution weights are
//! kept in PyTorch's layout `(out, in / groups, k, k)`.

use super::kernels::{self, Window};
use burn::module::Param;
use burn::nn::Dropout;
use burn::prelude::*;
use burn::tensor::Distribution;
use burn::tensor::module::conv2d;
use burn::tensor::ops::ConvOptions;
use rayon::prelude::*;

/// Zero padding of one spatial axis, `(before, after)`.
pub(crate) type Pad = (usize, usize);

/// Shape-independent settings of a convolution; the same for rows and columns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Geometry {
    /// Side of the kernel.
    pub kernel: usize,
    /// Stride.
    pub stride: usize,
    /// Padding.
    pub pad: Pad,
    /// Groups; the channel count for a depthwise convolution.
    pub groups: usize,
}

impl Geometry {
    /// Padding `kernel / 2` on both sides, as in PyTorch's ResNet.
    pub const fn centred(kernel: usize, stride: usize) -> Self {
        Self { kernel, stride, pad: (kernel / 2, kernel / 2), groups: 1 }
    }

    /// The same with this many groups.
    pub const fn grouped(self, groups: usize) -> Self {
        Self { groups, ..self }
    }

    /// TensorFlow "SAME": at stride 2 on even sides the odd pixel of padding goes behind.
    pub const fn same(kernel: usize, stride: usize, groups: usize) -> Self {
        let total = kernel - stride;
        Self { kernel, stride, pad: (total / 2, total - total / 2), groups }
    }

    fn window(&self) -> Window {
        Window { kernel: self.kernel, stride: self.stride, before: self.pad.0 }
    }

    fn options(&self) -> ConvOptions<2> {
        ConvOptions::new_with_padding([self.stride; 2], [self.pad; 2], [1; 2], self.groups)
    }
}

/// A trainable tensor with values uniform in `[-bound, bound)`.
pub(crate) fn uniform<const D: usize>(
    shape: [usize; D],
    bound: f64,
    device: &Device,
) -> Param<Tensor<D>> {
    Param::from_tensor(Tensor::random(shape, Distribution::Uniform(-bound, bound), device))
}

/// A trainable tensor filled with one value.
pub(crate) fn filled<const D: usize>(
    shape: [usize; D],
    value: f32,
    device: &Device,
) -> Param<Tensor<D>> {
    Param::from_tensor(Tensor::full(shape, value, device))
}

/// Bare convolution, with or without bias.
#[derive(Module, Debug)]
pub(crate) struct Conv {
    /// `(out, in / groups, k, k)`.
    pub weight: Param<Tensor<4>>,
    /// `(out)`.
    pub bias: Option<Param<Tensor<1>>>,
    #[module(skip)]
    pub geometry: Geometry,
}

impl Conv {
    /// PyTorch's default initialisation: uniform +-1/sqrt(fan in) for weight and bias.
    pub fn new(inp: usize, out: usize, geometry: Geometry, bias: bool, device: &Device) -> Self {
        let Geometry { kernel, groups, .. } = geometry;
        let bound = 1.0 / ((inp / groups * kernel * kernel) as f64).sqrt();
        Self {
            weight: uniform([out, inp / groups, kernel, kernel], bound, device),
            bias: bias.then(|| uniform([out], bound, device)),
            geometry,
        }
    }

    /// Stride-1 convolution of a batch-wide map `(in, N, H, W)` as one matrix product,
    /// `(out, N * H * W)`; see [`kernels`].
    pub fn forward_wide(&self, x: Tensor<4>) -> Tensor<2> {
        let [out, inp, k, _] = self.weight.dims();
        let weight = self.weight.val().reshape([out, inp * k * k]);
        let y = weight.matmul(kernels::unfold_same(x, self.geometry.window()));
        match &self.bias {
            Some(bias) => y + bias.val().reshape([out, 1]),
            None => y,
        }
    }

    /// `(B, in, H, W)` to `(B, out, H', W')`.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let bias = self.bias.as_ref().map(Param::val);
        conv2d(x, self.weight.val(), bias, self.geometry.options())
    }
}

/// What follows a convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Activation {
    /// Nothing.
    Identity,
    /// `max(x, 0)`.
    Relu,
    /// `min(max(x, 0), 6)`.
    Relu6,
    /// `x * min(max(x / 6 + 0.5, 0), 1)`.
    HardSwish,
}

impl Activation {
    /// Applies it element by element.
    pub fn apply<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        match self {
            Self::Identity => x,
            Self::Relu => burn::tensor::activation::relu(x),
            Self::Relu6 => x.clamp(0.0, 6.0),
            Self::HardSwish => burn::tensor::activation::hard_swish(x),
        }
    }
}

/// Batch norm whose statistics never change (spec 2.6): an affine map per channel.
#[derive(Module, Debug)]
pub(crate) struct FrozenBatchNorm {
    /// Scale; trainable unless its block is frozen.
    pub weight: Param<Tensor<1>>,
    /// Shift; trainable unless its block is frozen.
    pub bias: Param<Tensor<1>>,
    /// Never trained.
    pub running_mean: Param<Tensor<1>>,
    /// Never trained.
    pub running_var: Param<Tensor<1>>,
    epsilon: f64,
}

impl FrozenBatchNorm {
    /// Identity statistics.
    pub fn new(channels: usize, epsilon: f64, device: &Device) -> Self {
        Self {
            weight: filled([channels], 1.0, device),
            bias: filled([channels], 0.0, device),
            running_mean: filled([channels], 0.0, device).set_require_grad(false),
            running_var: filled([channels], 1.0, device).set_require_grad(false),
            epsilon,
        }
    }
}

/// Runs a convolution with the frozen batch norm behind it, folded into its weights.
///
/// Folding is exact, saves a pass over every activation in training, and leaves nothing but a
/// biased convolution per layer once the exporter has folded the constants. `on_graph` false takes
/// the parameters out of autodiff, so that a frozen layer records nothing.
pub(crate) fn conv_bn(
    conv: &Conv,
    bn: &FrozenBatchNorm,
    activation: Activation,
    on_graph: bool,
    x: Tensor<4>,
) -> Tensor<4> {
    let (weight, bias) = fold(conv, bn, on_graph);
    activation.apply(conv2d(x, weight, Some(bias), conv.geometry.options()))
}

/// A convolution with its batch norm folded in, for batch-wide maps; see [`kernels`].
#[derive(Clone, Debug)]
pub(crate) struct WideConv {
    /// `(out, in / groups * k * k)`.
    weight: Tensor<2>,
    /// `(out)`.
    bias: Tensor<1>,
    window: Window,
}

impl WideConv {
    /// Folds `bn` into `conv`; `on_graph` as in [`conv_bn`].
    pub fn new(conv: &Conv, bn: &FrozenBatchNorm, on_graph: bool) -> Self {
        let (weight, bias) = fold(conv, bn, on_graph);
        let [out, inp, k, _] = weight.dims();
        Self { weight: weight.reshape([out, inp * k * k]), bias, window: conv.geometry.window() }
    }

    /// 1x1 convolution with ReLU6, `(in, N, H, W)` to `(out, N, H, W)`.
    pub fn pointwise_relu6(&self, x: Tensor<4>) -> Tensor<4> {
        let [inp, n, h, w] = x.dims();
        let y = self.weight.clone().matmul(x.reshape([inp, n * h * w]));
        let y = kernels::bias_relu6(y, self.bias.clone());
        let out = y.dims()[0];
        y.reshape([out, n, h, w])
    }

    /// 1x1 convolution without activation, `(in, N, H, W)` to `(out, N, H, W)`.
    pub fn pointwise(&self, x: Tensor<4>) -> Tensor<4> {
        let [inp, n, h, w] = x.dims();
        let y = self.weight.clone().matmul(x.reshape([inp, n * h * w]));
        let out = y.dims()[0];
        (y + self.bias.clone().reshape([out, 1])).reshape([out, n, h, w])
    }

    /// Depthwise convolution with ReLU6, `(C, N, H, W)` to `(C, N, H', W')`.
    pub fn depthwise_relu6(&self, x: Tensor<4>) -> Tensor<4> {
        kernels::depthwise_relu6(x, self.weight.clone(), self.bias.clone(), self.window)
    }

    /// 1x1 convolution with hard-swish, `(in, N, H, W)` to `(out, N, H, W)`.
    pub fn pointwise_hard_swish(&self, x: Tensor<4>) -> Tensor<4> {
        let [inp, n, h, w] = x.dims();
        let y = self.weight.clone().matmul(x.reshape([inp, n * h * w]));
        let y = kernels::mobile::bias_hard_swish(y, self.bias.clone());
        let out = y.dims()[0];
        y.reshape([out, n, h, w])
    }

    /// Depthwise convolution without activation, `(C, N, H, W)` to `(C, N, H', W')`.
    pub fn depthwise(&self, x: Tensor<4>) -> Tensor<4> {
        kernels::mobile::depthwise(x, self.weight.clone(), self.bias.clone(), self.window)
    }
}

/// Weight and bias of the convolution that equals `bn` after `conv`.
fn fold(conv: &Conv, bn: &FrozenBatchNorm, on_graph: bool) -> (Tensor<4>, Tensor<1>) {
    let (weight, gamma, beta) = (conv.weight.val(), bn.weight.val(), bn.bias.val());
    let (weight, gamma, beta) = if on_graph {
        (weight, gamma, beta)
    } else {
        (weight.inner(), gamma.inner(), beta.inner())
    };
    let deviation = bn.running_var.val().inner().add_scalar(bn.epsilon).sqrt();
    let scale = gamma / deviation;
    let bias = beta - scale.clone() * bn.running_mean.val().inner();
    let out = weight.dims()[0];
    (weight * scale.reshape([out, 1, 1, 1]), bias)
}

/// Parameter-free norm of the head feature (spec 1.3): RMS over `(C, H, W)` becomes
/// `sqrt(1 / (C k^2))`, image by image.
pub(crate) fn instance_l2_norm(x: Tensor<4>, filter_size: usize) -> Tensor<4> {
    let [b, c, h, w] = x.dims();
    let count = c * h * w;
    let scale = (1.0 / (c * filter_size * filter_size) as f64).sqrt();
    let flat = x.reshape([b, c, h * w]);
    // Channel by channel: engines add one axis from end to end, and 80,000 numbers in a row would
    // cost a decimal place of the whole feature.
    let energy = flat.clone().powi_scalar(2).sum_dim(2).sum_dim(1).add_scalar(1e-5);
    // s * sqrt(n / e), written with one square root and one division.
    let factor = energy.sqrt().recip().mul_scalar(scale * (count as f64).sqrt());
    (flat * factor).reshape([b, c, h, w])
}

/// [`instance_l2_norm`] of a batch-wide map `(C, N, H * W)`.
pub(crate) fn instance_l2_norm_wide(x: Tensor<3>, filter_size: usize) -> Tensor<3> {
    let [c, _, cells] = x.dims();
    let count = c * cells;
    let scale = (1.0 / (c * filter_size * filter_size) as f64).sqrt();
    let energy = x.clone().powi_scalar(2).sum_dim(2).sum_dim(0).add_scalar(1e-5);
    x * energy.sqrt().recip().mul_scalar(scale * (count as f64).sqrt())
}

/// Dropout. Burn draws one number of a cryptographic generator per element; on the CPU that costs more
/// than the layers around it, so here the device's generator gives a seed and an integer hash of
/// seed and place decides. As there, nothing happens outside training.
pub(crate) fn dropout<const D: usize>(layer: &Dropout, x: Tensor<D>) -> Tensor<D> {
    let device = x.device();
    if !device.is_autodiff() || !kernels::supports(&device) {
        return layer.forward(x);
    }
    if layer.prob == 0.0 || !layer.training.is_enabled() {
        return x;
    }
    let device = device.inner();
    let drawn = Tensor::<1>::random([2], Distribution::Uniform(0.0, 1.0), &device).into_data();
    // 24 random bits each.
    let seed: [u32; 2] =
        std::array::from_fn(|i| drawn.iter::<f32>().nth(i).unwrap_or_default().to_bits());
    let mask = dropout_mask(seed, layer.prob, x.shape().num_elements());
    let mask = Tensor::<D>::from_data(TensorData::new(mask, x.shape()), &device);
    x * Tensor::from_inner(mask)
}

/// 0 with probability `drop`, else `1 / (1 - drop)`.
fn dropout_mask(seed: [u32; 2], drop: f64, count: usize) -> Vec<f32> {
    const CHUNK: usize = 1 << 14;
    let (kept, limit) = ((1.0 / (1.0 - drop)) as f32, (drop * f64::from(u32::MAX)) as u32);
    let mut mask = vec![0.0f32; count];
    mask.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, mask)| {
        let first = (chunk * CHUNK) as u32;
        for (i, mask) in mask.iter_mut().enumerate() {
            // A Weyl sequence through murmur3's finaliser.
            let place = first.wrapping_add(i as u32).wrapping_mul(0x9e37_79b9);
            let mut h = place.wrapping_add(seed[0]) ^ seed[1].rotate_left(9);
            h = (h ^ (h >> 16)).wrapping_mul(0x85eb_ca6b);
            h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
            h ^= h >> 16;
            *mask = if h < limit { 0.0 } else { kept };
        }
    });
    mask
}

/// The fixed positional code of one frame, `(side * side, width)` row-major (spec 1.5, with the
/// map's side as `maxres`).
pub(crate) fn positional_code(side: usize, width: usize) -> Vec<f32> {
    let frequencies = width / 4;
    let phi = side as f64 / frequencies as f64;
    let centre = |i: usize| ((i as f32) + 0.5) / (side as f32 + 1e-6);
    let mut code = vec![0.0; side * side * width];
    for (cell, token) in code.chunks_exact_mut(width).enumerate() {
        let (y, x) = (centre(cell / side), centre(cell % side));
        for i in 0..frequencies {
            // Formed in double, rounded once, as the reference does.
            let omega = ((i + 1) as f64 * phi * std::f64::consts::PI) as f32;
            token[2 * i] = (omega * x).sin();
            token[2 * i + 1] = (omega * y).sin();
            token[2 * (frequencies + i)] = (omega * x).cos();
            token[2 * (frequencies + i) + 1] = (omega * y).cos();
        }
    }
    code
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::nn::DropoutConfig;

    #[test]
    fn dropout_keeps_the_mean_and_follows_the_seed() {
        let device = Device::flex().autodiff();
        let layer = DropoutConfig::new(0.3).init();
        let run = |seed: u64| {
            device.seed(seed);
            // Twice: the second call must not repeat the first.
            [(); 2].map(|()| {
                let x = Tensor::<2>::ones([200, 500], &device).require_grad();
                let y = dropout(&layer, x.clone());
                let gradients = y.clone().sum().backward();
                let gradient = x.grad(&gradients).map(|g| g.into_data());
                assert_eq!(gradient, Some(y.clone().inner().into_data()), "the mask, here");
                y.into_data().try_to_vec::<f32>().unwrap()
            })
        };
        let first = run(5);
        // Burn's CPU generator is one for all threads; another test may seed it in between.
        assert!((0..8).any(|_| run(5) == run(5)));
        assert_ne!(first[0], first[1]);
        assert_ne!(first[0], run(6)[0]);
        for mask in &first {
            let dropped = mask.iter().filter(|v| **v == 0.0).count() as f64 / 1e5;
            assert!((dropped - 0.3).abs() < 0.006, "{dropped}");
            assert!(mask.iter().all(|v| *v == 0.0 || (v - 1.0 / 0.7).abs() < 1e-6));
            // No stripes: neighbours in a row and in a column are independent.
            for apart in [1, 500] {
                let pairs = mask.iter().zip(&mask[apart..]);
                let both = pairs.filter(|(a, b)| **a == 0.0 && **b == 0.0).count() as f64 / 1e5;
                assert!((both - 0.09).abs() < 0.005, "{both} at {apart}");
            }
        }
        let plain = Tensor::<2>::ones([2, 2], &Device::flex());
        assert_eq!(dropout(&layer, plain.clone()).into_data(), plain.into_data());
    }
}
