//! What MobileNetV3 adds: depthwise convolution without limits, hard-swish behind a bias and behind
//! the gate of a squeeze-excite.

use super::depthwise::{self, Limits};
use super::{Window, dims, sum, tensor};
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::prelude::*;
use rayon::prelude::*;

/// The operations, forward.
#[backend_extension(Flex, Autodiff)]
pub trait MobileOps: Backend {
    /// `depthwise(x) + bias`; x `(C, N, H, W)`, weight `(C, k * k)`, bias `(C)`; output sides are
    /// `ceil(side / stride)`.
    fn depthwise(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        window: Window,
    ) -> FloatTensor<Self>;

    /// `hard_swish(x + bias)` with x `(C, M)`, bias `(C)`.
    fn bias_hard_swish(x: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self>;

    /// `hard_swish(x * gate)` with x `(R, P)`, gate `(R)`.
    fn gated_hard_swish(x: FloatTensor<Self>, gate: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// The operations, backward.
pub trait MobileGradients: MobileOps {
    /// Gradients of x (when `needs_x`), weight and bias.
    fn depthwise_backward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        window: Window,
        needs_x: bool,
    ) -> (Option<FloatTensor<Self>>, FloatTensor<Self>, FloatTensor<Self>);

    /// Gradients of x and bias.
    fn bias_hard_swish_backward(
        x: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        grad: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);

    /// Gradients of x and gate.
    fn gated_hard_swish_backward(
        x: FloatTensor<Self>,
        gate: FloatTensor<Self>,
        grad: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
}

/// See [`MobileOps::depthwise`].
pub(crate) fn depthwise(
    x: Tensor<4>,
    weight: Tensor<2>,
    bias: Tensor<1>,
    window: Window,
) -> Tensor<4> {
    Tensor::from_dispatch(<Dispatch as MobileOps>::depthwise(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        window,
    ))
}

/// See [`MobileOps::bias_hard_swish`].
pub(crate) fn bias_hard_swish(x: Tensor<2>, bias: Tensor<1>) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as MobileOps>::bias_hard_swish(
        x.into_dispatch(),
        bias.into_dispatch(),
    ))
}

/// See [`MobileOps::gated_hard_swish`].
pub(crate) fn gated_hard_swish(x: Tensor<2>, gate: Tensor<1>) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as MobileOps>::gated_hard_swish(
        x.into_dispatch(),
        gate.into_dispatch(),
    ))
}

#[derive(Debug)]
struct Depthwise;

impl<B: MobileGradients> Backward<B, 3> for Depthwise {
    type State = (FloatTensor<B>, FloatTensor<B>, Window);

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let (x, weight, window) = ops.state;
        let [node_x, node_weight, node_bias] = ops.parents;
        let (gx, gw, gb) = B::depthwise_backward(x, weight, grad, window, node_x.is_some());
        for (node, gradient) in [(node_x, gx), (node_weight, Some(gw)), (node_bias, Some(gb))] {
            if let (Some(node), Some(gradient)) = (node, gradient) {
                grads.register::<B>(node.id, gradient);
            }
        }
    }
}

/// The backward pass of an operation of two tensors.
macro_rules! two_tensors {
    ($name:ident, $backward:ident) => {
        #[derive(Debug)]
        struct $name;

        impl<B: MobileGradients> Backward<B, 2> for $name {
            type State = (FloatTensor<B>, FloatTensor<B>);

            fn backward(
                self,
                ops: Ops<Self::State, 2>,
                grads: &mut Gradients,
                _: &mut Checkpointer,
            ) {
                let grad = grads.consume::<B>(&ops.node);
                let (x, other) = ops.state;
                let (gx, go) = B::$backward(x, other, grad);
                for (node, gradient) in ops.parents.into_iter().zip([gx, go]) {
                    if let Some(node) = node {
                        grads.register::<B>(node.id, gradient);
                    }
                }
            }
        }
    };
}

two_tensors!(BiasHardSwish, bias_hard_swish_backward);
two_tensors!(GatedHardSwish, gated_hard_swish_backward);

impl<B: MobileGradients, C: CheckpointStrategy> MobileOps for Autodiff<B, C> {
    fn depthwise(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        window: Window,
    ) -> FloatTensor<Self> {
        let prep = Depthwise
            .prepare::<C>([x.node(), weight.node(), bias.node()])
            .compute_bound()
            .stateful();
        let (x, weight) = (x.into_primitive(), weight.into_primitive());
        let y = B::depthwise(x.clone(), weight.clone(), bias.into_primitive(), window);
        match prep {
            OpsKind::Tracked(prep) => prep.finish((x, weight, window), y),
            OpsKind::UnTracked(prep) => prep.finish(y),
        }
    }

    fn bias_hard_swish(x: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        let prep = BiasHardSwish.prepare::<C>([x.node(), bias.node()]).compute_bound().stateful();
        let (x, bias) = (x.into_primitive(), bias.into_primitive());
        let y = B::bias_hard_swish(x.clone(), bias.clone());
        match prep {
            OpsKind::Tracked(prep) => prep.finish((x, bias), y),
            OpsKind::UnTracked(prep) => prep.finish(y),
        }
    }

    fn gated_hard_swish(x: FloatTensor<Self>, gate: FloatTensor<Self>) -> FloatTensor<Self> {
        let prep = GatedHardSwish.prepare::<C>([x.node(), gate.node()]).compute_bound().stateful();
        let (x, gate) = (x.into_primitive(), gate.into_primitive());
        let y = B::gated_hard_swish(x.clone(), gate.clone());
        match prep {
            OpsKind::Tracked(prep) => prep.finish((x, gate), y),
            OpsKind::UnTracked(prep) => prep.finish(y),
        }
    }
}

fn hard_swish(x: f32) -> f32 {
    x * (x * (1.0 / 6.0) + 0.5).clamp(0.0, 1.0)
}

/// Derivative of [`hard_swish`].
fn slope(x: f32) -> f32 {
    let inside = x * (1.0 / 3.0) + 0.5;
    let right = if x >= 3.0 { 1.0 } else { inside };
    if x <= -3.0 { 0.0 } else { right }
}

/// Scalar product in eight lanes, as [`sum`].
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut lanes = [0.0f32; 8];
    for (a, b) in a.iter().zip(b) {
        for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
            *lane += a * b;
        }
    }
    lanes.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f32>()
}

/// `f(x, p)` of every element of rows x `(R, P)` with one number `p` per row.
fn by_row(
    x: FlexTensor,
    per_row: FlexTensor,
    f: impl Fn(f32, f32) -> f32 + Sync + Send,
) -> FlexTensor {
    let (x, per_row) = (x.to_contiguous(), per_row.to_contiguous());
    let [rows, length] = dims(&x);
    let (xs, ps) = (x.storage::<f32>(), per_row.storage::<f32>());
    let mut y = vec![0.0f32; rows * length];
    y.par_chunks_mut(length).zip(xs.par_chunks(length)).zip(ps.par_iter()).for_each(
        |((y, x), p)| {
            for (y, x) in y.iter_mut().zip(x) {
                *y = f(*x, *p);
            }
        },
    );
    tensor(y, &[rows, length])
}

/// Gradients of rows and of the number per row. `each` turns x, the number and the gradient into the
/// gradient inside the activation; `finish` turns those of a row and its x into both results.
fn by_row_backward(
    [x, per_row, grad]: [FlexTensor; 3],
    each: impl Fn(f32, f32, f32) -> f32 + Sync + Send,
    finish: impl Fn(&mut [f32], &[f32], f32) -> f32 + Sync + Send,
) -> (FlexTensor, FlexTensor) {
    let [x, per_row, grad] = [x, per_row, grad].map(|t| t.to_contiguous());
    let [rows, length] = dims(&x);
    let (xs, ps) = (x.storage::<f32>(), per_row.storage::<f32>());
    let gs = grad.storage::<f32>();
    let mut gx = vec![0.0f32; rows * length];
    let mut gp = vec![0.0f32; rows];
    gx.par_chunks_mut(length)
        .zip(gp.par_iter_mut())
        .zip(xs.par_chunks(length).zip(gs.par_chunks(length)))
        .zip(ps.par_iter())
        .for_each(|(((gx, gp), (x, g)), p)| {
            for ((gx, x), g) in gx.iter_mut().zip(x).zip(g) {
                *gx = each(*x, *p, *g);
            }
            *gp = finish(gx, x, *p);
        });
    (tensor(gx, &[rows, length]), tensor(gp, &[rows]))
}

impl MobileOps for Flex {
    fn depthwise(
        x: FlexTensor,
        weight: FlexTensor,
        bias: FlexTensor,
        window: Window,
    ) -> FlexTensor {
        depthwise::depthwise(x, weight, bias, window, Limits::Free)
    }

    fn bias_hard_swish(x: FlexTensor, bias: FlexTensor) -> FlexTensor {
        by_row(x, bias, |x, bias| hard_swish(x + bias))
    }

    fn gated_hard_swish(x: FlexTensor, gate: FlexTensor) -> FlexTensor {
        by_row(x, gate, |x, gate| hard_swish(x * gate))
    }
}

impl MobileGradients for Flex {
    fn depthwise_backward(
        x: FlexTensor,
        weight: FlexTensor,
        grad: FlexTensor,
        window: Window,
        needs_x: bool,
    ) -> (Option<FlexTensor>, FlexTensor, FlexTensor) {
        depthwise::depthwise_backward(x, weight, None, grad, window, needs_x)
    }

    fn bias_hard_swish_backward(
        x: FlexTensor,
        bias: FlexTensor,
        grad: FlexTensor,
    ) -> (FlexTensor, FlexTensor) {
        let each = |x: f32, bias: f32, g: f32| g * slope(x + bias);
        by_row_backward([x, bias, grad], each, |gx, _, _| sum(gx))
    }

    fn gated_hard_swish_backward(
        x: FlexTensor,
        gate: FlexTensor,
        grad: FlexTensor,
    ) -> (FlexTensor, FlexTensor) {
        let each = |x: f32, gate: f32, g: f32| g * slope(x * gate);
        by_row_backward([x, gate, grad], each, |gx, x, gate| {
            let of_gate = dot(gx, x);
            gx.iter_mut().for_each(|g| *g *= gate);
            of_gate
        })
    }
}
