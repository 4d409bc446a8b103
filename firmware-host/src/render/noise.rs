//! Seeded noise from integer hashes: the same numbers on every machine.

/// Mixes two lattice coordinates and a seed into 32 well-spread bits.
pub(super) fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h = seed ^ (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// Uniform in `[0, 1)`.
pub(super) fn unit(x: i32, y: i32, seed: u32) -> f32 {
    (hash(x, y, seed) >> 8) as f32 / (1u32 << 24) as f32
}

/// Roughly normal, mean 0, variance 1: four bytes of one hash summed.
pub(super) fn normal(x: i32, y: i32, seed: u32) -> f32 {
    let h = hash(x, y, seed);
    let sum = (h & 255) + ((h >> 8) & 255) + ((h >> 16) & 255) + (h >> 24);
    (sum as f32 - 510.0) / 147.8
}

/// Value noise in `[0, 1]` with wavelength 1.
pub(super) fn value(x: f32, y: f32, seed: u32) -> f32 {
    let (fx, fy) = (libm::floorf(x), libm::floorf(y));
    let (ix, iy) = (fx as i32, fy as i32);
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let (u, v) = (ease(x - fx), ease(y - fy));
    let corner = |dx, dy| unit(ix.wrapping_add(dx), iy.wrapping_add(dy), seed);
    let top = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * u;
    let bottom = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * u;
    top + (bottom - top) * v
}

/// Octaves of [`value`], mean 0.5. `footprint` is the size of a pixel in the units of `x`, `y`:
/// octaves finer than two pixels fade out, which is what keeps far ground from flickering.
pub(super) fn octaves(x: f32, y: f32, footprint: (f32, f32), count: u32, seed: u32) -> f32 {
    let (mut sum, mut total, mut amplitude, mut frequency) = (0.0, 0.0, 1.0, 1.0);
    let pixel = if footprint.0 > footprint.1 { footprint.0 } else { footprint.1 };
    for octave in 0..count {
        let sharp = (1.0 / (frequency * pixel.max(1e-4)) - 1.0).clamp(0.0, 1.0);
        if sharp > 0.0 {
            let n = value(x * frequency, y * frequency, seed.wrapping_add(octave * 101));
            sum += (n - 0.5) * amplitude * sharp;
        }
        total += amplitude;
        amplitude *= 0.55;
        frequency *= 2.03;
    }
    0.5 + sum / total
}
