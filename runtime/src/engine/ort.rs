//! ONNX Runtime, loaded from a shared library at run time.
//!
//! The library is the one named by the environment variable `TSDA_ORT_LIB`, else by
//! `ORT_DYLIB_PATH`, else the system's `libonnxruntime.so`; 1.17 or newer. The PyPI wheel holds one;
//! `scripts/fetch_onnxruntime.sh` unpacks it.
//!
//! All inputs and outputs are bound to buffers made once. On the processor the graphs read and write
//! these buffers in place. On a GPU the head feature and the template tokens stay in its memory;
//! what the tracker writes (crop, label, box map) goes up before the run that reads it, because
//! ONNX Runtime copies a bound input when it is bound and not when it runs, and the two maps come
//! down with the run that makes them.

pub mod graph;
mod inline;
mod library;
mod options;
#[cfg(all(test, feature = "tract"))]
mod tests;

pub use library::{LIBRARY_VARIABLES, OrtError, OrtLibrary};
pub use options::{Optimisation, OrtOptions, Provider};

use super::{Engine, EngineError, Maps, Stage, TemplateInput, slot_shape};
use crate::bundle::{Bundle, SectionKind, WEIGHTS_FILE};
use crate::spec::ModelSpec;
use ::ort::memory::{Allocator, AllocatorType, MemoryInfo, MemoryType};
use ::ort::session::{IoBinding, Session};
use ::ort::value::{Outlet, Tensor, ValueType};
use std::path::PathBuf;

const NAME: &str = "ort";

/// A bundle's network on ONNX Runtime.
///
/// Inputs and outputs are bound once and shared between the graphs; the Rust side allocates a few
/// hundred bytes per call inside the `ort` crate.
#[derive(Debug)]
pub struct OrtEngine {
    spec: ModelSpec,
    name: &'static str,
    /// Inputs that the tracker writes must be sent to the device before each run.
    upload: bool,
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
    /// Loads the library and the graphs of a bundle; on the processor, one thread.
    ///
    /// # Errors
    /// When the library cannot be loaded or is too old, a graph is missing or does not fit the
    /// specification, or ONNX Runtime refuses it. [`Self::with_options`] has the longer messages.
    pub fn from_bundle(bundle: &Bundle<'_>) -> Result<Self, EngineError> {
        Self::with_threads(bundle, 1)
    }

    /// As [`Self::from_bundle`], with this many threads per operation; 0 for one per core.
    ///
    /// # Errors
    /// As [`Self::from_bundle`].
    pub fn with_threads(bundle: &Bundle<'_>, threads: usize) -> Result<Self, EngineError> {
        let options = OrtOptions { threads, ..OrtOptions::default() };
        Self::with_options(bundle, &options).map_err(EngineError::from)
    }

    /// Loads the library and the graphs of a bundle. An execution provider that is not there is an
    /// error: nothing falls back to the processor in silence.
    ///
    /// # Errors
    /// When the options do not go together, the library or the provider is missing or cannot start,
    /// a graph is missing or does not fit the specification, or ONNX Runtime refuses it.
    pub fn with_options(bundle: &Bundle<'_>, options: &OrtOptions) -> Result<Self, OrtError> {
        options.check().map_err(OrtError::Options)?;
        let library = OrtLibrary::get()?;
        library.require(options.provider)?;
        let loader = Loader { library, bundle, options, cache: cache_folder(bundle, options)? };
        Self::assemble(&loader, options.provider.memory().is_some())
    }

    fn assemble(loader: &Loader<'_>, upload: bool) -> Result<Self, OrtError> {
        let spec = loader.bundle.manifest().spec;
        let (side, map, width) = (spec.crop_side(), spec.map_side(), usize::from(spec.width));

        let features = loader.open(SectionKind::FeaturesOnnx)?;
        let shared = loader.shared_memory(&features)?;
        let mut crop = zeros(&[1, 3, side, side])?;
        let mut feature = empty(&shared, &[1, width, map, map])?;
        let binding = bind(
            SectionKind::FeaturesOnnx,
            &features,
            &mut [("crop", &mut crop)],
            &mut [("feature", &mut feature)],
        )?;
        let features = Graph { session: features, binding };

        let template = loader.open(SectionKind::TemplateOnnx)?;
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
            let mut slot = empty(&shared, &slot_shape)?;
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
            let session = loader.open(kind)?;
            let slots = names.iter().map(String::as_str).zip(&mut tokens).take(k.into());
            let mut inputs: Vec<Port<'_>> = slots.collect();
            inputs.push(("feature", &mut feature));
            let mut outputs = [("scores", &mut scores), ("ltrb", &mut ltrb_map)];
            let binding = bind(kind, &session, &mut inputs, &mut outputs)?;
            predict.push(Graph { session, binding });
        }
        Ok(Self {
            spec,
            name: loader.options.provider.engine_name(),
            upload,
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
        self.name
    }

    fn crop_mut(&mut self) -> &mut [f32] {
        write(&mut self.crop)
    }

    fn features(&mut self) -> Result<(), EngineError> {
        // Whatever was there belongs to an older crop.
        self.has_feature = false;
        let stage = Stage::Features;
        if self.upload {
            send(&mut self.features.binding, &[("crop", &self.crop)], stage)?;
        }
        self.features.run(stage)?;
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
        let Some(binding) = self.template_bindings.get_mut(slot) else {
            return Err(error(stage, format_args!("slot {slot} of a network with {slots} slots")));
        };
        // A failed run leaves anything in the slot.
        self.written[slot] = false;
        if self.upload {
            send(binding, &[("label", &self.label), ("ltrb", &self.ltrb)], stage)?;
        }
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

/// Sends what the tracker wrote to the device: binding is what copies.
fn send(
    binding: &mut IoBinding,
    inputs: &[(&str, &Tensor<f32>)],
    stage: Stage,
) -> Result<(), EngineError> {
    let failed = |e: ::ort::Error| error(stage, format_args!("sending inputs: {e}"));
    for (name, tensor) in inputs {
        binding.bind_input(*name, tensor).map_err(failed)?;
    }
    binding.synchronize_inputs().map_err(failed)
}

/// What it takes to open the graphs of one bundle.
struct Loader<'a> {
    library: &'static OrtLibrary,
    bundle: &'a Bundle<'a>,
    options: &'a OrtOptions,
    cache: Option<PathBuf>,
}

impl Loader<'_> {
    fn open(&self, kind: SectionKind) -> Result<Session, OrtError> {
        let load = |detail: core::fmt::Arguments<'_>| error(Stage::Load, detail);
        let onnx = self.bundle.require(kind).map_err(|e| load(format_args!("{e}")))?;
        let weights = self.bundle.section(SectionKind::Weights).unwrap_or_default();
        let model = inline::inline(onnx, WEIGHTS_FILE, weights)
            .map_err(|reason| load(format_args!("{kind}: {reason}")))?;
        let failed = |e: &dyn core::fmt::Display| load(format_args!("{kind}: {e}"));
        let options = self.options;
        let builder = Session::builder(&self.library.environment)
            .map_err(|e| failed(&e))?
            .with_intra_threads(options.threads)
            .map_err(|e| failed(&e))?
            .with_intra_op_spinning(false)
            .map_err(|e| failed(&e))?
            .with_optimization_level(options.optimisation.level())
            .map_err(|e| failed(&e))?;
        let providers = options.providers(self.cache.as_deref());
        let mut builder =
            builder.with_execution_providers(providers).map_err(|e| OrtError::Start {
                provider: options.provider,
                reason: e.to_string().trim().to_owned(),
                version: self.library.version().to_owned(),
                library: self.library.path().to_owned(),
            })?;
        builder.commit_from_memory(&model).map_err(|e| failed(&e).into())
    }

    /// Where tensors live that only graphs read and write.
    fn shared_memory(&self, session: &Session) -> Result<Allocator, OrtError> {
        let Some(device) = self.options.provider.memory() else { return Ok(Allocator::default()) };
        let failed = |e: ::ort::Error| error(Stage::Load, format_args!("device memory: {e}"));
        // `OrtOptions::check` has looked at the range.
        let id = self.options.device as i32;
        let info = MemoryInfo::new(device, id, AllocatorType::Device, MemoryType::Default);
        Ok(Allocator::new(session, info.map_err(failed)?).map_err(failed)?)
    }
}

/// The bundle's own folder for TensorRT's engines, made if needed. TensorRT recognises a graph by
/// its structure and not by its weights, so two trainings of one network must not share a folder.
fn cache_folder(bundle: &Bundle<'_>, options: &OrtOptions) -> Result<Option<PathBuf>, OrtError> {
    let Some(root) = &options.cache else { return Ok(None) };
    let weights = bundle.section(SectionKind::Weights).unwrap_or_default();
    let precision = if options.fp16 { "fp16" } else { "fp32" };
    let path = root.join(format!("{:08x}-{precision}", crate::bundle::crc32(weights)));
    std::fs::create_dir_all(&path)
        .map_err(|e| OrtError::Cache { path: path.clone(), reason: e.to_string() })?;
    Ok(Some(path))
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

/// A tensor in the processor's memory.
fn zeros(shape: &[usize]) -> Result<Tensor<f32>, EngineError> {
    let mut tensor = empty(&Allocator::default(), shape)?;
    write(&mut tensor).fill(0.0);
    Ok(tensor)
}

/// A tensor with anything in it: no graph reads it before another has written it.
fn empty(allocator: &Allocator, shape: &[usize]) -> Result<Tensor<f32>, EngineError> {
    let shape: Vec<i64> = shape.iter().map(|&side| side as i64).collect();
    Tensor::new(allocator, shape).map_err(|e| error(Stage::Load, format_args!("{e}")))
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
