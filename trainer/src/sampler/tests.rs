use super::*;
use crate::testing::{Clip, StillPair};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::collections::HashSet;

fn sampler(clips: Vec<Box<dyn Sequence>>, registered: bool, config: &SamplerConfig) -> Sampler {
    Sampler::from_sequences(clips, registered, config, Arc::new(PictureCache::new(4))).unwrap()
}

fn draws(sampler: &Sampler, n: u64) -> Vec<Drawn> {
    (0..n).map(|i| sampler.draw(&mut ChaCha8Rng::seed_from_u64(i)).unwrap()).collect()
}

#[test]
fn templates_share_a_sensor_and_half_the_searches_cross() {
    let s = sampler(StillPair::several(5), true, &SamplerConfig::default());
    let drawn = draws(&s, 600);
    let share = |f: &dyn Fn(&Drawn) -> bool| drawn.iter().filter(|d| f(d)).count() as f64 / 600.0;
    assert!(drawn.iter().all(|d| d.templates[0].at.modality == d.templates[1].at.modality));
    assert!((share(&Drawn::is_cross) - 0.5).abs() < 0.07);
    assert!((share(&|d| d.templates[0].at.modality == Modality::Rgb) - 0.5).abs() < 0.07);
    assert!((share(&|d| d.region) - 0.3).abs() < 0.07);
    assert!(drawn.iter().all(|d| d.templates[0].bbox == d.search.bbox));
}

#[test]
fn the_chance_of_crossing_is_obeyed_at_its_ends() {
    for p in [0.0, 1.0] {
        let config = SamplerConfig { cross_modal_p: p, ..Default::default() };
        let s = sampler(StillPair::several(2), true, &config);
        assert!(draws(&s, 40).iter().all(|d| d.is_cross() == (p == 1.0)));
    }
    // One sensor only: nothing to cross to.
    let config = SamplerConfig { cross_modal_p: 1.0, ..Default::default() };
    let clip = Clip { modalities: vec![Modality::Thermal], frames: 40, seen: |_, _| true };
    assert!(
        draws(&sampler(vec![Box::new(clip)], false, &config), 40).iter().all(|d| !d.is_cross())
    );
}

#[test]
fn videos_are_sampled_causally_within_the_gap_and_only_where_seen() {
    let config = SamplerConfig { gap: 10, ..Default::default() };
    let clip = Clip {
        modalities: vec![Modality::Rgb, Modality::Thermal],
        frames: 120,
        // Both ends are seen, so no base lacks a frame in reach: a base without one would widen the gap.
        seen: |f, m| match f {
            0 | 119 => true,
            _ if m == Modality::Rgb => f % 3 != 0,
            _ => f % 2 == 0,
        },
    };
    let s = sampler(vec![Box::new(clip)], false, &config);
    let mut seen_bases = HashSet::new();
    for d in draws(&s, 300) {
        let (base, earlier, search) =
            (d.templates[0].at.frame, d.templates[1].at.frame, d.search.at.frame);
        assert!(earlier < base && base < search, "{}", d.id);
        assert!(base - earlier <= 10 && search - base < 10, "{}", d.id);
        seen_bases.insert(base);
    }
    assert!(seen_bases.len() > 40);
}

#[test]
fn the_gap_widens_when_the_target_is_seldom_seen() {
    let config = SamplerConfig { gap: 3, cross_modal_p: 0.0, ..Default::default() };
    let clip = Clip { modalities: vec![Modality::Rgb], frames: 400, seen: |f, _| f % 50 == 7 };
    for d in draws(&sampler(vec![Box::new(clip)], false, &config), 30) {
        assert!(d.templates[1].at.frame < d.templates[0].at.frame);
        assert!(d.templates[0].at.frame < d.search.at.frame);
    }
}

#[test]
fn what_cannot_be_used_is_not_drawn() {
    let cache = || Arc::new(PictureCache::new(1));
    let config = SamplerConfig::default();
    let short: Vec<Box<dyn Sequence>> =
        vec![Box::new(Clip { modalities: vec![Modality::Rgb], frames: 19, seen: |_, _| true })];
    assert!(Sampler::from_sequences(short, false, &config, cache()).is_none());
    let unseen: Vec<Box<dyn Sequence>> =
        vec![Box::new(Clip { modalities: vec![Modality::Rgb], frames: 100, seen: |f, _| f < 6 })];
    assert!(Sampler::from_sequences(unseen, false, &config, cache()).is_none());
    assert!(Sampler::from_sequences(Vec::new(), true, &config, cache()).is_none());
    // Boxes below the least size count as absent; regions still work.
    let strict = SamplerConfig { min_target: 100.0, ..config };
    let s = sampler(StillPair::several(2), true, &strict);
    let mut regions = 0;
    for i in 0..50 {
        if let Ok(d) = s.draw(&mut ChaCha8Rng::seed_from_u64(i)) {
            assert!(d.region);
            regions += 1;
        }
    }
    assert_eq!(regions, 50);
}

#[test]
fn the_cache_stays_within_its_bound_and_changes_nothing() {
    let small = Arc::new(PictureCache::new(1));
    let clip = || {
        vec![Box::new(Clip { modalities: vec![Modality::Rgb], frames: 3000, seen: |_, _| true })
            as Box<dyn Sequence>]
    };
    let config = SamplerConfig { gap: 3000, ..Default::default() };
    let a = Sampler::from_sequences(clip(), false, &config, small.clone()).unwrap();
    let b = sampler(clip(), false, &config);
    for (x, y) in draws(&a, 1000).iter().zip(draws(&b, 1000)) {
        assert_eq!((&x.id, x.search.picture.data[0]), (&y.id, y.search.picture.data[0]));
    }
    assert!(small.bytes() <= 1 << 20 && small.bytes() > 1 << 19, "{}", small.bytes());
}
