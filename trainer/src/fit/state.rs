//! What changes from step to step, and how it is kept.

use super::alignment::Alignment;
use super::{FitError, optim};
use crate::checkpoint::{Checkpoint, CheckpointError, CheckpointStore, write_atomic};
use crate::config::Experiment;
use crate::import;
use crate::model::TrackerNet;
use burn::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::module::Module;
use burn::optim::{GradientsParams, ModuleOptimizer};
use burn::prelude::*;
use burn::store::ModuleRecord;
use burn::tensor::Bytes;
use serde::{Deserialize, Serialize};
use std::path::Path;

const MODEL: &str = "model.bpk";
const OPTIM: &str = "optim.bpk";
const AVERAGE: &str = "ema.bpk";
const STATE: &str = "state.json";
const WEIGHTS: &str = "model.safetensors";

/// What a checkpoint says about itself.
#[derive(Serialize, Deserialize)]
struct Header {
    step: u64,
    /// The resolved configuration it was trained with.
    config: String,
}

/// Network, alignment branches, optimisers, running average and the number of steps done.
pub(super) struct State {
    pub net: TrackerNet,
    pub step: u64,
    /// Branches that exist in training only.
    pub align: Option<Alignment>,
    optimizer: ModuleOptimizer,
    /// Running average of the weights, without autodiff.
    average: Option<TrackerNet>,
}

impl State {
    pub fn start(experiment: &Experiment, net: TrackerNet, device: &Device) -> Self {
        let average = (experiment.optim.ema_decay > 0.0).then(|| net.valid());
        let align = Alignment::start(experiment, net.spec().width.into(), device);
        Self { net, step: 0, align, optimizer: optim::optimizer(&experiment.optim), average }
    }

    /// One optimiser step.
    pub fn update(&mut self, rate: ModuleLearningRate, gradients: GradientsParams, decay: f64) {
        self.net = self.optimizer.step(rate, self.net.clone(), gradients);
        if let Some(average) = self.average.take() {
            self.average = Some(optim::average(average, &self.net, decay, self.step));
        }
    }

    /// The network to validate and ship: the running average where there is one.
    pub fn inference_net(&self) -> TrackerNet {
        self.average.clone().unwrap_or_else(|| self.net.valid())
    }

    /// Writes the checkpoint of this step.
    pub fn save(&self, store: &CheckpointStore, config: &str) -> Result<Checkpoint, FitError> {
        store.write(self.step, |folder| {
            put_record(folder, MODEL, self.net.clone().into_record().into_bytes())?;
            put_record(folder, OPTIM, self.optimizer.into_bytes())?;
            if let Some(average) = &self.average {
                put_record(folder, AVERAGE, average.clone().into_record().into_bytes())?;
            }
            if let Some(align) = &self.align {
                align.save(folder)?;
            }
            let header = Header { step: self.step, config: config.to_owned() };
            let text = serde_json::to_vec_pretty(&header)
                .map_err(|e| FitError::Device(format!("cannot write {STATE}: {e}")))?;
            write_atomic(&folder.join(STATE), &text)?;
            // Not needed to go on, but exportable at once.
            Ok(import::save_weights(&self.inference_net(), &folder.join(WEIGHTS))?)
        })
    }

    /// Goes on from a checkpoint. Returns notes for the user: settings that changed.
    pub fn load(
        &mut self,
        experiment: &Experiment,
        checkpoint: &Checkpoint,
    ) -> Result<Vec<String>, FitError> {
        let unfit = |reason: String| FitError::Resume { path: checkpoint.path.clone(), reason };
        let header: Header = serde_json::from_slice(&checkpoint.read(STATE)?)
            .map_err(|e| unfit(format!("{STATE}: {e}")))?;
        let then = Experiment::parse(&header.config, &checkpoint.path.join(STATE))?;
        if then.model_spec()? != experiment.model_spec()? {
            return Err(unfit("it holds a network of another [model]".into()));
        }
        // Parameters get the ids they had, by which the optimiser's state is found.
        self.net = self
            .net
            .clone()
            .try_load_record(read_record(checkpoint, MODEL)?)
            .map_err(|e| unfit(format!("{MODEL}: {e}")))?;
        self.optimizer = optim::optimizer(&experiment.optim)
            .from_bytes(Bytes::from_bytes_vec(checkpoint.read(OPTIM)?))
            .map_err(|e| unfit(format!("{OPTIM}: {e}")))?;
        if experiment.optim.ema_decay > 0.0 {
            let average = self.net.valid();
            self.average = Some(if checkpoint.has(AVERAGE) {
                average
                    .try_load_record(read_record(checkpoint, AVERAGE)?)
                    .map_err(|e| unfit(format!("{AVERAGE}: {e}")))?
            } else {
                average
            });
        }
        self.step = header.step;
        let mut notes = changes(&then, experiment);
        if let Some(align) = &mut self.align {
            notes.extend(align.load(experiment, &then.align, checkpoint)?);
        }
        Ok(notes)
    }
}

/// Tables that differ and make the resumed run another one than an uninterrupted run.
fn changes(then: &Experiment, now: &Experiment) -> Vec<String> {
    let tables = [
        ("data", then.data != now.data),
        ("sampler", then.sampler != now.sampler),
        ("processing", then.processing != now.processing),
        ("loss", then.loss != now.loss),
        ("align", then.align_differs(now)),
        ("optim", then.optim != now.optim),
        ("run.seed", then.run.seed != now.run.seed),
        ("run.batch", then.run.batch != now.run.batch),
        ("run.accumulate", then.run.accumulate != now.run.accumulate),
        ("run.steps", then.total_steps() != now.total_steps()),
    ];
    tables
        .iter()
        .filter(|(_, differs)| *differs)
        .map(|(name, _)| format!("warning: {name} differs from the checkpoint's configuration"))
        .collect()
}

/// A record of a checkpoint.
pub(super) fn read_record(checkpoint: &Checkpoint, name: &str) -> Result<ModuleRecord, FitError> {
    ModuleRecord::from_bytes(Bytes::from_bytes_vec(checkpoint.read(name)?)).map_err(|e| {
        FitError::Resume { path: checkpoint.path.clone(), reason: format!("{name}: {e}") }
    })
}

/// Writes a record into a checkpoint's folder.
pub(super) fn put_record<E: std::fmt::Display>(
    folder: &Path,
    name: &str,
    bytes: Result<Bytes, E>,
) -> Result<(), FitError> {
    let path = folder.join(name);
    let bytes = bytes.map_err(|e| CheckpointError::Damaged {
        path: path.clone(),
        reason: format!("its record cannot be made: {e}"),
    })?;
    Ok(write_atomic(&path, &bytes)?)
}
