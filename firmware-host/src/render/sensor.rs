//! From radiance and temperature to what two cameras would deliver.

use super::canvas::Canvas;
use super::noise::{normal, unit};
use crate::picture::Picture;

/// Separable 5-tap blur with these weights for distance 0, 1, 2 (they sum to one over the taps).
fn blur(plane: &mut [f32], scratch: &mut [f32], width: usize, height: usize, w: [f32; 3]) {
    let tap = |line: &dyn Fn(usize) -> f32, i: usize, n: usize| {
        let at = |d: isize| line(i.saturating_add_signed(d).min(n - 1));
        w[0] * at(0) + w[1] * (at(-1) + at(1)) + w[2] * (at(-2) + at(2))
    };
    for y in 0..height {
        let row = &plane[y * width..(y + 1) * width];
        for x in 0..width {
            scratch[y * width + x] = tap(&|i| row[i], x, width);
        }
    }
    for y in 0..height {
        for x in 0..width {
            plane[y * width + x] = tap(&|i| scratch[i * width + x], y, height);
        }
    }
}

/// Darkening towards the corners: 1 in the middle, `1 - depth` in the corners.
fn vignette(x: usize, y: usize, width: usize, height: usize, depth: f32) -> f32 {
    let (u, v) = (x as f32 / width as f32 - 0.5, y as f32 / height as f32 - 0.5);
    1.0 - depth * 2.0 * (u * u + v * v)
}

/// Visible camera: exposure, sensor noise that shows in the dark, display gamma.
pub(super) fn visible(canvas: &Canvas, frame: u32, seed: u32, out: &mut Picture) {
    let (width, height) = (canvas.width, canvas.height);
    out.reset(width, height, 3);
    let mut plane = vec![0.0; width * height];
    let mut scratch = vec![0.0; width * height];
    let salt = seed ^ frame.wrapping_mul(0x9E37);
    for channel in 0..3 {
        for (p, t) in plane.iter_mut().zip(&canvas.data) {
            *p = t[channel];
        }
        blur(&mut plane, &mut scratch, width, height, [0.60, 0.19, 0.01]);
        for y in 0..height {
            for x in 0..width {
                let i = y * width + x;
                let v = (plane[i] * vignette(x, y, width, height, 0.35)).max(0.0) * 1.15;
                // Shot noise grows with the signal, read noise is always there; after the gamma the
                // dark shows it most.
                let sigma = libm::sqrtf(0.000_25 * v + 0.000_005);
                let common = normal(x as i32, y as i32, salt);
                let own = normal(x as i32, y as i32, salt ^ ((channel as u32 + 1) * 0x51));
                let v = (v + sigma * (0.75 * common + 0.6 * own)).clamp(0.0, 4.0);
                // A shoulder keeps lamps from clipping hard.
                let v = if v > 0.7 { 0.7 + (v - 0.7) / (1.0 + (v - 0.7) * 2.2) } else { v };
                let code = libm::powf(v.min(1.0), 1.0 / 2.2) * 255.0 + 0.5;
                out.data[i * 3 + channel] = code as u8;
            }
        }
    }
}

/// Thermal camera: soft optics, low contrast behind a fixed gain, column pattern, slow drift of the
/// offset, brighter corners (the housing's own warmth).
pub(super) fn thermal(canvas: &Canvas, frame: u32, seed: u32, out: &mut Picture) {
    let (width, height) = (canvas.width, canvas.height);
    out.reset(width, height, 1);
    let mut plane: Vec<f32> = canvas.data.iter().map(|t| t[3]).collect();
    let mut scratch = vec![0.0; width * height];
    blur(&mut plane, &mut scratch, width, height, [0.40, 0.23, 0.07]);
    let salt = seed ^ 0x7E00 ^ frame.wrapping_mul(0x85EB);
    let drift = 0.012 * libm::sinf(frame as f32 * 0.13);
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let column = (unit(x as i32, 0, seed ^ 0x7E11) - 0.5) * 0.014;
            let corner = 0.05 * (1.0 - vignette(x, y, width, height, 1.0));
            let white = 0.010 * normal(x as i32, y as i32, salt);
            let v = plane[i] + drift + column + corner + white;
            // Gain and a soft knee at the hot end.
            let v = 0.06 + 0.86 * v;
            let v = if v > 0.8 { 0.8 + (v - 0.8) * 0.6 } else { v };
            out.data[i] = (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        }
    }
}
