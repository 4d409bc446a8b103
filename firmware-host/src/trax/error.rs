//! What can end a session before its time.

use super::image::ImageError;
use super::message::{Kind, MessageError};
use super::policy::Channel;
use super::region::RegionError;
use std::io;
use tsda_runtime::TrackError;

/// A session that cannot go on. The client is told with a `quit` message before.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TraxError {
    /// A malformed message.
    #[error("message {message}: {source}")]
    Message {
        /// 1-based, of the client's messages.
        message: u64,
        /// What is wrong with it.
        source: MessageError,
    },
    /// The client went away in the middle of a message.
    #[error("message {message}: the stream ended inside it")]
    CutOff {
        /// 1-based, of the client's messages.
        message: u64,
    },
    /// A message that may not come now.
    #[error("unexpected \"{kind}\" message: {why}")]
    Unexpected {
        /// Its type.
        kind: Kind,
        /// What is expected instead.
        why: String,
    },
    /// A region no target can be taken from.
    #[error("target {target}: {source}")]
    Region {
        /// 1-based, of this session.
        target: u64,
        /// What is wrong with it.
        source: RegionError,
    },
    /// A picture that cannot be used.
    #[error("target {target}, frame {frame}, channel {channel}: {source}")]
    Image {
        /// 1-based, of this session.
        target: u64,
        /// 0-based, of this target.
        frame: u64,
        /// Which of the pictures.
        channel: Channel,
        /// What is wrong with it.
        source: ImageError,
    },
    /// The tracker or its engine failed, or the first box lies outside the picture.
    #[error("target {target}, frame {frame}: {source}")]
    Track {
        /// 1-based, of this session.
        target: u64,
        /// 0-based, of this target.
        frame: u64,
        /// What the tracker said.
        source: Box<TrackError>,
    },
    /// Reading from the client failed.
    #[error("reading from the TraX client failed: {source}")]
    Read {
        /// What the system said.
        source: io::Error,
    },
    /// Writing to the client failed.
    #[error("writing to the TraX client failed: {source}")]
    Write {
        /// What the system said.
        source: io::Error,
    },
    /// The way to the client named in the environment cannot be used.
    #[error("{variable}={value}: {reason}")]
    Environment {
        /// `TRAX_SOCKET`, `TRAX_IN` or `TRAX_OUT`.
        variable: &'static str,
        /// What it says.
        value: String,
        /// Why that does not work and what is expected.
        reason: String,
    },
}

impl TraxError {
    /// Is it about what the client sent, and not about the work failing?
    pub fn is_input(&self) -> bool {
        match self {
            Self::Message { .. }
            | Self::Unexpected { .. }
            | Self::Region { .. }
            | Self::Image { .. }
            | Self::Environment { .. } => true,
            Self::Track { source, .. } => matches!(**source, TrackError::Box(_)),
            Self::CutOff { .. } | Self::Read { .. } | Self::Write { .. } => false,
        }
    }
}
