//! The time of a run: the machine's, or one that goes on by frames.

use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

/// Which time a run goes by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ClockKind {
    /// The machine's: pictures come when they come, older ones are passed over.
    #[default]
    Wall,
    /// One step per frame, as fast as the tracker goes: every frame of a file is used and a run can
    /// be repeated exactly. Not for cameras.
    Frames,
}

/// The time since the start of a run.
#[derive(Clone, Copy, Debug)]
pub enum Clock {
    /// The machine's.
    Wall(Instant),
    /// So many steps of that many seconds.
    Frames {
        /// Steps so far.
        steps: u64,
        /// Seconds per step.
        step_s: f64,
    },
}

impl Clock {
    /// Starts at zero. `rate`: steps per second of [`ClockKind::Frames`].
    pub fn start(kind: ClockKind, rate: f64) -> Self {
        match kind {
            ClockKind::Wall => Self::Wall(Instant::now()),
            ClockKind::Frames => Self::Frames { steps: 0, step_s: 1.0 / rate.max(1e-3) },
        }
    }

    /// Time since the start.
    pub fn now(&self) -> Duration {
        match self {
            Self::Wall(start) => start.elapsed(),
            Self::Frames { steps, step_s } => Duration::from_secs_f64(*steps as f64 * step_s),
        }
    }

    /// The next step; the machine's time goes on by itself.
    pub fn tick(&mut self) {
        if let Self::Frames { steps, .. } = self {
            *steps += 1;
        }
    }

    /// Lets time pass, where waiting makes it pass.
    pub fn sleep(&self, time: Duration) {
        if let Self::Wall(_) = self {
            std::thread::sleep(time);
        }
    }
}
