//! Datasets, protocols and metrics for cross-modal tracking, without a training framework.
//!
//! * [`dataset`]: one [`dataset::Sequence`] trait over every folder layout; frames decoded lazily.
//! * the trainer's sampler reads the same loaders, and `tsda eval` runs bundles over them.

pub mod dataset;
