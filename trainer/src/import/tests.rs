use super::*;
use crate::model::{FreezePolicy, NetOptions};
use std::process::Command;
use tsda_runtime::ModelSpec;

const NET: ModelSpec = ModelSpec {
    crop: 32,
    width: 16,
    feed_forward: 16,
    encoder_layers: 1,
    decoder_layers: 1,
    ltrb_hidden: 8,
    ..ModelSpec::NANO
};

fn net() -> TrackerNet {
    TrackerNet::new(&NET, &NetOptions::default(), &Device::flex()).unwrap()
}

fn mismatch(result: Result<(TrackerNet, ImportReport), WeightsError>) -> TensorMismatch {
    match result {
        Err(WeightsError::Tensors { source, .. }) => source,
        other => panic!("not a mismatch: {:?}", other.map(|(_, report)| report)),
    }
}

#[test]
fn what_was_saved_is_loaded_and_trains_as_before() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("net.safetensors");
    let saved = net();
    save_weights(&saved, &path).unwrap();
    // Nothing but the file itself is left.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);

    let options = NetOptions { freeze: FreezePolicy::All, ..NetOptions::default() };
    let other = TrackerNet::new(&NET, &options, &Device::flex().autodiff()).unwrap();
    let (loaded, report) = load_weights(other, &path).unwrap();
    assert!(report.unused.is_empty());
    assert!(state_dict(&loaded) == state_dict(&saved));

    struct Trains(Vec<String>, usize, usize);
    impl ModuleVisitor for Trains {
        fn enter_module(&mut self, name: &str, _: &str) {
            self.0.push(name.into());
        }
        fn exit_module(&mut self, _: &str, _: &str) {
            self.0.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let backbone = self.0[0] == "feature_extractor";
            let statistic = self.0.last().unwrap().starts_with("running_");
            let trains = param.val().is_require_grad();
            assert_eq!(trains, !backbone && !statistic, "{}", self.0.join("."));
            if trains { self.1 += 1 } else { self.2 += 1 }
        }
    }
    let mut trains = Trains(Vec::new(), 0, 0);
    loaded.visit(&mut trains);
    assert!(trains.1 > 20 && trains.2 > 50);
}

#[test]
fn every_difference_is_listed_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("net.safetensors");
    let mut dict = state_dict(&net());
    let (missing, short) =
        ("head.classifier.linear.bias", "feature_extractor._blocks.3._bn1.running_var");
    dict.retain(|name| name != missing);
    dict.insert(short.into(), StateTensor { shape: vec![2], values: vec![0.0; 2] });
    dict.insert("head.unknown".into(), StateTensor { shape: vec![1], values: vec![0.0] });
    // Harmless: nobody runs the stages behind stride 16.
    let harmless = "feature_extractor._blocks.13._bn1.weight";
    dict.insert(harmless.into(), StateTensor { shape: vec![1], values: vec![0.0] });
    dict.write(&path, &Metadata::default()).unwrap();
    let found = mismatch(load_weights(net(), &path));
    assert_eq!(found.missing, [missing]);
    assert_eq!(found.extra, ["head.unknown"]);
    assert_eq!(found.shapes, [(short.to_string(), vec![2], vec![144])]);
    let text = found.to_string();
    for name in [missing, short, "head.unknown"] {
        assert!(text.contains(name), "{text}");
    }
    assert!(!text.contains(harmless));
}

#[test]
fn a_backbone_comes_with_or_without_prefix() {
    let folder = tempfile::tempdir().unwrap();
    let source = net();
    let mut dict = state_dict(&source);
    dict.retain(|name| name.starts_with(BACKBONE));
    let with = folder.path().join("with.safetensors");
    dict.write(&with, &Metadata::default()).unwrap();
    dict.rename(|name| name.strip_prefix(BACKBONE).unwrap().to_string());
    dict.insert("_fc.weight".into(), StateTensor { shape: vec![1], values: vec![0.0] });
    let without = folder.path().join("without.safetensors");
    dict.write(&without, &Metadata::default()).unwrap();

    let fresh = net();
    for path in [&with, &without] {
        let (loaded, report) = load_backbone(fresh.clone(), path).unwrap();
        let (loaded, source, fresh) =
            (state_dict(&loaded), state_dict(&source), state_dict(&fresh));
        for (name, tensor) in loaded.iter() {
            let from = if name.starts_with(BACKBONE) { &source } else { &fresh };
            assert!(Some(tensor) == from.get(name), "{name}");
        }
        assert_eq!(report.unused.len(), usize::from(path == &without));
    }
    // The command, and its output read again.
    let out = folder.path().join("out.safetensors");
    let options = ImportOptions {
        kind: None,
        input: without.clone(),
        output: out.clone(),
        given: Given::Nothing,
    };
    let summary = run(&options).unwrap();
    assert_eq!((summary.kind, summary.detected), (ImportKind::EfficientNetLite0, true));
    assert_eq!(summary.backbone, Some(Backbone::EfficientNetLite0));
    assert!(StateDict::read(&out).unwrap().names().all(|name| name.starts_with(BACKBONE)));
    load_backbone(net(), &out).unwrap();
    let nano = Given::Preset("nano".into());
    let full = ImportOptions { kind: Some(ImportKind::Full), given: nano, ..options.clone() };
    let error = run(&full).unwrap_err();
    assert!(matches!(error, WeightsError::NoHead { .. }), "{error}");
    let kind = Some(ImportKind::EfficientNetLite0);
    let wrong = ImportOptions { kind, given: Given::Preset("tomp50".into()), ..options };
    let error = run(&wrong).unwrap_err();
    assert!(matches!(error, WeightsError::Kind { .. }), "{error}");
}

#[test]
fn unreadable_files_name_themselves() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.safetensors");
    let error = load_weights(net(), &path).unwrap_err();
    assert!(matches!(error, WeightsError::Io { .. }) && error.to_string().contains("bad."));
    let whole = folder.path().join("whole.safetensors");
    save_weights(&net(), &whole).unwrap();
    let bytes = std::fs::read(&whole).unwrap();
    for cut in [0, 4, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..cut]).unwrap();
        let error = load_weights(net(), &path).unwrap_err();
        assert!(matches!(error, WeightsError::Format { .. }), "cut at {cut}: {error}");
    }
    let nowhere = folder.path().join("no/folder/net.safetensors");
    assert!(matches!(save_weights(&net(), &nowhere), Err(WeightsError::Io { .. })));
}

#[test]
fn other_number_types_are_read() {
    use safetensors::tensor::{Dtype, TensorView};
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("types.safetensors");
    let one = |dtype, bytes: Vec<u8>| (dtype, bytes);
    let cases = [
        one(Dtype::F64, 1.5f64.to_le_bytes().to_vec()),
        one(Dtype::F16, 0x3E00u16.to_le_bytes().to_vec()),
        one(Dtype::BF16, 0x3FC0u16.to_le_bytes().to_vec()),
    ];
    for (dtype, bytes) in cases {
        let view = TensorView::new(dtype, vec![1], &bytes).unwrap();
        std::fs::write(&path, safetensors::serialize([("x", view)], None).unwrap()).unwrap();
        let dict = StateDict::read(&path).unwrap();
        assert_eq!(dict.get("x").unwrap().values, [1.5], "{dtype:?}");
    }
    let bytes = [0u8; 2];
    let view = TensorView::new(Dtype::U16, vec![1], &bytes).unwrap();
    std::fs::write(&path, safetensors::serialize([("x", view)], None).unwrap()).unwrap();
    assert!(matches!(StateDict::read(&path), Err(WeightsError::Dtype { .. })));
}

fn torch_file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/import").join(name)
}

fn import(
    input: &Path,
    output: &Path,
    kind: Option<ImportKind>,
    given: Given,
) -> Result<ImportSummary, WeightsError> {
    run(&ImportOptions { kind, input: input.into(), output: output.into(), given })
}

#[test]
fn a_pytracking_checkpoint_says_which_network_it_is_of() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("tiny.safetensors");
    let input = torch_file("pytracking.pth.tar");
    let summary = import(&input, &out, None, Given::Nothing).unwrap();
    println!("{summary}");
    assert_eq!((summary.kind, summary.detected), (ImportKind::Pytracking, true));
    let spec = summary.network.as_ref().unwrap().spec;
    let want = ModelSpec {
        backbone: Backbone::ResNet { base_channels: 1, blocks: [1, 2, 1] },
        crop: 64,
        width: 8,
        heads: 2,
        feed_forward: 4,
        encoder_layers: 1,
        decoder_layers: 2,
        ltrb_hidden: 2,
        filter_size: 3,
        test_embedding: true,
        ..ModelSpec::TOMP50
    };
    assert_eq!(spec, want);
    let text = summary.to_string();
    for part in [
        "pytracking.pth.tar: PyTorch zip file, under `net`",
        "tompnet_tiny(",
        "filter_size    3  (constructor)",
        "backbone       ResNet, 1 channels, blocks 1-2-1  (tensors)",
        "feature_extractor.layer4.*",
        "feature_extractor.fc.*: 2",
        "query_embed_fg.weight = head.filter_predictor.query_embed_fg_decoder.weight",
        "optimizer (dict)",
        "settings (ltr.admin.settings.Settings)",
    ] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
    // The file written says the same, and its tensors are the input's.
    let metadata = Metadata::read(&out).unwrap();
    assert_eq!(metadata.spec, Some(want));
    assert_eq!(metadata.source.unwrap().kind, "pytracking");
    let theirs = StateDict::read(&input).unwrap();
    let ours = StateDict::read(&out).unwrap();
    assert_eq!(ours.names().count(), summary.report.loaded.len());
    assert!(ours.iter().all(|(name, tensor)| theirs.get(name) == Some(tensor)));
    let net = TrackerNet::new(&want, &NetOptions::default(), &Device::flex()).unwrap();
    let (net, _) = load_weights(net, &out).unwrap();
    assert!(state_dict(&net) == ours);
    // Straight from the checkpoint as well, as `init.weights` does it.
    let (net, report) = load_weights(net, &input).unwrap();
    assert!(state_dict(&net) == ours && report == summary.report);
    // The same bytes every time, and again from our own file.
    let again = folder.path().join("again.safetensors");
    import(&input, &again, None, Given::Nothing).unwrap();
    assert!(std::fs::read(&again).unwrap() == std::fs::read(&out).unwrap());
    let summary = import(&out, &again, None, Given::Nothing).unwrap();
    assert_eq!((summary.kind, summary.network.unwrap().spec), (ImportKind::Full, want));
}

#[test]
fn disagreements_and_open_questions_name_the_field() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let out = at("out.safetensors");
    let input = torch_file("pytracking.pth.tar");
    let config = |text: &str| {
        std::fs::write(at("c.toml"), text).unwrap();
        given(None, Some(&at("c.toml"))).unwrap()
    };
    let model = "[model]\ncrop = 64\nwidth = 8\nheads = 2\nfeed_forward = 4\nencoder_layers = 1\n\
                 decoder_layers = 2\nltrb_hidden = 2\nsearch_factor = 5.0\n\
                 backbone = { res_net = { base_channels = 1, blocks = [1, 2, 1] } }\n";
    // Filter size and test-frame embedding are the file's unless the configuration insists.
    let summary = import(&input, &out, None, config(model)).unwrap();
    assert_eq!(summary.network.unwrap().spec.filter_size, 3);
    std::fs::remove_file(&out).unwrap();
    let cases: [(&str, Given, &[&str]); 6] = [
        ("preset", Given::Preset("tomp101".into()), &["backbone", "1-2-1", "3-4-23", "tomp101"]),
        ("heads", config(&model.replace("heads = 2", "heads = 4")), &["heads is 2", "but 4"]),
        ("k", config(&format!("{model}filter_size = 1\n")), &["filter_size is 3", "but 1"]),
        (
            "e_test",
            config(&format!("{model}test_embedding = false\n")),
            &["test_embedding is true"],
        ),
        ("crop", config(&model.replace("crop = 64", "crop = 96")), &["crop is 64", "but 96"]),
        ("no preset", Given::Preset("tomp".into()), &["preset"]),
    ];
    for (case, given, want) in cases {
        let error = import(&input, &out, None, given).unwrap_err().to_string();
        assert!(want.iter().all(|w| error.contains(w)), "{case}: {error}");
    }
    // A bare state dict: nothing tells the heads of a network of no preset's shape.
    let whole = WeightsFile::read(&input).unwrap().dict;
    let bare = at("bare.safetensors");
    whole.write(&bare, &Metadata::default()).unwrap();
    let error = import(&bare, &out, None, Given::Nothing).unwrap_err().to_string();
    assert!(error.contains("heads") && error.contains("--config"), "{error}");
    let summary = import(&bare, &out, None, config(model)).unwrap();
    assert_eq!(summary.network.unwrap().spec.filter_size, 1);
    std::fs::remove_file(&out).unwrap();

    // Two names of one tensor that differ (quirk Q11), a missing, an extra and a short tensor.
    let mut wrong = whole.clone();
    let mut alias = wrong.get(TIED.1).unwrap().clone();
    alias.values[3] += 1.0;
    wrong.insert(TIED.1.into(), alias);
    wrong.retain(|name| name != "head.classifier.linear.bias");
    wrong.insert("head.new".into(), StateTensor { shape: vec![1], values: vec![0.0] });
    let short = "head.bb_regressor.linear.bias";
    wrong.insert(short.into(), StateTensor { shape: vec![7], values: vec![0.0; 7] });
    wrong.write(&bare, &Metadata::default()).unwrap();
    let error = import(&bare, &out, None, config(model)).unwrap_err().to_string();
    for part in [
        "1 missing: head.classifier.linear.bias",
        "1 too many: head.new",
        "head.bb_regressor.linear.bias has shape [7] instead of [8]",
        TIED.0,
        TIED.1,
        "differ",
        "bare.safetensors",
    ] {
        assert!(error.contains(part), "{part} is not in: {error}");
    }
    // Q2: without its key the network has no test-frame embedding.
    let mut without = whole;
    without.retain(|name| name != "head.filter_predictor.query_embed_test.weight");
    without.write(&bare, &Metadata::default()).unwrap();
    assert!(!out.exists());
    let summary = import(&bare, &out, None, config(model)).unwrap();
    assert!(!summary.network.unwrap().spec.test_embedding);
}

#[test]
fn torchvision_weights_are_a_backbone() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("resnet.safetensors");
    let input = torch_file("resnet.pth");
    let whole = import(&input, &out, Some(ImportKind::Pytracking), Given::Nothing).unwrap_err();
    assert!(matches!(whole, WeightsError::NoHead { .. }), "{whole}");
    let summary = import(&input, &out, None, Given::Nothing).unwrap();
    println!("{summary}");
    let backbone = Backbone::ResNet { base_channels: 1, blocks: [1, 2, 1] };
    assert_eq!(summary.kind, ImportKind::TorchvisionResNet);
    assert_eq!(summary.backbone, Some(backbone));
    let unused = &summary.report.unused;
    for name in ["feature_extractor.fc.weight", "feature_extractor.layer4.0.conv1.weight"] {
        assert!(unused.iter().any(|n| n == name), "{name} is not reported");
    }
    assert_eq!(Metadata::read(&out).unwrap().backbone, Some(backbone));
    // Directly and through the command.
    let spec = ModelSpec { backbone, ..NET };
    let theirs = StateDict::read(&input).unwrap();
    for path in [&input, &out] {
        let net = TrackerNet::new(&spec, &NetOptions::default(), &Device::flex()).unwrap();
        let (net, _) = load_backbone(net, path).unwrap();
        for (name, tensor) in state_dict(&net).iter() {
            if let Some(bare) = name.strip_prefix(BACKBONE) {
                assert!(theirs.get(bare) == Some(tensor), "{name}");
            }
        }
    }
    let kind = Some(ImportKind::TorchvisionResNet);
    let error = import(&input, &out, kind, Given::Preset("tomp101".into())).unwrap_err();
    assert!(error.to_string().contains("backbone is ResNet, 1 channels, blocks 1-2-1"), "{error}");
    let error = import(&input, &out, kind, Given::Preset("nano".into())).unwrap_err();
    assert!(matches!(error, WeightsError::Kind { .. }), "{error}");
    let error = import(&torch_file("traits.pth"), &out, None, Given::Nothing).unwrap_err();
    assert!(matches!(error, WeightsError::Unknown { .. }), "{error}");
}

#[test]
fn training_starts_from_torchvision_weights_and_from_checkpoints() {
    let theirs = |name: &str| StateDict::read(&torch_file(name)).unwrap();
    let config = |init: &str| {
        let text = format!(
            "[model]\npreset = \"tomp50\"\ncrop = 64\nwidth = 8\nheads = 2\nfeed_forward = 4\n\
             encoder_layers = 1\ndecoder_layers = 2\nltrb_hidden = 2\nfilter_size = 3\n\
             backbone = {{ res_net = {{ base_channels = 1, blocks = [1, 2, 1] }} }}\n\
             [[data]]\nkind = \"pairs\"\npath = \"pairs\"\n[init]\n{init}\n"
        );
        crate::config::Experiment::parse(&text, Path::new("c.toml")).unwrap()
    };
    let start = |init: &str| {
        let net = crate::fit::initial_net(&config(init), &Device::flex().autodiff()).unwrap();
        state_dict(&net.valid())
    };
    let path = |name: &str| torch_file(name).display().to_string();
    let net = start(&format!("backbone = {:?}", path("resnet.pth")));
    let dict = theirs("resnet.pth");
    let backbone = net.iter().filter_map(|(n, t)| Some((n.strip_prefix(BACKBONE)?, t)));
    assert_eq!(backbone.filter(|(n, t)| dict.get(n) == Some(*t)).count(), 80);
    let net = start(&format!("weights = {:?}", path("pytracking.pth.tar")));
    let dict = theirs("pytracking.pth.tar");
    assert!(net.iter().all(|(name, tensor)| dict.get(name) == Some(tensor)));
}

/// A Python with torch, if there is one.
fn torch_python() -> Option<String> {
    ["TSDA_TORCH_PYTHON", "TSDA_PYTHON"].iter().find_map(|name| {
        let python = std::env::var(name).ok()?;
        let out = Command::new(&python).args(["-c", "import torch, numpy"]).output().ok()?;
        out.status.success().then_some(python)
    })
}

#[test]
fn files_written_just_now_by_torch_are_read() {
    let Some(python) = torch_python() else {
        println!("skipped: neither TSDA_TORCH_PYTHON nor TSDA_PYTHON names a Python with torch");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let script = torch_file("make_torch_files.py");
    for what in [None, Some("small")] {
        let mut command = Command::new(&python);
        command.arg("-B").arg(&script).arg(folder.path()).args(what);
        let out = command.output().unwrap();
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    }
    torch::check_folder(folder.path());
    // Checkpoints of the small golden configuration compute the reference's figures.
    let dict = crate::model::tests::compact();
    let config = folder.path().join("small.toml");
    let model = "[model]\npreset = \"tomp50\"\ncrop = 144\nwidth = 64\nheads = 4\nfeed_forward = 128\n\
                 encoder_layers = 2\ndecoder_layers = 2\nltrb_hidden = 16\n\
                 backbone = { res_net = { base_channels = 16, blocks = [2, 2, 3] } }\n";
    std::fs::write(&config, model).unwrap();
    let out = folder.path().join("small.safetensors");
    for (file, given, case, seq, test_embedding) in [
        ("small.pth.tar", Given::Nothing, "case_a", 0, true),
        ("small_no_test.pth.tar", Given::Nothing, "case_d", 2, false),
        // Nothing but tensors: the heads are the configuration's.
        ("small_legacy.pth", given(None, Some(&config)).unwrap(), "case_a", 0, true),
        // Or those of the preset whose shapes they have.
        ("small_legacy.pth", Given::Nothing, "case_a", 0, true),
        ("small_no_test_legacy.pth", Given::Preset("small".into()), "case_d", 2, false),
    ] {
        let summary = import(&folder.path().join(file), &out, None, given).unwrap();
        let spec = summary.network.unwrap().spec;
        assert_eq!(spec, crate::model::tests::small(test_embedding), "{file}");
        let net = TrackerNet::new(&spec, &NetOptions::default(), &Device::flex()).unwrap();
        let (net, _) = load_weights(net, &out).unwrap();
        let (scores, ltrb) = crate::model::tests::track_with(&net, seq, 2, &dict);
        let off = |what: &str, got: &[f32]| {
            let want = &dict.get(&format!("{case}.{what}")).unwrap().values;
            crate::model::tests::difference(got, want)
        };
        let (s, l) = (off("scores", &scores), off("ltrb", &ltrb));
        println!("{file}: scores within {s:.1e}, ltrb within {l:.1e} of the reference");
        assert!(s <= 2e-5 && l <= 2e-5, "{file}: {s} {l}");
    }
}
