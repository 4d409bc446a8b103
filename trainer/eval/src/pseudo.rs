//! Clips with exact truth made from registered stills: a virtual camera pans and zooms over the
//! two pictures of a pair along a smooth seeded path, the same for both sensors.
//!
//! This is how a pack of stills is evaluated as tracking. What such a clip tests is finding the
//! target again in the other sensor while it moves over the frame (camera motion) and changes size
//! by up to [`PseudoOptions::zoom`] either way, between the distractors of a real scene. What it
//! does not test: deformation, occlusion, motion of the target against its background. Gain,
//! offset and noise change from frame to frame, so no two frames are alike.

use std::f64::consts::TAU;
use std::sync::Arc;

use tsda_runtime::{BBox, Modality};

use crate::dataset::{DatasetError, Picture, Sequence};
use crate::rng::{SplitMix, hash_name};

/// How clips are made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PseudoOptions {
    /// Frames per clip.
    pub frames: usize,
    /// Width of a frame in pixels.
    pub width: usize,
    /// Height of a frame in pixels.
    pub height: usize,
    /// The window grows and shrinks by up to this factor around its middle size.
    pub zoom: f64,
    /// Standard deviation of the noise added to every pixel, in grey levels.
    pub noise: f64,
    /// Targets with a side below this are left out, both in the still and in the middle-sized
    /// window: 2-6 px of label error say little about smaller ones.
    pub min_side: f64,
    /// Targets with a side above this share of the smallest window are left out.
    pub max_share: f64,
    /// Everything random follows from this, the still's id and the target's number.
    pub seed: u64,
}

impl Default for PseudoOptions {
    fn default() -> Self {
        Self {
            frames: 60,
            width: 320,
            height: 256,
            zoom: 1.3,
            noise: 3.0,
            min_side: 16.0,
            max_share: 0.8,
            seed: 0,
        }
    }
}

/// The two decoded pictures of a pair, shared by the clips of all its targets.
#[derive(Debug)]
pub struct RegisteredStill {
    id: String,
    rgb: Picture,
    thermal: Picture,
}

impl RegisteredStill {
    /// Two pictures of one size; `rgb` with three channels, `thermal` with one.
    ///
    /// # Errors
    /// When sizes, channels or buffer lengths do not fit.
    pub fn new(id: impl Into<String>, rgb: Picture, thermal: Picture) -> Result<Self, PseudoError> {
        let id = id.into();
        let fits = |p: &Picture, channels: usize| {
            p.channels == channels
                && p.width > 1
                && p.height > 1
                && p.data.len() == p.width * p.height * channels
        };
        if !fits(&rgb, 3)
            || !fits(&thermal, 1)
            || (rgb.width, rgb.height) != (thermal.width, thermal.height)
        {
            return Err(PseudoError::Pictures {
                id,
                rgb: [rgb.width, rgb.height, rgb.channels],
                thermal: [thermal.width, thermal.height, thermal.channels],
            });
        }
        Ok(Self { id, rgb, thermal })
    }

    /// Decodes frame 0 of both sensors of a still.
    ///
    /// # Errors
    /// When a picture cannot be read, or the two do not fit each other.
    pub fn decode(still: &dyn Sequence) -> Result<Self, PseudoError> {
        let rgb = still.picture(0, Modality::Rgb)?;
        let thermal = still.picture(0, Modality::Thermal)?;
        Self::new(still.id(), rgb, thermal)
    }

    fn picture(&self, modality: Modality) -> &Picture {
        match modality {
            Modality::Rgb => &self.rgb,
            Modality::Thermal => &self.thermal,
        }
    }
}

/// A still no clip can be made from.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PseudoError {
    /// A picture could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The two pictures are no registered pair.
    #[error(
        "still {id}: rgb is {rgb:?} and thermal {thermal:?} (width, height, channels); \
         a registered pair has one size of at least 2 x 2, with 3 and 1 channels"
    )]
    Pictures {
        /// The still.
        id: String,
        /// Width, height, channels.
        rgb: [usize; 3],
        /// Width, height, channels.
        thermal: [usize; 3],
    },
    /// A box without area or outside the still.
    #[error("still {id}: target {bbox:?} lies outside the {width} x {height} picture or is empty")]
    Target {
        /// The still.
        id: String,
        /// The box.
        bbox: BBox,
        /// Width of the still.
        width: usize,
        /// Height of the still.
        height: usize,
    },
    /// Options out of range.
    #[error("option {field} = {value}: expected {want}")]
    Option {
        /// The option.
        field: &'static str,
        /// Its value.
        value: f64,
        /// What it may be.
        want: &'static str,
    },
}

impl PseudoOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// Names the first one out of range.
    pub fn validate(&self) -> Result<(), PseudoError> {
        let check = |field, value: f64, low: f64, high: f64, want| {
            if value.is_finite() && (low..=high).contains(&value) {
                Ok(())
            } else {
                Err(PseudoError::Option { field, value, want })
            }
        };
        check("frames", self.frames as f64, 1.0, 1e6, "1 to 1000000")?;
        check("width", self.width as f64, 16.0, 4096.0, "16 to 4096")?;
        check("height", self.height as f64, 16.0, 4096.0, "16 to 4096")?;
        check("zoom", self.zoom, 1.0, 2.0, "1 to 2")?;
        check("noise", self.noise, 0.0, 64.0, "0 to 64")?;
        check("min_side", self.min_side, 1.0, 1e6, "at least 1")?;
        check("max_share", self.max_share, 0.01, 1.0, "0.01 to 1")
    }

    /// Pixels of the still per pixel of a frame, at the middle size of the window: the largest
    /// window just fits the still, with 5 % to spare.
    fn middle_zoom(&self, width: usize, height: usize) -> f64 {
        let fit = (width as f64 / self.width as f64).min(height as f64 / self.height as f64);
        fit / (self.zoom * 1.05)
    }

    /// Is a target of this size worth a clip?
    fn takes(&self, bbox: BBox, width: usize, height: usize) -> bool {
        let zoom = self.middle_zoom(width, height);
        let (w, h) = (f64::from(bbox.w), f64::from(bbox.h));
        let smallest = zoom / self.zoom;
        let side = w.min(h);
        side >= self.min_side
            && side / zoom >= self.min_side
            && w <= self.max_share * smallest * self.width as f64
            && h <= self.max_share * smallest * self.height as f64
    }
}

/// A smooth curve through `[0, 1]`: two sines of seeded phase, rate and share.
#[derive(Clone, Copy, Debug)]
struct Wave {
    rates: [f64; 2],
    phases: [f64; 2],
    share: f64,
}

impl Wave {
    fn seeded(rng: &mut SplitMix) -> Self {
        let mut wave = |low, high| rng.uniform(low, high);
        Self {
            rates: [wave(0.5, 1.2), wave(1.2, 2.0)],
            phases: [wave(0.0, TAU), wave(0.0, TAU)],
            share: wave(0.6, 0.8),
        }
    }

    /// Value at `t`; one unit of `t` is one round of a wave of rate 1.
    fn at(&self, t: f64) -> f64 {
        let sine = |i: usize| (TAU * self.rates[i] * t + self.phases[i]).sin();
        0.5 + 0.5 * (self.share * sine(0) + (1.0 - self.share) * sine(1))
    }
}

/// One clip: 60 frames (by default) of both sensors around one target of a still.
#[derive(Clone, Debug)]
pub struct PseudoClip {
    id: String,
    still: Arc<RegisteredStill>,
    target: BBox,
    options: PseudoOptions,
    seed: u64,
    pan: [Wave; 2],
    zoom: Wave,
    gain: [Wave; 2],
    offset: [Wave; 2],
}

/// The part of the still that one frame shows.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Window {
    left: f64,
    top: f64,
    /// Pixels of the still per pixel of the frame.
    zoom: f64,
}

/// Frames per unit of a [`Wave`]; fixed, so that longer clips are longer, not slower.
const PERIOD: f64 = 60.0;
/// Share of the window that is kept free between target and edge, where there is room.
const MARGIN: f64 = 0.04;

impl PseudoClip {
    /// A clip of the target `bbox` (pixels of the still); `number` tells targets of one still
    /// apart in the id and in the seed.
    ///
    /// # Errors
    /// When an option is out of range or the box is not in the still. Size limits of the options
    /// are not applied here, only by [`clips`].
    pub fn new(
        still: Arc<RegisteredStill>,
        number: usize,
        bbox: BBox,
        options: PseudoOptions,
    ) -> Result<Self, PseudoError> {
        options.validate()?;
        let (width, height) = (still.rgb.width, still.rgb.height);
        if !bbox.is_valid() || !bbox.overlaps_image(width, height) {
            return Err(PseudoError::Target { id: still.id.clone(), bbox, width, height });
        }
        let seed = SplitMix::new(&[options.seed, hash_name(&still.id), number as u64]).next_u64();
        let mut rng = SplitMix::new(&[seed]);
        let mut wave = || Wave::seeded(&mut rng);
        Ok(Self {
            id: format!("{}.{number}", still.id),
            pan: [wave(), wave()],
            zoom: wave(),
            gain: [wave(), wave()],
            offset: [wave(), wave()],
            still,
            target: bbox,
            options,
            seed,
        })
    }

    fn window(&self, frame: usize) -> Window {
        let o = &self.options;
        let (width, height) = (self.still.rgb.width as f64, self.still.rgb.height as f64);
        let t = frame as f64 / PERIOD;
        let middle = o.middle_zoom(self.still.rgb.width, self.still.rgb.height);
        let zoom = middle * o.zoom.powf(2.0 * self.zoom.at(t) - 1.0);
        let place = |position: f64, low: f32, size: f32, window: f64, whole: f64| {
            // Where the window may begin: inside the still, target inside the window. The two can
            // exclude each other (target at the still's edge); then the still wins.
            let (low, size) = (f64::from(low), f64::from(size));
            let from = (low + size - (1.0 - MARGIN) * window).max(0.0);
            let to = (low - MARGIN * window).min(whole - window);
            let begin = if from <= to { from + position * (to - from) } else { (from + to) / 2.0 };
            begin.clamp(0.0, whole - window)
        };
        let b = self.target;
        Window {
            left: place(self.pan[0].at(t), b.x, b.w, zoom * o.width as f64, width),
            top: place(self.pan[1].at(t), b.y, b.h, zoom * o.height as f64, height),
            zoom,
        }
    }
}

impl Sequence for PseudoClip {
    fn id(&self) -> &str {
        &self.id
    }

    fn frames(&self) -> usize {
        self.options.frames
    }

    fn modalities(&self) -> &[Modality] {
        &[Modality::Rgb, Modality::Thermal]
    }

    fn targets(&self) -> usize {
        1
    }

    fn truth(&self, target: usize, frame: usize, _modality: Modality) -> Option<BBox> {
        if target != 0 || frame >= self.options.frames {
            return None;
        }
        let Window { left, top, zoom } = self.window(frame);
        let b = self.target;
        Some(BBox::new(
            ((f64::from(b.x) - left) / zoom) as f32,
            ((f64::from(b.y) - top) / zoom) as f32,
            (f64::from(b.w) / zoom) as f32,
            (f64::from(b.h) / zoom) as f32,
        ))
    }

    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        if frame >= self.options.frames {
            return Err(DatasetError::NoSuchFrame { sequence: self.id.clone(), frame, modality });
        }
        let (o, window) = (&self.options, self.window(frame));
        let sensor = modality as usize;
        let t = frame as f64 / PERIOD;
        let gain = 0.9 + 0.2 * self.gain[sensor].at(t);
        let offset = 16.0 * self.offset[sensor].at(t) - 8.0;
        let mut noise = SplitMix::new(&[self.seed, frame as u64, 1 + sensor as u64]);
        let source = self.still.picture(modality);
        // Pixel centres: frame pixel i covers [i, i + 1), its centre is i + 0.5.
        let axis = |n: usize, begin: f64, limit: usize| -> Vec<(usize, usize, f32)> {
            (0..n)
                .map(|i| {
                    let at = begin + (i as f64 + 0.5) * window.zoom - 0.5;
                    let at = at.clamp(0.0, (limit - 1) as f64);
                    let low = at.floor() as usize;
                    (low, (low + 1).min(limit - 1), (at - low as f64) as f32)
                })
                .collect()
        };
        let columns = axis(o.width, window.left, source.width);
        let rows = axis(o.height, window.top, source.height);
        let c = source.channels;
        let (gain, offset, sigma) = (gain as f32, offset as f32, o.noise as f32);
        let mut data = Vec::with_capacity(o.width * o.height * c);
        for &(y0, y1, fy) in &rows {
            let (upper, lower) = (y0 * source.width, y1 * source.width);
            for &(x0, x1, fx) in &columns {
                for k in 0..c {
                    let value = |row: usize, x: usize| f32::from(source.data[(row + x) * c + k]);
                    let above = value(upper, x0) * (1.0 - fx) + value(upper, x1) * fx;
                    let below = value(lower, x0) * (1.0 - fx) + value(lower, x1) * fx;
                    let clean = above * (1.0 - fy) + below * fy;
                    let value = gain * clean + offset + sigma * bell(noise.next_u64());
                    data.push((value + 0.5).clamp(0.0, 255.0) as u8);
                }
            }
        }
        Ok(Picture { width: o.width, height: o.height, channels: c, data })
    }
}

/// Roughly normal with unit deviation: the sum of four uniform 16-bit parts.
fn bell(bits: u64) -> f32 {
    let sum: u32 = (0..4).map(|i| (bits >> (16 * i)) as u32 & 0xFFFF).sum();
    // Mean 2 and variance 4/12 in units of 65536.
    (sum as f32 / 65536.0 - 2.0) * 1.732
}

/// What [`clips`] made of a pack of stills.
#[derive(Debug, Default)]
pub struct Clips {
    /// One per target, in the order of the stills.
    pub clips: Vec<PseudoClip>,
    /// Stills that no clip can be made from: pictures that cannot be read or are no registered pair.
    pub broken: Vec<PseudoError>,
}

/// One clip for every target of the stills that passes the size limits of `options`, in order.
/// Stills without such a target are passed over and not decoded; what is wrong with a still is
/// listed and the others go on.
///
/// # Errors
/// When an option is out of range.
pub fn clips<'a>(
    stills: impl IntoIterator<Item = &'a dyn Sequence>,
    options: PseudoOptions,
) -> Result<Clips, PseudoError> {
    options.validate()?;
    let mut made = Clips::default();
    for still in stills {
        let boxes: Vec<(usize, BBox)> = (0..still.targets())
            .filter_map(|n| Some((n, still.truth(n, 0, Modality::Rgb)?)))
            .filter(|(_, b)| f64::from(b.w.min(b.h)) >= options.min_side)
            .collect();
        if boxes.is_empty() {
            continue;
        }
        let still = match RegisteredStill::decode(still) {
            Ok(still) => Arc::new(still),
            Err(e) => {
                made.broken.push(e);
                continue;
            }
        };
        let (width, height) = (still.rgb.width, still.rgb.height);
        for (number, bbox) in boxes.into_iter().filter(|(_, b)| options.takes(*b, width, height)) {
            match PseudoClip::new(still.clone(), number, bbox, options) {
                Ok(clip) => made.clips.push(clip),
                Err(e) => made.broken.push(e),
            }
        }
    }
    Ok(made)
}

#[cfg(test)]
#[path = "pseudo_tests.rs"]
mod tests;
