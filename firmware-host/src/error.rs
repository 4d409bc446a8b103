//! What can go wrong in the program, and the exit code each kind gets.

pub use tsda_runtime::one_line;

use crate::frames::SourceError;
use std::path::PathBuf;
use tsda_runtime::bundle::BundleFileError;

/// Exit code of success.
pub const EXIT_OK: u8 = 0;
/// A check was made and failed.
pub const EXIT_CHECK_FAILED: u8 = 1;
/// What the user gave cannot be used.
pub const EXIT_BAD_INPUT: u8 = 2;
/// The input was fine, the work failed or was interrupted.
pub const EXIT_RUNTIME: u8 = 3;
/// No sensor delivered a usable picture for as long as the configuration allows (`tsda run`).
pub const EXIT_NO_PICTURES: u8 = 4;

/// Any failure of a command.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HostError {
    /// Frames that cannot be read.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// A bundle that cannot be used.
    #[error(transparent)]
    Bundle(#[from] BundleFileError),
    /// The program was built without `models/nano.tsda`.
    #[error("this build has no embedded model; pass --bundle FILE.tsda")]
    NoEmbeddedModel,
    /// The first box is missing or unusable.
    #[error("{what}: {reason}")]
    Init {
        /// Where the box came from.
        what: String,
        /// What is wrong with it and what to do.
        reason: String,
    },
    /// An argument that parses but makes no sense.
    #[error("{what}: {reason}")]
    Argument {
        /// Which argument.
        what: String,
        /// What is wrong with it and what to do.
        reason: String,
    },
    /// A file or folder that cannot be created.
    #[error("cannot write {}: {source}", path.display())]
    Create {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Writing failed on the way.
    #[error("writing {} failed: {source}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A picture or animation could not be encoded.
    #[error("encoding {} failed: {reason}", path.display())]
    Encode {
        /// The file.
        path: PathBuf,
        /// What the encoder said.
        reason: String,
    },
    /// The tracker or its engine failed.
    #[error("frame {frame}: {source}")]
    Tracker {
        /// 0-based frame.
        frame: usize,
        /// What the tracker said.
        source: Box<tsda_runtime::TrackError>,
    },
    /// The engine is not there on this machine, or could not be built from the bundle.
    #[error("{}: {source}", bundle.display())]
    Engine {
        /// The bundle.
        bundle: PathBuf,
        /// What the engine said.
        source: Box<tsda_runtime::engine::any::OpenError>,
    },
    /// An engine failed while it was timed.
    #[error("{}: {source}", bundle.display())]
    Timing {
        /// The bundle.
        bundle: PathBuf,
        /// What the engine said.
        source: Box<tsda_runtime::EngineError>,
    },
    /// The process that measures an engine failed.
    #[error("bench, {engine}: {reason}")]
    Bench {
        /// The engine.
        engine: String,
        /// What happened.
        reason: String,
    },
    /// The bundle's probe is missing or unusable.
    #[error("{}: {source}", bundle.display())]
    Probe {
        /// The bundle.
        bundle: PathBuf,
        /// What is wrong with it.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// An engine failed on the probe.
    #[error("{}: {source}", bundle.display())]
    ProbeRun {
        /// The bundle.
        bundle: PathBuf,
        /// What the engine said.
        source: Box<tsda_runtime::probe::ProbeError>,
    },
    /// A script that cannot be replayed.
    #[error(transparent)]
    Replay(#[from] crate::replay::ReplayError),
    /// A TraX session could not go on.
    #[error(transparent)]
    Trax(#[from] crate::trax::TraxError),
    /// An evaluation could not be finished.
    #[error("evaluation: {0}")]
    Eval(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// Ctrl-C.
    #[error("interrupted; no output was written")]
    Interrupted,
}

impl HostError {
    /// The exit code the program ends with.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Source(_)
            | Self::Bundle(_)
            | Self::NoEmbeddedModel
            | Self::Init { .. }
            | Self::Argument { .. }
            | Self::Probe { .. }
            | Self::Replay(_)
            | Self::Create { .. } => EXIT_BAD_INPUT,
            // The choice of engine is the user's.
            Self::Engine { source, .. } if source.is_absent() => EXIT_BAD_INPUT,
            Self::Trax(e) if e.is_input() => EXIT_BAD_INPUT,
            Self::Write { .. }
            | Self::Encode { .. }
            | Self::Tracker { .. }
            | Self::Engine { .. }
            | Self::Timing { .. }
            | Self::ProbeRun { .. }
            | Self::Bench { .. }
            | Self::Trax(_)
            | Self::Eval(_)
            | Self::Interrupted => EXIT_RUNTIME,
        }
    }
}
