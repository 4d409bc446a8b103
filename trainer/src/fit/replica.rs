//! The network on each device that computes a share of a step.
//!
//! burn's own data parallelism (burn-train's `MultiDevice` strategies) copies the module to every
//! device and the gradients back, as here; its all-reduce exists for CUDA and remote devices only.

use super::state::State;
use crate::align::Branches;
use crate::model::TrackerNet;
use burn::module::Module;
use burn::prelude::*;

/// Network and alignment branches on one device, for one step.
pub(super) struct Replica<'a> {
    pub net: TrackerNet,
    pub branches: Option<Branches>,
    pub device: &'a Device,
}

impl<'a> Replica<'a> {
    /// One for each of the devices, autodiff devices all. The first is where `state` lives; its
    /// replica is the network itself, so batch statistics follow the batches computed there (as in
    /// PyTorch's DistributedDataParallel, where those of rank 0 count).
    pub fn all(state: &State, devices: &'a [Device]) -> Vec<Self> {
        let branches = state.align.as_ref().map(|a| &a.branches);
        let copy = |i: usize, device: &'a Device| match i {
            0 => Self { net: state.net.clone(), branches: branches.cloned(), device },
            _ => Self {
                net: copied(&state.net, device),
                branches: branches.map(|b| copied(b, device)),
                device,
            },
        };
        devices.iter().enumerate().map(|(i, device)| copy(i, device)).collect()
    }
}

/// A copy that trains on another device. The way over `valid` gives it batch statistics of its own:
/// burn moves those of a module's clones together.
fn copied<M: Module>(module: &M, device: &Device) -> M {
    module.valid().fork(&device.clone().inner()).train()
}
