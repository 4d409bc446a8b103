//! What can go wrong on the way from a burn module to an ONNX file.

/// A burn computation that could not be written as ONNX.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// An operation, or a setting of it, that the converter does not know.
    #[error(
        "operation {position} of graph `{graph}`, {operation}, cannot be written as ONNX: {reason}"
    )]
    Unsupported {
        /// Name of the graph being recorded.
        graph: String,
        /// Position in the recorded sequence, from 0.
        position: usize,
        /// burn's name of the operation.
        operation: String,
        /// What exactly is not supported, and what to use in its place.
        reason: String,
    },
    /// burn's graph capture refused the recording.
    #[error("graph `{graph}`: recording failed: {reason}")]
    Capture {
        /// Name of the graph being recorded.
        graph: String,
        /// What burn said.
        reason: String,
    },
    /// A name was given to two inputs or outputs, or is empty.
    #[error("graph `{graph}`: `{name}` cannot name an input or output: {reason}")]
    Name {
        /// Name of the graph being recorded.
        graph: String,
        /// The name.
        name: String,
        /// What is wrong with it.
        reason: &'static str,
    },
}
