use super::*;
use crate::config::SamplerConfig;
use crate::sampler::{PictureCache, Sampler};
use crate::testing::StillPair;
use safetensors::SafeTensors;
use std::sync::Arc;

fn spec() -> ModelSpec {
    ModelSpec { crop: 64, ..ModelSpec::NANO }
}

fn maker(config: &ProcessingConfig, seed: u64, augment: bool) -> BatchMaker {
    let sampler = Sampler::from_sequences(
        StillPair::several(4),
        true,
        &SamplerConfig::default(),
        Arc::new(PictureCache::new(8)),
    )
    .unwrap();
    BatchMaker::new(sampler, Processor::new(&spec(), config, augment), seed, 3)
}

#[test]
fn regions_equal_the_reference() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden/runtime/labels.safetensors");
    let bytes = std::fs::read(path).unwrap();
    let golden = SafeTensors::deserialize(&bytes).unwrap();
    let boxes: Vec<f32> = golden
        .tensor("boxes")
        .unwrap()
        .data()
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
        .collect();
    let regions = golden.tensor("sample_region").unwrap().data().to_vec();
    for (n, b) in boxes.chunks_exact(4).enumerate() {
        let got = sample_region(&ModelSpec::TOMP101, &BBox::new(b[0], b[1], b[2], b[3]));
        let want: Vec<bool> = regions[n * 324..][..324].iter().map(|v| *v != 0).collect();
        assert!(got == want, "box {n}: {b:?}");
    }
}

#[test]
fn the_flip_is_one_pixel_off_as_in_the_reference() {
    assert_eq!(flip_box(&BBox::new(100.0, 5.0, 30.0, 9.0), 288).x, 157.0);
}

#[test]
fn a_batch_depends_on_seed_and_step_alone() {
    let config = ProcessingConfig {
        thermal: PhotometricConfig { noise_p: 0.5, noise_sigma: 9.0, ..Default::default() },
        ..Default::default()
    };
    let (a, b) = (maker(&config, 5, true), maker(&config, 5, true));
    // b draws other steps in between; what is in its cache differs as well.
    b.step(9).unwrap();
    let first = a.step(2).unwrap();
    assert!(first == b.step(2).unwrap());
    assert!(first != a.step(3).unwrap());
    assert!(first != maker(&config, 6, true).step(2).unwrap());
}

#[test]
fn batches_have_the_shapes_they_say() {
    let batch = maker(&ProcessingConfig::default(), 1, true).step(0).unwrap();
    let (b, bt, f) = (3, 6, 16);
    assert_eq!((batch.size, batch.templates, batch.ids.len(), batch.cross.len()), (b, 2, b, b));
    assert_eq!(batch.template_crops.len(), bt * 3 * 64 * 64);
    assert_eq!(batch.search_crops.len(), b * 3 * 64 * 64);
    assert_eq!(batch.template_labels.len(), bt * f);
    assert_eq!(batch.template_ltrb.len(), bt * 4 * f);
    assert_eq!(batch.search_labels.len(), b * f);
    assert_eq!(batch.search_ltrb.len(), b * 4 * f);
    assert_eq!(batch.region.len(), b * f);
    assert!(batch.search_crops.iter().chain(&batch.template_crops).all(|v| v.is_finite()));
}

#[test]
fn without_jitter_the_target_sits_in_the_middle() {
    let still = JitterConfig { scale: 0.0, centre: 0.0, aspect: 0.0 };
    let config = ProcessingConfig { template: still, search: still, ..Default::default() };
    let maker = maker(&config, 1, false);
    for i in 0..20 {
        let sample = maker.sample(i).unwrap();
        let (t, s) = (&sample.templates[0], &sample.search);
        assert_eq!(t.bbox, s.bbox);
        if t.modality == s.modality {
            assert!(t.pixels == s.pixels);
        }
        let (cx, cy) = s.bbox.centre();
        // Crops are moved into the picture, so the target may sit off the middle.
        assert!((0.0..=64.0).contains(&cx) && (0.0..=64.0).contains(&cy), "{:?}", s.bbox);
    }
}

#[test]
fn polarity_is_turned_for_all_thermal_crops_of_a_sample_at_once() {
    let still = JitterConfig { scale: 0.0, centre: 0.0, aspect: 0.0 };
    let plain = ProcessingConfig {
        template: still,
        search: still,
        brightness: 0.0,
        grayscale_p: 0.0,
        joint_flip_p: 0.0,
        crop_flip_p: 0.0,
        ..Default::default()
    };
    let mut turned = plain.clone();
    turned.thermal.invert_p = 1.0;
    let (a, b) = (maker(&plain, 3, true), maker(&turned, 3, true));
    let (mean, std) = (spec().input_mean[0], spec().input_std[0]);
    let mut thermal = 0;
    for i in 0..20 {
        let (a, b) = (a.sample(i).unwrap(), b.sample(i).unwrap());
        for (x, y) in
            a.templates.iter().chain([&a.search]).zip(b.templates.iter().chain([&b.search]))
        {
            let (v, w) = (x.pixels[100] * std + mean, y.pixels[100] * std + mean);
            if x.modality == Modality::Thermal {
                thermal += 1;
                assert!((v + w - 1.0).abs() < 1e-4, "{v} {w}");
            } else {
                assert!((v - w).abs() < 1e-6);
            }
        }
    }
    assert!(thermal > 10);
}

#[test]
fn the_sheet_holds_every_crop() {
    let maker = maker(&ProcessingConfig::default(), 1, true);
    let samples: Vec<Sample> = (0..3).map(|i| maker.sample(i).unwrap()).collect();
    let sheet = contact_sheet(&spec(), &samples);
    assert_eq!((sheet.width(), sheet.height()), (3 * 68 + 4, 3 * 68 + 4));
    let greens = sheet.pixels().filter(|p| p.0 == [80, 255, 80]).count();
    let reds = sheet.pixels().filter(|p| p.0 == [255, 60, 60]).count();
    assert!(greens > 50 && reds > 10, "{greens} {reds}");
}
