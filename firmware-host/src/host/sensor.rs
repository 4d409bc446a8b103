//! A source with what belongs to it: its layout and gain, its health.

use super::clock::Clock;
use super::output::SourceInfo;
use super::source::{Captured, Polled, Source};
use crate::error::HostError;
use crate::switch::health::Marks;
use crate::switch::{Condition, HealthLimits, Scene, Watch};
use crate::thermal::{AgcOptions, Celsius, Profile, Temperature, Thermal};
use std::time::Duration;
use tsda_runtime::{BBox, FrameView, Modality, PixelFormat};

/// One sensor of the run.
#[derive(Debug)]
pub struct Sensor {
    info: SourceInfo,
    source: Box<dyn Source>,
    /// What buffers and raw values are, where it is given.
    meaning: (Option<Profile>, Option<Celsius>),
    agc: AgcOptions,
    crop: Option<[usize; 4]>,
    /// Width, height, 16 bit, largest value: what `thermal` was made for.
    shape: Option<(usize, usize, bool, u16)>,
    thermal: Option<Thermal>,
    watch: Watch,
    always_new: bool,
    /// Whether the source has a picture.
    there: bool,
}

/// What [`Sensor::poll`] found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum News {
    /// A picture that shows something new.
    Fresh,
    /// None, or the same as before.
    Nothing,
    /// There will be no more.
    Ended,
}

impl Sensor {
    /// Puts a sensor together. `meaning`: what its buffers hold, and the scale of raw values where it
    /// is given.
    ///
    /// # Errors
    /// When the gain options make no sense.
    pub fn new(
        info: SourceInfo,
        source: Box<dyn Source>,
        meaning: (Option<Profile>, Option<Celsius>),
        agc: AgcOptions,
        health: HealthLimits,
        crop: Option<[usize; 4]>,
    ) -> Result<Self, HostError> {
        // The options are checked against a layout that suits any: what depends on the camera's own
        // is found with its first picture.
        if let Ok(layout) = Profile::Generic.layout(1, 1, true, u16::MAX) {
            let open = AgcOptions { window: None, min_span: None, ..agc };
            Thermal::new(layout, open).map_err(|e| HostError::Argument {
                what: format!("source `{}`", info.name),
                reason: e.to_string(),
            })?;
        }
        Ok(Self {
            info,
            source,
            meaning,
            agc,
            crop,
            shape: None,
            thermal: None,
            watch: Watch::new(health),
            always_new: health.frozen_s <= 0.0,
            there: false,
        })
    }

    /// Name and kind.
    pub const fn info(&self) -> &SourceInfo {
        &self.info
    }

    /// Kind of sensor.
    pub const fn modality(&self) -> Modality {
        self.info.sensor
    }

    /// The source.
    pub fn source(&self) -> &dyn Source {
        self.source.as_ref()
    }

    /// Health.
    pub const fn watch(&self) -> &Watch {
        &self.watch
    }

    /// Looks for a newer picture for at most `wait` and takes it in.
    ///
    /// # Errors
    /// See [`Source::poll`]; also when the pictures do not suit the profile or the crop.
    pub fn poll(&mut self, clock: &Clock, wait: Duration) -> Result<News, HostError> {
        match self.source.poll(clock, wait)? {
            Polled::Fresh => {
                self.there = true;
                let new = self.take(clock.now())?;
                Ok(if new { News::Fresh } else { News::Nothing })
            }
            Polled::Nothing => Ok(News::Nothing),
            Polled::Gone => {
                self.there = false;
                self.watch.gone();
                Ok(News::Nothing)
            }
            Polled::Ended => Ok(News::Ended),
        }
    }

    /// What keeps the device from being opened again, once per reason.
    pub fn trouble(&mut self) -> Option<String> {
        self.source.trouble()
    }

    /// Health, layout and gain of a new picture; answers whether it shows anything new.
    fn take(&mut self, now: Duration) -> Result<bool, HostError> {
        let fail = |name: &str, reason: String| HostError::Argument {
            what: format!("source `{name}`"),
            reason,
        };
        let Some(captured) = self.source.frame() else { return Ok(false) };
        let whole =
            cropped(&captured.view, self.crop).map_err(|reason| fail(&self.info.name, reason))?;
        let sixteen = matches!(whole.format(), PixelFormat::Y16 { .. });
        let shape = (whole.width(), whole.height(), sixteen, captured.full);
        if self.shape != Some(shape) {
            self.thermal = match self.meaning {
                (None, _) if !sixteen => None,
                (profile, celsius) => {
                    let layout = profile
                        .unwrap_or_default()
                        .layout(shape.0, shape.1, sixteen, captured.full)
                        .map(|layout| layout.with_celsius(celsius))
                        .and_then(|layout| Thermal::new(layout, self.agc));
                    Some(layout.map_err(|e| fail(&self.info.name, e.to_string()))?)
                }
            };
            self.shape = Some(shape);
        }
        let status = self.thermal.as_ref().map(|t| t.status(&whole)).unwrap_or_default();
        let picture = match &self.thermal {
            Some(thermal) => {
                thermal.picture(&whole).map_err(|e| fail(&self.info.name, e.to_string()))?
            }
            None => whole,
        };
        let marks =
            Marks { damaged: captured.damaged, shutter: captured.shutter || status.shutter };
        let new = self.watch.picture(now, Scene::measure(&picture, captured.full), marks);
        let good = self.watch.condition(now) == Condition::Good;
        if let Some(thermal) = &mut self.thermal {
            thermal
                .follow(&whole, captured.at, !good)
                .map_err(|e| fail(&self.info.name, e.to_string()))?;
        }
        Ok(new || self.always_new)
    }

    /// The newest picture as the source delivered it.
    pub fn captured(&self) -> Option<Captured<'_>> {
        if self.there { self.source.frame() } else { None }
    }

    /// The newest picture as the tracker reads it.
    pub fn view(&self) -> Option<FrameView<'_>> {
        let whole = cropped(&self.captured()?.view, self.crop).ok()?;
        match &self.thermal {
            Some(thermal) => thermal.picture(&whole).ok(),
            None => Some(whole),
        }
    }

    /// Temperature in a box of the newest picture.
    pub fn temperature(&self, bbox: &BBox) -> Option<Temperature> {
        let thermal = self.thermal.as_ref()?;
        thermal.temperature(&cropped(&self.captured()?.view, self.crop).ok()?, bbox)
    }
}

/// Part of a picture, without copying. Planar formats cannot be cut this way.
fn cropped<'a>(view: &FrameView<'a>, crop: Option<[usize; 4]>) -> Result<FrameView<'a>, String> {
    let Some([x, y, w, h]) = crop else { return Ok(*view) };
    let (width, height, format) = (view.width(), view.height(), view.format());
    let fits = x.checked_add(w).is_some_and(|r| r <= width)
        && y.checked_add(h).is_some_and(|b| b <= height);
    if !fits {
        return Err(format!("crop {x}, {y}, {w}, {h} does not lie in its {width} x {height}"));
    }
    let packed = matches!(format, PixelFormat::Yuyv | PixelFormat::Uyvy);
    if format == PixelFormat::Nv12 || (packed && x % 2 == 1) {
        return Err(format!("crop {x}, {y}, {w}, {h} cannot be cut from {format:?} pictures"));
    }
    let skip = y * view.stride() + format.row_bytes(x);
    let data = view.data().get(skip..).unwrap_or_default();
    FrameView::new(data, w, h, view.stride(), format).map_err(|e| e.to_string())
}
