//! `host.toml` as written. Unknown keys are errors; [`super::plan`] says what it all means.

mod output;
mod process;

pub use output::{
    JsonConfig, MavlinkConfig, McapConfig, MetricsConfig, OutputConfig, PreviewConfig,
};
pub use process::{ProcessConfig, TemperatureConfig};

use super::clock::ClockKind;
use super::source::Fault;
use crate::error::HostError;
use crate::switch::HealthLimits;
use crate::switch::homography::Homography;
use crate::switch::policy::SceneMeasure;
use crate::thermal::{AgcOptions, Celsius, Profile};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tsda_runtime::Modality;

/// The whole file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HostConfig {
    /// Bundle, relative to this file; the embedded one without it.
    pub model: Option<PathBuf>,
    /// Engine with its options, as `--engine`.
    pub engine: Option<String>,
    /// Time of the run.
    #[serde(default)]
    pub clock: ClockKind,
    /// End after so many records.
    pub frames: Option<u64>,
    /// End (exit code 4) after so many seconds without a usable picture of any sensor.
    pub give_up_s: Option<f64>,
    /// Look over the whole frame for a lost target, so many search areas per frame.
    pub scan_when_lost: Option<u8>,
    /// Sensors, at least one.
    #[serde(rename = "source")]
    pub sources: Vec<SourceConfig>,
    /// What to follow.
    #[serde(default)]
    pub target: TargetConfig,
    /// When to change sensors.
    #[serde(default)]
    pub switch: SwitchConfig,
    /// Where a point of one sensor's picture lies in another's.
    #[serde(default, rename = "registration")]
    pub registrations: Vec<RegistrationConfig>,
    /// Commands while running.
    #[serde(default)]
    pub control: ControlConfig,
    /// What comes out.
    #[serde(default)]
    pub output: OutputConfig,
    /// The process itself.
    #[serde(default)]
    pub process: ProcessConfig,
    /// Folder that relative paths start from; that of the file.
    #[serde(skip)]
    pub base: PathBuf,
}

/// A sensor. Exactly one of `v4l2`, `files`, `y4m`, `raw16` and `render` says where its pictures
/// come from.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceConfig {
    /// Name in messages, commands and outputs.
    pub name: String,
    /// `rgb` or `thermal`.
    pub sensor: Modality,
    /// A camera.
    pub v4l2: Option<V4l2Config>,
    /// A folder or list of pictures.
    pub files: Option<FilesConfig>,
    /// Raw video.
    pub y4m: Option<Y4mConfig>,
    /// A folder of raw 16-bit pictures.
    pub raw16: Option<Raw16Config>,
    /// The scene the program draws itself.
    pub render: Option<RenderConfig>,
    /// What a thermal camera's buffer holds.
    pub profile: Option<Profile>,
    /// What raw values mean, instead of what the profile or the telemetry says.
    pub celsius: Option<Celsius>,
    /// 16 bit to 8 bit.
    #[serde(default)]
    pub agc: AgcOptions,
    /// When a picture is unusable.
    #[serde(default)]
    pub health: HealthLimits,
    /// Part of the picture to use: x, y, width, height.
    pub crop: Option<[usize; 4]>,
    /// Rehearsed faults, not for cameras.
    #[serde(default)]
    pub faults: Vec<Fault>,
}

/// A V4L2 camera.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct V4l2Config {
    /// `/dev/v4l/by-id/..` or `/dev/v4l/by-path/..`; `/dev/videoN` may change at every plug.
    pub device: PathBuf,
    /// Four characters: YUYV, UYVY, NV12, RGB3, BGR3, GREY, Y10, Y16 or MJPG; the best the camera
    /// has without it.
    pub format: Option<String>,
    /// Width and height; what the camera is set to without it.
    pub size: Option<[u32; 2]>,
    /// Pictures per second.
    pub rate: Option<f64>,
    /// Buffers in the driver.
    #[serde(default = "four")]
    pub buffers: u32,
    /// Wait for a camera that is not there at the start, instead of refusing to run.
    #[serde(default)]
    pub wait: bool,
    /// Controls by name, set at every start.
    #[serde(default)]
    pub controls: BTreeMap<String, i64>,
}

fn four() -> u32 {
    4
}

fn usual_rate() -> f64 {
    25.0
}

/// Pictures in files.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FilesConfig {
    /// Folder or text list.
    pub path: PathBuf,
    /// Pictures per second.
    #[serde(default = "usual_rate")]
    pub rate: f64,
    /// Begin anew after the last.
    #[serde(default)]
    pub repeat: bool,
    /// Read everything at the start.
    #[serde(default)]
    pub preload: bool,
}

/// Y4M video.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Y4mConfig {
    /// File.
    pub path: PathBuf,
    /// Pictures per second.
    #[serde(default = "usual_rate")]
    pub rate: f64,
    /// Begin anew after the last.
    #[serde(default)]
    pub repeat: bool,
}

/// Raw 16-bit pictures.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Raw16Config {
    /// Folder.
    pub path: PathBuf,
    /// Width and height, telemetry rows included.
    pub size: [usize; 2],
    /// Bits that are used.
    #[serde(default = "sixteen")]
    pub bits: u8,
    /// Pictures per second.
    #[serde(default = "usual_rate")]
    pub rate: f64,
    /// Begin anew after the last.
    #[serde(default)]
    pub repeat: bool,
}

fn sixteen() -> u8 {
    16
}

/// The drawn scene; all sources with the same seed and number of frames see the same.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderConfig {
    /// Width and height.
    pub size: [usize; 2],
    /// Frames.
    pub frames: usize,
    /// Seed.
    pub seed: u32,
    /// Thermal as 16-bit words of 0.01 K, 20 to 40 degrees Celsius.
    pub raw16: bool,
    /// Pictures per second.
    pub rate: f64,
    /// Begin anew after the last.
    pub repeat: bool,
}

impl Default for RenderConfig {
    fn default() -> Self {
        let clip = crate::render::ClipConfig::default();
        Self {
            size: [clip.width, clip.height],
            frames: clip.frames,
            seed: clip.seed,
            raw16: false,
            rate: usual_rate(),
            repeat: false,
        }
    }
}

/// What to follow.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TargetConfig {
    /// x, y, width, height in the first picture; without it that of the files, else a command.
    #[serde(rename = "box")]
    pub bbox: Option<[f32; 4]>,
    /// Source whose pixels `box` is in; the first one used without it.
    pub source: Option<String>,
}

/// When to change sensors.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SwitchConfig {
    /// Source to begin with and to come back to; the first without it.
    pub preferred: Option<String>,
    /// On failure.
    pub failure: Option<FailureConfig>,
    /// At given times.
    #[serde(default)]
    pub schedule: Vec<ScheduleConfig>,
    /// In turn, every so many seconds.
    pub every_s: Option<f64>,
    /// By what is seen.
    pub scene: Option<SceneConfig>,
}

/// Changing on failure.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FailureConfig {
    /// Seconds without a usable picture.
    pub after_s: f64,
    /// Seconds for which the preferred source has to be good before it is used again; negative:
    /// never go back.
    pub return_after_s: f64,
}

impl Default for FailureConfig {
    fn default() -> Self {
        Self { after_s: 0.3, return_after_s: 2.0 }
    }
}

/// One entry of a schedule.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduleConfig {
    /// Seconds since the start.
    pub at_s: f64,
    /// Source.
    pub to: String,
}

/// Changing by what is seen.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneConfig {
    /// Source whose pictures decide.
    pub watch: String,
    /// Source to use while its figure is low.
    pub otherwise: String,
    /// Which figure.
    #[serde(default)]
    pub measure: SceneMeasure,
    /// Leave below this.
    pub below: f32,
    /// Come back above this.
    pub above: f32,
    /// Seconds for which the figure has to stay there.
    #[serde(default = "one")]
    pub hold_s: f64,
}

fn one() -> f64 {
    1.0
}

/// Registration of an ordered pair of sources.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegistrationConfig {
    /// Source.
    pub from: String,
    /// Source.
    pub to: String,
    /// Three rows of three.
    pub matrix: Homography,
}

/// Commands while running.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlConfig {
    /// One JSON command per line on standard input.
    #[serde(default)]
    pub stdin: bool,
    /// One JSON command per line over a Unix socket.
    pub socket: Option<PathBuf>,
}

impl HostConfig {
    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, is no TOML, or has a key or value that is not understood: names the
    /// file and the line.
    pub fn read(path: &Path) -> Result<Self, HostError> {
        let text = std::fs::read_to_string(path).map_err(|e| HostError::Argument {
            what: path.display().to_string(),
            reason: format!("cannot be read: {e}"),
        })?;
        let mut config = Self::parse(&text, &path.display().to_string())?;
        config.base = path.parent().unwrap_or(Path::new("")).to_path_buf();
        Ok(config)
    }

    /// Parses text; errors call it `name`.
    ///
    /// # Errors
    /// See [`Self::read`].
    pub fn parse(text: &str, name: &str) -> Result<Self, HostError> {
        toml::from_str(text).map_err(|e| {
            let place = e.span().map_or_else(String::new, |span| {
                let before = text.get(..span.start).unwrap_or(text);
                format!(", line {}", before.matches('\n').count() + 1)
            });
            HostError::Argument {
                what: format!("{name}{place}"),
                reason: e.message().trim().to_owned(),
            }
        })
    }

    /// A path of the file, relative to its folder.
    pub fn path(&self, path: &Path) -> PathBuf {
        self.base.join(path)
    }
}
