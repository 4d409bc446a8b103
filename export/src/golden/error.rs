//! What makes a folder of cases unusable.

use crate::onnx::ExportError;
use std::path::PathBuf;
use tsda_runtime::{EngineError, SpecError};
use tsda_trainer::import::{TensorMismatch, WeightsError};

/// Cases that cannot be compared. Differences are no errors: the report tells.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GoldenError {
    /// A folder or file that cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// Which.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file that is no safetensors file, or holds a number type that is not read.
    #[error(transparent)]
    Tensors(#[from] WeightsError),
    /// The head of a safetensors file is damaged.
    #[error("{}: its header cannot be read: {detail}", path.display())]
    Header {
        /// The file.
        path: PathBuf,
        /// What the reader said.
        detail: String,
    },
    /// A folder without anything to compare.
    #[error(
        "{}: no cases here: expected `case_*.safetensors` or `{preset}*.safetensors` beside \
         `inputs.safetensors`; found {found}", dir.display()
    )]
    NoCases {
        /// The folder.
        dir: PathBuf,
        /// Preset asked for.
        preset: String,
        /// What is there.
        found: String,
    },
    /// A tensor the case has to be run with is missing.
    #[error("{}: no tensor `{name}`, which {why}", path.display())]
    MissingInput {
        /// The file it should be in.
        path: PathBuf,
        /// Its name.
        name: String,
        /// What it is needed for.
        why: String,
    },
    /// A tensor has another shape than its use asks for.
    #[error("{}: tensor `{name}` has shape {found:?}, {expected} is needed", path.display())]
    Shape {
        /// The file.
        path: PathBuf,
        /// Its name.
        name: String,
        /// Its shape.
        found: Vec<usize>,
        /// What it should be.
        expected: String,
    },
    /// A statement about a case that cannot be followed.
    #[error("{}: {what} = `{value}`: expected {expected}", path.display())]
    Statement {
        /// The file.
        path: PathBuf,
        /// The key of its metadata or the part of its name.
        what: String,
        /// What it says.
        value: String,
        /// What it may say.
        expected: String,
    },
    /// The network's specification is out of range.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The weights do not go with the preset.
    #[error("{}: {source}; is this the right --preset?", path.display())]
    Weights {
        /// The weights file, or what stands for it.
        path: PathBuf,
        /// The differences.
        source: TensorMismatch,
    },
    /// The network cannot be written as ONNX.
    #[error(transparent)]
    Export(#[from] ExportError),
    /// The bundle an engine reads cannot be put together.
    #[error(transparent)]
    Bundle(#[from] crate::bundle::WriteError),
    /// An engine failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A back end failed on a graph.
    #[error("{engine}, graph {graph}: {detail}")]
    Graph {
        /// The back end.
        engine: &'static str,
        /// The graph.
        graph: String,
        /// What it said.
        detail: String,
    },
    /// A back end that this program does not have.
    #[error("{0}")]
    Unavailable(String),
    /// A result cannot be written.
    #[error(transparent)]
    File(#[from] crate::files::FileError),
}
