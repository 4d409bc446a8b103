//! What makes a script unusable.

use std::path::PathBuf;
use tsda_runtime::{BoxError, FrameError, TrackError};

/// A script that cannot be replayed. Differences are no errors: the report lists them.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// A file that cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The script is no JSON.
    #[error("{}, line {line}, column {column}: {detail}", path.display())]
    Json {
        /// The script.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// Counted from 1.
        column: usize,
        /// What the reader said.
        detail: String,
    },
    /// A field is missing or holds something else than it should.
    #[error("{}: {at}: {detail}", path.display())]
    Field {
        /// The script.
        path: PathBuf,
        /// Which field, from the outside in: run, frame, name.
        at: String,
        /// What is wrong with it and what is expected.
        detail: String,
    },
    /// The file with the maps is damaged.
    #[error("{}, byte {offset}: {detail}", path.display())]
    Tensors {
        /// The file.
        path: PathBuf,
        /// Where in the file.
        offset: usize,
        /// What is wrong there.
        detail: String,
    },
    /// A map that the script needs is missing or has the wrong shape.
    #[error("{}: tensor `{name}`: {detail}", path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// Its name.
        name: String,
        /// What is wrong with it.
        detail: String,
    },
    /// The tracker refused a frame.
    #[error("run {run}, frame {frame}: {source}")]
    Tracker {
        /// Name of the run.
        run: String,
        /// Number of the frame; 0 is the annotated one.
        frame: u64,
        /// What the tracker said.
        source: Box<TrackError>,
    },
    /// A picture of the size stated is impossible.
    #[error("run {run}: {source}")]
    Picture {
        /// Name of the run.
        run: String,
        /// Why.
        source: FrameError,
    },
    /// The first box is unusable.
    #[error("run {run}: {source}")]
    Box {
        /// Name of the run.
        run: String,
        /// Why.
        source: BoxError,
    },
}
