//! Weights in files.
//!
//! Our files are safetensors with PyTorch state-dict names and layouts (spec 1.9), so they open in
//! any other tool; [`Metadata`] in them says which network they are of. PyTorch's own files are read
//! as well ([`torch`]). Reading lists every tensor that is missing, too many or of the wrong shape,
//! by name. Writing goes to a temporary name first and renames at the end.
//!
//! * [`save_weights`], [`load_weights`]: a whole [`TrackerNet`];
//! * [`load_backbone`]: pretrained weights for the backbone of a fresh net;
//! * [`run`]: the command `tsda-train weights-import`.

mod command;
mod file;
mod infer;
mod state_dict;
#[cfg(test)]
mod tests;
pub mod torch;

pub use command::{ImportKind, ImportOptions, ImportSummary, given, run};
pub use file::{BACKBONE_KEY, Metadata, SOURCE_KEY, SPEC_KEY, Source, WeightsFile};
pub use infer::{Given, Inferred, check_hidden, infer, model_toml, spec_fields};
pub use state_dict::{StateDict, StateTensor};

use crate::model::{TrackerNet, state_dict_name};
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::prelude::*;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use torch::TorchError;
use tsda_runtime::{Backbone, SpecError};

/// Weights that cannot be read, written or used.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file cannot be opened, read, written or renamed.
    #[error("cannot {action} the weights file: {source} ({})", path.display())]
    Io {
        /// `read`, `write`.
        action: &'static str,
        /// What the system said.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// The file is neither PyTorch's nor a safetensors file, or is cut short.
    #[error("neither a PyTorch nor a safetensors file, or damaged: {detail} ({})", path.display())]
    Format {
        /// What the reader said.
        detail: String,
        /// The file.
        path: PathBuf,
    },
    /// The file is a PyTorch one that cannot be read.
    #[error("{source} ({})", path.display())]
    Torch {
        /// What is wrong.
        source: TorchError,
        /// The file.
        path: PathBuf,
    },
    /// What the file says about its network is not understood.
    #[error(
        "its metadata {key} cannot be used: {reason}; import the original file again ({})",
        path.display()
    )]
    Metadata {
        /// The key.
        key: &'static str,
        /// What the reader said.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// Nothing known is in the file.
    #[error(
        "it cannot be told what the file holds (names like {}); say --kind ({})",
        names.join(", "), path.display()
    )]
    Unknown {
        /// Some of the names.
        names: Vec<String>,
        /// The file.
        path: PathBuf,
    },
    /// A whole network was asked for, but the file has no head.
    #[error(
        "it holds no head, so it is no {kind} file; backbones are imported with --kind \
         torchvision-resnet, efficientnet-lite0 or nanotrack ({})", path.display()
    )]
    NoHead {
        /// `pytracking`, `full`.
        kind: &'static str,
        /// The file.
        path: PathBuf,
    },
    /// Nothing says how many attention heads the network has.
    #[error(
        "the number of attention heads cannot be seen in tensors (width {width}), and neither a \
         constructor in the file nor the shapes of a preset tell it; give --preset, or --config \
         with [model] heads"
    )]
    Heads {
        /// Width of the network.
        width: u16,
    },
    /// File and user disagree.
    #[error("{field} is {file} in the file, but {wanted} in {by}")]
    Conflict {
        /// Field of [`tsda_runtime::ModelSpec`].
        field: &'static str,
        /// The file's value.
        file: String,
        /// The other value.
        wanted: String,
        /// `preset tomp101`, ...
        by: String,
    },
    /// A tensor is stored in a number type that is not read here.
    #[error("tensor {tensor} is stored as {dtype}; F32, F16, BF16 and F64 are read ({})", path.display())]
    Dtype {
        /// Its name.
        tensor: String,
        /// Its type.
        dtype: String,
        /// The file.
        path: PathBuf,
    },
    /// The tensors are not those of the network.
    #[error("{source} ({})", path.display())]
    Tensors {
        /// The differences.
        source: TensorMismatch,
        /// The file.
        path: PathBuf,
    },
    /// The network's specification is not valid.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The kind of weights does not go with the backbone.
    #[error("{kind} weights do not fit this network: its backbone is {backbone:?}")]
    Kind {
        /// `efficientnet-lite0`, ...
        kind: &'static str,
        /// The network's backbone.
        backbone: Backbone,
    },
}

/// How a set of tensors differs from what a network needs. At least one list is not empty.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TensorMismatch {
    /// Needed, but not there.
    pub missing: Vec<String>,
    /// There, but neither needed nor known to be harmless.
    pub extra: Vec<String>,
    /// `(name, shape in the file, shape needed)`.
    pub shapes: Vec<(String, Vec<usize>, Vec<usize>)>,
    /// Two names of one tensor (quirk Q11) whose values differ.
    pub untied: Vec<(String, String)>,
}

impl std::fmt::Display for TensorMismatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "the tensors do not fit the network")?;
        if !self.missing.is_empty() {
            write!(f, "; {} missing: {}", self.missing.len(), self.missing.join(", "))?;
        }
        if !self.extra.is_empty() {
            write!(f, "; {} too many: {}", self.extra.len(), self.extra.join(", "))?;
        }
        for (name, got, want) in &self.shapes {
            write!(f, "; {name} has shape {got:?} instead of {want:?}")?;
        }
        for (name, alias) in &self.untied {
            write!(
                f,
                "; {name} and {alias} are one tensor in the network, but differ in the file"
            )?;
        }
        Ok(())
    }
}

impl std::error::Error for TensorMismatch {}

/// What was done with the tensors of a file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ImportReport {
    /// State-dict names that were used.
    pub loaded: Vec<String>,
    /// Known tensors the network does not need (classifier, stride-32 stages, counters).
    pub unused: Vec<String>,
}

/// Prefix of the backbone's names.
const BACKBONE: &str = "feature_extractor.";

/// The foreground embedding and its second name (quirk Q11).
const TIED: (&str, &str) = (
    "head.filter_predictor.query_embed_fg.weight",
    "head.filter_predictor.query_embed_fg_decoder.weight",
);

/// Writes all parameters and running statistics.
///
/// # Errors
/// When the file cannot be written; an older file of this name is then still there.
pub fn save_weights(net: &TrackerNet, path: &Path) -> Result<(), WeightsError> {
    state_dict(net).write(path, &Metadata::of(net.spec()))
}

/// Reads all parameters and running statistics into `net`, keeping its device and what trains.
///
/// # Errors
/// When the file cannot be read or its tensors are not exactly those of the network; unused stages
/// of the published ToMP files (`layer4`, `fc`) and counters are only reported.
pub fn load_weights(
    net: TrackerNet,
    path: &Path,
) -> Result<(TrackerNet, ImportReport), WeightsError> {
    let dict = StateDict::read(path)?;
    apply(net, &dict, "").map_err(|source| WeightsError::Tensors { source, path: path.into() })
}

/// Reads the backbone of `net` from a file of backbone weights (safetensors, or PyTorch as
/// torchvision has them, or a NanoTrack state dict), with or without the `feature_extractor.` prefix,
/// or from a whole network's file. The head stays as it is.
///
/// # Errors
/// When the file cannot be read or lacks a tensor of the backbone.
pub fn load_backbone(
    net: TrackerNet,
    path: &Path,
) -> Result<(TrackerNet, ImportReport), WeightsError> {
    let mut dict = StateDict::read(path)?;
    command::adopt(&mut dict);
    apply(net, &dict, BACKBONE)
        .map_err(|source| WeightsError::Tensors { source, path: path.into() })
}

/// All parameters and running statistics of `net` under their state-dict names.
pub fn state_dict(net: &TrackerNet) -> StateDict {
    let mut collect = Collect { path: Vec::new(), dict: StateDict::default() };
    net.visit(&mut collect);
    collect.dict
}

/// Names and shapes, as in files, of all parameters and running statistics.
fn needed(net: &TrackerNet) -> Vec<(String, Vec<usize>)> {
    struct Names {
        path: Vec<String>,
        found: Vec<(String, Vec<usize>)>,
    }
    impl ModuleVisitor for Names {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let (name, layout) = state_dict_name(&self.path);
            self.found.push((name, layout.file_shape(&param.val().dims())));
        }
    }
    let mut names = Names { path: Vec::new(), found: Vec::new() };
    net.visit(&mut names);
    names.found
}

/// Checks `dict` against what is needed under `prefix`.
fn compare(
    needed: &[(String, Vec<usize>)],
    dict: &StateDict,
    prefix: &str,
) -> Result<ImportReport, TensorMismatch> {
    let mut mismatch = TensorMismatch::default();
    let mut used = BTreeSet::new();
    for (name, want) in needed.iter().filter(|(name, _)| name.starts_with(prefix)) {
        match dict.get(name) {
            None => mismatch.missing.push(name.clone()),
            Some(tensor) => {
                used.insert(name.clone());
                if tensor.shape != *want {
                    mismatch.shapes.push((name.clone(), tensor.shape.clone(), want.clone()));
                }
            }
        }
    }
    let mut unused = Vec::new();
    for name in dict.names().filter(|name| !used.contains(*name)) {
        if is_harmless(name) || !name.starts_with(prefix) {
            unused.push(name.to_string());
        } else {
            mismatch.extra.push(name.to_string());
        }
    }
    if let (Some(a), Some(b)) = (dict.get(TIED.0), dict.get(TIED.1))
        && a != b
        && TIED.0.starts_with(prefix)
    {
        mismatch.untied.push((TIED.0.into(), TIED.1.into()));
    }
    if mismatch != TensorMismatch::default() {
        return Err(mismatch);
    }
    Ok(ImportReport { loaded: used.into_iter().collect(), unused })
}

/// Puts the tensors of `dict` into the parameters whose state-dict name starts with `prefix`.
///
/// # Errors
/// When one is missing or has another shape, or `dict` holds a tensor under `prefix` that the
/// network does not know.
pub fn apply(
    net: TrackerNet,
    dict: &StateDict,
    prefix: &str,
) -> Result<(TrackerNet, ImportReport), TensorMismatch> {
    let report = compare(&needed(&net), dict, prefix)?;
    let net = net.map(&mut Fill { path: Vec::new(), dict, prefix });
    Ok((net, report))
}

/// Tensors that published files carry and no network of the family runs.
fn is_harmless(name: &str) -> bool {
    const UNUSED: [&str; 11] = [
        "layer4.",
        "fc.",
        "_conv_head.",
        "_bn1.",
        "_fc.",
        "_blocks.11.",
        "_blocks.12.",
        "_blocks.13.",
        "_blocks.14.",
        "_blocks.15.",
        "classifier.",
    ];
    name.ends_with("num_batches_tracked")
        || name == TIED.1
        || name
            .strip_prefix(BACKBONE)
            .is_some_and(|rest| UNUSED.iter().any(|unused| rest.starts_with(unused)))
}

/// Rows and columns of a row-major `(rows, columns)` matrix exchanged.
fn transposed(values: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    (0..rows * columns).map(|i| values[(i % rows) * columns + i / rows]).collect()
}

struct Collect {
    path: Vec<String>,
    dict: StateDict,
}

impl ModuleVisitor for Collect {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let (name, layout) = state_dict_name(&self.path);
        let data = param.val().inner().into_data();
        let shape: Vec<usize> = data.shape().iter().copied().collect();
        let mut values: Vec<f32> = data.iter::<f32>().collect();
        if layout.is_transposed() && shape.len() == 2 {
            values = transposed(&values, shape[0], shape[1]);
        }
        self.dict.insert(name, StateTensor { shape: layout.file_shape(&shape), values });
    }
}

/// Fills parameters; names and shapes have been compared.
struct Fill<'a> {
    path: Vec<String>,
    dict: &'a StateDict,
    prefix: &'a str,
}

impl ModuleMapper for Fill<'_> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (name, layout) = state_dict_name(&self.path);
        if !name.starts_with(self.prefix) {
            return param;
        }
        let shape = param.val().dims();
        let Some(tensor) = self.dict.get(&name) else { return param };
        let values = match (layout.is_transposed(), shape.as_slice()) {
            (true, &[inp, out]) => transposed(&tensor.values, out, inp),
            _ => tensor.values.clone(),
        };
        param.map(|old| {
            let new = Tensor::from_data(TensorData::new(values, shape), &old.device());
            if old.is_require_grad() { new.require_grad() } else { new }
        })
    }
}
