//! Named tensors as plain values, and safetensors files of them.

use super::{Metadata, WeightsError, WeightsFile};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::BTreeMap;
use std::io::{BufWriter, Write};
use std::path::Path;

/// One tensor of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct StateTensor {
    /// Shape as in the file.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub values: Vec<f32>,
}

/// Tensors by name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StateDict {
    tensors: BTreeMap<String, StateTensor>,
}

impl StateDict {
    /// The tensor of this name.
    pub fn get(&self, name: &str) -> Option<&StateTensor> {
        self.tensors.get(name)
    }

    /// Adds or replaces a tensor.
    pub fn insert(&mut self, name: String, tensor: StateTensor) {
        self.tensors.insert(name, tensor);
    }

    /// Names in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Names and tensors in order of the names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &StateTensor)> {
        self.tensors.iter().map(|(name, tensor)| (name.as_str(), tensor))
    }

    /// Keeps the tensors whose name passes.
    pub fn retain(&mut self, keep: impl Fn(&str) -> bool) {
        self.tensors.retain(|name, _| keep(name));
    }

    /// Gives every tensor a new name.
    pub fn rename(&mut self, name: impl Fn(&str) -> String) {
        self.tensors =
            std::mem::take(&mut self.tensors).into_iter().map(|(k, v)| (name(&k), v)).collect();
    }

    /// Reads the tensors of a weights file, safetensors or PyTorch. Floating-point tensors become
    /// f32; integer tensors (counters of batch norms, masks) are read as numbers too.
    ///
    /// # Errors
    /// When the file cannot be read, is damaged or holds a number type not read here.
    pub fn read(path: &Path) -> Result<Self, WeightsError> {
        Ok(WeightsFile::read(path)?.dict)
    }

    pub(super) fn read_safetensors(path: &Path) -> Result<Self, WeightsError> {
        let bytes = std::fs::read(path).map_err(|source| WeightsError::Io {
            action: "read",
            source,
            path: path.into(),
        })?;
        let file = SafeTensors::deserialize(&bytes)
            .map_err(|e| WeightsError::Format { detail: e.to_string(), path: path.into() })?;
        let mut dict = Self::default();
        for (name, view) in file.iter() {
            let values = values(&view).ok_or_else(|| WeightsError::Dtype {
                tensor: name.to_string(),
                dtype: format!("{:?}", view.dtype()),
                path: path.into(),
            })?;
            dict.insert(name.into(), StateTensor { shape: view.shape().to_vec(), values });
        }
        Ok(dict)
    }

    /// Writes a safetensors file of f32 tensors: temporary name beside it, then rename. The same
    /// tensors and metadata give the same bytes.
    ///
    /// # Errors
    /// When the file cannot be written; an older file of this name is then still there.
    pub fn write(&self, path: &Path, metadata: &Metadata) -> Result<(), WeightsError> {
        let table = self
            .table(metadata)
            .map_err(|e| WeightsError::Format { detail: e.to_string(), path: path.into() })?;
        let mut temporary = path.as_os_str().to_owned();
        temporary.push(format!(".{}.tmp", std::process::id()));
        let write = || {
            let mut file = BufWriter::new(std::fs::File::create(&temporary)?);
            file.write_all(&(table.len() as u64).to_le_bytes())?;
            file.write_all(&table)?;
            for value in self.tensors.values().flat_map(|t| &t.values) {
                file.write_all(&value.to_le_bytes())?;
            }
            // On disk before the old file is given up.
            file.into_inner().map_err(|e| e.into_error())?.sync_all()?;
            std::fs::rename(&temporary, path)
        };
        write().map_err(|source| {
            // The file may not exist; there is nothing more to do about it either way.
            let _ = std::fs::remove_file(&temporary);
            WeightsError::Io { action: "write", source, path: path.into() }
        })
    }

    /// The table at the start of a safetensors file, padded so that the numbers are aligned. Written
    /// here because the crate's writer wants a second copy of all tensors, and orders metadata at
    /// random.
    fn table(&self, metadata: &Metadata) -> Result<Vec<u8>, serde_json::Error> {
        #[derive(serde::Serialize)]
        #[serde(untagged)]
        enum Entry<'a> {
            Metadata(BTreeMap<String, String>),
            Tensor { dtype: &'static str, shape: &'a [usize], data_offsets: [usize; 2] },
        }
        let mut entries = BTreeMap::new();
        let metadata = metadata.to_map()?;
        if !metadata.is_empty() {
            entries.insert("__metadata__", Entry::Metadata(metadata));
        }
        let mut at = 0;
        for (name, tensor) in self.iter() {
            let end = at + 4 * tensor.values.len();
            let (shape, data_offsets) = (tensor.shape.as_slice(), [at, end]);
            entries.insert(name, Entry::Tensor { dtype: "F32", shape, data_offsets });
            at = end;
        }
        let mut table = serde_json::to_vec(&entries)?;
        table.resize(table.len().next_multiple_of(8), b' ');
        Ok(table)
    }
}

/// The numbers of a tensor as f32, or nothing for types that are not read.
fn values(view: &TensorView<'_>) -> Option<Vec<f32>> {
    fn each<const N: usize>(data: &[u8], read: impl Fn([u8; N]) -> f32) -> Vec<f32> {
        data.as_chunks::<N>().0.iter().map(|bytes| read(*bytes)).collect()
    }
    let data = view.data();
    Some(match view.dtype() {
        Dtype::F32 => each(data, f32::from_le_bytes),
        Dtype::F64 => each(data, |b| f64::from_le_bytes(b) as f32),
        Dtype::BF16 => each(data, |b| f32::from_bits(u32::from(u16::from_le_bytes(b)) << 16)),
        Dtype::F16 => each(data, |b| burn::tensor::f16::from_le_bytes(b).to_f32()),
        Dtype::I64 => each(data, |b| i64::from_le_bytes(b) as f32),
        Dtype::I32 => each(data, |b| i32::from_le_bytes(b) as f32),
        Dtype::U8 | Dtype::BOOL => each(data, |[b]| f32::from(b)),
        _ => return None,
    })
}
