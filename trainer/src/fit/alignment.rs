//! The alignment branches while they train: parameters, optimiser, checkpoint files.

use super::state::{put_record, read_record};
use super::{FitError, optim};
use crate::align::{AlignStep, Branches};
use crate::checkpoint::Checkpoint;
use crate::config::{AlignConfig, Experiment};
use burn::module::Module;
use burn::optim::{GradientsParams, ModuleOptimizer};
use burn::prelude::*;
use burn::tensor::Bytes;
use std::path::Path;

const BRANCHES: &str = "align.bpk";
const OPTIM: &str = "align_optim.bpk";

/// Branches and their optimiser; never part of a weights file.
pub(super) struct Alignment {
    pub branches: Branches,
    optimizer: ModuleOptimizer,
}

/// Gradients of both branches, summed over a step's batches; empty for a branch that is off.
#[derive(Default)]
pub(super) struct AlignGradients {
    pub discriminator: GradientsParams,
    pub projection: GradientsParams,
}

impl AlignGradients {
    /// Adds those of a batch, wherever they were computed. `branches` live on `device`.
    pub fn add(&mut self, step: AlignStep, branches: &Branches, device: &Device) {
        for (sum, more) in
            [(&mut self.discriminator, step.discriminator), (&mut self.projection, step.projection)]
        {
            if let Some(more) = more {
                let more = more.to_device(device, branches);
                *sum = optim::add(branches, std::mem::take(sum), more);
            }
        }
    }
}

impl Alignment {
    /// Fresh branches, from the seed alone; `None` for runs without. Without a draw for the network,
    /// rows of an ablation start from the same network.
    pub fn start(experiment: &Experiment, width: usize, device: &Device) -> Option<Self> {
        device.seed(super::mix(experiment.run.seed, u64::MAX - 2));
        let branches = Branches::new(&experiment.align, width, device)?;
        Some(Self { branches, optimizer: optim::optimizer(&experiment.optim) })
    }

    /// Norms of the gradients by the names they have in logs.
    pub fn gradient_norms(&self, of: &AlignGradients) -> Vec<(&'static str, f32)> {
        [("discriminator_grad_norm", &of.discriminator), ("projection_grad_norm", &of.projection)]
            .into_iter()
            .filter(|(_, gradients)| !gradients.is_empty())
            .map(|(name, gradients)| (name, optim::gradient_norm(&self.branches, gradients)))
            .collect()
    }

    /// One optimiser step, every branch clipped on its own.
    pub fn update(&mut self, rate: f64, of: AlignGradients, clip: f64) {
        for gradients in [of.discriminator, of.projection] {
            if gradients.is_empty() {
                continue;
            }
            let norm = optim::gradient_norm(&self.branches, &gradients);
            let gradients: GradientsParams = optim::clip(&self.branches, gradients, norm, clip);
            // Parameters without a gradient, those of the other branch, stay as they are.
            self.branches = self.optimizer.step(rate, self.branches.clone(), gradients);
        }
    }

    /// Writes its files of a checkpoint.
    pub fn save(&self, folder: &Path) -> Result<(), FitError> {
        put_record(folder, BRANCHES, self.branches.clone().into_record().into_bytes())?;
        put_record(folder, OPTIM, self.optimizer.into_bytes())
    }

    /// Goes on from a checkpoint of a run with the table `then`. A checkpoint of a run without
    /// alignment leaves the branches fresh, and a note says so.
    pub fn load(
        &mut self,
        experiment: &Experiment,
        then: &AlignConfig,
        checkpoint: &Checkpoint,
    ) -> Result<Option<String>, FitError> {
        let unfit = |reason: String| FitError::Resume { path: checkpoint.path.clone(), reason };
        if !checkpoint.has(BRANCHES) {
            return Ok(Some("its run had no alignment: the branches start fresh".into()));
        }
        if shapes(then) != shapes(&experiment.align) {
            return Err(unfit("its alignment branches are not those of this [align]".into()));
        }
        // Parameters get the ids they had, by which the optimiser's state is found.
        self.branches = self
            .branches
            .clone()
            .try_load_record(read_record(checkpoint, BRANCHES)?)
            .map_err(|e| unfit(format!("{BRANCHES}: {e}")))?;
        self.optimizer = optim::optimizer(&experiment.optim)
            .from_bytes(Bytes::from_bytes_vec(checkpoint.read(OPTIM)?))
            .map_err(|e| unfit(format!("{OPTIM}: {e}")))?;
        Ok(None)
    }
}

/// Widths of the branches that a table asks for.
fn shapes(config: &AlignConfig) -> [Option<Vec<usize>>; 2] {
    let projection = config.contrastive().map(|b| [b.hidden, vec![b.dim]].concat());
    [config.adversarial().map(|b| b.hidden), projection]
}
