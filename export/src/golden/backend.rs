//! What computes the values that figures are compared with.
//!
//! | back end | computes |
//! |---|---|
//! | `burn` | every intermediate, in the form the reference is written in ([`Written`]) |
//! | `burn, re-arranged` | the inference functions that are exported ([`Arranged`]) |
//! | `native`, `tract`, `ort` | score maps and boxes through the runtime's engine on the bundle's own graphs; features, filters and encoder output from graphs with more outputs ([`OnEngine`]) |
//!
//! Another engine of the runtime joins with one line in [`EngineKind::open`] and one in
//! [`EngineKind::ALL`].

use super::error::GoldenError;
use super::figure::Pass;
use super::graphs::{self, Opened};
use super::inputs::{Frame, Sequence, TemplateFrame};
use crate::{bundle, network};
use burn::module::Module as _;
use burn::tensor::{Device, Tensor, TensorData};
use std::collections::HashMap;
use tsda_runtime::bundle::{Bundle, Manifest};
use tsda_runtime::engine::{NativeEngine, TractEngine};
use tsda_runtime::{Engine, EngineError, ModelSpec};
use tsda_trainer::import::{StateDict, StateTensor};
use tsda_trainer::model::TrackerNet;
use tsda_trainer::model::inspect::{HeadInput, Mode, Parts};

/// Computes passes; keeps what one pass shares with the next.
pub trait Backend {
    /// As in the report.
    fn name(&self) -> &'static str;

    /// The values of a pass by name, or nothing when this back end has no such pass.
    ///
    /// # Errors
    /// What the back end reported.
    fn run(
        &mut self,
        sequences: &[Sequence],
        pass: &Pass,
    ) -> Result<Option<StateDict>, GoldenError>;
}

/// The back ends a user can ask for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EngineKind {
    /// burn on the CPU (flex).
    Burn,
    /// burn on a GPU through Vulkan or WebGPU; cargo feature `wgpu`.
    Wgpu,
    /// Our own engine.
    Native,
    /// tract.
    Tract,
    /// ONNX Runtime; cargo feature `ort`.
    Ort,
}

impl EngineKind {
    /// All of them, with the name on the command line and whether this program has it.
    pub const ALL: [(Self, &'static str, bool); 5] = [
        (Self::Burn, "burn", true),
        (Self::Wgpu, "wgpu", cfg!(feature = "wgpu")),
        (Self::Native, "native", true),
        (Self::Tract, "tract", true),
        (Self::Ort, "ort", cfg!(feature = "ort")),
    ];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(kind, ..)| *kind == self).map_or("", |(_, name, _)| name)
    }

    /// Builds the back ends of this kind for a network.
    ///
    /// # Errors
    /// When it is not compiled in, not installed, or does not take the network.
    pub fn open(self, net: &TrackerNet) -> Result<Vec<Box<dyn Backend>>, GoldenError> {
        match self {
            Self::Burn => Ok(on_burn(net, ["burn", "burn, re-arranged"])),
            #[cfg(feature = "wgpu")]
            Self::Wgpu => {
                let net = net.clone().to_device(&Device::wgpu(Default::default()));
                Ok(on_burn(&net, ["wgpu", "wgpu, re-arranged"]))
            }
            #[cfg(not(feature = "wgpu"))]
            Self::Wgpu => self.absent("wgpu"),
            Self::Native => on_engine("native", net, NativeEngine::from_bundle, graphs::native),
            Self::Tract => on_engine("tract", net, TractEngine::from_bundle, graphs::tract),
            #[cfg(feature = "ort")]
            Self::Ort => on_engine(
                "ort",
                net,
                tsda_runtime::engine::ort::OrtEngine::from_bundle,
                graphs::ort,
            ),
            #[cfg(not(feature = "ort"))]
            Self::Ort => self.absent("ort"),
        }
    }

    #[cfg(not(all(feature = "wgpu", feature = "ort")))]
    fn absent(self, feature: &str) -> Result<Vec<Box<dyn Backend>>, GoldenError> {
        Err(GoldenError::Unavailable(format!(
            "{} is not part of this program: build it with `--features {feature}`",
            self.name()
        )))
    }
}

fn on_burn(net: &TrackerNet, names: [&'static str; 2]) -> Vec<Box<dyn Backend>> {
    let net = net.valid();
    let device = net.devices().into_iter().next().unwrap_or_else(Device::flex).inner();
    let base = OnBurn { net, device };
    vec![
        Box::new(Written { name: names[0], base: base.clone(), frames: HashMap::new() }),
        Box::new(Arranged { name: names[1], base, frames: HashMap::new() }),
    ]
}

#[derive(Clone)]
struct OnBurn {
    net: TrackerNet,
    device: Device,
}

impl OnBurn {
    fn tensor<const D: usize>(&self, values: Vec<f32>, shape: [usize; D]) -> Tensor<D> {
        Tensor::from_data(TensorData::new(values, shape), &self.device)
    }

    /// One batch of crops.
    fn crops(&self, crops: &[&[f32]]) -> Tensor<4> {
        let side = self.net.spec().crop_side();
        self.tensor(crops.concat(), [crops.len(), 3, side, side])
    }
}

/// The frames of a pass: templates sequence by sequence, then the search frames.
fn frames<'a>(sequences: &'a [Sequence], pass: &Pass) -> [Vec<&'a Frame>; 2] {
    let of = |i: &usize| &sequences[*i];
    let templates = pass.sequences.iter().map(of);
    let templates =
        templates.flat_map(|s| s.templates[..pass.templates].iter().map(|t| &t.frame)).collect();
    [templates, pass.sequences.iter().map(|i| &of(i).search).collect()]
}

/// burn, as the reference is written.
struct Written {
    name: &'static str,
    base: OnBurn,
    /// Values of a crop by name, by frame; without the batch axis.
    frames: HashMap<usize, StateDict>,
}

impl Backend for Written {
    fn name(&self) -> &'static str {
        self.name
    }

    fn run(
        &mut self,
        sequences: &[Sequence],
        pass: &Pass,
    ) -> Result<Option<StateDict>, GoldenError> {
        let [templates, search] = frames(sequences, pass);
        // Everything that is new in one batch.
        let mut fresh: Vec<_> = templates.iter().chain(&search).copied().collect();
        fresh.retain(|f| !self.frames.contains_key(&f.id));
        if !fresh.is_empty() {
            let crops: Vec<&[f32]> = fresh.iter().map(|f| f.crop.as_slice()).collect();
            let (_, found) = self.base.net.inspect_features(self.base.crops(&crops));
            for (row, frame) in fresh.iter().enumerate() {
                let mut own = StateDict::default();
                for (name, tensor) in found.iter() {
                    let len = tensor.values.len() / fresh.len();
                    let values = tensor.values[row * len..(row + 1) * len].to_vec();
                    own.insert(
                        name.into(),
                        StateTensor { shape: tensor.shape[1..].into(), values },
                    );
                }
                self.frames.insert(frame.id, own);
            }
        }
        let stacked = |name: &str, frames: &[&Frame]| {
            let parts: Vec<&StateTensor> = frames
                .iter()
                .filter_map(|f| self.frames.get(&f.id).and_then(|own| own.get(name)))
                .collect();
            let mut shape = vec![parts.len()];
            shape.extend(parts.first().map_or(&[][..], |p| &p.shape));
            StateTensor { shape, values: parts.iter().flat_map(|p| p.values.clone()).collect() }
        };
        let (f, d) = (self.base.net.spec().map_side(), usize::from(self.base.net.spec().width));
        let feature = |frames: &[&Frame]| {
            self.base.tensor(stacked("head.feat", frames).values, [frames.len(), d, f, f])
        };
        let each = |part: fn(&TemplateFrame) -> &Vec<f32>| -> Vec<f32> {
            let used =
                pass.sequences.iter().flat_map(|i| &sequences[*i].templates[..pass.templates]);
            used.flat_map(|t| part(t).iter().copied()).collect()
        };
        let count = templates.len();
        let input = HeadInput {
            templates: feature(&templates),
            search: feature(&search),
            labels: self.base.tensor(each(|t| &t.label), [count, f, f]),
            ltrb: self.base.tensor(each(|t| &t.ltrb), [count, 4, f, f]),
        };
        let mut found = self.base.net.inspect(&input, pass.mode);
        let names: Vec<String> = search
            .first()
            .and_then(|s| self.frames.get(&s.id))
            .map(|own| own.names().map(str::to_string).collect())
            .unwrap_or_default();
        for name in names {
            found.insert(format!("train.{name}"), stacked(&name, &templates));
            found.insert(format!("test.{name}"), stacked(&name, &search));
        }
        Ok(Some(found))
    }
}

/// burn, the inference functions; one batch of everything in training mode.
struct Arranged {
    name: &'static str,
    base: OnBurn,
    frames: HashMap<usize, Tensor<4>>,
}

impl Backend for Arranged {
    fn name(&self) -> &'static str {
        self.name
    }

    fn run(
        &mut self,
        sequences: &[Sequence],
        pass: &Pass,
    ) -> Result<Option<StateDict>, GoldenError> {
        let net = &self.base.net;
        let f = net.spec().map_side();
        let all = frames(sequences, pass);
        for frame in all.iter().flatten() {
            if !self.frames.contains_key(&frame.id) {
                let feature = net.features(self.base.crops(&[&frame.crop]));
                self.frames.insert(frame.id, feature);
            }
        }
        let feature = |frame: &Frame| -> Tensor<4> { self.frames[&frame.id].clone() };
        let mut found = StateDict::default();
        for (name, frames) in ["train.head.feat", "test.head.feat"].into_iter().zip(&all) {
            let stacked = Tensor::cat(frames.iter().map(|f| feature(f)).collect(), 0);
            insert(&mut found, name, stacked);
        }
        if let Mode::Parallel { annotated } = pass.mode
            && annotated != 1
        {
            // The inference functions are made for one annotated template.
            return Ok(None);
        }
        let mut parts = Vec::new();
        for index in &pass.sequences {
            let sequence = &sequences[*index];
            let tokens = sequence.templates[..pass.templates].iter().map(|t| {
                let label = self.base.tensor(t.label.clone(), [f, f]);
                let ltrb = self.base.tensor(t.ltrb.clone(), [4, f, f]);
                net.template(feature(&t.frame), label, ltrb)
            });
            let (tokens, search) = (tokens.collect::<Vec<_>>(), feature(&sequence.search));
            parts.push(match pass.mode {
                Mode::Parallel { .. } => {
                    // What is exported, and what it was computed from.
                    let (scores, ltrb) = net.predict(tokens.clone(), search.clone());
                    Parts { scores, ltrb, ..net.predict_parts(tokens, search) }
                }
                Mode::Single => net.single_parts(tokens, search),
            });
        }
        let rows = parts.into_iter().map(values_of).collect();
        collect(net.spec(), pass.mode, rows, &mut found);
        if pass.mode == Mode::Single {
            self.whole_batch(sequences, pass, &mut found);
        }
        Ok(Some(found))
    }
}

impl Arranged {
    /// Maps of the training pass over all sequences at once; they replace those computed one by one.
    fn whole_batch(&self, sequences: &[Sequence], pass: &Pass, found: &mut StateDict) {
        let (base, f) = (&self.base, self.base.net.spec().map_side());
        let [templates, search] = frames(sequences, pass)
            .map(|list| list.into_iter().map(|f| f.crop.as_slice()).collect());
        let each = |part: fn(&TemplateFrame) -> &Vec<f32>| -> Vec<f32> {
            let used =
                pass.sequences.iter().flat_map(|i| &sequences[*i].templates[..pass.templates]);
            used.flat_map(|t| part(t).iter().copied()).collect()
        };
        let templates: Vec<&[f32]> = templates;
        let count = templates.len();
        let out = base.net.forward_train(
            base.crops(&templates),
            base.crops(&search),
            base.tensor(each(|t| &t.label), [count, f, f]),
            base.tensor(each(|t| &t.ltrb), [count, 4, f, f]),
        );
        insert(found, "scores", out.scores.unsqueeze_dim::<4>(0));
        insert(found, "ltrb", out.ltrb.unsqueeze_dim::<5>(0));
    }
}

fn insert<const D: usize>(found: &mut StateDict, name: &str, tensor: Tensor<D>) {
    let shape = tensor.dims().to_vec();
    let values = tensor.into_data().iter::<f32>().collect();
    found.insert(name.into(), StateTensor { shape, values });
}

/// Values of one sequence in the order of [`PARTS`].
pub type PartValues = [Vec<f32>; 6];

/// Outputs of a graph that is opened for inspection, in order.
pub const PARTS: [&str; 6] = ["scores", "ltrb", "cls_filter", "reg_filter", "cls_enc", "reg_enc"];

fn values_of(parts: Parts) -> PartValues {
    fn read<const D: usize>(t: Tensor<D>) -> Vec<f32> {
        t.into_data().iter::<f32>().collect()
    }
    [
        read(parts.scores),
        read(parts.ltrb),
        read(parts.cls_filter),
        read(parts.reg_filter),
        read(parts.cls_enc),
        read(parts.reg_enc),
    ]
}

/// Puts the values of all sequences together under the names of the figures.
fn collect(spec: &ModelSpec, mode: Mode, rows: Vec<PartValues>, found: &mut StateDict) {
    let (b, f, d) = (rows.len(), spec.map_side(), usize::from(spec.width));
    let shapes = [
        vec![1, b, f, f],
        vec![1, b, 4, f, f],
        vec![b, d, 1, 1],
        vec![b, d, 1, 1],
        vec![1, b, d, f, f],
        vec![1, b, d, f, f],
    ];
    for (i, (name, shape)) in PARTS.into_iter().zip(shapes).enumerate() {
        let values = rows.iter().flat_map(|row| row[i].clone()).collect();
        found.insert(name.into(), StateTensor { shape, values });
    }
    let filters: Vec<f32> = match mode {
        Mode::Parallel { .. } => {
            rows.iter().flat_map(|row| [row[2].clone(), row[3].clone()]).flatten().collect()
        }
        Mode::Single => rows.iter().flat_map(|row| row[2].clone()).collect(),
    };
    let shape = vec![1, filters.len() / d, d];
    found.insert("decoder.norm".into(), StateTensor { shape, values: filters });
}

/// An engine of the runtime on the bundle's graphs, and its library on opened ones.
struct OnEngine<E> {
    name: &'static str,
    engine: E,
    opened: Opened,
    features: HashMap<usize, Vec<f32>>,
    /// Sequence in the engine's slots, and how many of them.
    held: Option<(usize, usize)>,
}

/// The back end of an engine that reads bundles.
fn on_engine<E: Engine + 'static>(
    name: &'static str,
    net: &TrackerNet,
    open: impl FnOnce(&Bundle<'_>) -> Result<E, EngineError>,
    load: graphs::Load,
) -> Result<Vec<Box<dyn Backend>>, GoldenError> {
    let net = net.valid();
    let manifest = Manifest::new("golden", *net.spec());
    let graphs = network::graphs(&net)?;
    let engine = {
        let bytes = bundle::encode(&manifest, &network::files(&graphs))?;
        open(&Bundle::parse(&bytes).map_err(bundle::WriteError::from)?)?
    };
    let opened = Opened::new(name, &net, &graphs, load)?;
    let (features, held) = (HashMap::new(), None);
    Ok(vec![Box::new(OnEngine { name, engine, opened, features, held })])
}

impl<E: Engine> Backend for OnEngine<E> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn run(
        &mut self,
        sequences: &[Sequence],
        pass: &Pass,
    ) -> Result<Option<StateDict>, GoldenError> {
        if let Mode::Parallel { annotated } = pass.mode
            && annotated != 1
        {
            return Ok(None);
        }
        let spec = *self.engine.spec();
        let (f, d) = (spec.map_side(), usize::from(spec.width));
        let all = frames(sequences, pass);
        let mut found = StateDict::default();
        for (name, frames) in ["train.head.feat", "test.head.feat"].into_iter().zip(&all) {
            let mut values = Vec::new();
            for frame in frames {
                if !self.features.contains_key(&frame.id) {
                    let feature = self.opened.features(&frame.crop)?;
                    self.features.insert(frame.id, feature);
                }
                values.extend_from_slice(&self.features[&frame.id]);
            }
            found.insert(name.into(), StateTensor { shape: vec![frames.len(), d, f, f], values });
        }
        let mut rows = Vec::new();
        for &index in &pass.sequences {
            let sequence = &sequences[index];
            let tokens = sequence.templates[..pass.templates]
                .iter()
                .map(|t| self.opened.template(&self.features[&t.frame.id], &t.label, &t.ltrb))
                .collect::<Result<Vec<_>, _>>()?;
            let search = &self.features[&sequence.search.id];
            let mut parts = self.opened.parts(pass.mode, &tokens, search)?;
            if matches!(pass.mode, Mode::Parallel { .. }) {
                // The deployed graphs have the last word on the maps.
                let (scores, ltrb) = self.deployed(index, sequence, pass.templates)?;
                (parts[0], parts[1]) = (scores, ltrb);
            }
            rows.push(parts);
        }
        collect(&spec, pass.mode, rows, &mut found);
        Ok(Some(found))
    }
}

impl<E: Engine> OnEngine<E> {
    /// Score map and distances as a tracker gets them.
    fn deployed(
        &mut self,
        index: usize,
        sequence: &Sequence,
        templates: usize,
    ) -> Result<(Vec<f32>, Vec<f32>), GoldenError> {
        let engine = &mut self.engine;
        if self.held.is_none_or(|(s, n)| s != index || n < templates) {
            for (slot, t) in sequence.templates[..templates].iter().enumerate() {
                engine.crop_mut().copy_from_slice(&t.frame.crop);
                engine.features()?;
                let input = engine.template_input_mut();
                input.label.copy_from_slice(&t.label);
                input.ltrb.copy_from_slice(&t.ltrb);
                engine.write_template(slot)?;
            }
            engine.crop_mut().copy_from_slice(&sequence.search.crop);
            engine.features()?;
            self.held = Some((index, templates));
        }
        let maps = engine.predict(templates)?;
        Ok((maps.scores.to_vec(), maps.ltrb.to_vec()))
    }
}
