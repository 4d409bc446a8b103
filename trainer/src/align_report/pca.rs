//! Principal components of small sets of vectors.

/// Rotations are repeated until the off-diagonal part has vanished; a matrix of any size here needs
/// fewer than ten rounds.
const SWEEPS: usize = 60;

/// The leading components.
#[derive(Clone, Debug, PartialEq)]
pub struct Pca {
    /// Mean of the vectors, `(d)`.
    pub mean: Vec<f64>,
    /// Unit vectors by falling variance, `(k, d)`. The sign is the one that makes the entry of
    /// largest magnitude (the first of them) positive.
    pub components: Vec<Vec<f64>>,
    /// Share of the total variance along each component; all 0 when nothing varies.
    pub explained: Vec<f64>,
}

impl Pca {
    /// The first `k` components (fewer when there are fewer dimensions) of vectors of one length.
    pub fn fit(rows: &[&[f64]], k: usize) -> Self {
        let d = rows.first().map_or(0, |r| r.len());
        let count = rows.len().max(1) as f64;
        let mut mean = vec![0.0; d];
        for row in rows {
            mean.iter_mut().zip(*row).for_each(|(m, v)| *m += v / count);
        }
        let mut covariance = vec![0.0; d * d];
        let mut centred = vec![0.0; d];
        for row in rows {
            centred.iter_mut().zip(*row).zip(&mean).for_each(|((c, v), m)| *c = v - m);
            for i in 0..d {
                let scale = centred[i] / (count - 1.0).max(1.0);
                let line = &mut covariance[i * d..][..d];
                line.iter_mut().zip(&centred).for_each(|(s, c)| *s += scale * c);
            }
        }
        let total: f64 = (0..d).map(|i| covariance[i * d + i]).sum();
        let (values, vectors) = symmetric_eigen(covariance, d);
        let mut order: Vec<usize> = (0..d).collect();
        order.sort_by(|&a, &b| values[b].total_cmp(&values[a]));
        order.truncate(k);
        let share = |&i: &usize| if total > 0.0 { values[i].max(0.0) / total } else { 0.0 };
        Self {
            mean,
            explained: order.iter().map(share).collect(),
            components: order.iter().map(|&i| signed(&vectors[i * d..][..d])).collect(),
        }
    }

    /// Coordinates of a vector along the components.
    pub fn project(&self, row: &[f64]) -> Vec<f64> {
        let along = |component: &Vec<f64>| {
            component.iter().zip(row).zip(&self.mean).map(|((c, v), m)| c * (v - m)).sum()
        };
        self.components.iter().map(along).collect()
    }
}

fn signed(vector: &[f64]) -> Vec<f64> {
    let largest = vector.iter().fold(0.0f64, |most, v| {
        // A tie within rounding keeps the first, so that the sign does not hang on the last bit.
        if v.abs() > most.abs() * (1.0 + 1e-9) { *v } else { most }
    });
    let sign = if largest < 0.0 { -1.0 } else { 1.0 };
    vector.iter().map(|v| v * sign).collect()
}

/// Eigenvalues and eigenvectors (row `i` belongs to value `i`) of a symmetric row-major `d x d`
/// matrix by cyclic Jacobi rotations: deterministic, and at ease with repeated eigenvalues.
fn symmetric_eigen(mut a: Vec<f64>, d: usize) -> (Vec<f64>, Vec<f64>) {
    let mut v = vec![0.0; d * d];
    (0..d).for_each(|i| v[i * d + i] = 1.0);
    let norm: f64 = a.iter().map(|x| x * x).sum();
    for _ in 0..SWEEPS {
        let off: f64 = (0..d)
            .flat_map(|i| (0..i).map(move |j| (i, j)))
            .map(|(i, j)| a[i * d + j] * a[i * d + j])
            .sum();
        if off <= norm * 1e-28 {
            break;
        }
        for p in 0..d {
            for q in p + 1..d {
                rotate(&mut a, &mut v, d, p, q);
            }
        }
    }
    ((0..d).map(|i| a[i * d + i]).collect(), v)
}

/// Zeroes the entry `(p, q)`.
fn rotate(a: &mut [f64], v: &mut [f64], d: usize, p: usize, q: usize) {
    let apq = a[p * d + q];
    if apq == 0.0 {
        return;
    }
    let theta = (a[q * d + q] - a[p * d + p]) / (2.0 * apq);
    let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
    let c = 1.0 / t.hypot(1.0);
    let s = t * c;
    for k in 0..d {
        let (x, y) = (a[k * d + p], a[k * d + q]);
        a[k * d + p] = c * x - s * y;
        a[k * d + q] = s * x + c * y;
    }
    let turn = |m: &mut [f64]| {
        let (head, tail) = m.split_at_mut(q * d);
        for (x, y) in head[p * d..][..d].iter_mut().zip(&mut tail[..d]) {
            (*x, *y) = (c * *x - s * *y, s * *x + c * *y);
        }
    };
    turn(a);
    turn(v);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: &[f64], b: &[f64]) -> bool {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12)
    }

    #[test]
    fn hand_computed_components() {
        let root = 0.5f64.sqrt();
        // The cross (+-2 along x, +-1 along y): variances 8/3 and 2/3. Turned by 45 degrees and
        // moved, the components turn with it; the sign rule decides their direction.
        let cross = [[2.0, 0.0], [-2.0, 0.0], [0.0, 1.0], [0.0, -1.0]];
        let turned = cross.map(|[x, y]| [5.0 + root * (x - y), -3.0 + root * (x + y)]);
        let cases = [
            ("upright", cross, [0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]], [2.0, 0.0]),
            ("turned", turned, [5.0, -3.0], [[root, root], [root, -root]], [2.0, 0.0]),
        ];
        for (name, rows, mean, components, first) in cases {
            let rows: Vec<&[f64]> = rows.iter().map(|r| &r[..]).collect();
            let pca = Pca::fit(&rows, 2);
            assert!(near(&pca.mean, &mean), "{name}: {pca:?}");
            assert!(near(&pca.explained, &[0.8, 0.2]), "{name}: {pca:?}");
            for (got, want) in pca.components.iter().zip(&components) {
                assert!(near(got, want), "{name}: {pca:?}");
            }
            assert!(near(&pca.project(rows[0]), &first), "{name}: {pca:?}");
        }
    }

    #[test]
    fn components_diagonalise_any_covariance() {
        let d = 17;
        let rows: Vec<Vec<f64>> = (0..40)
            .map(|i| {
                (0..d)
                    .map(|j| ((i * 31 + j * 17 + i * j * 7) % 23) as f64 * (j + 1) as f64)
                    .collect()
            })
            .collect();
        let rows: Vec<&[f64]> = rows.iter().map(Vec::as_slice).collect();
        let pca = Pca::fit(&rows, d);
        assert!((pca.explained.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!(pca.explained.windows(2).all(|w| w[0] >= w[1]));
        let scores: Vec<Vec<f64>> = rows.iter().map(|r| pca.project(r)).collect();
        let total: f64 = scores.iter().flatten().map(|s| s * s).sum();
        for i in 0..d {
            for j in 0..=i {
                let dot: f64 = (0..d).map(|k| pca.components[i][k] * pca.components[j][k]).sum();
                assert!((dot - f64::from(u8::from(i == j))).abs() < 1e-10, "{i} {j}: {dot}");
                let sum: f64 = scores.iter().map(|s| s[i] * s[j]).sum();
                let want = if i == j { pca.explained[i] } else { 0.0 };
                assert!((sum / total - want).abs() < 1e-10, "{i} {j}: {sum}");
            }
        }
    }

    #[test]
    fn nothing_that_varies_is_no_error() {
        let row = [1.0, 2.0];
        assert_eq!(Pca::fit(&[&row, &row], 2).explained, [0.0, 0.0]);
        assert_eq!(Pca::fit(&[&[3.0]], 2).components, [[1.0]]);
        assert!(Pca::fit(&[], 2).components.is_empty());
    }
}
