//! From trained weights to a bundle that runs anywhere.
//!
//! 1. [`onnx`] records burn modules as ONNX graphs; it knows nothing of trackers.
//! 2. [`network`] records the tracker's three inference functions with it.
//! 3. [`build`] reads weights and configuration, adds reference outputs and writes the bundle
//!    ([`bundle`]).
//! 4. [`check`] compares every engine with the reference outputs; [`unpack`] takes a bundle apart;
//!    [`macs`] counts what it computes.
//! 5. [`quantize`] makes bundles of 8-bit numbers and 16-bit weights out of bundles of floats.
//! 6. [`golden`] compares every back end with reference figures of the network.
//!
//! The command line is `tsda-export` (`src/main.rs`).

pub mod build;
pub mod bundle;
pub mod check;
pub mod files;
pub mod golden;
pub mod macs;
pub mod network;
pub mod onnx;
pub mod quantize;
pub mod unpack;
