//! What can go wrong around a tracker.

use crate::crop::CropError;
use crate::engine::EngineError;
use crate::geometry::BBox;
use crate::spec::SpecError;

/// A box no target can be taken from.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum BoxError {
    /// One of the four numbers is NaN or infinite.
    #[error("box x {} y {} w {} h {}: all four numbers must be finite", .0.x, .0.y, .0.w, .0.h)]
    NotFinite(BBox),
    /// A side is zero, negative, or too short to mean anything.
    #[error(
        "box x {} y {} w {} h {} has no area: width and height must be at least {MIN_SIDE} pixels",
        .0.x, .0.y, .0.w, .0.h
    )]
    Empty(BBox),
    /// A side is so long that it cannot be one of a target.
    #[error(
        "box x {} y {} w {} h {}: no side may be longer than {MAX_SIDE} pixels", 
        .0.x, .0.y, .0.w, .0.h
    )]
    TooLarge(BBox),
    /// No part of it lies in the picture.
    #[error(
        "box x {} y {} w {} h {} lies outside the picture of {width} x {height} pixels",
        .bbox.x, .bbox.y, .bbox.w, .bbox.h
    )]
    Outside {
        /// The box.
        bbox: BBox,
        /// Width of the picture.
        width: usize,
        /// Height of the picture.
        height: usize,
    },
}

/// Shortest side of a target, in pixels.
const MIN_SIDE: f32 = 0.1;
/// Longest side of a target, in pixels; far beyond any sensor, and far from overflowing.
const MAX_SIDE: f32 = 1_000_000.0;

/// Checks a box for a picture of this size: finite, with an area, at least partly in the picture.
///
/// # Errors
/// Says which of these it is not.
pub fn check_box(bbox: &BBox, width: usize, height: usize) -> Result<(), BoxError> {
    check_size(bbox)?;
    if bbox.overlaps_image(width, height) {
        Ok(())
    } else {
        Err(BoxError::Outside { bbox: *bbox, width, height })
    }
}

/// The part of [`check_box`] that does not depend on the picture.
pub(super) fn check_size(bbox: &BBox) -> Result<(), BoxError> {
    let BBox { x, y, w, h } = *bbox;
    if ![x, y, w, h].into_iter().all(f32::is_finite) {
        Err(BoxError::NotFinite(*bbox))
    } else if w < MIN_SIDE || h < MIN_SIDE {
        Err(BoxError::Empty(*bbox))
    } else if w > MAX_SIDE || h > MAX_SIDE {
        Err(BoxError::TooLarge(*bbox))
    } else {
        Ok(())
    }
}

/// A frame that could not be tracked.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[expect(clippy::large_enum_variant, reason = "an engine's message is inside, there is no heap")]
pub enum TrackError {
    /// The network's specification or the thresholds are out of range.
    #[error("tracker cannot be built: {0}")]
    Spec(#[from] SpecError),
    /// A buffer of the engine has another size than its specification says.
    #[error("engine {engine}: {what} has {len} numbers, its specification needs {needed}")]
    Buffer {
        /// Name of the engine.
        engine: &'static str,
        /// Which buffer.
        what: &'static str,
        /// Its length.
        len: usize,
        /// The length it should have.
        needed: usize,
    },
    /// The box cannot be used.
    #[error(transparent)]
    Box(#[from] BoxError),
    /// There is no target yet.
    #[error("no target: call init with the first frame and its box before update")]
    NoTarget,
    /// The search area cannot be cut out.
    #[error(transparent)]
    Crop(#[from] CropError),
    /// The engine failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The network answered with NaN or infinity.
    #[error(
        "engine {engine}: the {what} is not finite; run `tsda verify` on the bundle, its weights or \
         this engine's arithmetic are broken"
    )]
    NotFinite {
        /// Name of the engine.
        engine: &'static str,
        /// Which map.
        what: &'static str,
    },
}
