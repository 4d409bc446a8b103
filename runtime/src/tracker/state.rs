//! What the tracker knows about its target between frames (spec 3.2).

use crate::crop::Patch;
use crate::geometry::{BBox, Yx};
use crate::localise::{Flag, Located};
use crate::spec::{ModelSpec, TrackerParams};
use serde::{Deserialize, Serialize};

/// How far a box can be relied on.
///
/// | state | when |
/// |---|---|
/// | `Tracking` | found without a rival, and none of the reasons below |
/// | `Uncertain` | found, but a rival is about as likely; or the score is below twice `not_found`; or the target was `Lost` until now and the score is not above `write_confidence` |
/// | `Searching` | not found in this frame, for fewer than `lost_after` frames in a row |
/// | `Lost` | not found for `lost_after` frames in a row or more |
///
/// Templates are kept in every state, so a target that comes back is found again; whoever gives up
/// on `Lost` does so by calling `init` with a new box.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrackState {
    /// The box is the target.
    Tracking,
    /// The box is probably the target.
    Uncertain,
    /// The target is not visible; the box is where it was seen last.
    Searching,
    /// The target has been gone for long.
    Lost,
}

impl TrackState {
    /// Lower-case name, as in logs and JSON.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Tracking => "tracking",
            Self::Uncertain => "uncertain",
            Self::Searching => "searching",
            Self::Lost => "lost",
        }
    }
}

impl core::fmt::Display for TrackState {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.as_str())
    }
}

/// How a frame was searched, for logs, pictures and tests.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Search {
    /// Middle of the search area asked for (pixel centres).
    pub centre: Yx,
    /// Image pixels per crop pixel asked for.
    pub scale: f32,
    /// Corners of the crop that was cut.
    pub patch: Patch,
    /// Middle of the crop that was cut (pixel centres).
    pub sample_pos: Yx,
    /// Image pixels per crop pixel of the crop that was cut.
    pub sample_scale: f32,
    /// What the score map said.
    pub located: Located,
    /// Box at the chosen cell in image pixels.
    pub raw: BBox,
    /// The same, inside the picture and not too small.
    pub clipped: BBox,
}

/// Number of accepted scales that are remembered (spec 3.8).
const SCALES: usize = 60;

/// The target between two frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Target {
    pos: Yx,
    size: Yx,
    scale: f32,
    /// Size of the target in crop pixels at scale 1: its area is the same for every target.
    base: Yx,
    scales: [f32; SCALES],
    /// Accepted scales so far, also those already overwritten.
    accepted: usize,
    /// Frames without the target since `init`; never reset (quirk Q6).
    not_found: u32,
    missing: u32,
    frame: u64,
    state: TrackState,
}

impl Target {
    /// From the annotated box (spec 3.2).
    pub(super) fn new(bbox: &BBox, spec: &ModelSpec) -> Self {
        let scale = spec.search_factor * libm::sqrtf(bbox.w * bbox.h) / f32::from(spec.crop);
        Self {
            pos: position(bbox),
            size: Yx::new(bbox.h, bbox.w),
            scale,
            base: Yx::new(bbox.h / scale, bbox.w / scale),
            scales: [0.0; SCALES],
            accepted: 0,
            not_found: 0,
            missing: 0,
            frame: 0,
            state: TrackState::Tracking,
        }
    }

    /// Position of the centre (pixel-centre coordinates).
    pub const fn pos(&self) -> Yx {
        self.pos
    }

    /// Height (y) and width (x) in image pixels.
    pub const fn size(&self) -> Yx {
        self.size
    }

    /// Image pixels per crop pixel of the next search area.
    pub const fn scale(&self) -> f32 {
        self.scale
    }

    /// Height and width in crop pixels at scale 1.
    pub const fn base(&self) -> Yx {
        self.base
    }

    /// Frames without the target since `init`, in all (quirk Q6).
    pub const fn not_found(&self) -> u32 {
        self.not_found
    }

    /// Frames without the target in a row.
    pub const fn missing(&self) -> u32 {
        self.missing
    }

    /// Number of the last frame, 0 for the annotated one.
    pub const fn frame(&self) -> u64 {
        self.frame
    }

    /// State after the last frame.
    pub const fn state(&self) -> TrackState {
        self.state
    }

    /// The box as reported (spec 3.5, step 8).
    pub fn bbox(&self) -> BBox {
        let Yx { y: h, x: w } = self.size;
        BBox::new(self.pos.x - (w - 1.0) * 0.5, self.pos.y - (h - 1.0) * 0.5, w, h)
    }

    /// Spec 3.5, step 6. The centre is set with plus half the size and reported with minus half of
    /// the size less one (quirk Q5).
    pub(super) fn accept(&mut self, found: &BBox) {
        self.pos = Yx::new(found.y + found.h * 0.5, found.x + found.w * 0.5);
        self.size = Yx::new(found.h, found.w);
        self.scale = self.scale_of(found);
        self.scales[self.accepted % SCALES] = self.scale;
        self.accepted += 1;
    }

    /// Spec 3.8: the next search area may grow, up to the mean of recent larger ones.
    pub(super) fn miss(&mut self) {
        if self.accepted == 0 {
            return;
        }
        self.not_found = self.not_found.saturating_add(1);
        let last = self.newest(0);
        let (mut sum, mut count) = (0.0, 0u32);
        for i in 0..self.accepted.min(SCALES) {
            let scale = self.newest(i);
            if scale >= last && count < self.not_found.clamp(2, 30) {
                sum += scale;
                count += 1;
            }
        }
        // The last one always counts, so there is at least one.
        self.scale = sum / count.max(1) as f32;
    }

    /// Counts the frame and derives the state.
    pub(super) fn step(&mut self, flag: Flag, score: f32, params: &TrackerParams) {
        self.frame += 1;
        let was_lost = self.state == TrackState::Lost;
        self.missing = if flag == Flag::NotFound { self.missing.saturating_add(1) } else { 0 };
        self.state = match flag {
            Flag::NotFound if self.missing >= params.lost_after.into() => TrackState::Lost,
            Flag::NotFound => TrackState::Searching,
            Flag::Uncertain => TrackState::Uncertain,
            _ if score < 2.0 * params.not_found => TrackState::Uncertain,
            _ if was_lost && score <= params.write_confidence => TrackState::Uncertain,
            _ => TrackState::Tracking,
        };
    }

    /// Moves the target to a box in the convention of [`Self::bbox`]; remembered scales follow.
    pub(super) fn place(&mut self, bbox: &BBox) {
        let old = libm::sqrtf(self.size.y * self.size.x);
        self.pos = position(bbox);
        self.size = Yx::new(bbox.h, bbox.w);
        let ratio = libm::sqrtf(bbox.w * bbox.h) / old;
        self.scale = self.scale_of(bbox);
        for scale in &mut self.scales {
            *scale *= ratio;
        }
    }

    /// The same target at another position (pixel-centre coordinates), with the size and scale it
    /// had.
    pub(super) const fn moved_to(&self, pos: Yx) -> Self {
        Self { pos, ..*self }
    }

    fn scale_of(&self, bbox: &BBox) -> f32 {
        libm::sqrtf(bbox.h * bbox.w / (self.base.y * self.base.x))
    }

    /// Accepted scale `back` acceptances ago.
    fn newest(&self, back: usize) -> f32 {
        self.scales[(self.accepted + SCALES - 1 - back % SCALES) % SCALES]
    }
}

/// Centre of a box in pixel-centre coordinates (spec 3.2).
fn position(bbox: &BBox) -> Yx {
    Yx::new(bbox.y + (bbox.h - 1.0) * 0.5, bbox.x + (bbox.w - 1.0) * 0.5)
}
