use super::*;
use crate::config::SamplerConfig;
use crate::sampler::{PictureCache, Sampler};
use crate::testing::StillPair;
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
fn targets_and_regions_equal_the_reference() {
    use tsda_runtime::labels::{box_centre, gaussian, ltrb};
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/golden/runtime/labels.safetensors");
    let golden = crate::import::StateDict::read(path.as_ref()).unwrap();
    let values = |name: &str| &golden.get(name).unwrap().values;
    let spec = ModelSpec::TOMP101;
    let (cells, sigma) = (spec.cells(), spec.label_sigma_cells());
    // Kernels of even size have maps of one row and column more, centred half a cell further.
    let labels = [
        ("kernel 1", "train_label.sigma0.9.f18", 18),
        ("kernel 3", "train_label.kernel3", 18),
        ("kernel 4", "train_label.kernel4_evenpad", 19),
    ];
    let regions = [("radius 1", "sample_region", 1.0), ("radius 0", "sample_region_radius0", 0.0)];
    let mut worst = [0.0f32; 4];
    let mut inside = [0; 2];
    for (n, b) in values("boxes").chunks_exact(4).enumerate() {
        let bbox = BBox::new(b[0], b[1], b[2], b[3]);
        let off = |got: &[f32], name: &str| {
            let want = &values(name)[n * got.len()..][..got.len()];
            got.iter().zip(want).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()))
        };
        for (i, (_, name, side)) in labels.into_iter().enumerate() {
            let mut label = vec![0.0; side * side];
            gaussian(box_centre(&spec, &bbox), sigma, side, &mut label);
            worst[i] = worst[i].max(off(&label, name));
        }
        let mut edges = vec![0.0; 4 * cells];
        ltrb(&spec, &bbox, &mut edges);
        worst[3] = worst[3].max(off(&edges, "ltrb_target"));
        for (i, (what, name, radius)) in regions.into_iter().enumerate() {
            let got = region_of_radius(&spec, &bbox, radius);
            let want: Vec<bool> =
                values(name)[n * cells..][..cells].iter().map(|v| *v != 0.0).collect();
            assert!(got == want, "{what}, box {n}: {b:?}");
            inside[i] += got.iter().filter(|r| **r).count();
        }
        assert!(sample_region(&spec, &bbox) == region_of_radius(&spec, &bbox, 1.0));
    }
    for ((what, ..), off) in labels.iter().zip(worst) {
        println!("label of {what}: within {off:.1e}");
    }
    println!("ltrb: within {:.1e}; cells in regions of radius 1 and 0: {inside:?}", worst[3]);
    assert!(worst.iter().all(|off| *off <= 1e-6), "{worst:?}");
    assert_eq!(inside, [11, 19]);
}

#[test]
fn a_mirrored_crop_is_the_mirror_image_but_its_box_is_one_pixel_off() {
    let still = JitterConfig { scale: 0.0, centre: 0.0, aspect: 0.0 };
    let config = |crop_flip_p| ProcessingConfig {
        template: still,
        search: still,
        brightness: 0.0,
        grayscale_p: 0.0,
        joint_flip_p: 0.0,
        crop_flip_p,
        ..Default::default()
    };
    let (plain, turned) = (maker(&config(0.0), 3, true), maker(&config(1.0), 3, true));
    for i in 0..6 {
        let (a, b) = (plain.sample(i).unwrap(), turned.sample(i).unwrap());
        for (a, b) in
            a.templates.iter().chain([&a.search]).zip(b.templates.iter().chain([&b.search]))
        {
            let rows = a.pixels.chunks_exact(64).zip(b.pixels.chunks_exact(64));
            assert!(rows.into_iter().all(|(a, b)| a.iter().rev().eq(b)));
            // Mirrored about the edges it would be 64 - (x + w).
            assert!((b.bbox.x - (63.0 - a.bbox.right())).abs() < 1e-4, "{:?} {:?}", a.bbox, b.bbox);
            assert_eq!((a.bbox.y, a.bbox.w, a.bbox.h), (b.bbox.y, b.bbox.w, b.bbox.h));
        }
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

/// Crops as they are, in the middle.
fn unchanged() -> ProcessingConfig {
    let still = JitterConfig { scale: 0.0, centre: 0.0, aspect: 0.0 };
    ProcessingConfig {
        template: still,
        search: still,
        brightness: 0.0,
        grayscale_p: 0.0,
        joint_flip_p: 0.0,
        crop_flip_p: 0.0,
        ..Default::default()
    }
}

#[test]
fn polarity_is_turned_for_all_thermal_crops_of_a_sample_at_once() {
    let plain = unchanged();
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
fn one_sensor_is_shown_as_two_and_two_sensors_stay_as_they_are() {
    let plain = unchanged();
    let shifted = ProcessingConfig { sensor_shift_p: 1.0, ..plain.clone() };
    let (a, b) = (maker(&plain, 3, true), maker(&shifted, 3, true));
    let (mut templates, mut searches, mut cross) = (0, 0, 0);
    for i in 0..40 {
        let (a, b) = (a.sample(i).unwrap(), b.sample(i).unwrap());
        let same = |x: &Crop, y: &Crop| x.pixels == y.pixels;
        let search = same(&a.search, &b.search);
        let template = a.templates.iter().zip(&b.templates).all(|(x, y)| same(x, y));
        match (a.cross, template, search) {
            (true, true, true) => cross += 1,
            (false, false, true) => templates += 1,
            (false, true, false) => searches += 1,
            other => panic!("sample {i}: {other:?}"),
        }
    }
    assert!(cross > 5 && templates > 3 && searches > 3, "{cross} {templates} {searches}");
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
