//! `[process]` as written.

use serde::Deserialize;
use std::path::PathBuf;

/// The process itself.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProcessConfig {
    /// Keep all memory in RAM.
    pub mlockall: bool,
    /// Priority of the loop under SCHED_FIFO, 1 to 99.
    pub sched_fifo: Option<u8>,
    /// How warm the machine is.
    pub temperature: Option<TemperatureConfig>,
}

/// Thermal zones of the machine.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TemperatureConfig {
    /// Folder with `thermal_zone*`.
    pub path: PathBuf,
    /// Seconds between two readings.
    pub every_s: f64,
    /// Degrees Celsius of the warmest zone above which frames are left out; without it the
    /// temperature is only reported.
    pub limit: Option<f32>,
    /// Degrees below the limit at which all frames are used again.
    pub hysteresis: f32,
    /// Frames per second while it is too warm.
    pub rate: f64,
}

impl Default for TemperatureConfig {
    fn default() -> Self {
        Self {
            path: "/sys/class/thermal".into(),
            every_s: 2.0,
            limit: None,
            hysteresis: 5.0,
            rate: 10.0,
        }
    }
}
