//! The program on the board: cameras in, boxes out, sensors changed on the way (`tsda run`).
//!
//! 1. [`config`]: `host.toml` as written; [`plan`]: what it means, checked.
//! 2. [`source`]: where pictures come from; [`sensor`]: a source with its gain and its health.
//! 3. [`run`]: the loop. One thread polls the sensors, tracks, and hands a [`FrameRecord`] to every
//!    [`Output`]; in steady state it allocates nothing.
//! 4. [`output`]: what outputs are, [`outputs`]: those of a configuration. [`json`]: one JSON object
//!    per line; [`preview`]: a page for a browser; [`metrics`]: figures for Prometheus; [`mavlink`]: a ground
//!    station; [`mcap`]: recordings; [`notify`]:
//!    signs of life for systemd. [`shot`]: pictures for them; [`http`]: their server.
//! 5. [`control`]: commands while running; [`zones`]: how warm the machine is.
//!
//! Described for users in docs/board.md.

pub mod clock;
pub mod config;
pub mod control;
pub mod http;
pub mod json;
pub mod mavlink;
pub mod mcap;
pub mod metrics;
pub mod motion;
pub mod notify;
pub mod output;
pub mod outputs;
pub mod plan;
pub mod preview;
pub mod run;
pub mod sensor;
pub mod shot;
pub mod source;
#[allow(unsafe_code)]
pub(crate) mod sys;
pub mod zones;

pub use clock::Clock;
pub use config::HostConfig;
pub use control::Command;
pub use output::{Event, EventKind, FrameRecord, Output, SourceInfo, TargetRecord, Views};
pub use run::{Allocations, Ending, Host, Summary};

#[cfg(test)]
mod tests;
