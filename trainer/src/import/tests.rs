use super::*;
use crate::model::FreezePolicy;

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
    dict.write(&path).unwrap();
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
    dict.write(&with).unwrap();
    dict.rename(|name| name.strip_prefix(BACKBONE).unwrap().to_string());
    dict.insert("_fc.weight".into(), StateTensor { shape: vec![1], values: vec![0.0] });
    let without = folder.path().join("without.safetensors");
    dict.write(&without).unwrap();

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
    run(ImportKind::EfficientNetLite0, &without, &out, &NET).unwrap();
    assert!(StateDict::read(&out).unwrap().names().all(|name| name.starts_with(BACKBONE)));
    load_backbone(net(), &out).unwrap();
    let error = run(ImportKind::Full, &without, &out, &NET).unwrap_err();
    assert!(matches!(error, WeightsError::Tensors { .. }), "{error}");
    let error = run(ImportKind::EfficientNetLite0, &without, &out, &ModelSpec::TOMP50).unwrap_err();
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
