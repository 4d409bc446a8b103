//! Small graphs written by hand: what is computed, and what is refused.

mod blocks;
mod bytes;
mod norms;
mod points;

use super::*;
use crate::bundle::{
    HEADER_LEN, Manifest, Section, SectionKind as Kind, WEIGHTS_FILE, align_up, crc32, header,
};
use crate::probe;
use proptest::prelude::*;

/// A protobuf message that is being written.
#[derive(Clone, Default)]
struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut n: u64) {
        while n >= 0x80 {
            self.0.push(n as u8 | 0x80);
            n >>= 7;
        }
        self.0.push(n as u8);
    }
    fn int(mut self, field: u64, n: i64) -> Self {
        self.varint(field << 3);
        self.varint(n as u64);
        self
    }
    fn bytes(mut self, field: u64, bytes: impl AsRef<[u8]>) -> Self {
        self.varint(field << 3 | 2);
        self.varint(bytes.as_ref().len() as u64);
        self.0.extend(bytes.as_ref());
        self
    }
    fn sub(self, field: u64, message: Self) -> Self {
        self.bytes(field, message.0)
    }
    fn float(mut self, field: u64, x: f32) -> Self {
        self.varint(field << 3 | 5);
        self.0.extend(x.to_le_bytes());
        self
    }
}

fn ints(name: &str, values: &[i64]) -> Message {
    values.iter().fold(Message::default().bytes(1, name).int(20, 7), |m, &v| m.int(8, v))
}

fn int(name: &str, value: i64) -> Message {
    Message::default().bytes(1, name).int(20, 2).int(3, value)
}

fn float(name: &str, value: f32) -> Message {
    Message::default().bytes(1, name).int(20, 1).float(2, value)
}

fn node(op: &str, inputs: &[&str], output: &str, attributes: Vec<Message>) -> Message {
    let m = inputs.iter().fold(Message::default(), |m, i| m.bytes(1, i));
    let m = m.bytes(2, output).bytes(3, format!("{op}_{output}")).bytes(4, op);
    attributes.into_iter().fold(m, |m, a| m.sub(5, a))
}

fn port(name: &str, shape: &[usize]) -> Message {
    let dims = shape
        .iter()
        .fold(Message::default(), |m, &n| m.sub(1, Message::default().int(1, n as i64)));
    let tensor = Message::default().int(1, 1).sub(2, dims);
    Message::default().bytes(1, name).sub(2, Message::default().sub(1, tensor))
}

fn floats(name: &str, shape: &[usize], values: &[f32]) -> Message {
    let m = shape.iter().fold(Message::default(), |m, &n| m.int(1, n as i64));
    let raw: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    m.int(2, 1).bytes(8, name).bytes(9, raw)
}

fn longs(name: &str, values: &[i64]) -> Message {
    let m = Message::default().int(1, values.len() as i64).int(2, 7).bytes(8, name);
    values.iter().fold(m, |m, &v| m.int(7, v))
}

/// A model file: nodes, inputs, outputs, constants.
fn model(
    nodes: Vec<Message>,
    inputs: Vec<Message>,
    outputs: Vec<Message>,
    constants: Vec<Message>,
) -> Vec<u8> {
    let fields = [(1, nodes), (5, constants), (11, inputs), (12, outputs)];
    let graph = fields.into_iter().fold(Message::default(), |m, (field, all)| {
        all.into_iter().fold(m, |m, part| m.sub(field, part))
    });
    Message::default().int(1, 8).sub(7, graph).0
}

const SPEC: ModelSpec = ModelSpec { crop: 48, width: 4, heads: 1, ..ModelSpec::NANO };
const SIDE: usize = 3;
const CELLS: usize = SIDE * SIDE;

/// The convolution's weights, at byte 64 of the section.
fn weights() -> Vec<f32> {
    (0..4 * 3 * 256).map(|i| ((i * 37 % 101) as f32 - 50.0) * 1e-3).collect()
}

fn external(offset: &str, length: &str, location: &str) -> Message {
    let entry = |key: &str, value: &str| Message::default().bytes(1, key).bytes(2, value);
    let m = [4, 3, 16, 16].iter().fold(Message::default(), |m, &n| m.int(1, n));
    m.int(2, 1)
        .bytes(8, "kernel")
        .sub(13, entry("location", location))
        .sub(13, entry("offset", offset))
        .sub(13, entry("length", length))
        .int(14, 1)
}

fn features_with(kernel: Message, op: &str, crop: usize) -> Vec<u8> {
    let attributes = vec![ints("kernel_shape", &[16, 16]), ints("strides", &[16, 16])];
    model(
        vec![node(op, &["crop", "kernel"], "feature", attributes)],
        vec![port("crop", &[1, 3, crop, crop])],
        vec![port("feature", &[1, 4, SIDE, SIDE])],
        vec![kernel],
    )
}

fn kernel() -> Message {
    external("64", "12288", WEIGHTS_FILE)
}

/// `tokens = feature^T + label + mean of ltrb`.
fn template() -> Vec<u8> {
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
            port("ltrb", &[4, SIDE, SIDE]),
            port("feature", &[1, 4, SIDE, SIDE]),
            port("label", &[SIDE, SIDE]),
        ],
        vec![port("tokens", &[CELLS, 4])],
        vec![longs("flat", &[4, 9]), longs("column", &[9, 1])],
    )
}

/// `scores = channel mean + sum over slots of mean(tokens)`, `ltrb = exp(feature)`.
fn predict(templates: usize, side: i64, op: &str) -> Vec<u8> {
    let mut nodes = vec![
        node("Reshape", &["feature", "map"], "fm", vec![]),
        node(op, &["fm"], "ltrb", vec![]),
        node("ReduceMean", &["fm"], "s0", vec![ints("axes", &[0]), int("keepdims", 0)]),
    ];
    let mut inputs = vec![port("feature", &[1, 4, SIDE, SIDE])];
    for i in 0..templates {
        let (name, mean) = (format!("template{i}"), format!("mean{i}"));
        inputs.push(port(&name, &[CELLS, 4]));
        let axes = vec![ints("axes", &[0, 1]), int("keepdims", 0)];
        nodes.push(node("ReduceMean", &[&name], &mean, axes));
        let to = if i + 1 == templates { "scores".into() } else { format!("s{}", i + 1) };
        nodes.push(node("Add", &[&format!("s{i}"), &mean], &to, vec![]));
    }
    let outputs = vec![port("ltrb", &[4, SIDE, SIDE]), port("scores", &[SIDE, SIDE])];
    model(nodes, inputs, outputs, vec![longs("map", &[4, side, 3])])
}

fn parts() -> Vec<(Kind, Vec<u8>)> {
    let weights = [0; 64].into_iter().chain(weights().into_iter().flat_map(f32::to_le_bytes));
    vec![
        (Kind::FeaturesOnnx, features_with(kernel(), "Conv", 48)),
        (Kind::TemplateOnnx, template()),
        (Kind::PredictOnnx(1), predict(1, 3, "Exp")),
        (Kind::PredictOnnx(2), predict(2, 3, "Exp")),
        (Kind::Weights, weights.collect()),
    ]
}

fn write(parts: &[(Kind, Vec<u8>)]) -> Vec<u8> {
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

fn load(parts: &[(Kind, Vec<u8>)]) -> Result<NativeEngine, EngineError> {
    NativeEngine::from_bundle(&Bundle::parse(&write(parts)).unwrap())
}

fn mean(values: &[f32]) -> f32 {
    values.iter().sum::<f32>() / values.len() as f32
}

#[test]
fn a_hand_computed_network_gives_the_same_numbers() {
    let feature_of = |crop: &[f32]| -> Vec<f32> {
        let w = weights();
        let at = |o: usize, cell: usize, i: usize| {
            let (channel, y, x) = (i / 256, i / 16 % 16, i % 16);
            let (r, c) = (cell / SIDE * 16 + y, cell % SIDE * 16 + x);
            w[o * 768 + i] * crop[(channel * 48 + r) * 48 + c]
        };
        (0..4 * CELLS).map(|k| (0..768).map(|i| at(k / CELLS, k % CELLS, i)).sum()).collect()
    };
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
    for (filled, offset) in [(1, means[0]), (2, means[0] + means[1]), (1, means[0])] {
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
    for threads in [0, 65] {
        let options = NativeOptions { threads, ..NativeOptions::default() };
        let bytes = write(&parts());
        let refused = NativeEngine::with_options(&Bundle::parse(&bytes).unwrap(), options);
        assert!(message(refused.unwrap_err()).contains("1 to 64"));
    }
}

#[test]
fn what_is_wrong_with_a_bundle_is_named() {
    let with = |at: usize, bytes: Vec<u8>| {
        let mut parts = parts();
        parts[at].1 = bytes;
        load(&parts).unwrap_err().to_string()
    };
    let kernel_at = |offset: &str, length: &str, file: &str| {
        with(0, features_with(external(offset, length, file), "Conv", 48))
    };
    let cases: [(String, &[&str]); 10] = [
        (with(0, b"\xff\xff".to_vec()), &["features.onnx", "not readable"]),
        (with(0, Vec::new()), &["features.onnx", "no graph"]),
        (
            with(0, features_with(kernel(), "Conv", 64)),
            &["features.onnx", "`feature`", "[1, 4, 4, 4]"],
        ),
        (
            with(0, features_with(kernel(), "Frobnicate", 48)),
            &["features.onnx", "Frobnicate_feature", "not supported"],
        ),
        (with(3, predict(2, 3, "Frobnicate")), &["predict2.onnx", "Frobnicate_ltrb"]),
        (with(2, predict(1, 4, "Exp")), &["predict1.onnx", "Reshape_fm", "[4, 4, 3]"]),
        (with(4, vec![0; 100]), &["features.onnx", "`kernel`", "outside the weights section"]),
        (kernel_at("-1", "12288", WEIGHTS_FILE), &["`kernel`", "offset `-1`"]),
        (kernel_at("64", "12288", "/etc/passwd"), &["weights.bin"]),
        (kernel_at("64", "64", WEIGHTS_FILE), &["`kernel`", "16 elements"]),
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

/// Runs one graph `x -> y` on the planner and a team of two threads.
fn evaluate(bytes: &[u8], x: (&[usize], &[f32]), y: &[usize]) -> Vec<f32> {
    planned(bytes, x, y, None).0
}

/// As [`evaluate`], with so many floats for transformed weights; also how often every kind of step
/// is in the plan.
fn planned(
    bytes: &[u8],
    x: (&[usize], &[f32]),
    y: &[usize],
    growth: Option<usize>,
) -> (Vec<f32>, Vec<(&'static str, usize)>) {
    let mut graph = graph::read(bytes, &[]).unwrap();
    graph::fuse(&mut graph);
    let kernels = Isa::best().kernels().unwrap();
    let mut planner = Planner::new(kernels, 2, 0, growth, None);
    let (from, to) = (planner.lasting(x.1.len()), planner.lasting(y.iter().product()));
    let bind =
        |name, at, shape: &[usize]| Binding { name, view: View::dense(Base::Arena(at), shape) };
    planner.add("test", &graph, &[bind("x", from, x.0)], &[bind("y", to, y)]).unwrap();
    let plan = planner.finish().unwrap();
    let kinds = plan.summaries[1].kinds.iter().map(|k| (k.0, k.1)).collect();
    let mut team = Team::new(plan.arena, plan.weights, plan.programs, kernels, 2, false).unwrap();
    team.view_mut(from..from + x.1.len()).copy_from_slice(x.1);
    team.run(0);
    team.run(1);
    (team.view(to..to + y.iter().product::<usize>()).to_vec(), kinds)
}

/// Hard-swish as one node and written out, alone and behind a gate: the same numbers, and one step
/// for what was written in two or three.
#[test]
fn hard_swish_in_all_its_forms() {
    let x: Vec<f32> = (0..24).map(|i| 0.5 * i as f32 - 6.0).collect();
    let gates = [0.25, 0.0, 1.0];
    let sixth = || vec![float("alpha", 1.0 / 6.0), float("beta", 0.5)];
    let swish = |v: f32| v * (v / 6.0 + 0.5).clamp(0.0, 1.0);
    let file = |nodes| {
        let constants = vec![floats("gate", &[1, 3, 1, 1], &gates)];
        model(nodes, vec![port("x", &[1, 3, 2, 4])], vec![port("y", &[1, 3, 2, 4])], constants)
    };
    let gate = || node("Mul", &["x", "gate"], "g", vec![]);
    let cases = [
        (file(vec![node("HardSwish", &["x"], "y", vec![])]), false),
        (
            file(vec![
                node("HardSigmoid", &["x"], "h", sixth()),
                node("Mul", &["x", "h"], "y", vec![]),
            ]),
            false,
        ),
        (
            file(vec![
                gate(),
                node("HardSigmoid", &["g"], "h", sixth()),
                node("Mul", &["h", "g"], "y", vec![]),
            ]),
            true,
        ),
        (file(vec![gate(), node("HardSwish", &["g"], "y", vec![])]), true),
    ];
    for (i, (bytes, gated)) in cases.iter().enumerate() {
        let mut graph = graph::read(bytes, &[]).unwrap();
        graph::fuse(&mut graph);
        assert_eq!(graph.nodes.len(), 1, "case {i}");
        let found = evaluate(bytes, (&[1, 3, 2, 4], &x), &[1, 3, 2, 4]);
        for (j, (y, x)) in found.iter().zip(&x).enumerate() {
            let want = swish(if *gated { x * gates[j / 8] } else { *x });
            assert!((y - want).abs() <= 1e-6, "case {i}, element {j}: {y}, not {want}");
        }
    }
    // Behind a product it is part of the product.
    let weight: Vec<f32> = (0..9).map(|i| 0.25 * i as f32 - 1.0).collect();
    let constants = vec![floats("w", &[3, 3, 1, 1], &weight)];
    let io = |name| vec![port(name, &[1, 3, 2, 4])];
    let nodes = vec![
        node("Conv", &["x", "w"], "c", vec![]),
        node("HardSigmoid", &["c"], "h", sixth()),
        node("Mul", &["c", "h"], "y", vec![]),
    ];
    let bytes = model(nodes, io("x"), io("y"), constants);
    let mut graph = graph::read(&bytes, &[]).unwrap();
    graph::fuse(&mut graph);
    assert_eq!(graph.nodes.len(), 1, "after a convolution");
    let found = evaluate(&bytes, (&[1, 3, 2, 4], &x), &[1, 3, 2, 4]);
    for (j, y) in found.iter().enumerate() {
        let sum: f32 = (0..3).map(|c| weight[j / 8 * 3 + c] * x[c * 8 + j % 8]).sum();
        assert!((y - swish(sum)).abs() <= 1e-5, "after a convolution, {j}: {y}");
    }
    // Another slope is another function, and a product that is used twice stays.
    let other = file(vec![
        node("HardSigmoid", &["x"], "h", vec![float("alpha", 0.2)]),
        node("Mul", &["x", "h"], "y", vec![]),
    ]);
    let mut graph = graph::read(&other, &[]).unwrap();
    graph::fuse(&mut graph);
    assert_eq!(graph.nodes.len(), 2);
    let found = evaluate(&other, (&[1, 3, 2, 4], &x), &[1, 3, 2, 4]);
    let want = |x: f32| x * (0.2 * x + 0.5).clamp(0.0, 1.0);
    assert!(found.iter().zip(&x).all(|(y, x)| (y - want(*x)).abs() <= 1e-6));
}

/// Layouts that need copies, constants that need computing, operators in unusual places.
#[test]
fn moves_and_constants() {
    let x: Vec<f32> = (0..24).map(|i| i as f32).collect();
    let file = |nodes, y: &[usize], constants| {
        model(nodes, vec![port("x", &[2, 3, 4])], vec![port("y", y)], constants)
    };
    let perm = || vec![ints("perm", &[2, 0, 1])];
    let turned = |i: usize| x[i % 6 * 4 + i / 6];
    // (2, 3, 4) -> (4, 2, 3) -> (24), which no view can show.
    let flat = file(
        vec![node("Transpose", &["x"], "t", perm()), node("Reshape", &["t", "all"], "y", vec![])],
        &[24],
        vec![longs("all", &[-1])],
    );
    assert_eq!(evaluate(&flat, (&[2, 3, 4], &x), &[24]), (0..24).map(turned).collect::<Vec<_>>());
    // y = (x[:, 1:, ::2] joined with x[:, :1, 1:3]) * exp(0) + 1, constants computed at load.
    let pieces = file(
        vec![
            node("Exp", &["zero"], "one", vec![]),
            node("Slice", &["x", "s1", "e1", "a1", "k1"], "p", vec![]),
            node("Slice", &["x", "s2", "e2", "a1"], "q", vec![]),
            node("Concat", &["p", "q"], "c", vec![int("axis", -2)]),
            node("Mul", &["c", "one"], "m", vec![]),
            node("Add", &["m", "one"], "y", vec![]),
        ],
        &[2, 3, 2],
        vec![
            floats("zero", &[1, 1], &[0.0]),
            longs("s1", &[1, 0]),
            longs("e1", &[9, 9]),
            longs("a1", &[1, 2]),
            longs("k1", &[1, 2]),
            longs("s2", &[0, 1]),
            longs("e2", &[1, -1]),
        ],
    );
    let want: Vec<f32> = [4, 6, 8, 10, 1, 2, 16, 18, 20, 22, 13, 14].map(|i| x[i] + 1.0).into();
    assert_eq!(evaluate(&pieces, (&[2, 3, 4], &x), &[2, 3, 2]), want);
    // Gather, Split-like slices and a LayerNorm over a row that is no run.
    let rows = file(
        vec![
            node("Gather", &["x", "pick"], "g", vec![int("axis", 1)]),
            node("Transpose", &["g"], "t", vec![ints("perm", &[0, 2, 1])]),
            node("LayerNormalization", &["t", "gain"], "y", vec![float("epsilon", 0.0)]),
        ],
        &[2, 4, 2],
        vec![longs("pick", &[2, 0]), floats("gain", &[2], &[1.0, 2.0])],
    );
    let found = evaluate(&rows, (&[2, 3, 4], &x), &[2, 4, 2]);
    assert!(found.chunks(2).all(|r| (r[0] - 1.0).abs() < 1e-5 && (r[1] + 2.0).abs() < 1e-5));
    // Gemm with both sides turned and a bias; the batch of products of a tensor with itself.
    let gemm = model(
        vec![
            node("Gemm", &["x", "w", "c"], "g", vec![int("transA", 1), int("transB", 1)]),
            node("Transpose", &["g"], "gt", vec![]),
            node("MatMul", &["g", "gt"], "y", vec![]),
        ],
        vec![port("x", &[2, 3])],
        vec![port("y", &[3, 3])],
        vec![floats("w", &[1, 2], &[1.0, 10.0]), floats("c", &[1], &[0.5])],
    );
    let found = evaluate(&gemm, (&[2, 3], &x[..6]), &[3, 3]);
    let g = [30.5, 41.5, 52.5];
    assert_eq!(found, (0..9).map(|i| g[i / 3] * g[i % 3]).collect::<Vec<f32>>());
}

/// Two groups, an uneven border, a dilation: nothing the shipped networks have.
#[test]
fn unusual_convolutions() {
    let x: Vec<f32> = (0..4 * 5 * 6).map(|i| (i * 37 % 23) as f32 * 0.1 - 1.0).collect();
    let w: Vec<f32> = (0..6 * 2 * 4).map(|i| (i * 17 % 13) as f32 * 0.1 - 0.6).collect();
    let file = model(
        vec![
            node(
                "Conv",
                &["x", "w", "b"],
                "c",
                vec![
                    ints("pads", &[1, 0, 0, 2]),
                    ints("dilations", &[2, 1]),
                    ints("strides", &[1, 2]),
                    int("group", 2),
                ],
            ),
            node("Relu", &["c"], "y", vec![]),
        ],
        vec![port("x", &[1, 4, 5, 6])],
        vec![port("y", &[1, 6, 4, 4])],
        vec![floats("w", &[6, 2, 2, 2], &w), floats("b", &[6], &[0.1, 0.2, 0.3, 0.4, 0.5, 0.6])],
    );
    let found = evaluate(&file, (&[1, 4, 5, 6], &x), &[1, 6, 4, 4]);
    for (i, &v) in found.iter().enumerate() {
        let (o, r, c) = (i / 16, i / 4 % 4, i % 4);
        let mut sum = 0.1 * (o + 1) as f32;
        for k in 0..8 {
            let (ch, ky, kx) = (k / 4, k / 2 % 2, k % 2);
            let (y, x_at) = (r + 2 * ky, 2 * c + kx);
            if (1..6).contains(&y) && x_at < 6 {
                sum += w[o * 8 + k] * x[((o / 3 * 2 + ch) * 5 + y - 1) * 6 + x_at];
            }
        }
        assert!((v - sum.max(0.0)).abs() < 1e-5, "{v} instead of {sum} at {i}");
    }
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = graph::read(&bytes, &[]);
    }

    /// Changed bytes of a real graph reach every reader and the planner.
    #[test]
    fn damaged_graphs_are_read_or_refused(
        which in 0usize..4,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
        cut in prop::option::of(any::<prop::sample::Index>()),
    ) {
        let mut parts = parts();
        let bytes = &mut parts[which].1;
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if let Some(cut) = cut {
            bytes.truncate(cut.index(bytes.len()));
        }
        let _ = load(&parts);
    }
}
