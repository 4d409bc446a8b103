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
    for table in
        ["model", "tracker", "sampler", "processing", "loss", "align", "optim", "init", "run"]
    {
        let e = parse(&format!("{MINIMAL}[{table}]\nno_such_key = 1\n")).unwrap_err().to_string();
        assert!(e.contains("x.toml, line 5") && e.contains("no_such_key"), "{table}: {e}");
    }
    for (text, key) in [
        ("typo = 1\n", "typo"),
        ("[[data]]\nkind = \"pairs\"\npath = \"p\"\npaht = \"q\"\n", "paht"),
        ("[align.adversarial]\nlambda = 1.0\n", "lambda"),
        ("[align.contrastive]\ntau = 1.0\n", "tau"),
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
fn sources_are_checked_by_entry_and_field() {
    let second = |lines: &str| format!("{MINIMAL}[[data]]\npath = \"q\"\n{lines}\n");
    for (lines, field, say) in [
        ("kind = \"video\"", "data.1.kind", "antiuav[/registered]"),
        ("kind = \"otb/zero_based\"", "data.1.kind", "otb[/thermal|/zero-based]"),
        ("kind = \"coco\"\nname = \"a=b\"", "data.1.name", "without '='"),
        ("kind = \"coco\"\nonly = [\"\"]", "data.1.only", "non-empty"),
        ("kind = \"coco\"\nsplit = \"trian\"", "data.1.split", "\"train\""),
        ("kind = \"coco\"\nweight = 0.0", "data.1.weight", "above 0"),
    ] {
        let e = parse(&second(lines)).unwrap_err().to_string();
        assert!(e.contains(field) && e.contains(say) && e.contains("line "), "{lines}: {e}");
    }
    let twins = second(
        "kind = \"coco\"\nname = \"a\"\n[[data]]\nkind = \"coco\"\npath = \"r\"\nname = \"a\"",
    );
    let e = parse(&twins).unwrap_err().to_string();
    assert!(e.contains("data.2.name = \"a\""), "{e}");
    for (kind, sensors, regions) in [
        ("pairs", (true, true), true),
        ("antiuav", (true, true), false),
        ("antiuav/registered", (true, true), true),
        ("otb", (true, false), false),
        ("coco/thermal", (false, true), false),
    ] {
        let a = parse(&second(&format!("kind = \"{kind}\""))).unwrap();
        let source = &a.data[1];
        assert_eq!((source.label(), source.sensors()), (kind, sensors));
        assert_eq!(source.draws_regions(), regions, "{kind}");
        let set = DataSource { regions: Some(!regions), ..source.clone() };
        assert_eq!(set.draws_regions(), !regions, "{kind}");
    }
    let named = parse(&second("kind = \"got10k\"\nname = \"a\"\nonly = [\"x\"]\nregions = true"));
    let named = named.unwrap();
    assert_eq!(parse(&named.to_toml().unwrap()).unwrap().data, named.data);
}

#[test]
fn a_root_is_put_before_relative_paths_only() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("x.toml");
    let root = dir.path().join("root");
    std::fs::create_dir_all(root.join("weights")).unwrap();
    std::fs::create_dir_all(dir.path().join("p")).unwrap();
    std::fs::write(root.join("weights/b.safetensors"), "").unwrap();
    let text = format!(
        "{MINIMAL}[[data]]\nkind = \"coco\"\npath = \"/abs\"\n\
         [init]\nbackbone = \"weights/b.safetensors\"\nweights = \"w.safetensors\"\n"
    );
    std::fs::write(&file, text).unwrap();
    let plain = Experiment::load(&file).unwrap();
    assert_eq!(plain.data[0].path, dir.path().join("p"));
    assert_eq!(plain.init.backbone, "weights/b.safetensors");
    let a = Experiment::load_from(&file, Some(&root)).unwrap();
    assert_eq!(a.data[0].path, root.join("p"));
    assert_eq!(a.data[1].path, Path::new("/abs"));
    assert_eq!(Path::new(&a.init.backbone), root.join("weights/b.safetensors"));
    assert_eq!(a.init.weights, "w.safetensors");
}

#[test]
fn a_missing_file_is_named() {
    let e = Experiment::load(Path::new("no/such.toml")).unwrap_err().to_string();
    assert!(e.contains("no/such.toml"), "{e}");
}

/// Loads a configuration of the folder `configs`.
fn shipped(path: &Path) -> Experiment {
    let text = std::fs::read_to_string(path).unwrap();
    parse(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn configs() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs")
}

#[test]
fn shipped_configurations_load() {
    let mut seen = 0;
    for entry in std::fs::read_dir(configs()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "toml") {
            let experiment = shipped(&path);
            let again = parse(&experiment.to_toml().unwrap()).unwrap();
            assert_eq!(again.align.adversarial(), experiment.align.adversarial());
            assert_eq!(again.align.contrastive(), experiment.align.contrastive());
            assert!(!again.align_differs(&experiment));
            seen += 1;
        }
    }
    assert!(seen >= 10, "{seen}");
}

#[test]
fn the_ablation_on_lasher_has_the_papers_settings() {
    let rows = AlignPreset::ALL.into_iter().filter(|p| *p != AlignPreset::None);
    let mut first: Option<Experiment> = None;
    for preset in rows {
        let path = configs().join(format!("tomp101-lasher-{}.toml", preset.name()));
        let mut e = shipped(&path);
        assert_eq!(e.align.preset, preset);
        assert_eq!(e.run.out, Path::new(&format!("out/tomp101-lasher-{}", preset.name())));
        let mixed = if preset == AlignPreset::Baseline { 0.0 } else { 0.5 };
        assert_eq!((e.training_sampler().cross_modal_p, e.sampler.cross_modal_p), (mixed, 0.5));
        let spec = e.model_spec().unwrap();
        assert_eq!((spec.crop, spec.search_factor, spec.filter_size), (288, 5.0, 3));
        assert_eq!((e.total_steps(), e.run.batch, e.align_start()), (150_000, 8, 25_000));
        assert_eq!((e.loss.cls, e.loss.reg), (100.0, 5.0));
        let o = &e.optim;
        assert_eq!((o.lr_head, o.lr_backbone, o.weight_decay), (1e-4, 1e-5, 1e-4));
        assert_eq!(crate::fit::lr_factor(o, 99_999, 150_000), 1.0);
        assert_eq!(crate::fit::lr_factor(o, 100_000, 150_000), 0.2);
        assert!(e.processing.template.centre > 0.0 && e.processing.search.centre > 0.0);
        // Nothing else differs.
        e.align.select(AlignPreset::None);
        e.run.out = "out".into();
        match &first {
            Some(first) => assert_eq!(&e, first, "{}", preset.name()),
            None => first = Some(e),
        }
    }
}

#[test]
fn presets_are_the_papers_rows() {
    let row = |name: &str| {
        let text = format!("{MINIMAL}[run]\nepochs = 9\n[align]\npreset = \"{name}\"\n");
        let e = parse(&text).unwrap();
        let a = e.align.adversarial().map(|b| (b.stage, b.weight, b.reversal));
        let c = e.align.contrastive().map(|b| (b.stage, b.weight, b.temperature));
        (a, c, e.align_factor(1249), e.align_factor(1250))
    };
    use AlignStage::{Encoder, Pre};
    for off in ["none", "baseline", "cm"] {
        assert_eq!(row(off), (None, None, None, None));
    }
    let on = Some(1.0);
    assert_eq!(row("pre-afa"), (Some((Pre, 0.5, 0.1)), None, None, on));
    assert_eq!(row("enc-afa"), (Some((Encoder, 0.5, 0.1)), None, None, on));
    assert_eq!(row("pre-cfa"), (None, Some((Pre, 0.1, 0.1)), None, on));
    assert_eq!(row("enc-cfa"), (None, Some((Encoder, 0.1, 0.1)), None, on));
    assert_eq!(row("joint"), (Some((Pre, 0.3, 0.1)), Some((Encoder, 0.1, 0.1)), None, on));
    for preset in AlignPreset::ALL {
        assert_eq!(preset.name().parse(), Ok(preset));
        let toml = toml::to_string(&AlignConfig { preset, ..Default::default() }).unwrap();
        assert!(toml.contains(&format!("preset = \"{}\"", preset.name())), "{toml}");
    }
    assert!("pre_afa".parse::<AlignPreset>().unwrap_err().contains("pre-afa"));
}

#[test]
fn alignment_tables_override_a_preset_or_stand_alone() {
    let text = format!(
        "{MINIMAL}[run]\nsteps = 100\n[align]\npreset = \"joint\"\nstart_step = 10\nramp_steps = 4\n\
         [align.adversarial]\nreversal = 1.0\n[align.contrastive]\nhidden = []\n"
    );
    let mut e = parse(&text).unwrap();
    let (a, c) = (e.align.adversarial().unwrap(), e.align.contrastive().unwrap());
    assert_eq!((a.weight, a.reversal, a.stage), (0.3, 1.0, AlignStage::Pre));
    assert_eq!((c.weight, c.hidden.len()), (0.1, 0));
    let factors: Vec<_> = [9, 10, 12, 13, 99].iter().map(|s| e.align_factor(*s)).collect();
    assert_eq!(factors, [None, Some(0.25), Some(0.75), Some(1.0), Some(1.0)]);
    // The command line's choice of another row leaves nothing of this one.
    e.align.select(AlignPreset::EncAfa);
    assert_eq!(e.align.adversarial().unwrap().reversal, 0.1);
    assert!(e.align.contrastive().is_none());

    let text =
        format!("{MINIMAL}[run]\nsteps = 100\n[align]\nstart_step = 0\n[align.adversarial]\n");
    let e = parse(&text).unwrap();
    assert!(e.align.is_on() && e.align.contrastive().is_none());
}

#[test]
fn alignment_that_cannot_be_is_refused() {
    for (text, field) in [
        ("[align]\npreset = \"pre-afa\"\n", "align.start_epoch"),
        ("[align]\npreset = \"pre-afa\"\nstart_step = 250\n", "align.start_step"),
        ("[align]\npreset = \"cm\"\n[sampler]\ncross_modal_p = 0.0\n", "sampler.cross_modal_p"),
        ("[align]\npreset = \"cm\"\n[align.contrastive]\n", "align.preset"),
        ("[align]\npreset = \"baseline\"\n[align.adversarial]\n", "align.preset"),
        ("[align]\nlr = nan\n", "align.lr"),
        ("[align.adversarial]\nreversal = -1.0\n", "align.adversarial.reversal"),
        ("[align.adversarial]\nweight = inf\n", "align.adversarial.weight"),
        ("[align.adversarial]\nhidden = [0]\n", "align.adversarial.hidden"),
        ("[align.contrastive]\ntemperature = 0.0\n", "align.contrastive.temperature"),
        ("[align.contrastive]\ndim = 0\n", "align.contrastive.dim"),
        ("[align.contrastive]\n[run]\nbatch = 1\n", "run.batch"),
        ("[align.contrastive]\n[sampler]\nabsent_p = 0.1\n", "sampler.absent_p"),
        (
            "[align]\npreset = \"enc-afa\"\n[sampler]\nmixed_templates_p = 0.1\n",
            "sampler.mixed_templates_p",
        ),
    ] {
        match parse(&format!("{MINIMAL}{text}")).unwrap_err() {
            ConfigError::Field { field: f, .. } => assert_eq!(f.field, field, "{f}"),
            other => panic!("{text}: {other}"),
        }
    }
    for text in ["[align]\npreset = \"pre\"\n", "[align.adversarial]\nstage = \"post\"\n"] {
        assert!(matches!(parse(&format!("{MINIMAL}{text}")), Err(ConfigError::Parse { .. })));
    }
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
