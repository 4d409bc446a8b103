//! The exact re-arrangements of spec 4.2 and 4.3 in the exported graphs: what is there, what is not,
//! and what it costs.

use std::path::Path;
use tsda_export::macs::{self, MacsReport};
use tsda_export::network::{self, NetworkGraph};
use tsda_export::onnx::{Graph, Node};
use tsda_export::{bundle, onnx};
use tsda_runtime::bundle::{Bundle, BundleFile, Manifest, SectionKind};
use tsda_runtime::engine::TractEngine;
use tsda_runtime::probe::{self, Probe};
use tsda_runtime::{Backbone, ModelSpec};
use tsda_trainer::burn_engine::BurnEngine;
use tsda_trainer::model::SlotForm;

fn small() -> ModelSpec {
    ModelSpec {
        backbone: Backbone::ResNet { base_channels: 8, blocks: [1, 1, 1] },
        crop: 96,
        width: 32,
        heads: 4,
        feed_forward: 48,
        encoder_layers: 3,
        decoder_layers: 2,
        ltrb_hidden: 8,
        templates: 3,
        ..ModelSpec::NANO
    }
}

fn preset(spec: &ModelSpec) -> MacsReport {
    macs::of_graphs(&network::graphs(&network::untrained(spec, 3).unwrap()).unwrap())
}

/// Within the rounding of the specification's table.
fn assert_millions(what: &str, macs: u64, want: f64) {
    let off = (macs as f64 * 1e-6 - want).abs();
    assert!(off <= 0.5 + 1e-4 * want, "{what}: {macs} MAC, {want} million expected");
}

/// The table of spec 4.3, and the sums of 4.1 that the re-arrangements leave alone.
#[test]
fn full_size_networks_cost_what_the_specification_says() {
    for (spec, backbone, two, one) in [
        (ModelSpec::TOMP101, 11_555.1, 29_822.0, 19_435.0),
        (ModelSpec::TOMP50, 5_418.6, 23_686.0, 13_298.0),
    ] {
        let report = preset(&spec);
        println!("{report}");
        let part = |graph: &str, part: &str| report.graph(graph).unwrap().part(part);
        assert_millions("backbone", part("features", "backbone"), backbone);
        assert_millions("head conv", part("features", "head conv"), 764.4);
        assert_millions("encoder", part("predict2", "encoder"), 16_678.0);
        assert_millions("decoder", part("predict2", "decoder"), 57.0);
        assert_millions("box regressor", part("predict2", "box regressor"), 767.5);
        // Once per memory write: the box MLP on 324 cells, projections of one layer.
        assert_millions("box encoding", part("template", "box encoding"), 106.5 / 4.0);
        assert_millions("template's projections", part("template", "encoder"), 63.7);
        assert_millions("two templates", report.per_frame[&2], two);
        assert_millions("one template", report.per_frame[&1], one);
        assert!(report.graphs.iter().all(|g| g.part("other") == 0), "{report}");
    }
}

/// Slots of tokens cost the projections of a frame in every prediction, and nothing else.
#[test]
fn the_first_layer_of_templates_is_left_to_the_memory_write() {
    let spec = ModelSpec::NANO;
    let net = network::untrained(&spec, 3).unwrap();
    let of = |form| macs::of_graphs(&network::graphs_as(&net, form).unwrap());
    let (tokens, projected) = (of(SlotForm::Tokens), of(SlotForm::Projected));
    let d = u64::from(spec.width);
    let projections = spec.cells() as u64 * 3 * d * d;
    for count in [1, 2] {
        let saved = tokens.per_frame[&count] - projected.per_frame[&count];
        assert_eq!(saved, u64::from(count) * projections);
    }
    let written = |report: &MacsReport| report.graph("template").unwrap().macs;
    assert_eq!(written(&projected) - written(&tokens), projections);
}

/// Files are counted from their shapes alone, graphs while they are still in memory.
#[test]
fn files_and_graphs_are_counted_alike() {
    for spec in [small(), ModelSpec::NANO] {
        let graphs = network::graphs(&network::untrained(&spec, 3).unwrap()).unwrap();
        for g in &graphs {
            let mut store = onnx::WeightStore::new("weights.bin");
            let file = onnx::model(&g.graph, onnx::Storage::External(&mut store));
            let counted = onnx::macs::count(&g.graph);
            assert!(!counted.is_empty());
            assert_eq!(onnx::macs::count_model(&file).unwrap(), counted, "{}", g.kind);
        }
    }
}

#[test]
fn the_shipped_bundle_can_be_counted() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/nano.tsda");
    let file = BundleFile::open(&path).unwrap();
    let bundle = file.bundle().unwrap();
    let report = macs::of_bundle(&bundle).unwrap();
    println!("{report}");
    // What is read from a file is what is counted while exporting.
    let spec = bundle.manifest().spec;
    let fresh = preset(&spec);
    let backbone = report.graph("features").unwrap().part("backbone");
    assert_eq!(backbone, fresh.graph("features").unwrap().part("backbone"));
    // The rest within a tenth: a file may be older than the last re-arrangement.
    let (stored, now) = (report.per_frame[&2] as f64, fresh.per_frame[&2] as f64);
    assert!((stored / now - 1.0).abs() < 0.1, "{stored} and {now}: {report}");
    // The two matrix products of attention, over the frame and two templates, in every encoder layer.
    let tokens = 3 * spec.cells() as u64;
    let attention = 2 * tokens * tokens * u64::from(spec.width) * u64::from(spec.encoder_layers);
    assert!(report.per_frame[&2] > attention + backbone, "{report}");
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["per_frame"]["2"], report.per_frame[&2]);
    assert_eq!(json["graphs"][0]["parts"][0]["part"], "backbone");
}

fn layer_nodes<'a>(graph: &'a Graph, layer: &'a str) -> impl Iterator<Item = &'a Node> {
    let live = graph.nodes.iter().filter(|n| graph.constant(n.output).is_none());
    live.filter(move |n| graph.value(n.output).name.starts_with(layer))
}

const ENCODER: &str = "head.filter_predictor.transformer.encoder.layers";
const DECODER: &str = "head.filter_predictor.transformer.decoder.layers";

fn predictions(graphs: &[NetworkGraph]) -> impl Iterator<Item = (u8, &Graph)> {
    graphs.iter().filter_map(|g| match g.kind {
        SectionKind::PredictOnnx(count) => Some((count, &g.graph)),
        _ => None,
    })
}

/// Spec 4.2: nothing before the first cross-attention depends on the frame, its query included.
#[test]
fn the_first_decoder_layer_starts_from_a_constant_query() {
    let spec = small();
    let graphs = network::graphs(&network::untrained(&spec, 3).unwrap()).unwrap();
    for (count, graph) in predictions(&graphs) {
        // Sums go by the layer before them, so of the norms only the norms themselves.
        for (part, op) in [("self_attn", "MatMul"), ("norm1", "LayerNormalization")] {
            let computed = |i: usize| {
                let layer = format!("{DECODER}.{i}.{part}");
                layer_nodes(graph, &layer).filter(|n| n.op == op).count()
            };
            assert_eq!(computed(0), 0, "{count}: {part} is computed");
            assert!(computed(1) > 0, "{count}: no {part} in the second layer");
        }
        let rows = if count == 1 { 1 } else { 2 };
        let layer = format!("{DECODER}.0.multihead_attn");
        let logits: Vec<&Node> = layer_nodes(graph, &layer)
            .filter(|n| n.op == "MatMul" && n.input(0).is_some_and(|q| graph.constant(q).is_some()))
            .collect();
        assert_eq!(logits.len(), rows, "{count}: logits of a constant query, one per row");
        for node in logits {
            let query = graph.dims(node.input(0).unwrap());
            let (heads, d) = (usize::from(spec.heads), usize::from(spec.width));
            assert_eq!(query.iter().product::<usize>(), heads * d);
            assert_eq!(graph.dims(node.output).iter().product::<usize>() % heads, 0);
        }
        // Then values and output, but no query, and no key or value of the memory.
        let weights = layer_nodes(graph, &layer).filter(|n| {
            n.op == "MatMul" && n.input(1).is_some_and(|w| graph.constant(w).is_some())
        });
        assert_eq!(weights.count(), 2 * rows, "{count}");
    }
}

/// One row with one template, two with more; one product for queries, keys and values; those of the
/// first layer for the search frame only, once for both rows.
#[test]
fn rows_and_projections_are_those_that_are_needed() {
    let spec = small();
    let (d, cells) = (usize::from(spec.width), spec.cells());
    let layers = usize::from(spec.encoder_layers) + usize::from(spec.decoder_layers);
    let graphs = network::graphs(&network::untrained(&spec, 3).unwrap()).unwrap();
    for (count, graph) in predictions(&graphs) {
        let rows = if count == 1 { 1 } else { 2 };
        let softmaxes = graph.nodes.iter().filter(|n| n.op == "Softmax").count();
        assert_eq!(softmaxes, rows * layers, "{count}");
        for i in 0..spec.encoder_layers {
            let layer = format!("{ENCODER}.{i}.self_attn");
            let weight = |n: &Node| n.input(1).filter(|w| graph.constant(*w).is_some());
            let projections: Vec<&Node> = layer_nodes(graph, &layer)
                .filter(|n| {
                    n.op == "MatMul" && weight(n).is_some_and(|w| graph.dims(w)[1] == 3 * d)
                })
                .collect();
            let tokens: usize = projections
                .iter()
                .map(|n| graph.dims(n.output).iter().product::<usize>() / (3 * d))
                .sum();
            let want = match (i, rows) {
                (0, _) => (1, cells),
                (_, 1) => (1, 2 * cells),
                _ => (2, (usize::from(count) + 1 + 2) * cells),
            };
            assert_eq!((projections.len(), tokens), want, "predict{count}, layer {i}");
            // Queries are scaled by their weights.
            let muls = layer_nodes(graph, &layer).filter(|n| ["Mul", "Div"].contains(&n.op));
            assert_eq!(muls.count(), 0, "predict{count}, layer {i}");
        }
        // What both rows read of the weights is there once.
        let mut seen = std::collections::HashSet::new();
        for id in graph.initialisers() {
            let Some(values) = graph.constant(id).and_then(onnx::Data::f32s) else { continue };
            let bits: Vec<u32> = values.iter().map(|v| v.to_bits()).collect();
            let fresh = bits.len() <= 64 || seen.insert((graph.dims(id).to_vec(), bits));
            assert!(fresh, "predict{count}: {} is there twice", graph.value(id).name);
        }
    }
}

/// Both forms of slot on tract, against burn.
#[test]
fn either_form_of_slot_runs_in_the_engine() {
    let spec = small();
    let net = network::untrained(&spec, 5).unwrap();
    let outputs = probe::capture(&mut BurnEngine::new(&net), &probe::default_boxes(&spec)).unwrap();
    for form in [SlotForm::Tokens, SlotForm::Projected] {
        let graphs = network::graphs_as(&net, form).unwrap();
        let mut sections = network::files(&graphs);
        sections.push((SectionKind::Probe, outputs.clone()));
        let manifest = Manifest::new("small", spec);
        let bytes = bundle::encode(&manifest, &sections).unwrap();
        let bundle = Bundle::parse(&bytes).unwrap();
        let probe = Probe::parse(bundle.section(SectionKind::Probe).unwrap(), &spec).unwrap();
        let mut engine = TractEngine::from_bundle(&bundle).unwrap();
        let off = probe::run(&mut engine, &probe).unwrap().max();
        println!("{form:?}: {off:.1e}");
        assert!(off <= 2e-5, "{form:?}: off by {off}");
        let counted = macs::of_bundle(&bundle).unwrap();
        assert_eq!(counted, macs::of_graphs(&graphs));
    }
}
