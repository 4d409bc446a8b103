//! Trainer, export and engine compute the same numbers, frame after frame.

use tsda_export::{bundle, network};
use tsda_runtime::bundle::{Bundle, BundleFile, Manifest, SectionKind};
use tsda_runtime::engine::{EngineChoice, NativeEngine, NativeOptions, TractEngine};
use tsda_runtime::probe::{self, Probe};
use tsda_runtime::{BBox, Engine, FrameView, ModelSpec, Tracker, TrackerParams};
use tsda_trainer::burn_engine::BurnEngine;
use tsda_trainer::model::TrackerNet;

/// Largest difference allowed between burn and an engine on score map and ltrb.
const TOLERANCE: f32 = 1e-4;

#[test]
fn the_shipped_bundle_repeats_the_trainers_numbers() {
    let file = BundleFile::open(tsda_tests::shipped_bundle()).unwrap();
    let bundle = file.bundle().unwrap();
    let spec = bundle.manifest().spec;
    let probe = Probe::parse(bundle.require(SectionKind::Probe).unwrap(), &spec).unwrap();
    let engines = [EngineChoice::Native(NativeOptions::default()), "tract".parse().unwrap()];
    for choice in engines {
        let mut engine = choice.open(&bundle).unwrap();
        let report = probe::run(&mut engine, &probe).unwrap();
        println!("nano.tsda, {choice} against burn, probe: {:e}", report.max());
        assert!(report.max() <= TOLERANCE, "{choice}: {report:?}");
    }
}

/// The recipe picture, seen through a window that moves by 3 pixels per frame.
fn picture(wide: &[u8], t: usize) -> Vec<u8> {
    let row = |y: usize| (y * WIDE + 3 * t) * 3;
    (0..HEIGHT).flat_map(|y| wide[row(y)..row(y) + WIDTH * 3].iter().copied()).collect()
}

const WIDE: usize = 360;
const WIDTH: usize = 320;
const HEIGHT: usize = 240;

#[test]
fn burn_and_the_engines_drive_the_tracker_alike() {
    let spec = ModelSpec::NANO;
    // Random weights: nothing in this test depends on what ships.
    let net = network::untrained(&spec, 3).unwrap();
    // Every frame counts as found and is learnt, so that both slots and all graphs are used.
    let tracker =
        TrackerParams { not_found: 0.0, write_confidence: 0.0, ..TrackerParams::default() };
    let manifest = Manifest { tracker, ..Manifest::new("random", spec) };
    let bytes =
        bundle::encode(&manifest, &network::files(&network::graphs(&net).unwrap())).unwrap();
    let bundle = Bundle::parse(&bytes).unwrap();
    alike(&net, TractEngine::from_bundle(&bundle).unwrap(), tracker);
    alike(&net, NativeEngine::from_bundle(&bundle).unwrap(), tracker);
}

fn alike(net: &TrackerNet, engine: impl Engine, tracker: TrackerParams) {
    let name = engine.name();

    let mut wide = vec![0; WIDE * HEIGHT * 3];
    probe::recipe_image(7, WIDE, HEIGHT, &mut wide);
    let mut a = Tracker::new(BurnEngine::new(net), tracker).unwrap();
    let mut b = Tracker::new(engine, tracker).unwrap();
    let mut worst = 0f32;
    for t in 0..8 {
        let data = picture(&wide, t);
        let view = FrameView::rgb(&data, WIDTH, HEIGHT).unwrap();
        if t == 0 {
            let target = BBox::new(120.0, 90.0, 50.0, 40.0);
            a.init(&view, target, None).unwrap();
            b.init(&view, target, None).unwrap();
            continue;
        }
        let (ta, tb) = (a.update(&view, None).unwrap(), b.update(&view, None).unwrap());
        worst = worst.max((ta.score - tb.score).abs());
        assert!((ta.score - tb.score).abs() < TOLERANCE, "frame {t}: {ta:?} {tb:?}");
        assert!(ta.bbox.iou(&tb.bbox) > 0.999, "frame {t}: {ta:?} {tb:?}");
        assert_eq!((ta.flag, ta.wrote_memory), (tb.flag, tb.wrote_memory), "frame {t}");
    }
    println!("burn against {name} through the tracker: scores differ by at most {worst:e}");
}
