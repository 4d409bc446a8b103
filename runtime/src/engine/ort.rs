//! ONNX Runtime, loaded from a shared library at run time.
//!
//! The library is the one named by the environment variable `TSDA_ORT_LIB`, else by
//! `ORT_DYLIB_PATH`, else the system's `libonnxruntime.so`; 1.17 or newer. The PyPI wheel holds one
//! (`onnxruntime/capi/libonnxruntime.so.*`).

pub mod graph;
mod inline;

use super::{Engine, EngineError, Maps, Stage, TemplateInput, slot_shape};
use crate::bundle::{Bundle, SectionKind, WEIGHTS_FILE};
use crate::spec::ModelSpec;
use ::ort::environment::Environment;

use ::ort::memory::Allocator;
use ::ort::session::{IoBinding, Session};
use ::ort::value::{Outlet, Tensor, ValueType};
use std::sync::OnceLock;

const NAME: &str = "ort";

/// A bundle's network on ONNX Runtime.
///
/// Inputs and outputs are bound once and shared between the graphs: nothing is copied, and the Rust
/// side allocates a few hundred bytes per call inside the `ort` crate.
#[derive(Debug)]
pub struct OrtEngine {
    spec: ModelSpec,
    features: Graph,
    /// Index: the slot the tokens are written to.
    template: Session,
    template_bindings: Vec<IoBinding>,
    /// Index `k - 1`: for `k` templates.
    predict: Vec<Graph>,
    crop: Tensor<f32>,
    label: Tensor<f32>,
    ltrb: Tensor<f32>,
    scores: Tensor<f32>,
    ltrb_map: Tensor<f32>,
    has_feature: bool,
    written: Vec<bool>,
}

#[derive(Debug)]
struct Graph {
    session: Session,
    binding: IoBinding,
}

/// A named tensor to bind.
type Port<'a> = (&'a str, &'a mut Tensor<f32>);

impl OrtEngine {
    /// Loads the library and the graphs of a bundle; one thread.
    ///
    /// # Errors
    /// When the library cannot be loaded or is too old, a graph is missing or does not fit the
    /// specification, or ONNX Runtime refuses it.
    pub fn from_bundle(bundle: &Bundle<'_>) -> Result<Self, EngineError> {
        Self::with_threads(bundle, 1)
    }

    /// As [`Self::from_bundle`], with this many threads per operation; 0 for one per core. Waiting
    /// threads sleep: spinning costs more than it gains on a busy board.
    ///
    /// # Errors
    /// As [`Self::from_bundle`].
    pub fn with_threads(bundle: &Bundle<'_>, threads: usize) -> Result<Self, EngineError> {
        let spec = bundle.manifest().spec;
        let (side, map, width) = (spec.crop_side(), spec.map_side(), usize::from(spec.width));
        let environment = environment()?;
        let open = |kind| open(environment, bundle, kind, threads);

        let features = open(SectionKind::FeaturesOnnx)?;
        let mut crop = zeros(&[1, 3, side, side])?;
        let mut feature = zeros(&[1, width, map, map])?;
        let binding = bind(
            SectionKind::FeaturesOnnx,
            &features,
            &mut [("crop", &mut crop)],
            &mut [("feature", &mut feature)],
        )?;
        let features = Graph { session: features, binding };

        let template = open(SectionKind::TemplateOnnx)?;
        let declared = template.outputs().iter().find(|o| o.name() == "tokens").map(Outlet::dtype);
        let declared = match declared {
            Some(ValueType::Tensor { shape, .. }) => Some(&shape[..]),
            _ => None,
        };
        let slot_shape = slot_shape(NAME, &spec, declared)?;
        let mut label = zeros(&[map, map])?;
        let mut ltrb = zeros(&[4, map, map])?;
        let mut tokens = Vec::new();
        let mut template_bindings = Vec::new();
        for _ in 0..spec.templates {
            let mut slot = zeros(&slot_shape)?;
            template_bindings.push(bind(
                SectionKind::TemplateOnnx,
                &template,
                &mut [("feature", &mut feature), ("label", &mut label), ("ltrb", &mut ltrb)],
                &mut [("tokens", &mut slot)],
            )?);
            tokens.push(slot);
        }

        let mut scores = zeros(&[map, map])?;
        let mut ltrb_map = zeros(&[4, map, map])?;
        let names: Vec<String> = (0..spec.templates).map(|i| format!("template{i}")).collect();
        let mut predict = Vec::new();
        for k in 1..=spec.templates {
            let kind = SectionKind::PredictOnnx(k);
            let session = open(kind)?;
            let slots = names.iter().map(String::as_str).zip(&mut tokens).take(k.into());
            let mut inputs: Vec<Port<'_>> = slots.collect();
            inputs.push(("feature", &mut feature));
            let mut outputs = [("scores", &mut scores), ("ltrb", &mut ltrb_map)];
            let binding = bind(kind, &session, &mut inputs, &mut outputs)?;
            predict.push(Graph { session, binding });
        }
        Ok(Self {
            spec,
            features,
            template,
            template_bindings,
            predict,
            crop,
            label,
            ltrb,
            scores,
            ltrb_map,
            has_feature: false,
            written: vec![false; spec.templates.into()],
        })
    }

    fn need_feature(&self, stage: Stage) -> Result<(), EngineError> {
        if self.has_feature {
            return Ok(());
        }
        Err(error(stage, format_args!("no head feature: call `features` first")))
    }
}

impl Engine for OrtEngine {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    fn name(&self) -> &'static str {
        NAME
    }

    fn crop_mut(&mut self) -> &mut [f32] {
        write(&mut self.crop)
    }

    fn features(&mut self) -> Result<(), EngineError> {
        // Whatever was there belongs to an older crop.
        self.has_feature = false;
        self.features.run(Stage::Features)?;
        self.has_feature = true;
        Ok(())
    }

    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        TemplateInput { label: write(&mut self.label), ltrb: write(&mut self.ltrb) }
    }

    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        let stage = Stage::Template;
        self.need_feature(stage)?;
        let slots = self.template_bindings.len();
        let Some(binding) = self.template_bindings.get(slot) else {
            return Err(error(stage, format_args!("slot {slot} of a network with {slots} slots")));
        };
        run(&mut self.template, binding, stage)?;
        self.written[slot] = true;
        Ok(())
    }

    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        let stage = Stage::Predict;
        self.need_feature(stage)?;
        let slots = self.predict.len();
        let Some(graph) = filled.checked_sub(1).and_then(|i| self.predict.get_mut(i)) else {
            let detail = format_args!("{filled} templates asked for, 1 to {slots} are possible");
            return Err(error(stage, detail));
        };
        if let Some(slot) = self.written.iter().take(filled).position(|written| !written) {
            return Err(error(stage, format_args!("template slot {slot} was never written")));
        }
        graph.run(stage)?;
        Ok(Maps { scores: read(&self.scores)?, ltrb: read(&self.ltrb_map)? })
    }
}

impl Graph {
    fn run(&mut self, stage: Stage) -> Result<(), EngineError> {
        run(&mut self.session, &self.binding, stage)
    }
}

fn run(session: &mut Session, binding: &IoBinding, stage: Stage) -> Result<(), EngineError> {
    match session.run_binding(binding) {
        Ok(_) => Ok(()),
        Err(e) => Err(error(stage, format_args!("{e}"))),
    }
}

/// The process's one ONNX Runtime environment; a failed attempt is remembered.
fn environment() -> Result<&'static Environment, EngineError> {
    static ENVIRONMENT: OnceLock<Result<Environment, String>> = OnceLock::new();
    let made = ENVIRONMENT.get_or_init(|| {
        let named = |variable| std::env::var_os(variable).filter(|v| !v.is_empty());
        let system = || {
            let (prefix, suffix) = (std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
            format!("{prefix}onnxruntime{suffix}").into()
        };
        let library =
            named("TSDA_ORT_LIB").or_else(|| named("ORT_DYLIB_PATH")).unwrap_or_else(system);
        let builder = ::ort::init_from(&library)
            .map_err(|e| format!("{e}; set TSDA_ORT_LIB to an ONNX Runtime library"))?;
        builder.with_name("tsda").build().map_err(|e| e.to_string())
    });
    made.as_ref().map_err(|e| error(Stage::Load, format_args!("{e}")))
}

fn open(
    environment: &Environment,
    bundle: &Bundle<'_>,
    kind: SectionKind,
    threads: usize,
) -> Result<Session, EngineError> {
    let load = |detail: core::fmt::Arguments<'_>| error(Stage::Load, detail);
    let onnx = bundle.require(kind).map_err(|e| load(format_args!("{e}")))?;
    let weights = bundle.section(SectionKind::Weights).unwrap_or_default();
    let model = inline::inline(onnx, WEIGHTS_FILE, weights)
        .map_err(|reason| load(format_args!("{kind}: {reason}")))?;
    let failed = |e: &dyn core::fmt::Display| load(format_args!("{kind}: {e}"));
    Session::builder(environment)
        .map_err(|e| failed(&e))?
        .with_intra_threads(threads)
        .map_err(|e| failed(&e))?
        .with_intra_op_spinning(false)
        .map_err(|e| failed(&e))?
        .commit_from_memory(&model)
        .map_err(|e| failed(&e))
}

/// Binds all inputs and outputs of a session, after a look at what it declares.
fn bind(
    kind: SectionKind,
    session: &Session,
    inputs: &mut [Port<'_>],
    outputs: &mut [Port<'_>],
) -> Result<IoBinding, EngineError> {
    check(kind, "input", session.inputs(), inputs)?;
    check(kind, "output", session.outputs(), outputs)?;
    let failed = |e: ::ort::Error| error(Stage::Load, format_args!("{kind}: {e}"));
    let mut binding = session.create_binding().map_err(failed)?;
    for (name, tensor) in inputs {
        binding.bind_input(*name, tensor).map_err(failed)?;
    }
    for (name, tensor) in outputs {
        binding.bind_output(*name, &mut **tensor).map_err(failed)?;
    }
    Ok(binding)
}

/// Are the declared ports those that the tracker relies on?
fn check(
    kind: SectionKind,
    what: &str,
    declared: &[Outlet],
    ports: &[Port<'_>],
) -> Result<(), EngineError> {
    for (name, tensor) in ports {
        let want = tensor.shape();
        let found = declared.iter().find(|o| o.name() == *name).map(Outlet::dtype);
        let fits = match found {
            Some(ValueType::Tensor { ty, shape, .. }) => {
                *ty == ::ort::value::TensorElementType::Float32 && shape == want
            }
            _ => false,
        };
        if !fits || declared.len() != ports.len() {
            let detail = format_args!(
                "{kind}: {what} `{name}` must be f32 {want:?} and one of {}, found {found:?} among {}",
                ports.len(),
                declared.len()
            );
            return Err(error(Stage::Load, detail));
        }
    }
    Ok(())
}

fn zeros(shape: &[usize]) -> Result<Tensor<f32>, EngineError> {
    let shape: Vec<i64> = shape.iter().map(|&side| side as i64).collect();
    let failed = |e: ::ort::Error| error(Stage::Load, format_args!("{e}"));
    let mut tensor = Tensor::new(&Allocator::default(), shape).map_err(failed)?;
    write(&mut tensor).fill(0.0);
    Ok(tensor)
}

/// The numbers of a tensor of ours; empty only if it were not one of floats in CPU memory.
fn write(tensor: &mut Tensor<f32>) -> &mut [f32] {
    tensor.try_extract_tensor_mut::<f32>().map_or(&mut [], |(_, values)| values)
}

fn read(tensor: &Tensor<f32>) -> Result<&[f32], EngineError> {
    let failed = |e: ::ort::Error| error(Stage::Predict, format_args!("{e}"));
    tensor.try_extract_tensor::<f32>().map(|(_, values)| values).map_err(failed)
}

fn error(stage: Stage, detail: core::fmt::Arguments<'_>) -> EngineError {
    EngineError::new(NAME, stage, detail)
}
