use super::descriptors::{Role, Views};
use super::measures::Measures;
use super::*;

/// A unit vector in the plane.
fn at(angle: f64) -> Vec<f64> {
    vec![angle.cos(), angle.sin()]
}

/// Targets in opposite pairs, so that nothing changes by centring; the search crop is turned by
/// `jitter` against the template, the thermal sensor by `sensor` against RGB. `shift` moves thermal
/// descriptors along the first axis.
fn targets(jitter: f64, sensor: f64, shift: f64) -> Vec<Views> {
    (0..12)
        .map(|i| {
            let angle = std::f64::consts::PI / 6.0 * f64::from(i);
            let view = |turned: f64, moved: f64| {
                let mut v = at(angle + turned);
                v[0] += moved;
                vec![v]
            };
            let role = |turned: f64| [view(turned, 0.0), view(turned + sensor, shift)];
            Views::new(i as usize, [role(0.0), role(jitter)])
        })
        .collect()
}

fn measures(targets: &[Views]) -> Measures {
    Measures::of(targets, &Views::centred(targets), 1)
}

fn near(a: Option<f64>, b: f64) -> bool {
    a.is_some_and(|a| (a - b).abs() < 1e-9)
}

#[test]
fn aligned_sensors_have_ratio_one_and_no_gap() {
    let m = measures(&targets(0.4, 0.0, 0.0));
    let r = m.r.unwrap();
    assert!(near(Some(r.value), 1.0) && near(Some(r.low), 1.0) && near(Some(r.high), 1.0), "{m:?}");
    assert!(near(m.r_rgb_to_thermal, 1.0) && near(m.r_thermal_to_rgb, 1.0), "{m:?}");
    assert!(near(m.gap, 0.0), "{m:?}");
    assert!(near(Some(m.cosine.same), 0.4f64.cos()), "{m:?}");
    // All other targets: the whole circle but the target itself.
    assert!(near(m.cosine.other, -0.4f64.cos() / 11.0), "{m:?}");
    assert!(near(m.separation, (1.0 - 0.4f64.cos()) / (1.0 + 0.4f64.cos() / 11.0)), "{m:?}");
}

#[test]
fn a_turned_sensor_has_the_ratio_of_the_angles() {
    let (a, b) = (0.4f64, 0.7f64);
    let m = measures(&targets(a, b, 0.0));
    // RGB template at 0, thermal search at a + b; thermal template at b, RGB search at a.
    let same = 1.0 - a.cos();
    assert!(near(m.r_rgb_to_thermal, (1.0 - (a + b).cos()) / same), "{m:?}");
    assert!(near(m.r_thermal_to_rgb, (1.0 - (a - b).cos()) / same), "{m:?}");
    assert!(near(m.r.map(|r| r.value), (1.0 - a.cos() * b.cos()) / same), "{m:?}");
    assert!(near(m.gap, 0.0), "a turn moves no centroid: {m:?}");
}

#[test]
fn turning_everything_changes_nothing() {
    let base = targets(0.3, 0.2, 0.5);
    let (sin, cos) = 1.1f64.sin_cos();
    let turned: Vec<Views> = base
        .iter()
        .map(|t| {
            let turn = |v: &[f64]| vec![cos * v[0] - sin * v[1], sin * v[0] + cos * v[1]];
            let of = |role| [0, 1].map(|s| t.all(role, s).map(turn).collect());
            Views::new(t.group, Role::ALL.map(of))
        })
        .collect();
    let (m, n) = (measures(&base), measures(&turned));
    for (a, b) in [
        (m.r.map(|r| r.value), n.r.map(|r| r.value)),
        (m.gap, n.gap),
        (m.separation, n.separation),
        (m.r_uncentred, n.r_uncentred),
    ] {
        assert!(near(a, b.unwrap()), "{m:?} {n:?}");
    }
}

#[test]
fn a_shifted_sensor_shows_in_ratio_and_gap() {
    let mut last = 1.0;
    for shift in [0.5, 1.0, 4.0] {
        let m = measures(&targets(0.4, 0.0, shift));
        // Points of a unit circle are at distance 1 from its centre.
        assert!(near(m.gap, shift) && near(m.gap_search, shift), "{m:?}");
        let r = m.r.unwrap();
        assert!(r.value > last && r.low < r.value && r.value < r.high, "{shift}: {m:?}");
        assert!(r.low > 1.0, "{shift}: {m:?}");
        last = r.value;
    }
}

#[test]
fn what_roles_differ_by_is_not_the_sensors_doing() {
    let mut moved = targets(0.4, 0.0, 0.0);
    for t in &mut moved {
        let of = |role: Role| {
            let shift = if role == Role::Search { 10.0 } else { 0.0 };
            [0, 1].map(|s| t.all(role, s).map(|v| vec![v[0] + shift, v[1]]).collect())
        };
        *t = Views::new(t.group, Role::ALL.map(of));
    }
    let m = measures(&moved);
    assert!(near(m.r.map(|r| r.value), 1.0) && near(m.gap, 0.0), "{m:?}");
    assert!(m.cosine_uncentred.same < 0.1, "{m:?}");
}

#[test]
fn collapsed_descriptors_have_no_ratio() {
    let one = || vec![vec![1.0, 2.0]];
    let all: Vec<Views> = (0..3).map(|g| Views::new(g, [[one(), one()], [one(), one()]])).collect();
    let m = measures(&all);
    assert_eq!((m.r_uncentred, m.gap), (None, None), "{m:?}");
    let (stage, svg) = stage("t", &all, 1);
    assert_eq!(stage.explained_variance, [0.0, 0.0]);
    assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
}

const CONFIG: &str = r#"
[model]
preset = "nano"
crop = 64
width = 16
heads = 2
feed_forward = 16
encoder_layers = 1
decoder_layers = 1
ltrb_hidden = 8
backbone = { res_net = { base_channels = 4, blocks = [1, 1, 1] } }

[[data]]
kind = "pairs"
path = "pairs"

[processing.search]
scale = 0.2
centre = 2.0
"#;

/// Six textured pairs. `inverted`: the thermal pictures are negatives; else they equal the visible
/// ones, and the sensors cannot be told apart.
fn pairs(folder: &Path, inverted: bool) {
    let mut pairs = Vec::new();
    for i in 0..6u32 {
        for sensor in ["visible", "infrared"] {
            std::fs::create_dir_all(folder.join(sensor)).unwrap();
            image::GrayImage::from_fn(96, 80, |x, y| {
                let v = ((x / 4 * 37 + y / 4 * 61 + i * 29) % 90 + 10) as u8;
                image::Luma([if inverted && sensor == "infrared" { 255 - v } else { v }])
            })
            .save(folder.join(sensor).join(format!("{i}.png")))
            .unwrap();
        }
        pairs.push(serde_json::json!({
            "id": format!("p{i}"), "split": "val",
            "visible": format!("visible/{i}.png"), "infrared": format!("infrared/{i}.png"),
            "width": 96, "height": 80,
            "boxes": [{ "xywh": [30.0 + f64::from(i), 25.0, 20.0, 24.0], "cls": "thing" }],
        }));
    }
    let index = serde_json::json!({ "pairs": pairs });
    std::fs::write(folder.join("index.json"), index.to_string()).unwrap();
}

struct Bench {
    dir: tempfile::TempDir,
    experiment: Experiment,
    options: AlignOptions,
}

impl Bench {
    fn new(inverted: bool) -> Self {
        let dir = tempfile::tempdir().unwrap();
        pairs(dir.path(), inverted);
        let experiment = Experiment::parse(CONFIG, Path::new("c.toml")).unwrap();
        // From a file: what is drawn anew depends on tests beside this one, which share burn's
        // random generator.
        let weights = dir.path().join("net.safetensors");
        let net = initial_net(&experiment, &Device::flex()).unwrap();
        import::save_weights(&net, &weights).unwrap();
        let options = AlignOptions {
            weights: WeightsFrom::File(weights),
            data: format!("pairs:{}@val", dir.path().display()),
            pairs: 20,
            seed: 3,
            batch: 8,
            device: Device::flex(),
        };
        Self { dir, experiment, options }
    }

    fn run(&self) -> Result<Alignment, AlignError> {
        run(&self.experiment, &self.options, |_| {})
    }

    fn message(&self) -> String {
        self.run().unwrap_err().to_string()
    }
}

#[test]
fn sensors_that_show_the_same_are_aligned() {
    let report = Bench::new(false).run().unwrap().report;
    for stage in [&report.pre, &report.post] {
        let m = &stage.measures;
        assert!((m.r.unwrap().value - 1.0).abs() < 1e-4, "{m:?}");
        assert!(m.gap.unwrap() < 1e-4, "{m:?}");
        // Equal descriptors get equal answers, one of the two right.
        assert!((stage.probe.both.accuracy - 0.5).abs() < 0.06, "{stage:?}");
        assert!(m.cosine.same < 0.999, "the crops differ: {m:?}");
    }
}

#[test]
fn a_negative_picture_is_found_out_and_written_down() {
    let mut bench = Bench::new(true);
    let found = bench.run().unwrap();
    let report = &found.report;
    assert_eq!((report.targets, report.width), (20, 16));
    assert!((2..=6).contains(&report.sequences));
    assert!(report.r_pre.unwrap() > 1.5, "{:?}", report.pre);
    assert_eq!(report.pre.probe.both.accuracy, 1.0, "{:?}", report.pre);
    // 20 targets, two sensors; two roles; two partners after the encoder.
    assert_eq!(report.pre.probe.template.examples, 40);
    assert_eq!(report.pre.probe.both.examples, 80);
    assert_eq!(report.post.probe.both.examples, 160);

    let out = bench.dir.path().join("deep/out");
    found.write(&out).unwrap();
    let read = |name: &str| std::fs::read_to_string(out.join(name)).unwrap();
    let json: serde_json::Value = serde_json::from_str(&read("align.json")).unwrap();
    // Reading a number may change its last digit.
    let same = |read: &serde_json::Value, r: Option<f64>| {
        let (read, r) = (read.as_f64().unwrap(), r.unwrap());
        assert!((read - r).abs() <= 1e-12 * r, "{read} is not {r}");
    };
    same(&json["r_pre"], report.r_pre);
    same(&json["post"]["r"]["value"], report.r_post);
    for (name, count) in [("align-pre.svg", 1), ("align-post.svg", 1), ("align.html", 2)] {
        let text = read(name);
        assert_eq!(text.matches("<svg ").count(), count, "{name}");
        assert_eq!(text.matches("</svg>").count(), count, "{name}");
        assert!(!text.contains("NaN") && !text.contains("{{"), "{name}");
    }
    // 20 targets in two directions and an entry of the legend per sensor.
    assert_eq!(read("align-pre.svg").matches("<circle").count(), 42);
    let table = page::table(report);
    assert!(table.contains("100.0 %") && table.lines().count() == 11, "{table}");

    // The batch decides memory, not figures; the seed decides the targets.
    bench.options.batch = 3;
    let again = bench.run().unwrap().report;
    assert!((again.r_pre.unwrap() - report.r_pre.unwrap()).abs() < 1e-4);
    assert!((again.r_post.unwrap() - report.r_post.unwrap()).abs() < 1e-4);
    bench.options.seed = 4;
    assert_ne!(bench.run().unwrap().report.r_pre, report.r_pre);
}

#[test]
fn weights_come_from_files_and_runs() {
    let mut bench = Bench::new(true);
    bench.options.pairs = 6;
    let net = bench.dir.path().join("net.safetensors");
    let root = bench.dir.path().join("run");
    let store = CheckpointStore::new(&root, 2);
    let checkpoint = store
        .write::<CheckpointError>(7, |folder| {
            std::fs::copy(&net, folder.join(WEIGHTS)).unwrap();
            Ok(())
        })
        .unwrap();
    let untrained = bench.run().unwrap().report;
    for weights in [
        WeightsFrom::Run(root.clone()),
        WeightsFrom::Run(checkpoint.path.clone()),
        WeightsFrom::File(checkpoint.path.join(WEIGHTS)),
    ] {
        bench.options.weights = weights;
        let report = bench.run().unwrap().report;
        assert_eq!((report.r_pre, report.r_post), (untrained.r_pre, untrained.r_post));
        assert!(report.weights.contains("checkpoint-000007"), "{}", report.weights);
    }
    bench.options.weights = WeightsFrom::Initial;
    assert!(bench.run().unwrap().report.r_pre.is_some());
    bench.options.weights = WeightsFrom::Run(bench.dir.path().join("visible"));
    assert!(bench.message().contains("nor a complete checkpoint"), "{}", bench.message());
    bench.options.weights = WeightsFrom::File(bench.dir.path().join("none"));
    assert!(bench.message().contains("none"), "{}", bench.message());
}

#[test]
fn bad_input_is_named() {
    let mut bench = Bench::new(true);
    bench.options.pairs = 1;
    assert!(bench.message().contains("--pairs: must be at least 2, is 1"), "{}", bench.message());
    bench.options.pairs = 4;
    bench.options.batch = 0;
    assert!(bench.message().contains("--batch"), "{}", bench.message());
    bench.options.batch = 2;

    let data = bench.options.data.clone();
    for (text, wanted) in [
        ("nothing", "expected KIND:PATH"),
        (&data.replace("pairs:", "pseudo:"), "registered pairs"),
        (&data.replace("@val", "@train"), "split 'train'"),
    ] {
        bench.options.data = text.into();
        assert!(bench.message().contains(wanted), "{text}: {}", bench.message());
    }
    bench.options.data = data;
    bench.experiment.sampler.min_target = 1000.0;
    bench.experiment.sampler.random_region_p = 0.0;
    assert!(bench.message().contains("1000 pixels"), "{}", bench.message());
}
