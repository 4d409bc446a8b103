//! Depthwise convolution of planes, forward and backward; spatial bookkeeping around
//! [`super::simd`].

use super::simd::{LANES, Tap, correlations, weighted_runs};
use super::{Window, dims, tensor};
use burn::backend::flex::FlexTensor;
use rayon::prelude::*;

/// Where the values of one plane lie for a windowed operation.
///
/// The padded plane is split into `stride * stride` phases (even and odd rows and columns at
/// stride 2), so that what one tap of the kernel reads for all outputs is a single contiguous run.
/// Runs are `wide` long per output row; what they hold behind the output's width is ignored.
struct Plan {
    side: [usize; 2],
    out: [usize; 2],
    /// Columns of a phase.
    wide: usize,
    /// Values of a phase.
    phase: usize,
    window: Window,
}

impl Plan {
    fn new([h, w]: [usize; 2], window: Window) -> Self {
        let Window { kernel, stride, before } = window;
        let out = [h.div_ceil(stride), w.div_ceil(stride)];
        let phase_side = |out: usize, side: usize| {
            (out + (kernel - 1) / stride).max((side + before).div_ceil(stride))
        };
        let wide = phase_side(out[1], w);
        Self { side: [h, w], out, wide, phase: phase_side(out[0], h) * wide, window }
    }

    fn plane(&self) -> usize {
        self.side[0] * self.side[1]
    }

    fn out_plane(&self) -> usize {
        self.out[0] * self.out[1]
    }

    /// Values of all phases, and of the vector that the last run may reach beyond them.
    fn phases(&self) -> usize {
        self.window.stride * self.window.stride * self.phase + LANES
    }

    /// Length of a run over all output rows, in whole vectors.
    fn run(&self) -> usize {
        ((self.out[0] - 1) * self.wide + self.out[1]).next_multiple_of(LANES)
    }

    /// Index of a row and column of the padded plane among the phases.
    fn index(&self, row: usize, column: usize) -> usize {
        let stride = self.window.stride;
        let phase = (row % stride) * stride + column % stride;
        phase * self.phase + (row / stride) * self.wide + column / stride
    }

    /// Where the run of a tap (row-major) begins.
    fn from(&self, tap: usize) -> usize {
        self.index(tap / self.window.kernel, tap % self.window.kernel)
    }

    /// Writes a plane into its place; the padding around it has to be zero already.
    fn split(&self, plane: &[f32], phases: &mut [f32]) {
        let Window { stride, before, .. } = self.window;
        for (y, row) in plane.chunks_exact(self.side[1]).enumerate() {
            for first in 0..stride.min(row.len()) {
                let at = self.index(y + before, first + before);
                if stride == 1 {
                    phases[at..at + row.len()].copy_from_slice(row);
                } else {
                    let values = row[first..].iter().step_by(stride);
                    for (to, v) in phases[at..].iter_mut().zip(values) {
                        *to = *v;
                    }
                }
            }
        }
    }

    /// Reads a plane from its place.
    fn join(&self, phases: &[f32], plane: &mut [f32]) {
        let Window { stride, before, .. } = self.window;
        for (y, row) in plane.chunks_exact_mut(self.side[1]).enumerate() {
            for first in 0..stride.min(row.len()) {
                let at = self.index(y + before, first + before);
                if stride == 1 {
                    row.copy_from_slice(&phases[at..at + row.len()]);
                } else {
                    let values = row[first..].iter_mut().step_by(stride);
                    for (to, v) in values.zip(&phases[at..]) {
                        *to = *v;
                    }
                }
            }
        }
    }
}

/// What is done to a sum behind the bias.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Limits {
    /// Nothing.
    Free,
    /// It is cut to 0 to 6.
    Relu6,
}

/// `limits(depthwise(x) + bias)`; x `(C, N, H, W)`, weight `(C, k * k)`, bias `(C)`.
pub(super) fn depthwise(
    x: FlexTensor,
    weight: FlexTensor,
    bias: FlexTensor,
    window: Window,
    limits: Limits,
) -> FlexTensor {
    let (x, weight, bias) = (x.to_contiguous(), weight.to_contiguous(), bias.to_contiguous());
    let [c, n, h, w] = dims(&x);
    let plan = Plan::new([h, w], window);
    let (xs, ws, bs) = (x.storage::<f32>(), weight.storage::<f32>(), bias.storage::<f32>());
    let (taps, plane) = (window.kernel * window.kernel, n * plan.plane());
    let mut y = vec![0.0f32; c * n * plan.out_plane()];
    y.par_chunks_mut(n * plan.out_plane()).enumerate().for_each(|(ch, y)| {
        let weight = &ws[ch * taps..(ch + 1) * taps];
        forward(&plan, &xs[ch * plane..(ch + 1) * plane], weight, bs[ch], limits, y);
    });
    tensor(y, &[c, n, plan.out[0], plan.out[1]])
}

/// Gradients of x (when `needs_x`), weight and bias; `relu6` is the output of [`depthwise`] with
/// [`Limits::Relu6`], `grad` the gradient of the output.
pub(super) fn depthwise_backward(
    x: FlexTensor,
    weight: FlexTensor,
    relu6: Option<FlexTensor>,
    grad: FlexTensor,
    window: Window,
    needs_x: bool,
) -> (Option<FlexTensor>, FlexTensor, FlexTensor) {
    let [x, weight, grad] = [x, weight, grad].map(|t| t.to_contiguous());
    let relu6 = relu6.map(|y| y.to_contiguous());
    let [c, n, h, w] = dims(&x);
    let plan = Plan::new([h, w], window);
    let (xs, ws) = (x.storage::<f32>(), weight.storage::<f32>());
    let (ys, gs) = (relu6.as_ref().map(|y| y.storage::<f32>()), grad.storage::<f32>());
    let taps = window.kernel * window.kernel;
    let (plane, out) = (n * plan.plane(), n * plan.out_plane());
    let mut gx = vec![0.0f32; if needs_x { c * plane } else { 0 }];
    let mut gw = vec![0.0f32; c * taps];
    let mut gb = vec![0.0f32; c];
    let mut gradients: Vec<_> = gw
        .chunks_exact_mut(taps)
        .zip(&mut gb)
        .map(|(weight, bias)| ChannelGradients { x: None, weight, bias })
        .collect();
    for (gradients, gx) in gradients.iter_mut().zip(gx.chunks_exact_mut(plane)) {
        gradients.x = Some(gx);
    }
    gradients.into_par_iter().enumerate().for_each(|(ch, gradients)| {
        let weight = &ws[ch * taps..(ch + 1) * taps];
        let (x, out) = (&xs[ch * plane..(ch + 1) * plane], ch * out..(ch + 1) * out);
        let y = ys.map(|y| &y[out.clone()]);
        backward(&plan, x, weight, y, &gs[out], gradients);
    });
    let gx = needs_x.then(|| tensor(gx, &[c, n, h, w]));
    (gx, tensor(gw, &[c, taps]), tensor(gb, &[c]))
}

/// One channel's planes, one after another.
fn forward(plan: &Plan, images: &[f32], weight: &[f32], bias: f32, limits: Limits, y: &mut [f32]) {
    let mut phases = vec![0.0; plan.phases()];
    let mut sums = vec![0.0; plan.run()];
    let taps: Vec<Tap> = weight.iter().enumerate().map(|(t, w)| (plan.from(t), *w)).collect();
    for (image, y) in images.chunks_exact(plan.plane()).zip(y.chunks_exact_mut(plan.out_plane())) {
        plan.split(image, &mut phases);
        weighted_runs(&mut sums, &phases, &taps, bias);
        for (y, row) in y.chunks_exact_mut(plan.out[1]).zip(sums.chunks(plan.wide)) {
            match limits {
                Limits::Free => y.copy_from_slice(&row[..plan.out[1]]),
                Limits::Relu6 => {
                    for (y, s) in y.iter_mut().zip(row) {
                        *y = s.clamp(0.0, 6.0);
                    }
                }
            }
        }
    }
}

/// What flows back through one channel.
struct ChannelGradients<'a> {
    /// To the planes, where somebody wants it.
    x: Option<&'a mut [f32]>,
    /// To the taps.
    weight: &'a mut [f32],
    /// To the bias.
    bias: &'a mut f32,
}

/// Gradients of [`forward`]; `grad` is that of its output, `relu6` the output where it was cut.
fn backward(
    plan: &Plan,
    images: &[f32],
    weight: &[f32],
    relu6: Option<&[f32]>,
    grad: &[f32],
    into: ChannelGradients<'_>,
) {
    let Window { kernel, stride, .. } = plan.window;
    let ChannelGradients { x: mut gx, weight: gw, bias: gb } = into;
    let run = plan.run();
    let mut phases = vec![0.0; plan.phases()];
    // The output gradient on the runs' grid, zeros behind every row. Around it as many zeros as the
    // farthest tap of a phase is away: the gradient of a plane is then a sum of runs again.
    let reach = plan.phase;
    let mut g = vec![0.0; reach + run.max(plan.phase) + LANES];
    let mut spread = vec![0.0; plan.phases()];
    let by_phase: Vec<Vec<Tap>> = (0..stride * stride)
        .map(|phase| {
            let taps = weight.iter().enumerate().map(|(t, w)| (plan.from(t), *w));
            let own = taps.filter(|(from, _)| from / plan.phase == phase);
            own.map(|(from, w)| (reach - from % plan.phase, w)).collect()
        })
        .collect();
    let planes = images.chunks_exact(plan.plane());
    for (i, (image, grad)) in planes.zip(grad.chunks_exact(plan.out_plane())).enumerate() {
        plan.split(image, &mut phases);
        let rows = g[reach..].chunks_mut(plan.wide).zip(grad.chunks_exact(plan.out[1]));
        for (g, grad) in rows {
            g[..plan.out[1]].copy_from_slice(grad);
        }
        if let Some(y) = relu6 {
            let y = &y[i * plan.out_plane()..(i + 1) * plan.out_plane()];
            let rows = g[reach..].chunks_mut(plan.wide).zip(y.chunks_exact(plan.out[1]));
            for (g, y) in rows.flat_map(|(g, y)| g.iter_mut().zip(y)) {
                if *y <= 0.0 || *y >= 6.0 {
                    *g = 0.0;
                }
            }
        }
        let values = &g[reach..reach + run];
        *gb += super::sum(values);
        match kernel {
            3 => tap_gradients::<9>(plan, gw, values, &phases),
            5 => tap_gradients::<5>(plan, gw, values, &phases),
            _ => tap_gradients::<1>(plan, gw, values, &phases),
        }
        if let Some(gx) = &mut gx {
            for (taps, spread) in by_phase.iter().zip(spread.chunks_exact_mut(plan.phase)) {
                weighted_runs(spread, &g, taps, 0.0);
            }
            plan.join(&spread, &mut gx[i * plan.plane()..(i + 1) * plan.plane()]);
        }
    }
}

/// Adds the gradients of all taps, `T` at a time; `T` divides their number.
fn tap_gradients<const T: usize>(plan: &Plan, gw: &mut [f32], g: &[f32], phases: &[f32]) {
    let (groups, _) = gw.as_chunks_mut::<T>();
    for (i, sums) in groups.iter_mut().enumerate() {
        let from = std::array::from_fn(|t| plan.from(i * T + t));
        correlations(sums, g, phases, from);
    }
}
