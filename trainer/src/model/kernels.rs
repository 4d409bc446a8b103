//! CPU kernels for training, as differentiable burn operations.
//!
//! burn-flex computes the weight gradient of a depthwise convolution group by group and unrolls
//! full convolutions per image. In training, channels-first maps of the **whole batch**
//! (`(C, N, H, W)`) are faster: a 1x1 convolution is then one large matrix product in every
//! direction, and what remains is memory-bound and done here in one pass each.
//!
//! Inference and graph capture never come here; the same numbers come from `conv2d` there, and
//! tests compare both ways.

mod depthwise;
pub(crate) mod mobile;
mod simd;

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{
    Autodiff, Backend, Dispatch, DispatchDevice, Flex, TensorMetadata as _, backend_extension,
};
use burn::prelude::*;
use depthwise::{Limits, depthwise, depthwise_backward};
use rayon::prelude::*;

/// Shape of a depthwise or unfolding window: kernel side, stride, padding before (behind is what
/// the output size implies).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Kernel side.
    pub kernel: usize,
    /// Stride.
    pub stride: usize,
    /// Padding before the first row and column.
    pub before: usize,
}

/// The operations, forward.
#[backend_extension(Flex, Autodiff)]
pub trait TrainOps: Backend {
    /// `clamp(depthwise(x) + bias, 0, 6)`; x `(C, N, H, W)`, weight `(C, k * k)`, bias `(C)`;
    /// output sides are `ceil(side / stride)`.
    fn depthwise_relu6(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        window: Window,
    ) -> FloatTensor<Self>;

    /// Columns `(C * k * k, N * H * W)` of x `(C, N, H, W)` at stride 1, sides kept.
    fn unfold_same(x: FloatTensor<Self>, window: Window) -> FloatTensor<Self>;

    /// `clamp(x + bias, 0, 6)` with x `(C, M)`, bias `(C)`.
    fn bias_relu6(x: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// The operations, backward.
pub trait TrainGradients: TrainOps {
    /// Gradients of x (when `needs_x`), weight and bias. `y` is the output.
    fn depthwise_relu6_backward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        y: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        window: Window,
        needs_x: bool,
    ) -> (Option<FloatTensor<Self>>, FloatTensor<Self>, FloatTensor<Self>);

    /// Columns back to a map of this shape, overlaps added.
    fn fold_same(
        columns: FloatTensor<Self>,
        shape: [usize; 4],
        window: Window,
    ) -> FloatTensor<Self>;

    /// Gradients of x and bias.
    fn bias_relu6_backward(
        y: FloatTensor<Self>,
        grad: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
}

/// Whether the kernels run on this device.
pub(crate) fn supports(device: &Device) -> bool {
    matches!(device.clone().inner().as_dispatch(), DispatchDevice::Flex(_))
}

/// See [`TrainOps::depthwise_relu6`].
pub(crate) fn depthwise_relu6(
    x: Tensor<4>,
    weight: Tensor<2>,
    bias: Tensor<1>,
    window: Window,
) -> Tensor<4> {
    Tensor::from_dispatch(<Dispatch as TrainOps>::depthwise_relu6(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        window,
    ))
}

/// See [`TrainOps::unfold_same`].
pub(crate) fn unfold_same(x: Tensor<4>, window: Window) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as TrainOps>::unfold_same(x.into_dispatch(), window))
}

/// See [`TrainOps::bias_relu6`].
pub(crate) fn bias_relu6(x: Tensor<2>, bias: Tensor<1>) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as TrainOps>::bias_relu6(
        x.into_dispatch(),
        bias.into_dispatch(),
    ))
}

#[derive(Debug)]
struct DepthwiseRelu6;

impl<B: TrainGradients> Backward<B, 3> for DepthwiseRelu6 {
    type State = (FloatTensor<B>, FloatTensor<B>, FloatTensor<B>, Window);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (x, weight, y, window) = ops.state;
        let [node_x, node_weight, node_bias] = ops.parents;
        let (gx, gw, gb) =
            B::depthwise_relu6_backward(x, weight, y, grad, window, node_x.is_some());
        if let (Some(node), Some(gx)) = (node_x, gx) {
            grads.register::<B>(node.id, gx);
        }
        if let Some(node) = node_weight {
            grads.register::<B>(node.id, gw);
        }
        if let Some(node) = node_bias {
            grads.register::<B>(node.id, gb);
        }
    }
}

#[derive(Debug)]
struct UnfoldSame;

impl<B: TrainGradients> Backward<B, 1> for UnfoldSame {
    type State = ([usize; 4], Window);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (shape, window) = ops.state;
        let [node] = ops.parents;
        if let Some(node) = node {
            grads.register::<B>(node.id, B::fold_same(grad, shape, window));
        }
    }
}

#[derive(Debug)]
struct BiasRelu6;

impl<B: TrainGradients> Backward<B, 2> for BiasRelu6 {
    type State = FloatTensor<B>;

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let [node_x, node_bias] = ops.parents;
        let (gx, gb) = B::bias_relu6_backward(ops.state, grad);
        if let Some(node) = node_x {
            grads.register::<B>(node.id, gx);
        }
        if let Some(node) = node_bias {
            grads.register::<B>(node.id, gb);
        }
    }
}

impl<B: TrainGradients, C: CheckpointStrategy> TrainOps for Autodiff<B, C> {
    fn depthwise_relu6(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        window: Window,
    ) -> FloatTensor<Self> {
        let prep = DepthwiseRelu6
            .prepare::<C>([x.node(), weight.node(), bias.node()])
            .compute_bound()
            .stateful();
        let (x, weight) = (x.into_primitive(), weight.into_primitive());
        let y = B::depthwise_relu6(x.clone(), weight.clone(), bias.into_primitive(), window);
        match prep {
            OpsKind::Tracked(prep) => prep.finish((x, weight, y.clone(), window), y),
            OpsKind::UnTracked(prep) => prep.finish(y),
        }
    }

    fn unfold_same(x: FloatTensor<Self>, window: Window) -> FloatTensor<Self> {
        let prep = UnfoldSame.prepare::<C>([x.node()]).compute_bound().stateful();
        let x = x.into_primitive();
        let shape = x.shape().dims();
        let y = B::unfold_same(x, window);
        match prep {
            OpsKind::Tracked(prep) => prep.finish((shape, window), y),
            OpsKind::UnTracked(prep) => prep.finish(y),
        }
    }

    fn bias_relu6(x: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        let prep = BiasRelu6.prepare::<C>([x.node(), bias.node()]).compute_bound().stateful();
        let y = B::bias_relu6(x.into_primitive(), bias.into_primitive());
        match prep {
            OpsKind::Tracked(prep) => prep.finish(y.clone(), y),
            OpsKind::UnTracked(prep) => prep.finish(y),
        }
    }
}

fn dims<const D: usize>(t: &FlexTensor) -> [usize; D] {
    t.layout().shape().dims()
}

fn tensor(values: Vec<f32>, shape: &[usize]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape.to_vec()))
}

impl TrainOps for Flex {
    fn depthwise_relu6(
        x: FlexTensor,
        weight: FlexTensor,
        bias: FlexTensor,
        window: Window,
    ) -> FlexTensor {
        depthwise(x, weight, bias, window, Limits::Relu6)
    }

    fn unfold_same(x: FlexTensor, window: Window) -> FlexTensor {
        let x = x.to_contiguous();
        let [c, n, h, w] = dims(&x);
        let xs = x.storage::<f32>();
        let taps = window.kernel * window.kernel;
        let mut columns = vec![0.0f32; c * taps * n * h * w];
        columns.par_chunks_mut(n * h * w).enumerate().for_each(|(row, out)| {
            let (ch, tap) = (row / taps, row % taps);
            let images = xs[ch * n * h * w..(ch + 1) * n * h * w].chunks_exact(h * w);
            for (image, out) in images.zip(out.chunks_exact_mut(h * w)) {
                for (at, from, run) in shifted_rows(h, w, tap, window) {
                    out[at..at + run].copy_from_slice(&image[from..from + run]);
                }
            }
        });
        tensor(columns, &[c * taps, n * h * w])
    }

    fn bias_relu6(x: FlexTensor, bias: FlexTensor) -> FlexTensor {
        let (x, bias) = (x.to_contiguous(), bias.to_contiguous());
        let [c, m] = dims(&x);
        let (xs, bs) = (x.storage::<f32>(), bias.storage::<f32>());
        let mut y = vec![0.0f32; c * m];
        y.par_chunks_mut(m).zip(xs.par_chunks(m)).zip(bs.par_iter()).for_each(|((y, x), b)| {
            for (y, x) in y.iter_mut().zip(x) {
                *y = (x + b).clamp(0.0, 6.0);
            }
        });
        tensor(y, &[c, m])
    }
}

/// Rows of a plane shifted by a tap: `(output index, input index, length)` of every run that
/// stays inside.
fn shifted_rows(
    h: usize,
    w: usize,
    tap: usize,
    window: Window,
) -> impl Iterator<Item = (usize, usize, usize)> {
    let (dy, dx) = (tap / window.kernel, tap % window.kernel);
    let before = window.before;
    // Output (y, x) reads input (y + dy - before, x + dx - before).
    let first = before.saturating_sub(dx);
    let last = (w + before).saturating_sub(dx).min(w);
    (0..h).filter_map(move |y| {
        let from = (y + dy).checked_sub(before).filter(|from| *from < h)?;
        (first < last).then(|| (y * w + first, from * w + first + dx - before, last - first))
    })
}

impl TrainGradients for Flex {
    fn depthwise_relu6_backward(
        x: FlexTensor,
        weight: FlexTensor,
        y: FlexTensor,
        grad: FlexTensor,
        window: Window,
        needs_x: bool,
    ) -> (Option<FlexTensor>, FlexTensor, FlexTensor) {
        depthwise_backward(x, weight, Some(y), grad, window, needs_x)
    }

    fn fold_same(columns: FlexTensor, [c, n, h, w]: [usize; 4], window: Window) -> FlexTensor {
        let columns = columns.to_contiguous();
        let cs = columns.storage::<f32>();
        let taps = window.kernel * window.kernel;
        let plane = n * h * w;
        let mut x = vec![0.0f32; c * plane];
        x.par_chunks_mut(plane).enumerate().for_each(|(ch, x)| {
            for tap in 0..taps {
                let row = (ch * taps + tap) * plane;
                let images = cs[row..row + plane].chunks_exact(h * w);
                for (g, x) in images.zip(x.chunks_exact_mut(h * w)) {
                    for (at, from, run) in shifted_rows(h, w, tap, window) {
                        for (x, g) in x[from..from + run].iter_mut().zip(&g[at..at + run]) {
                            *x += g;
                        }
                    }
                }
            }
        });
        tensor(x, &[c, n, h, w])
    }

    fn bias_relu6_backward(y: FlexTensor, grad: FlexTensor) -> (FlexTensor, FlexTensor) {
        let (y, grad) = (y.to_contiguous(), grad.to_contiguous());
        let [c, m] = dims(&y);
        let (ys, gs) = (y.storage::<f32>(), grad.storage::<f32>());
        let mut gx = vec![0.0f32; c * m];
        let mut gb = vec![0.0f32; c];
        gx.par_chunks_mut(m)
            .zip(gb.par_iter_mut())
            .zip(ys.par_chunks(m).zip(gs.par_chunks(m)))
            .for_each(|((gx, gb), (y, g))| {
                for ((gx, y), g) in gx.iter_mut().zip(y).zip(g) {
                    *gx = if *y > 0.0 && *y < 6.0 { *g } else { 0.0 };
                }
                *gb = sum(gx);
            });
        (tensor(gx, &[c, m]), tensor(gb, &[c]))
    }
}

/// Sum in eight lanes: a fixed order the compiler can vectorise.
fn sum(values: &[f32]) -> f32 {
    let (chunks, rest) = values.as_chunks::<8>();
    let mut lanes = [0.0f32; 8];
    for chunk in chunks {
        for (lane, v) in lanes.iter_mut().zip(chunk) {
            *lane += v;
        }
    }
    lanes.iter().sum::<f32>() + rest.iter().sum::<f32>()
}
