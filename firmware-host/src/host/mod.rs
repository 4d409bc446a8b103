//! The program on the board: cameras in, boxes out, sensors changed on the way (`tsda run`).
//!
//! 1. [`config`]: `host.toml` as written; [`plan`]: what it means, checked.
//! 2. [`source`]: where pictures come from; [`sensor`]: a source with its gain and its health.
//! 3. [`run`]: the loop. One thread polls the sensors, tracks, and hands a [`FrameRecord`] to every
//!    [`Output`]; in steady state it allocates nothing.
//! 4. [`output`]: what outputs are; [`json`]: one JSON object per line.
//! 5. [`control`]: commands while running.
//!
//! Described for users in docs/board.md.

pub mod clock;
pub mod config;
pub mod control;
pub mod json;
pub mod motion;
pub mod output;
pub mod plan;
pub mod run;
pub mod sensor;
pub mod source;

pub use clock::Clock;
pub use config::HostConfig;
pub use control::Command;
pub use output::{Event, EventKind, FrameRecord, Output, SourceInfo, TargetRecord, Views};
pub use run::{Ending, Host, Summary};

#[cfg(test)]
mod tests;
