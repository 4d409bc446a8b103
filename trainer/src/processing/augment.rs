//! Changes of grey values of one crop.

use crate::config::PhotometricConfig;
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};

/// Weights of R, G, B in the luma of BT.601.
pub(super) const LUMA: [f32; 3] = [0.299, 0.587, 0.114];

/// A random mixture of R, G, B: weights from 0 to 1 that add up to 1.
pub(super) fn channel_mix(rng: &mut impl Rng) -> [f32; 3] {
    let weights: [f32; 3] = std::array::from_fn(|_| rng.random::<f32>() + 1e-3);
    let sum: f32 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// How another sensor might show what this one shows: the channels' mixture, then an arbitrary curve
/// over the grey values. Edges mostly stay; which side of them is bright does not.
#[derive(Clone, Debug)]
pub(super) struct SensorShift {
    weights: [f32; 3],
    table: [u8; 256],
}

impl SensorShift {
    /// Grey values that five random knots span at least.
    const SPAN: f32 = 96.0;

    /// A random one: the curve runs straight between five knots.
    pub fn draw(rng: &mut impl Rng) -> Self {
        let weights = channel_mix(rng);
        let knots = loop {
            let knots: [f32; 5] = std::array::from_fn(|_| 255.0 * rng.random::<f32>());
            let (low, high) =
                knots.iter().fold((255.0f32, 0.0f32), |(l, h), v| (l.min(*v), h.max(*v)));
            if high - low >= Self::SPAN {
                break knots;
            }
        };
        let table = std::array::from_fn(|v| {
            let (knot, share) = (v / 64, (v % 64) as f32 / 64.0);
            (knots[knot] + (knots[knot + 1] - knots[knot]) * share).round_ties_even() as u8
        });
        Self { weights, table }
    }

    /// The crop as that sensor shows it: one channel.
    pub fn apply(&self, pixels: Pixels) -> Pixels {
        let mut grey = pixels.into_grey(self.weights);
        grey.data.iter_mut().for_each(|v| *v = self.table[usize::from(*v)]);
        grey
    }
}

/// Pixels of a square crop: 8-bit, interleaved, 1 or 3 channels.
pub(super) struct Pixels {
    pub side: usize,
    pub channels: usize,
    pub data: Vec<u8>,
}

impl Pixels {
    /// One channel: R, G and B times `weights`, added up ([`LUMA`], or another mixture); nothing
    /// happens to a grey crop.
    pub fn into_grey(self, weights: [f32; 3]) -> Self {
        if self.channels != 3 {
            return self;
        }
        let mix = |p: &[u8]| {
            let v: f32 = p.iter().zip(weights).map(|(v, weight)| f32::from(*v) * weight).sum();
            v.clamp(0.0, 255.0).round_ties_even() as u8
        };
        Self { side: self.side, channels: 1, data: self.data.chunks_exact(3).map(mix).collect() }
    }

    /// Stretches the grey values so that some share of the pixels, at most `window` at either end, is
    /// clipped: what automatic gain does in a thermal camera.
    pub fn window(&mut self, config: &PhotometricConfig, rng: &mut impl Rng) {
        if config.window_p <= 0.0 || !rng.random_bool(config.window_p) {
            return;
        }
        let mut histogram = [0usize; 256];
        self.data.iter().for_each(|v| histogram[usize::from(*v)] += 1);
        let n = self.data.len() as f32;
        let (below, above) = (rng.random::<f32>(), rng.random::<f32>());
        // First grey value that leaves at most this share of pixels behind it.
        let reach = |share: f32, from_top: bool| {
            let mut left = share * config.window * n;
            (0..256).map(|v| if from_top { 255 - v } else { v }).find(|&v| {
                left -= histogram[v] as f32;
                left < 0.0
            })
        };
        let (low, high) = (reach(below, false), reach(above, true));
        // A flat crop has nothing to stretch.
        let (Some(low), Some(high)) = (low, high) else { return };
        if high < low + 8 {
            return;
        }
        let scale = 255.0 / (high - low) as f32;
        for v in &mut self.data {
            let value = (f32::from(*v) - low as f32) * scale;
            *v = value.clamp(0.0, 255.0).round_ties_even() as u8;
        }
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
    if config.motion_blur_p > 0.0 && rng.random_bool(config.motion_blur_p) {
        let length = config.motion_blur * rng.random::<f32>();
        let angle = std::f32::consts::PI * rng.random::<f32>();
        for plane in planes.chunks_exact_mut(side * side) {
            motion_blur(plane, side, length, angle);
        }
    }
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

/// Mean along a line of `length` pixels in direction `angle`, centred, so that nothing moves on
/// average and boxes stay right; borders replicated.
fn motion_blur(plane: &mut [f32], side: usize, length: f32, angle: f32) {
    let reach = (length * 0.5).round() as i32;
    if reach < 1 {
        return;
    }
    let (dy, dx) = angle.sin_cos();
    let taps: Vec<(i32, i32)> = (-reach..=reach)
        .map(|t| ((dx * t as f32).round() as i32, (dy * t as f32).round() as i32))
        .collect();
    let before = plane.to_vec();
    let last = side as i32 - 1;
    for (i, out) in plane.iter_mut().enumerate() {
        let (x, y) = ((i % side) as i32, (i / side) as i32);
        let at = |(dx, dy): &(i32, i32)| {
            before[(y + dy).clamp(0, last) as usize * side + (x + dx).clamp(0, last) as usize]
        };
        *out = taps.iter().map(at).sum::<f32>() / taps.len() as f32;
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
    fn motion_blur_moves_nothing_on_average() {
        for step in 0..12 {
            let mut spot = vec![0.0; 31 * 31];
            spot[15 * 31 + 15] = 100.0;
            motion_blur(&mut spot, 31, 9.0, step as f32 * 0.26);
            let centre = |f: &dyn Fn(usize) -> usize| {
                spot.iter().enumerate().map(|(i, v)| f(i) as f32 * v).sum::<f32>() / 100.0
            };
            assert!((spot.iter().sum::<f32>() - 100.0).abs() < 1e-3);
            assert!((centre(&|i| i % 31) - 15.0).abs() < 1e-3, "step {step}");
            assert!((centre(&|i| i / 31) - 15.0).abs() < 1e-3, "step {step}");
            assert!(spot[15 * 31 + 15] < 15.0);
        }
    }

    #[test]
    fn windows_fill_the_range_and_keep_the_order() {
        let config = PhotometricConfig { window_p: 1.0, window: 0.1, ..Default::default() };
        for seed in 0..20 {
            let mut p = Pixels {
                side: 16,
                channels: 1,
                data: (0..256).map(|i| 60 + i as u8 / 4).collect::<Vec<_>>(),
            };
            p.window(&config, &mut ChaCha8Rng::seed_from_u64(seed));
            assert!(p.data.windows(2).all(|w| w[0] <= w[1]));
            assert_eq!((p.data[0], p.data[255]), (0, 255));
            let clipped = p.data.iter().filter(|v| **v == 0).count();
            assert!(clipped <= 30, "{clipped} of 256");
        }
        let mut flat = Pixels { side: 4, channels: 1, data: vec![90; 16] };
        flat.window(&config, &mut ChaCha8Rng::seed_from_u64(1));
        assert_eq!(flat.data, [90; 16]);
    }

    #[test]
    fn channel_mixtures_add_up_and_differ() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let (a, b) = (channel_mix(&mut rng), channel_mix(&mut rng));
        assert!((a.iter().sum::<f32>() - 1.0).abs() < 1e-6 && a != b);
        let p = Pixels { side: 1, channels: 3, data: vec![200, 200, 200] }.into_grey(a);
        assert_eq!((p.channels, p.data), (1, vec![200]));
    }

    #[test]
    fn sensor_shifts_keep_structure_but_not_polarity() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let (mut rising, mut falling) = (0, 0);
        for _ in 0..50 {
            let shift = SensorShift::draw(&mut rng);
            let shown = shift.apply(ramp(16, 3));
            assert_eq!((shown.channels, shown.data.len()), (1, 256));
            let (low, high) =
                (shift.table.iter().min().unwrap(), shift.table.iter().max().unwrap());
            // The last knot lies one beyond the table.
            assert!(high - low >= 90, "{low} {high}");
            let steps = shift.table.windows(2).map(|w| w[0].abs_diff(w[1])).max().unwrap();
            assert!(steps <= 4, "a jump of {steps} where the scene has none");
            match shift.table[0] < shift.table[255] {
                true => rising += 1,
                false => falling += 1,
            }
        }
        assert!(rising > 10 && falling > 10, "{rising} {falling}");
    }

    #[test]
    fn grey_is_the_luma() {
        let p = Pixels { side: 1, channels: 3, data: vec![200, 100, 50] }.into_grey(LUMA);
        assert_eq!((p.channels, p.data), (1, vec![124]));
    }
}
