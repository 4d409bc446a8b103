//! From drawn frames to network input (spec 2.2 to 2.4).
//!
//! Order, for one sample: one draw for all frames (grey or channel mixture, whole-picture mirror,
//! polarity, a shift of the sensor between templates and search); then for every crop on its own: jitter, cut, (search crop) target covered, distractor
//! and occluder, window, tone curve, smear, blur and noise, brightness, mirror, normalisation. Labels
//! are made from the box in crop pixels.
//!
//! Everything random of a sample comes from one ChaCha8 stream keyed by `(seed, index)`
//! ([`sample_rng`]), so a batch depends on nothing but the seed and its step.

mod augment;
mod batch;
mod crop;
mod paste;
mod sheet;

pub use batch::{Batch, BatchMaker};
pub use crop::{CropRule, CropWindow, jittered};
pub use sheet::contact_sheet;

use crate::config::{JitterConfig, PhotometricConfig, ProcessingConfig};
use crate::sampler::{Absence, Drawn, DrawnFrame};
use augment::{Pixels, SensorShift};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use tsda_runtime::{BBox, Modality, ModelSpec};

/// One crop, ready for the network.
#[derive(Clone, Debug)]
pub struct Crop {
    /// `(3, S, S)` normalised, R, G, B planes.
    pub pixels: Vec<f32>,
    /// Target in crop pixels, continuous edges.
    pub bbox: BBox,
    /// Sensor it came from.
    pub modality: Modality,
}

/// One sample, ready for the network.
#[derive(Clone, Debug)]
pub struct Sample {
    /// Name for logs.
    pub id: String,
    /// Template crops.
    pub templates: Vec<Crop>,
    /// Search crop.
    pub search: Crop,
    /// Does the search crop come from another sensor?
    pub cross: bool,
    /// Does the search crop show the target? Where not, its box is where something else is.
    pub present: bool,
}

impl Sample {
    /// Are the templates thermal?
    pub fn is_thermal(&self) -> bool {
        self.templates.first().is_some_and(|t| t.modality == Modality::Thermal)
    }
}

/// The random stream of one sample.
pub fn sample_rng(seed: u64, index: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(index);
    rng
}

/// Cells whose centre lies strictly inside the box and less than one stride from the box's centre
/// along both axes (spec 2.4, radius 1): where the box loss is taken. `bbox` in crop pixels.
pub fn sample_region(spec: &ModelSpec, bbox: &BBox) -> Vec<bool> {
    region_of_radius(spec, bbox, 1.0)
}

/// [`sample_region`] within another distance of the box's centre, in strides; 0 is no limit: all
/// cells inside the box (spec 2.4).
pub fn region_of_radius(spec: &ModelSpec, bbox: &BBox, radius: f32) -> Vec<bool> {
    let side = spec.map_side();
    let reach = if radius > 0.0 { radius * ModelSpec::STRIDE as f32 } else { f32::INFINITY };
    let (cx, cy) = bbox.centre();
    let inside = |at: f32, low: f32, high: f32, centre: f32| {
        at > low.max(centre - reach) && at < high.min(centre + reach)
    };
    (0..side * side)
        .map(|i| {
            let x = tsda_runtime::labels::cell_centre(i % side);
            let y = tsda_runtime::labels::cell_centre(i / side);
            inside(x, bbox.x, bbox.right(), cx) && inside(y, bbox.y, bbox.bottom(), cy)
        })
        .collect()
}

/// Box of a picture `width` wide after mirroring it left to right, as the reference does it: one
/// pixel left of the edge-aligned place (spec 2.2).
fn flip_box(bbox: &BBox, width: usize) -> BBox {
    BBox { x: (width as f32 - 1.0) - bbox.right(), ..*bbox }
}

/// What one draw decides for the whole sample.
#[derive(Clone)]
struct Joint {
    /// Weights of R, G, B where RGB pictures turn into one channel.
    grey: Option<[f32; 3]>,
    mirror: bool,
    invert_rgb: bool,
    invert_thermal: bool,
    /// Shows these crops as another sensor might.
    shift: Option<SensorShift>,
}

/// What is pasted into a search crop.
struct Others<'a> {
    distractor: Option<&'a DrawnFrame>,
    occluder: Option<&'a DrawnFrame>,
    /// Is the target to be covered by what lies beside it?
    covered: bool,
}

/// Turns drawn frames into crops.
#[derive(Clone, Debug)]
pub struct Processor {
    spec: ModelSpec,
    config: ProcessingConfig,
    augment: bool,
}

impl Processor {
    /// A processor for training (`augment`) or validation, which keeps the jitter of crops but
    /// changes no grey values and mirrors nothing.
    pub fn new(spec: &ModelSpec, config: &ProcessingConfig, augment: bool) -> Self {
        Self { spec: *spec, config: config.clone(), augment }
    }

    /// The network the crops are for.
    pub fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    /// Crops of one sample.
    pub fn process(&self, drawn: &Drawn, rng: &mut impl Rng) -> Sample {
        let config = &self.config;
        let mut chance = |p: f64| rng.random_bool(p) && self.augment;
        let mut joint = Joint {
            grey: chance(config.grayscale_p).then_some(augment::LUMA),
            mirror: chance(config.joint_flip_p),
            invert_rgb: chance(config.rgb.invert_p),
            invert_thermal: chance(config.thermal.invert_p),
            shift: None,
        };
        if self.augment && config.channel_mix_p > 0.0 && rng.random_bool(config.channel_mix_p) {
            joint.grey = Some(augment::channel_mix(rng));
        }
        let (mut for_templates, mut for_search) = (joint.clone(), joint);
        let one_sensor = !drawn.is_cross() && self.augment && config.sensor_shift_p > 0.0;
        if one_sensor && rng.random_bool(config.sensor_shift_p) {
            let side = if rng.random() { &mut for_templates } else { &mut for_search };
            side.shift = Some(SensorShift::draw(rng));
        }
        let nothing = Others { distractor: None, occluder: None, covered: false };
        let templates = drawn
            .templates
            .iter()
            .map(|f| self.crop(f, &config.template, &for_templates, &nothing, rng).0)
            .collect();
        let absence = drawn.absence.as_ref().filter(|_| self.augment);
        let others = Others {
            distractor: drawn.distractor.as_ref(),
            occluder: drawn.occluder.as_ref(),
            covered: matches!(absence, Some(Absence::Covered)),
        };
        let others = if self.augment { others } else { nothing };
        let (frame, elsewhere) = match absence {
            Some(Absence::Another(frame)) => (frame, true),
            _ => (&drawn.search, false),
        };
        let (search, covered) = self.crop(frame, &config.search, &for_search, &others, rng);
        let present = !elsewhere && !covered;
        Sample { id: drawn.id.clone(), templates, search, cross: drawn.is_cross(), present }
    }

    /// The crop, and whether the target in it is covered.
    fn crop(
        &self,
        frame: &DrawnFrame,
        jitter: &JitterConfig,
        joint: &Joint,
        others: &Others<'_>,
        rng: &mut impl Rng,
    ) -> (Crop, bool) {
        let (config, side) = (&self.config, self.spec.crop_side());
        let picture = frame.picture.as_ref();
        let bbox = if joint.mirror { flip_box(&frame.bbox, picture.width) } else { frame.bbox };
        let around = jittered(&bbox, jitter, rng);
        let normal: f32 = StandardNormal.sample(rng);
        let rule = CropRule {
            search_factor: self.spec.search_factor,
            output: side,
            max_scale_change: config.max_scale_change,
            stretch: jitter.aspect * normal,
        };
        let window = CropWindow::around((picture.width, picture.height), &around, &rule);
        let mut bbox = window.to_crop(&bbox, side);
        let mut pixels = Pixels {
            side,
            channels: picture.channels,
            data: window.cut(picture, side, joint.mirror),
        };
        let covered = others.covered && paste::cover(&mut pixels, &bbox, rng);
        if let Some(other) = others.distractor {
            paste::distractor(&mut pixels, &bbox, other, rng);
        }
        if let Some(other) = others.occluder {
            paste::occluder(&mut pixels, &bbox, &other.picture, config.occluder_side, rng);
        }
        if let Some(weights) = joint.grey {
            pixels = pixels.into_grey(weights);
        }
        if let Some(shift) = &joint.shift {
            pixels = shift.apply(pixels);
        }
        let mut mirror = false;
        let planes = if self.augment {
            let (photometric, invert) = self.photometric(frame.at.modality, joint);
            pixels.window(photometric, rng);
            pixels.tone(photometric, invert, rng);
            let mut planes = pixels.planes();
            augment::degrade(&mut planes, side, photometric, rng);
            let factor = 1.0 + config.brightness * (2.0 * rng.random::<f32>() - 1.0);
            planes.iter_mut().for_each(|v| *v *= factor);
            mirror = rng.random_bool(config.crop_flip_p);
            planes
        } else {
            pixels.planes()
        };
        if mirror {
            bbox = flip_box(&bbox, side);
        }
        let pixels = self.normalise(&planes, mirror);
        (Crop { pixels, bbox, modality: frame.at.modality }, covered)
    }

    fn photometric(&self, modality: Modality, joint: &Joint) -> (&PhotometricConfig, bool) {
        match modality {
            Modality::Rgb => (&self.config.rgb, joint.invert_rgb),
            Modality::Thermal => (&self.config.thermal, joint.invert_thermal),
        }
    }

    /// One or three planes in 0..255 to three normalised ones.
    fn normalise(&self, planes: &[f32], mirror: bool) -> Vec<f32> {
        let side = self.spec.crop_side();
        let n = side * side;
        let mut out = Vec::with_capacity(3 * n);
        for c in 0..3 {
            let plane = if planes.len() == 3 * n { &planes[c * n..][..n] } else { planes };
            let (mean, inverse) = (self.spec.input_mean[c], 1.0 / self.spec.input_std[c]);
            let one = |v: &f32| ((v / 255.0).clamp(0.0, 1.0) - mean) * inverse;
            for row in plane.chunks_exact(side) {
                if mirror {
                    out.extend(row.iter().rev().map(one));
                } else {
                    out.extend(row.iter().map(one));
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests;
