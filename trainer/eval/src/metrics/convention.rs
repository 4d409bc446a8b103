//! Whose rules a result is scored by.
//!
//! | convention | truth | predictions | first frame | absent target | average |
//! |---|---|---|---|---|---|
//! | `tsda` | one or two | as they are | left out | left out | sequences |
//! | `lasher` | one, rounded | rounded; no area: the box before | the truth | miss in SR, hit in PR and NPR | sequences |
//! | `rgbt234` | two, the better one per frame | rounded | counts as predicted | counts | sequences |
//! | `rgbt210` | one | rounded | the truth | counts | sequences |
//! | `gtot` | two, the better one per frame | rounded | counts as predicted | counts | frames |
//! | `otb` | one | as they are | the truth | counts | sequences |
//! | `got10k` | one, with visible share | as they are, cut to the picture | left out | left out where the visible share is 0 | frames |
//!
//! `lasher`, `rgbt234`, `rgbt210` and `gtot` are those of the PyPI package `rgbt` 1.0.1 in its own
//! single precision (as NumPy 2 evaluates it); `otb` and `got10k` those of the GOT-10k toolkit in
//! double precision. A frame exactly on a threshold is decided by the last bit, so the precision
//! and the way a threshold is computed are part of the definition.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Points of the precision and the normalised precision curve.
pub const PRECISION_POINTS: usize = 51;

/// Rules of one benchmark; see the [module](self).
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize,
)]
#[serde(rename_all = "lowercase")]
pub enum Convention {
    /// This project's own rules, those of [`super::measure`].
    #[default]
    Tsda,
    /// LasHeR: PR, NPR, SR.
    Lasher,
    /// RGBT234: MPR, MSR.
    Rgbt234,
    /// RGBT210: PR, SR.
    Rgbt210,
    /// GTOT: MPR at 5 px, MSR by trapezoids.
    Gtot,
    /// OTB: success and precision.
    Otb,
    /// GOT-10k: AO, SR.
    Got10k,
}

/// What counts the same in an average over sequences.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Averaging {
    /// Every sequence.
    Sequences,
    /// Every frame.
    Frames,
}

/// How many truths a convention takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Truths {
    /// One.
    One,
    /// One for each sensor.
    Two,
    /// One, or one for each sensor.
    OneOrTwo,
}

/// How the frame that the tracker was initialised with enters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum First {
    /// Not at all.
    Excluded,
    /// With the truth in place of the prediction.
    Truth,
    /// Like any other frame.
    Predicted,
}

impl Convention {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::Tsda,
        Self::Lasher,
        Self::Rgbt234,
        Self::Rgbt210,
        Self::Gtot,
        Self::Otb,
        Self::Got10k,
    ];

    /// Lower-case name, as on command lines and in files.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Tsda => "tsda",
            Self::Lasher => "lasher",
            Self::Rgbt234 => "rgbt234",
            Self::Rgbt210 => "rgbt210",
            Self::Gtot => "gtot",
            Self::Otb => "otb",
            Self::Got10k => "got10k",
        }
    }

    /// How many truths it takes.
    pub const fn truths(self) -> Truths {
        match self {
            Self::Rgbt234 | Self::Gtot => Truths::Two,
            Self::Tsda => Truths::OneOrTwo,
            _ => Truths::One,
        }
    }

    /// What counts the same in averages.
    pub const fn averaging(self) -> Averaging {
        match self {
            Self::Gtot | Self::Got10k => Averaging::Frames,
            _ => Averaging::Sequences,
        }
    }

    /// Thresholds of the success curve (IoU strictly above): 21, for `got10k` 101, over `[0, 1]`.
    pub fn success_thresholds(self) -> Vec<f64> {
        match self {
            // Division gives the doubles nearest to 0.05, 0.1 ..
            Self::Tsda => (0..super::SUCCESS_POINTS).map(|i| i as f64 / 20.0).collect(),
            Self::Got10k => linspace(1.0, 101),
            _ => linspace(1.0, super::SUCCESS_POINTS),
        }
    }

    /// Thresholds of the precision curve in pixels: 0, 1 .. 50, for `gtot` 0, 0.5 .. 25.
    pub fn precision_thresholds(self) -> Vec<f64> {
        linspace(if self == Self::Gtot { 25.0 } else { 50.0 }, PRECISION_POINTS)
    }

    /// Thresholds of the normalised precision curve: 0, 0.01 .. 0.5.
    pub fn normalised_thresholds(self) -> Vec<f64> {
        linspace(0.5, PRECISION_POINTS)
    }

    /// Is a distance of exactly the threshold a miss?
    pub(super) const fn precision_is_strict(self) -> bool {
        matches!(self, Self::Gtot)
    }

    /// Are boxes rounded to whole pixels and compared in single precision?
    pub(super) const fn is_rgbt(self) -> bool {
        matches!(self, Self::Lasher | Self::Rgbt234 | Self::Rgbt210 | Self::Gtot)
    }

    pub(super) const fn first(self) -> First {
        match self {
            Self::Tsda | Self::Got10k => First::Excluded,
            Self::Lasher | Self::Rgbt210 | Self::Otb => First::Truth,
            Self::Rgbt234 | Self::Gtot => First::Predicted,
        }
    }
}

/// `n` points from 0 to `end` with the rounding errors of NumPy's function of that name.
fn linspace(end: f64, n: usize) -> Vec<f64> {
    let step = end / (n - 1) as f64;
    (0..n).map(|i| if i + 1 == n { end } else { i as f64 * step }).collect()
}

impl fmt::Display for Convention {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A text that names no convention.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown convention '{0}': expected tsda, lasher, rgbt234, rgbt210, gtot, otb or got10k")]
pub struct UnknownConvention(pub String);

impl FromStr for Convention {
    type Err = UnknownConvention;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|c| c.as_str() == s)
            .ok_or_else(|| UnknownConvention(s.to_owned()))
    }
}
