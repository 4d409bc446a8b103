//! Thermal cameras: where in a buffer the picture, the temperatures and the telemetry are
//! ([`profile`]), and which raw values are shown as black and white ([`agc`]).
//!
//! Nothing is converted: the crop sampler reads the 16-bit words and maps them linearly between two
//! limits that follow the scene slowly, white hot, one channel for all three: what the training data
//! (8-bit pictures of cameras with their own gain control) looked like.

pub mod agc;
pub mod profile;

pub use agc::{Agc, AgcOptions, Window};
pub use profile::{Celsius, Layout, Profile, ThermalError};

use profile::{Measured, Picture, Telemetry};
use std::time::Duration;
use tsda_runtime::{BBox, FrameError, FrameView, PixelFormat};

/// Temperature in the middle of the target's box, in degrees Celsius.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Temperature {
    /// Mean over the inner half of the box's width and height.
    pub mean: f32,
    /// Hottest pixel there.
    pub max: f32,
}

/// One thermal camera: its layout and its gain.
#[derive(Clone, Debug)]
pub struct Thermal {
    layout: Layout,
    agc: Agc,
}

/// What the telemetry rows say.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Status {
    /// The shutter is closed (flat field correction under way).
    pub shutter: bool,
    /// The sensor's own frame counter.
    pub counter: Option<u32>,
}

impl Thermal {
    /// For buffers of this layout.
    ///
    /// # Errors
    /// When the options make no sense for it.
    pub fn new(layout: Layout, options: AgcOptions) -> Result<Self, ThermalError> {
        Ok(Self { layout, agc: Agc::new(&layout, options)? })
    }

    /// The layout.
    pub const fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Reads the telemetry of a whole buffer and lets the limits follow its picture, unless the
    /// shutter is closed. `at` is the time of the picture. Allocates nothing.
    ///
    /// # Errors
    /// When the buffer is not as large as the layout says.
    pub fn follow(
        &mut self,
        whole: &FrameView<'_>,
        at: Duration,
        frozen: bool,
    ) -> Result<Status, FrameError> {
        let status = self.status(whole);
        if frozen || status.shutter {
            self.agc.hold(at);
        } else if self.layout.picture == Picture::Raw {
            self.agc.follow(&self.picture(whole)?, at);
        }
        Ok(status)
    }

    /// The part of a buffer that the tracker reads.
    ///
    /// # Errors
    /// When the buffer is not as large as the layout says.
    pub fn picture<'a>(&self, whole: &FrameView<'a>) -> Result<FrameView<'a>, FrameError> {
        let (low, high) = self.agc.limits();
        let format = match self.layout.picture {
            Picture::Raw => PixelFormat::Y16 { low, high },
            Picture::Camera => whole.format(),
        };
        rows(whole, self.layout.rows, format)
    }

    /// Temperature at the target; `None` when the camera does not measure any, or does not say that it
    /// does.
    pub fn temperature(&self, whole: &FrameView<'_>, bbox: &BBox) -> Option<Temperature> {
        let celsius = match self.layout.measured {
            Measured::Always => self.layout.celsius?,
            Measured::WhenSaid => self.said(whole)?,
        };
        let raw = PixelFormat::Y16 { low: 0, high: u16::MAX };
        let data = rows(whole, self.layout.data?, raw).ok()?;
        // The picture and the temperatures may differ in size.
        let picture = (self.layout.width as f32, self.layout.rows.count as f32);
        let (kx, ky) = (data.width() as f32 / picture.0, data.height() as f32 / picture.1);
        let span = |middle: f32, size: f32, k: f32, n: usize| {
            let low = ((middle - size * 0.25) * k).clamp(0.0, n as f32 - 1.0) as usize;
            let high = ((middle + size * 0.25) * k).clamp(0.0, n as f32).ceil() as usize;
            low..high.clamp(low + 1, n)
        };
        let (cx, cy) = bbox.centre();
        let (columns, lines) =
            (span(cx, bbox.w, kx, data.width()), span(cy, bbox.h, ky, data.height()));
        let (mut sum, mut count, mut max) = (0u64, 0u64, 0u16);
        for y in lines {
            let row = &data.data()[y * data.stride()..][..2 * data.width()];
            for value in row.as_chunks::<2>().0.get(columns.clone())? {
                let raw = u16::from_le_bytes(*value);
                sum += u64::from(raw);
                count += 1;
                max = max.max(raw);
            }
        }
        let mean = sum as f64 / count.max(1) as f64;
        Some(Temperature {
            mean: celsius.from_raw(mean) as f32,
            max: celsius.from_raw(f64::from(max)) as f32,
        })
    }

    /// What the telemetry rows say; nothing when there are none. Allocates nothing.
    pub fn status(&self, whole: &FrameView<'_>) -> Status {
        let word = |i: usize| self.word(whole, i);
        let long = |i: usize| Some(word(i)? | word(i + 1)? << 16);
        // Bits 4 and 5 of the status: 1 imminent, 2 in progress, 3 complete.
        let ffc = long(profile::LEPTON_STATUS).map_or(0, |s| s >> 4 & 3);
        Status { shutter: ffc == 2, counter: long(profile::LEPTON_COUNTER) }
    }

    /// The scale of the raw values as the telemetry tells it.
    fn said(&self, whole: &FrameView<'_>) -> Option<Celsius> {
        let word = |i: usize| self.word(whole, profile::LEPTON_TLINEAR + i);
        profile::tlinear(word(0)?, word(1)?)
    }

    /// A word of a Lepton's telemetry.
    fn word(&self, whole: &FrameView<'_>, i: usize) -> Option<u32> {
        let Some((at, Telemetry::Lepton)) = self.layout.telemetry else { return None };
        let (row, column) = (i / self.layout.width, i % self.layout.width);
        if row >= at.count {
            return None;
        }
        let start = (at.first + row) * whole.stride() + 2 * column;
        let bytes = whole.data().get(start..start + 2)?;
        Some(u32::from(u16::from_le_bytes([bytes[0], bytes[1]])))
    }
}

/// Some rows of a view, read as `format`.
fn rows<'a>(
    whole: &FrameView<'a>,
    rows: profile::Rows,
    format: PixelFormat,
) -> Result<FrameView<'a>, FrameError> {
    let skip = rows.first.saturating_mul(whole.stride());
    let truncated = FrameError::Truncated { len: whole.data().len(), needed: skip };
    let data = whole.data().get(skip..).ok_or(truncated)?;
    FrameView::new(data, whole.width(), rows.count, whole.stride(), format)
}

#[cfg(test)]
mod tests;
