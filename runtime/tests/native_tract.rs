//! The native engine and tract on the same bundle and random inputs.
#![cfg(all(feature = "native", feature = "tract"))]

use tsda_runtime::Engine;
use tsda_runtime::bundle::BundleFile;
use tsda_runtime::engine::{NativeEngine, TractEngine};

/// A simple generator, so that a failure can be repeated.
struct Random(u64);

impl Random {
    fn fill(&mut self, out: &mut [f32], scale: f32) {
        for v in out {
            self.0 = self
                .0
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            *v = ((self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0) * scale;
        }
    }
}

fn drive(engine: &mut dyn Engine, seed: u64) -> Vec<Vec<f32>> {
    let templates = usize::from(engine.spec().templates);
    let mut random = Random(seed);
    for slot in 0..=templates {
        random.fill(engine.crop_mut(), 2.0);
        engine.features().unwrap();
        if slot < templates {
            let input = engine.template_input_mut();
            random.fill(input.label, 1.0);
            random.fill(input.ltrb, 0.5);
            engine.write_template(slot).unwrap();
        }
    }
    let mut maps = Vec::new();
    for filled in 1..=templates {
        let found = engine.predict(filled).unwrap();
        maps.extend([found.scores.to_vec(), found.ltrb.to_vec()]);
    }
    maps
}

#[test]
fn random_inputs_give_what_tract_gives() {
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/nano.tsda");
    let file = BundleFile::open(shipped).unwrap();
    let bundle = file.bundle().unwrap();
    let mut native = NativeEngine::from_bundle(&bundle).unwrap();
    let mut tract = TractEngine::from_bundle(&bundle).unwrap();
    let mut largest = 0.0f32;
    for seed in 0..3 {
        for (a, b) in drive(&mut native, seed).iter().zip(&drive(&mut tract, seed)) {
            let differences = a.iter().zip(b).map(|(x, y)| (x - y).abs());
            largest =
                differences.fold(largest, |m, d| if d.is_nan() { f32::INFINITY } else { m.max(d) });
        }
    }
    println!("largest difference {largest:e}");
    assert!(largest <= 2e-5, "{largest:e}");
}
