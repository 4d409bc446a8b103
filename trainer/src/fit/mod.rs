//! The training loop.
//!
//! Every step's random state comes from `(seed, step)`: the samples of its batch and the device's
//! generator, which dropout reads. Learning rates are a function of the step. So a run that was
//! stopped and resumed ends with the same weights, bit for bit, as one that was not.

#[cfg(test)]
mod accumulate_tests;
mod alignment;
mod curves;
mod evaluate;
mod optim;
mod progress;
mod replica;
mod state;
mod step;
#[cfg(test)]
mod step_tests;
mod tensors;
mod throughput;
#[cfg(all(test, feature = "wgpu"))]
mod wgpu_tests;

pub use evaluate::{Group, Validation, best_box};
pub use optim::lr_factor;
pub use throughput::{Throughput, throughput};

use crate::align::Figures;
use crate::checkpoint::{CheckpointError, CheckpointStore, write_atomic};
use crate::config::{ConfigError, Experiment, SCRATCH};
use crate::import::{self, WeightsError};
use crate::logging::RunLog;
use crate::losses::LossWeights;
use crate::model::{NetOptions, TrackerNet};
use crate::prefetch::{PrefetchError, Prefetcher};
use crate::processing::{Batch, BatchMaker, Processor};
use crate::sampler::{PictureCache, SampleError, Sampler};
use burn::module::Module;
use burn::prelude::*;
use progress::{Progress, Window};
use serde::Serialize;
use state::State;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use step::{Rates, train_step};
use tsda_runtime::SpecError;

/// Keeps the validation samples apart from the training ones of the same seed.
const VALIDATION_SEED: u64 = 0x7661_6c69_6461_7465;

/// A training run that cannot start or go on.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FitError {
    /// The configuration.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The data.
    #[error(transparent)]
    Sample(#[from] SampleError),
    /// A batch could not be prepared.
    #[error("batch of step {step}: {source}")]
    Batch {
        /// The step.
        step: u64,
        /// What went wrong.
        source: PrefetchError<SampleError>,
    },
    /// The network's specification.
    #[error("[model]: {0}")]
    Spec(#[from] SpecError),
    /// Weights to start from, or the final model.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// A weights file of the configuration does not exist.
    #[error(
        "{field}: {path} does not exist; fetch the ImageNet weights (EfficientNet-Lite0: `python3 \
         trainer/scripts/fetch_efficientnet_lite0.py`; ResNet: torchvision's .pth file) and give \
         their path, or train from random weights with init.backbone = \"scratch\""
    )]
    NoWeights {
        /// Field of the configuration.
        field: &'static str,
        /// The file.
        path: PathBuf,
    },
    /// A checkpoint could not be written or read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// A checkpoint does not belong to this run.
    #[error("cannot resume from {path}: {reason}")]
    Resume {
        /// The checkpoint.
        path: PathBuf,
        /// What does not fit.
        reason: String,
    },
    /// The output folder already holds a run.
    #[error("{out} already holds checkpoints: go on with --resume, or choose another --out")]
    Exists {
        /// The folder.
        out: PathBuf,
    },
    /// A file of the run could not be written.
    #[error("cannot {action} {path}: {source}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The loss or the gradient is not a number.
    #[error(
        "step {step}: {what} is {value}; the weights were not changed and the last checkpoint is \
         intact. Samples: {}",
        .ids.join("; ")
    )]
    NotFinite {
        /// The step.
        step: u64,
        /// `loss`, `alignment loss`, `gradient norm` or the name of a branch's norm in the log.
        what: &'static str,
        /// Its value.
        value: f32,
        /// Samples of the batch.
        ids: Vec<String>,
    },
    /// Batches cannot be spread evenly over the devices.
    #[error(
        "run.accumulate = {accumulate} cannot be spread over {devices} devices: every optimiser step \
         is run.accumulate batches of run.batch samples, batch k on device k modulo {devices}; make it \
         a multiple of {devices} (and run.batch smaller, to keep the samples of a step)"
    )]
    Devices {
        /// `run.accumulate`.
        accumulate: usize,
        /// Devices given.
        devices: usize,
    },
    /// The compute device failed.
    #[error("device: {0}")]
    Device(String),
}

fn device_error(e: impl std::fmt::Debug) -> FitError {
    FitError::Device(format!("{e:?}"))
}

/// How to run, apart from what is trained.
#[derive(Clone, Debug)]
pub struct FitOptions {
    /// Go on from the newest complete checkpoint, if there is one.
    pub resume: bool,
    /// Stop (with a checkpoint) after this step, short of the end the schedule is made for.
    pub stop_after: Option<u64>,
    /// Set from outside to stop after the step under way, with a checkpoint.
    pub stop: Arc<AtomicBool>,
    /// Where to compute; autodiff is added here. Weights, optimiser and validation live here.
    pub device: Device,
    /// Further devices that take their share of a step's batches; `run.accumulate` has to be a
    /// multiple of their number plus one.
    pub more_devices: Vec<Device>,
    /// Print progress.
    pub verbose: bool,
}

impl Default for FitOptions {
    fn default() -> Self {
        Self {
            resume: false,
            stop_after: None,
            stop: Arc::default(),
            device: Device::flex(),
            more_devices: Vec::new(),
            verbose: false,
        }
    }
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// All steps are done.
    Finished {
        /// The final weights.
        model: PathBuf,
        /// The last validation, if there was one.
        validation: Option<Validation>,
    },
    /// Stopped early; a checkpoint of this step was written.
    Stopped {
        /// Steps done.
        step: u64,
    },
}

#[derive(Serialize)]
struct StepEntry {
    loss: f64,
    cls: f64,
    giou: f64,
    grad_norm: f64,
    lr: f64,
    samples_per_s: f64,
    data_wait: f64,
    /// While alignment is on.
    #[serde(flatten)]
    align: Figures,
}

#[derive(Serialize)]
struct RunEntry {
    parameters: usize,
    sequences: usize,
    batch: usize,
    accumulate: usize,
    devices: usize,
    total_steps: u64,
}

#[derive(Serialize)]
struct BadBatch<'a> {
    what: &'a str,
    ids: &'a [String],
}

/// A derived seed; mixes well even for neighbouring inputs (splitmix64's finaliser).
fn mix(seed: u64, step: u64) -> u64 {
    let mut z = seed ^ step.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

fn sampler(
    experiment: &Experiment,
    cache: &Arc<PictureCache>,
    validation: bool,
) -> Result<Sampler, SampleError> {
    // Every row of an ablation is validated on the same samples.
    let config =
        if validation { experiment.sampler.clone() } else { experiment.training_sampler() };
    Sampler::open(&experiment.data, &config, cache.clone(), validation)
}

/// The batches a configuration trains on.
///
/// # Errors
/// When the specification is wrong or the data cannot be read.
pub fn training_batches(experiment: &Experiment) -> Result<BatchMaker, FitError> {
    let spec = experiment.model_spec()?;
    let cache = Arc::new(PictureCache::new(experiment.processing.cache_mib));
    let processor = Processor::new(&spec, &experiment.processing, true);
    let run = &experiment.run;
    Ok(BatchMaker::new(sampler(experiment, &cache, false)?, processor, run.seed, run.batch))
}

/// A network with the weights training starts from.
///
/// # Errors
/// When the specification is wrong or weights cannot be read.
pub fn initial_net(experiment: &Experiment, device: &Device) -> Result<TrackerNet, FitError> {
    let spec = experiment.model_spec()?;
    let present = |field, path: &str| -> Result<PathBuf, FitError> {
        let path = PathBuf::from(path);
        if path.is_file() { Ok(path) } else { Err(FitError::NoWeights { field, path }) }
    };
    let (backbone, whole) = (&experiment.init.backbone, &experiment.init.weights);
    let backbone =
        if backbone == SCRATCH { None } else { Some(present("init.backbone", backbone)?) };
    let whole = if whole.is_empty() { None } else { Some(present("init.weights", whole)?) };
    device.seed(mix(experiment.run.seed, u64::MAX - 1));
    let options = NetOptions {
        dropout: experiment.optim.dropout,
        attention_dropout: experiment.optim.attention_dropout,
        freeze: experiment.optim.freeze,
    };
    let mut net = TrackerNet::new(&spec, &options, device)?;
    if let Some(path) = backbone {
        net = import::load_backbone(net, &path)?.0;
    }
    if let Some(path) = whole {
        net = import::load_weights(net, &path)?.0;
    }
    Ok(net)
}

/// Trains as the configuration says.
///
/// # Errors
/// See [`FitError`]. Nothing is written before data and weights have been opened.
pub fn fit(experiment: &Experiment, options: &FitOptions) -> Result<Outcome, FitError> {
    let run = &experiment.run;
    let total = experiment.total_steps();
    let devices: Vec<Device> = std::iter::once(&options.device)
        .chain(&options.more_devices)
        .map(|device| device.clone().autodiff())
        .collect();
    if !run.accumulate.is_multiple_of(devices.len()) {
        return Err(FitError::Devices { accumulate: run.accumulate, devices: devices.len() });
    }
    let store = CheckpointStore::new(&run.out, run.keep);
    if !options.resume && store.any()? {
        return Err(FitError::Exists { out: run.out.clone() });
    }
    let maker = Arc::new(training_batches(experiment)?);
    let validation = validation_batches(experiment)?;
    let device = &devices[0];
    let mut state = State::start(experiment, initial_net(experiment, device)?, device);
    let mut notes = Vec::new();
    if options.resume {
        let latest = store.latest()?;
        notes.extend(latest.skipped.iter().map(|s| format!("passed over: {s}")));
        if let Some(checkpoint) = latest.checkpoint {
            notes.extend(state.load(experiment, &checkpoint)?);
            notes.push(format!("resumed from {}", checkpoint.path.display()));
        }
        store.clean()?;
    }

    create_folder(&run.out)?;
    let resolved = experiment.to_toml()?;
    write_atomic(&run.out.join("config.resolved.toml"), resolved.as_bytes())?;
    let log_path = run.out.join("log.jsonl");
    let log_error = |source| FitError::Io { action: "write", path: log_path.clone(), source };
    let mut log = RunLog::open(&run.out).map_err(log_error)?;
    let entry = RunEntry {
        parameters: state.net.num_params(),
        sequences: maker.sampler().sequences(),
        batch: run.batch,
        accumulate: run.accumulate,
        devices: devices.len(),
        total_steps: total,
    };
    let event = if state.step > 0 { "resume" } else { "start" };
    log.entry(event, state.step, &entry, &[]).map_err(log_error)?;
    let progress = Progress::new(options.verbose, state.step, total);
    notes.iter().for_each(|note| progress.line(note));

    let end = options.stop_after.map_or(total, |s| s.min(total));
    let weights = LossWeights { classification: experiment.loss.cls, giou: experiment.loss.reg };
    let backbone = optim::backbone_group().map_err(FitError::Device)?;
    let source = maker.clone();
    let per_step = run.accumulate as u64;
    // While a step computes, the batches of the next one are prepared.
    let ahead = run.workers + run.accumulate;
    let range = state.step * per_step..end * per_step;
    let mut batches = Prefetcher::new(range, run.workers, ahead, move |i| source.step(i))
        .map_err(|source| FitError::Batch { step: state.step, source })?;
    let mut window = Window::new(run.batch * run.accumulate);
    let mut last = None;
    let mut saved = state.step;
    while state.step < end && !options.stop.load(Ordering::Relaxed) {
        let waited = Instant::now();
        let step = state.step;
        let batches: Vec<Batch> = batches
            .by_ref()
            .take(run.accumulate)
            .collect::<Result<_, _>>()
            .map_err(|source| FitError::Batch { step, source })?;
        window.wait(waited.elapsed());
        let factor = lr_factor(&experiment.optim, step, total);
        let rates = Rates {
            net: optim::learning_rate(&experiment.optim, &backbone, factor),
            align: experiment.align.lr.unwrap_or(experiment.optim.lr_head) * factor,
        };
        let figures = match train_step(&mut state, &batches, experiment, weights, rates, &devices) {
            Ok(figures) => figures,
            Err(e) => {
                if let FitError::NotFinite { what, ids, .. } = &e {
                    log.entry("not_finite", step, &BadBatch { what, ids }, &[])
                        .map_err(log_error)?;
                }
                return Err(e);
            }
        };
        window.add(figures);
        state.step += 1;
        progress.step(state.step, &window);
        let finished = state.step == total;
        if state.step.is_multiple_of(run.log_every) || state.step == end {
            let e = window.take(experiment.optim.lr_head * factor);
            progress.entry(state.step, &e);
            let mut scalars = vec![
                ("loss", e.loss),
                ("cls", e.cls),
                ("giou", e.giou),
                ("grad_norm", e.grad_norm),
                ("lr", e.lr),
                ("samples_per_s", e.samples_per_s),
                ("data_wait", e.data_wait),
            ];
            scalars.extend(e.align.iter().map(|(name, value)| (*name, *value)));
            log.entry("train", state.step, &e, &scalars).map_err(log_error)?;
        }
        let due =
            run.validate_every > 0 && (state.step.is_multiple_of(run.validate_every) || finished);
        if let (true, Some(maker)) = (due, &validation) {
            let net = state.inference_net();
            let plain = options.device.clone();
            let v = evaluate::validate(
                &net,
                maker,
                run.validation_samples,
                run.batch,
                weights,
                &plain,
            )?;
            progress.validation(state.step, &v);
            let scalars: Vec<(&str, f64)> = [("same", v.same), ("cross", v.cross), ("all", v.all)]
                .iter()
                .flat_map(|(group, g)| {
                    scalar_names(group).into_iter().zip([g.cls, g.giou, g.iou, g.success])
                })
                .collect();
            log.entry("validation", state.step, &v, &scalars).map_err(log_error)?;
            last = Some(v);
            window.restart();
        }
        if state.step.is_multiple_of(run.checkpoint_every) || finished {
            state.save(&store, &resolved)?;
            saved = state.step;
            window.restart();
        }
    }
    if saved != state.step {
        state.save(&store, &resolved)?;
    }
    progress.finish();
    curves::write(experiment)?;
    if state.step < total {
        return Ok(Outcome::Stopped { step: state.step });
    }
    let model = run.out.join("model.safetensors");
    import::save_weights(&state.inference_net(), &model)?;
    Ok(Outcome::Finished { model, validation: last })
}

fn scalar_names(group: &str) -> [&'static str; 4] {
    match group {
        "same" => ["same/cls", "same/giou", "same/iou", "same/success"],
        "cross" => ["cross/cls", "cross/giou", "cross/iou", "cross/success"],
        _ => ["all/cls", "all/giou", "all/iou", "all/success"],
    }
}

fn validation_batches(experiment: &Experiment) -> Result<Option<BatchMaker>, FitError> {
    let run = &experiment.run;
    if run.validate_every == 0 {
        return Ok(None);
    }
    let cache = Arc::new(PictureCache::new(experiment.processing.cache_mib));
    let sampler = sampler(experiment, &cache, true)?;
    if sampler.is_empty() {
        return Ok(None);
    }
    let processor = Processor::new(&experiment.model_spec()?, &experiment.processing, false);
    Ok(Some(BatchMaker::new(sampler, processor, run.seed ^ VALIDATION_SEED, run.batch)))
}

fn create_folder(path: &Path) -> Result<(), FitError> {
    std::fs::create_dir_all(path).map_err(|source| FitError::Io {
        action: "create",
        path: path.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_of_neighbouring_steps_are_unrelated() {
        let seeds: Vec<u64> = (0..1000).map(|s| mix(1, s)).collect();
        let mut unique = seeds.clone();
        unique.sort_unstable();
        unique.dedup();
        assert_eq!(unique.len(), seeds.len());
        for pair in seeds.windows(2) {
            let differing = (pair[0] ^ pair[1]).count_ones();
            assert!((8..=56).contains(&differing), "{differing} bits differ");
        }
        assert_ne!(mix(1, 2), mix(2, 1));
    }
}
