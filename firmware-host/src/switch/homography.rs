//! Where a point of one sensor's picture lies in the other's: a 3 x 3 homography, and its estimate
//! from pairs of points.
//!
//! Points are in pixels with continuous edges, as in [`BBox`]: the corner of the picture is (0, 0).

use serde::{Deserialize, Serialize};
use tsda_runtime::BBox;

/// Fewest pairs of points that fix a homography.
pub const MIN_PAIRS: usize = 4;

/// A projective map of the plane, row by row.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Homography(pub [[f64; 3]; 3]);

/// A point in the first sensor's picture and the same in the second's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// x, y in the first.
    pub from: [f64; 2],
    /// x, y in the second.
    pub to: [f64; 2],
}

/// A homography that cannot be used or estimated.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RegistrationError {
    /// Not finite, or it maps the plane to a line.
    #[error("the matrix is not finite or cannot be inverted (determinant {determinant:e})")]
    Singular {
        /// Of the matrix scaled to a largest entry of 1.
        determinant: f64,
    },
    /// Too few pairs.
    #[error("{got} pairs of points; a homography needs at least {MIN_PAIRS}, better 8 or more")]
    TooFew {
        /// Pairs given.
        got: usize,
    },
    /// The points do not fix the map.
    #[error(
        "the points do not fix a homography: (nearly) all of them lie on one line or in one place; \
         spread them over the picture"
    )]
    Degenerate,
}

impl Homography {
    /// Every point stays.
    pub const IDENTITY: Self = Self([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);

    /// Scales both axes: two sensors with the same field of view and sizes in this ratio.
    pub const fn scaling(x: f64, y: f64) -> Self {
        Self([[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, 1.0]])
    }

    /// Whether it can be used.
    ///
    /// # Errors
    /// When it is not finite or singular.
    pub fn validate(&self) -> Result<(), RegistrationError> {
        let largest = self.0.iter().flatten().fold(0f64, |a, v| a.max(v.abs()));
        let determinant = self.determinant() / (largest * largest * largest);
        if self.0.iter().flatten().all(|v| v.is_finite()) && determinant.abs() > 1e-12 {
            Ok(())
        } else {
            Err(RegistrationError::Singular { determinant })
        }
    }

    fn determinant(&self) -> f64 {
        let [a, b, c] = self.0;
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0])
            + a[2] * (b[0] * c[1] - b[1] * c[0])
    }

    /// The way back.
    ///
    /// # Errors
    /// When the matrix is singular.
    pub fn inverse(&self) -> Result<Self, RegistrationError> {
        self.validate()?;
        let m = self.0;
        let minor = |r: usize, c: usize| {
            let (r0, r1) = ((r + 1) % 3, (r + 2) % 3);
            let (c0, c1) = ((c + 1) % 3, (c + 2) % 3);
            m[r0][c0] * m[r1][c1] - m[r0][c1] * m[r1][c0]
        };
        let d = self.determinant();
        Ok(Self(std::array::from_fn(|r| std::array::from_fn(|c| minor(c, r) / d))))
    }

    /// First this, then `next`.
    pub fn then(&self, next: &Self) -> Self {
        let dot = |r: usize, c: usize| (0..3).map(|k| next.0[r][k] * self.0[k][c]).sum();
        Self(std::array::from_fn(|r| std::array::from_fn(|c| dot(r, c))))
    }

    /// Where a point goes. Points on the horizon go far away, never to infinity.
    pub fn apply(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [a, b, c] = self.0.map(|r| r[0] * x + r[1] * y + r[2]);
        let c = if c.abs() < 1e-12 { 1e-12 } else { c };
        [a / c, b / c]
    }

    /// How a small step at a point is mapped: `[[dx'/dx, dx'/dy], [dy'/dx, dy'/dy]]`.
    pub fn jacobian(&self, [x, y]: [f64; 2]) -> [[f64; 2]; 2] {
        let w = self.0[2][0] * x + self.0[2][1] * y + self.0[2][2];
        let w = if w.abs() < 1e-12 { 1e-12 } else { w };
        let [u, v] = self.apply([x, y]);
        let row = |r: usize, at: f64| [0, 1].map(|c| (self.0[r][c] - at * self.0[2][c]) / w);
        [row(0, u), row(1, v)]
    }

    /// A box in the other picture: centre by the map, shape by the map's slope there. The area
    /// follows the slope exactly; a quarter turn swaps width and height.
    pub fn map_box(&self, bbox: &BBox) -> BBox {
        let (cx, cy) = bbox.centre();
        let centre = [f64::from(cx), f64::from(cy)];
        let [u, v] = self.apply(centre);
        let [[a, b], [c, d]] = self.jacobian(centre);
        let (w, h) = (f64::from(bbox.w), f64::from(bbox.h));
        // The box around the mapped box has the right shape but is too large when turned.
        let (wide, high) = (a.abs() * w + b.abs() * h, c.abs() * w + d.abs() * h);
        let shrink = ((a * d - b * c).abs() * w * h / (wide * high).max(1e-12)).sqrt();
        let (wide, high) = (wide * shrink, high * shrink);
        BBox::new((u - wide * 0.5) as f32, (v - high * 0.5) as f32, wide as f32, high as f32)
    }

    /// A velocity at a point, in the other picture.
    pub fn map_velocity(&self, at: [f64; 2], [x, y]: [f64; 2]) -> [f64; 2] {
        self.jacobian(at).map(|[a, b]| a * x + b * y)
    }

    /// Distance in pixels of the second picture between where a pair's first point goes and where
    /// the second is.
    pub fn residual(&self, pair: &Pair) -> f64 {
        let [u, v] = self.apply(pair.from);
        (u - pair.to[0]).hypot(v - pair.to[1])
    }

    /// The least-squares homography of pairs of points: normalised direct linear transform
    /// (Hartley 1997).
    ///
    /// # Errors
    /// With fewer than four pairs, or when they lie on a line.
    pub fn estimate(pairs: &[Pair]) -> Result<Self, RegistrationError> {
        if pairs.len() < MIN_PAIRS {
            return Err(RegistrationError::TooFew { got: pairs.len() });
        }
        let from = normalisation(pairs.iter().map(|p| p.from))?;
        let to = normalisation(pairs.iter().map(|p| p.to))?;
        let mut normal = [[0.0; 9]; 9];
        for pair in pairs {
            let ([x, y], [u, v]) = (from.apply(pair.from), to.apply(pair.to));
            for row in [
                [-x, -y, -1.0, 0.0, 0.0, 0.0, u * x, u * y, u],
                [0.0, 0.0, 0.0, -x, -y, -1.0, v * x, v * y, v],
            ] {
                for (i, line) in normal.iter_mut().enumerate() {
                    for (j, cell) in line.iter_mut().enumerate() {
                        *cell += row[i] * row[j];
                    }
                }
            }
        }
        let (values, vectors) = eigen(normal);
        let mut order: [usize; 9] = std::array::from_fn(|i| i);
        order.sort_by(|a, b| values[*a].total_cmp(&values[*b]));
        // With a second solution as good as the first, neither is one.
        if values[order[1]] < 1e-9 * values[order[8]] {
            return Err(RegistrationError::Degenerate);
        }
        let h: [f64; 9] = std::array::from_fn(|i| vectors[i][order[0]]);
        let h = Self([[h[0], h[1], h[2]], [h[3], h[4], h[5]], [h[6], h[7], h[8]]]);
        let found = from.then(&h).then(&to.inverse()?);
        let last = found.0[2][2];
        let scale = if last.abs() > 1e-9 { 1.0 / last } else { 1.0 };
        let found = Self(found.0.map(|r| r.map(|v| v * scale)));
        found.validate().map_err(|_| RegistrationError::Degenerate)?;
        Ok(found)
    }

    /// Like [`Self::estimate`], for pairs of which some are wrong: the homography of four pairs that
    /// most others agree with within `tolerance` pixels, refined on all of those. Answers it and
    /// whether each pair was used. The same pairs give the same answer.
    ///
    /// # Errors
    /// See [`Self::estimate`].
    pub fn estimate_robust(
        pairs: &[Pair],
        tolerance: f64,
    ) -> Result<(Self, Vec<bool>), RegistrationError> {
        if pairs.len() < MIN_PAIRS {
            return Err(RegistrationError::TooFew { got: pairs.len() });
        }
        let agreeing =
            |h: &Self| -> Vec<bool> { pairs.iter().map(|p| h.residual(p) <= tolerance).collect() };
        let count = |used: &[bool]| used.iter().filter(|u| **u).count();
        let mut best: Option<Vec<bool>> = None;
        let mut state = 0x9E37_79B9_7F4A_7C15u64;
        for _ in 0..ROBUST_ROUNDS {
            let mut four: Vec<usize> = Vec::with_capacity(MIN_PAIRS);
            while four.len() < MIN_PAIRS {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                let pick = (state >> 33) as usize % pairs.len();
                if !four.contains(&pick) {
                    four.push(pick);
                }
            }
            let sample: Vec<Pair> = four.iter().map(|&i| pairs[i]).collect();
            let Ok(h) = Self::estimate(&sample) else { continue };
            let used = agreeing(&h);
            if best.as_ref().is_none_or(|b| count(b) < count(&used)) {
                best = Some(used);
            }
        }
        let mut used = best.ok_or(RegistrationError::Degenerate)?;
        for _ in 0..3 {
            let chosen: Vec<Pair> =
                pairs.iter().zip(&used).filter(|(_, u)| **u).map(|(p, _)| *p).collect();
            let found = Self::estimate(&chosen)?;
            let next = agreeing(&found);
            if next == used || count(&next) < MIN_PAIRS {
                return Ok((found, used));
            }
            used = next;
        }
        let chosen: Vec<Pair> =
            pairs.iter().zip(&used).filter(|(_, u)| **u).map(|(p, _)| *p).collect();
        Ok((Self::estimate(&chosen)?, used))
    }
}

const ROBUST_ROUNDS: usize = 500;

/// Moves the points' mean to the origin and their mean distance from it to the square root of two.
fn normalisation(
    points: impl Iterator<Item = [f64; 2]> + Clone,
) -> Result<Homography, RegistrationError> {
    let n = points.clone().count() as f64;
    let mean = |c: usize| points.clone().map(|p| p[c]).sum::<f64>() / n;
    let (mx, my) = (mean(0), mean(1));
    let distance = points.map(|[x, y]| (x - mx).hypot(y - my)).sum::<f64>() / n;
    if !(distance.is_finite() && distance > 1e-9) {
        return Err(RegistrationError::Degenerate);
    }
    let s = std::f64::consts::SQRT_2 / distance;
    Ok(Homography([[s, 0.0, -s * mx], [0.0, s, -s * my], [0.0, 0.0, 1.0]]))
}

/// Eigenvalues and eigenvectors (columns) of a symmetric matrix: cyclic Jacobi rotations.
fn eigen(mut a: [[f64; 9]; 9]) -> ([f64; 9], [[f64; 9]; 9]) {
    let mut v: [[f64; 9]; 9] =
        std::array::from_fn(|r| std::array::from_fn(|c| f64::from(u8::from(r == c))));
    for _ in 0..60 {
        let off: f64 =
            (0..9).flat_map(|r| (0..r).map(move |c| (r, c))).map(|(r, c)| a[r][c].powi(2)).sum();
        if off < 1e-28 {
            break;
        }
        for p in 0..8 {
            for q in p + 1..9 {
                if a[p][q].abs() < 1e-300 {
                    continue;
                }
                let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
                let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
                let c = 1.0 / t.hypot(1.0);
                let s = t * c;
                for row in &mut a {
                    let (x, y) = (row[p], row[q]);
                    (row[p], row[q]) = (c * x - s * y, s * x + c * y);
                }
                let (x, y) = (a[p], a[q]);
                a[p] = std::array::from_fn(|k| c * x[k] - s * y[k]);
                a[q] = std::array::from_fn(|k| s * x[k] + c * y[k]);
                for row in &mut v {
                    let (x, y) = (row[p], row[q]);
                    (row[p], row[q]) = (c * x - s * y, s * x + c * y);
                }
            }
        }
    }
    (std::array::from_fn(|i| a[i][i]), v)
}
