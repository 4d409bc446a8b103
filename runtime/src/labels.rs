//! What a template frame says about its target: a Gaussian label and the ltrb map (spec 1.4, 2.4,
//! 3.6). Tracker, trainer and probe share these functions.
//!
//! Cells are indexed (row, column); cell `(r, c)` of a map of side `F` has its centre at
//! `(16 c + 8, 16 r + 8)` in crop pixels (x, y).

use crate::geometry::{BBox, Yx};
use crate::spec::ModelSpec;

/// Writes the Gaussian label `(side, side)`, row-major (spec 2.4):
/// `exp(-((r - m - cy)^2 + (c - m - cx)^2) / (2 sigma^2))` with `m = (side - 1) / 2`.
///
/// `centre` is the target's offset from the middle of the map, in cells; `sigma` is in cells too.
/// The peak is not moved to a cell, so the largest value may be below 1. Cells of `out` beyond
/// `side * side` stay as they are.
pub fn gaussian(centre: Yx, sigma: f32, side: usize, out: &mut [f32]) {
    if side == 0 {
        return;
    }
    let middle = (side as f32 - 1.0) * 0.5;
    let inverse = -0.5 / (sigma * sigma);
    let bell = |cell: usize, offset: f32| {
        let d = cell as f32 - middle - offset;
        libm::expf(d * d * inverse)
    };
    for (r, row) in out.chunks_exact_mut(side).take(side).enumerate() {
        let vertical = bell(r, centre.y);
        for (c, value) in row.iter_mut().enumerate() {
            *value = vertical * bell(c, centre.x);
        }
    }
}

/// Offset of a box's centre from the middle of the map, in cells (spec 2.4): the training-side
/// convention with continuous edges. `bbox` is in crop pixels.
pub fn box_centre(spec: &ModelSpec, bbox: &BBox) -> Yx {
    let (x, y) = bbox.centre();
    let side = f32::from(spec.crop);
    let cells = spec.map_side() as f32 / side;
    Yx { y: cells * (y - side * 0.5), x: cells * (x - side * 0.5) }
}

/// Writes the ltrb map `(4, F, F)` of a box in crop pixels (spec 1.4): distances from every cell's
/// centre to the left, top, right and bottom edge in units of the crop side, negative outside.
pub fn ltrb(spec: &ModelSpec, bbox: &BBox, out: &mut [f32]) {
    let (side, crop) = (spec.map_side(), f32::from(spec.crop));
    if side == 0 {
        return;
    }
    let (right, bottom) = (bbox.right(), bbox.bottom());
    for (edge, plane) in out.chunks_exact_mut(side * side).take(4).enumerate() {
        for (r, row) in plane.chunks_exact_mut(side).enumerate() {
            for (c, value) in row.iter_mut().enumerate() {
                let (x, y) = (cell_centre(c), cell_centre(r));
                let distance = match edge {
                    0 => x - bbox.x,
                    1 => y - bbox.y,
                    2 => right - x,
                    _ => bottom - y,
                };
                *value = distance / crop;
            }
        }
    }
}

/// Label and ltrb map of a training or probe template, both from its box in crop pixels.
pub fn template_maps(spec: &ModelSpec, bbox: &BBox, label: &mut [f32], ltrb_out: &mut [f32]) {
    gaussian(box_centre(spec, bbox), spec.label_sigma_cells(), spec.map_side(), label);
    ltrb(spec, bbox, ltrb_out);
}

/// Crop coordinate of the centre of a cell, in pixels along either axis.
pub const fn cell_centre(cell: usize) -> f32 {
    (ModelSpec::STRIDE * cell + ModelSpec::STRIDE / 2) as f32
}

#[cfg(test)]
mod tests;
