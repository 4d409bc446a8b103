//! Are RGB and thermal descriptors aligned? The command `tsda-train align-report`.
//!
//! 1. [`descriptors`] draws targets of registered pairs as training does, shows them to the network
//!    by both sensors and pools what comes out before and after the encoder;
//! 2. [`measures`] turns the descriptors into figures, [`probe`] asks a linear classifier for the
//!    sensor, [`pca`] finds the plane to draw them in;
//! 3. [`svg`] and [`page`] write it down.
//!
//! Definitions and how to read them: `docs/alignment.md`.

pub mod descriptors;
pub mod measures;
pub mod page;
pub mod pca;
pub mod probe;
pub mod svg;
#[cfg(test)]
mod tests;

use crate::checkpoint::{CheckpointError, CheckpointStore, write_atomic};
use crate::config::{Experiment, SamplerConfig};
use crate::fit::{FitError, initial_net};
use crate::import::{self, WeightsError};
use crate::model::{NetOptions, TrackerNet};
use crate::processing::Processor;
use crate::sampler::{PictureCache, SampleError, Sampler};
use burn::tensor::Device;
use descriptors::{Descriptors, Plan, Role, Views};
use measures::Measures;
use pca::Pca;
use probe::{Example, ProbeResult, Tally};
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tsda_eval::dataset::{self, OpenError, Registration, Sequence};
use tsda_runtime::SpecError;

/// File of the weights in a checkpoint.
const WEIGHTS: &str = "model.safetensors";

/// A report that cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AlignError {
    /// The data cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The data shows no target by both sensors at once.
    #[error(
        "--data {data}: none of its {sequences} sequences is a still of both sensors on one pixel \
         grid; use registered pairs (pairs:DIR[@val])"
    )]
    NotRegistered {
        /// The data as given.
        data: String,
        /// Sequences looked at.
        sequences: usize,
    },
    /// There are stills, but no target in them.
    #[error(
        "--data {data}: no target to draw; stills need a box of at least {least} pixels (root of \
         its area), or sampler.random_region_p > 0 in the configuration"
    )]
    NoTargets {
        /// The data as given.
        data: String,
        /// `sampler.min_target`.
        least: f32,
    },
    /// All targets come from one sequence.
    #[error(
        "--data {data}: {targets} targets were drawn and all are from one still; the probe needs \
         at least two (more data, or a larger --pairs)"
    )]
    OneSequence {
        /// The data as given.
        data: String,
        /// Targets drawn.
        targets: usize,
    },
    /// An option out of range.
    #[error("{option}: must be at least {least}, is {value}")]
    Option {
        /// The option.
        option: &'static str,
        /// Its least value.
        least: usize,
        /// What it is.
        value: usize,
    },
    /// A sample could not be drawn.
    #[error(transparent)]
    Sample(#[from] SampleError),
    /// The sampler gave a sample of one sensor where it was to give one of two.
    #[error("sample {id} does not show its target by both sensors")]
    NotCross {
        /// The sample.
        id: String,
    },
    /// The network's specification.
    #[error("[model]: {0}")]
    Spec(#[from] SpecError),
    /// The weights cannot be read.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The network of the configuration cannot be made.
    #[error(transparent)]
    Initial(#[from] FitError),
    /// The run's folder cannot be read, or a file of the report cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// A run without a complete checkpoint.
    #[error("--checkpoint: {path} holds neither {WEIGHTS} nor a complete checkpoint{}",
        .skipped.iter().map(|s| format!("; passed over: {s}")).collect::<String>())]
    NoCheckpoint {
        /// The folder.
        path: PathBuf,
        /// Incomplete ones, and why.
        skipped: Vec<String>,
    },
    /// A descriptor is not a number.
    #[error("the network gives values that are not finite for sample {id}: damaged weights?")]
    NotFinite {
        /// The sample.
        id: String,
    },
    /// The compute device failed.
    #[error("device: {0}")]
    Device(String),
    /// The figures cannot be written as JSON.
    #[error("cannot write the figures: {0}")]
    Json(#[from] serde_json::Error),
}

/// Where the network's weights are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum WeightsFrom {
    /// A weights file, safetensors or PyTorch.
    File(PathBuf),
    /// A folder with `model.safetensors`: a finished run or one checkpoint; else the newest complete
    /// checkpoint in it.
    Run(PathBuf),
    /// What training by the configuration starts from (`[init]`).
    Initial,
}

/// What to look at.
#[derive(Clone, Debug)]
pub struct AlignOptions {
    /// The network's weights.
    pub weights: WeightsFrom,
    /// `KIND:PATH[@split]`.
    pub data: String,
    /// Targets to draw, at least 2.
    pub pairs: usize,
    /// Seed of the drawing.
    pub seed: u64,
    /// Targets put through the network at a time, at least 1.
    pub batch: usize,
    /// Where to compute; without autodiff.
    pub device: Device,
}

/// Accuracy of the probe: one classifier for templates, one for search crops.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ProbeStage {
    /// Over the descriptors of both.
    pub both: ProbeResult,
    /// Of templates.
    pub template: ProbeResult,
    /// Of search crops.
    pub search: ProbeResult,
}

/// Everything about one stage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Stage {
    /// Distances and ratios.
    #[serde(flatten)]
    pub measures: Measures,
    /// The probe.
    pub probe: ProbeStage,
    /// Shares of the variance along the two components drawn; descriptors centred per role.
    pub explained_variance: Vec<f64>,
}

/// All figures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// The weights, in words.
    pub weights: String,
    /// The data as given.
    pub data: String,
    /// Targets drawn.
    pub targets: usize,
    /// Registered pairs they are from.
    pub sequences: usize,
    /// Seed of the drawing.
    pub seed: u64,
    /// Numbers in a descriptor, `d`.
    pub width: usize,
    /// [`Measures::r`] before the encoder.
    pub r_pre: Option<f64>,
    /// [`Measures::r`] after the encoder.
    pub r_post: Option<f64>,
    /// Pooled head features before any encoding.
    pub pre: Stage,
    /// Pooled encoder outputs.
    pub post: Stage,
}

/// A report and its pictures.
#[derive(Clone, Debug)]
pub struct Alignment {
    /// The figures.
    pub report: Report,
    /// Scatter of pre-encoder descriptors, SVG.
    pub pre_svg: String,
    /// Scatter of post-encoder descriptors, SVG.
    pub post_svg: String,
}

impl Alignment {
    /// Writes `align.json`, `align-pre.svg`, `align-post.svg` and `align.html` into a folder, which
    /// is created.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), AlignError> {
        std::fs::create_dir_all(folder).map_err(|source| CheckpointError::Io {
            action: "create",
            path: folder.to_owned(),
            source,
        })?;
        let mut json = serde_json::to_string_pretty(&self.report)?;
        json.push('\n');
        let page = page::html(&self.report, &self.pre_svg, &self.post_svg);
        for (name, text) in [
            ("align-pre.svg", &self.pre_svg),
            ("align-post.svg", &self.post_svg),
            ("align.html", &page),
            ("align.json", &json),
        ] {
            write_atomic(&folder.join(name), text.as_bytes())?;
        }
        Ok(())
    }
}

/// Draws targets, runs the network and analyses what comes out; `on_batch` hears how many targets
/// are done. The same options give the same report on one machine.
///
/// # Errors
/// See [`AlignError`].
pub fn run(
    experiment: &Experiment,
    options: &AlignOptions,
    on_batch: impl FnMut(usize),
) -> Result<Alignment, AlignError> {
    for (option, value, least) in [("--pairs", options.pairs, 2), ("--batch", options.batch, 1)] {
        if value < least {
            return Err(AlignError::Option { option, least, value });
        }
    }
    let sampler = sampler(experiment, &options.data)?;
    let (net, weights) = network(experiment, options)?;
    let processor = Processor::new(net.spec(), &experiment.processing, false);
    let plan = Plan {
        targets: options.pairs,
        batch: options.batch,
        seed: options.seed,
        device: &options.device,
    };
    let found = descriptors::collect(&net, &sampler, &processor, plan, on_batch)?;
    let sequences = found.pre.iter().map(|t| t.group).collect::<BTreeSet<_>>().len();
    if sequences < 2 {
        let data = options.data.clone();
        return Err(AlignError::OneSequence { data, targets: found.pre.len() });
    }
    Ok(analyse(
        &found,
        |pre, post| Report {
            weights,
            data: options.data.clone(),
            targets: found.pre.len(),
            sequences,
            seed: options.seed,
            width: net.spec().width.into(),
            r_pre: pre.measures.r.map(|r| r.value),
            r_post: post.measures.r.map(|r| r.value),
            pre,
            post,
        },
        options.seed,
    ))
}

/// Stills of both sensors on one grid; every draw crosses sensors.
fn sampler(experiment: &Experiment, data: &str) -> Result<Sampler, AlignError> {
    let opened = dataset::open(data)?;
    let sequences = opened.sequences.len();
    let fits = |s: &dyn Sequence| {
        s.frames() == 1
            && descriptors::SENSORS.iter().all(|m| s.modalities().contains(m))
            && s.registration() == Registration::Aligned
    };
    let stills: Vec<_> = opened.sequences.into_iter().filter(|s| fits(s.as_ref())).collect();
    if stills.is_empty() {
        return Err(AlignError::NotRegistered { data: data.to_owned(), sequences });
    }
    let config = SamplerConfig { cross_modal_p: 1.0, ..experiment.sampler.clone() };
    let cache = Arc::new(PictureCache::new(experiment.processing.cache_mib));
    Sampler::from_sequences(stills, true, &config, cache)
        .ok_or_else(|| AlignError::NoTargets { data: data.to_owned(), least: config.min_target })
}

/// The network for inference, and what its weights are.
fn network(
    experiment: &Experiment,
    options: &AlignOptions,
) -> Result<(TrackerNet, String), AlignError> {
    let path = match &options.weights {
        WeightsFrom::File(path) => path.clone(),
        WeightsFrom::Run(folder) => newest(folder)?,
        WeightsFrom::Initial => {
            let (backbone, whole) = (&experiment.init.backbone, &experiment.init.weights);
            let words = if whole.is_empty() {
                format!("start of training (init.backbone = {backbone}, random head)")
            } else {
                format!("start of training (init.weights = {whole})")
            };
            return Ok((initial_net(experiment, &options.device)?, words));
        }
    };
    let net = TrackerNet::new(&experiment.model_spec()?, &NetOptions::default(), &options.device)?;
    let (net, _) = import::load_weights(net, &path)?;
    Ok((net, path.display().to_string()))
}

fn newest(folder: &Path) -> Result<PathBuf, AlignError> {
    let own = folder.join(WEIGHTS);
    if own.is_file() {
        return Ok(own);
    }
    let latest = CheckpointStore::new(folder, 1).latest()?;
    match latest.checkpoint {
        Some(checkpoint) => Ok(checkpoint.path.join(WEIGHTS)),
        None => Err(AlignError::NoCheckpoint { path: folder.to_owned(), skipped: latest.skipped }),
    }
}

fn analyse(
    found: &Descriptors,
    report: impl FnOnce(Stage, Stage) -> Report,
    seed: u64,
) -> Alignment {
    let (pre, pre_svg) = stage("Pre-encoder descriptors", &found.pre, seed);
    let (post, post_svg) = stage("Post-encoder descriptors", &found.post, seed);
    Alignment { report: report(pre, post), pre_svg, post_svg }
}

/// Figures and picture of one stage.
fn stage(title: &str, targets: &[Views], seed: u64) -> (Stage, String) {
    let centred = Views::centred(targets);
    let [template, search] = Role::ALL.map(|role| {
        let examples: Vec<Example<'_>> = targets
            .iter()
            .flat_map(|t| {
                [false, true].into_iter().flat_map(move |thermal| {
                    let of = t.all(role, usize::from(thermal));
                    of.map(move |values| Example { values, thermal, group: t.group })
                })
            })
            .collect();
        let mut tally = Tally::default();
        tally.probe(&examples);
        tally
    });
    let mut both = template.clone();
    both.merge(&search);
    let rows: Vec<&[f64]> = centred
        .iter()
        .flat_map(|t| {
            Role::ALL.into_iter().flat_map(move |r| (0..2).flat_map(move |s| t.all(r, s)))
        })
        .collect();
    let pca = Pca::fit(&rows, 2);
    let stage = Stage {
        measures: Measures::of(targets, &centred, seed),
        probe: ProbeStage {
            both: both.result(),
            template: template.result(),
            search: search.result(),
        },
        explained_variance: pca.explained.clone(),
    };
    (stage, svg::scatter(title, &centred, &pca))
}
