//! The project's own RGB-thermal clip, drawn by formula: a street at dusk, a person walking, a car
//! passing, other people. Night falls, the visible picture goes dark, the thermal one does not care.
//!
//! Both sensors are computed from one scene, so they are registered exactly and the truth boxes are
//! exact too. Everything is integer hashes, IEEE basic arithmetic and `libm`, so the clip has the
//! same bytes on every machine.

mod canvas;
mod car;
mod light;
mod noise;
mod scenery;
mod sensor;
mod walker;

use crate::picture::Picture;
use canvas::Canvas;
use car::Car;
use light::{Camera, Light};
use tsda_runtime::{BBox, Modality};
use walker::Walker;

/// Size, length and seed of a clip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClipConfig {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Frames.
    pub frames: usize,
    /// Seed of every texture and of the noise.
    pub seed: u32,
    /// Whether a screen stands in the target's way: it vanishes after a fifth of the clip and is back
    /// for the last fifth, somewhere else in the picture.
    pub screen: bool,
}

impl Default for ClipConfig {
    fn default() -> Self {
        Self { width: 320, height: 240, frames: 96, seed: 7, screen: false }
    }
}

impl ClipConfig {
    /// Frames per second the motion is made for.
    pub const FPS: f32 = 25.0;
    /// Length of the story in seconds: shorter or longer clips tell it faster or slower.
    const STORY: f32 = 96.0 / Self::FPS;
}

/// The clip; frames are drawn on demand.
#[derive(Clone, Debug)]
pub struct Clip {
    config: ClipConfig,
    target: Walker,
    others: [Walker; 2],
    cars: [Car; 3],
}

impl Clip {
    /// A clip of this size and seed.
    pub fn new(config: ClipConfig) -> Self {
        let target = Walker {
            start: (-2.75, 11.6),
            velocity: (1.28, -0.62),
            stature: 1.78,
            jacket: [0.42, 0.07, 0.05],
            trousers: [0.07, 0.09, 0.16],
            insulation: 0.42,
            phase: 0.1,
            seed: config.seed ^ 0x101,
        };
        let others = [
            Walker {
                start: (4.0, 19.4),
                velocity: (-1.15, 0.0),
                stature: 1.68,
                jacket: [0.06, 0.065, 0.07],
                trousers: [0.16, 0.15, 0.13],
                insulation: 0.55,
                phase: 0.4,
                seed: config.seed ^ 0x202,
            },
            Walker {
                start: (3.2, 10.3),
                velocity: (0.27, 0.04),
                stature: 1.72,
                jacket: [0.10, 0.16, 0.24],
                trousers: [0.05, 0.05, 0.06],
                insulation: 0.50,
                phase: 0.7,
                seed: config.seed ^ 0x303,
            },
        ];
        let car = |x, z, speed, paint, running, salt| Car {
            start: (x, z),
            speed,
            paint,
            running,
            seed: config.seed ^ salt,
        };
        let cars = [
            car(-6.6, 17.0, 0.0, [0.30, 0.31, 0.33], false, 0x404),
            car(6.4, 17.1, 0.0, [0.05, 0.10, 0.22], false, 0x505),
            car(13.0, 15.3, -6.4, [0.46, 0.44, 0.40], true, 0x606),
        ];
        Self { config, target, others, cars }
    }

    /// Size, length and seed.
    pub fn config(&self) -> ClipConfig {
        self.config
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.config.frames
    }

    fn progress(&self, frame: usize) -> f32 {
        frame as f32 / (self.config.frames.max(2) - 1) as f32
    }

    /// Where the camera looks: it pans after the target half-heartedly and is held by hand.
    fn camera(&self, t: f32) -> Camera {
        let k = self.config.height as f32 / 240.0;
        let seconds = t * ClipConfig::STORY;
        let shake = |speed: f32, salt: u32| {
            noise::octaves(seconds * speed, 0.5, (0.01, 0.01), 3, self.config.seed ^ salt) - 0.5
        };
        let pan = -22.0 + 44.0 * canvas::smooth(0.0, 1.0, t);
        Camera {
            focal: 345.0 * k,
            height: 3.3,
            centre: (
                self.config.width as f32 * 0.5 + (12.0 * shake(1.7, 0x61) - pan) * k,
                (66.0 + 8.0 * shake(1.9, 0x62)) * k,
            ),
        }
    }

    /// The target's box in `frame` (0-based), the same for both sensors; exact, and clipped to
    /// nothing: it stays inside the picture for the whole clip.
    pub fn truth(&self, frame: usize) -> BBox {
        let t = self.progress(frame);
        self.target.bbox(&self.camera(t), t * ClipConfig::STORY)
    }

    /// Visible share of the target in `frame`, in `[0, 1]`: 1 but behind the screen.
    pub fn visible(&self, frame: usize) -> f32 {
        if !self.config.screen {
            return 1.0;
        }
        let (left, right) = scenery::screen_sides(&self.camera(self.progress(frame)));
        let b = self.truth(frame);
        1.0 - ((b.right().min(right) - b.x.max(left)) / b.w).clamp(0.0, 1.0)
    }

    /// Draws `frame` (0-based) as this sensor sees it: 3 channels for RGB, 1 for thermal.
    pub fn render(&self, frame: usize, modality: Modality, out: &mut Picture) {
        let t = self.progress(frame);
        let seconds = t * ClipConfig::STORY;
        let seed = self.config.seed;
        let (camera, light) = (self.camera(t), Light::at(t));
        let mut canvas = Canvas::new(self.config.width, self.config.height);
        let c = &mut canvas;
        scenery::backdrop(c, &camera, &light, seed);
        for (place, tall, salt) in
            [((-10.5, 30.0), 8.5, 1u32), ((2.8, 28.0), 7.0, 2), ((12.5, 26.0), 8.0, 3)]
        {
            scenery::tree(c, &camera, &light, place, tall, seed ^ (salt * 0x9100));
        }
        self.others[0].paint(c, &camera, &light, seconds);
        scenery::lamps(c, &camera, &light);
        for car in &self.cars {
            car.paint(c, &camera, &light, seconds);
        }
        // Nearer things last.
        let mut near = [&self.target, &self.others[1]];
        near.sort_by(|a, b| b.place(seconds).1.total_cmp(&a.place(seconds).1));
        for walker in near {
            walker.paint(c, &camera, &light, seconds);
        }
        scenery::post(c, &camera, &light, (0.62, 8.0), (2.3, 0.045), (0.26, 0.26));
        if self.config.screen {
            scenery::screen(c, &camera, &light, seed);
        }
        match modality {
            Modality::Rgb => sensor::visible(c, frame as u32, seed, out),
            Modality::Thermal => sensor::thermal(c, frame as u32, seed, out),
        }
    }
}

#[cfg(test)]
mod tests;
