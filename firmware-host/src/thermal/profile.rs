//! What a thermal camera's buffer holds, by camera.

use serde::{Deserialize, Serialize};

/// Telemetry words of a Lepton (16 bit, low word of two first).
pub(super) const LEPTON_STATUS: usize = 3;
pub(super) const LEPTON_COUNTER: usize = 20;
/// Words 48 and 49 of the third group of 80: whether raw values are temperatures, and in which steps
/// (0: 0.1 K, 1: 0.01 K).
pub(super) const LEPTON_TLINEAR: usize = 160 + 48;

/// A kind of thermal camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Profile {
    /// 16-bit words without further meaning.
    #[default]
    Generic,
    /// FLIR Lepton 2, 3 (PureThermal boards); telemetry rows are recognised by the number of rows, and
    /// say whether raw values are temperatures (TLinear). Gain takes them for 0.01 K.
    Lepton,
    /// FLIR Boson: counts before its gain control; telemetry rows are recognised by the number of
    /// rows.
    Boson,
    /// InfiRay P2 Pro, Topdon TC001: 256 x 384, the picture in YUYV over the temperatures.
    P2,
}

/// Rows of a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rows {
    /// First row.
    pub first: usize,
    /// Number of rows, at least 1.
    pub count: usize,
}

/// What the tracker reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Picture {
    /// 16-bit words, mapped by [`super::Agc`].
    Raw,
    /// The camera's own 8-bit picture, in the format of the buffer.
    Camera,
}

/// What the rows of telemetry are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Telemetry {
    /// Read: shutter, frame counter, scale of temperatures.
    Lepton,
    /// Passed over.
    Unread,
}

/// Temperature in degrees Celsius from a raw value: `raw * scale + offset`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Celsius {
    /// Kelvin per raw step.
    pub scale: f64,
    /// Degrees Celsius at raw 0.
    pub offset: f64,
}

impl Celsius {
    /// Raw to degrees Celsius.
    #[allow(clippy::wrong_self_convention)]
    pub fn from_raw(&self, raw: f64) -> f64 {
        raw * self.scale + self.offset
    }

    /// Degrees Celsius to raw, within the range of the word.
    pub fn to_raw(&self, celsius: f64) -> u16 {
        ((celsius - self.offset) / self.scale).round().clamp(0.0, f64::from(u16::MAX)) as u16
    }
}

/// Which temperatures are reported.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measured {
    /// Those of [`Layout::celsius`], as the camera's only way or by the configuration.
    Always,
    /// Those of pictures whose telemetry says that raw values are temperatures, in its scale.
    WhenSaid,
}

/// Where things are in a buffer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layout {
    /// Pixels per row.
    pub width: usize,
    /// Rows of the picture.
    pub rows: Rows,
    /// What the picture is.
    pub picture: Picture,
    /// Rows of 16-bit words, which are temperatures when `celsius` is there.
    pub data: Option<Rows>,
    /// Rows of telemetry.
    pub telemetry: Option<(Rows, Telemetry)>,
    /// Meaning of the words in `data`, as far as gain is concerned.
    pub celsius: Option<Celsius>,
    /// Whether `celsius` is also reported.
    pub measured: Measured,
    /// Largest value of a word: what the sensor can deliver.
    pub full: u16,
}

/// A thermal camera that cannot be used as configured.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ThermalError {
    /// The buffer does not look like that camera's.
    #[error(
        "profile {profile:?}: buffers of {width} x {height} in {format} are not what this camera \
         delivers: {want}"
    )]
    Layout {
        /// The profile.
        profile: Profile,
        /// Width of the buffer.
        width: usize,
        /// Rows of the buffer.
        height: usize,
        /// Its pixel format.
        format: &'static str,
        /// What was expected.
        want: &'static str,
    },
    /// Gain options out of range.
    #[error("{what}: {reason}")]
    Options {
        /// Key of the configuration.
        what: &'static str,
        /// What is wrong and what to do.
        reason: String,
    },
}

/// Zero in degrees Celsius of scales that begin at absolute zero.
const ABSOLUTE: f64 = -273.15;
const CENTIKELVIN: Celsius = Celsius { scale: 0.01, offset: ABSOLUTE };
const DECIKELVIN: Celsius = Celsius { scale: 0.1, offset: ABSOLUTE };

/// The scale that the words at [`LEPTON_TLINEAR`] tell; `None` when raw values are no temperatures.
pub(super) const fn tlinear(on: u32, resolution: u32) -> Option<Celsius> {
    match (on, resolution) {
        (1, 0) => Some(DECIKELVIN),
        (1, 1) => Some(CENTIKELVIN),
        _ => None,
    }
}

impl Layout {
    /// With a scale that somebody stands for; only where there are raw values.
    #[must_use]
    pub fn with_celsius(self, celsius: Option<Celsius>) -> Self {
        match celsius {
            Some(_) if self.data.is_some() => Self { celsius, measured: Measured::Always, ..self },
            _ => self,
        }
    }
}

impl Profile {
    /// Where things are in a buffer of this size. `sixteen`: the buffer holds 16-bit words (and not
    /// 8-bit grey or colour); `full` is their largest value.
    ///
    /// # Errors
    /// When the size or the format is not one this camera has.
    pub fn layout(
        self,
        width: usize,
        height: usize,
        sixteen: bool,
        full: u16,
    ) -> Result<Layout, ThermalError> {
        let refuse = |want| ThermalError::Layout {
            profile: self,
            width,
            height,
            format: if sixteen { "16-bit grey" } else { "8 bit" },
            want,
        };
        let simple = |picture_rows: usize| Layout {
            width,
            rows: Rows { first: 0, count: picture_rows },
            picture: if sixteen { Picture::Raw } else { Picture::Camera },
            data: sixteen.then_some(Rows { first: 0, count: picture_rows }),
            telemetry: None,
            celsius: None,
            measured: Measured::Always,
            full,
        };
        let under = |rows: usize, kind| {
            (height > rows).then_some((Rows { first: rows, count: height - rows }, kind))
        };
        match self {
            Self::Generic => Ok(simple(height)),
            Self::Lepton => {
                let rows = match (width, height) {
                    (80, 60 | 63) => 60,
                    (160, 120 | 122) => 120,
                    _ => return Err(refuse("80 x 60, 80 x 63, 160 x 120 or 160 x 122")),
                };
                let mut layout = simple(rows);
                layout.celsius = sixteen.then_some(CENTIKELVIN);
                layout.measured = Measured::WhenSaid;
                // The rows are 16-bit words; an 8-bit buffer has no room for them.
                layout.telemetry = under(rows, Telemetry::Lepton).filter(|_| sixteen);
                Ok(layout)
            }
            Self::Boson => {
                let rows = match (width, height) {
                    (640, 512 | 514) => 512,
                    (320, 256 | 258) => 256,
                    _ => return Err(refuse("640 x 512, 640 x 514, 320 x 256 or 320 x 258")),
                };
                Ok(Layout { telemetry: under(rows, Telemetry::Unread), ..simple(rows) })
            }
            Self::P2 => {
                if width != 256 || !matches!(height, 192 | 384 | 386) {
                    return Err(refuse("256 x 384, 256 x 386 or (picture only) 256 x 192"));
                }
                if height == 192 {
                    return Ok(simple(192));
                }
                Ok(Layout {
                    // Called Y16 by some converters, the upper half is a picture all the same; then
                    // the lower half is what can be read.
                    rows: Rows { first: if sixteen { 192 } else { 0 }, count: 192 },
                    data: Some(Rows { first: 192, count: 192 }),
                    telemetry: under(384, Telemetry::Unread),
                    celsius: Some(Celsius { scale: 1.0 / 64.0, offset: ABSOLUTE }),
                    ..simple(192)
                })
            }
        }
    }
}
