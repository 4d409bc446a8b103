//! Looking over the whole frame for a target that is lost.
//!
//! Search areas of the size the target had last are laid over the picture in a grid with half an
//! area between centres, so that some area has any target in its middle half. A frame looks at a few of
//! them; consecutive looks are far apart, so that a part of the sweep already covers the picture
//! evenly.

use crate::geometry::Yx;
use crate::spec::SpecError;
use serde::{Deserialize, Serialize};

/// How the frame is scanned for a target in state `Lost`.
///
/// The place it was last seen in is always looked at first, as without these options; only when it
/// is not there does the scan go on. Templates are not touched until the target is found, nor in
/// the frame it is found in.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RedetectOptions {
    /// Further search areas looked at per frame: what a frame may cost at most, in network runs.
    pub positions_per_frame: u8,
    /// A find counts only with a score above this; higher than the tracker's own `not_found`,
    /// because a whole frame holds more that resembles the target than its neighbourhood does.
    pub threshold: f32,
}

impl Default for RedetectOptions {
    fn default() -> Self {
        Self { positions_per_frame: 2, threshold: 0.8 }
    }
}

impl RedetectOptions {
    /// Checks both fields.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn validate(&self) -> Result<(), SpecError> {
        if self.positions_per_frame == 0 {
            let (field, want) = ("positions_per_frame", "at least 1");
            return Err(SpecError { field, value: 0.0, want });
        }
        if !(self.threshold.is_finite() && self.threshold >= 0.0) {
            let (field, want) = ("threshold", "a finite number, not negative");
            return Err(SpecError { field, value: self.threshold, want });
        }
        Ok(())
    }
}

/// Where the scan is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Scan {
    options: RedetectOptions,
    /// Looks since the target was lost.
    looks: usize,
}

impl Scan {
    pub(super) const fn new(options: RedetectOptions) -> Self {
        Self { options, looks: 0 }
    }

    pub(super) const fn options(&self) -> RedetectOptions {
        self.options
    }

    /// Begins anew.
    pub(super) const fn restart(&mut self) {
        self.looks = 0;
    }

    /// Centres (pixel-centre coordinates) of the search areas of the next frame: a picture of
    /// `(height, width)` pixels, areas `size` pixels wide. No position comes twice in a frame.
    pub(super) fn positions(
        &mut self,
        (height, width): (usize, usize),
        size: f32,
    ) -> impl Iterator<Item = Yx> + use<> {
        let (rows, columns) = (Axis::new(height, size), Axis::new(width, size));
        let cells = rows.count.saturating_mul(columns.count);
        let looks = cells.min(self.options.positions_per_frame.into());
        // Modulo the number of cells, which follows size and picture and may change between frames.
        let first = self.looks % cells;
        self.looks = first + looks;
        let stride = stride(cells);
        (first..first + looks).map(move |look| {
            let cell = (look as u128 * stride as u128 % cells as u128) as usize;
            Yx::new(rows.centre(cell / columns.count), columns.centre(cell % columns.count))
        })
    }
}

/// Centres along one axis of the picture.
#[derive(Clone, Copy)]
struct Axis {
    count: usize,
    first: f32,
    step: f32,
}

impl Axis {
    /// Evenly spread from edge to edge, at most half a search area apart.
    fn new(image: usize, size: f32) -> Self {
        let image = image as f32;
        // Pixel centres: the middle of a picture of one pixel is at 0.
        let middle = (image - 1.0) * 0.5;
        let free = image - size;
        // Also for a size that is no number.
        if free.is_nan() || free <= 0.0 {
            return Self { count: 1, first: middle, step: 0.0 };
        }
        // Areas narrower than a few pixels would make a grid without use and without end.
        let gaps = libm::ceilf(free / (size * 0.5).max(4.0)).max(1.0);
        Self { count: gaps as usize + 1, first: middle - free * 0.5, step: free / gaps }
    }

    fn centre(&self, index: usize) -> f32 {
        self.first + self.step * index as f32
    }
}

/// A step near the golden section of `cells` without a common divisor: multiples of it visit every
/// cell once per sweep, and any run of them is spread over the whole.
fn stride(cells: usize) -> usize {
    let near = (cells as f64 * 0.618) as usize;
    // Ends at 1 at the latest, which divides nothing else.
    (1..=near.max(1)).rev().find(|&s| gcd(s, cells) == 1).unwrap_or(1)
}

const fn gcd(mut a: usize, mut b: usize) -> usize {
    while b != 0 {
        (a, b) = (b, a % b);
    }
    a
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sweep(scan: &mut Scan, image: (usize, usize), size: f32) -> Vec<(i32, i32)> {
        let per = usize::from(scan.options.positions_per_frame);
        let cells = Axis::new(image.0, size).count * Axis::new(image.1, size).count;
        let mut seen = Vec::new();
        for _ in 0..cells.div_ceil(per) {
            let at = scan.positions(image, size);
            seen.extend(at.map(|p| ((p.y * 16.0) as i32, (p.x * 16.0) as i32)));
        }
        seen
    }

    #[test]
    fn an_area_as_large_as_the_picture_is_looked_at_once_in_the_middle() {
        let mut scan = Scan::new(RedetectOptions { positions_per_frame: 5, threshold: 0.5 });
        let at: Vec<_> = scan.positions((90, 121), 130.0).collect();
        assert_eq!(at, [Yx::new(44.5, 60.0)]);
    }

    #[test]
    fn a_sweep_begins_far_apart_and_starts_again_when_told() {
        let mut scan = Scan::new(RedetectOptions { positions_per_frame: 2, threshold: 0.5 });
        let first: Vec<_> = scan.positions((240, 320), 80.0).collect();
        let far = libm::hypotf(first[0].y - first[1].y, first[0].x - first[1].x);
        assert!(far > 80.0, "{first:?}");
        let second: Vec<_> = scan.positions((240, 320), 80.0).collect();
        assert_ne!(first, second);
        scan.restart();
        assert_eq!(scan.positions((240, 320), 80.0).collect::<Vec<_>>(), first);
    }

    #[test]
    fn options_out_of_range_are_named() {
        let good = RedetectOptions::default();
        good.validate().unwrap();
        let bad = RedetectOptions { positions_per_frame: 0, ..good };
        assert_eq!(bad.validate().unwrap_err().field, "positions_per_frame");
        let bad = RedetectOptions { threshold: f32::NAN, ..good };
        assert_eq!(bad.validate().unwrap_err().field, "threshold");
    }

    proptest! {
        /// One sweep visits every cell once, and every pixel is within a quarter of an area's side
        /// of a centre or of the middle half of an area at the picture's edge.
        #[test]
        fn a_sweep_covers_the_picture(
            height in 1usize..300, width in 1usize..300, size in 8f32..200.0, per in 1u8..6,
        ) {
            let mut scan = Scan::new(RedetectOptions { positions_per_frame: per, threshold: 0.5 });
            let mut seen = sweep(&mut scan, (height, width), size);
            let cells = Axis::new(height, size).count * Axis::new(width, size).count;
            seen.truncate(cells);
            seen.sort_unstable();
            seen.dedup();
            prop_assert_eq!(seen.len(), cells);
            for image in [height, width] {
                let axis = Axis::new(image, size);
                prop_assert!(axis.step <= size * 0.5 + 1e-3);
                let (low, high) = (axis.centre(0), axis.centre(axis.count - 1));
                prop_assert!((low + high - (image as f32 - 1.0)).abs() < 0.01);
                // The outermost areas reach the picture's edges.
                prop_assert!(low - size * 0.5 <= -0.4 || axis.count == 1 && size >= image as f32);
            }
        }
    }
}
