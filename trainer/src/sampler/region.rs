//! Random textured regions of registered pairs: the same place in both pictures is a valid
//! cross-modal target, box annotation or not.

use crate::config::SamplerConfig;
use rand::{Rng, RngExt};
use tsda_eval::dataset::Picture;
use tsda_runtime::BBox;

/// Candidates looked at before the draw is given up.
const TRIES: usize = 30;
/// Grey levels of mean gradient under which a region counts as flat in any picture.
const LEAST_GRADIENT: f32 = 1.5;

/// Mean of `|dx| + |dy|` over at most some 2,000 pixels of a region, in grey levels. `region` is
/// `(x0, y0, x1, y1)`, end exclusive, inside the picture less its last row and column.
fn gradient(picture: &Picture, region: (usize, usize, usize, usize)) -> f32 {
    let (x0, y0, x1, y1) = region;
    let channel = picture.channels / 2; // green, or the only one
    let at = |x: usize, y: usize| {
        let i = (y * picture.width + x) * picture.channels + channel;
        i32::from(picture.data.get(i).copied().unwrap_or(0))
    };
    // Odd, so that a regular pattern is not always met at the same phase.
    let step = (((x1 - x0) * (y1 - y0)) as f32 / 2000.0).sqrt().ceil().max(1.0) as usize | 1;
    let (mut sum, mut n) = (0u32, 0u32);
    for y in (y0..y1).step_by(step) {
        for x in (x0..x1).step_by(step) {
            let v = at(x, y);
            sum += v.abs_diff(at(x + 1, y)) + v.abs_diff(at(x, y + 1));
            n += 1;
        }
    }
    if n == 0 { 0.0 } else { sum as f32 / n as f32 }
}

/// Draws a box that is textured in every one of `pictures` (all of one size); `None` when the
/// pictures are too small or no candidate had texture.
pub(super) fn draw(
    pictures: &[&Picture],
    config: &SamplerConfig,
    rng: &mut impl Rng,
) -> Option<BBox> {
    let (width, height) = pictures.first().map(|p| (p.width, p.height))?;
    if pictures.iter().any(|p| (p.width, p.height) != (width, height)) {
        return None;
    }
    let largest = config.region_max.min(width.min(height) as f32 * 0.5);
    if largest < config.region_min {
        return None;
    }
    let whole = (0, 0, width - 1, height - 1);
    let needed: Vec<f32> = pictures
        .iter()
        .map(|p| (gradient(p, whole) * config.region_texture).max(LEAST_GRADIENT))
        .collect();
    let (low, high) = (config.region_min.ln(), largest.ln());
    for _ in 0..TRIES {
        let side = (low + (high - low) * rng.random::<f32>()).exp();
        let stretch = (rng.random::<f32>() - 0.5).exp(); // sqrt of the aspect ratio: 0.6 to 1.65
        let (w, h) = (side * stretch, side / stretch);
        let (room_x, room_y) = (width as f32 - 2.0 - w, height as f32 - 2.0 - h);
        let (u, v) = (rng.random::<f32>(), rng.random::<f32>());
        if room_x <= 0.0 || room_y <= 0.0 {
            continue;
        }
        let bbox = BBox::new((room_x * u).floor(), (room_y * v).floor(), w.round(), h.round());
        let region = (
            bbox.x as usize,
            bbox.y as usize,
            (bbox.right() as usize).min(width - 1),
            (bbox.bottom() as usize).min(height - 1),
        );
        if pictures.iter().zip(&needed).all(|(p, least)| gradient(p, region) >= *least) {
            return Some(bbox);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Flat but for a checkered block at `(x0..x1, y0..y1)`.
    fn picture(channels: usize, block: (usize, usize, usize, usize)) -> Picture {
        let (width, height) = (200, 120);
        let mut data = Vec::new();
        for y in 0..height {
            for x in 0..width {
                let inside = x >= block.0 && x < block.2 && y >= block.1 && y < block.3;
                let v = if inside && (x / 2 + y / 2) % 2 == 0 { 200 } else { 90 };
                data.extend(std::iter::repeat_n(v, channels));
            }
        }
        Picture { width, height, channels, data }
    }

    #[test]
    fn regions_have_texture_in_both_pictures() {
        let rgb = picture(3, (0, 0, 140, 120));
        let thermal = picture(1, (60, 0, 200, 120));
        let config = SamplerConfig {
            region_min: 12.0,
            region_max: 30.0,
            region_texture: 1.2,
            ..Default::default()
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let both = BBox::new(60.0, 0.0, 80.0, 120.0);
        for _ in 0..200 {
            if let Some(b) = draw(&[&rgb, &thermal], &config, &mut rng) {
                assert!(b.x >= 0.0 && b.right() <= 199.0 && b.bottom() <= 119.0, "{b:?}");
                let iw = b.right().min(both.right()) - b.x.max(both.x);
                assert!(iw / b.w > 0.6, "{b:?} is mostly flat in one picture");
            }
        }
    }

    #[test]
    fn flat_tiny_or_unequal_pictures_give_nothing() {
        let config = SamplerConfig::default();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let flat = picture(1, (0, 0, 0, 0));
        assert_eq!(draw(&[&flat, &flat], &config, &mut rng), None);
        let tiny = Picture { width: 20, height: 20, channels: 1, data: vec![0; 400] };
        assert_eq!(draw(&[&tiny, &tiny], &config, &mut rng), None);
        assert_eq!(draw(&[&flat, &tiny], &config, &mut rng), None);
        assert_eq!(draw(&[], &config, &mut rng), None);
    }
}
