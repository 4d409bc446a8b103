//! Whether a sensor's pictures can be used: late, gone, damaged, frozen, dark, saturated, or behind
//! its own shutter.

use super::Scene;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// What is wrong with a sensor, or nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Condition {
    /// The newest picture can be tracked in.
    Good,
    /// No picture yet.
    #[default]
    Waiting,
    /// No picture for longer than the time limit.
    Late,
    /// The device is not there.
    Gone,
    /// The driver marked the picture as damaged, or it is shorter than it should be.
    Damaged,
    /// The same picture again and again.
    Frozen,
    /// Nearly all of the picture is black.
    Dark,
    /// Nearly all of the picture is at the top of the scale.
    Saturated,
    /// A thermal camera shows its shutter (flat field correction).
    Shutter,
}

impl Condition {
    /// Lower-case name, as in JSON.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Waiting => "waiting",
            Self::Late => "late",
            Self::Gone => "gone",
            Self::Damaged => "damaged",
            Self::Frozen => "frozen",
            Self::Dark => "dark",
            Self::Saturated => "saturated",
            Self::Shutter => "shutter",
        }
    }

    /// Whether the camera itself has stopped delivering.
    pub const fn is_lost(self) -> bool {
        matches!(self, Self::Late | Self::Gone)
    }
}

impl std::fmt::Display for Condition {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.as_str())
    }
}

/// When a picture counts as unusable.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HealthLimits {
    /// Seconds without a picture after which the camera is late.
    pub timeout_s: f64,
    /// Seconds of the same picture after which it is frozen; 0: never.
    pub frozen_s: f64,
    /// Share of black samples above which a picture is dark; 1: never.
    pub dark_share: f32,
    /// Share of samples at full scale above which a picture is saturated; 1: never.
    pub saturated_share: f32,
}

impl Default for HealthLimits {
    fn default() -> Self {
        Self { timeout_s: 0.5, frozen_s: 0.5, dark_share: 0.98, saturated_share: 0.9 }
    }
}

/// What a source said about its newest picture besides the pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Marks {
    /// Marked by the driver, or too short.
    pub damaged: bool,
    /// The shutter is closed or about to be.
    pub shutter: bool,
}

/// Follows one sensor's condition.
#[derive(Clone, Debug)]
pub struct Watch {
    limits: HealthLimits,
    /// Since when the camera is waited for.
    since: Duration,
    newest: Option<Duration>,
    gone: bool,
    picture: Condition,
    digest: Option<u64>,
    changed: Duration,
    good: Option<Duration>,
    scene: Scene,
}

impl Watch {
    /// Nothing seen yet.
    pub fn new(limits: HealthLimits) -> Self {
        Self {
            limits,
            since: Duration::ZERO,
            newest: None,
            gone: false,
            picture: Condition::Waiting,
            digest: None,
            changed: Duration::ZERO,
            good: None,
            scene: Scene::default(),
        }
    }

    /// A new picture at `now`. Answers whether it shows anything the one before did not.
    pub fn picture(&mut self, now: Duration, scene: Scene, marks: Marks) -> bool {
        let (new, limits) = (self.digest != Some(scene.digest), self.limits);
        if new {
            self.digest = Some(scene.digest);
            self.changed = now;
        }
        self.newest = Some(now);
        self.gone = false;
        self.scene = scene;
        let still = (now.saturating_sub(self.changed)).as_secs_f64();
        self.picture = if marks.damaged {
            Condition::Damaged
        } else if marks.shutter {
            Condition::Shutter
        } else if scene.dark > limits.dark_share {
            Condition::Dark
        } else if scene.bright > limits.saturated_share {
            Condition::Saturated
        } else if limits.frozen_s > 0.0 && still >= limits.frozen_s {
            Condition::Frozen
        } else {
            Condition::Good
        };
        if self.picture == Condition::Good && new {
            self.good = Some(now);
        }
        new
    }

    /// The device is not there.
    pub fn gone(&mut self) {
        self.gone = true;
    }

    /// Whether the sensor can be used at `now`.
    pub fn condition(&self, now: Duration) -> Condition {
        if self.gone {
            return Condition::Gone;
        }
        let quiet = now.saturating_sub(self.newest.unwrap_or(self.since)).as_secs_f64();
        match quiet > self.limits.timeout_s {
            true => Condition::Late,
            false => self.picture,
        }
    }

    /// How long there was no usable picture; zero while there is one.
    pub fn bad_for(&self, now: Duration) -> Duration {
        if self.condition(now) == Condition::Good {
            return Duration::ZERO;
        }
        now.saturating_sub(self.good.unwrap_or(self.since))
    }

    /// Statistics of the newest picture.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }
}
