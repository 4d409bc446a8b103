//! Camera and light of one moment of the clip.

use super::canvas::{Texel, mix, smooth};

/// Pinhole camera above a flat ground; world axes: x right, y up, z away, in metres.
#[derive(Clone, Copy, Debug)]
pub(super) struct Camera {
    /// Focal length in pixels.
    pub(super) focal: f32,
    /// Metres above the ground.
    pub(super) height: f32,
    /// Screen position of the vanishing point straight ahead: pan and shake move it.
    pub(super) centre: (f32, f32),
}

impl Camera {
    /// Pixels per metre at depth `z`.
    pub(super) fn scale(&self, z: f32) -> f32 {
        self.focal / z
    }

    /// Screen position of a world point.
    pub(super) fn project(&self, x: f32, y: f32, z: f32) -> (f32, f32) {
        let s = self.scale(z);
        (self.centre.0 + x * s, self.centre.1 + (self.height - y) * s)
    }
}

/// Street lamps stand at these places `(x, z)`.
pub(super) const LAMPS: [(f32, f32); 3] = [(-7.5, 18.4), (1.55, 18.4), (10.5, 18.4)];

/// Light on the scene; every field in linear radiance.
#[derive(Clone, Copy, Debug)]
pub(super) struct Light {
    /// Sky light.
    pub(super) ambient: [f32; 3],
    /// Street lamps, 0 off to 1 on.
    pub(super) lamps: f32,
    /// 0 dusk, 1 night.
    pub(super) night: f32,
}

impl Light {
    /// Light at `t` in `[0, 1]` of the clip: dusk, a night that falls fast, then street lamps that
    /// warm up slowly.
    pub(super) fn at(t: f32) -> Self {
        let night = smooth(0.20, 0.47, t);
        Self {
            ambient: [mix(0.66, 0.024, night), mix(0.62, 0.027, night), mix(0.64, 0.038, night)],
            lamps: smooth(0.60, 0.80, t),
            night,
        }
    }

    /// Texel of a surface of this reflectance and temperature at ground position `(x, z)`.
    pub(super) fn shade(&self, albedo: [f32; 3], temperature: f32, (x, z): (f32, f32)) -> Texel {
        let mut lamp = 0.0;
        for (lx, lz) in LAMPS {
            let (dx, dz) = (x - lx, z - lz);
            lamp += 1.0 / (1.0 + (dx * dx + dz * dz) / 60.0);
        }
        let lamp = lamp * self.lamps * 0.36;
        let [r, g, b] = albedo;
        [
            r * (self.ambient[0] + lamp),
            g * (self.ambient[1] + lamp * 0.82),
            b * (self.ambient[2] + lamp * 0.56),
            temperature,
        ]
    }
}
