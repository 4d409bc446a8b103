//! Reading, resolving and writing an [`Experiment`].

use super::{Experiment, FieldError, ModelConfig, SCRATCH};
use std::path::{Path, PathBuf};
use toml::de::{DeTable, DeValue};

/// A configuration that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file could not be read.
    #[error("cannot read configuration {path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML, an unknown key, or a value of the wrong type.
    #[error("{path}{}: {reason}", at(*.line))]
    Parse {
        /// The file.
        path: PathBuf,
        /// 1-based line, where one can be named.
        line: Option<usize>,
        /// What is wrong.
        reason: String,
    },
    /// A value out of range.
    #[error("{path}{}: {field}", at(*.line))]
    Field {
        /// The file.
        path: PathBuf,
        /// 1-based line; none when the field is not in the file or was overridden.
        line: Option<usize>,
        /// Field, value and range.
        field: FieldError,
    },
    /// The configuration cannot be written as TOML.
    #[error("cannot write the resolved configuration: {reason}")]
    Write {
        /// What the writer said.
        reason: String,
    },
}

fn at(line: Option<usize>) -> String {
    line.map(|l| format!(", line {l}")).unwrap_or_default()
}

fn line_of(text: &str, byte: usize) -> usize {
    text.as_bytes().iter().take(byte).filter(|b| **b == b'\n').count() + 1
}

/// Line of a dotted field in the text; falls back to the deepest table that is there.
fn locate(text: &str, field: &str) -> Option<usize> {
    let root = DeTable::parse(text).ok()?;
    let mut parts = field.split('.');
    let mut node = root.get_ref().get(parts.next()?)?;
    for part in parts {
        let next = match node.get_ref() {
            DeValue::Table(table) => table.get(part),
            DeValue::Array(array) => part.parse::<usize>().ok().and_then(|i| array.get(i)),
            _ => None,
        };
        match next {
            Some(next) => node = next,
            None => break,
        }
    }
    Some(line_of(text, node.span().start))
}

impl Experiment {
    /// Reads, resolves and checks a configuration. Paths of data and weights that are relative and
    /// exist beside the file are taken from there, others from the current folder.
    ///
    /// # Errors
    /// Names file, line and field of whatever is wrong.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        Self::load_from(path, None)
    }

    /// As [`Self::load`]; with `root`, relative paths of data start there, and so do those of
    /// weights that exist there.
    ///
    /// # Errors
    /// Names file, line and field of whatever is wrong.
    pub fn load_from(path: &Path, root: Option<&Path>) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Io { path: path.into(), source })?;
        let mut experiment = Self::parse(&text, path)?;
        let beside = path.parent().unwrap_or(Path::new(""));
        for source in &mut experiment.data {
            source.path = match root {
                Some(root) => root.join(&source.path),
                None => resolve(beside, &source.path),
            };
        }
        let weights = |path: &str| {
            let below = root.map(|root| resolve(root, Path::new(path)));
            let found = below.filter(|p| p.exists());
            let found = found.unwrap_or_else(|| resolve(beside, Path::new(path)));
            found.to_string_lossy().into_owned()
        };
        if experiment.init.backbone != SCRATCH {
            experiment.init.backbone = weights(&experiment.init.backbone);
        }
        if !experiment.init.weights.is_empty() {
            experiment.init.weights = weights(&experiment.init.weights);
        }
        Ok(experiment)
    }

    /// Reads and checks a configuration given as text; `path` is what errors call it.
    ///
    /// # Errors
    /// Names line and field of whatever is wrong.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let experiment: Self = toml::from_str(text).map_err(|e| ConfigError::Parse {
            path: path.into(),
            line: e.span().map(|s| line_of(text, s.start)),
            reason: e.message().to_owned(),
        })?;
        experiment.validate().map_err(|field| ConfigError::Field {
            path: path.into(),
            line: locate(text, &field.field),
            field,
        })?;
        Ok(experiment)
    }

    /// The whole configuration with the preset expanded, as TOML.
    ///
    /// # Errors
    /// When a value has no TOML form (none that passed [`Self::validate`]).
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        let write = |reason: String| ConfigError::Write { reason };
        let spec = self.model.spec().map_err(|e| write(e.to_string()))?;
        let mut full = self.clone();
        full.model = ModelConfig::from_spec(self.model.preset.clone(), &spec);
        full.align = self.align.expanded();
        toml::to_string(&full).map_err(|e| write(e.to_string()))
    }
}

fn resolve(beside: &Path, path: &Path) -> PathBuf {
    let near = beside.join(path);
    if path.is_relative() && near.exists() { near } else { path.to_owned() }
}
