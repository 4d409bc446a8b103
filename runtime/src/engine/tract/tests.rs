//! A tiny network written by hand, so that every number can be computed here as well.

use super::*;
use crate::bundle::{HEADER_LEN, Manifest, Section, SectionKind as Kind, align_up, crc32, header};
use crate::probe;
use crate::spec::TrackerParams;
use crate::tracker::Tracker;
use crate::{BBox, FrameView};
use prost::Message as _;

pub(in crate::engine) const SPEC: ModelSpec =
    ModelSpec { crop: 48, width: 4, heads: 1, ..ModelSpec::NANO };
const SIDE: usize = 3;
const CELLS: usize = SIDE * SIDE;

fn ints(name: &str, values: &[i64]) -> pb::AttributeProto {
    let r#type = pb::attribute_proto::AttributeType::Ints as i32;
    pb::AttributeProto { name: name.into(), ints: values.into(), r#type, ..Default::default() }
}

fn int(name: &str, i: i64) -> pb::AttributeProto {
    let r#type = pb::attribute_proto::AttributeType::Int as i32;
    pb::AttributeProto { name: name.into(), i, r#type, ..Default::default() }
}

fn node(
    op: &str,
    inputs: &[&str],
    output: &str,
    attribute: Vec<pb::AttributeProto>,
) -> pb::NodeProto {
    pb::NodeProto {
        op_type: op.into(),
        name: format!("{op}_{output}"),
        input: inputs.iter().map(|s| s.to_string()).collect(),
        output: vec![output.into()],
        attribute,
        ..Default::default()
    }
}

fn value(name: &str, shape: &[usize]) -> pb::ValueInfoProto {
    let dim = |&n: &usize| pb::tensor_shape_proto::Dimension {
        value: Some(dimension::Value::DimValue(n as i64)),
        ..Default::default()
    };
    let tensor = type_proto::Tensor {
        elem_type: tensor_proto::DataType::Float as i32,
        shape: Some(pb::TensorShapeProto { dim: shape.iter().map(dim).collect() }),
    };
    let value = Some(type_proto::Value::TensorType(tensor));
    let r#type = Some(pb::TypeProto { value, ..Default::default() });
    pb::ValueInfoProto { name: name.into(), r#type, ..Default::default() }
}

fn shape_const(name: &str, values: &[i64]) -> pb::TensorProto {
    pb::TensorProto {
        name: name.into(),
        dims: vec![values.len() as i64],
        data_type: tensor_proto::DataType::Int64 as i32,
        int64_data: values.into(),
        ..Default::default()
    }
}

fn model(
    node: Vec<pb::NodeProto>,
    input: Vec<pb::ValueInfoProto>,
    output: Vec<pb::ValueInfoProto>,
    initializer: Vec<pb::TensorProto>,
) -> pb::ModelProto {
    let graph =
        pb::GraphProto { node, input, output, initializer, name: "g".into(), ..Default::default() };
    let opset = pb::OperatorSetIdProto { version: 17, ..Default::default() };
    pb::ModelProto {
        ir_version: 8,
        graph: Some(graph),
        opset_import: vec![opset],
        ..Default::default()
    }
}

/// The convolution's weights, at byte 64 of the section.
fn weights() -> Vec<f32> {
    (0..4 * 3 * 256).map(|i| ((i * 37 % 101) as f32 - 50.0) * 1e-3).collect()
}

pub(in crate::engine) fn external(offset: &str, length: &str) -> pb::TensorProto {
    let entry = |key: &str, value: &str| pb::StringStringEntryProto {
        key: key.into(),
        value: value.into(),
    };
    pb::TensorProto {
        name: "kernel".into(),
        dims: vec![4, 3, 16, 16],
        data_type: tensor_proto::DataType::Float as i32,
        data_location: Some(tensor_proto::DataLocation::External as i32),
        external_data: vec![
            entry("location", WEIGHTS_FILE),
            entry("offset", offset),
            entry("length", length),
        ],
        ..Default::default()
    }
}

/// One 16 x 16 convolution of stride 16.
pub(in crate::engine) fn features_with(kernel: pb::TensorProto) -> pb::ModelProto {
    let attributes = vec![ints("kernel_shape", &[16, 16]), ints("strides", &[16, 16])];
    model(
        vec![node("Conv", &["crop", "kernel"], "feature", attributes)],
        vec![value("crop", &[1, 3, 48, 48])],
        vec![value("feature", &[1, 4, SIDE, SIDE])],
        vec![kernel],
    )
}

fn features() -> pb::ModelProto {
    features_with(external("64", "12288"))
}

/// `tokens = feature^T + label + mean of ltrb`. Inputs are declared in another order than the
/// engine's.
fn template() -> pb::ModelProto {
    model(
        vec![
            node("Reshape", &["feature", "flat"], "f", vec![]),
            node("Transpose", &["f"], "ft", vec![ints("perm", &[1, 0])]),
            node("Reshape", &["label", "column"], "l", vec![]),
            node("ReduceMean", &["ltrb"], "m", vec![ints("axes", &[0]), int("keepdims", 0)]),
            node("Reshape", &["m", "column"], "mc", vec![]),
            node("Add", &["ft", "l"], "fl", vec![]),
            node("Add", &["fl", "mc"], "tokens", vec![]),
        ],
        vec![
            value("ltrb", &[4, SIDE, SIDE]),
            value("feature", &[1, 4, SIDE, SIDE]),
            value("label", &[SIDE, SIDE]),
        ],
        vec![value("tokens", &[CELLS, 4])],
        vec![shape_const("flat", &[4, 9]), shape_const("column", &[9, 1])],
    )
}

/// `scores = feature channel mean + sum over slots of (slot + 1) * mean(tokens)`,
/// `ltrb = exp(feature)`. The outputs are declared in another order than the engine's.
fn predict(templates: usize) -> pb::ModelProto {
    let mut nodes = vec![
        node("Reshape", &["feature", "map"], "fm", vec![]),
        node("Exp", &["fm"], "ltrb", vec![]),
        node("ReduceMean", &["fm"], "s0", vec![ints("axes", &[0]), int("keepdims", 0)]),
    ];
    let mut inputs = vec![value("feature", &[1, 4, SIDE, SIDE])];
    let mut last = String::from("s0");
    for i in 0..templates {
        let (name, mean) = (format!("template{i}"), format!("mean{i}"));
        inputs.push(value(&name, &[CELLS, 4]));
        let axes = vec![ints("axes", &[0, 1]), int("keepdims", 0)];
        nodes.push(node("ReduceMean", &[&name], &mean, axes));
        for j in 0..=i {
            let next = format!("a{i}_{j}");
            let to = if i + 1 == templates && j == i { "scores" } else { &next };
            nodes.push(node("Add", &[&last, &mean], to, vec![]));
            last = next;
        }
    }
    model(
        nodes,
        inputs,
        vec![value("ltrb", &[4, SIDE, SIDE]), value("scores", &[SIDE, SIDE])],
        vec![shape_const("map", &[4, 3, 3])],
    )
}

fn weights_section() -> Vec<u8> {
    [0; 64].into_iter().chain(weights().into_iter().flat_map(f32::to_le_bytes)).collect()
}

pub(in crate::engine) fn parts() -> Vec<(Kind, Vec<u8>)> {
    vec![
        (Kind::FeaturesOnnx, features().encode_to_vec()),
        (Kind::TemplateOnnx, template().encode_to_vec()),
        (Kind::PredictOnnx(1), predict(1).encode_to_vec()),
        (Kind::PredictOnnx(2), predict(2).encode_to_vec()),
        (Kind::Weights, weights_section()),
    ]
}

pub(in crate::engine) fn write(parts: &[(Kind, Vec<u8>)]) -> Vec<u8> {
    let mut manifest = Manifest { licence: "MIT", ..Manifest::new("tiny", SPEC) };
    let mut at = 4096;
    for (kind, bytes) in parts {
        let (offset, length) = (align_up(at).unwrap(), bytes.len() as u64);
        manifest.sections.push(Section { kind: *kind, offset, length, crc: crc32(bytes) }).unwrap();
        at = offset + length;
    }
    let encoded = postcard::to_stdvec(&manifest).unwrap();
    assert!(HEADER_LEN + encoded.len() <= 4096);
    let mut out = header(&encoded).unwrap().to_vec();
    out.extend(encoded);
    for (section, (_, bytes)) in manifest.sections.iter().zip(parts) {
        out.resize(section.offset as usize, 0);
        out.extend(bytes);
    }
    out
}

pub(in crate::engine) fn load(parts: &[(Kind, Vec<u8>)]) -> Result<TractEngine, EngineError> {
    TractEngine::from_bundle(&Bundle::parse(&write(parts)).unwrap())
}

/// The same network, computed here.
fn feature_of(crop: &[f32]) -> Vec<f32> {
    let w = weights();
    let mut out = Vec::new();
    for o in 0..4 {
        for cell in 0..CELLS {
            let (r, c) = (cell / SIDE, cell % SIDE);
            let mut sum = 0.0;
            for i in 0..3 * 256 {
                let (channel, y, x) = (i / 256, i / 16 % 16, i % 16);
                let at = (channel * 48 + 16 * r + y) * 48 + 16 * c + x;
                sum += w[o * 768 + i] * crop[at];
            }
            out.push(sum);
        }
    }
    out
}

fn mean(values: &[f32]) -> f32 {
    values.iter().sum::<f32>() / values.len() as f32
}

#[test]
fn a_hand_computed_network_gives_the_same_numbers() {
    let mut engine = load(&parts()).unwrap();
    let mut means = Vec::new();
    for slot in 0..2 {
        probe::crop_input(&SPEC, slot, engine.crop_mut());
        engine.features().unwrap();
        let feature = feature_of(engine.crop_mut());
        let input = engine.template_input_mut();
        input.label.iter_mut().enumerate().for_each(|(i, v)| *v = (i + slot) as f32 * 0.1);
        input.ltrb.iter_mut().enumerate().for_each(|(i, v)| *v = i as f32 * 0.01);
        means.push(mean(&feature) + mean(input.label) + mean(input.ltrb));
        engine.write_template(slot).unwrap();
    }
    probe::crop_input(&SPEC, 2, engine.crop_mut());
    engine.features().unwrap();
    let feature = feature_of(engine.crop_mut());
    for (filled, offset) in [(1, means[0]), (2, means[0] + 2.0 * means[1]), (1, means[0])] {
        let maps = engine.predict(filled).unwrap();
        for cell in 0..CELLS {
            let channels: Vec<f32> = (0..4).map(|o| feature[o * CELLS + cell]).collect();
            let want = mean(&channels) + offset;
            assert!((maps.scores[cell] - want).abs() < 1e-5, "{filled}, cell {cell}");
        }
        for (a, b) in maps.ltrb.iter().zip(&feature) {
            assert!((a - b.exp()).abs() < 1e-5 * b.exp().max(1.0));
        }
    }
}

/// A bundle whose slots hold more than tokens: the engine takes their shape from the graphs.
#[test]
fn slots_have_the_shape_that_the_graphs_declare() {
    let mut wide = template();
    let graph = wide.graph.as_mut().unwrap();
    graph.node.last_mut().unwrap().output[0] = "one".into();
    graph.node.push(node("Concat", &["one"; 4], "tokens", vec![int("axis", 1)]));
    graph.output[0] = value("tokens", &[CELLS, 16]);
    let mut parts = parts();
    parts[1].1 = wide.encode_to_vec();
    for k in 1..=2 {
        let mut model = predict(k);
        let inputs = &mut model.graph.as_mut().unwrap().input;
        for (i, input) in inputs.iter_mut().skip(1).enumerate() {
            *input = value(&format!("template{i}"), &[CELLS, 16]);
        }
        parts[1 + k].1 = model.encode_to_vec();
    }
    let boxes = probe::default_boxes(&SPEC);
    let section = probe::capture(&mut load(&self::parts()).unwrap(), &boxes).unwrap();
    let probe = probe::Probe::parse(&section, &SPEC).unwrap();
    // The mean over four equal blocks is the mean over one.
    assert!(probe::run(&mut load(&parts).unwrap(), &probe).unwrap().max() < 1e-6);
    // All graphs have to say the same.
    parts[2].1 = predict(1).encode_to_vec();
    let message = load(&parts).unwrap_err().to_string();
    assert!(message.contains("predict1.onnx: input `template0`"), "{message}");
}

#[test]
fn two_engines_of_one_bundle_agree_on_the_probe_and_can_be_sent_to_threads() {
    let boxes = probe::default_boxes(&SPEC);
    let section = probe::capture(&mut load(&parts()).unwrap(), &boxes).unwrap();
    let mut other = load(&parts()).unwrap();
    let report = std::thread::spawn(move || {
        let probe = probe::Probe::parse(&section, &SPEC).unwrap();
        probe::run(&mut other, &probe).unwrap()
    });
    assert_eq!(report.join().unwrap().max(), 0.0);
}

#[test]
fn a_tracker_runs_on_it() {
    let mut tracker = Tracker::new(load(&parts()).unwrap(), TrackerParams::default()).unwrap();
    let picture = crate::testing::recipe(0, 100, 80);
    let frame = FrameView::rgb(&picture, 100, 80).unwrap();
    tracker.init(&frame, BBox::new(30.0, 20.0, 25.0, 30.0), None).unwrap();
    for _ in 0..3 {
        let track = tracker.update(&frame, None).unwrap();
        assert!(track.bbox.is_valid() && track.score.is_finite());
    }
}

#[test]
fn calls_out_of_order_are_errors() {
    let mut engine = load(&parts()).unwrap();
    let message = |e: EngineError| e.to_string();
    assert!(message(engine.predict(1).unwrap_err()).contains("features"));
    assert!(message(engine.write_template(0).unwrap_err()).contains("features"));
    engine.features().unwrap();
    assert!(message(engine.predict(1).unwrap_err()).contains("slot 0 was never written"));
    assert!(message(engine.write_template(2).unwrap_err()).contains("slot 2"));
    for filled in [0, 3] {
        assert!(message(engine.predict(filled).unwrap_err()).contains("1 to 2"));
    }
    engine.write_template(0).unwrap();
    engine.predict(1).unwrap();
    assert!(message(engine.predict(2).unwrap_err()).contains("slot 1 was never written"));
}

#[test]
fn what_is_wrong_with_a_bundle_is_named() {
    let with = |at: usize, bytes: Vec<u8>| {
        let mut parts = parts();
        parts[at].1 = bytes;
        load(&parts).unwrap_err().to_string()
    };
    let kernel = |change: fn(&mut pb::TensorProto)| {
        let mut kernel = external("64", "12288");
        change(&mut kernel);
        with(0, features_with(kernel).encode_to_vec())
    };
    let mut wide = features();
    wide.graph.as_mut().unwrap().input[0] = value("crop", &[1, 3, 64, 64]);
    let mut named = template();
    named.graph.as_mut().unwrap().input[0].name = "box".into();
    let mut lying = predict(1);
    lying.graph.as_mut().unwrap().initializer[0] = shape_const("map", &[4, 9, 1]);
    let mut unknown = predict(2);
    unknown.graph.as_mut().unwrap().node[1].op_type = "Frobnicate".into();
    let slot = |sides: &[usize]| {
        let mut other = template();
        other.graph.as_mut().unwrap().output[0] = value("tokens", sides);
        with(1, other.encode_to_vec())
    };
    let cases: [(String, &[&str]); 15] = [
        (slot(&[CELLS, 6]), &["template.onnx: output `tokens`", "[9, n * 4]", "[9, 6]"]),
        (slot(&[CELLS + 1, 4]), &["template.onnx: output `tokens`", "[10, 4]"]),
        (slot(&[CELLS, 4, 1]), &["template.onnx: output `tokens`", "[9, 4, 1]"]),
        // Declared otherwise than computed.
        (slot(&[CELLS, 16]), &["template.onnx", "tokens"]),
        (with(0, b"\xff\xff".to_vec()), &["features.onnx"]),
        (with(0, Vec::new()), &["features.onnx", "no graph"]),
        (with(0, wide.encode_to_vec()), &["features.onnx", "`crop`", "[1, 3, 48, 48]"]),
        (with(1, named.encode_to_vec()), &["template.onnx has no input `ltrb`"]),
        (with(2, lying.encode_to_vec()), &["predict1.onnx"]),
        (with(3, unknown.encode_to_vec()), &["predict2.onnx"]),
        (with(4, vec![0; 100]), &["features.onnx", "`kernel`", "outside the weights section"]),
        (kernel(|k| k.external_data[1].value = "-1".into()), &["`kernel`", "offset `-1`"]),
        (kernel(|k| k.external_data[0].value = "/etc/passwd".into()), &["weights.bin"]),
        (kernel(|k| k.external_data[2].value = "64".into()), &["features.onnx"]),
        (kernel(|k| k.external_data.clear()), &["`kernel`", "no location"]),
    ];
    for (message, wants) in cases {
        for want in wants {
            assert!(message.contains(want), "{want}: {message}");
        }
    }
    let mut short = parts();
    short.remove(3);
    let message = load(&short).unwrap_err().to_string();
    assert!(message.contains("no section predict2.onnx"), "{message}");
}
