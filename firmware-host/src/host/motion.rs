//! Where the target probably is while it cannot be seen: constant velocity.

use crate::switch::Homography;
use std::time::Duration;
use tsda_runtime::BBox;

/// Time over which the velocity is averaged, seconds.
const MEMORY_S: f32 = 0.25;
/// A velocity says nothing about later than this.
const HORIZON: Duration = Duration::from_millis(1500);

/// The last box and its velocity.
#[derive(Clone, Copy, Debug, Default)]
pub struct Motion {
    seen: Option<(Duration, BBox)>,
    /// Pixels per second of the centre, x and y.
    velocity: [f32; 2],
}

impl Motion {
    /// Begins anew with a box.
    pub fn start(&mut self, at: Duration, bbox: BBox) {
        *self = Self { seen: Some((at, bbox)), velocity: [0.0; 2] };
    }

    /// The box was seen.
    pub fn seen(&mut self, at: Duration, bbox: BBox) {
        if let Some((before, old)) = self.seen {
            let dt = at.saturating_sub(before).as_secs_f32();
            if dt > 1e-6 {
                let (new, old) = (bbox.centre(), old.centre());
                let step = [(new.0 - old.0) / dt, (new.1 - old.1) / dt];
                let share = 1.0 - (-dt / MEMORY_S).exp();
                for (v, s) in self.velocity.iter_mut().zip(step) {
                    *v += (s - *v) * share;
                }
            }
        }
        self.seen = Some((at, bbox));
    }

    /// Not found at this time; believed to be where it was.
    pub fn unseen(&mut self, at: Duration, bbox: BBox) {
        self.seen = Some((at, bbox));
    }

    /// Whether the last box is of this time.
    pub fn is_at(&self, at: Duration) -> bool {
        self.seen.is_some_and(|(t, _)| t == at)
    }

    /// The box at a later time.
    pub fn predict(&self, at: Duration) -> Option<BBox> {
        let (before, b) = self.seen?;
        let dt = at.saturating_sub(before).min(HORIZON).as_secs_f32();
        Some(BBox::new(b.x + self.velocity[0] * dt, b.y + self.velocity[1] * dt, b.w, b.h))
    }

    /// The same target in another sensor's picture.
    pub fn map(&mut self, registration: &Homography) {
        let Some((at, bbox)) = self.seen else { return };
        let (x, y) = bbox.centre();
        let velocity = self.velocity.map(f64::from);
        let mapped = registration.map_velocity([f64::from(x), f64::from(y)], velocity);
        self.velocity = mapped.map(|v| v as f32);
        self.seen = Some((at, registration.map_box(&bbox)));
    }

    /// Velocity of the centre in pixels per second, x and y.
    pub const fn velocity(&self) -> [f32; 2] {
        self.velocity
    }
}

/// A box moved so that its centre lies in a picture of this size.
pub fn kept_inside(bbox: BBox, width: usize, height: usize) -> BBox {
    let (x, y) = bbox.centre();
    let inside = |v: f32, n: usize| v.clamp(0.0, n as f32) - v;
    BBox::new(bbox.x + inside(x, width), bbox.y + inside(y, height), bbox.w, bbox.h)
}
