//! Things that change what the search crop shows: a distractor beside the target, an occluder over part
//! of it, both from another picture, and the target covered by what lies beside it. The target's box
//! stays what it was.

use super::augment::Pixels;
use crate::sampler::DrawnFrame;
use rand::{Rng, RngExt};
use tsda_eval::dataset::Picture;
use tsda_runtime::BBox;

/// Places looked at for a distractor.
const TRIES: usize = 10;
/// A thing smaller than this, in crop pixels, is not worth pasting.
const LEAST: f32 = 3.0;

/// Pastes the other target, at a size like this one's, where it does not touch `target` (crop
/// pixels). Does nothing when there is no room.
pub(super) fn distractor(
    pixels: &mut Pixels,
    target: &BBox,
    other: &DrawnFrame,
    rng: &mut impl Rng,
) {
    let side = pixels.side as f32;
    for _ in 0..TRIES {
        let size = (target.area() / other.bbox.area()).sqrt() * (rng.random::<f32>() - 0.5).exp();
        let (w, h) = (other.bbox.w * size, other.bbox.h * size);
        let (u, v) = (rng.random::<f32>(), rng.random::<f32>());
        if w.min(h) < LEAST || w >= side || h >= side {
            continue;
        }
        let to = BBox::new(u * (side - w), v * (side - h), w, h);
        let apart = to.right() <= target.x
            || to.x >= target.right()
            || to.bottom() <= target.y
            || to.y >= target.bottom();
        if apart {
            paste(pixels, &to, &other.picture, &other.bbox);
            return;
        }
    }
}

/// Covers part of `target` (crop pixels), at most the share `largest` of its width and of its height,
/// with a random piece of the other picture.
pub(super) fn occluder(
    pixels: &mut Pixels,
    target: &BBox,
    other: &Picture,
    largest: f32,
    rng: &mut impl Rng,
) {
    let mut draw = || rng.random::<f32>();
    let (w, h) =
        (target.w * largest * (0.4 + 0.6 * draw()), target.h * largest * (0.4 + 0.6 * draw()));
    let to =
        BBox::new(target.x + (target.w - w) * draw(), target.y + (target.h - h) * draw(), w, h);
    if w.min(h) < LEAST {
        return;
    }
    let (fw, fh) = (w.min(other.width as f32), h.min(other.height as f32));
    let x = (other.width as f32 - fw) * draw();
    let y = (other.height as f32 - fh) * draw();
    paste(pixels, &to, other, &BBox::new(x, y, fw, fh));
}

/// Share of the target's width and height added on each side when it is covered: boxes are often tight.
const COVER_MARGIN: f32 = 0.15;

/// Copies over `target` (crop pixels) what lies beside it, as large as it is with a margin, with a soft
/// edge. False, and nothing done, when there is no room beside it in the crop.
pub(super) fn cover(pixels: &mut Pixels, target: &BBox, rng: &mut impl Rng) -> bool {
    let side = pixels.side as f32;
    let (mx, my) = (target.w * COVER_MARGIN, target.h * COVER_MARGIN);
    // In whole pixels, so that nothing has to be resampled.
    let low = |v: f32| v.floor().clamp(0.0, side) as i64;
    let high = |v: f32| v.ceil().clamp(0.0, side) as i64;
    let (left, right) = (low(target.x - mx), high(target.right() + mx));
    let (top, bottom) = (low(target.y - my), high(target.bottom() + my));
    let (w, h, side) = (right - left, bottom - top, pixels.side as i64);
    // By its size to the left, right, up or down, and a little along the other axis.
    let slide = |length: i64, share: f32| (length as f32 * share) as i64;
    let mut places = [(-w, 0), (w, 0), (0, -h), (0, h)].map(|(dx, dy)| {
        let along = 0.5 * (rng.random::<f32>() - 0.5);
        if dx == 0 {
            (slide(w, along).clamp(-left, side - right), dy)
        } else {
            (dx, slide(h, along).clamp(-top, side - bottom))
        }
    });
    let first = rng.random_range(0..places.len());
    places.rotate_left(first);
    let fits = |low: i64, length: i64| low >= 0 && low + length <= side;
    let Some((dx, dy)) =
        places.into_iter().find(|(dx, dy)| fits(left + dx, w) && fits(top + dy, h))
    else {
        return false;
    };
    if w == 0 || h == 0 {
        return false;
    }
    let channels = pixels.channels;
    // The places do not overlap, so what is read is never what was written.
    for y in top..bottom {
        for x in left..right {
            let edge = (x - left).min(right - 1 - x).min(y - top).min(bottom - 1 - y);
            let share = ((edge + 1) as f32 / 3.0).min(1.0);
            let at = |x: i64, y: i64| (y * side + x) as usize * channels;
            let (to, from) = (at(x, y), at(x + dx, y + dy));
            for c in 0..channels {
                let (old, new) = (f32::from(pixels.data[to + c]), f32::from(pixels.data[from + c]));
                pixels.data[to + c] = (old + (new - old) * share).round_ties_even() as u8;
            }
        }
    }
    true
}

/// Fills the pixels whose centres lie in `to` (crop pixels) with what is in `from` (pixels of
/// `picture`), bilinear.
fn paste(pixels: &mut Pixels, to: &BBox, picture: &Picture, from: &BBox) {
    let (side, channels) = (pixels.side, pixels.channels);
    let range = |low: f32, high: f32| {
        let end = (high + 0.5).floor().clamp(0.0, side as f32) as usize;
        ((low + 0.5).floor().max(0.0) as usize)..end
    };
    // Half-pixel convention, borders replicated.
    let source = |at: usize, low: f32, length: f32, first: f32, size: f32, limit: usize| {
        let p = first + (at as f32 + 0.5 - low) / length * size - 0.5;
        let p = p.clamp(0.0, limit as f32 - 1.0);
        (p as usize, (p as usize + 1).min(limit - 1), p.fract())
    };
    for y in range(to.y, to.bottom()) {
        let (top, bottom, fy) = source(y, to.y, to.h, from.y, from.h, picture.height);
        for x in range(to.x, to.right()) {
            let (left, right, fx) = source(x, to.x, to.w, from.x, from.w, picture.width);
            for c in 0..channels {
                // Only material of one sensor meets here, but a folder may mix grey and colour.
                let c_from = c.min(picture.channels - 1);
                let value = |x: usize, y: usize| {
                    f32::from(picture.data[(y * picture.width + x) * picture.channels + c_from])
                };
                let a = value(left, top) + (value(right, top) - value(left, top)) * fx;
                let b = value(left, bottom) + (value(right, bottom) - value(left, bottom)) * fx;
                let v = (a + (b - a) * fy).round_ties_even() as u8;
                pixels.data[(y * side + x) * channels + c] = v;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampler::FrameRef;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use std::sync::Arc;
    use tsda_runtime::Modality;

    fn blank() -> Pixels {
        Pixels { side: 64, channels: 1, data: vec![0; 64 * 64] }
    }

    fn other() -> DrawnFrame {
        let data = (0..40 * 30).map(|i| if i % 40 < 20 { 100 } else { 200 }).collect();
        let picture = Arc::new(Picture { width: 40, height: 30, channels: 1, data });
        let at = FrameRef { source: 0, sequence: 1, frame: 0, modality: Modality::Thermal };
        DrawnFrame { at, bbox: BBox::new(15.0, 10.0, 10.0, 8.0), picture }
    }

    /// Pixels changed inside and outside the target.
    fn changed(pixels: &Pixels, target: &BBox) -> (usize, usize) {
        let set = (0..64 * 64).filter(|&i| pixels.data[i] != 0);
        let inside = |i: &usize| {
            let (x, y) = ((i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5);
            x > target.x && x < target.right() && y > target.y && y < target.bottom()
        };
        let (inside, outside): (Vec<_>, Vec<_>) = set.partition(inside);
        (inside.len(), outside.len())
    }

    #[test]
    fn distractors_stay_off_the_target() {
        let target = BBox::new(24.0, 24.0, 16.0, 16.0);
        let mut pasted = 0;
        for seed in 0..40 {
            let mut pixels = blank();
            distractor(&mut pixels, &target, &other(), &mut ChaCha8Rng::seed_from_u64(seed));
            let (inside, outside) = changed(&pixels, &target);
            assert_eq!(inside, 0, "seed {seed}");
            pasted += usize::from(outside > 50);
            // Left half of the other target is 100, right half 200.
            if outside > 0 {
                assert!(pixels.data.contains(&100) && pixels.data.contains(&200));
            }
        }
        assert!(pasted > 30, "{pasted}");
        let mut full = blank();
        let everywhere = BBox::new(0.0, 0.0, 64.0, 64.0);
        distractor(&mut full, &everywhere, &other(), &mut ChaCha8Rng::seed_from_u64(1));
        assert!(full.data.iter().all(|v| *v == 0));
    }

    #[test]
    fn a_covered_target_looks_like_what_is_beside_it() {
        // The second one has room on one side only, the third on none.
        let targets = [(24.0, 24.0, 10.0, 12.0), (8.0, 2.0, 16.0, 48.0), (2.0, 2.0, 60.0, 60.0)];
        for (i, (x, y, w, h)) in targets.into_iter().enumerate() {
            let target = BBox::new(x, y, w, h);
            for seed in 0..20 {
                let mut pixels = blank();
                for (j, v) in pixels.data.iter_mut().enumerate() {
                    let (px, py) = ((j % 64) as f32 + 0.5, (j / 64) as f32 + 0.5);
                    let inside = px > target.x
                        && px < target.right()
                        && py > target.y
                        && py < target.bottom();
                    *v = if inside { 255 } else { 40 + (j % 2) as u8 };
                }
                let done = cover(&mut pixels, &target, &mut ChaCha8Rng::seed_from_u64(seed));
                assert_eq!(done, i < 2, "{target:?} seed {seed}");
                assert_eq!(pixels.data.iter().all(|v| *v <= 41), done, "{target:?} seed {seed}");
            }
        }
    }

    #[test]
    fn occluders_cover_part_of_the_target_and_nothing_else() {
        // The second one hangs over the crop's edge.
        for target in [BBox::new(20.0, 20.0, 24.0, 20.0), BBox::new(-8.0, 50.0, 24.0, 24.0)] {
            let mut covered = 0;
            for seed in 0..40 {
                let mut pixels = blank();
                let rng = &mut ChaCha8Rng::seed_from_u64(seed);
                occluder(&mut pixels, &target, &other().picture, 0.6, rng);
                let (inside, outside) = changed(&pixels, &target);
                assert_eq!(outside, 0, "seed {seed}");
                // 0.6 of either side, and half a pixel of rounding at each edge.
                assert!(inside as f32 <= (0.6 * target.w + 1.0) * (0.6 * target.h + 1.0));
                covered += usize::from(inside > 20);
            }
            assert!(covered > 20, "{covered}");
        }
    }
}
