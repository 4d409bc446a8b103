//! How far apart the sensors are, in figures. Definitions: `docs/alignment.md`.

use super::descriptors::{Role, Views, mean};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::BTreeMap;

/// Resamples of the bootstrap over sequences.
const RESAMPLES: usize = 1000;
/// Cosine distances below this are rounding.
const LEAST_DISTANCE: f64 = 1e-12;

/// Mean cosines between a template's and a search crop's descriptor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Cosines {
    /// Same target, different sensors.
    pub cross: f64,
    /// Same target, same sensor.
    pub same: f64,
    /// Targets of different sequences, same sensor; none with a single sequence.
    pub other: Option<f64>,
}

/// A figure with the 95 % interval of a bootstrap over sequences.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Interval {
    /// The figure.
    pub value: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The figures of one stage. Ratios are none where their denominator vanishes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Measures {
    /// Alignment ratio `R`: mean cosine distance of a target's template and search descriptor across
    /// sensors, over that within a sensor; descriptors centred per role. 1 is aligned.
    pub r: Option<Interval>,
    /// `R` with RGB templates and thermal search crops only.
    pub r_rgb_to_thermal: Option<f64>,
    /// `R` with thermal templates and RGB search crops only.
    pub r_thermal_to_rgb: Option<f64>,
    /// `R` of descriptors as they are, not centred.
    pub r_uncentred: Option<f64>,
    /// Mean cosine distance across sensors, same target, over that within a sensor, different
    /// targets; centred. From 1 on, a change of sensor costs as much as a change of target.
    pub separation: Option<f64>,
    /// Cosines of centred descriptors.
    pub cosine: Cosines,
    /// Cosines of descriptors as they are.
    pub cosine_uncentred: Cosines,
    /// Distance of the sensors' centroids over the mean spread (root mean square distance from the
    /// centroid) within a sensor; mean of both roles.
    pub gap: Option<f64>,
    /// The same of templates alone.
    pub gap_template: Option<f64>,
    /// The same of search crops alone.
    pub gap_search: Option<f64>,
}

impl Measures {
    /// The figures of a stage; `centred` is [`Views::centred`] of `targets`, `seed` that of the
    /// bootstrap.
    pub fn of(targets: &[Views], centred: &[Views], seed: u64) -> Self {
        let sums = Sums::of(centred);
        let raw = Sums::of(targets);
        let (cosine, cosine_uncentred) = (sums.cosines(), raw.cosines());
        let same = 1.0 - cosine.same;
        let gap_template = gap(targets, Role::Template);
        let gap_search = gap(targets, Role::Search);
        Self {
            r: sums.interval(seed),
            r_rgb_to_thermal: ratio(1.0 - sums.direction(0), same),
            r_thermal_to_rgb: ratio(1.0 - sums.direction(1), same),
            r_uncentred: ratio(1.0 - cosine_uncentred.cross, 1.0 - cosine_uncentred.same),
            separation: cosine.other.and_then(|other| ratio(1.0 - cosine.cross, 1.0 - other)),
            cosine,
            cosine_uncentred,
            gap: gap_template.zip(gap_search).map(|(a, b)| 0.5 * (a + b)),
            gap_template,
            gap_search,
        }
    }
}

fn ratio(above: f64, below: f64) -> Option<f64> {
    (below > LEAST_DISTANCE).then(|| above / below)
}

/// A vector at length 1; a zero vector stays one and is at cosine 0 to everything.
fn unit(v: &[f64]) -> Vec<f64> {
    let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    if norm > 0.0 { v.iter().map(|x| x / norm).collect() } else { v.to_vec() }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Cosines of one sequence's targets, added up.
#[derive(Clone, Debug, Default)]
struct GroupSums {
    targets: f64,
    /// By sensor of the template.
    cross: [f64; 2],
    same: f64,
    /// Unit vectors of same-sensor views, by sensor, templates and search crops.
    units: [[Vec<f64>; 2]; 2],
}

struct Sums {
    groups: Vec<GroupSums>,
}

impl Sums {
    fn of(targets: &[Views]) -> Self {
        let mut groups: BTreeMap<usize, GroupSums> = BTreeMap::new();
        for t in targets {
            let sums = groups.entry(t.group).or_default();
            sums.targets += 1.0;
            for s in 0..2 {
                let template = unit(t.at(Role::Template, s, s));
                let search = unit(t.at(Role::Search, s, s));
                sums.same += 0.5 * dot(&template, &search);
                for (sum, unit) in sums.units[s].iter_mut().zip([template, search]) {
                    sum.resize(unit.len(), 0.0);
                    sum.iter_mut().zip(&unit).for_each(|(s, u)| *s += u);
                }
                let other = 1 - s;
                let template = unit(t.at(Role::Template, s, other));
                let search = unit(t.at(Role::Search, other, s));
                sums.cross[s] += dot(&template, &search);
            }
        }
        Self { groups: groups.into_values().collect() }
    }

    fn mean(&self, figure: impl Fn(&GroupSums) -> f64) -> f64 {
        let targets: f64 = self.groups.iter().map(|g| g.targets).sum();
        self.groups.iter().map(figure).sum::<f64>() / targets
    }

    fn direction(&self, template: usize) -> f64 {
        self.mean(|g| g.cross[template])
    }

    fn cosines(&self) -> Cosines {
        Cosines {
            cross: 0.5 * (self.direction(0) + self.direction(1)),
            same: self.mean(|g| g.same),
            other: self.other(),
        }
    }

    /// Mean cosine over all template-search pairs of different sequences within a sensor: that of
    /// all pairs less that within sequences, both from sums of unit vectors.
    fn other(&self) -> Option<f64> {
        let targets: f64 = self.groups.iter().map(|g| g.targets).sum();
        let within: f64 = self.groups.iter().map(|g| g.targets * g.targets).sum();
        let pairs = targets * targets - within;
        let mut sum = 0.0;
        for s in 0..2 {
            let [templates, searches] = [0, 1].map(|role: usize| {
                let d = self.groups.first().map_or(0, |g| g.units[s][role].len());
                let mut all = vec![0.0; d];
                for g in &self.groups {
                    all.iter_mut().zip(&g.units[s][role]).for_each(|(a, u)| *a += u);
                }
                all
            });
            sum += dot(&templates, &searches);
            sum -= self.groups.iter().map(|g| dot(&g.units[s][0], &g.units[s][1])).sum::<f64>();
        }
        (pairs > 0.0).then(|| sum / (2.0 * pairs))
    }

    /// `R` with its interval.
    fn interval(&self, seed: u64) -> Option<Interval> {
        let distances: Vec<[f64; 2]> = self
            .groups
            .iter()
            .map(|g| [g.targets - 0.5 * (g.cross[0] + g.cross[1]), g.targets - g.same])
            .collect();
        let of = |picked: &mut dyn Iterator<Item = usize>| {
            let [cross, same] = picked.fold([0.0; 2], |[cross, same], i| {
                [cross + distances[i][0], same + distances[i][1]]
            });
            ratio(cross, same)
        };
        let n = distances.len();
        let value = of(&mut (0..n))?;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut drawn: Vec<f64> = (0..RESAMPLES)
            .filter_map(|_| of(&mut (0..n).map(|_| rng.random_range(0..n))))
            .collect();
        drawn.sort_by(f64::total_cmp);
        let at = |share: f64| {
            let last = drawn.len().saturating_sub(1) as f64;
            drawn.get((share * last).round() as usize).copied().unwrap_or(value)
        };
        Some(Interval { value, low: at(0.025), high: at(0.975) })
    }
}

fn gap(targets: &[Views], role: Role) -> Option<f64> {
    let of = |sensor: usize| targets.iter().flat_map(move |t| t.all(role, sensor));
    let apart = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
    let centroids = [mean(of(0)), mean(of(1))];
    let spread = |sensor: usize| {
        let (sum, n) = of(sensor)
            .fold((0.0, 0usize), |(sum, n), v| (sum + apart(v, &centroids[sensor]), n + 1));
        (sum / n.max(1) as f64).sqrt()
    };
    let within = 0.5 * (spread(0) + spread(1));
    (within > LEAST_DISTANCE).then(|| apart(&centroids[0], &centroids[1]).sqrt() / within)
}
