//! NanoTrack's backbones against independent figures, published weights included.

use super::{
    NO_DROPOUT, committed, difference, gradients, recipe_image, recipe_net, stream, tiny, values,
};
use crate::import::{self, ImportKind, ImportOptions, StateDict, load_backbone};
use crate::model::{FreezePolicy, NetOptions, TrackerNet};
use burn::prelude::*;
use std::path::{Path, PathBuf};
use tsda_runtime::{Backbone, ModelSpec};

const BACKBONES: [(Backbone, &str); 2] =
    [(Backbone::NanoTrackV2, "v2"), (Backbone::NanoTrackV3, "v3")];

fn spec(backbone: Backbone) -> ModelSpec {
    ModelSpec { backbone, ..tiny() }
}

/// Plain and fast road of the backbone on one crop of 64 x 64, against a committed figure.
fn check(net: &TrackerNet, crop: Vec<f32>, figure: &str) {
    let crop = Tensor::<4>::from_data(TensorData::new(crop, [1, 3, 64, 64]), &Device::flex());
    let want = committed("nanotrack_64.safetensors");
    let want = &want.get(figure).unwrap().values;
    let peak = want.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let plain = net.feature_extractor.forward(crop.clone(), net.frozen);
    let wide = net.feature_extractor.forward_wide(crop, net.frozen).swap_dims(0, 1);
    for (road, map) in [("plain", plain), ("wide", wide)] {
        let off = difference(&values(map), want);
        println!("{figure}, {road}: {:.1e} of the largest value", off / peak);
        assert!(off <= 1e-5 * peak, "{figure}, {road}: off by {off} of {peak}");
    }
}

#[test]
fn nanotrack_equals_a_numpy_reference() {
    for (backbone, version) in BACKBONES {
        let net = recipe_net(&spec(backbone), &NO_DROPOUT, &Device::flex());
        check(&net, recipe_image(0, 64), &format!("recipe_{version}"));
    }
}

fn published(version: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join(format!("../../shared/data/backbones/nanotrack_{version}_state_dict.safetensors"));
    if !path.exists() {
        println!("skipped: {} is not there", path.display());
        return None;
    }
    Some(path)
}

#[test]
fn published_weights_give_the_published_networks_numbers() {
    // The figures were made with B, G, R; after the import the same picture is given as R, G, B.
    let pixel = |c: usize, y: usize, x: usize| ((x * 7 + y * 13 + c * 29 + x * y) % 256) as f32;
    let crop: Vec<f32> =
        (0..3 * 64 * 64).map(|i| pixel(2 - i / 4096, i / 64 % 64, i % 64)).collect();
    for (backbone, version) in BACKBONES {
        let Some(path) = published(version) else { return };
        let net = TrackerNet::new(&spec(backbone), &NO_DROPOUT, &Device::flex()).unwrap();
        let (direct, report) = load_backbone(net.clone(), &path).unwrap();
        assert!(report.unused.iter().any(|name| name.starts_with("ban_head.")));
        check(&direct, crop.clone(), &format!("published_{version}"));
        // And by way of the command, whose output is not turned a second time.
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("backbone.safetensors");
        let given = import::Given::Nothing;
        let options = ImportOptions { kind: None, input: path, output: output.clone(), given };
        let summary = import::run(&options).unwrap();
        assert_eq!((summary.kind, summary.backbone), (ImportKind::NanoTrack, Some(backbone)));
        let text = summary.to_string();
        for words in ["nanotrack (detected)", "not needed ban_head.*: ", "not needed neck.*: 5"] {
            assert!(text.contains(words), "{words}:\n{text}");
        }
        assert!(summary.flipped && text.contains("B, G, R"), "{text}");
        let (imported, _) = load_backbone(net, &output).unwrap();
        assert!(import::state_dict(&imported).get(STEM) == import::state_dict(&direct).get(STEM));
        assert!(StateDict::read(&output).unwrap().names().all(|n| n.starts_with("feature_ex")));
    }
}

const STEM: &str = "feature_extractor.features.0.0.weight";

#[test]
fn the_fast_road_has_the_gradients_of_the_plain_one() {
    let plain = Device::flex();
    let random = |name: &str, n: usize| -> Vec<f32> {
        stream(name).take(n).map(|z| (z >> 40) as f32 / 8_388_608.0 - 1.0).collect()
    };
    let spec = spec(Backbone::NanoTrackV3);
    let (s, f) = (spec.crop_side(), spec.map_side());
    let crops = TensorData::new(random("x", 9 * s * s), [3, 3, s, s]);
    let crops = Tensor::<4>::from_data(crops, &plain);
    // Values with a gradient of their own for every output.
    let weight = TensorData::new(random("w", 3 * 32 * f * f), [3, 32, f, f]);
    let weight = Tensor::<4>::from_data(weight, &plain);
    for (freeze, first) in [(FreezePolicy::BeforeStride16, 4), (FreezePolicy::Leading(0), 1)] {
        let options = NetOptions { freeze, ..NO_DROPOUT };
        let net = recipe_net(&spec, &options, &Device::flex().autodiff());
        let run = |features: Tensor<4>| {
            let gradient = (features.clone() * weight.clone()).sum().backward();
            (values(features), gradients(&net, &gradient))
        };
        let (fast, fast_gradients) = run(net.training_features(crops.clone()));
        let (slow, slow_gradients) = run(net.features(crops.clone()));
        assert!(difference(&fast, &slow) <= 1e-5);
        let names: Vec<&str> = slow_gradients.names().collect();
        assert_eq!(names, fast_gradients.names().collect::<Vec<_>>());
        let trains = |i: usize| names.iter().any(|n| n.contains(&format!(".features.{i}.conv.")));
        assert!((0..=9).all(|i| trains(i) == (i >= first)), "{names:?}");
        assert!(names.iter().any(|n| n.contains(".fc.2.")), "{names:?}");
        for name in &names {
            let [a, b] = [&fast_gradients, &slow_gradients].map(|g| &g.get(name).unwrap().values);
            let scale = b.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            let off = difference(a, b);
            assert!(off <= 2e-4 * scale, "{freeze:?} {name}: off by {off} of {scale}");
        }
    }
}
