//! One TOML file that fixes a training run, from the network to the last seed.
//!
//! Every table refuses unknown keys and every value is checked before anything is read or written,
//! so a typing mistake costs a second and not an hour. [`Experiment::load`] names the file, the
//! line and the field. The resolved copy (presets expanded, paths made concrete, overrides applied)
//! is written beside the results with [`Experiment::to_toml`].

mod align;
mod load;
mod model;
mod validate;

pub use align::{
    Adversarial, AdversarialConfig, AlignConfig, AlignPreset, AlignStage, Contrastive,
    ContrastiveConfig,
};
pub use load::ConfigError;
pub use model::ModelConfig;
pub use validate::FieldError;

use crate::model::FreezePolicy;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use tsda_runtime::{ModelSpec, SpecError, TrackerParams};

/// Everything a training run depends on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Experiment {
    /// The network.
    pub model: ModelConfig,
    /// Thresholds of the online tracker; training does not read them, bundles carry them.
    pub tracker: TrackerParams,
    /// Where samples come from; at least one entry.
    pub data: Vec<DataSource>,
    /// How frames, targets and sensors are drawn.
    pub sampler: SamplerConfig,
    /// How drawn frames become network input.
    pub processing: ProcessingConfig,
    /// Weights of the two losses.
    pub loss: LossConfig,
    /// Training-only alignment of the two sensors.
    pub align: AlignConfig,
    /// Optimiser, learning rates, freezing.
    pub optim: OptimConfig,
    /// Weights to start from.
    pub init: InitConfig,
    /// Length, seed, checkpoints, logs.
    pub run: RunConfig,
}

/// One set of sequences to draw from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataSource {
    /// Name in logs and on the command line (`--data NAME=DIR`); the kind's name when left out.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub name: String,
    /// Layout of the folder, as `tsda data-check` and `tsda eval` name it: `KIND[/option..]`
    /// ([`tsda_eval::dataset::KINDS`]).
    pub kind: String,
    /// The folder; relative paths are tried beside the configuration file, then from the current
    /// folder.
    pub path: PathBuf,
    /// Split trained on.
    #[serde(default = "train_split")]
    pub split: String,
    /// Split validated on; an empty string leaves the source out of validation.
    #[serde(default = "val_split")]
    pub validation_split: String,
    /// Share of the samples, relative to the other sources' weights.
    #[serde(default = "one")]
    pub weight: f64,
    /// Only sequences whose name contains one of these texts; all when empty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub only: Vec<String>,
    /// Take part in `sampler.random_region_p`? When left out, sources do whose kind promises
    /// registered sensors (`pairs`, `pseudo`, `lasher`, `rgbt210`, `antiuav/registered`).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub regions: Option<bool>,
}

impl DataSource {
    /// What logs call it.
    pub fn label(&self) -> &str {
        if self.name.is_empty() { &self.kind } else { &self.name }
    }

    /// May targets be random regions?
    pub fn draws_regions(&self) -> bool {
        let registered = ["pairs", "pseudo", "lasher", "rgbt210", "antiuav/registered"];
        self.regions.unwrap_or_else(|| registered.contains(&self.kind.as_str()))
    }

    /// Sensors that material of this kind can hold: `(RGB, thermal)`.
    pub fn sensors(&self) -> (bool, bool) {
        match self.kind.as_str() {
            "otb" | "got10k" | "coco" | "otb/zero-based" => (true, false),
            kind if kind.split('/').any(|word| word == "thermal") => (false, true),
            _ => (true, true),
        }
    }
}

fn train_split() -> String {
    "train".into()
}
fn val_split() -> String {
    "val".into()
}
fn one() -> f64 {
    1.0
}

/// How frames, targets and sensors are drawn (spec 2.1 and the paper's modality rule).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SamplerConfig {
    /// Template frames per sample; all of one sensor.
    pub templates: usize,
    /// Share of samples whose search frame comes from the other sensor, over all sources together.
    pub cross_modal_p: f64,
    /// Share of the samples of sources that draw regions (`data.regions`) whose target is a random
    /// textured region instead of an annotated box.
    pub random_region_p: f64,
    /// Smallest side of a random region in pixels.
    pub region_min: f32,
    /// Largest side of a random region in pixels (and never above half the picture's short side).
    pub region_max: f32,
    /// A region counts as textured when, in every sensor drawn, its mean gradient is at least this
    /// share of the picture's.
    pub region_texture: f32,
    /// Annotated boxes with a smaller `sqrt(w h)` are not used, in pixels.
    pub min_target: f32,
    /// Largest distance in frames between the base template and any other frame of a video.
    pub gap: usize,
    /// Chance that a target of another sequence of the source is pasted beside the target in the
    /// search crop. Training only.
    pub distractor_p: f64,
    /// Chance that part of a picture of another sequence of the source covers part of the target in
    /// the search crop. Training only.
    pub occluder_p: f64,
    /// Chance that the search crop does not show the target: it is either cut around a target of
    /// another sequence, or what lies beside the target is copied over it. Its score map is then all
    /// background, and it takes no part in the box loss. Training only; not with contrastive alignment.
    pub absent_p: f64,
    /// Chance, in samples across sensors, that a template after the first comes from the search
    /// frame's sensor, as it does in the tracker's memory some time after a change of sensor. Training
    /// only; not with alignment, which needs templates of one sensor.
    pub mixed_templates_p: f64,
    /// Samples that count as one epoch.
    pub samples_per_epoch: usize,
}

impl Default for SamplerConfig {
    fn default() -> Self {
        Self {
            templates: 2,
            cross_modal_p: 0.5,
            random_region_p: 0.3,
            region_min: 20.0,
            region_max: 160.0,
            region_texture: 0.8,
            min_target: 8.0,
            gap: 200,
            distractor_p: 0.0,
            occluder_p: 0.0,
            absent_p: 0.0,
            mixed_templates_p: 0.0,
            samples_per_epoch: 4000,
        }
    }
}

/// Jitter of the box a crop is cut around (spec 2.3).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JitterConfig {
    /// `sj`: standard deviation of the logarithm of width and height.
    pub scale: f32,
    /// `cj`: the centre moves by up to half of this, in units of `sqrt(w h)`, per axis.
    pub centre: f32,
    /// Standard deviation of the logarithm of the crop's stretch (x against y). The reference has
    /// none; stills, where nothing else moves, profit from a little.
    pub aspect: f32,
}

impl Default for JitterConfig {
    fn default() -> Self {
        Self { scale: 0.5, centre: 4.5, aspect: 0.0 }
    }
}

/// From a drawn frame to network input (spec 2.2, 2.3).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProcessingConfig {
    /// Jitter of template crops.
    pub template: JitterConfig,
    /// Jitter of search crops.
    pub search: JitterConfig,
    /// Largest factor by which a crop may shrink to stay inside the picture.
    pub max_scale_change: f32,
    /// Chance that the whole sample is mirrored.
    pub joint_flip_p: f64,
    /// Chance that one crop is mirrored on its own.
    pub crop_flip_p: f64,
    /// Chance that the sample's RGB pictures turn grey.
    pub grayscale_p: f64,
    /// Chance that the sample's RGB pictures turn into one random mixture of their channels instead,
    /// which comes nearer to what a thermal camera shows of a coloured thing.
    pub channel_mix_p: f64,
    /// Chance that, in a sample within one sensor, either the templates or the search crop are shown as
    /// another sensor might: one random mixture of the channels, then an arbitrary curve over the grey
    /// values. Not in the paper; for material with few pictures of two sensors.
    pub sensor_shift_p: f64,
    /// Largest share of the target's width and height that an occluder covers
    /// (`sampler.occluder_p`).
    pub occluder_side: f32,
    /// Brightness factor is uniform in `1 +- brightness`.
    pub brightness: f32,
    /// Photometric changes of RGB crops.
    pub rgb: PhotometricConfig,
    /// Photometric changes of thermal crops.
    pub thermal: PhotometricConfig,
    /// Decoded pictures kept in memory, in MiB.
    pub cache_mib: usize,
}

impl Default for ProcessingConfig {
    fn default() -> Self {
        Self {
            template: JitterConfig { scale: 0.0, centre: 0.0, aspect: 0.0 },
            search: JitterConfig::default(),
            max_scale_change: 1.5,
            joint_flip_p: 0.5,
            crop_flip_p: 0.5,
            grayscale_p: 0.05,
            channel_mix_p: 0.0,
            sensor_shift_p: 0.0,
            occluder_side: 0.6,
            brightness: 0.2,
            rgb: PhotometricConfig::default(),
            thermal: PhotometricConfig::default(),
            cache_mib: 1024,
        }
    }
}

/// Changes of grey values of one sensor; all off by default, as in the reference.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PhotometricConfig {
    /// Gamma is `exp(U(-gamma, gamma))`.
    pub gamma: f32,
    /// Contrast factor around the crop's mean is `exp(U(-contrast, contrast))`.
    pub contrast: f32,
    /// Chance that grey values are inverted (white-hot / black-hot), once per sample and sensor.
    pub invert_p: f64,
    /// Chance of a Gaussian blur.
    pub blur_p: f64,
    /// Largest standard deviation of the blur, in crop pixels.
    pub blur_sigma: f32,
    /// Chance of added Gaussian noise.
    pub noise_p: f64,
    /// Largest standard deviation of the noise, in grey levels of 0..255.
    pub noise_sigma: f32,
    /// Chance that grey values are stretched to fill the range, as a thermal camera's automatic gain
    /// does.
    pub window_p: f64,
    /// Largest share of the pixels that the stretch clips, at each end.
    pub window: f32,
    /// Chance that a crop is smeared along a random direction.
    pub motion_blur_p: f64,
    /// Largest length of the smear, in crop pixels.
    pub motion_blur: f32,
}

/// Loss weights (spec 2.5).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Weight of the classification loss.
    pub cls: f64,
    /// Weight of the box loss.
    pub reg: f64,
}

impl Default for LossConfig {
    fn default() -> Self {
        Self { cls: 100.0, reg: 1.0 }
    }
}

/// How the learning rate falls after the warm-up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case", tag = "kind")]
pub enum ScheduleConfig {
    /// Never.
    Constant,
    /// Times `gamma` at each of these shares of the run.
    Step {
        /// Shares of the run, in `(0, 1)`, rising.
        at: Vec<f64>,
        /// Factor per step.
        gamma: f64,
    },
    /// Half a cosine from 1 to `floor`.
    Cosine {
        /// Share of the starting rate left at the end.
        #[serde(default)]
        floor: f64,
    },
}

/// AdamW, learning rates, freezing (spec 2.6, 2.7).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimConfig {
    /// Learning rate of everything but the backbone.
    pub lr_head: f64,
    /// Learning rate of the backbone.
    pub lr_backbone: f64,
    /// Decoupled weight decay, on every parameter.
    pub weight_decay: f64,
    /// Added to the root of the second moment.
    pub eps: f64,
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Steps over which the rates rise linearly from zero.
    pub warmup_steps: u64,
    /// After the warm-up.
    pub schedule: ScheduleConfig,
    /// Largest norm of all gradients together; 0 switches clipping off.
    pub clip_norm: f64,
    /// Decay of the running average of the weights; 0 switches it off. Validation and the final
    /// model use the average.
    pub ema_decay: f64,
    /// Leading layers of the backbone that stay as they are: `"before_stride16"`, `"all"`,
    /// `"none"` or `{ leading = 3 }`.
    pub freeze: FreezePolicy,
    /// Share of transformer activations dropped.
    pub dropout: f64,
    /// Share of attention weights dropped.
    pub attention_dropout: f64,
}

impl Default for OptimConfig {
    fn default() -> Self {
        Self {
            lr_head: 1e-4,
            lr_backbone: 2e-5,
            weight_decay: 1e-4,
            eps: 1e-8,
            beta1: 0.9,
            beta2: 0.999,
            warmup_steps: 0,
            schedule: ScheduleConfig::Cosine { floor: 0.01 },
            clip_norm: 0.0,
            ema_decay: 0.0,
            freeze: FreezePolicy::default(),
            dropout: 0.1,
            attention_dropout: 0.1,
        }
    }
}

/// Weights to start from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InitConfig {
    /// Backbone weights (safetensors, or a PyTorch file as torchvision's), or `"scratch"` for random
    /// ones.
    pub backbone: String,
    /// Weights of a whole network of the same specification to go on from (safetensors, or a
    /// pytracking checkpoint); empty for none.
    pub weights: String,
}

/// Value of [`InitConfig::backbone`] that asks for random weights.
pub const SCRATCH: &str = "scratch";

impl Default for InitConfig {
    fn default() -> Self {
        Self { backbone: SCRATCH.into(), weights: String::new() }
    }
}

/// Length, seed, checkpoints, logs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunConfig {
    /// Optimiser steps; when 0, `epochs` decides.
    pub steps: u64,
    /// Epochs of `sampler.samples_per_epoch` samples, used when `steps` is 0.
    pub epochs: u64,
    /// Samples per forward pass; what in-batch negatives and batch statistics are taken over.
    pub batch: usize,
    /// Batches per optimiser step. The step's gradient is that of the mean over all their samples.
    pub accumulate: usize,
    /// Seed of everything random.
    pub seed: u64,
    /// Threads that prepare batches.
    pub workers: usize,
    /// Folder for checkpoints, logs and the final model.
    pub out: PathBuf,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Checkpoints kept.
    pub keep: usize,
    /// Steps between log entries.
    pub log_every: u64,
    /// Steps between validations; 0 for none.
    pub validate_every: u64,
    /// Samples per validation; the same ones every time.
    pub validation_samples: usize,
}

impl Default for RunConfig {
    fn default() -> Self {
        Self {
            steps: 0,
            epochs: 1,
            batch: 16,
            accumulate: 1,
            seed: 1,
            workers: 2,
            out: PathBuf::from("out"),
            checkpoint_every: 500,
            keep: 3,
            log_every: 10,
            validate_every: 500,
            validation_samples: 128,
        }
    }
}

impl RunConfig {
    /// Samples that an optimiser step sees, at least 1.
    pub fn samples_per_step(&self) -> u64 {
        (self.batch as u64).saturating_mul(self.accumulate as u64).max(1)
    }
}

impl Experiment {
    /// The network, preset and overrides put together.
    ///
    /// # Errors
    /// When the preset is unknown or a field is out of range.
    pub fn model_spec(&self) -> Result<ModelSpec, SpecError> {
        self.model.spec()
    }

    /// Optimiser steps of the whole run.
    pub fn total_steps(&self) -> u64 {
        if self.run.steps > 0 {
            return self.run.steps;
        }
        let samples = self.run.epochs.saturating_mul(self.sampler.samples_per_epoch as u64);
        samples.div_ceil(self.run.samples_per_step())
    }

    /// First step with alignment losses (0-based), whether or not the run has any.
    pub fn align_start(&self) -> u64 {
        let samples = self.align.start_epoch.saturating_mul(self.sampler.samples_per_epoch as u64);
        self.align.start_step.unwrap_or_else(|| samples.div_ceil(self.run.samples_per_step()))
    }

    /// Share of the alignment weights in force at a step, 0 to 1; `None` before alignment starts
    /// and in runs without.
    pub fn align_factor(&self, step: u64) -> Option<f64> {
        let done = step.checked_sub(self.align_start()).filter(|_| self.align.is_on())?;
        let ramp = self.align.ramp_steps.max(1);
        Some(((done + 1) as f64 / ramp as f64).min(1.0))
    }

    /// Would `other` align in another way? However the two tables say it.
    pub fn align_differs(&self, other: &Self) -> bool {
        let said = |e: &Self| {
            let on = e.align.is_on();
            let when = on.then(|| (e.align_start(), e.align.ramp_steps, e.align.lr));
            let alone = e.align.preset == AlignPreset::Baseline;
            (e.align.adversarial(), e.align.contrastive(), when, alone)
        };
        said(self) != said(other)
    }

    /// How training samples are drawn: `[sampler]`, or with one sensor only in the baseline row.
    pub fn training_sampler(&self) -> SamplerConfig {
        let mut sampler = self.sampler.clone();
        if self.align.preset == AlignPreset::Baseline {
            sampler.cross_modal_p = 0.0;
        }
        sampler
    }
}

#[cfg(test)]
mod tests;
