//! Where pictures come from: cameras, files, drawn scenes.

mod held;
mod raw16;
mod reel;

pub use held::Held;
pub use raw16::Raw16Folder;
pub use reel::{Fault, FaultKind, Reel};

use super::Clock;
use crate::error::HostError;
use std::fmt::Debug;
use std::time::{Duration, Instant};
use tsda_runtime::{BBox, FrameView};

/// What [`Source::poll`] found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Polled {
    /// A new picture is there.
    Fresh,
    /// None within the time.
    Nothing,
    /// The device is not there; it is looked for.
    Gone,
    /// There will be no more.
    Ended,
}

/// The newest picture of a source.
#[derive(Clone, Copy, Debug)]
pub struct Captured<'a> {
    /// All of the buffer, telemetry rows included.
    pub view: FrameView<'a>,
    /// Largest value of a 16-bit sensor.
    pub full: u16,
    /// Time of the run at which it was there.
    pub at: Duration,
    /// The driver's time stamp.
    pub capture: Option<Duration>,
    /// The same as a moment of this program, where the driver's clock is the machine's.
    pub taken: Option<Instant>,
    /// The driver's frame number.
    pub sequence: u32,
    /// Marked by the driver, or shorter than it should be.
    pub damaged: bool,
    /// The source knows that the shutter is closed.
    pub shutter: bool,
}

/// Counts of a source since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counters {
    /// Pictures delivered to the loop.
    pub delivered: u64,
    /// Pictures passed over because a newer one was there.
    pub skipped: u64,
    /// Pictures missing in the driver's numbering.
    pub missing: u64,
    /// Pictures marked as damaged, or too short.
    pub damaged: u64,
    /// Restarts of the stream after an error.
    pub restarts: u64,
    /// Times the device went away.
    pub unplugged: u64,
}

/// Delivers the newest picture.
pub trait Source: Debug {
    /// Looks for a newer picture, for at most `wait`. In steady state nothing is allocated.
    ///
    /// # Errors
    /// What cannot be cured by waiting: a damaged file, a camera that does not deliver what was
    /// asked for.
    fn poll(&mut self, clock: &Clock, wait: Duration) -> Result<Polled, HostError>;

    /// The newest picture, until the next [`Self::poll`].
    fn frame(&self) -> Option<Captured<'_>>;

    /// What keeps the device from being opened again; every reason once, as long as it stays the
    /// same.
    fn trouble(&mut self) -> Option<String> {
        None
    }

    /// Counts so far.
    fn counters(&self) -> Counters;

    /// Pictures per second, where known.
    fn rate(&self) -> Option<f64>;

    /// Box of the target in the first picture, where the files say it.
    fn known_box(&self) -> Option<BBox> {
        None
    }

    /// What it is, for people.
    fn describe(&self) -> String;
}
