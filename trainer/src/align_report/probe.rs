//! How well can a linear classifier tell RGB descriptors from thermal ones?
//!
//! Logistic regression with an L2 penalty, cross-validated with all descriptors of a sequence in one
//! fold: a classifier that merely knows a scene's sensors by heart gains nothing.

use serde::Serialize;

/// Folds of the cross-validation, fewer when there are fewer sequences.
const FOLDS: usize = 5;
/// Penalty on half the squared weights, against the sum of the log losses of standardised features.
const PENALTY: f64 = 1.0;
const NEWTON_STEPS: usize = 50;
/// Two-sided 95 % of the normal distribution.
const Z: f64 = 1.959_963_985;

/// One labelled vector.
#[derive(Clone, Copy, Debug)]
pub struct Example<'a> {
    /// The descriptor.
    pub values: &'a [f64],
    /// Is it from the thermal sensor?
    pub thermal: bool,
    /// Sequence it is from.
    pub group: usize,
}

/// Accuracy on sequences not trained on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ProbeResult {
    /// Share told right; 0.5 is chance.
    pub accuracy: f64,
    /// Lower end of the 95 % interval, which counts descriptors of a sequence as dependent.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// Descriptors told.
    pub examples: usize,
    /// Sequences they are from.
    pub groups: usize,
}

/// Accumulates right answers per sequence.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// `(right, told)` by sequence.
    groups: std::collections::BTreeMap<usize, (usize, usize)>,
}

impl Tally {
    /// Cross-validates on one set of examples and adds the answers. Examples of fewer than two
    /// sequences cannot be told without leakage and add nothing.
    pub fn probe(&mut self, examples: &[Example<'_>]) {
        let fold_of = folds(examples);
        for fold in 0..FOLDS {
            let of = |test: bool| -> Vec<Example<'_>> {
                examples.iter().filter(|e| (fold_of[&e.group] == fold) == test).copied().collect()
            };
            let (train, test) = (of(false), of(true));
            if train.is_empty() || test.is_empty() {
                continue;
            }
            let model = Logistic::fit(&train);
            for example in test {
                let entry = self.groups.entry(example.group).or_default();
                entry.0 += usize::from((model.logit(example.values) > 0.0) == example.thermal);
                entry.1 += 1;
            }
        }
    }

    /// The answers of another set of examples of the same sequences.
    pub fn merge(&mut self, other: &Self) {
        for (group, (right, told)) in &other.groups {
            let entry = self.groups.entry(*group).or_default();
            entry.0 += right;
            entry.1 += told;
        }
    }

    /// Accuracy with a Wilson interval on the effective number of examples: as many independent ones
    /// as would scatter the accuracy as much as the sequences do.
    pub fn result(&self) -> ProbeResult {
        let (right, told) = self.groups.values().fold((0, 0), |s, g| (s.0 + g.0, s.1 + g.1));
        let (groups, n) = (self.groups.len(), told.max(1) as f64);
        let p = right as f64 / n;
        let scatter: f64 =
            self.groups.values().map(|g| (g.0 as f64 - p * g.1 as f64).powi(2)).sum();
        let correction = groups as f64 / (groups as f64 - 1.0).max(1.0);
        let variance = correction * scatter / (n * n);
        // All sequences alike (all right, say): their number is all that is known.
        let effective =
            if variance > 0.0 { (p * (1.0 - p) / variance).min(n) } else { groups as f64 };
        let (low, high) = wilson(p, effective.max(1.0));
        ProbeResult { accuracy: p, low, high, examples: told, groups }
    }
}

fn wilson(p: f64, n: f64) -> (f64, f64) {
    let z2 = Z * Z;
    let centre = (p + z2 / (2.0 * n)) / (1.0 + z2 / n);
    let half = Z / (1.0 + z2 / n) * (p * (1.0 - p) / n + z2 / (4.0 * n * n)).sqrt();
    ((centre - half).max(0.0), (centre + half).min(1.0))
}

/// Fold of every sequence: the largest first, each to the fold with the fewest examples.
fn folds(examples: &[Example<'_>]) -> std::collections::BTreeMap<usize, usize> {
    let mut sizes = std::collections::BTreeMap::new();
    examples.iter().for_each(|e| *sizes.entry(e.group).or_insert(0usize) += 1);
    let mut order: Vec<(usize, usize)> = sizes.into_iter().collect();
    order.sort_by_key(|&(group, size)| (std::cmp::Reverse(size), group));
    let mut filled = [0usize; FOLDS];
    order
        .into_iter()
        .map(|(group, size)| {
            let fold = (0..FOLDS).min_by_key(|&f| filled[f]).unwrap_or(0);
            filled[fold] += size;
            (group, fold)
        })
        .collect()
}

/// A fitted classifier; standardises its input as the examples it was fitted on.
struct Logistic {
    mean: Vec<f64>,
    inverse: Vec<f64>,
    /// Weights, the bias last.
    weights: Vec<f64>,
}

impl Logistic {
    fn fit(examples: &[Example<'_>]) -> Self {
        let d = examples.first().map_or(0, |e| e.values.len());
        let n = examples.len() as f64;
        let mut mean = vec![0.0; d];
        let mut inverse = vec![0.0; d];
        for e in examples {
            mean.iter_mut().zip(e.values).for_each(|(m, v)| *m += v / n);
        }
        for e in examples {
            inverse
                .iter_mut()
                .zip(e.values)
                .zip(&mean)
                .for_each(|((s, v), m)| *s += (v - m) * (v - m) / n);
        }
        // A constant feature says nothing; rounding must not be blown up into a signal.
        inverse.iter_mut().zip(&mean).for_each(|(s, m)| {
            *s = if s.sqrt() > 1e-9 * m.abs() { 1.0 / s.sqrt() } else { 0.0 };
        });
        let mut model = Self { mean, inverse, weights: vec![0.0; d + 1] };
        let rows: Vec<Vec<f64>> = examples.iter().map(|e| model.features(e.values)).collect();
        let thermal: Vec<bool> = examples.iter().map(|e| e.thermal).collect();
        model.weights = newton(&rows, &thermal);
        model
    }

    /// Standardised features and a 1 for the bias.
    fn features(&self, values: &[f64]) -> Vec<f64> {
        let scaled =
            values.iter().zip(&self.mean).zip(&self.inverse).map(|((v, m), s)| (v - m) * s);
        scaled.chain([1.0]).collect()
    }

    fn logit(&self, values: &[f64]) -> f64 {
        dot(&self.features(values), &self.weights)
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Penalty of weight `i` of `size`; the bias, the last one, is free (but for what keeps the system
/// solvable).
fn penalty(i: usize, size: usize) -> f64 {
    if i + 1 == size { 1e-9 } else { PENALTY }
}

fn objective(rows: &[Vec<f64>], thermal: &[bool], w: &[f64]) -> f64 {
    let loss = |(row, &thermal): (&Vec<f64>, &bool)| {
        let margin = if thermal { dot(row, w) } else { -dot(row, w) };
        // log(1 + exp(-margin)) without overflow
        (-margin).max(0.0) + (-margin.abs()).exp().ln_1p()
    };
    let size = w.len();
    rows.iter().zip(thermal).map(loss).sum::<f64>()
        + 0.5 * w.iter().enumerate().map(|(i, w)| penalty(i, size) * w * w).sum::<f64>()
}

/// Newton's method with step halving; the objective is strictly convex, so there is one answer.
fn newton(rows: &[Vec<f64>], thermal: &[bool]) -> Vec<f64> {
    let size = rows.first().map_or(0, Vec::len);
    let mut w = vec![0.0; size];
    let mut now = objective(rows, thermal, &w);
    for _ in 0..NEWTON_STEPS {
        let mut gradient: Vec<f64> =
            w.iter().enumerate().map(|(i, w)| penalty(i, size) * w).collect();
        let mut hessian = vec![0.0; size * size];
        (0..size).for_each(|i| hessian[i * size + i] = penalty(i, size));
        for (row, &thermal) in rows.iter().zip(thermal) {
            let p = 1.0 / (1.0 + (-dot(row, &w)).exp());
            let error = p - f64::from(u8::from(thermal));
            let curvature = p * (1.0 - p);
            for i in 0..size {
                gradient[i] += error * row[i];
                let scale = curvature * row[i];
                let line = &mut hessian[i * size..][..=i];
                line.iter_mut().zip(row).for_each(|(h, v)| *h += scale * v);
            }
        }
        let step = solve(hessian, gradient, size);
        let mut share = 1.0;
        let (next, value) = loop {
            let next: Vec<f64> = w.iter().zip(&step).map(|(w, s)| w - share * s).collect();
            let value = objective(rows, thermal, &next);
            if value <= now || share < 1e-6 {
                break (next, value);
            }
            share *= 0.5;
        };
        if value >= now {
            break;
        }
        let gain = now - value;
        (w, now) = (next, value);
        if gain <= 1e-10 * now.max(1e-10) {
            break;
        }
    }
    w
}

/// Solves `a x = b` for a positive definite `a`, of which the lower triangle is read (Cholesky).
fn solve(mut a: Vec<f64>, mut b: Vec<f64>, n: usize) -> Vec<f64> {
    for i in 0..n {
        for j in 0..=i {
            let (head, tail) = a.split_at_mut(i * n);
            let row = &mut tail[..n];
            let above = if i == j { &[][..] } else { &head[j * n..][..n] };
            if i == j {
                let rest = row[i] - dot(&row[..i], &row[..i]);
                row[i] = rest.max(f64::MIN_POSITIVE).sqrt();
            } else {
                row[j] = (row[j] - dot(&row[..j], &above[..j])) / above[j];
            }
        }
        b[i] = (b[i] - dot(&a[i * n..][..i], &b[..i])) / a[i * n + i];
    }
    for i in (0..n).rev() {
        b[i] /= a[i * n + i];
        for j in 0..i {
            b[j] -= a[i * n + j] * b[i];
        }
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Descriptors of `groups` sequences, 4 of each sensor, the thermal ones moved by `shift`.
    fn cloud(groups: usize, shift: f64, seed: u64) -> Vec<(Vec<f64>, bool, usize)> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..groups * 8)
            .map(|i| {
                let thermal = i % 2 == 1;
                let mut v: Vec<f64> = (0..6).map(|_| rng.random::<f64>() * 2.0 - 1.0).collect();
                v[2] += if thermal { shift } else { 0.0 };
                (v, thermal, i / 8)
            })
            .collect()
    }

    fn run(data: &[(Vec<f64>, bool, usize)]) -> ProbeResult {
        let examples: Vec<_> =
            data.iter().map(|(v, t, g)| Example { values: v, thermal: *t, group: *g }).collect();
        let mut tally = Tally::default();
        tally.probe(&examples);
        tally.result()
    }

    #[test]
    fn accuracy_follows_the_shift() {
        let apart = run(&cloud(40, 3.0, 1));
        assert_eq!((apart.accuracy, apart.high, apart.examples, apart.groups), (1.0, 1.0, 320, 40));
        assert!(apart.low > 0.9 && apart.low < 0.95, "{apart:?}");
        // Overlap of two unit-spaced boxes of width 2: three quarters can be told.
        let half = run(&cloud(100, 1.0, 2));
        assert!((half.accuracy - 0.75).abs() < 0.05, "{half:?}");
        let same = run(&cloud(100, 0.0, 3));
        assert!(same.low < 0.5 && same.high > 0.5 && same.high - same.low < 0.12, "{same:?}");
    }

    #[test]
    fn a_sequence_is_never_trained_and_tested_on() {
        // Every sequence shows its sensor in a feature of its own sign; nothing carries over, so
        // only leakage could tell them.
        let data: Vec<_> = (0..40)
            .flat_map(|g| {
                (0..8).map(move |i| {
                    let thermal = (g % 2 == 0) ^ (i < 4);
                    let mut v = vec![0.0; 40];
                    v[g] = if i < 4 { 1.0 } else { -1.0 };
                    (v, thermal, g)
                })
            })
            .collect();
        assert_eq!(run(&data).accuracy, 0.5);
        assert_eq!(run(&data[..8]).examples, 0, "one sequence alone cannot be tested");
    }

    #[test]
    fn dependent_examples_widen_the_interval() {
        let mut data = cloud(40, 0.8, 5);
        let loose = run(&data);
        // Each sequence's examples become copies of its first two: eight times less information.
        for i in 0..data.len() {
            data[i].0 = data[i / 8 * 8 + i % 2].0.clone();
        }
        let tied = run(&data);
        assert!(tied.high - tied.low > 1.4 * (loose.high - loose.low), "{loose:?} {tied:?}");
    }

    #[test]
    fn the_fit_is_the_minimum() {
        let data = cloud(10, 1.0, 7);
        let examples: Vec<_> =
            data.iter().map(|(v, t, g)| Example { values: v, thermal: *t, group: *g }).collect();
        let model = Logistic::fit(&examples);
        let rows: Vec<Vec<f64>> = examples.iter().map(|e| model.features(e.values)).collect();
        let thermal: Vec<bool> = examples.iter().map(|e| e.thermal).collect();
        let best = objective(&rows, &thermal, &model.weights);
        for i in 0..model.weights.len() {
            for step in [-1e-3, 1e-3] {
                let mut w = model.weights.clone();
                w[i] += step;
                assert!(objective(&rows, &thermal, &w) > best, "weight {i}");
            }
        }
    }

    #[test]
    fn wilson_interval() {
        // 8 of 10: (0.4902, 0.9433), as tabulated.
        let (low, high) = wilson(0.8, 10.0);
        assert!((low - 0.4902).abs() < 1e-4 && (high - 0.9433).abs() < 1e-4, "{low} {high}");
    }
}
