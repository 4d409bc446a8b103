//! tract: ONNX in pure Rust, the default on CPUs and the independent check of every export.
//!
//! The graphs of a bundle keep their weights outside, as ONNX external data pointing into the
//! weights section. They are put back in before tract reads a graph, so nothing is written to disk.

use super::{Engine, EngineError, Maps, Stage, TemplateInput, slot_shape};
use crate::bundle::{Bundle, SectionKind, WEIGHTS_FILE};
use crate::spec::ModelSpec;
use crate::system::{growing, is_installed, pooled, reserve};
use tract_onnx::pb::{self, tensor_proto, tensor_shape_proto::dimension, type_proto};
use tract_onnx::prelude::*;

const NAME: &str = "tract";

/// How to run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TractOptions {
    /// Size in MiB of the pool ([`crate::system`]) that tract's allocations come from; `None` finds
    /// it by a trial run at load, 0 leaves them to the system.
    pub pool_mib: Option<usize>,
}

/// A bundle's network on tract, single-threaded.
///
/// Inputs and results are copied once between tract's tensors and the engine's buffers (about a
/// thousandth of a frame's time). tract itself allocates while it computes: from a pool, in programs
/// whose allocator is [`crate::system::Heap`].
#[derive(Debug)]
pub struct TractEngine {
    spec: ModelSpec,
    pooled: bool,
    features: Graph,
    template: Graph,
    /// Index `k - 1`: for `k` templates.
    predict: Vec<Graph>,
    crop: Vec<f32>,
    label: Vec<f32>,
    ltrb: Vec<f32>,
    feature: Option<TValue>,
    tokens: Vec<Option<TValue>>,
    scores: Vec<f32>,
    ltrb_map: Vec<f32>,
}

impl TractEngine {
    /// Loads and optimises the graphs of a bundle; takes some seconds for large networks.
    ///
    /// # Errors
    /// When a graph is missing, does not fit the specification, refers to weights outside the
    /// weights section, or tract cannot run it. The message names graph and tensor.
    pub fn from_bundle(bundle: &Bundle<'_>) -> Result<Self, EngineError> {
        Self::with_options(bundle, TractOptions::default())
    }

    /// Loads and optimises the graphs of a bundle.
    ///
    /// # Errors
    /// As [`Self::from_bundle`]; also when there is no memory for the pool.
    pub fn with_options(bundle: &Bundle<'_>, options: TractOptions) -> Result<Self, EngineError> {
        let mut engine = Self::load(bundle)?;
        match options.pool_mib {
            Some(mib) => {
                let bytes = mib.checked_mul(1 << 20);
                if is_installed() && !bytes.is_some_and(reserve) {
                    let detail = format_args!("no memory for a pool of {mib} MiB; ask for less");
                    return Err(error(Stage::Load, detail));
                }
                engine.pooled = mib > 0;
            }
            None => {
                engine.pooled = is_installed();
                if engine.pooled {
                    growing(|| engine.trial())?;
                }
            }
        }
        Ok(engine)
    }

    /// Does everything that a frame may do, so that the pool gets the size it needs.
    fn trial(&mut self) -> Result<(), EngineError> {
        let slots = self.tokens.len();
        self.run_features()?;
        (0..slots).try_for_each(|slot| self.run_template(slot))?;
        (1..=slots).try_for_each(|filled| self.run_predict(filled))?;
        // Again with everything in place, which is how frames find it.
        self.run_features()?;
        self.feature = None;
        self.tokens.fill(None);
        Ok(())
    }

    fn load(bundle: &Bundle<'_>) -> Result<Self, EngineError> {
        let spec = bundle.manifest().spec;
        let (side, map, width) = (spec.crop_side(), spec.map_side(), usize::from(spec.width));
        let cells = spec.cells();
        let port = |name: &str, shape: &[usize]| Port { name: name.into(), shape: shape.into() };
        let crop = port("crop", &[1, 3, side, side]);
        let feature = port("feature", &[1, width, map, map]);
        let label = port("label", &[map, map]);
        let ltrb = port("ltrb", &[4, map, map]);
        let scores = port("scores", &[map, map]);
        let slot = slot_shape(NAME, &spec, declared_slot(bundle)?.as_deref())?;
        let tokens = port("tokens", &slot);

        let features = Graph::load(
            bundle,
            SectionKind::FeaturesOnnx,
            &[crop],
            core::slice::from_ref(&feature),
        )?;
        let template = Graph::load(
            bundle,
            SectionKind::TemplateOnnx,
            &[feature.clone(), label, ltrb.clone()],
            &[tokens],
        )?;
        let predict = (1..=spec.templates)
            .map(|k| {
                let slot = |i| port(&format!("template{i}"), &slot);
                let mut inputs: Vec<Port> = (0..k).map(slot).collect();
                inputs.push(feature.clone());
                let outputs = [scores.clone(), ltrb.clone()];
                Graph::load(bundle, SectionKind::PredictOnnx(k), &inputs, &outputs)
            })
            .collect::<Result<Vec<_>, _>>()?;
        Ok(Self {
            spec,
            pooled: false,
            features,
            template,
            predict,
            crop: vec![0.0; spec.crop_len()],
            label: vec![0.0; cells],
            ltrb: vec![0.0; 4 * cells],
            feature: None,
            tokens: vec![None; spec.templates.into()],
            scores: vec![0.0; cells],
            ltrb_map: vec![0.0; 4 * cells],
        })
    }

    fn feature(&self, stage: Stage) -> Result<TValue, EngineError> {
        self.feature
            .clone()
            .ok_or_else(|| error(stage, format_args!("no head feature: call `features` first")))
    }
}

impl TractEngine {
    fn run_features(&mut self) -> Result<(), EngineError> {
        // Whatever was there belongs to an older crop.
        self.feature = None;
        let crop = self.features.input(0, &self.crop, Stage::Features)?;
        let [feature] = self.features.run(tvec!(crop), Stage::Features)?;
        self.feature = Some(feature);
        Ok(())
    }

    fn run_template(&mut self, slot: usize) -> Result<(), EngineError> {
        let stage = Stage::Template;
        let slots = self.tokens.len();
        if slot >= slots {
            return Err(error(stage, format_args!("slot {slot} of a network with {slots} slots")));
        }
        let inputs = tvec!(
            self.feature(stage)?,
            self.template.input(1, &self.label, stage)?,
            self.template.input(2, &self.ltrb, stage)?,
        );
        let [tokens] = self.template.run(inputs, stage)?;
        self.tokens[slot] = Some(tokens);
        Ok(())
    }

    fn run_predict(&mut self, filled: usize) -> Result<(), EngineError> {
        let stage = Stage::Predict;
        let slots = self.tokens.len();
        let feature = self.feature(stage)?;
        let Some(graph) = filled.checked_sub(1).and_then(|i| self.predict.get_mut(i)) else {
            let detail = format_args!("{filled} templates asked for, 1 to {slots} are possible");
            return Err(error(stage, detail));
        };
        let mut inputs = TVec::with_capacity(filled + 1);
        for (slot, tokens) in self.tokens.iter().take(filled).enumerate() {
            let empty = || error(stage, format_args!("template slot {slot} was never written"));
            inputs.push(tokens.clone().ok_or_else(empty)?);
        }
        inputs.push(feature);
        let [scores, ltrb] = graph.run(inputs, stage)?;
        read(&scores, &mut self.scores)?;
        read(&ltrb, &mut self.ltrb_map)
    }

    /// Does some work with tract's memory where it is to be.
    fn inside(
        &mut self,
        work: impl FnOnce(&mut Self) -> Result<(), EngineError>,
    ) -> Result<(), EngineError> {
        if self.pooled { pooled(|| work(self)) } else { work(self) }
    }
}

impl Engine for TractEngine {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    fn name(&self) -> &'static str {
        NAME
    }

    fn crop_mut(&mut self) -> &mut [f32] {
        &mut self.crop
    }

    fn features(&mut self) -> Result<(), EngineError> {
        self.inside(Self::run_features)
    }

    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        TemplateInput { label: &mut self.label, ltrb: &mut self.ltrb }
    }

    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        self.inside(|engine| engine.run_template(slot))
    }

    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        self.inside(|engine| engine.run_predict(filled))?;
        Ok(Maps { scores: &self.scores, ltrb: &self.ltrb_map })
    }
}

/// A named input or output and its shape.
#[derive(Clone, Debug)]
struct Port {
    name: String,
    shape: Vec<usize>,
}

/// A loaded graph with its state, kept from frame to frame.
#[derive(Debug)]
struct Graph {
    state: TypedSimpleState,
    inputs: Vec<Port>,
}

impl Graph {
    fn load(
        bundle: &Bundle<'_>,
        kind: SectionKind,
        inputs: &[Port],
        outputs: &[Port],
    ) -> Result<Self, EngineError> {
        let bytes = bundle.require(kind).map_err(|e| error(Stage::Load, format_args!("{e}")))?;
        let failed = |e: TractError| error(Stage::Load, format_args!("{kind}: {e:#}"));
        let mut proto = onnx().proto_model_for_read(&mut &*bytes).map_err(failed)?;
        let Some(graph) = proto.graph.as_mut() else {
            return Err(error(Stage::Load, format_args!("{kind}: the file holds no graph")));
        };
        for (ports, found, what) in
            [(inputs, &graph.input, "input"), (outputs, &graph.output, "output")]
        {
            check_declared(kind, ports, found, what)?;
        }
        let weights = bundle.section(SectionKind::Weights).unwrap_or_default();
        for tensor in &mut graph.initializer {
            fill(tensor, weights).map_err(|reason| {
                let name = &tensor.name;
                error(Stage::Load, format_args!("{kind}, tensor `{name}`: {reason}"))
            })?;
        }
        let depthwise = graph.node.iter().any(is_grouped_conv);
        let names = |ports: &[Port]| ports.iter().map(|p| p.name.clone()).collect::<Vec<_>>();
        let prepare = || {
            let mut model = onnx().model_for_proto_model(&proto)?;
            model.set_input_names(names(inputs))?;
            model.select_outputs_by_name(names(outputs))?;
            let mut model = model.into_typed()?.into_decluttered()?;
            if depthwise {
                channels_last(&mut model)?;
            }
            model.into_optimized()?.into_runnable()
        };
        let plan = prepare().map_err(failed)?;
        // What tract inferred has to be what the tracker relies on.
        for (i, port) in outputs.iter().enumerate() {
            let model = plan.model();
            let fact = model.output_fact(i).map_err(failed)?;
            let found = fact.shape.as_concrete();
            if found != Some(&port.shape) || fact.datum_type != DatumType::F32 {
                let Port { name, shape } = port;
                let detail = format_args!(
                    "{kind}: output `{name}` is {fact:?}, the specification needs f32 {shape:?}"
                );
                return Err(error(Stage::Load, detail));
            }
        }
        let state = plan.spawn().map_err(failed)?;
        Ok(Self { state, inputs: inputs.into() })
    }

    fn input(&self, index: usize, values: &[f32], stage: Stage) -> Result<TValue, EngineError> {
        let shape = self.inputs.get(index).map_or(&[][..], |p| &p.shape);
        let tensor = Tensor::from_shape(shape, values);
        tensor.map(Into::into).map_err(|e| error(stage, format_args!("{e:#}")))
    }

    fn run<const N: usize>(
        &mut self,
        inputs: TVec<TValue>,
        stage: Stage,
    ) -> Result<[TValue; N], EngineError> {
        let failed = |e: TractError| error(stage, format_args!("{e:#}"));
        let results = match self.state.run(inputs) {
            Ok(results) => results,
            Err(e) => {
                // Values of the broken turn must not stay for the next one.
                let _ = self.state.reset_turn();
                return Err(failed(e));
            }
        };
        let results: Vec<TValue> = results.into_vec();
        let count = results.len();
        results.try_into().map_err(|_| error(stage, format_args!("{count} outputs instead of {N}")))
    }
}

/// The shape that the `template` graph declares for what a slot keeps.
fn declared_slot(bundle: &Bundle<'_>) -> Result<Option<Vec<i64>>, EngineError> {
    let kind = SectionKind::TemplateOnnx;
    let bytes = bundle.require(kind).map_err(|e| error(Stage::Load, format_args!("{e}")))?;
    let proto = onnx()
        .proto_model_for_read(&mut &*bytes)
        .map_err(|e| error(Stage::Load, format_args!("{kind}: {e:#}")))?;
    let output = proto.graph.iter().flat_map(|g| &g.output).find(|v| v.name == "tokens");
    Ok(output.and_then(tensor_type).map(sides))
}

fn tensor_type(info: &pb::ValueInfoProto) -> Option<&type_proto::Tensor> {
    match info.r#type.as_ref()?.value.as_ref()? {
        type_proto::Value::TensorType(tensor) => Some(tensor),
    }
}

/// Sides of a declared tensor; -1 where one is not fixed.
fn sides(declared: &type_proto::Tensor) -> Vec<i64> {
    let dims = declared.shape.iter().flat_map(|s| &s.dim);
    dims.map(|d| match d.value {
        Some(dimension::Value::DimValue(n)) => n,
        _ => -1,
    })
    .collect()
}

/// A convolution of several groups; in the networks of this family, one per channel.
fn is_grouped_conv(node: &pb::NodeProto) -> bool {
    node.op_type == "Conv" && node.attribute.iter().any(|a| a.name == "group" && a.i > 1)
}

/// Lets convolutions run with the channels innermost. tract's depthwise kernel walks one plane after
/// the other, a few dozen cells each; with the channels innermost it computes whole vectors, which
/// saves a third of the time of `features` of `nano`. Only graphs with such convolutions are changed.
fn channels_last(model: &mut TypedModel) -> TractResult<()> {
    let name = "conv_nhwc";
    match tract_onnx::tract_core::transform::get_transform(name)? {
        Some(transform) => transform.transform(model),
        None => Err(TractError::msg(format!("this tract has no transformation {name}"))),
    }
}

/// Do the graph's declared inputs or outputs have the names and shapes they need?
fn check_declared(
    kind: SectionKind,
    ports: &[Port],
    found: &[pb::ValueInfoProto],
    what: &str,
) -> Result<(), EngineError> {
    let fail = |detail: core::fmt::Arguments<'_>| Err(error(Stage::Load, detail));
    for Port { name, shape } in ports {
        let Some(info) = found.iter().find(|v| v.name == *name) else {
            return fail(format_args!("{kind} has no {what} `{name}`"));
        };
        let Some(declared) = tensor_type(info) else {
            return fail(format_args!("{kind}: {what} `{name}` has no tensor type"));
        };
        if declared.elem_type != tensor_proto::DataType::Float as i32 {
            return fail(format_args!("{kind}: {what} `{name}` must be f32"));
        }
        let dims = sides(declared);
        if !dims.iter().copied().eq(shape.iter().map(|&n| n as i64)) {
            return fail(format_args!(
                "{kind}: {what} `{name}` is {dims:?}, the specification needs {shape:?}"
            ));
        }
    }
    Ok(())
}

/// Puts a tensor's external data back into it.
fn fill(tensor: &mut pb::TensorProto, weights: &[u8]) -> Result<(), String> {
    if tensor.data_location != Some(tensor_proto::DataLocation::External as i32) {
        return Ok(());
    }
    let field = |key: &str| tensor.external_data.iter().find(|e| e.key == key).map(|e| &*e.value);
    match field("location") {
        Some(WEIGHTS_FILE) => {}
        Some(other) => return Err(format!("its data are in `{other}`, not in `{WEIGHTS_FILE}`")),
        None => return Err("its external data have no location".into()),
    }
    let number = |key: &str| match field(key) {
        None => Ok(None),
        Some(text) => match text.parse::<usize>() {
            Ok(n) => Ok(Some(n)),
            Err(_) => Err(format!("external data {key} `{text}` is not a number")),
        },
    };
    let offset = number("offset")?.unwrap_or(0);
    let length = match number("length")? {
        Some(n) => n,
        None => weights.len().saturating_sub(offset),
    };
    let data = offset.checked_add(length).and_then(|end| weights.get(offset..end));
    let Some(data) = data else {
        let have = weights.len();
        return Err(format!(
            "bytes {offset} to {offset} + {length} are outside the weights section of {have} bytes"
        ));
    };
    tensor.raw_data = data.to_vec();
    tensor.external_data.clear();
    tensor.data_location = None;
    Ok(())
}

/// Copies an output into its buffer.
fn read(value: &TValue, out: &mut [f32]) -> Result<(), EngineError> {
    let failed = |e: TractError| error(Stage::Predict, format_args!("{e:#}"));
    let view = value.try_as_plain_ram().map_err(failed)?;
    let values = view.as_slice::<f32>().map_err(failed)?;
    if values.len() != out.len() {
        let (found, needed) = (values.len(), out.len());
        let detail = format_args!("an output has {found} numbers instead of {needed}");
        return Err(error(Stage::Predict, detail));
    }
    out.copy_from_slice(values);
    Ok(())
}

fn error(stage: Stage, detail: core::fmt::Arguments<'_>) -> EngineError {
    EngineError::new(NAME, stage, detail)
}

#[cfg(test)]
pub(super) mod tests;
