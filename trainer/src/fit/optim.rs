//! Learning rates, global gradient clipping and the running average of the weights.

use crate::config::{OptimConfig, ScheduleConfig};
use burn::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param, ParamGroup, ParamId};
use burn::optim::{AdamWConfig, GradientsAccumulator, GradientsParams, ModuleOptimizer};
use burn::prelude::*;
use std::collections::HashMap;

/// Paths of the backbone's parameters.
const BACKBONE: &str = r"^feature_extractor\.";

/// AdamW as configured.
pub(super) fn optimizer(config: &OptimConfig) -> ModuleOptimizer {
    AdamWConfig::new()
        .with_beta_1(config.beta1 as f32)
        .with_beta_2(config.beta2 as f32)
        .with_epsilon(config.eps as f32)
        .with_weight_decay(config.weight_decay as f32)
        .init()
}

/// Share of the starting learning rates in force at `step` of `total`: a pure function, so nothing
/// of it needs to be in a checkpoint.
pub fn lr_factor(config: &OptimConfig, step: u64, total: u64) -> f64 {
    if step < config.warmup_steps {
        return (step + 1) as f64 / config.warmup_steps as f64;
    }
    match &config.schedule {
        ScheduleConfig::Constant => 1.0,
        ScheduleConfig::Step { at, gamma } => {
            let done = step as f64 / total.max(1) as f64;
            gamma.powi(at.iter().filter(|share| done >= **share).count() as i32)
        }
        ScheduleConfig::Cosine { floor } => {
            let length = total.saturating_sub(config.warmup_steps).max(1) as f64;
            let done = ((step - config.warmup_steps) as f64 / length).min(1.0);
            floor + (1.0 - floor) * 0.5 * (1.0 + (std::f64::consts::PI * done).cos())
        }
    }
}

/// Learning rates of both groups at a step.
pub(super) fn learning_rate(
    config: &OptimConfig,
    backbone: &ParamGroup,
    factor: f64,
) -> ModuleLearningRate {
    ModuleLrScheduler::new(config.lr_head * factor)
        .with_group(backbone.clone(), config.lr_backbone * factor)
        .step()
}

/// The parameters with the backbone's learning rate.
pub(super) fn backbone_group() -> Result<ParamGroup, String> {
    ParamGroup::from_regex(BACKBONE).map_err(|e| format!("{e:?}"))
}

/// Sum of squares of all gradients.
struct SquaredNorm<'a> {
    gradients: &'a GradientsParams,
    sum: Option<Tensor<1>>,
}

impl ModuleVisitor for SquaredNorm<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(g) = self.gradients.get::<D>(param.id) {
            let s = g.clone().mul(g).sum();
            self.sum = Some(match self.sum.take() {
                Some(sum) => sum + s,
                None => s,
            });
        }
    }
}

/// See [`complete`].
struct Complete<'a> {
    gradients: &'a mut GradientsParams,
}

impl ModuleVisitor for Complete<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let value = param.val();
        if value.is_require_grad() && self.gradients.get::<D>(param.id).is_none() {
            self.gradients.register(param.id, value.inner().zeros_like());
        }
    }
}

/// Zero gradients for parameters that train but have none, as the value weights of the decoder's
/// first layer: the optimiser passes over parameters without a gradient, and weight decay is for
/// all of them (spec 2.6, 2.7).
pub(super) fn complete<M: Module>(module: &M, mut gradients: GradientsParams) -> GradientsParams {
    module.visit(&mut Complete { gradients: &mut gradients });
    gradients
}

struct Scale<'a> {
    gradients: &'a mut GradientsParams,
    factor: f32,
}

impl ModuleVisitor for Scale<'_> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(g) = self.gradients.remove::<D>(param.id) {
            self.gradients.register(param.id, g.mul_scalar(self.factor));
        }
    }
}

/// Sum of the gradients of two backward passes of a module.
pub(super) fn add<M: Module>(
    module: &M,
    sum: GradientsParams,
    more: GradientsParams,
) -> GradientsParams {
    let mut accumulator = GradientsAccumulator::new();
    accumulator.accumulate(module, sum);
    accumulator.accumulate(module, more);
    accumulator.grads()
}

/// Euclidean norm of all gradients together; 0 without any.
pub(super) fn gradient_norm<M: Module>(module: &M, gradients: &GradientsParams) -> f32 {
    let mut visitor = SquaredNorm { gradients, sum: None };
    module.visit(&mut visitor);
    visitor.sum.map_or(0.0, |s| s.into_scalar::<f32>().max(0.0).sqrt())
}

/// Scales the gradients so that their common norm is at most `limit` (burn's own clipping treats
/// each tensor apart). `norm` is what [`gradient_norm`] said.
pub(super) fn clip<M: Module>(
    module: &M,
    mut gradients: GradientsParams,
    norm: f32,
    limit: f64,
) -> GradientsParams {
    let factor = limit as f32 / (norm + 1e-6);
    if limit > 0.0 && factor < 1.0 {
        module.visit(&mut Scale { gradients: &mut gradients, factor });
    }
    gradients
}

struct Collect(HashMap<ParamId, Tensor<1>>);

impl ModuleVisitor for Collect {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let value = param.val();
        let n = value.shape().num_elements();
        self.0.insert(param.id, value.inner().reshape([n]));
    }
}

struct Blend<'a> {
    source: &'a HashMap<ParamId, Tensor<1>>,
    keep: f32,
}

impl ModuleMapper for Blend<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, value, mapper) = param.consume();
        let value = match self.source.get(&id) {
            Some(source) => {
                let source = source.clone().reshape(value.shape());
                value.mul_scalar(self.keep) + source.mul_scalar(1.0 - self.keep)
            }
            None => value,
        };
        Param::from_mapped_value(id, value, mapper)
    }
}

/// Moves the running average a step towards the weights. Early on the average is shorter than
/// `decay` says, so that it does not remember the initialisation: `min(decay, (1 + n) / (10 + n))`.
pub(super) fn average<M: Module>(average: M, model: &M, decay: f64, step: u64) -> M {
    let early = (1 + step) as f64 / (10 + step) as f64;
    let mut collect = Collect(HashMap::new());
    model.visit(&mut collect);
    average.map(&mut Blend { source: &collect.0, keep: decay.min(early) as f32 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::nn::{Linear, LinearConfig};

    fn config(warmup_steps: u64, schedule: ScheduleConfig) -> OptimConfig {
        OptimConfig { warmup_steps, schedule, ..Default::default() }
    }

    #[test]
    fn rates_rise_and_fall_as_configured() {
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} {b}");
        let cosine = config(10, ScheduleConfig::Cosine { floor: 0.1 });
        near(lr_factor(&cosine, 0, 110), 0.1);
        near(lr_factor(&cosine, 9, 110), 1.0);
        near(lr_factor(&cosine, 10, 110), 1.0);
        near(lr_factor(&cosine, 60, 110), 0.55);
        near(lr_factor(&cosine, 110, 110), 0.1);
        near(lr_factor(&cosine, 500, 110), 0.1);
        let steps = config(0, ScheduleConfig::Step { at: vec![0.5, 0.8], gamma: 0.2 });
        for (step, want) in [(0, 1.0), (49, 1.0), (50, 0.2), (79, 0.2), (80, 0.04)] {
            near(lr_factor(&steps, step, 100), want);
        }
        near(lr_factor(&config(0, ScheduleConfig::Constant), 7, 8), 1.0);
    }

    fn gradients(layer: &Linear, device: &Device) -> GradientsParams {
        let x = Tensor::<2>::ones([3, 4], device);
        GradientsParams::from_grads(layer.forward(x).mul_scalar(5.0).sum().backward(), layer)
    }

    #[test]
    fn clipping_is_global() {
        let device = Device::flex().autodiff();
        let layer = LinearConfig::new(4, 2).init(&device);
        let g = gradients(&layer, &device);
        let norm = gradient_norm(&layer, &g);
        // d/dw = 15 in 8 places, d/db = 15 in 2.
        assert!((norm - 15.0 * 10f32.sqrt()).abs() < 1e-3, "{norm}");
        let g = clip(&layer, g, norm, 1.0);
        assert!((gradient_norm(&layer, &g) - 1.0).abs() < 1e-4);
        let g = clip(&layer, g, 1.0, 50.0);
        assert!((gradient_norm(&layer, &g) - 1.0).abs() < 1e-4);
    }

    #[test]
    fn the_average_follows_the_weights() {
        let device = Device::flex().autodiff();
        let start: Linear = LinearConfig::new(2, 2).init(&device);
        let other = optimizer(&OptimConfig::default()).step(0.5, start.clone(), gradients2(&start));
        let mean = average(start.valid(), &other, 0.75, 1000);
        let want = start.weight.val().inner() * 0.75 + other.weight.val().inner() * 0.25;
        let off = (mean.weight.val() - want).abs().max().into_scalar::<f32>();
        assert!(off < 1e-6, "{off}");
        let early = average(start.valid(), &other, 0.999, 0);
        let want = start.weight.val().inner() * 0.1 + other.weight.val().inner() * 0.9;
        assert!((early.weight.val() - want).abs().max().into_scalar::<f32>() < 1e-6);
    }

    fn gradients2(layer: &Linear) -> GradientsParams {
        let x = Tensor::<2>::ones([1, 2], &Device::flex().autodiff());
        GradientsParams::from_grads(layer.forward(x).sum().backward(), layer)
    }
}
