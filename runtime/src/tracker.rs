//! The online tracker (spec 3): one target, one frame at a time, no allocation.

mod error;
mod motion;
mod redetect;
mod state;

pub use error::{BoxError, TrackError, check_box};
pub use motion::MotionPrior;
pub use redetect::RedetectOptions;
pub use state::{Search, Target, TrackState};

use crate::bundle::{Manifest, ScoreCalibration};
use crate::crop::{self, Patch, Window, round_half_even};
use crate::engine::{Engine, EngineError};
use crate::frame::FrameView;
use crate::geometry::{BBox, Modality, Yx};
use crate::labels;
use crate::localise::{Cell, Flag, localise_weighted};
use crate::memory::{Template, TemplateMemory};
use crate::spec::{MAX_TEMPLATES, ModelSpec, SpecError, TrackerParams};
use redetect::Scan;

/// What one frame gave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Track {
    /// Target in image pixels. While it is not found, the last box it was seen in.
    pub bbox: BBox,
    /// Highest score of the map: about 1 on the target, about 0 without it; not a probability.
    pub score: f32,
    /// Probability that the box is right, in `[0, 1]`; `None` without [`Tracker::set_calibration`].
    pub confidence: Option<f32>,
    /// How far the box can be relied on.
    pub state: TrackState,
    /// What the score map looked like.
    pub flag: Flag,
    /// Whether this frame became a template.
    pub wrote_memory: bool,
    /// Number of this frame, counted from the annotated frame 0.
    pub frame: u64,
    /// Frames without the target up to and including this one; 0 when it was found.
    pub missing: u32,
    /// Whether the scan of a lost target's frame found it; see [`RedetectOptions`].
    pub redetected: bool,
}

/// A single-object tracker on an engine.
///
/// Everything is allocated before [`Tracker::new`], by the engine; neither [`Tracker::init`] nor
/// [`Tracker::update`] allocates anything of their own.
#[derive(Debug)]
pub struct Tracker<E> {
    engine: E,
    spec: ModelSpec,
    params: TrackerParams,
    memory: TemplateMemory<MAX_TEMPLATES>,
    target: Option<Target>,
    search: Option<Search>,
    calibration: Option<ScoreCalibration>,
    scan: Option<Scan>,
    motion: Option<MotionPrior>,
}

impl<E: Engine> Tracker<E> {
    /// A tracker without a target.
    ///
    /// # Errors
    /// When the engine's specification or `params` are out of range, or the engine's buffers do not
    /// have the sizes the specification asks for.
    pub fn new(mut engine: E, params: TrackerParams) -> Result<Self, TrackError> {
        let spec = *engine.spec();
        spec.validate()?;
        params.validate()?;
        let name = engine.name();
        fits(name, "crop", engine.crop_mut().len(), spec.crop_len())?;
        let input = engine.template_input_mut();
        fits(name, "template label", input.label.len(), spec.cells())?;
        fits(name, "template ltrb", input.ltrb.len(), 4 * spec.cells())?;
        let memory = TemplateMemory::new(spec.templates.into());
        Ok(Self {
            engine,
            spec,
            params,
            memory,
            target: None,
            search: None,
            calibration: None,
            scan: None,
            motion: None,
        })
    }

    /// A tracker as a bundle wants it: with its thresholds, calibration and motion prior.
    ///
    /// # Errors
    /// As [`Self::new`], and when calibration or motion prior are out of range.
    pub fn from_manifest(engine: E, manifest: &Manifest<'_>) -> Result<Self, TrackError> {
        let mut tracker = Self::new(engine, manifest.tracker)?;
        tracker.set_calibration(manifest.calibration)?;
        tracker.set_motion_prior(manifest.motion)?;
        Ok(tracker)
    }

    /// Takes the target from the annotated frame (spec 3.2, 3.3). May be called again at any time
    /// for another target; after an error there is none.
    ///
    /// # Errors
    /// When the box is unusable, lies outside the picture, or the engine fails.
    pub fn init(
        &mut self,
        frame: &FrameView<'_>,
        bbox: BBox,
        modality: Option<Modality>,
    ) -> Result<(), TrackError> {
        check_box(&bbox, frame.width(), frame.height())?;
        self.target = None;
        self.search = None;
        self.memory.clear();
        if let Some(scan) = &mut self.scan {
            scan.restart();
        }

        let target = Target::new(&bbox, &self.spec);
        let pos = target.pos();
        let centre = Yx::new(round_half_even(pos.y), round_half_even(pos.x));
        let window = Window::first(frame, centre, target.scale(), &self.spec)?;
        crop::reference(frame, &window, &self.spec, self.engine.crop_mut())?;
        self.engine.features()?;
        let template = self.template(&target, centre, target.scale(), modality, 1.0);
        self.write(0, &template)?;
        self.memory.record(template);
        self.target = Some(target);
        Ok(())
    }

    /// Finds the target in the next frame (spec 3.5).
    ///
    /// Frames may change format and size from one call to the next. Positions stay in pixels: when
    /// the new picture shows the scene in another place or at another scale, say so first with
    /// [`Self::set_box`].
    ///
    /// # Errors
    /// Before [`Self::init`], when the engine fails, or when the network's answer is not finite. The
    /// tracker then stands where it stood before, and the next frame may be tried.
    pub fn update(
        &mut self,
        frame: &FrameView<'_>,
        modality: Option<Modality>,
    ) -> Result<Track, TrackError> {
        let Some(mut target) = self.target else {
            return Err(TrackError::NoTarget);
        };
        let (mut search, mut score) = self.look(frame, &target, self.motion)?;
        let mut scan = self.scan;
        let mut redetected = false;
        if let Some(scan) = &mut scan {
            if target.state() == TrackState::Lost && search.located.flag == Flag::NotFound {
                if let Some(found) = self.scan_frame(frame, &target, scan)? {
                    (search, score) = found;
                    redetected = true;
                }
            } else {
                scan.restart();
            }
        }
        let flag = search.located.flag;
        if flag == Flag::NotFound {
            target.miss();
        } else {
            target.accept(&search.clipped);
        }
        target.step(flag, score, &self.params);

        // The engine holds the features of the last crop it looked at, which after a scan need not
        // be the one with the target; and a find from afar should prove itself first.
        let learn = !redetected
            && matches!(flag, Flag::Normal | Flag::HardNegative)
            && score > self.params.write_confidence;
        let mut wrote_memory = false;
        if let (true, Some(slot)) = (learn, self.memory.next_slot()) {
            let (pos, scale) = (search.sample_pos, search.sample_scale);
            let template = self.template(&target, pos, scale, modality, score);
            self.write(slot, &template)?;
            wrote_memory = self.memory.record(template).is_some();
        }
        // Nothing can fail any more: what was computed becomes the state.
        self.target = Some(target);
        self.search = Some(search);
        self.scan = scan;
        Ok(Track {
            bbox: target.bbox(),
            score,
            confidence: self.calibration.map(|c| c.probability(score)),
            state: target.state(),
            flag,
            wrote_memory,
            frame: target.frame(),
            missing: target.missing(),
            redetected,
        })
    }

    /// Moves the target, keeping all templates: for a switch to a sensor that sees the scene in
    /// another place or at another scale, or for a correction from outside. `bbox` is in pixels of
    /// the next frame, in the convention of [`Track::bbox`].
    ///
    /// # Errors
    /// Before [`Self::init`], or when the box is unusable.
    pub fn set_box(&mut self, bbox: BBox) -> Result<(), TrackError> {
        let Some(target) = &mut self.target else {
            return Err(TrackError::NoTarget);
        };
        error::check_size(&bbox)?;
        target.place(&bbox);
        Ok(())
    }

    /// Scales the target along when frames change their size, `(width, height)` in pixels: both
    /// sensors are taken to see the same field of view. `last` is the box in the `old` frame.
    ///
    /// # Errors
    /// See [`Self::set_box`].
    pub fn follow_size(
        &mut self,
        last: BBox,
        old: (usize, usize),
        now: (usize, usize),
    ) -> Result<(), TrackError> {
        if old == now {
            return Ok(());
        }
        let (kx, ky) = (now.0 as f32 / old.0 as f32, now.1 as f32 / old.1 as f32);
        self.set_box(BBox::new(last.x * kx, last.y * ky, last.w * kx, last.h * ky))
    }

    /// Looks at the next positions of the grid; the best find above the threshold, if there is one.
    fn scan_frame(
        &mut self,
        frame: &FrameView<'_>,
        target: &Target,
        scan: &mut Scan,
    ) -> Result<Option<(Search, f32)>, TrackError> {
        let threshold = scan.options().threshold;
        let size = target.scale() * f32::from(self.spec.crop);
        let mut best: Option<(Search, f32)> = None;
        for centre in scan.positions((frame.height(), frame.width()), size) {
            let (search, score) = self.look(frame, &target.moved_to(centre), None)?;
            let higher = best.as_ref().is_none_or(|(_, other)| score > *other);
            if search.located.flag != Flag::NotFound && score > threshold && higher {
                best = Some((search, score));
            }
        }
        Ok(best)
    }

    /// Steps 1 to 5 of spec 3.5: crop, network, cell, box. Changes nothing but the engine.
    fn look(
        &mut self,
        frame: &FrameView<'_>,
        target: &Target,
        motion: Option<MotionPrior>,
    ) -> Result<(Search, f32), TrackError> {
        let (spec, params) = (self.spec, self.params);
        let (side, cells) = (f32::from(spec.crop), spec.cells());
        // Cells have a middle one only when their number is odd; with an even number the search
        // area is moved by half a cell so that the target lies on a cell (quirk Q3).
        let shift = if spec.map_side().is_multiple_of(2) {
            0.5 * ModelSpec::STRIDE as f32 * target.scale()
        } else {
            0.0
        };
        let pos = target.pos();
        let centre = Yx::new(pos.y + shift, pos.x + shift);
        let size = target.scale() * side;
        let window = Window::search(frame, centre, size, &spec, params.max_scale_change)?;
        crop::reference(frame, &window, &spec, self.engine.crop_mut())?;
        self.engine.features()?;

        let name = self.engine.name();
        let maps = self.engine.predict(self.memory.filled())?;
        fits(name, "score map", maps.scores.len(), cells)?;
        fits(name, "ltrb map", maps.ltrb.len(), 4 * cells)?;
        if !maps.scores.iter().all(|v| v.is_finite()) {
            return Err(TrackError::NotFinite { engine: name, what: "score map" });
        }
        let patch = window.patch();
        let (sample_pos, sample_scale) = (patch.sample_pos(), patch.sample_scale(side));
        let cell_size = sample_scale * ModelSpec::STRIDE as f32;
        let previous =
            Yx::new((pos.y - sample_pos.y) / cell_size, (pos.x - sample_pos.x) / cell_size);
        let motion = motion.unwrap_or(MotionPrior::OFF);
        let located = localise_weighted(
            maps.scores,
            spec.map_side(),
            &params,
            Yx::new(target.size().y / cell_size, target.size().x / cell_size),
            previous,
            motion.weight(target, spec.map_side(), previous),
        );
        let raw = motion.damp(target, &cell_box(maps.ltrb, located.cell, &patch, &spec));
        let clipped = clip(&raw, frame, params.min_size);
        if !clipped.is_valid() {
            return Err(TrackError::NotFinite { engine: name, what: "ltrb map" });
        }
        let search = Search {
            centre,
            scale: target.scale(),
            patch,
            sample_pos,
            sample_scale,
            located,
            raw,
            clipped,
        };
        Ok((search, located.first.score))
    }

    /// Box and label of a memory sample (spec 3.6) from the crop's position and scale.
    fn template(
        &self,
        target: &Target,
        sample_pos: Yx,
        sample_scale: f32,
        modality: Option<Modality>,
        score: f32,
    ) -> Template {
        let side = f32::from(self.spec.crop);
        let (pos, size) = (target.pos(), target.size());
        let (dy, dx) = (pos.y - sample_pos.y, pos.x - sample_pos.x);
        let middle = (side - 1.0) * 0.5;
        let (h, w) = (size.y / sample_scale, size.x / sample_scale);
        let (y, x) = (dy / sample_scale + middle, dx / sample_scale + middle);
        let map = self.spec.map_side() as f32;
        Template {
            frame: target.frame(),
            modality,
            bbox: BBox::new(x - (w - 1.0) * 0.5, y - (h - 1.0) * 0.5, w, h),
            label_centre: Yx::new(
                map * dy / (sample_scale * side),
                map * dx / (sample_scale * side),
            ),
            score,
        }
    }

    /// Turns the engine's current head feature into the tokens of a slot.
    fn write(&mut self, slot: usize, template: &Template) -> Result<(), EngineError> {
        let (sigma, map) = (self.spec.label_sigma_cells(), self.spec.map_side());
        let input = self.engine.template_input_mut();
        labels::gaussian(template.label_centre, sigma, map, input.label);
        labels::ltrb(&self.spec, &template.bbox, input.ltrb);
        self.engine.write_template(slot)
    }
}

impl<E> Tracker<E> {
    /// Has [`Track::confidence`] computed by this map; the one of the bundle is in its manifest.
    ///
    /// # Errors
    /// When the map is out of range; the old one then stays.
    pub fn set_calibration(
        &mut self,
        calibration: Option<ScoreCalibration>,
    ) -> Result<(), SpecError> {
        if let Some(c) = &calibration {
            c.validate()?;
        }
        self.calibration = calibration;
        Ok(())
    }

    /// The map from score to [`Track::confidence`].
    pub const fn calibration(&self) -> Option<ScoreCalibration> {
        self.calibration
    }

    /// Has the frame scanned for a target that is [`TrackState::Lost`]; `None`, the default, looks
    /// only where it was last seen.
    ///
    /// # Errors
    /// When the options are out of range; the old ones then stay.
    pub fn set_redetection(&mut self, options: Option<RedetectOptions>) -> Result<(), SpecError> {
        if let Some(o) = &options {
            o.validate()?;
        }
        self.scan = options.map(Scan::new);
        Ok(())
    }

    /// How the frame is scanned for a lost target, when it is.
    pub fn redetection(&self) -> Option<RedetectOptions> {
        self.scan.map(|s| s.options())
    }

    /// Has the place and size of the last frame count in the next one; `None`, the default, is the
    /// reference's way.
    ///
    /// # Errors
    /// When the prior is out of range; the old one then stays.
    pub fn set_motion_prior(&mut self, motion: Option<MotionPrior>) -> Result<(), SpecError> {
        if let Some(m) = &motion {
            m.validate()?;
        }
        self.motion = motion;
        Ok(())
    }

    /// What the last frame says about the next one, if anything.
    pub const fn motion_prior(&self) -> Option<MotionPrior> {
        self.motion
    }

    /// Changes the score above which a frame is remembered ([`TrackerParams::write_confidence`]).
    ///
    /// # Errors
    /// When it is negative or not finite; the old one then stays.
    pub fn set_write_confidence(&mut self, score: f32) -> Result<(), SpecError> {
        let params = TrackerParams { write_confidence: score, ..self.params };
        params.validate()?;
        self.params = params;
        Ok(())
    }

    /// The network's shape.
    pub const fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    /// Thresholds in use.
    pub const fn params(&self) -> &TrackerParams {
        &self.params
    }

    /// The target's state; `None` before [`Tracker::init`].
    pub const fn target(&self) -> Option<&Target> {
        self.target.as_ref()
    }

    /// How the last frame was searched; `None` before the first [`Tracker::update`].
    pub const fn last_search(&self) -> Option<&Search> {
        self.search.as_ref()
    }

    /// What the templates were made from.
    pub const fn memory(&self) -> &TemplateMemory<MAX_TEMPLATES> {
        &self.memory
    }

    /// The engine.
    pub const fn engine(&self) -> &E {
        &self.engine
    }

    /// The engine, to be changed. Its template slots belong to the tracker.
    pub const fn engine_mut(&mut self) -> &mut E {
        &mut self.engine
    }

    /// Gives the engine back.
    pub fn into_engine(self) -> E {
        self.engine
    }
}

/// Box of a cell in image pixels (spec 3.5, step 4).
fn cell_box(ltrb: &[f32], cell: Cell, patch: &Patch, spec: &ModelSpec) -> BBox {
    let side = f32::from(spec.crop);
    let at = cell.row * spec.map_side() + cell.col;
    let edge = |e: usize| ltrb.get(e * spec.cells() + at).map_or(f32::NAN, |v| v * side);
    let (x, y) = (labels::cell_centre(cell.col), labels::cell_centre(cell.row));
    let (left, top) = (x - edge(0), y - edge(1));
    let in_crop = BBox::new(left, top, x + edge(2) - left, y + edge(3) - top);
    patch.to_image(&in_crop, side)
}

/// Keeps a box in the picture and no smaller than `min` (spec 3.5, step 5).
fn clip(bbox: &BBox, frame: &FrameView<'_>, min: f32) -> BBox {
    // A side that is not a number must not become one here.
    let axis = |start: f32, length: f32, image: usize| {
        let image = image as f32;
        let low = start.min(image - min).max(0.0);
        let high = (start + length).min(image).max(low + min);
        if start.is_finite() && length.is_finite() { (low, high - low) } else { (low, f32::NAN) }
    };
    let (x, w) = axis(bbox.x, bbox.w, frame.width());
    let (y, h) = axis(bbox.y, bbox.h, frame.height());
    BBox::new(x, y, w, h)
}

fn fits(
    engine: &'static str,
    what: &'static str,
    len: usize,
    needed: usize,
) -> Result<(), TrackError> {
    if len == needed { Ok(()) } else { Err(TrackError::Buffer { engine, what, len, needed }) }
}

#[cfg(test)]
mod tests;
