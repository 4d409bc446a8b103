//! The probe: reference outputs of the trainer's own network, stored in the bundle, against which
//! every engine on every board can be checked.
//!
//! The inputs are not stored: they are made from a recipe ([`recipe_image`]). Images `0..T` are the
//! crops of `T` templates, image `T` is the search crop. The expected outputs are the two maps of
//! `predict` with the first `k` slots filled, for `k = 1..=T`.
//!
//! Layout of the section, all little endian:
//!
//! ```text
//! 0           4 bytes       "PRB1"
//! 4           u32           T, number of templates
//! 8           u32           F, side of the maps
//! 12          T * 4 f32     boxes of the templates, x, y, w, h in crop pixels
//! then for k = 1..=T:
//!             F * F f32     scores, row-major
//!             4 * F * F f32 ltrb, edge by edge, row-major
//! ```

#[cfg(feature = "std")]
mod timing;

use crate::engine::{Engine, EngineError};
use crate::geometry::BBox;
pub use crate::labels::template_maps;
use crate::spec::{MAX_TEMPLATES, ModelSpec};
#[cfg(feature = "std")]
pub use timing::{StageTime, stage_times};

/// First bytes of the section.
const MAGIC: [u8; 4] = *b"PRB1";
/// Bytes before the boxes.
const HEADER: usize = 12;

/// A probe section that cannot be read or run.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[expect(clippy::large_enum_variant, reason = "an engine's message is inside, there is no heap")]
pub enum ProbeError {
    /// The section does not start as a probe does.
    #[error("probe section: unknown signature; export the bundle again")]
    Signature,
    /// The section is for another network.
    #[error(
        "probe section: {field} is {found}, the specification says {want}; export the bundle again"
    )]
    Shape {
        /// What differs.
        field: &'static str,
        /// In the section.
        found: usize,
        /// In the specification.
        want: usize,
    },
    /// The section has the wrong length.
    #[error("probe section has {len} bytes, {needed} are needed; export the bundle again")]
    Length {
        /// Bytes given.
        len: usize,
        /// Bytes needed.
        needed: usize,
    },
    /// A stored number is not finite or a box is empty.
    #[error("probe section: {0} is not usable; export the bundle again")]
    Value(&'static str),
    /// The engine's maps or buffers have another size than its specification says.
    #[error("engine {engine}: {what} has {len} numbers, the specification needs {needed}")]
    Engine {
        /// Name of the engine.
        engine: &'static str,
        /// Which buffer.
        what: &'static str,
        /// Its length.
        len: usize,
        /// The length it should have.
        needed: usize,
    },
    /// The engine failed.
    #[error(transparent)]
    Run(#[from] EngineError),
}

/// A probe section, checked against a specification.
#[derive(Clone, Copy, Debug)]
pub struct Probe<'a> {
    bytes: &'a [u8],
    templates: usize,
    cells: usize,
}

impl<'a> Probe<'a> {
    /// Reads the section of a bundle for the network `spec`.
    ///
    /// # Errors
    /// When the section is damaged or made for another network.
    pub fn parse(bytes: &'a [u8], spec: &ModelSpec) -> Result<Self, ProbeError> {
        let short = ProbeError::Length { len: bytes.len(), needed: HEADER };
        let (header, _) = bytes.split_first_chunk::<HEADER>().ok_or(short)?;
        if header[..4] != MAGIC {
            return Err(ProbeError::Signature);
        }
        let word = |i: usize| {
            u32::from_le_bytes([header[i], header[i + 1], header[i + 2], header[i + 3]]) as usize
        };
        for (field, found, want) in [
            ("number of templates", word(4), usize::from(spec.templates)),
            ("side of the maps", word(8), spec.map_side()),
        ] {
            if found != want {
                return Err(ProbeError::Shape { field, found, want });
            }
        }
        let probe = Self { bytes, templates: word(4), cells: spec.cells() };
        let needed = probe.block(probe.templates + 1);
        if bytes.len() != needed {
            return Err(ProbeError::Length { len: bytes.len(), needed });
        }
        if !probe.floats(HEADER, (needed - HEADER) / 4).all(f32::is_finite) {
            return Err(ProbeError::Value("a number"));
        }
        if !(0..probe.templates).all(|i| probe.bbox(i).is_some_and(|b| b.is_valid())) {
            return Err(ProbeError::Value("a template box"));
        }
        Ok(probe)
    }

    /// Number of templates `T`.
    pub const fn templates(&self) -> usize {
        self.templates
    }

    /// Box of a template in crop pixels.
    pub fn bbox(&self, template: usize) -> Option<BBox> {
        if template >= self.templates {
            return None;
        }
        let mut v = self.floats(HEADER + 16 * template, 4);
        Some(BBox::new(v.next()?, v.next()?, v.next()?, v.next()?))
    }

    /// Expected scores `(F, F)` with the first `filled` slots (1-based count) filled.
    pub fn scores(&self, filled: usize) -> impl Iterator<Item = f32> + 'a {
        self.floats(self.block(filled), self.cells)
    }

    /// Expected ltrb map `(4, F, F)` with the first `filled` slots filled.
    pub fn ltrb(&self, filled: usize) -> impl Iterator<Item = f32> + 'a {
        self.floats(self.block(filled) + 4 * self.cells, 4 * self.cells)
    }

    /// Start of the outputs for this many filled slots.
    const fn block(&self, filled: usize) -> usize {
        HEADER + 16 * self.templates + filled.saturating_sub(1) * 20 * self.cells
    }

    fn floats(&self, start: usize, count: usize) -> impl Iterator<Item = f32> + 'a {
        let body = self.bytes.get(start..start + 4 * count).unwrap_or_default();
        body.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
    }
}

/// Differences for one number of filled slots.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ProbeDiff {
    /// Slots filled.
    pub templates: usize,
    /// Maximum absolute difference over the score map.
    pub scores: f32,
    /// Maximum absolute difference over the ltrb map, units of the crop side.
    pub ltrb: f32,
}

/// What [`run`] measured, one entry per number of filled slots.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ProbeReport {
    /// In order of filled slots.
    pub diffs: heapless::Vec<ProbeDiff, MAX_TEMPLATES>,
}

impl ProbeReport {
    /// Largest absolute difference of all; infinite when an output was not a number.
    pub fn max(&self) -> f32 {
        self.diffs.iter().fold(0.0, |m: f32, d| m.max(d.scores).max(d.ltrb))
    }
}

/// Drives an engine through the probe's inputs and compares its maps with the stored ones.
///
/// # Errors
/// When the engine fails or its buffers do not fit its specification. Large differences are no
/// error: the report tells.
pub fn run<E: Engine>(engine: &mut E, probe: &Probe<'_>) -> Result<ProbeReport, ProbeError> {
    let mut report = ProbeReport::default();
    drive(
        engine,
        probe.templates,
        |i| probe.bbox(i).unwrap_or_default(),
        |filled, scores, ltrb| {
            // One entry per slot, and `parse` bounds the slots by the specification.
            let _ = report.diffs.push(ProbeDiff {
                templates: filled,
                scores: max_difference(scores, probe.scores(filled)),
                ltrb: max_difference(ltrb, probe.ltrb(filled)),
            });
        },
    )?;
    Ok(report)
}

fn max_difference(found: &[f32], want: impl Iterator<Item = f32>) -> f32 {
    found.iter().zip(want).fold(0.0, |max, (a, b)| {
        let d = (a - b).abs();
        if d.is_nan() { f32::INFINITY } else { d.max(max) }
    })
}

/// Fills all template slots from the recipe, then calls `each(filled, scores, ltrb)` for every
/// number of filled slots.
fn drive<E: Engine>(
    engine: &mut E,
    templates: usize,
    bbox: impl Fn(usize) -> BBox,
    mut each: impl FnMut(usize, &[f32], &[f32]),
) -> Result<(), ProbeError> {
    let (spec, name) = (*engine.spec(), engine.name());
    let fits = |what, len, needed| {
        if len == needed {
            Ok(())
        } else {
            Err(ProbeError::Engine { engine: name, what, len, needed })
        }
    };
    for i in 0..=templates {
        let crop = engine.crop_mut();
        fits("crop", crop.len(), spec.crop_len())?;
        crop_input(&spec, i, crop);
        engine.features()?;
        if i < templates {
            let input = engine.template_input_mut();
            fits("template label", input.label.len(), spec.cells())?;
            fits("template ltrb", input.ltrb.len(), 4 * spec.cells())?;
            template_maps(&spec, &bbox(i), input.label, input.ltrb);
            engine.write_template(i)?;
        }
    }
    for filled in 1..=templates {
        let maps = engine.predict(filled)?;
        fits("score map", maps.scores.len(), spec.cells())?;
        fits("ltrb map", maps.ltrb.len(), 4 * spec.cells())?;
        each(filled, maps.scores, maps.ltrb);
    }
    Ok(())
}

/// Boxes for a new probe: near the middle of the crop, of the size a target has there, no two
/// alike and none on the cell grid.
pub fn default_boxes(spec: &ModelSpec) -> heapless::Vec<BBox, MAX_TEMPLATES> {
    let side = f32::from(spec.crop);
    let target = side / spec.search_factor;
    (0..usize::from(spec.templates).min(MAX_TEMPLATES))
        .map(|i| {
            let i = i as f32;
            let (w, h) = (target * (0.9 + 0.07 * i), target * (1.1 - 0.05 * i));
            BBox::new(0.5 * (side - w) + 3.3 * i + 0.7, 0.5 * (side - h) - 2.1 * i - 0.4, w, h)
        })
        .collect()
}

/// Writes recipe image `index` as a network input `(3, S, S)`: bytes of [`recipe_byte`], divided by
/// 255 and normalised with the specification's mean and deviation.
pub fn crop_input(spec: &ModelSpec, index: usize, out: &mut [f32]) {
    let (side, seed) = (spec.crop_side(), recipe_seed(index));
    for (c, plane) in out.chunks_exact_mut((side * side).max(1)).take(3).enumerate() {
        let (mean, std) = (spec.input_mean[c], spec.input_std[c]);
        for (y, row) in plane.chunks_exact_mut(side).enumerate() {
            for (x, value) in row.iter_mut().enumerate() {
                let byte = recipe_byte(seed, index, side, side, c, y, x);
                *value = (f32::from(byte) / 255.0 - mean) / std;
            }
        }
    }
}

/// Writes recipe image `index` as packed RGB, `height * width * 3` bytes.
pub fn recipe_image(index: usize, width: usize, height: usize, out: &mut [u8]) {
    let seed = recipe_seed(index);
    for (i, value) in out.iter_mut().take(width * height * 3).enumerate() {
        let (pixel, c) = (i / 3, i % 3);
        *value = recipe_byte(seed, index, width, height, c, pixel / width, pixel % width);
    }
}

/// Hash of the name `image.<index>` (FNV-1a, 64 bits): where the image's noise starts.
pub fn recipe_seed(index: usize) -> u64 {
    let mut digits = heapless::String::<20>::new();
    // 20 digits hold every u64.
    let _ = core::fmt::Write::write_fmt(&mut digits, format_args!("{index}"));
    "image.".bytes().chain(digits.bytes()).fold(0xcbf2_9ce4_8422_2325, |h: u64, b| {
        (h ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

/// One byte of a recipe image: two triangle waves plus noise of 0 to 63 (SplitMix64).
pub fn recipe_byte(
    seed: u64,
    index: usize,
    width: usize,
    height: usize,
    channel: usize,
    y: usize,
    x: usize,
) -> u8 {
    let triangle = |t: usize, p: usize| (t % (2 * p)).abs_diff(p);
    let i = ((channel * height + y) * width + x) as u64;
    let mut z = seed.wrapping_add((i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^= z >> 31;
    let value = triangle(3 * x + 5 * y + 40 * channel + 31 * index, 128)
        + triangle(x + 2 * y + 17 * index, 64)
        + (z >> 58) as usize;
    value.min(255) as u8
}

/// Runs an engine (the trainer's own network) over the probe's inputs and writes the section.
///
/// # Errors
/// When the engine fails, there is not one box per template, or an output is not finite.
#[cfg(feature = "std")]
pub fn capture<E: Engine>(engine: &mut E, boxes: &[BBox]) -> Result<Vec<u8>, ProbeError> {
    let mut outputs = Vec::new();
    let bbox = |i: usize| boxes.get(i).copied().unwrap_or_default();
    let templates = usize::from(engine.spec().templates);
    if boxes.len() == templates {
        drive(engine, templates, bbox, |_, scores, ltrb| {
            outputs.push((scores.to_vec(), ltrb.to_vec()));
        })?;
    }
    encode(engine.spec(), boxes, &outputs)
}

/// Writes the section: `boxes` of all templates in crop pixels, `outputs[k - 1]` the score map
/// `(F, F)` and the ltrb map `(4, F, F)` with the first `k` slots filled.
///
/// # Errors
/// When counts or lengths do not fit `spec`, or a number is not finite.
#[cfg(feature = "std")]
pub fn encode(
    spec: &ModelSpec,
    boxes: &[BBox],
    outputs: &[(Vec<f32>, Vec<f32>)],
) -> Result<Vec<u8>, ProbeError> {
    let want = usize::from(spec.templates);
    let shape = |field, found, want| {
        if found == want { Ok(()) } else { Err(ProbeError::Shape { field, found, want }) }
    };
    shape("number of boxes", boxes.len(), want)?;
    shape("number of outputs", outputs.len(), want)?;
    let mut bytes = MAGIC.to_vec();
    bytes.extend(u32::from(spec.templates).to_le_bytes());
    bytes.extend((spec.map_side() as u32).to_le_bytes());
    bytes.extend(boxes.iter().flat_map(|b| [b.x, b.y, b.w, b.h]).flat_map(f32::to_le_bytes));
    for (scores, ltrb) in outputs {
        shape("length of a score map", scores.len(), spec.cells())?;
        shape("length of an ltrb map", ltrb.len(), 4 * spec.cells())?;
        bytes.extend(scores.iter().chain(ltrb).flat_map(|v| v.to_le_bytes()));
    }
    Probe::parse(&bytes, spec)?;
    Ok(bytes)
}

#[cfg(all(test, feature = "std"))]
mod tests;
