//! Cross-modal single-object tracking, the per-frame half.
//!
//! The way through the crate, in the order a frame takes it:
//! 1. [`bundle`] reads a `.tsda` file: network specification, thresholds, ONNX graphs, weights.
//! 2. An [`engine`] is built from it (native, tract, ONNX Runtime, or one of your own).
//! 3. A [`Tracker`] is built on the engine and given the first frame with its box.
//! 4. Every later frame goes through [`Tracker::update`]: [`crop`] cuts the search area out of the
//!    sensor's buffer, the engine scores it, [`localise`] reads the maps, [`memory`] decides what to
//!    keep.
//!
//! Without features the crate is `no_std` and never allocates; `std` adds file reading, `native`,
//! `tract` and `ort` add engines. Section numbers in the docs ("spec 3.4") are those of the tracker
//! specification summarised in `docs/tracker.md`.
#![cfg_attr(not(any(feature = "std", test)), no_std)]

pub mod bundle;
pub mod crop;
pub mod engine;
pub mod frame;
pub mod geometry;
pub mod labels;
pub mod localise;
pub mod memory;
#[cfg(feature = "std")]
mod one_line;
pub mod probe;
pub mod spec;
#[cfg(feature = "std")]
pub mod system;
#[cfg(test)]
mod testing;
pub mod tracker;

pub use engine::{Engine, EngineError};
pub use frame::{FrameError, FrameView, PixelFormat};
pub use geometry::{BBox, Modality, Yx};
pub use localise::Flag;
pub use memory::TemplateMemory;
#[cfg(feature = "std")]
pub use one_line::one_line;
pub use spec::{Backbone, ModelSpec, SpecError, TrackerParams};
pub use tracker::{BoxError, MotionPrior, RedetectOptions, Track, TrackError, TrackState, Tracker};
