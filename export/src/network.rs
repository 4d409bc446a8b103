//! The tracker's network as ONNX graphs over one set of weights.

use crate::onnx::{ExportError, Graph, Storage, WeightStore, encode, optimise, record};
use burn::module::Module as _;
use burn::tensor::Device;
use tsda_runtime::ModelSpec;
use tsda_runtime::bundle::{SectionKind, WEIGHTS_FILE};
use tsda_trainer::model::{SlotForm, TrackerNet};

/// One graph and how it came about.
#[derive(Clone, Debug)]
pub struct NetworkGraph {
    /// Its place in the bundle.
    pub kind: SectionKind,
    /// The simplified graph.
    pub graph: Graph,
    /// Nodes as recorded, before simplification.
    pub recorded: usize,
}

/// Records the three inference functions: `features`, `template`, and `predict` for every number of
/// filled slots from 1 to `spec().templates`. Nothing else of the module is looked at, so parts
/// that serve training only cannot get into the graphs.
///
/// # Errors
/// When the network uses an operation that the converter does not know.
pub fn graphs(net: &TrackerNet) -> Result<Vec<NetworkGraph>, ExportError> {
    graphs_as(net, SlotForm::default())
}

/// [`graphs`] with a form of slot of choice.
///
/// # Errors
/// As [`graphs`].
pub fn graphs_as(net: &TrackerNet, form: SlotForm) -> Result<Vec<NetworkGraph>, ExportError> {
    let spec = *net.spec();
    let mut graphs = vec![features(net, &spec)?, template(net, &spec, form)?];
    for count in 1..=spec.templates {
        graphs.push(predict(net, &spec, form, count)?);
    }
    Ok(graphs)
}

/// The files of the graphs, and the weights they share.
pub fn files(graphs: &[NetworkGraph]) -> Vec<(SectionKind, Vec<u8>)> {
    let mut weights = WeightStore::new(WEIGHTS_FILE);
    let mut files: Vec<_> = graphs
        .iter()
        .map(|g| (g.kind, encode(&g.graph, Storage::External(&mut weights))))
        .collect();
    files.push((SectionKind::Weights, weights.into_bytes()));
    files
}

fn simplified(kind: SectionKind, mut graph: Graph) -> NetworkGraph {
    let recorded = graph.nodes.len();
    optimise(&mut graph);
    NetworkGraph { kind, graph, recorded }
}

fn feature_doc(spec: &ModelSpec) -> String {
    let (d, f) = (spec.width, spec.map_side());
    format!("head feature (1, {d}, {f}, {f}): batch, channel, row, column; cell of 16 crop pixels")
}

fn features(net: &TrackerNet, spec: &ModelSpec) -> Result<NetworkGraph, ExportError> {
    let side = spec.crop_side();
    let doc = "Head feature of a crop; run once per frame. The feature of a search frame goes to \
               predict, that of a frame to remember to template.";
    let graph = record("features", doc, |r| {
        let net = r.module(net);
        let crop = format!(
            "crop (1, 3, {side}, {side}): batch, channel, row, column; R, G, B, (value / 255 - \
             mean) / std with mean {:?} and std {:?}; single-channel sensors repeat their value",
            spec.input_mean, spec.input_std
        );
        let crop = r.input("crop", [1, 3, side, side], &crop)?;
        r.output("feature", net.features(crop), &feature_doc(spec))
    })?;
    Ok(simplified(SectionKind::FeaturesOnnx, graph))
}

fn slot_doc(spec: &ModelSpec, form: SlotForm) -> String {
    let (cells, d, columns) = (spec.cells(), spec.width, form.columns(spec));
    let columns_are = match form {
        SlotForm::Tokens => "channel of the token".into(),
        SlotForm::Projected => format!(
            "{d} each of token, query, key and value of the first encoder layer, positional code \
             and biases included, queries divided by the root of a head's depth"
        ),
    };
    format!("({cells}, {columns}): cell (row-major), {columns_are}")
}

fn template(
    net: &TrackerNet,
    spec: &ModelSpec,
    form: SlotForm,
) -> Result<NetworkGraph, ExportError> {
    let (d, f) = (usize::from(spec.width), spec.map_side());
    let doc = "What a slot keeps of a frame to remember; run once per memory write.";
    let graph = record("template", doc, |r| {
        let net = r.module(net);
        let feature = r.input("feature", [1, d, f, f], &feature_doc(spec))?;
        let label = format!(
            "label ({f}, {f}): Gaussian of height 1 at the target's centre, sigma {} cells",
            spec.label_sigma_cells()
        );
        let label = r.input("label", [f, f], &label)?;
        let ltrb = format!(
            "target box (4, {f}, {f}): distances of every cell's centre (16 column + 8, 16 row + \
             8) to its left, top, right, bottom edge, in units of the crop side"
        );
        let ltrb = r.input("ltrb", [4, f, f], &ltrb)?;
        let doc = format!("template slot {}", slot_doc(spec, form));
        r.output("tokens", net.template_as(form, feature, label, ltrb), &doc)
    })?;
    Ok(simplified(SectionKind::TemplateOnnx, graph))
}

fn predict(
    net: &TrackerNet,
    spec: &ModelSpec,
    form: SlotForm,
    count: u8,
) -> Result<NetworkGraph, ExportError> {
    let (d, f) = (usize::from(spec.width), spec.map_side());
    let doc = format!("Score map and boxes of a search frame against {count} template(s).");
    let graph = record(&format!("predict{count}"), &doc, |r| {
        let net = r.module(net);
        let templates = (0..count)
            .map(|slot| {
                let which = if slot == 0 { " of the annotated first frame" } else { "" };
                let doc = format!("slot {slot}{which}, as the template graph wrote it");
                r.input(&format!("template{slot}"), [f * f, form.columns(spec)], &doc)
            })
            .collect::<Result<Vec<_>, _>>()?;
        let feature = r.input("feature", [1, d, f, f], &feature_doc(spec))?;
        let (scores, ltrb) = net.predict(templates, feature);
        let doc = format!("score map ({f}, {f}): row, column; about 1 on the target, else about 0");
        r.output("scores", scores, &doc)?;
        let doc = format!(
            "boxes (4, {f}, {f}): distances of every cell's centre to the left, top, right, \
             bottom edge of the target, in units of the crop side; read where the score is highest"
        );
        r.output("ltrb", ltrb, &doc)
    })?;
    Ok(simplified(SectionKind::PredictOnnx(count), graph))
}

/// Number of parameters and running statistics of a network.
pub fn parameters(net: &TrackerNet) -> usize {
    net.num_params()
}

/// A network with random weights on the CPU, for tests and size estimates.
///
/// # Errors
/// When `spec` is not valid.
pub fn untrained(spec: &ModelSpec, seed: u64) -> Result<TrackerNet, tsda_runtime::SpecError> {
    let device = Device::flex();
    device.seed(seed);
    TrackerNet::new(spec, &tsda_trainer::model::NetOptions::default(), &device)
}
