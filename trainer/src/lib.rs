//! Trains cross-modal ToMP-style trackers with burn.
//!
//! The road of a training step: [`sampler`] draws frames, a target and sensors; [`processing`]
//! cuts, alters and labels crops; [`prefetch`] does both ahead of time on worker threads; [`fit`]
//! runs the [`model`] on the batch, takes the [`losses`] and those of [`align`] and steps the
//! optimiser; [`checkpoint`] and [`logging`] keep what came out. [`config`] describes all of it in
//! one file.
//!
//! The command line is `tsda-train` (`src/main.rs`).

pub mod align;
pub mod align_report;
pub mod burn_engine;
pub mod checkpoint;
pub mod config;
pub mod fit;
pub mod import;
pub mod logging;
pub mod losses;
pub mod memory;
pub mod model;
pub mod prefetch;
pub mod processing;
pub mod sampler;
#[cfg(test)]
mod testing;
