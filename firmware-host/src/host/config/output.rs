//! `[output]` as written.

use serde::Deserialize;
use std::path::PathBuf;

/// Outputs.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OutputConfig {
    /// JSON lines.
    #[serde(default)]
    pub json: Vec<JsonConfig>,
    /// A page for a browser.
    pub preview: Option<PreviewConfig>,
    /// Figures for Prometheus.
    pub metrics: Option<MetricsConfig>,
    /// An autopilot or ground station.
    pub mavlink: Option<MavlinkConfig>,
    /// A recording.
    pub mcap: Option<McapConfig>,
}

/// JSON lines.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JsonConfig {
    /// `stdout`, `udp:HOST:PORT` or `unix:PATH`.
    pub to: String,
    /// Lines that may wait.
    #[serde(default = "queue_depth")]
    pub queue: usize,
}

fn queue_depth() -> usize {
    256
}

/// A page for a browser.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PreviewConfig {
    /// Address and port.
    pub bind: String,
    /// What a browser has to know; necessary when `bind` is not loopback. At least 16 characters.
    pub token: Option<String>,
    /// File with the token, instead of `token`.
    pub token_file: Option<PathBuf>,
    /// Pictures per second and source, at most; none are made while nobody looks.
    pub rate: f64,
    /// JPEG quality, 1 to 100.
    pub quality: u8,
    /// Longest side of a picture; larger ones are thinned out.
    pub size: usize,
    /// Records that may wait.
    pub queue: usize,
}

impl Default for PreviewConfig {
    fn default() -> Self {
        Self {
            bind: "127.0.0.1:8080".into(),
            token: None,
            token_file: None,
            rate: 10.0,
            quality: 75,
            size: 960,
            queue: queue_depth(),
        }
    }
}

/// Figures for Prometheus.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MetricsConfig {
    /// Address and port; on the preview's server without it.
    pub bind: Option<String>,
    /// As for the preview.
    pub token: Option<String>,
    /// As for the preview.
    pub token_file: Option<PathBuf>,
}

/// An autopilot or ground station.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MavlinkConfig {
    /// `udp:HOST:PORT` (sends there), `udpin:ADDRESS:PORT` (answers who speaks) or
    /// `serial:DEVICE:BAUD`.
    pub to: String,
    /// Number of this vehicle.
    pub system: u8,
    /// Number of this component; cameras have 100 to 105.
    pub component: u8,
    /// CAMERA_TRACKING_IMAGE_STATUS per second until someone sets another interval; 0: only then.
    pub status_rate: f64,
    /// Share of the picture's width that a box around a tracked point gets when the command has no
    /// radius.
    pub point_size: f32,
    /// Take commands.
    pub control: bool,
    /// Records that may wait.
    pub queue: usize,
}

impl Default for MavlinkConfig {
    fn default() -> Self {
        Self {
            to: String::new(),
            system: 1,
            component: 100,
            status_rate: 5.0,
            point_size: 0.1,
            control: true,
            queue: queue_depth(),
        }
    }
}

/// A recording.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct McapConfig {
    /// Folder for the files, made if needed.
    pub dir: PathBuf,
    /// Pictures per second and source; 0: none, only annotations.
    pub rate: f64,
    /// JPEG quality, 1 to 100.
    pub quality: u8,
    /// Longest side of a picture; larger ones are thinned out.
    pub size: usize,
    /// A new file is begun at this size.
    pub file_mb: u64,
    /// The oldest files are removed so that all together stay below this; 0: never.
    pub total_mb: u64,
    /// A chunk is written out at least so often.
    pub flush_s: f64,
    /// Records that may wait.
    pub queue: usize,
}

impl Default for McapConfig {
    fn default() -> Self {
        Self {
            dir: PathBuf::new(),
            rate: 10.0,
            quality: 85,
            size: 1280,
            file_mb: 256,
            total_mb: 4096,
            flush_s: 1.0,
            queue: queue_depth(),
        }
    }
}
