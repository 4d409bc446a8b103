//! Weights files of any kind, and what ours say about themselves.

use super::torch::{Checkpoint, TorchFile, is_torch};
use super::{StateDict, WeightsError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use tsda_runtime::{Backbone, ModelSpec};

/// Key of the network's [`ModelSpec`] (JSON) in the metadata of a safetensors file.
pub const SPEC_KEY: &str = "tsda.spec";
/// Key of the [`Backbone`] (JSON) in the metadata of a file of backbone weights.
pub const BACKBONE_KEY: &str = "tsda.backbone";
/// Key of the [`Source`] (JSON) in the metadata of an imported file.
pub const SOURCE_KEY: &str = "tsda.source";

/// Longest table of a safetensors file; the format's own limit.
const MAX_TABLE: u64 = 100_000_000;

/// Where imported weights come from.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Source {
    /// File name, without folders.
    pub file: String,
    /// What it was imported as, as in `pytracking`.
    pub kind: String,
    /// Container, as in `PyTorch zip file`.
    pub format: String,
    /// Key of the state dict in the file; empty for its root.
    pub key: String,
    /// The call that made the network, as far as the file tells; else empty.
    pub constructor: String,
}

/// What a weights file says about its network.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Metadata {
    /// Of a whole network.
    pub spec: Option<ModelSpec>,
    /// Of backbone weights.
    pub backbone: Option<Backbone>,
    /// Of imported weights.
    pub source: Option<Source>,
}

impl Metadata {
    /// Of a network made or trained here.
    pub fn of(spec: &ModelSpec) -> Self {
        Self { spec: Some(*spec), ..Self::default() }
    }

    /// As stored in a file.
    pub(super) fn to_map(&self) -> Result<BTreeMap<String, String>, serde_json::Error> {
        let mut map = BTreeMap::new();
        if let Some(spec) = &self.spec {
            map.insert(SPEC_KEY.into(), serde_json::to_string(spec)?);
        }
        if let Some(backbone) = &self.backbone {
            map.insert(BACKBONE_KEY.into(), serde_json::to_string(backbone)?);
        }
        if let Some(source) = &self.source {
            map.insert(SOURCE_KEY.into(), serde_json::to_string(source)?);
        }
        Ok(map)
    }

    /// Reads the metadata of a weights file, not its tensors. PyTorch files have none.
    ///
    /// # Errors
    /// When the file cannot be read, or one of our keys holds what is not understood.
    pub fn read(path: &Path) -> Result<Self, WeightsError> {
        let io = |source| WeightsError::Io { action: "read", source, path: path.into() };
        let format = |detail: String| WeightsError::Format { detail, path: path.into() };
        let mut file = File::open(path).map_err(io)?;
        let mut start = Vec::new();
        (&mut file).take(8).read_to_end(&mut start).map_err(io)?;
        let length = start.first_chunk().map(|b| u64::from_le_bytes(*b));
        if start.starts_with(b"PK") || length.is_none_or(|n| n > MAX_TABLE) {
            return Ok(Self::default());
        }
        let mut table = Vec::new();
        file.take(length.unwrap_or(0)).read_to_end(&mut table).map_err(io)?;
        Self::from_table(&table, path).map_err(|e| match e {
            TableError::Json(e) => format(e.to_string()),
            TableError::Weights(e) => e,
        })
    }

    fn from_table(table: &[u8], path: &Path) -> Result<Self, TableError> {
        #[derive(Deserialize)]
        struct Table {
            #[serde(rename = "__metadata__", default)]
            metadata: BTreeMap<String, String>,
        }
        fn parse<T: serde::de::DeserializeOwned>(
            map: &BTreeMap<String, String>,
            key: &'static str,
            path: &Path,
        ) -> Result<Option<T>, TableError> {
            let Some(text) = map.get(key) else { return Ok(None) };
            serde_json::from_str(text).map(Some).map_err(|e| {
                let (reason, path) = (e.to_string(), path.into());
                TableError::Weights(WeightsError::Metadata { key, reason, path })
            })
        }
        let table: Table = serde_json::from_slice(table).map_err(TableError::Json)?;
        Ok(Self {
            spec: parse(&table.metadata, SPEC_KEY, path)?,
            backbone: parse(&table.metadata, BACKBONE_KEY, path)?,
            source: parse(&table.metadata, SOURCE_KEY, path)?,
        })
    }
}

enum TableError {
    Json(serde_json::Error),
    Weights(WeightsError),
}

/// A weights file: safetensors or PyTorch, told apart by its first bytes.
#[derive(Clone, Debug)]
pub struct WeightsFile {
    /// Container, for messages.
    pub format: String,
    /// The tensors.
    pub dict: StateDict,
    /// Of safetensors files made here.
    pub metadata: Metadata,
    /// What else a PyTorch file holds; its `dict` is empty.
    pub torch: Option<Checkpoint>,
    /// Was `module.` (of `DataParallel`) taken off every name?
    pub stripped: bool,
}

/// What `DataParallel` puts before every name.
const PARALLEL: &str = "module.";

impl WeightsFile {
    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, is damaged, or holds a number type that is not read.
    pub fn read(path: &Path) -> Result<Self, WeightsError> {
        let io = |source| WeightsError::Io { action: "read", source, path: path.into() };
        let mut start = Vec::new();
        let file = File::open(path).map_err(io)?;
        (&file).take(16).read_to_end(&mut start).map_err(io)?;
        let mut file = if is_torch(&start) {
            let torch = |source| WeightsError::Torch { source, path: path.into() };
            let mut checkpoint = TorchFile::open(BufReader::new(file))
                .and_then(|mut f| f.checkpoint())
                .map_err(torch)?;
            Self {
                format: checkpoint.format.to_string(),
                dict: std::mem::take(&mut checkpoint.dict),
                metadata: Metadata::default(),
                torch: Some(checkpoint),
                stripped: false,
            }
        } else {
            Self {
                format: "safetensors file".into(),
                dict: StateDict::read_safetensors(path)?,
                metadata: Metadata::read(path)?,
                torch: None,
                stripped: false,
            }
        };
        let mut names = file.dict.names();
        file.stripped =
            file.dict.names().next().is_some() && names.all(|n| n.starts_with(PARALLEL));
        drop(names);
        if file.stripped {
            file.dict.rename(|name| name.strip_prefix(PARALLEL).unwrap_or(name).to_owned());
        }
        Ok(file)
    }
}
