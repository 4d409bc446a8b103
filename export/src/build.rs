//! From weights and configuration to a bundle.

use crate::bundle::{self, WriteError};
use crate::files::{self, FileError};
use crate::network;
use crate::onnx::ExportError;
use burn::tensor::Device;
use serde::Deserialize;
use std::path::{Path, PathBuf};
use tsda_runtime::SpecError;
use tsda_runtime::bundle::{Figure, Manifest, Provenance, SectionKind, TrainedOn, crc32};
use tsda_runtime::probe::{self, ProbeError};
use tsda_trainer::burn_engine::BurnEngine;
use tsda_trainer::config::{ConfigError, Experiment};
use tsda_trainer::import::{WeightsError, load_weights};
use tsda_trainer::model::{NetOptions, TrackerNet};

/// Most figures a manifest holds.
const MAX_FIGURES: usize = 32;

/// What `tsda-export build` is given.
#[derive(Clone, Debug)]
pub struct BuildOptions {
    /// Trained weights, safetensors with state-dict names.
    pub weights: PathBuf,
    /// The resolved configuration of the training run.
    pub config: PathBuf,
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
    /// The weights cannot be used.
    #[error(transparent)]
    Weights(#[from] WeightsError),
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

/// Builds a bundle: reads weights and configuration, records the graphs, computes the reference
/// outputs with the network itself, writes the file.
///
/// # Errors
/// Names the file, field or tensor that cannot be used. No file is left behind then.
pub fn build(options: &BuildOptions) -> Result<BuildReport, BuildError> {
    let text = files::read_text(&options.config)?;
    // Parsed, not loaded, which would look for the data sources on this machine.
    let experiment = portable(Experiment::parse(&text, &options.config)?);
    let spec = experiment
        .model_spec()
        .map_err(|source| BuildError::Spec { path: options.config.clone(), source })?;
    let config = experiment.to_toml()?;
    let read = |path: &Option<PathBuf>| path.as_deref().map(files::read_text).transpose();
    let (card, data) = (read(&options.card)?, read(&options.data_sources)?.unwrap_or_default());
    let figures = options.figures.as_deref().map(read_figures).transpose()?.unwrap_or_default();

    let net = TrackerNet::new(&spec, &NetOptions::default(), &Device::flex())
        .map_err(|source| BuildError::Spec { path: options.config.clone(), source })?;
    let (net, _) = load_weights(net, &options.weights)?;
    check_finite(&net, &options.weights)?;
    let raw = std::fs::read(&options.weights).map_err(|source| FileError {
        action: "read",
        path: options.weights.clone(),
        source,
    })?;

    let graphs = network::graphs(&net)?;
    let mut sections = network::files(&graphs);
    let weights = sections.last().map_or(0, |(_, bytes)| bytes.len());
    let boxes = probe::default_boxes(&spec);
    sections.push((SectionKind::Probe, probe::capture(&mut BurnEngine::new(&net), &boxes)?));

    let name = options.name.clone().unwrap_or_else(|| stem(&options.out));
    let card = card.unwrap_or_else(|| format!("# {name}\n\nNo model card was written.\n"));
    let manifest = Manifest {
        name: &name,
        spec,
        tracker: experiment.tracker,
        trained_on: TrainedOn {
            // Every data source the trainer reads is a registered RGB-thermal one.
            rgb: !experiment.data.is_empty(),
            thermal: !experiment.data.is_empty(),
            cross_modal: experiment.sampler.cross_modal_p > 0.0,
        },
        calibration: None,
        provenance: Provenance {
            trainer: concat!("tsda-train ", env!("CARGO_PKG_VERSION")),
            config: &config,
            seed: experiment.run.seed,
            steps: experiment.total_steps(),
            data: &data,
            weights_crc: crc32(&raw),
        },
        figures: figures.iter().map(|(name, value)| Figure { name, value: *value }).collect(),
        licence: &options.licence,
        card: &card,
        sections: Default::default(),
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
