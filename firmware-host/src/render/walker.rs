//! A walking person: an articulated silhouette whose box is known exactly.

use super::canvas::{Canvas, blend, capsule, smooth};
use super::light::{Camera, Light};
use super::noise;
use tsda_runtime::BBox;

/// How a person looks and walks.
#[derive(Clone, Copy, Debug)]
pub(super) struct Walker {
    /// Place `(x, z)` at the start of the clip, metres.
    pub(super) start: (f32, f32),
    /// Speed `(x, z)` in metres per second.
    pub(super) velocity: (f32, f32),
    /// Body height in metres.
    pub(super) stature: f32,
    /// Reflectance of jacket and trousers.
    pub(super) jacket: [f32; 3],
    /// See `jacket`.
    pub(super) trousers: [f32; 3],
    /// How well the clothes hide the body's warmth: 0 like skin, 1 like the air.
    pub(super) insulation: f32,
    /// Phase of the gait, in cycles.
    pub(super) phase: f32,
    /// Seed of the cloth's texture.
    pub(super) seed: u32,
}

/// One body part: a capsule in body coordinates (x forward, y up, metres at stature 1.75).
#[derive(Clone, Copy)]
struct Part {
    a: (f32, f32),
    b: (f32, f32),
    radius: f32,
    cloth: Cloth,
    /// Parts on the far side get less light.
    shade: f32,
}

#[derive(Clone, Copy, PartialEq)]
enum Cloth {
    Skin,
    Hair,
    Jacket,
    Trousers,
    Shoe,
}

const TURN: f32 = core::f32::consts::TAU;

impl Walker {
    /// Ground position at `seconds`.
    pub(super) fn place(&self, seconds: f32) -> (f32, f32) {
        (self.start.0 + self.velocity.0 * seconds, self.start.1 + self.velocity.1 * seconds)
    }

    /// Body parts from back to front, in metres, facing the direction of walking.
    fn parts(&self, seconds: f32) -> [Part; 16] {
        let pace = libm::hypotf(self.velocity.0, self.velocity.1);
        let cycle = (self.phase + seconds * pace * 0.72) * TURN;
        let swing = (pace / 1.3).min(1.0);
        let facing = if self.velocity.0 < 0.0 { -1.0 } else { 1.0 };
        let k = self.stature / 1.75;
        let bob = 0.02 * libm::cosf(2.0 * cycle) * swing;
        let at = |x: f32, y: f32| (facing * x * k, (y + bob) * k);
        let reach = |(x, y): (f32, f32), angle: f32, length: f32| {
            (x + length * libm::sinf(angle), y - length * libm::cosf(angle))
        };
        let part = |a: (f32, f32), b: (f32, f32), r: f32, cloth, shade| Part {
            a: at(a.0, a.1),
            b: at(b.0, b.1),
            radius: r * k,
            cloth,
            shade,
        };
        let leg = |angle: f32, bend: f32, side: f32, shade: f32| {
            let hip = (side, 0.92);
            let knee = reach(hip, angle, 0.44);
            let ankle = reach(knee, angle - bend, 0.42);
            let toe = (ankle.0 + 0.15, ankle.1 - 0.02 + 0.1 * bend.min(0.6));
            [
                part(hip, knee, 0.092, Cloth::Trousers, shade),
                part(knee, ankle, 0.066, Cloth::Trousers, shade),
                part(ankle, toe, 0.046, Cloth::Shoe, shade),
            ]
        };
        let arm = |angle: f32, side: f32, shade: f32| {
            let shoulder = (side, 1.40);
            let elbow = reach(shoulder, angle, 0.29);
            let wrist = reach(elbow, angle + 0.35, 0.25);
            [
                part(shoulder, elbow, 0.062, Cloth::Jacket, shade),
                part(elbow, wrist, 0.05, Cloth::Jacket, shade),
                part(wrist, wrist, 0.05, Cloth::Skin, shade),
            ]
        };
        let s = libm::sinf(cycle) * swing;
        let bend = |c: f32| (0.12 + 0.75 * (c * swing).max(0.0)) * swing;
        let near = leg(0.46 * s, bend(libm::cosf(cycle)), 0.02, 1.0);
        let far = leg(-0.46 * s, bend(-libm::cosf(cycle)), -0.02, 0.72);
        let near_arm = arm(-0.5 * s, 0.01, 1.04);
        let far_arm = arm(0.5 * s, -0.01, 0.74);
        [
            far_arm[0],
            far_arm[1],
            far_arm[2],
            far[2],
            far[1],
            far[0],
            near[2],
            near[1],
            near[0],
            part((0.0, 1.02), (0.01, 1.37), 0.165, Cloth::Jacket, 0.95),
            part((0.01, 1.48), (0.02, 1.53), 0.062, Cloth::Skin, 0.85),
            part((0.03, 1.62), (0.03, 1.645), 0.098, Cloth::Skin, 1.0),
            part((-0.015, 1.665), (0.025, 1.675), 0.092, Cloth::Hair, 1.0),
            near_arm[0],
            near_arm[1],
            near_arm[2],
        ]
    }

    /// The tight box around the silhouette, unclipped; occluders are ignored.
    pub(super) fn bbox(&self, camera: &Camera, seconds: f32) -> BBox {
        let (x, z) = self.place(seconds);
        let (mut lo, mut hi) = ((f32::MAX, f32::MAX), (f32::MIN, f32::MIN));
        for part in self.parts(seconds) {
            for (px, py) in [part.a, part.b] {
                lo = (lo.0.min(px - part.radius), lo.1.min(py - part.radius));
                hi = (hi.0.max(px + part.radius), hi.1.max(py + part.radius));
            }
        }
        let (left, top) = camera.project(x + lo.0, hi.1, z);
        let (right, bottom) = camera.project(x + hi.0, lo.1, z);
        BBox::new(left, top, right - left, bottom - top)
    }

    pub(super) fn paint(&self, canvas: &mut Canvas, camera: &Camera, light: &Light, seconds: f32) {
        let (x, z) = self.place(seconds);
        let scale = camera.scale(z);
        shadow(canvas, camera, (x, z), (0.42, 0.20), 0.55 * (1.0 - 0.6 * light.night));
        for part in self.parts(seconds) {
            let reach = part.radius + 1.5 / scale;
            let (ax, ay) = camera.project(x + part.a.0, part.a.1, z);
            let (bx, by) = camera.project(x + part.b.0, part.b.1, z);
            let pad = reach * scale;
            let area = (ax.min(bx) - pad, ay.min(by) - pad, ax.max(bx) + pad, ay.max(by) + pad);
            canvas.fill(area, |sx, sy| {
                let p = (
                    (sx - camera.centre.0) / scale - x,
                    camera.height - (sy - camera.centre.1) / scale,
                );
                let d = capsule(p, part.a, part.b, part.radius);
                let coverage = 0.5 - d * scale;
                if coverage <= 0.0 {
                    return (0.0, [0.0; 4]);
                }
                (coverage, self.surface(light, part, p, d, (x, z)))
            });
        }
    }

    /// Cloth with folds and rounding light in the visible; skin, breath of warmth through the cloth
    /// and cooler edges in thermal.
    fn surface(
        &self,
        light: &Light,
        part: Part,
        p: (f32, f32),
        d: f32,
        ground: (f32, f32),
    ) -> [f32; 4] {
        let depth = (-d / part.radius).clamp(0.0, 1.0);
        let side = ((p.0 - (part.a.0 + part.b.0) * 0.5) / part.radius).clamp(-1.0, 1.0);
        let folds = noise::octaves(p.0 * 9.0, p.1 * 6.0, (0.3, 0.3), 3, self.seed);
        let lit = part.shade * (0.72 + 0.3 * depth - 0.16 * side + 0.5 * (folds - 0.5));
        let warm = |skin: f32| skin - (skin - 0.40) * self.insulation;
        let (albedo, temperature) = match part.cloth {
            Cloth::Skin => ([0.50, 0.31, 0.22], 0.93),
            Cloth::Hair => ([0.05, 0.04, 0.035], 0.74),
            Cloth::Jacket => (self.jacket, warm(0.86)),
            Cloth::Trousers => (self.trousers, warm(0.80)),
            Cloth::Shoe => ([0.07, 0.06, 0.06], 0.52),
        };
        // The hem of the jacket and the neck leak heat; the rim of a round body looks cooler.
        let leak = if part.cloth == Cloth::Jacket { smooth(1.25, 1.45, p.1) * 0.10 } else { 0.0 };
        let patch = noise::octaves(p.0 * 5.0, p.1 * 4.0, (0.3, 0.3), 2, self.seed ^ 77) - 0.5;
        let heat = temperature + leak + 0.16 * patch - 0.10 * (1.0 - depth) * (1.0 - depth);
        light.shade(albedo.map(|c| c * lit), heat * (0.9 + 0.1 * part.shade), ground)
    }
}

/// Darkens the ground under something that stands on it; half sides of the ellipse in metres.
pub(super) fn shadow(
    canvas: &mut Canvas,
    camera: &Camera,
    (x, z): (f32, f32),
    half: (f32, f32),
    strength: f32,
) {
    let (left, top) = camera.project(x - half.0, 0.0, z + half.1);
    let (right, bottom) = camera.project(x + half.0, 0.0, (z - half.1).max(1.0));
    let (cx, cy) = ((left + right) * 0.5, (top + bottom) * 0.5);
    let (rx, ry) = ((right - left) * 0.5, (bottom - top) * 0.5);
    let width = canvas.width;
    let height = canvas.height;
    let clamp = |v: f32, max: usize| v.clamp(0.0, max as f32) as usize;
    for py in clamp(top, height)..clamp(bottom + 1.0, height) {
        for px in clamp(left, width)..clamp(right + 1.0, width) {
            let (dx, dy) = ((px as f32 + 0.5 - cx) / rx, (py as f32 + 0.5 - cy) / ry);
            let a = strength * (1.0 - smooth(0.2, 1.0, dx * dx + dy * dy));
            let texel = &mut canvas.data[py * width + px];
            let dark = blend([texel[0], texel[1], texel[2]], [0.0; 3], a);
            texel[..3].copy_from_slice(&dark);
        }
    }
}
