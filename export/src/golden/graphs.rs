//! Graphs with more outputs than the deployed ones, and libraries that run any graph.

use super::backend::{PARTS, PartValues};
use super::error::GoldenError;
use crate::network::NetworkGraph;
use crate::onnx::{ExportError, Graph, Recorder, Storage, encode, optimise, record};
use burn::tensor::Tensor;
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use tsda_runtime::bundle::SectionKind;
use tsda_runtime::engine::native::GraphSession as NativeSession;
#[cfg(feature = "ort")]
use tsda_runtime::engine::ort::graph::GraphSession;
use tsda_trainer::model::TrackerNet;
use tsda_trainer::model::inspect::{Mode, Parts};

/// A loaded graph.
pub trait Session {
    /// Runs it: inputs by name, outputs by the names given.
    ///
    /// # Errors
    /// What the library said.
    fn run(&mut self, inputs: &[(&str, &[f32])], outputs: &[&str])
    -> Result<Vec<Vec<f32>>, String>;
}

/// Loads an ONNX file that holds its weights into a library.
pub type Load = fn(&[u8]) -> Result<Box<dyn Session>, String>;

/// The opened graphs of a network on one library.
pub struct Opened {
    engine: &'static str,
    net: TrackerNet,
    load: Load,
    /// Shape of a slot's tokens.
    slot: Vec<usize>,
    features: Box<dyn Session>,
    template: Box<dyn Session>,
    /// By mode and number of templates, recorded when first needed.
    parts: HashMap<(bool, usize), Box<dyn Session>>,
}

impl Opened {
    /// Loads the deployed `features` and `template` graphs.
    ///
    /// # Errors
    /// When one is missing or the library refuses it.
    pub fn new(
        engine: &'static str,
        net: &TrackerNet,
        deployed: &[NetworkGraph],
        load: Load,
    ) -> Result<Self, GoldenError> {
        let spec = *net.spec();
        let find = |kind| {
            deployed.iter().find(|g| g.kind == kind).map(|g| &g.graph).ok_or_else(|| {
                GoldenError::Graph {
                    engine,
                    graph: kind.to_string(),
                    detail: "it was not recorded".into(),
                }
            })
        };
        let template = find(SectionKind::TemplateOnnx)?;
        // Whatever a slot holds: the deployed graph knows.
        let slot = template.outputs.first().map(|port| template.dims(port.value).to_vec());
        Ok(Self {
            engine,
            net: net.clone(),
            load,
            slot: slot.unwrap_or_else(|| vec![spec.cells(), spec.width.into()]),
            features: open(engine, load, find(SectionKind::FeaturesOnnx)?)?,
            template: open(engine, load, template)?,
            parts: HashMap::new(),
        })
    }

    fn failed(&self, graph: &str) -> impl Fn(String) -> GoldenError + use<> {
        let (engine, graph) = (self.engine, graph.to_string());
        move |detail| GoldenError::Graph { engine, graph: graph.clone(), detail }
    }

    /// Head feature of a crop.
    pub fn features(&mut self, crop: &[f32]) -> Result<Vec<f32>, GoldenError> {
        let failed = self.failed("features");
        let found = self.features.run(&[("crop", crop)], &["feature"]).map_err(failed)?;
        Ok(found.into_iter().next().unwrap_or_default())
    }

    /// Tokens of a template.
    pub fn template(
        &mut self,
        feature: &[f32],
        label: &[f32],
        ltrb: &[f32],
    ) -> Result<Vec<f32>, GoldenError> {
        let failed = self.failed("template");
        let inputs = [("feature", feature), ("label", label), ("ltrb", ltrb)];
        let found = self.template.run(&inputs, &["tokens"]).map_err(failed)?;
        Ok(found.into_iter().next().unwrap_or_default())
    }

    /// Values of one sequence, in the order of [`PARTS`].
    pub fn parts(
        &mut self,
        mode: Mode,
        templates: &[Vec<f32>],
        search: &[f32],
    ) -> Result<PartValues, GoldenError> {
        let key = (mode == Mode::Single, templates.len());
        let failed = self.failed("predict with more outputs");
        let session = match self.parts.entry(key) {
            Entry::Occupied(held) => held.into_mut(),
            Entry::Vacant(free) => {
                let graph = parts_graph(&self.net, key.1, key.0, &self.slot)?;
                free.insert(open(self.engine, self.load, &graph)?)
            }
        };
        let names: Vec<String> = (0..templates.len()).map(|i| format!("template{i}")).collect();
        let mut inputs: Vec<(&str, &[f32])> =
            names.iter().map(String::as_str).zip(templates.iter().map(Vec::as_slice)).collect();
        inputs.push(("feature", search));
        let found = session.run(&inputs, &PARTS).map_err(&failed)?;
        let count = found.len();
        found.try_into().map_err(|_| failed(format!("{count} outputs instead of {}", PARTS.len())))
    }
}

fn open(engine: &'static str, load: Load, graph: &Graph) -> Result<Box<dyn Session>, GoldenError> {
    load(&encode(graph, Storage::Inline)).map_err(|detail| GoldenError::Graph {
        engine,
        graph: graph.name.clone(),
        detail,
    })
}

fn parts_graph(
    net: &TrackerNet,
    count: usize,
    single: bool,
    slot: &[usize],
) -> Result<Graph, ExportError> {
    let (d, f) = (usize::from(net.spec().width), net.spec().map_side());
    let name = if single { "single" } else { "predict" };
    let [tokens, width] = [slot.first().copied(), slot.get(1).copied()].map(|n| n.unwrap_or(1));
    let mut graph = record(&format!("{name}{count}.parts"), "For inspection.", |r| {
        let net = r.module(net);
        let templates = (0..count)
            .map(|i| r.input(&format!("template{i}"), [tokens, width], "tokens"))
            .collect::<Result<Vec<_>, _>>()?;
        let feature = r.input("feature", [1, d, f, f], "head feature")?;
        let parts = match single {
            true => net.single_parts(templates, feature),
            false => net.predict_parts(templates, feature),
        };
        outputs(r, parts)
    })?;
    optimise(&mut graph);
    Ok(graph)
}

fn outputs(r: &mut Recorder, parts: Parts) -> Result<(), ExportError> {
    fn own<const D: usize>(t: Tensor<D>) -> Tensor<D> {
        // Two names may stand for one value; an output needs a value of its own.
        t.add_scalar(0.0)
    }
    let Parts { scores, ltrb, cls_filter, reg_filter, cls_enc, reg_enc } = parts;
    r.output(PARTS[0], scores, "score map")?;
    r.output(PARTS[1], ltrb, "distances")?;
    r.output(PARTS[2], own(cls_filter), "filter of the classifier")?;
    r.output(PARTS[3], own(reg_filter), "filter of the box regressor")?;
    r.output(PARTS[4], own(cls_enc), "encoded search frame of the classifier")?;
    r.output(PARTS[5], own(reg_enc), "encoded search frame of the box regressor")
}

/// Loads a graph into tract.
///
/// # Errors
/// What tract said.
pub fn tract(file: &[u8]) -> Result<Box<dyn Session>, String> {
    use tract_onnx::prelude::*;

    struct Tract {
        plan: Arc<TypedRunnableModel>,
        /// Names and shapes.
        inputs: Vec<(String, Vec<usize>)>,
        outputs: Vec<String>,
    }

    impl Session for Tract {
        fn run(
            &mut self,
            inputs: &[(&str, &[f32])],
            outputs: &[&str],
        ) -> Result<Vec<Vec<f32>>, String> {
            let mut values = TVec::new();
            for (name, shape) in &self.inputs {
                let given = inputs.iter().find(|(n, _)| n == name);
                let (_, data) = given.ok_or_else(|| format!("input `{name}` was not given"))?;
                let tensor = Tensor::from_shape(shape, data).map_err(|e| format!("{e:#}"))?;
                values.push(tensor.into());
            }
            let results = self.plan.run(values).map_err(|e| format!("{e:#}"))?;
            outputs
                .iter()
                .map(|name| {
                    let at = self.outputs.iter().position(|n| n == name);
                    let at = at.ok_or_else(|| format!("there is no output `{name}`"))?;
                    let view = results[at].try_as_plain_ram().map_err(|e| format!("{e:#}"))?;
                    Ok(view.as_slice::<f32>().map_err(|e| format!("{e:#}"))?.to_vec())
                })
                .collect()
        }
    }

    let load = || -> TractResult<Tract> {
        let proto = read(file)?;
        let graph = proto.graph.as_ref();
        let names = |list: &[tract_onnx::pb::ValueInfoProto]| -> Vec<String> {
            list.iter().map(|v| v.name.clone()).collect()
        };
        let inputs = graph.map(|g| names(&g.input)).unwrap_or_default();
        let outputs = graph.map(|g| names(&g.output)).unwrap_or_default();
        let mut model = tract_onnx::onnx().model_for_proto_model(&proto)?;
        model.set_input_names(inputs.clone())?;
        model.select_outputs_by_name(outputs.clone())?;
        let plan = model.into_optimized()?.into_runnable()?;
        let shapes = (0..inputs.len())
            .map(|i| {
                let fact = plan.model().input_fact(i)?;
                Ok(fact.shape.as_concrete().unwrap_or_default().to_vec())
            })
            .collect::<TractResult<Vec<_>>>()?;
        Ok(Tract { plan, inputs: inputs.into_iter().zip(shapes).collect(), outputs })
    };
    fn read(bytes: &[u8]) -> TractResult<tract_onnx::pb::ModelProto> {
        tract_onnx::onnx().proto_model_for_read(&mut &*bytes)
    }
    match load() {
        Ok(session) => Ok(Box::new(session)),
        Err(e) => Err(format!("{e:#}")),
    }
}

impl Session for NativeSession {
    fn run(
        &mut self,
        inputs: &[(&str, &[f32])],
        outputs: &[&str],
    ) -> Result<Vec<Vec<f32>>, String> {
        for (name, values) in inputs {
            fill(name, self.input_mut(name), values)?;
        }
        NativeSession::run(self);
        let values = |name: &&str| match self.output(name) {
            Some(values) => Ok(values.to_vec()),
            None => Err(format!("there is no output `{name}`")),
        };
        outputs.iter().map(values).collect()
    }
}

/// Loads a graph into our own engine.
///
/// # Errors
/// What it said.
pub fn native(file: &[u8]) -> Result<Box<dyn Session>, String> {
    match NativeSession::new(file) {
        Ok(session) => Ok(Box::new(session)),
        Err(e) => Err(e.to_string()),
    }
}

fn fill(name: &str, input: Option<&mut [f32]>, values: &[f32]) -> Result<(), String> {
    let input = input.ok_or(format!("there is no input `{name}`"))?;
    if input.len() != values.len() {
        return Err(format!(
            "input `{name}` has {} numbers, {} were given",
            input.len(),
            values.len()
        ));
    }
    input.copy_from_slice(values);
    Ok(())
}

#[cfg(feature = "ort")]
impl Session for GraphSession {
    fn run(
        &mut self,
        inputs: &[(&str, &[f32])],
        outputs: &[&str],
    ) -> Result<Vec<Vec<f32>>, String> {
        for (name, values) in inputs {
            fill(name, self.input_mut(name), values)?;
        }
        GraphSession::run(self).map_err(|e| e.to_string())?;
        outputs
            .iter()
            .map(|name| match self.output(name) {
                Some(values) => Ok(values.to_vec()),
                None => Err(format!("there is no output `{name}`")),
            })
            .collect()
    }
}

/// Loads a graph into ONNX Runtime.
///
/// # Errors
/// What it said.
#[cfg(feature = "ort")]
pub fn ort(file: &[u8]) -> Result<Box<dyn Session>, String> {
    match GraphSession::new(file, 0) {
        Ok(session) => Ok(Box::new(session)),
        Err(e) => Err(e.to_string()),
    }
}
