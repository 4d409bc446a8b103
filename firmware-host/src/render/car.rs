//! A car seen from the side.

use super::canvas::{Canvas, blend, convex, rounded, smooth};
use super::light::{Camera, Light};
use super::noise;
use super::walker::shadow;

/// A parked or passing car.
#[derive(Clone, Copy, Debug)]
pub(super) struct Car {
    /// Place `(x, z)` of its middle at the start of the clip, metres.
    pub(super) start: (f32, f32),
    /// Speed along x in metres per second; the nose points this way.
    pub(super) speed: f32,
    /// Reflectance of the paint.
    pub(super) paint: [f32; 3],
    /// Engine, brakes and tyres are hot.
    pub(super) running: bool,
    /// Seed of its texture.
    pub(super) seed: u32,
}

const BODY: ((f32, f32), (f32, f32)) = ((0.0, 0.60), (2.10, 0.31));
const CABIN: [(f32, f32); 4] = [(-1.55, 0.86), (1.15, 0.86), (0.45, 1.42), (-1.05, 1.42)];
const WINDOWS: [[(f32, f32); 4]; 2] = [
    [(-1.36, 0.92), (-0.24, 0.92), (-0.24, 1.35), (-0.98, 1.35)],
    [(-0.14, 0.92), (0.96, 0.92), (0.40, 1.35), (-0.14, 1.35)],
];
const WHEELS: [f32; 2] = [-1.32, 1.30];

impl Car {
    pub(super) fn place(&self, seconds: f32) -> (f32, f32) {
        (self.start.0 + self.speed * seconds, self.start.1)
    }

    pub(super) fn paint(&self, canvas: &mut Canvas, camera: &Camera, light: &Light, seconds: f32) {
        let (x, z) = self.place(seconds);
        let facing = if self.speed < 0.0 { -1.0 } else { 1.0 };
        let scale = camera.scale(z);
        shadow(canvas, camera, (x, z), (2.3, 0.8), 0.75 * (1.0 - 0.6 * light.night));
        let (left, top) = camera.project(x - 2.4, 1.6, z);
        let (right, bottom) = camera.project(x + 2.4, -0.1, z);
        canvas.fill((left, top, right, bottom), |sx, sy| {
            let p = (
                ((sx - camera.centre.0) / scale - x) * facing,
                camera.height - (sy - camera.centre.1) / scale,
            );
            let body = rounded(p, BODY.0, BODY.1, 0.22).min(convex(p, &CABIN) - 0.04);
            let wheel =
                WHEELS.iter().map(|w| libm::hypotf(p.0 - w, p.1 - 0.33)).fold(f32::MAX, f32::min);
            let d = body.min(wheel - 0.34);
            let coverage = 0.5 - d * scale;
            if coverage <= 0.0 {
                return (0.0, [0.0; 4]);
            }
            (coverage, self.surface(light, p, wheel, scale, (x, z)))
        });
        if self.running {
            // Headlight towards the front, tail light behind; they bloom once it is dark.
            let on = 0.25 + 0.75 * light.night;
            let head = camera.project(x + facing * 2.08, 0.62, z);
            let tail = camera.project(x - facing * 2.08, 0.66, z);
            canvas.bloom(head, 0.17 * scale, [1.1 * on, 1.05 * on, 0.9 * on]);
            canvas.bloom(tail, 0.09 * scale, [0.7 * on, 0.05 * on, 0.03 * on]);
        }
    }

    fn surface(
        &self,
        light: &Light,
        p: (f32, f32),
        wheel: f32,
        scale: f32,
        ground: (f32, f32),
    ) -> [f32; 4] {
        let soft = 1.0 / scale;
        let grain = noise::octaves(p.0 * 2.0, p.1 * 3.0, (0.1, 0.1), 3, self.seed) - 0.5;
        // Paint mirrors the sky above its shoulder line; metal does the same in thermal (cold sky).
        let upward = smooth(0.35, 1.4, p.1);
        let mut albedo = self.paint.map(|c| c * (0.55 + 0.65 * upward + 0.25 * grain));
        let mut heat = 0.30 - 0.07 * upward + 0.05 * grain;
        if self.running {
            let bonnet = smooth(0.5, 1.5, p.0) * smooth(0.30, 0.55, p.1) * smooth(1.1, 0.7, p.1);
            let under = smooth(0.42, 0.28, p.1);
            heat += 0.38 * bonnet + 0.22 * under;
        }
        let seam = |at: f32| 1.0 - smooth(0.0, 0.03 + soft * 0.5, (p.0 - at).abs());
        if p.1 < 0.9 {
            let seams = seam(-1.0).max(seam(-0.19)).max(seam(0.85));
            albedo = blend(albedo, [0.02; 3], seams * 0.7);
        }
        let glass = WINDOWS.iter().map(|w| convex(p, w)).fold(f32::MAX, f32::min);
        let a = (0.5 - glass * scale).clamp(0.0, 1.0);
        albedo =
            blend(albedo, [0.06 + 0.12 * upward, 0.08 + 0.12 * upward, 0.10 + 0.13 * upward], a);
        heat += a * (if self.running { 0.44 } else { 0.20 } - heat);
        let arch = (0.5 - (wheel - 0.42) * scale).clamp(0.0, 1.0);
        if p.1 < 0.62 {
            albedo = blend(albedo, [0.015; 3], arch);
            heat += arch * (0.26 - heat);
        }
        let tyre = (0.5 - (wheel - 0.34) * scale).clamp(0.0, 1.0);
        albedo = blend(albedo, [0.03; 3], tyre);
        heat += tyre * (if self.running { 0.62 } else { 0.34 } - heat);
        let rim = (0.5 - (wheel - 0.20) * scale).clamp(0.0, 1.0);
        albedo = blend(albedo, [0.30, 0.30, 0.31], rim);
        heat += rim * (if self.running { 0.52 } else { 0.30 } - heat);
        light.shade(albedo, heat, ground)
    }
}
