//! Training crops (spec 2.3): integer windows, replicated borders, bilinear on 8-bit data.
//!
//! Boxes here are continuous-edge boxes in pixels, x right and y down, as everywhere in training.

use crate::config::JitterConfig;
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};
use tsda_eval::dataset::Picture;
use tsda_runtime::BBox;

/// Part of a picture a crop is made of, in whole pixels; may leave the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CropWindow {
    /// Left column.
    pub x: i64,
    /// Top row.
    pub y: i64,
    /// Columns, at least 1.
    pub w: i64,
    /// Rows, at least 1.
    pub h: i64,
}

/// What a window is computed from besides picture and box.
#[derive(Clone, Copy, Debug)]
pub struct CropRule {
    /// Side of the crop over the square root of the box's area.
    pub search_factor: f32,
    /// Side of the output in pixels.
    pub output: usize,
    /// Largest factor by which the window may shrink to stay inside the picture.
    pub max_scale_change: f32,
    /// Logarithm of the window's width over its height; 0 is the square of the reference.
    pub stretch: f32,
}

/// The jittered copy of a box that a crop is cut around (spec 2.3).
pub fn jittered(bbox: &BBox, jitter: &JitterConfig, rng: &mut impl Rng) -> BBox {
    let mut normal = || -> f32 { StandardNormal.sample(rng) };
    let w = bbox.w * (jitter.scale * normal()).exp();
    let h = bbox.h * (jitter.scale * normal()).exp();
    let reach = (w * h).sqrt() * jitter.centre;
    let (cx, cy) = bbox.centre();
    let cx = cx + reach * (rng.random::<f32>() - 0.5);
    let cy = cy + reach * (rng.random::<f32>() - 0.5);
    BBox::new(cx - w * 0.5, cy - h * 0.5, w, h)
}

/// Half-to-even, as Python rounds.
fn round(v: f64) -> i64 {
    v.round_ties_even() as i64
}

impl CropWindow {
    /// Steps 1 to 3 of spec 2.3 ("inside_major").
    pub fn around(image: (usize, usize), bbox: &BBox, rule: &CropRule) -> Self {
        let out = rule.output as f32;
        let side =
            (out * (bbox.w * bbox.h / (out * out)).sqrt() * rule.search_factor).ceil().max(1.0);
        let (w, h) = (image.0 as f64, image.1 as f64);
        let side = f64::from(side);
        let q = (side / w).min(side / h).max(1.0).min(f64::from(rule.max_scale_change));
        let side = (side / q).floor().max(1.0);
        let half = f64::from(rule.stretch) * 0.5;
        // A stretch of exactly 0 leaves the reference's square untouched.
        let (cw, ch) = if rule.stretch == 0.0 {
            (side as i64, side as i64)
        } else {
            (round(side * half.exp()).max(1), round(side * (-half).exp()).max(1))
        };
        let axis = |origin: f32, length: f32, size: i64, limit: usize| {
            let start = f64::from(origin) + 0.5 * f64::from(length) - size as f64 * 0.5;
            let limit = limit as i64;
            let first = round(start);
            let end = first + size;
            let shift = (-first).max(0) + (limit - end).min(0);
            let (first, end) = (first + shift, end + shift);
            // An overhang left on both sides means the window is wider than the picture: centre it.
            let outside = ((-first).max(0) + (end - limit).max(0)) / 2;
            if outside > 0 { -outside } else { first }
        };
        Self {
            x: axis(bbox.x, bbox.w, cw, image.0),
            y: axis(bbox.y, bbox.h, ch, image.1),
            w: cw,
            h: ch,
        }
    }

    /// A box of the picture in crop pixels: plain edge coordinates.
    pub fn to_crop(&self, bbox: &BBox, output: usize) -> BBox {
        let (fx, fy) = (output as f32 / self.w as f32, output as f32 / self.h as f32);
        BBox::new(
            (bbox.x - self.x as f32) * fx,
            (bbox.y - self.y as f32) * fy,
            bbox.w * fx,
            bbox.h * fy,
        )
    }

    /// Cuts the window out of the picture and resizes it to `output` x `output`: interleaved
    /// 8-bit rows with the picture's channels. With `mirror` the window is that of the picture
    /// mirrored left to right.
    pub fn cut(&self, picture: &Picture, output: usize, mirror: bool) -> Vec<u8> {
        let columns = Axis::new(self.x, self.w, picture.width, output);
        let rows = Axis::new(self.y, self.h, picture.height, output);
        let (channels, stride) = (picture.channels, picture.width * picture.channels);
        let column = |x: usize| if mirror { picture.width - 1 - x } else { x } * channels;
        let taps: Vec<(usize, usize, f32)> =
            columns.taps.iter().map(|&(a, b, f)| (column(a), column(b), f)).collect();
        let mut out = Vec::with_capacity(output * output * channels);
        for &(top, bottom, fy) in &rows.taps {
            let top = &picture.data[top * stride..][..stride];
            let bottom = &picture.data[bottom * stride..][..stride];
            for &(left, right, fx) in &taps {
                for c in 0..channels {
                    let lerp = |row: &[u8]| {
                        let (a, b) = (f32::from(row[left + c]), f32::from(row[right + c]));
                        a + (b - a) * fx
                    };
                    let (a, b) = (lerp(top), lerp(bottom));
                    out.push((a + (b - a) * fy).round_ties_even() as u8);
                }
            }
        }
        out
    }
}

/// Source pixels of every output pixel along one axis: two indices and the second one's weight.
struct Axis {
    taps: Vec<(usize, usize, f32)>,
}

impl Axis {
    /// Step 4 of spec 2.3. The picture's last row and column are never read when the window
    /// reaches them (quirk Q10).
    fn new(start: i64, length: i64, limit: usize, output: usize) -> Self {
        let limit = limit as i64;
        let end = start + length;
        let last_read = end - (end - limit + 1).max(0) - 1;
        let source = |i: i64| {
            let low = start.max(0);
            (start + i).min(last_read).max(low).clamp(0, limit - 1) as usize
        };
        let scale = length as f64 / output as f64;
        let taps = (0..output)
            .map(|o| {
                let at = (o as f64 + 0.5) * scale - 0.5;
                let whole = at.floor();
                let (i, f) = (whole as i64, (at - whole) as f32);
                if i < 0 {
                    (source(0), source(0), 0.0)
                } else if i >= length - 1 {
                    (source(length - 1), source(length - 1), 0.0)
                } else {
                    (source(i), source(i + 1), f)
                }
            })
            .collect();
        Self { taps }
    }
}

#[cfg(test)]
mod tests;
