//! What TensorRT asks of an ONNX file, checked on the files themselves: fixed shapes, one opset, and
//! no operator that its parser lacks.

use std::collections::BTreeSet;
use tract_onnx::pb;
use tract_onnx::pb::tensor_shape_proto::dimension::Value as Dim;
use tract_onnx::pb::type_proto::Value as Type;
use tract_onnx::prelude::*;
use tsda_export::network;
use tsda_runtime::bundle::{Bundle, BundleFile, SectionKind, WEIGHTS_FILE};
use tsda_runtime::{Backbone, ModelSpec};

/// The opset docs/onnx.md names. TensorRT 10.0 reads 9 to 20, 10.15 reads 9 to 24.
const OPSET: i64 = 17;

/// Operators of our converter's output that TensorRT's ONNX parser takes for f32: in its operator
/// table (`docs/operators.md` of onnx-tensorrt) of both TensorRT 9.2 and 10.15.
const TENSORRT: &[&str] = &[
    "Abs",
    "Add",
    "And",
    "ArgMax",
    "ArgMin",
    "Atan",
    "AveragePool",
    "BatchNormalization",
    "Cast",
    "Ceil",
    "Clip",
    "Concat",
    "Constant",
    "ConstantOfShape",
    "Conv",
    "ConvTranspose",
    "Cos",
    "Div",
    "Elu",
    "Equal",
    "Erf",
    "Exp",
    "Expand",
    "Flatten",
    "Floor",
    "Gather",
    "GatherElements",
    "Gemm",
    "GlobalAveragePool",
    "Greater",
    "GreaterOrEqual",
    "HardSigmoid",
    "Identity",
    "LayerNormalization",
    "LeakyRelu",
    "Less",
    "LessOrEqual",
    "Log",
    "LogSoftmax",
    "MatMul",
    "Max",
    "MaxPool",
    "Min",
    "Mul",
    "Neg",
    "Not",
    "Or",
    "PRelu",
    "Pad",
    "Pow",
    "Reciprocal",
    "ReduceMax",
    "ReduceMean",
    "ReduceMin",
    "ReduceProd",
    "ReduceSum",
    "Relu",
    "Reshape",
    "Round",
    "Sigmoid",
    "Sign",
    "Sin",
    "Slice",
    "Softmax",
    "Split",
    "Sqrt",
    "Squeeze",
    "Sub",
    "Tan",
    "Tanh",
    "Tile",
    "Transpose",
    "Unsqueeze",
    "Where",
];

/// Graph files of a network with fresh weights.
fn fresh(spec: &ModelSpec) -> Vec<(SectionKind, Vec<u8>)> {
    network::files(&network::graphs(&network::untrained(spec, 3).unwrap()).unwrap())
}

/// Graph files of the bundle in the repository.
fn shipped() -> Vec<(SectionKind, Vec<u8>)> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/nano.tsda");
    let file = BundleFile::open(path).unwrap();
    let bundle: Bundle<'_> = file.bundle().unwrap();
    let kinds = bundle.manifest().sections.iter().map(|s| s.kind);
    kinds.filter_map(|kind| Some((kind, bundle.section(kind)?.to_vec()))).collect()
}

/// The ResNet branch with every part switched on: bottlenecks, three templates, test embedding.
fn resnet() -> ModelSpec {
    ModelSpec {
        backbone: Backbone::ResNet { base_channels: 8, blocks: [1, 2, 1] },
        crop: 96,
        width: 32,
        heads: 4,
        feed_forward: 48,
        encoder_layers: 2,
        decoder_layers: 2,
        ltrb_hidden: 8,
        test_embedding: true,
        templates: 3,
        ..ModelSpec::NANO
    }
}

/// Sides of a declared tensor, or what keeps them from being fixed.
fn fixed_shape(info: &pb::ValueInfoProto) -> Result<Vec<i64>, String> {
    let Some(Type::TensorType(tensor)) = info.r#type.as_ref().and_then(|t| t.value.as_ref()) else {
        return Err("no tensor type".into());
    };
    let shape = tensor.shape.as_ref().ok_or("no shape")?;
    let side = |d: &pb::tensor_shape_proto::Dimension| match &d.value {
        Some(Dim::DimValue(n)) if *n > 0 => Ok(*n),
        other => Err(format!("a side is {other:?}")),
    };
    shape.dim.iter().map(side).collect()
}

#[test]
fn shapes_are_fixed_and_operators_known() {
    let mut used = BTreeSet::new();
    let resnet = resnet();
    for (name, files) in [
        ("shipped nano", shipped()),
        ("nano", fresh(&ModelSpec::NANO)),
        ("small", fresh(&ModelSpec::SMALL)),
        ("resnet", fresh(&resnet)),
    ] {
        let weights = files.iter().find(|(kind, _)| *kind == SectionKind::Weights);
        let weights = &weights.expect("weights").1;
        let mut graphs = 0;
        for (kind, bytes) in &files {
            if !kind.to_string().ends_with(".onnx") {
                continue;
            }
            graphs += 1;
            let at = format!("{name}, {kind}");
            let mut proto = onnx().proto_model_for_read(&mut &bytes[..]).unwrap();
            let opsets: Vec<_> =
                proto.opset_import.iter().map(|o| (o.domain.as_str(), o.version)).collect();
            assert_eq!(opsets, [("", OPSET)], "{at}: only ONNX's own operators, opset {OPSET}");
            let graph = proto.graph.as_mut().unwrap();
            let declared = graph.input.iter().chain(&graph.output).chain(&graph.value_info);
            for info in declared {
                let shape = fixed_shape(info);
                assert!(shape.is_ok(), "{at}: `{}`: {shape:?}", info.name);
            }
            let constant: BTreeSet<&str> =
                graph.initializer.iter().map(|tensor| tensor.name.as_str()).collect();
            for node in &graph.node {
                assert!(node.domain.is_empty(), "{at}: `{}` is of {}", node.name, node.domain);
                used.insert(node.op_type.clone());
                // What the table restricts: further outputs of poolings and norms, dilated
                // poolings, and whatever describes a shape must be known when the engine is built.
                assert_eq!(node.output.len(), 1, "{at}: `{}`", node.name);
                let described = ["Reshape", "Slice", "ReduceSum", "Expand", "Pad", "Tile", "Clip"];
                if described.contains(&node.op_type.as_str()) {
                    let open = node.input[1..].iter().find(|i| !constant.contains(i.as_str()));
                    assert!(open.is_none(), "{at}: `{}` depends on {open:?}", node.name);
                }
                if node.op_type == "MaxPool" {
                    let dilations = node.attribute.iter().find(|a| a.name == "dilations");
                    let plain = dilations.is_none_or(|a| a.ints.iter().all(|&d| d == 1));
                    assert!(plain, "{at}: `{}` is dilated", node.name);
                }
            }
            // What lies between inputs and outputs follows from them: no side is left open.
            for tensor in &mut graph.initializer {
                inline(tensor, weights);
            }
            let model = onnx().model_for_proto_model(&proto).unwrap().into_typed().unwrap();
            for node in &model.nodes {
                for output in &node.outputs {
                    let shape = &output.fact.shape;
                    assert!(shape.as_concrete().is_some(), "{at}: `{}` is {shape:?}", node.name);
                }
            }
        }
        assert!(graphs >= 4, "{name}: {graphs} graphs");
    }
    println!("operators used: {}", used.iter().cloned().collect::<Vec<_>>().join(", "));
    for op in &used {
        assert!(TENSORRT.contains(&op.as_str()), "TensorRT 10 has no {op}");
    }
    let docs = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/onnx.md");
    let docs = std::fs::read_to_string(docs).unwrap();
    for op in &used {
        assert!(docs.contains(&format!("`{op}`")), "docs/onnx.md does not list {op}");
    }
}

/// Puts a tensor's external data into it.
fn inline(tensor: &mut pb::TensorProto, weights: &[u8]) {
    let field = |key: &str| tensor.external_data.iter().find(|e| e.key == key).map(|e| &*e.value);
    let Some(location) = field("location") else { return };
    assert_eq!(location, WEIGHTS_FILE);
    let number = |key| field(key).unwrap().parse::<usize>().unwrap();
    let (offset, length) = (number("offset"), number("length"));
    tensor.raw_data = weights[offset..offset + length].to_vec();
    tensor.external_data.clear();
    tensor.data_location = None;
}
