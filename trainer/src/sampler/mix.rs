//! Which source a sample comes from.
//!
//! A source with one sensor only cannot give a sample across sensors. So same-sensor and
//! cross-sensor samples have chances of their own per source, chosen such that both promises of the
//! configuration hold at once: a share `p` of all samples crosses sensors, and source `i` gives the
//! share `s_i = weight_i / sum` of all samples. With `C` the shares of the sources that can cross
//! added up:
//!
//! ```text
//! P(i | cross) = s_i / C  where i can cross,  0 elsewhere
//! P(i | same)  = (s_i - p P(i | cross)) / (1 - p)
//! ```
//! When `C < p` the second line goes below zero and both cannot hold. Then `p` does: the sources
//! that can cross give the share `p`, all of it across sensors, and the others the rest, each group
//! in proportion to its weights.

use rand::{Rng, RngExt};

/// Chances under which rounding errors are taken for zero.
const NOTHING: f64 = 1e-12;

/// Chances of the sources.
#[derive(Clone, Debug)]
pub(super) struct Mix {
    cross_p: f64,
    /// Share of all samples, by source: same sensor, across sensors.
    shares: Vec<[f64; 2]>,
}

impl Mix {
    /// From `(weight, can it cross sensors)` of every source. When none can, nothing crosses.
    pub fn new(sources: &[(f64, bool)], cross_p: f64) -> Self {
        let total: f64 = sources.iter().map(|(weight, _)| weight).sum();
        let can: f64 = sources.iter().filter(|(_, cross)| *cross).map(|(w, _)| w / total).sum();
        let cross_p = if can > 0.0 { cross_p } else { 0.0 };
        let mut shares: Vec<[f64; 2]> = sources
            .iter()
            .map(|&(weight, cross)| {
                let share = weight / total;
                let across = if cross { cross_p * share / can } else { 0.0 };
                let same = share - across;
                [if same > NOTHING { same } else { 0.0 }, across]
            })
            .collect();
        let same: f64 = shares.iter().map(|s| s[0]).sum();
        if same > 0.0 {
            shares.iter_mut().for_each(|s| s[0] *= (1.0 - cross_p) / same);
        }
        Self { cross_p, shares }
    }

    /// Share of all samples that source `i` gives: same sensor, across sensors.
    pub fn share(&self, i: usize) -> [f64; 2] {
        self.shares.get(i).copied().unwrap_or_default()
    }

    /// Does the next sample cross sensors?
    pub fn draw_cross(&self, rng: &mut impl Rng) -> bool {
        rng.random_bool(self.cross_p)
    }

    /// The source of a sample; `None` when there are none.
    pub fn draw_source(&self, cross: bool, rng: &mut impl Rng) -> Option<usize> {
        let chances = || self.shares.iter().map(|s| s[usize::from(cross)]);
        let mut at = rng.random::<f64>() * chances().sum::<f64>();
        let possible = || chances().enumerate().filter(|(_, chance)| *chance > 0.0);
        for (i, chance) in possible() {
            at -= chance;
            if at < 0.0 {
                return Some(i);
            }
        }
        possible().map(|(i, _)| i).next_back()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Shares of `(source, cross)` over many draws.
    fn drawn(mix: &Mix, sources: usize) -> Vec<[f64; 2]> {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let n = 40_000;
        let mut counts = vec![[0.0; 2]; sources];
        for _ in 0..n {
            let cross = mix.draw_cross(&mut rng);
            let source = mix.draw_source(cross, &mut rng).unwrap();
            counts[source][usize::from(cross)] += 1.0 / f64::from(n);
        }
        counts
    }

    #[test]
    fn weights_are_shares_of_samples_and_the_cross_modal_share_is_kept() {
        struct Case {
            name: &'static str,
            sources: &'static [(f64, bool)],
            p: f64,
            /// Share of each source, `[same, cross]`.
            want: &'static [[f64; 2]],
        }
        let cases = [
            Case { name: "one", sources: &[(3.0, true)], p: 0.5, want: &[[0.5, 0.5]] },
            Case {
                name: "single-sensor sources leave cross-modal samples to the others",
                sources: &[(6.0, true), (4.0, false)],
                p: 0.5,
                want: &[[0.1, 0.5], [0.4, 0.0]],
            },
            Case {
                name: "several of both",
                sources: &[(2.0, true), (1.0, false), (4.0, true), (1.0, false)],
                p: 0.6,
                want: &[[0.05, 0.2], [0.125, 0.0], [0.1, 0.4], [0.125, 0.0]],
            },
            Case {
                name: "too little that can cross: the cross-modal share wins",
                sources: &[(1.0, true), (6.0, false), (3.0, false)],
                p: 0.5,
                want: &[[0.0, 0.5], [1.0 / 3.0, 0.0], [1.0 / 6.0, 0.0]],
            },
            Case { name: "none", sources: &[(1.0, false)], p: 0.5, want: &[[1.0, 0.0]] },
            Case {
                name: "all cross",
                sources: &[(1.0, true), (9.0, false)],
                p: 1.0,
                want: &[[0.0, 1.0], [0.0, 0.0]],
            },
            Case {
                name: "none cross",
                sources: &[(1.0, true), (9.0, false)],
                p: 0.0,
                want: &[[0.1, 0.0], [0.9, 0.0]],
            },
        ];
        for case in cases {
            let mix = Mix::new(case.sources, case.p);
            let got = drawn(&mix, case.sources.len());
            for (i, want) in case.want.iter().enumerate() {
                for cross in [0, 1] {
                    let exact = mix.share(i)[cross];
                    assert!((exact - want[cross]).abs() < 1e-9, "{}: {i} {exact}", case.name);
                    let off = (got[i][cross] - want[cross]).abs();
                    assert!(off < 0.01, "{}: source {i}: {:?}, not {want:?}", case.name, got[i]);
                }
            }
        }
        assert_eq!(Mix::new(&[], 0.5).draw_source(false, &mut ChaCha8Rng::seed_from_u64(1)), None);
    }
}
