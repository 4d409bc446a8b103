//! burn modules to ONNX, by recording what they do.
//!
//! Free of any knowledge of trackers: whatever burn's graph capture records and ONNX opset 17 can
//! say is converted; what cannot be converted is refused by name and position.
//!
//! 1. [`record`] runs a closure on burn's capture device; [`Recorder`] makes its inputs, moves
//!    modules there and takes its outputs. The result is a [`Graph`] with fixed shapes.
//! 2. [`optimise`] computes constant parts, folds batch norm into convolutions and drops what has
//!    no effect.
//! 3. [`encode`] writes the file, its weights inside or in a [`WeightStore`] shared by any number
//!    of graphs.
//!
//! [`macs`] counts the multiply-accumulates of graphs and of model files.
//!
//! Modules are recorded in their inference form ([`burn::module::Module::valid`]), wherever they are.

mod convert;
mod emit;
mod error;
mod eval;
mod graph;
pub mod macs;
mod passes;
pub mod proto;
mod record;

pub use emit::{OPSET, Storage, WeightStore, encode, model};
pub use error::ExportError;
pub use graph::{Attribute, Data, Elem, Graph, Node, Port, Value, ValueId};
pub use passes::optimise;
pub use record::{Recorder, record};
