//! Changes of grey values of one crop.

use crate::config::PhotometricConfig;
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};

/// Pixels of a square crop: 8-bit, interleaved, 1 or 3 channels.
pub(super) struct Pixels {
    pub side: usize,
    pub channels: usize,
    pub data: Vec<u8>,
}

impl Pixels {
    /// Luma (BT.601) as the only channel; nothing happens to a grey crop.
    pub fn into_grey(self) -> Self {
        if self.channels != 3 {
            return self;
        }
        let luma = |p: &[u8]| {
            let v = 0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2]);
            v.round_ties_even() as u8
        };
        Self { side: self.side, channels: 1, data: self.data.chunks_exact(3).map(luma).collect() }
    }

    /// Planar float copy in 0..255, `channels` planes.
    pub fn planes(&self) -> Vec<f32> {
        let n = self.side * self.side;
        let mut out = vec![0.0; n * self.channels];
        for (c, plane) in out.chunks_exact_mut(n).enumerate() {
            let source = self.data.iter().skip(c).step_by(self.channels);
            plane.iter_mut().zip(source).for_each(|(o, v)| *o = f32::from(*v));
        }
        out
    }

    /// Gamma, contrast and polarity in one table look-up. All draws are made whatever the strengths,
    /// so that changing one setting leaves the others' draws alone.
    pub fn tone(&mut self, config: &PhotometricConfig, invert: bool, rng: &mut impl Rng) {
        let gamma = (config.gamma * (2.0 * rng.random::<f32>() - 1.0)).exp();
        let contrast = (config.contrast * (2.0 * rng.random::<f32>() - 1.0)).exp();
        if config.gamma == 0.0 && config.contrast == 0.0 && !invert {
            return;
        }
        let curve = |v: f32| 255.0 * (v / 255.0).powf(gamma);
        let mut histogram = [0u32; 256];
        self.data.iter().for_each(|v| histogram[usize::from(*v)] += 1);
        let total: f32 =
            histogram.iter().enumerate().map(|(v, n)| curve(v as f32) * *n as f32).sum();
        let mean = total / self.data.len().max(1) as f32;
        let mut table = [0u8; 256];
        for (v, out) in table.iter_mut().enumerate() {
            let value = mean + (curve(v as f32) - mean) * contrast;
            let value = value.clamp(0.0, 255.0).round_ties_even();
            *out = if invert { 255.0 - value } else { value } as u8;
        }
        self.data.iter_mut().for_each(|v| *v = table[usize::from(*v)]);
    }
}

/// Blur and noise of planes in 0..255 (`channels` planes of `side * side`), in place.
pub(super) fn degrade(
    planes: &mut [f32],
    side: usize,
    config: &PhotometricConfig,
    rng: &mut impl Rng,
) {
    let (blur, sigma) = (rng.random_bool(config.blur_p), config.blur_sigma * rng.random::<f32>());
    let (noise, level) =
        (rng.random_bool(config.noise_p), config.noise_sigma * rng.random::<f32>());
    if blur && sigma > 0.1 {
        for plane in planes.chunks_exact_mut(side * side) {
            gaussian_blur(plane, side, sigma);
        }
    }
    if noise && level > 0.0 {
        for v in planes.iter_mut() {
            let n: f32 = StandardNormal.sample(rng);
            *v += level * n;
        }
    }
}

/// Separable Gaussian with replicated borders.
fn gaussian_blur(plane: &mut [f32], side: usize, sigma: f32) {
    let radius = ((2.5 * sigma).ceil() as usize).clamp(1, side.saturating_sub(1).max(1));
    let mut kernel: Vec<f32> = (0..=2 * radius)
        .map(|i| {
            let d = i as f32 - radius as f32;
            (-d * d / (2.0 * sigma * sigma)).exp()
        })
        .collect();
    let sum: f32 = kernel.iter().sum();
    kernel.iter_mut().for_each(|k| *k /= sum);
    let mut line = vec![0.0; side + 2 * radius];
    // Rows, then columns: `step` is the distance of neighbours, `next` that of lines.
    for (step, next) in [(1, side), (side, 1)] {
        for l in 0..side {
            for (i, v) in line.iter_mut().enumerate() {
                *v = plane[l * next + i.saturating_sub(radius).min(side - 1) * step];
            }
            for o in 0..side {
                let taps = &line[o..o + kernel.len()];
                plane[l * next + o * step] = taps.iter().zip(&kernel).map(|(a, b)| a * b).sum();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn ramp(side: usize, channels: usize) -> Pixels {
        let data = (0..side * side * channels).map(|i| (i * 37 % 256) as u8).collect();
        Pixels { side, channels, data }
    }

    #[test]
    fn strength_zero_changes_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut p = ramp(16, 3);
        let before = p.data.clone();
        p.tone(&PhotometricConfig::default(), false, &mut rng);
        assert_eq!(p.data, before);
        let mut planes = p.planes();
        degrade(&mut planes, 16, &PhotometricConfig::default(), &mut rng);
        assert_eq!(planes, p.planes());
        assert_eq!(planes[256], f32::from(before[1]));
    }

    #[test]
    fn inversion_alone_is_exact() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut p = ramp(16, 1);
        let before = p.data.clone();
        p.tone(&PhotometricConfig::default(), true, &mut rng);
        assert!(p.data.iter().zip(&before).all(|(a, b)| *a == 255 - *b));
    }

    #[test]
    fn tone_curves_keep_the_order_of_grey_values() {
        let config = PhotometricConfig { gamma: 0.5, contrast: 0.5, ..Default::default() };
        for seed in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut p = Pixels { side: 16, channels: 1, data: (0..=255).collect() };
            p.tone(&config, false, &mut rng);
            assert!(p.data.windows(2).all(|w| w[0] <= w[1]));
        }
    }

    #[test]
    fn blur_keeps_flat_pictures_and_the_mean_of_a_spot() {
        let mut flat = vec![7.0; 20 * 20];
        gaussian_blur(&mut flat, 20, 1.3);
        assert!(flat.iter().all(|v| (v - 7.0).abs() < 1e-4));
        let mut spot = vec![0.0; 20 * 20];
        spot[10 * 20 + 10] = 100.0;
        gaussian_blur(&mut spot, 20, 1.0);
        assert!((spot.iter().sum::<f32>() - 100.0).abs() < 1e-2);
        assert!(spot[10 * 20 + 10] < 30.0 && spot[10 * 20 + 12] > 1.0);
    }

    #[test]
    fn noise_has_about_the_drawn_strength() {
        let config = PhotometricConfig { noise_p: 1.0, noise_sigma: 10.0, ..Default::default() };
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut planes = vec![100.0; 64 * 64];
        degrade(&mut planes, 64, &config, &mut rng);
        let var = planes.iter().map(|v| (v - 100.0).powi(2)).sum::<f32>() / planes.len() as f32;
        assert!(var > 0.01 && var.sqrt() < 10.5, "{}", var.sqrt());
    }

    #[test]
    fn grey_is_the_luma() {
        let p = Pixels { side: 1, channels: 3, data: vec![200, 100, 50] }.into_grey();
        assert_eq!((p.channels, p.data), (1, vec![124]));
    }
}
