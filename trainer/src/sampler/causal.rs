//! Frames of a video.

use crate::config::SamplerConfig;
use rand::{Rng, RngExt};

/// Causal frames of a video (spec 2.1): a base template, earlier further templates, a later search
/// frame, all within `gap`, which widens by 5 until every range has a visible frame.
pub(super) fn draw_causal(
    frames: usize,
    config: &SamplerConfig,
    template_seen: impl Fn(usize) -> bool,
    search_seen: impl Fn(usize) -> bool,
    rng: &mut impl Rng,
) -> Option<(Vec<usize>, usize)> {
    let visible = |range: std::ops::Range<usize>, seen: &dyn Fn(usize) -> bool| -> Vec<usize> {
        range.filter(|f| seen(*f)).collect()
    };
    let bases = visible(1..frames.saturating_sub(1), &template_seen);
    if bases.is_empty() {
        return None;
    }
    let mut extra = 0;
    // Past the length of the clip, widening changes nothing any more; a few draws of other bases
    // are still worth it.
    while extra <= frames + 100 {
        let base = bases[rng.random_range(0..bases.len())];
        let reach = config.gap + extra;
        let earlier = visible(base.saturating_sub(reach)..base, &template_seen);
        let later = visible(base + 1..(base + reach).min(frames), &search_seen);
        if later.is_empty() || (earlier.is_empty() && config.templates > 1) {
            extra += 5;
            continue;
        }
        let mut templates = vec![base];
        for _ in 1..config.templates {
            templates.push(earlier[rng.random_range(0..earlier.len())]);
        }
        return Some((templates, later[rng.random_range(0..later.len())]));
    }
    None
}
