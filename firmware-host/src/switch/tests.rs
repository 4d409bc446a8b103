use super::health::Marks;
use super::policy::{FailurePlan, SceneMeasure, ScenePlan};
use super::*;
use proptest::prelude::*;
use std::time::Duration;
use tsda_runtime::{BBox, FrameView, PixelFormat};

fn seconds(s: f64) -> Duration {
    Duration::from_secs_f64(s)
}

fn view(data: &[u8], format: PixelFormat) -> FrameView<'_> {
    FrameView::new(data, 16, 12, format.row_bytes(16), format).expect("view")
}

#[test]
fn scenes_are_measured_in_every_format() {
    let y16 = PixelFormat::Y16 { low: 0, high: 1 };
    // format, bytes repeated, full scale, brightness.
    for (format, pattern, full, want) in [
        (PixelFormat::Gray8, vec![51u8], 255, 0.2),
        (PixelFormat::Rgb8, vec![0, 51, 255], 255, 0.2),
        (PixelFormat::Bgr8, vec![0, 51, 255], 255, 0.2),
        (PixelFormat::Yuyv, vec![126, 0, 125, 255], 255, 0.5),
        (PixelFormat::Uyvy, vec![0, 126, 255, 125], 255, 0.5),
        (PixelFormat::Nv12, vec![126, 125], 255, 0.5),
        (y16, 512u16.to_le_bytes().to_vec(), 1023, 0.5),
        (y16, 32768u16.to_le_bytes().to_vec(), u16::MAX, 0.5),
    ] {
        let data: Vec<u8> = pattern.iter().copied().cycle().take(16 * 12 * 3).collect();
        let scene = Scene::measure(&view(&data, format), full);
        assert!((scene.brightness - want).abs() < 0.01, "{format:?}: {scene:?}");
        assert!(scene.contrast < 0.01 && scene.dark == 0.0 && scene.bright == 0.0, "{scene:?}");
    }
    let half: Vec<u8> = (0..16 * 12).map(|i| if i % 2 == 0 { 0 } else { 255 }).collect();
    let scene = Scene::measure(&view(&half, PixelFormat::Gray8), 255);
    assert_eq!((scene.dark, scene.bright), (0.5, 0.5));
    assert!((scene.contrast - 0.5).abs() < 0.01);
    let mut other = half.clone();
    other[100] ^= 1;
    let other = Scene::measure(&view(&other, PixelFormat::Gray8), 255);
    assert_ne!(scene.digest, other.digest);
}

fn scene(digest: u64, brightness: f32) -> Scene {
    Scene { brightness, contrast: 0.2, dark: 0.0, bright: 0.0, digest }
}

#[test]
fn every_condition_is_seen() {
    let limits = HealthLimits { timeout_s: 0.5, frozen_s: 0.3, ..HealthLimits::default() };
    let mut watch = Watch::new(limits);
    assert_eq!(watch.condition(seconds(0.1)), Condition::Waiting);
    assert_eq!(watch.condition(seconds(0.6)), Condition::Late, "never a picture");
    let none = Marks::default();
    assert!(watch.picture(seconds(1.0), scene(1, 0.5), none));
    assert_eq!(watch.condition(seconds(1.0)), Condition::Good);
    assert_eq!(watch.condition(seconds(1.6)), Condition::Late);
    assert_eq!(watch.bad_for(seconds(1.6)), seconds(0.6));
    assert!(watch.picture(seconds(2.0), scene(2, 0.5), none));
    assert!(!watch.picture(seconds(2.2), scene(2, 0.5), none), "the same again");
    assert_eq!(watch.condition(seconds(2.2)), Condition::Good, "not for long enough");
    watch.picture(seconds(2.35), scene(2, 0.5), none);
    assert_eq!(watch.condition(seconds(2.35)), Condition::Frozen);
    for (marks, dark, bright, want) in [
        (Marks { damaged: true, shutter: false }, 0.0, 0.0, Condition::Damaged),
        (Marks { damaged: false, shutter: true }, 0.0, 0.0, Condition::Shutter),
        (none, 0.99, 0.0, Condition::Dark),
        (none, 0.0, 0.95, Condition::Saturated),
        (none, 0.9, 0.05, Condition::Good),
    ] {
        watch.picture(
            seconds(3.0),
            Scene { dark, bright, ..scene(9 + (dark * 9.0) as u64, 0.5) },
            marks,
        );
        assert_eq!(watch.condition(seconds(3.0)), want);
    }
    watch.gone();
    assert_eq!(watch.condition(seconds(3.0)), Condition::Gone);
    watch.picture(seconds(4.0), scene(77, 0.5), none);
    assert_eq!(watch.condition(seconds(4.0)), Condition::Good, "back again");
}

/// Sensors whose pictures are good, or stopped coming, or are dark.
struct Bench {
    watches: Vec<Watch>,
    policy: Policy,
    active: usize,
    n: u64,
}

impl Bench {
    fn new(plan: SwitchPlan) -> Self {
        let watches = vec![Watch::new(HealthLimits::default()); 2];
        Self { active: plan.preferred, policy: Policy::new(plan), watches, n: 0 }
    }

    /// A tenth of a second with these brightnesses; `None`: no picture. Answers a change.
    fn turn(&mut self, pictures: [Option<f32>; 2]) -> Option<(usize, Reason)> {
        self.n += 1;
        let now = seconds(self.n as f64 * 0.1);
        for (watch, picture) in self.watches.iter_mut().zip(pictures) {
            if let Some(brightness) = picture {
                watch.picture(now, scene(self.n, brightness), Marks::default());
            }
        }
        let watches = &self.watches;
        let change = self.policy.decide(now, self.active, 2, |i| &watches[i]);
        if let Some((to, _)) = change {
            self.active = to;
        }
        change
    }

    fn turns(&mut self, n: usize, pictures: [Option<f32>; 2]) -> Vec<(u64, usize, Reason)> {
        (0..n).filter_map(|_| self.turn(pictures).map(|(to, why)| (self.n, to, why))).collect()
    }
}

const GOOD: [Option<f32>; 2] = [Some(0.5), Some(0.5)];

#[test]
fn a_failed_sensor_is_left_and_taken_again() {
    let failure = FailurePlan { after: seconds(0.2), return_after: Some(seconds(0.45)) };
    let mut bench = Bench::new(SwitchPlan { failure: Some(failure), ..SwitchPlan::default() });
    assert!(bench.turns(5, GOOD).is_empty());
    let left = bench.turns(10, [None, Some(0.5)]);
    assert_eq!(left, [(11, 1, Reason::Failure(Condition::Late))], "0.5 s after turn 5");
    assert!(bench.turns(3, GOOD).is_empty(), "not for long enough");
    let back = bench.turns(5, GOOD);
    assert_eq!(back.len(), 1);
    assert_eq!((back[0].1, back[0].2), (0, Reason::Recovered));
    // With nothing to change to, nothing changes.
    assert!(bench.turns(20, [None, None]).is_empty());
}

#[test]
fn an_unplugged_sensor_is_left_at_once_and_for_good_when_told_so() {
    let failure = FailurePlan { after: seconds(5.0), return_after: None };
    let mut bench = Bench::new(SwitchPlan { failure: Some(failure), ..SwitchPlan::default() });
    bench.turns(3, GOOD);
    bench.watches[0].gone();
    let change = bench.turn([None, Some(0.5)]);
    assert_eq!(change, Some((1, Reason::Failure(Condition::Gone))));
    assert!(bench.turns(50, GOOD).is_empty());
}

#[test]
fn a_schedule_is_kept_and_a_command_stops_it() {
    let schedule = vec![(seconds(0.45), 1), (seconds(1.0), 0), (seconds(1.5), 1)];
    let mut bench = Bench::new(SwitchPlan { schedule, ..SwitchPlan::default() });
    let changes = bench.turns(12, GOOD);
    assert_eq!(changes, [(5, 1, Reason::Schedule), (10, 0, Reason::Schedule)]);
    bench.policy.set_automatic(false);
    assert!(bench.turns(10, GOOD).is_empty());
    bench.policy.set_automatic(true);
    assert!(bench.turns(10, GOOD).is_empty(), "what is past does not come again");

    let mut bench = Bench::new(SwitchPlan { every: Some(seconds(0.35)), ..SwitchPlan::default() });
    let at: Vec<u64> = bench.turns(15, GOOD).iter().map(|c| c.0).collect();
    assert_eq!(at, [4, 7, 11, 14]);
}

#[test]
fn the_scene_decides_with_hysteresis() {
    let scene = ScenePlan {
        watch: 0,
        otherwise: 1,
        measure: SceneMeasure::Brightness,
        below: 0.1,
        above: 0.2,
        hold: seconds(0.25),
    };
    let mut bench = Bench::new(SwitchPlan { scene: Some(scene), ..SwitchPlan::default() });
    assert!(bench.turns(10, [Some(0.15), Some(0.5)]).is_empty(), "between the limits");
    assert!(bench.turns(2, [Some(0.05), Some(0.5)]).is_empty(), "too short");
    assert!(bench.turns(1, GOOD).is_empty());
    let left = bench.turns(5, [Some(0.05), Some(0.5)]);
    assert_eq!(left.len(), 1);
    assert_eq!((left[0].1, left[0].2), (1, Reason::Scene { value: 0.05 }));
    assert!(bench.turns(10, [Some(0.15), Some(0.5)]).is_empty(), "between the limits");
    let back = bench.turns(5, [Some(0.25), Some(0.5)]);
    assert_eq!((back.len(), back[0].1), (1, 0));
}

fn pairs(h: &Homography, n: usize) -> Vec<Pair> {
    (0..n)
        .map(|i| {
            let from = [(i * i * 37 % 320) as f64, (i * 53 % 240) as f64];
            Pair { from, to: h.apply(from) }
        })
        .collect()
}

const TILTED: Homography =
    Homography([[0.52, 0.03, -12.0], [-0.02, 0.49, 7.5], [1e-4, -5e-5, 1.0]]);

#[test]
fn a_homography_is_found_from_exact_and_from_noisy_points() {
    let exact = pairs(&TILTED, 12);
    let found = Homography::estimate(&exact).expect("estimate");
    assert!(exact.iter().all(|p| found.residual(p) < 1e-6), "{found:?}");
    let four = Homography::estimate(&pairs(&TILTED, 4)).expect("four are enough");
    assert!(exact.iter().all(|p| four.residual(p) < 1e-4), "{four:?}");
    let mut noisy = pairs(&TILTED, 30);
    for (i, p) in noisy.iter_mut().enumerate() {
        p.to[0] += ((i * 7 % 5) as f64 - 2.0) * 0.25;
        p.to[1] += ((i * 11 % 5) as f64 - 2.0) * 0.25;
    }
    let found = Homography::estimate(&noisy).expect("estimate");
    assert!(exact.iter().all(|p| found.residual(p) < 0.5), "{found:?}");
    // A fifth of the points is wrong.
    for p in noisy.iter_mut().step_by(5) {
        p.to[0] += 40.0;
    }
    let (robust, used) = Homography::estimate_robust(&noisy, 2.0).expect("estimate");
    assert!(exact.iter().all(|p| robust.residual(p) < 0.5), "{robust:?}");
    assert_eq!(used.iter().filter(|u| !**u).count(), 6);
}

#[test]
fn points_that_fix_nothing_are_refused() {
    assert!(matches!(
        Homography::estimate(&pairs(&TILTED, 3)),
        Err(RegistrationError::TooFew { got: 3 })
    ));
    let line: Vec<Pair> = (0..10)
        .map(|i| Pair { from: [f64::from(i), 2.0 * f64::from(i)], to: [f64::from(i), 5.0] })
        .collect();
    assert_eq!(Homography::estimate(&line), Err(RegistrationError::Degenerate));
    let place = vec![Pair { from: [1.0, 1.0], to: [2.0, 2.0] }; 6];
    assert_eq!(Homography::estimate(&place), Err(RegistrationError::Degenerate));
    assert!(Homography([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).validate().is_err());
    assert!(Homography([[f64::NAN; 3]; 3]).validate().is_err());
}

#[test]
fn boxes_are_mapped_with_their_shape() {
    let near = |a: BBox, b: BBox| {
        let d = [a.x - b.x, a.y - b.y, a.w - b.w, a.h - b.h];
        assert!(d.iter().all(|v| v.abs() < 1e-3), "{a:?} {b:?}");
    };
    let b = BBox::new(100.0, 60.0, 20.0, 40.0);
    near(Homography::scaling(0.5, 0.25).map_box(&b), BBox::new(50.0, 15.0, 10.0, 10.0));
    // A quarter turn: x' = -y + 240, y' = x.
    let turned = Homography([[0.0, -1.0, 240.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]);
    near(turned.map_box(&b), BBox::new(140.0, 100.0, 40.0, 20.0));
    assert_eq!(turned.map_velocity([0.0, 0.0], [3.0, 0.0]), [0.0, 3.0]);
    let back = turned.inverse().expect("inverse");
    near(back.map_box(&turned.map_box(&b)), b);
}

proptest! {
    /// There and back is where one was, and the estimate finds any map that is one.
    #[test]
    fn maps_can_be_turned_round_and_found(
        a in 0.3f64..3.0, b in -0.2f64..0.2, c in -100f64..100.0,
        d in -0.2f64..0.2, e in 0.3f64..3.0, f in -100f64..100.0,
        g in -3e-4f64..3e-4, h in -3e-4f64..3e-4,
        x in 0f64..320.0, y in 0f64..240.0,
    ) {
        let map = Homography([[a, b, c], [d, e, f], [g, h, 1.0]]);
        let back = map.inverse().expect("inverse");
        let [u, v] = back.apply(map.apply([x, y]));
        prop_assert!((u - x).hypot(v - y) < 1e-6);
        let found = Homography::estimate(&pairs(&map, 10)).expect("estimate");
        let residual = found.residual(&Pair { from: [x, y], to: map.apply([x, y]) });
        prop_assert!(residual < 1e-3, "{}", residual);
    }
}
