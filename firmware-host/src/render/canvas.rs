//! What everything is painted on: visible radiance and apparent temperature of every pixel, so both
//! sensors see exactly the same geometry.

/// Red, green, blue radiance and apparent temperature, all roughly `[0, 1]`.
pub(super) type Texel = [f32; 4];

/// A picture of [`Texel`]s.
pub(super) struct Canvas {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) data: Vec<Texel>,
}

impl Canvas {
    pub(super) fn new(width: usize, height: usize) -> Self {
        Self { width, height, data: vec![[0.0; 4]; width * height] }
    }

    /// Paints over the pixels of a screen rectangle `(x0, y0, x1, y1)`: `paint` gets the pixel
    /// centre and answers coverage in `[0, 1]` and texel; nothing where coverage is not positive.
    pub(super) fn fill(
        &mut self,
        (x0, y0, x1, y1): (f32, f32, f32, f32),
        mut paint: impl FnMut(f32, f32) -> (f32, Texel),
    ) {
        let clamp = |v: f32, max: usize| v.clamp(0.0, max as f32) as usize;
        let columns = clamp(libm::floorf(x0), self.width)..clamp(libm::ceilf(x1), self.width);
        for y in clamp(libm::floorf(y0), self.height)..clamp(libm::ceilf(y1), self.height) {
            for x in columns.clone() {
                let (coverage, texel) = paint(x as f32 + 0.5, y as f32 + 0.5);
                if coverage > 0.0 {
                    let a = coverage.min(1.0);
                    for (d, s) in self.data[y * self.width + x].iter_mut().zip(texel) {
                        *d += (s - *d) * a;
                    }
                }
            }
        }
    }

    /// Adds light around a point, falling with the squared distance: the bloom of a lamp.
    pub(super) fn bloom(&mut self, (cx, cy): (f32, f32), radius: f32, colour: [f32; 3]) {
        let reach = radius * 9.0;
        let (width, height) = (self.width as f32, self.height as f32);
        let clamp = |v: f32, max: f32| v.clamp(0.0, max) as usize;
        for y in clamp(cy - reach, height)..clamp(cy + reach, height) {
            for x in clamp(cx - reach, width)..clamp(cx + reach, width) {
                let (dx, dy) = ((x as f32 + 0.5 - cx) / radius, (y as f32 + 0.5 - cy) / radius);
                let r2 = dx * dx + dy * dy;
                let fade = (1.0 - r2 / 81.0).max(0.0);
                let glow = fade * fade / (1.0 + r2);
                for (d, s) in self.data[y * self.width + x].iter_mut().zip(colour) {
                    *d += s * glow;
                }
            }
        }
    }
}

/// Linear blend.
pub(super) fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// Blend of two texels or colours.
pub(super) fn blend<const N: usize>(a: [f32; N], b: [f32; N], t: f32) -> [f32; N] {
    core::array::from_fn(|i| mix(a[i], b[i], t))
}

/// 0 below `lo`, 1 above `hi`, smooth between.
pub(super) fn smooth(lo: f32, hi: f32, v: f32) -> f32 {
    let t = ((v - lo) / (hi - lo)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Distance to a capsule of radius `r` around the segment `a`-`b`; negative inside.
pub(super) fn capsule(p: (f32, f32), a: (f32, f32), b: (f32, f32), r: f32) -> f32 {
    let (px, py, bx, by) = (p.0 - a.0, p.1 - a.1, b.0 - a.0, b.1 - a.1);
    let h = ((px * bx + py * by) / (bx * bx + by * by).max(1e-9)).clamp(0.0, 1.0);
    libm::hypotf(px - bx * h, py - by * h) - r
}

/// Distance to a rounded box of half sides `half` around `c`; negative inside.
pub(super) fn rounded(p: (f32, f32), c: (f32, f32), half: (f32, f32), r: f32) -> f32 {
    let (qx, qy) = ((p.0 - c.0).abs() - half.0 + r, (p.1 - c.1).abs() - half.1 + r);
    libm::hypotf(qx.max(0.0), qy.max(0.0)) + qx.max(qy).min(0.0) - r
}

/// Distance bound to a convex polygon with counter-clockwise corners (y up); negative inside.
pub(super) fn convex(p: (f32, f32), corners: &[(f32, f32)]) -> f32 {
    let mut worst = f32::NEG_INFINITY;
    for (i, a) in corners.iter().enumerate() {
        let b = corners[(i + 1) % corners.len()];
        let (ex, ey) = (b.0 - a.0, b.1 - a.1);
        let d = ((p.0 - a.0) * ey - (p.1 - a.1) * ex) / libm::hypotf(ex, ey).max(1e-6);
        worst = worst.max(d);
    }
    worst
}
