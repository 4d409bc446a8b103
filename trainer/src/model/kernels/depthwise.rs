//! Depthwise convolution of planes, forward and backward; spatial bookkeeping around
//! [`super::simd`].

use super::Window;
use super::simd::{LANES, Tap, correlations, weighted_runs};

/// Where the values of one plane lie for a windowed operation.
///
/// The padded plane is split into `stride * stride` phases (even and odd rows and columns at
/// stride 2), so that what one tap of the kernel reads for all outputs is a single contiguous run.
/// Runs are `wide` long per output row; what they hold behind the output's width is ignored.
pub(super) struct Plan {
    side: [usize; 2],
    pub out: [usize; 2],
    /// Columns of a phase.
    wide: usize,
    /// Values of a phase.
    phase: usize,
    window: Window,
}

impl Plan {
    pub fn new([h, w]: [usize; 2], window: Window) -> Self {
        let Window { kernel, stride, before } = window;
        let out = [h.div_ceil(stride), w.div_ceil(stride)];
        let phase_side = |out: usize, side: usize| {
            (out + (kernel - 1) / stride).max((side + before).div_ceil(stride))
        };
        let wide = phase_side(out[1], w);
        Self { side: [h, w], out, wide, phase: phase_side(out[0], h) * wide, window }
    }

    pub fn plane(&self) -> usize {
        self.side[0] * self.side[1]
    }

    pub fn out_plane(&self) -> usize {
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

/// `clamp(depthwise(images) + bias, 0, 6)` of one channel's planes, one after another.
pub(super) fn forward(plan: &Plan, images: &[f32], weight: &[f32], bias: f32, y: &mut [f32]) {
    let mut phases = vec![0.0; plan.phases()];
    let mut sums = vec![0.0; plan.run()];
    let taps: Vec<Tap> = weight.iter().enumerate().map(|(t, w)| (plan.from(t), *w)).collect();
    for (image, y) in images.chunks_exact(plan.plane()).zip(y.chunks_exact_mut(plan.out_plane())) {
        plan.split(image, &mut phases);
        weighted_runs(&mut sums, &phases, &taps, bias);
        for (y, row) in y.chunks_exact_mut(plan.out[1]).zip(sums.chunks(plan.wide)) {
            for (y, s) in y.iter_mut().zip(row) {
                *y = s.clamp(0.0, 6.0);
            }
        }
    }
}

/// What flows back through one channel.
pub(super) struct ChannelGradients<'a> {
    /// To the planes, where somebody wants it.
    pub x: Option<&'a mut [f32]>,
    /// To the taps.
    pub weight: &'a mut [f32],
    /// To the bias.
    pub bias: &'a mut f32,
}

/// Gradients of [`forward`]; `y` is what it wrote, `grad` the gradient of that.
pub(super) fn backward(
    plan: &Plan,
    images: &[f32],
    weight: &[f32],
    y: &[f32],
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
    let outputs = y.chunks_exact(plan.out_plane()).zip(grad.chunks_exact(plan.out_plane()));
    for (i, (image, (y, grad))) in planes.zip(outputs).enumerate() {
        plan.split(image, &mut phases);
        let rows = y.chunks_exact(plan.out[1]).zip(grad.chunks_exact(plan.out[1]));
        for ((y, grad), g) in rows.zip(g[reach..].chunks_mut(plan.wide)) {
            for ((g, y), grad) in g.iter_mut().zip(y).zip(grad) {
                *g = if *y > 0.0 && *y < 6.0 { *grad } else { 0.0 };
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
