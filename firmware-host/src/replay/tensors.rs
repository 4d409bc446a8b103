//! The part of the safetensors format that scripts need: named f32 tensors.

use super::error::ReplayError;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// One tensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    /// Its sides.
    pub shape: Vec<usize>,
    /// Row-major.
    pub values: Vec<f32>,
}

/// Tensors by name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tensors {
    /// Where they were read from.
    pub path: PathBuf,
    map: BTreeMap<String, Tensor>,
}

#[derive(Deserialize)]
struct Entry {
    dtype: String,
    shape: Vec<usize>,
    data_offsets: [usize; 2],
}

impl Tensors {
    /// Reads a file. Tensors that are not F32 or F64 are left out.
    ///
    /// # Errors
    /// When the file cannot be read or is damaged, with the place of the damage.
    pub fn read(path: &Path) -> Result<Self, ReplayError> {
        let bytes = std::fs::read(path)
            .map_err(|source| ReplayError::Read { path: path.into(), source })?;
        Self::parse(&bytes, path)
    }

    /// Reads the bytes of a file; `path` is for messages.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn parse(bytes: &[u8], path: &Path) -> Result<Self, ReplayError> {
        let damaged = |offset: usize, detail: String| ReplayError::Tensors {
            path: path.into(),
            offset,
            detail,
        };
        let length = bytes.first_chunk::<8>().map(|b| u64::from_le_bytes(*b));
        let Some(length) = length else {
            return Err(damaged(0, format!("{} bytes are no safetensors file", bytes.len())));
        };
        let body = usize::try_from(length).ok().and_then(|n| n.checked_add(8));
        let Some((body, header)) = body.and_then(|end| Some((end, bytes.get(8..end)?))) else {
            let detail = format!("a header of {length} bytes in a file of {}", bytes.len());
            return Err(damaged(0, detail));
        };
        let mut table: BTreeMap<String, serde_json::Value> = serde_json::from_slice(header)
            .map_err(|e| damaged(8 + e.column().saturating_sub(1), format!("header: {e}")))?;
        table.remove("__metadata__");
        let mut map = BTreeMap::new();
        for (name, entry) in table {
            let entry: Entry = serde_json::from_value(entry)
                .map_err(|e| damaged(8, format!("header entry `{name}`: {e}")))?;
            let [from, to] = entry.data_offsets;
            let range = body.checked_add(from).zip(body.checked_add(to));
            let Some(data) = range.and_then(|(from, to)| bytes.get(from..to)) else {
                let detail = format!("tensor `{name}` ends at {to} of {}", bytes.len() - body);
                return Err(damaged(body, detail));
            };
            let values: Vec<f32> = match entry.dtype.as_str() {
                "F32" => data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
                "F64" => data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
                _ => continue,
            };
            let count = entry.shape.iter().try_fold(1usize, |n, side| n.checked_mul(*side));
            if count != Some(values.len()) {
                let detail = format!(
                    "tensor `{name}` of shape {:?} has {} numbers",
                    entry.shape,
                    values.len()
                );
                return Err(damaged(body + from, detail));
            }
            map.insert(name, Tensor { shape: entry.shape, values });
        }
        Ok(Self { path: path.into(), map })
    }

    /// The tensor of this name.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.map.get(name)
    }

    /// All names, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.map.keys().map(String::as_str)
    }
}
