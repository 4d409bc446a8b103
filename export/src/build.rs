//! From weights and configuration to a bundle.

use crate::bundle::{self, WriteError};
use crate::files::{self, FileError};
use crate::network;
use crate::onnx::ExportError;
use burn::tensor::Device;
use serde::Deserialize;
use std::path::{Path, PathBuf};
use tsda_runtime::bundle::{Figure, Manifest, Provenance, SectionKind, TrainedOn, crc32};
use tsda_runtime::probe::{self, ProbeError};
use tsda_runtime::{ModelSpec, MotionPrior, SpecError, TrackerParams};
use tsda_trainer::burn_engine::BurnEngine;
use tsda_trainer::config::{ConfigError, Experiment};
use tsda_trainer::import::{self, Given, Metadata, Source, WeightsError, WeightsFile};
use tsda_trainer::model::{NetOptions, TrackerNet};

/// Most figures a manifest holds.
const MAX_FIGURES: usize = 32;

/// What `tsda-export build` is given.
#[derive(Clone, Debug)]
pub struct BuildOptions {
    /// Trained weights, safetensors with state-dict names.
    pub weights: PathBuf,
    /// The resolved configuration of the training run. Without one the network is the one the
    /// weights say they are of, as imported ones do.
    pub config: Option<PathBuf>,
    /// Preset the network has to be of, when there is no configuration.
    pub preset: Option<String>,
    /// The bundle to write.
    pub out: PathBuf,
    /// Name of the model; the file name of `out` when not given.
    pub name: Option<String>,
    /// Model card, Markdown.
    pub card: Option<PathBuf>,
    /// Measured figures, JSON.
    pub figures: Option<PathBuf>,
    /// Data sources and their licences, one per line.
    pub data_sources: Option<PathBuf>,
    /// Licence of the weights.
    pub licence: String,
    /// Sensors the weights have seen, when no configuration tells.
    pub trained_on: TrainedOn,
    /// What the tracker takes the last frame to say about the next one.
    pub motion: Option<MotionPrior>,
    /// Score above which a frame becomes a template; that of the configuration when not given.
    pub remember_above: Option<f32>,
}

/// A bundle that could not be built. Nothing has been written then.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BuildError {
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The network specification cannot be used.
    #[error("configuration {}: model: {source}", path.display())]
    Spec {
        /// The configuration.
        path: PathBuf,
        /// The field.
        source: SpecError,
    },
    /// A threshold given beside the configuration cannot be used.
    #[error("tracker: {0}")]
    Tracker(#[source] SpecError),
    /// The weights cannot be used.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// Nothing says which network the weights are of.
    #[error(
        "the weights do not say which network they are of; give --config or --preset, or import \
         them first with `tsda-train weights-import` ({})", path.display()
    )]
    NoSpec {
        /// The weights file.
        path: PathBuf,
    },
    /// The weights hold a number that is not finite.
    #[error("tensor {tensor} holds {value} at element {index}; train again ({})", path.display())]
    NotFinite {
        /// Its state-dict name.
        tensor: String,
        /// Flat index of the first such element.
        index: usize,
        /// The number.
        value: f32,
        /// The weights file.
        path: PathBuf,
    },
    /// A text file cannot be read or the bundle cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The figures are not what they should be.
    #[error("figures {}: {reason}", path.display())]
    Figures {
        /// The file.
        path: PathBuf,
        /// What is wrong and what was expected.
        reason: String,
    },
    /// The network cannot be written as ONNX.
    #[error(transparent)]
    Export(#[from] ExportError),
    /// The reference outputs cannot be computed.
    #[error(transparent)]
    Probe(#[from] ProbeError),
    /// The bundle cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// What was built.
#[derive(Clone, Debug)]
pub struct BuildReport {
    /// Graph, nodes as recorded, nodes written.
    pub graphs: Vec<(SectionKind, usize, usize)>,
    /// Parameters and running statistics of the network.
    pub parameters: usize,
    /// Size of the shared weights in bytes.
    pub weights: usize,
    /// Size of the bundle in bytes.
    pub bundle: u64,
}

/// Which network to build, and what is known about how it was made.
struct Plan {
    spec: ModelSpec,
    tracker: TrackerParams,
    /// TOML.
    config: String,
    /// Program, or the file the weights were imported from.
    trainer: String,
    trained_on: TrainedOn,
    seed: u64,
    steps: u64,
}

impl Plan {
    /// From a configuration: of a training run here.
    fn configured(path: &Path, stored: Option<&ModelSpec>) -> Result<Self, BuildError> {
        let text = files::read_text(path)?;
        // Parsed, not loaded, which would look for the data sources on this machine.
        let experiment = portable(Experiment::parse(&text, path)?);
        let spec = experiment
            .model_spec()
            .map_err(|source| BuildError::Spec { path: path.into(), source })?;
        if let Some(stored) = stored {
            import::check_hidden(stored, &spec, &path.display().to_string())?;
        }
        // The trainer refuses to draw across sensors when no source has both.
        let cross_modal = experiment.sampler.cross_modal_p > 0.0;
        let sensors = || experiment.data.iter().map(|source| source.sensors());
        Ok(Self {
            spec,
            tracker: experiment.tracker,
            config: experiment.to_toml()?,
            trainer: concat!("tsda-train ", env!("CARGO_PKG_VERSION")).into(),
            trained_on: TrainedOn {
                rgb: cross_modal || sensors().any(|(rgb, _)| rgb),
                thermal: cross_modal || sensors().any(|(_, thermal)| thermal),
                cross_modal,
            },
            seed: experiment.run.seed,
            steps: experiment.total_steps(),
        })
    }

    /// From what the weights say, with the thresholds of spec 3.1.
    fn stored(options: &BuildOptions, file: &WeightsFile) -> Result<Self, BuildError> {
        let stored = file.metadata.spec.as_ref();
        let given = match &options.preset {
            Some(name) => Given::Preset(name.clone()),
            None if stored.is_some() => Given::Nothing,
            None => return Err(BuildError::NoSpec { path: options.weights.clone() }),
        };
        let spec = import::infer(&file.dict, None, stored, &given)?.spec;
        let tracker = TrackerParams::default();
        let from = |s: &Source| match s.constructor.as_str() {
            "" => format!("imported from {} ({})", s.file, s.kind),
            call => format!("imported from {} ({}, {call})", s.file, s.kind),
        };
        Ok(Self {
            spec,
            tracker,
            config: import::model_toml(&spec, &tracker)?,
            trainer: file.metadata.source.as_ref().map_or_else(|| "not known".into(), from),
            trained_on: options.trained_on,
            seed: 0,
            steps: 0,
        })
    }
}

/// Builds a bundle: reads weights and what is known about them, records the graphs, computes the
/// reference outputs with the network itself, writes the file.
///
/// # Errors
/// Names the file, field or tensor that cannot be used. No file is left behind then.
pub fn build(options: &BuildOptions) -> Result<BuildReport, BuildError> {
    let weights_path = options.weights.as_path();
    // Settings before weights: they are read in no time, and most mistakes are in them.
    let configured = match &options.config {
        None => None,
        Some(path) => {
            let stored = Metadata::read(weights_path).ok().and_then(|m| m.spec);
            Some(Plan::configured(path, stored.as_ref())?)
        }
    };
    let read = |path: &Option<PathBuf>| path.as_deref().map(files::read_text).transpose();
    let (card, data) = (read(&options.card)?, read(&options.data_sources)?.unwrap_or_default());
    let figures = options.figures.as_deref().map(read_figures).transpose()?.unwrap_or_default();

    let file = WeightsFile::read(weights_path)?;
    let plan = match configured {
        Some(plan) => plan,
        None => Plan::stored(options, &file)?,
    };
    let spec = plan.spec;
    let spec_path = options.config.as_deref().unwrap_or(weights_path);
    let net = TrackerNet::new(&spec, &NetOptions::default(), &Device::flex())
        .map_err(|source| BuildError::Spec { path: spec_path.into(), source })?;
    let tensors = |source| WeightsError::Tensors { source, path: weights_path.into() };
    let (net, _) = import::apply(net, &file.dict, "").map_err(tensors)?;
    drop(file);
    check_finite(&net, weights_path)?;
    let weights_crc = {
        let raw = std::fs::read(weights_path).map_err(|source| FileError {
            action: "read",
            path: weights_path.into(),
            source,
        })?;
        crc32(&raw)
    };

    let graphs = network::graphs(&net)?;
    let mut sections = network::files(&graphs);
    let weights = sections.last().map_or(0, |(_, bytes)| bytes.len());
    let boxes = probe::default_boxes(&spec);
    sections.push((SectionKind::Probe, probe::capture(&mut BurnEngine::new(&net), &boxes)?));

    let mut tracker = plan.tracker;
    if let Some(score) = options.remember_above {
        tracker.write_confidence = score;
        tracker.validate().map_err(BuildError::Tracker)?;
    }
    let name = options.name.clone().unwrap_or_else(|| stem(&options.out));
    let card = card.unwrap_or_else(|| format!("# {name}\n\nNo model card was written.\n"));
    let manifest = Manifest {
        name: &name,
        spec,
        tracker,
        trained_on: plan.trained_on,
        calibration: None,
        provenance: Provenance {
            trainer: &plan.trainer,
            config: &plan.config,
            seed: plan.seed,
            steps: plan.steps,
            data: &data,
            weights_crc,
        },
        figures: figures.iter().map(|(name, value)| Figure { name, value: *value }).collect(),
        licence: &options.licence,
        card: &card,
        sections: Default::default(),
        precision: None,
        motion: options.motion,
    };
    let bundle = bundle::write(&options.out, &manifest, &sections)?;
    Ok(BuildReport {
        graphs: graphs.iter().map(|g| (g.kind, g.recorded, g.graph.nodes.len())).collect(),
        parameters: network::parameters(&net),
        weights,
        bundle,
    })
}

/// Absolute paths cut to their last part: a bundle tells nothing about the machine it was made on.
fn portable(mut experiment: Experiment) -> Experiment {
    let cut = |path: &Path| match path.file_name() {
        Some(name) if path.is_absolute() => PathBuf::from(name),
        _ => path.to_owned(),
    };
    experiment.run.out = cut(&experiment.run.out);
    for source in &mut experiment.data {
        source.path = cut(&source.path);
    }
    for path in [&mut experiment.init.backbone, &mut experiment.init.weights] {
        *path = cut(Path::new(path.as_str())).to_string_lossy().into_owned();
    }
    experiment
}

fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Refuses weights with NaN or infinity: every output would be one.
fn check_finite(net: &TrackerNet, path: &Path) -> Result<(), BuildError> {
    for (name, tensor) in tsda_trainer::import::state_dict(net).iter() {
        if let Some(index) = tensor.values.iter().position(|v| !v.is_finite()) {
            return Err(BuildError::NotFinite {
                tensor: name.into(),
                index,
                value: tensor.values[index],
                path: path.into(),
            });
        }
    }
    Ok(())
}

/// `{"name": number, ..}` or `[{"name": "..", "value": number}, ..]`.
#[derive(Deserialize)]
#[serde(untagged)]
enum FiguresFile {
    List(Vec<FigureEntry>),
    Map(std::collections::BTreeMap<String, f32>),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FigureEntry {
    name: String,
    value: f32,
}

fn read_figures(path: &Path) -> Result<Vec<(String, f32)>, BuildError> {
    let wrong = |reason: String| BuildError::Figures { path: path.into(), reason };
    let expected = "expected {\"name\": number, ..} or [{\"name\": \"..\", \"value\": number}, ..]";
    let value: serde_json::Value = serde_json::from_str(&files::read_text(path)?)
        .map_err(|e| wrong(format!("{e}; {expected}")))?;
    let figures: Vec<(String, f32)> =
        match serde_json::from_value(value).map_err(|_| wrong(expected.into()))? {
            FiguresFile::List(list) => list.into_iter().map(|f| (f.name, f.value)).collect(),
            FiguresFile::Map(map) => map.into_iter().collect(),
        };
    if figures.len() > MAX_FIGURES {
        return Err(wrong(format!("{} figures, at most {MAX_FIGURES} fit", figures.len())));
    }
    if let Some((name, value)) = figures.iter().find(|(_, v)| !v.is_finite()) {
        return Err(wrong(format!("`{name}` is {value}, not a finite number")));
    }
    Ok(figures)
}
