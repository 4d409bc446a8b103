//! Buffers that live at different times share memory.

/// When a buffer is in use, and its length.
#[derive(Clone, Copy, Debug)]
pub struct Life {
    /// Floats.
    pub len: usize,
    /// First step that writes it.
    pub first: usize,
    /// Last step that uses it.
    pub last: usize,
}

impl Life {
    const fn meets(&self, other: &Self) -> bool {
        self.first <= other.last && other.first <= self.last
    }
}

/// A start for every buffer, multiples of `align`, such that buffers in use at the same time do not
/// overlap; and the length of it all. Large buffers first, each at the lowest place that is free.
pub fn place(lives: &[Life], align: usize) -> (Vec<usize>, usize) {
    let mut order: Vec<usize> = (0..lives.len()).collect();
    order.sort_by_key(|&i| (core::cmp::Reverse(lives[i].len), lives[i].first));
    let mut starts = vec![0; lives.len()];
    let mut placed: Vec<usize> = Vec::with_capacity(lives.len());
    let mut total = 0;
    for i in order {
        let mut taken: Vec<(usize, usize)> = placed
            .iter()
            .filter(|&&j| lives[j].meets(&lives[i]))
            .map(|&j| (starts[j], starts[j] + lives[j].len))
            .collect();
        taken.sort_unstable();
        let mut at = 0;
        for (start, end) in taken {
            if at + lives[i].len <= start {
                break;
            }
            at = at.max(end.next_multiple_of(align));
        }
        starts[i] = at;
        total = total.max(at + lives[i].len);
        placed.push(i);
    }
    (starts, total.next_multiple_of(align))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_chain_needs_two_buffers() {
        let life = |i| Life { len: 100, first: i, last: i + 1 };
        let lives: Vec<Life> = (0..10).map(life).collect();
        assert_eq!(place(&lives, 16).1, 2 * 112);
    }

    proptest! {
        // Miri takes minutes for more.
        #![proptest_config(ProptestConfig { cases: if cfg!(miri) { 4 } else { 256 }, ..ProptestConfig::default() })]

        #[test]
        fn buffers_in_use_together_are_apart(
            lives in prop::collection::vec((1usize..500, 0usize..20, 0usize..6), 0..40),
        ) {
            let life = |&(len, first, more): &(usize, usize, usize)| Life { len, first, last: first + more };
            let lives: Vec<Life> = lives.iter().map(life).collect();
            let (starts, total) = place(&lives, 16);
            for (i, a) in lives.iter().enumerate() {
                prop_assert!(starts[i] % 16 == 0 && starts[i] + a.len <= total);
                for (j, b) in lives.iter().enumerate().take(i) {
                    let apart = starts[i] + a.len <= starts[j] || starts[j] + b.len <= starts[i];
                    prop_assert!(apart || !a.meets(b), "{i} and {j}");
                }
            }
        }
    }
}
