//! How the tracker searches, where that differs from the bundle: arguments shared by the commands
//! that track.

use crate::error::HostError;
use clap::Args;
use std::fmt;
use tsda_runtime::{MotionPrior, RedetectOptions, Tracker, TrackerParams};

/// A motion prior as typed, or `off`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionChoice(pub Option<MotionPrior>);

impl std::str::FromStr for MotionChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "off" {
            return Ok(Self(None));
        }
        text.parse().map(|prior| Self(Some(prior))).map_err(|e: &str| format!("{e}; or off"))
    }
}

/// `--scan-when-lost`, `--scan-threshold`, `--motion` and `--remember-above`.
#[derive(Clone, Copy, Debug, Default, Args)]
pub struct RedetectArgs {
    /// Look over the whole frame for a target that is lost, N search areas more per frame (the cost
    /// of a frame is that of N + 1 then) [default when given without N: 2]
    #[arg(long, value_name = "N", num_args = 0..=1, require_equals = true,
        default_missing_value = "2", value_parser = clap::value_parser!(u8).range(1..))]
    pub scan_when_lost: Option<u8>,
    /// Score above which a find of the scan counts [default: 0.8]
    #[arg(long, value_name = "SCORE", requires = "scan_when_lost")]
    pub scan_threshold: Option<f32>,
    /// How much place and size of the last frame count: share of a score that depends on the
    /// distance from there, share of a change of size taken over at once [default: the bundle's]
    #[arg(long, value_name = "WINDOW,SIZE_RATE|off")]
    pub motion: Option<MotionChoice>,
    /// Score above which a frame becomes a template: lower follows changes of look and sensor sooner,
    /// higher drifts less [default: the bundle's]
    #[arg(long, value_name = "SCORE")]
    pub remember_above: Option<f32>,
}

impl RedetectArgs {
    /// What was chosen; `None`: look only where the target was last seen.
    pub fn options(&self) -> Option<RedetectOptions> {
        let defaults = RedetectOptions::default();
        self.scan_when_lost.map(|positions_per_frame| RedetectOptions {
            positions_per_frame,
            threshold: self.scan_threshold.unwrap_or(defaults.threshold),
        })
    }

    /// Checks the values.
    ///
    /// # Errors
    /// When a threshold is out of range.
    pub fn validate(&self) -> Result<(), HostError> {
        if let Some(score) = self.remember_above {
            let params = TrackerParams { write_confidence: score, ..Default::default() };
            params.validate().map_err(|e| out_of_range("--remember-above", e))?;
        }
        let scan = self.options().map_or(Ok(()), |o| o.validate());
        scan.map_err(|e| out_of_range("--scan-threshold", e))
    }

    /// Sets a tracker up.
    ///
    /// # Errors
    /// When a threshold is out of range.
    pub fn apply<E>(&self, tracker: &mut Tracker<E>) -> Result<(), HostError> {
        if let Some(MotionChoice(motion)) = self.motion {
            tracker.set_motion_prior(motion).map_err(|e| out_of_range("--motion", e))?;
        }
        if let Some(score) = self.remember_above {
            tracker.set_write_confidence(score).map_err(|e| out_of_range("--remember-above", e))?;
        }
        tracker.set_redetection(self.options()).map_err(|e| out_of_range("--scan-threshold", e))
    }
}

fn out_of_range(what: &str, e: impl fmt::Display) -> HostError {
    HostError::Argument { what: what.into(), reason: e.to_string() }
}

/// What sets results apart from those without the options; empty without them.
impl fmt::Display for RedetectArgs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut parts = Vec::new();
        if let Some(options) = self.options() {
            // As JSON, which has every field there is.
            let json = serde_json::to_string(&options).map_err(|_| fmt::Error)?;
            parts.push(format!("scan {json}"));
        }
        match self.motion {
            None => {}
            Some(MotionChoice(None)) => parts.push("motion off".into()),
            Some(MotionChoice(Some(prior))) => parts.push(format!("motion {prior}")),
        }
        parts.extend(self.remember_above.map(|score| format!("remember above {score}")));
        f.write_str(&parts.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        redetect: RedetectArgs,
    }

    #[test]
    fn the_scan_is_off_unless_asked_for() {
        let parse = |args: &[&str]| {
            let args = ["program"].iter().chain(args);
            Program::try_parse_from(args).map(|p| p.redetect.options())
        };
        assert_eq!(parse(&[]).expect("nothing"), None);
        assert_eq!(parse(&["--scan-when-lost"]).expect("alone"), Some(RedetectOptions::default()));
        let both = parse(&["--scan-when-lost=5", "--scan-threshold", "0.9"]).expect("both");
        assert_eq!(both, Some(RedetectOptions { positions_per_frame: 5, threshold: 0.9 }));
        let text = |args: &[&str]| {
            let args = ["program"].iter().chain(args);
            Program::try_parse_from(args).map(|p| p.redetect.to_string()).expect("arguments")
        };
        assert_eq!(text(&[]), "");
        assert_eq!(
            text(&["--scan-when-lost=5", "--scan-threshold", "0.9"]),
            "scan {\"positions_per_frame\":5,\"threshold\":0.9}"
        );
        assert_eq!(text(&["--motion", "0.3,1"]), "motion 0.3,1");
        assert_eq!(
            text(&["--scan-when-lost=2", "--motion=off"]),
            "scan {\"positions_per_frame\":2,\"threshold\":0.8}, motion off"
        );
        assert_eq!(
            text(&["--remember-above", "0.5", "--motion", "0.3,1"]),
            "motion 0.3,1, remember above 0.5"
        );
        let bad = Program::try_parse_from(["program", "--remember-above=-1"]).expect("a number");
        let error = bad.redetect.validate().expect_err("negative").to_string();
        assert!(error.contains("--remember-above") && error.contains("-1"), "{error}");
        assert!(parse(&["--motion", "1.5,1"]).is_err() && parse(&["--motion", "0.3"]).is_err());
        assert!(parse(&["--scan-threshold", "0.8"]).is_err());
        assert!(parse(&["--scan-when-lost=0"]).is_err());
    }
}
