//! Which of two sensors is tracked on.

use crate::frames::Decoded;
use core::fmt;
use core::num::NonZeroU32;
use core::str::FromStr;
use tsda_runtime::TrackState;

/// One picture of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channel {
    /// Visible light (or whatever a client puts there).
    Color,
    /// Thermal infrared.
    Ir,
}

impl Channel {
    /// The word on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Color => "color",
            Self::Ir => "ir",
        }
    }

    /// The other one.
    pub const fn other(self) -> Self {
        match self {
            Self::Color => Self::Ir,
            Self::Ir => Self::Color,
        }
    }
}

impl fmt::Display for Channel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// The pictures a client is asked to send with every frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Channels {
    /// One, of whichever sensor.
    #[default]
    Color,
    /// One, thermal.
    Ir,
    /// Both.
    Both,
}

impl Channels {
    /// In the order in which they come.
    pub const fn list(self) -> &'static [Channel] {
        match self {
            Self::Color => &[Channel::Color],
            Self::Ir => &[Channel::Ir],
            Self::Both => &[Channel::Color, Channel::Ir],
        }
    }
}

impl FromStr for Channels {
    type Err = String;

    /// `color`, `ir`, or both with a comma, semicolon or plus between, in any order.
    fn from_str(text: &str) -> Result<Self, String> {
        let mut words: Vec<&str> =
            text.split([',', ';', '+']).map(str::trim).filter(|w| !w.is_empty()).collect();
        words.sort_unstable();
        match words[..] {
            ["color"] => Ok(Self::Color),
            ["ir"] => Ok(Self::Ir),
            ["color", "ir"] => Ok(Self::Both),
            _ => Err("expected color, ir or color,ir".into()),
        }
    }
}

/// How the sensor is chosen when there are two.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SensorPolicy {
    /// Always this one.
    Fixed(Channel),
    /// Color for so many frames, then ir for as many, and so on, from the first frame of a target.
    Switch(NonZeroU32),
    /// Color first; the other as soon as the active one shows nothing, or has not shown the target
    /// for [`Chooser::PATIENCE`] frames.
    #[default]
    Auto,
}

impl FromStr for SensorPolicy {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "color" => Ok(Self::Fixed(Channel::Color)),
            "ir" => Ok(Self::Fixed(Channel::Ir)),
            "auto" => Ok(Self::Auto),
            _ => text
                .strip_prefix("switch:")
                .and_then(|n| n.parse().ok())
                .map(Self::Switch)
                .ok_or_else(|| "expected color, ir, auto or switch:N with N of at least 1".into()),
        }
    }
}

impl fmt::Display for SensorPolicy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Fixed(channel) => write!(f, "{channel}"),
            Self::Switch(n) => write!(f, "switch:{n}"),
            Self::Auto => f.write_str("auto"),
        }
    }
}

/// A policy at work on one target.
#[derive(Clone, Copy, Debug)]
pub struct Chooser {
    policy: SensorPolicy,
    active: Channel,
    frame: u64,
    missing: u32,
}

impl Chooser {
    /// Frames without the target before the other sensor is tried.
    pub const PATIENCE: u32 = 5;

    /// For a new target.
    pub const fn new(policy: SensorPolicy) -> Self {
        let active = match policy {
            SensorPolicy::Fixed(channel) => channel,
            SensorPolicy::Switch(_) | SensorPolicy::Auto => Channel::Color,
        };
        Self { policy, active, frame: 0, missing: 0 }
    }

    /// The channel for the next frame, with its picture. `decode` is called for the other channel
    /// only when the active one is in doubt.
    ///
    /// # Errors
    /// What `decode` said about the channel that was wanted, when nothing else helps.
    pub fn pick<E>(
        &mut self,
        mut decode: impl FnMut(Channel) -> Result<Decoded, E>,
    ) -> Result<(Channel, Decoded), E> {
        let frame = self.frame;
        self.frame += 1;
        if let SensorPolicy::Switch(n) = self.policy {
            let thermal = frame / u64::from(n.get()) % 2 == 1;
            self.active = if thermal { Channel::Ir } else { Channel::Color };
        }
        let picture = decode(self.active);
        if self.policy != SensorPolicy::Auto {
            return picture.map(|p| (self.active, p));
        }
        let impatient = self.missing >= Self::PATIENCE;
        if !impatient && picture.as_ref().is_ok_and(|p| !shows_nothing(self.active, p)) {
            return picture.map(|p| (self.active, p));
        }
        let other = self.active.other();
        match decode(other) {
            // A dull picture is better than none at all.
            Ok(p) if picture.is_err() || !shows_nothing(other, &p) => {
                self.active = other;
                self.missing = 0;
                Ok((other, p))
            }
            _ => picture.map(|p| (self.active, p)),
        }
    }

    /// Takes note of how the frame went.
    pub const fn note(&mut self, state: TrackState) {
        self.missing = match state {
            TrackState::Tracking | TrackState::Uncertain => 0,
            TrackState::Searching | TrackState::Lost => self.missing.saturating_add(1),
        };
    }
}

/// Standard deviation of grey levels below which a picture is flat: shutter closed, lens covered,
/// saturated.
const FLAT: f32 = 3.0;
/// Mean grey level below which a visible picture is night.
const DARK: f32 = 32.0;
/// Raw values between the first and last percentile of a 16-bit picture that is flat.
const FLAT_RAW: u16 = 8;

/// Is there nothing to be seen in the picture? Judged on a grid of some thousand pixels.
pub(super) fn shows_nothing(channel: Channel, picture: &Decoded) -> bool {
    let picture = match picture {
        Decoded::Eight(picture) => picture,
        Decoded::Sixteen { low, high, .. } => return high.abs_diff(*low) < FLAT_RAW,
    };
    let step = (picture.width.max(picture.height) / 64).max(1);
    let (mut count, mut sum, mut squares) = (0u32, 0f32, 0f32);
    for y in (step / 2..picture.height).step_by(step) {
        for x in (step / 2..picture.width).step_by(step) {
            let [r, g, b] = picture.rgb(x, y).map(f32::from);
            let grey = (r + g + b) / 3.0;
            count += 1;
            sum += grey;
            squares += grey * grey;
        }
    }
    let count = count.max(1) as f32;
    let mean = sum / count;
    let deviation = (squares / count - mean * mean).max(0.0).sqrt();
    // A thermal picture may well be dark but for the target.
    deviation < FLAT || (channel == Channel::Color && mean < DARK)
}
