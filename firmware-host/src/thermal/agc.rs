//! Which raw values are shown as black and white.
//!
//! Limits taken from every picture by itself make the whole picture jump when something hot comes
//! in, and a template of the target then no longer fits. So the limits are percentiles, follow
//! slowly, keep a least distance (noise is not blown up to a picture) and stand still while the
//! shutter is closed.

use super::profile::{Layout, ThermalError};
use serde::{Deserialize, Serialize};
use std::time::Duration;
use tsda_runtime::FrameView;

/// Samples per picture, at most.
const SAMPLES: usize = 8192;

/// A fixed range instead of one that follows the scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Window {
    /// Shown as black: degrees Celsius for a camera that measures them, else raw.
    pub low: f64,
    /// Shown as white.
    pub high: f64,
}

/// How the range follows the scene.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AgcOptions {
    /// Share of the pixels that may be black, and of those that may be white, in `[0, 0.25]`.
    pub clip: f64,
    /// Seconds in which the limits make 63 % of a step of the scene; 0: at once.
    pub time_s: f64,
    /// Least distance of the limits: kelvin for a camera that measures them, else raw steps.
    pub min_span: Option<f64>,
    /// Fixed limits instead.
    pub window: Option<Window>,
}

impl Default for AgcOptions {
    fn default() -> Self {
        Self { clip: 0.005, time_s: 0.7, min_span: None, window: None }
    }
}

/// Least distances without one in the configuration: 5 K, or this share of the sensor's range.
const MIN_SPAN_KELVIN: f64 = 5.0;
const MIN_SPAN_SHARE: f64 = 1.0 / 256.0;

/// The limits and their history.
#[derive(Clone, Debug)]
pub struct Agc {
    options: AgcOptions,
    min_span: f32,
    full: f32,
    /// Low and high, raw.
    limits: Option<(f32, f32)>,
    at: Duration,
    samples: Vec<u16>,
}

impl Agc {
    /// Allocates what it needs for good.
    ///
    /// # Errors
    /// When an option is out of range.
    pub fn new(layout: &Layout, options: AgcOptions) -> Result<Self, ThermalError> {
        let refuse = |what, reason: String| Err(ThermalError::Options { what, reason });
        if !(0.0..=0.25).contains(&options.clip) {
            return refuse("agc.clip", format!("{} is not between 0 and 0.25", options.clip));
        }
        if !(options.time_s.is_finite() && options.time_s >= 0.0) {
            return refuse("agc.time_s", format!("{} is not a time", options.time_s));
        }
        let full = f64::from(layout.full);
        let min_span = match (options.min_span, layout.celsius) {
            (Some(kelvin), Some(c)) => kelvin / c.scale,
            (Some(raw), None) => raw,
            (None, Some(c)) => MIN_SPAN_KELVIN / c.scale,
            (None, None) => full * MIN_SPAN_SHARE,
        };
        if !(min_span >= 1.0 && min_span <= full) {
            return refuse("agc.min_span", format!("{min_span} raw steps are not in 1..{full}"));
        }
        let limits = match options.window {
            None => None,
            Some(w) => {
                let raw = |v: f64| match layout.celsius {
                    Some(c) => f32::from(c.to_raw(v)),
                    None => v.clamp(0.0, 65535.0) as f32,
                };
                let (low, high) = (raw(w.low), raw(w.high));
                if low.is_nan() || high.is_nan() || low + 1.0 > high {
                    return refuse(
                        "agc.window",
                        format!("low {} and high {} leave no range between them", w.low, w.high),
                    );
                }
                Some((low, high))
            }
        };
        let samples = vec![0; SAMPLES];
        Ok(Self {
            options,
            min_span: min_span as f32,
            full: full as f32,
            limits,
            at: Duration::ZERO,
            samples,
        })
    }

    /// Lets the limits follow a picture of 16-bit words. Allocates nothing.
    pub fn follow(&mut self, picture: &FrameView<'_>, at: Duration) {
        let dt = at.saturating_sub(self.at).as_secs_f64();
        self.at = at;
        if self.options.window.is_some() {
            return;
        }
        let n = sample(picture, &mut self.samples);
        let Some((low, high)) = percentiles(&mut self.samples[..n], self.options.clip) else {
            return;
        };
        let (low, high) = self.widened(f32::from(low), f32::from(high));
        self.limits = Some(match self.limits {
            Some((old_low, old_high)) if self.options.time_s > 0.0 => {
                let share = 1.0 - (-dt / self.options.time_s).exp() as f32;
                let toward = |old: f32, new: f32| old + (new - old) * share;
                self.widened(toward(old_low, low), toward(old_high, high))
            }
            _ => (low, high),
        });
    }

    /// Time goes by without a picture to follow: what comes after is no later for it.
    pub fn hold(&mut self, at: Duration) {
        self.at = at;
    }

    /// At least the minimum span, inside the sensor's range.
    fn widened(&self, low: f32, high: f32) -> (f32, f32) {
        let grow = ((self.min_span - (high - low)) * 0.5).max(0.0);
        let (low, high) = (low - grow, high + grow);
        let low = low.clamp(0.0, (self.full - self.min_span).max(0.0));
        (low, high.clamp(low + self.min_span.max(1.0), self.full.max(low + self.min_span)))
    }

    /// Raw values shown as black and as white; the first is below the second.
    pub fn limits(&self) -> (u16, u16) {
        let (low, high) = self.limits.unwrap_or((0.0, self.full));
        let low = (low.round().max(0.0) as u16).min(u16::MAX - 1);
        (low, (high.round() as u16).max(low + 1))
    }
}

/// Spreads the samples over the picture; answers how many there are.
fn sample(picture: &FrameView<'_>, out: &mut [u16]) -> usize {
    let (w, h) = (picture.width(), picture.height());
    let step = (w * h).div_ceil(out.len()).max(1);
    // Every step-th pixel of the picture as one line. A step that divides the width would sample
    // columns only.
    let step = if step > 1 && w.is_multiple_of(step) { step + 1 } else { step };
    let mut n = 0;
    for (slot, i) in out.iter_mut().zip((0..w * h).step_by(step)) {
        let at = i / w * picture.stride() + 2 * (i % w);
        *slot = u16::from_le_bytes([picture.data()[at], picture.data()[at + 1]]);
        n += 1;
    }
    n
}

fn percentiles(samples: &mut [u16], clip: f64) -> Option<(u16, u16)> {
    let last = samples.len().checked_sub(1)?;
    let k = (clip * last as f64).round() as usize;
    let low = *samples.select_nth_unstable(k).1;
    let high = *samples.select_nth_unstable(last - k).1;
    Some((low, high))
}
