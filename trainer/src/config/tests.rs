use super::*;
use std::path::Path;

const MINIMAL: &str = "[[data]]\nkind = \"pairs\"\npath = \"p\"\n";

fn parse(text: &str) -> Result<Experiment, ConfigError> {
    Experiment::parse(text, Path::new("x.toml"))
}

#[test]
fn a_minimal_file_is_enough_and_its_resolved_copy_says_the_same() {
    let a = parse(MINIMAL).unwrap();
    assert_eq!(a.model_spec().unwrap(), ModelSpec::NANO);
    assert_eq!(a.total_steps(), 250);
    let text = a.to_toml().unwrap();
    assert!(text.contains("crop = 160"), "{text}");
    let b = parse(&text).unwrap();
    assert_eq!(b.model_spec().unwrap(), a.model_spec().unwrap());
    assert_eq!(b.optim, a.optim);
    assert_eq!(b.to_toml().unwrap(), text);
}

#[test]
fn model_fields_override_the_preset() {
    let text = format!(
        "{MINIMAL}[model]\npreset = \"tomp50\"\nwidth = 64\nbackbone = {{ res_net = {{ base_channels = 16, blocks = [1, 1, 1] }} }}\n"
    );
    let spec = parse(&text).unwrap().model_spec().unwrap();
    assert_eq!((spec.width, spec.crop, spec.backbone.out_channels()), (64, 288, 256));
}

#[test]
fn unknown_keys_are_refused_everywhere_with_their_line() {
    for table in ["model", "tracker", "sampler", "processing", "loss", "optim", "init", "run"] {
        let e = parse(&format!("{MINIMAL}[{table}]\nno_such_key = 1\n")).unwrap_err().to_string();
        assert!(e.contains("x.toml, line 5") && e.contains("no_such_key"), "{table}: {e}");
    }
    for (text, key) in [
        ("typo = 1\n", "typo"),
        ("[[data]]\nkind = \"pairs\"\npath = \"p\"\npaht = \"q\"\n", "paht"),
        ("[processing.rgb]\ngama = 1.0\n", "gama"),
        ("[processing.search]\njitter = 1.0\n", "jitter"),
        ("[optim]\nschedule = { kind = \"cosine\", flor = 0.1 }\n", "flor"),
    ] {
        let e = parse(text).unwrap_err();
        assert!(matches!(e, ConfigError::Parse { .. }) && e.to_string().contains(key), "{e}");
    }
}

#[test]
fn values_out_of_range_name_field_and_line() {
    for (table, line, field) in [
        ("optim", "lr_head = nan", "optim.lr_head"),
        ("optim", "eps = inf", "optim.eps"),
        ("optim", "eps = 0.0", "optim.eps"),
        ("optim", "clip_norm = -inf", "optim.clip_norm"),
        ("optim", "dropout = 1.0", "optim.dropout"),
        (
            "optim",
            "schedule = { kind = \"step\", at = [0.5, nan], gamma = 0.2 }",
            "optim.schedule.at",
        ),
        ("sampler", "cross_modal_p = 1.5", "sampler.cross_modal_p"),
        ("sampler", "templates = 0", "sampler.templates"),
        ("sampler", "templates = 3", "sampler.templates"),
        ("sampler", "region_max = 5.0", "sampler.region_max"),
        ("processing", "brightness = nan", "processing.brightness"),
        ("processing.thermal", "noise_sigma = inf", "processing.thermal.noise_sigma"),
        ("loss", "cls = nan", "loss.cls"),
        ("model", "crop = 150", "model.crop"),
        ("model", "search_factor = nan", "model.search_factor"),
        ("model", "preset = \"huge\"", "model.preset"),
        ("tracker", "not_found = nan", "tracker.not_found"),
        ("run", "batch = 0", "run.batch"),
        ("run", "workers = 0", "run.workers"),
        ("run", "out = \"\"", "run.out"),
        ("init", "backbone = \"\"", "init.backbone"),
    ] {
        match parse(&format!("{MINIMAL}[{table}]\n{line}\n")).unwrap_err() {
            ConfigError::Field { line: at, field: f, .. } => {
                assert_eq!((f.field.as_str(), at), (field, Some(5)), "{f}");
            }
            other => panic!("{line}: {other}"),
        }
    }
    let e = parse("[[data]]\nkind = \"pairs\"\npath = \"p\"\nweight = nan\n").unwrap_err();
    assert!(e.to_string().starts_with("x.toml, line 4: data.0.weight = NaN"), "{e}");
    let e = parse("[run]\nsteps = 3\n").unwrap_err();
    assert!(e.to_string().contains("[[data]]"), "{e}");
    let e = parse(&format!("{MINIMAL}[run]\nepochs = 0\n")).unwrap_err();
    assert!(e.to_string().contains("run.steps (or run.epochs) = 0"), "{e}");
}

#[test]
fn a_missing_file_is_named() {
    let e = Experiment::load(Path::new("no/such.toml")).unwrap_err().to_string();
    assert!(e.contains("no/such.toml"), "{e}");
}

#[test]
fn shipped_configurations_load() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let mut seen = 0;
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "toml") {
            Experiment::load(&path).unwrap();
            seen += 1;
        }
    }
    assert!(seen >= 2);
}

#[test]
fn another_backbone_brings_its_own_input_statistics() {
    let of = |text: &str| toml::from_str::<ModelConfig>(text).unwrap().spec().unwrap();
    let raw = of("preset = \"nano\"\nbackbone = \"nanotrack_v3\"");
    assert_eq!((raw.input_mean, raw.input_std), ([0.0; 3], [1.0 / 255.0; 3]));
    assert_eq!(raw, tsda_runtime::ModelSpec::PICO_V3);
    let imagenet = of("preset = \"pico\"\nbackbone = \"efficient_net_lite0\"");
    assert_eq!(imagenet, tsda_runtime::ModelSpec::NANO);
    let own = of("preset = \"pico\"\ninput_mean = [0.5, 0.5, 0.5]\ncrop = 192");
    assert_eq!((own.input_mean, own.input_std), ([0.5; 3], [1.0 / 255.0; 3]));
}
