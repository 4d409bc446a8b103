//! Tensors of a checkpoint: views on storages.

use super::TorchError;
use super::value::{Arena, Id, Value};

/// Number types of storages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Dtype {
    F64,
    F32,
    F16,
    BF16,
    I64,
    I32,
    I16,
    I8,
    U8,
    Bool,
}

impl Dtype {
    /// Bytes of an element.
    pub fn size(self) -> u64 {
        match self {
            Self::F64 | Self::I64 => 8,
            Self::F32 | Self::I32 => 4,
            Self::F16 | Self::BF16 | Self::I16 => 2,
            Self::I8 | Self::U8 | Self::Bool => 1,
        }
    }

    /// By the class of a storage, `FloatStorage`, or a dtype, `float32`.
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "DoubleStorage" | "float64" => Self::F64,
            "FloatStorage" | "float32" => Self::F32,
            "HalfStorage" | "float16" => Self::F16,
            "BFloat16Storage" | "bfloat16" => Self::BF16,
            "LongStorage" | "int64" => Self::I64,
            "IntStorage" | "int32" => Self::I32,
            "ShortStorage" | "int16" => Self::I16,
            "CharStorage" | "int8" => Self::I8,
            "ByteStorage" | "uint8" => Self::U8,
            "BoolStorage" | "bool" => Self::Bool,
            _ => return None,
        })
    }

    /// One element as f32; `bytes` has [`Self::size`] bytes, little-endian.
    pub fn value(self, bytes: &[u8]) -> f32 {
        fn le<const N: usize>(bytes: &[u8]) -> [u8; N] {
            bytes.first_chunk().copied().unwrap_or([0; N])
        }
        match self {
            Self::F64 => f64::from_le_bytes(le(bytes)) as f32,
            Self::F32 => f32::from_le_bytes(le(bytes)),
            Self::F16 => burn::tensor::f16::from_le_bytes(le(bytes)).to_f32(),
            Self::BF16 => f32::from_bits(u32::from(u16::from_le_bytes(le(bytes))) << 16),
            Self::I64 => i64::from_le_bytes(le(bytes)) as f32,
            Self::I32 => i32::from_le_bytes(le(bytes)) as f32,
            Self::I16 => i16::from_le_bytes(le(bytes)).into(),
            Self::I8 => i8::from_le_bytes(le(bytes)).into(),
            Self::U8 => u8::from_le_bytes(le(bytes)).into(),
            Self::Bool => f32::from(u8::from(le::<1>(bytes)[0] != 0)),
        }
    }
}

/// A storage as the pickle names it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Storage {
    pub key: String,
    /// None for an untyped one.
    pub dtype: Option<Dtype>,
    /// Python's name of its class.
    pub class: String,
    /// First element, for old files whose storages are parts of others.
    pub offset: u64,
}

/// A view on a storage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct View {
    pub storage: String,
    pub dtype: Dtype,
    /// First element.
    pub offset: u64,
    pub shape: Vec<u64>,
    pub strides: Vec<u64>,
}

impl View {
    /// Number of elements; nothing for more than a u64 holds.
    pub fn elements(&self) -> Option<u64> {
        self.shape.iter().try_fold(1u64, |n, d| n.checked_mul(*d))
    }

    /// Elements of the storage from [`Self::offset`] to the last one used.
    pub fn reach(&self) -> Option<u64> {
        if self.shape.contains(&0) {
            return Some(0);
        }
        let steps = self.shape.iter().zip(&self.strides);
        steps.clone().try_fold(1u64, |n, (d, s)| n.checked_add((d - 1).checked_mul(*s)?))
    }

    /// Is it row-major without gaps?
    fn contiguous(&self) -> bool {
        let mut expected = 1u64;
        self.shape.iter().zip(&self.strides).rev().all(|(d, s)| {
            let fits = *d == 1 || *s == expected;
            expected = u64::saturating_mul(expected, (*d).max(1));
            fits
        })
    }

    /// Row-major values from the bytes between offset and reach. Sizes were checked by the caller.
    pub fn gather(&self, bytes: &[u8]) -> Vec<f32> {
        let size = self.dtype.size() as usize;
        if self.contiguous() {
            return bytes.chunks_exact(size).map(|b| self.dtype.value(b)).collect();
        }
        let elements = self.elements().unwrap_or(0) as usize;
        let mut values = Vec::with_capacity(elements);
        let mut index = vec![0u64; self.shape.len()];
        for _ in 0..elements {
            let at: u64 = index.iter().zip(&self.strides).map(|(i, s)| i * s).sum();
            let at = at as usize * size;
            values.push(bytes.get(at..at + size).map_or(0.0, |b| self.dtype.value(b)));
            for (i, d) in index.iter_mut().zip(&self.shape).rev() {
                *i += 1;
                if *i < *d {
                    break;
                }
                *i = 0;
            }
        }
        values
    }
}

/// Most axes of a tensor.
const MAX_AXES: usize = 16;

impl Arena {
    /// The storage a persistent id names: `("storage", class, key, device, elements[, part])`.
    pub(super) fn storage(&self, id: Id) -> Option<Storage> {
        let Value::Persistent(inner) = self.get(id) else { return None };
        let fields = self.sequence(*inner)?;
        let (kind, class, key) = (fields.first()?, fields.get(1)?, fields.get(2)?);
        if self.text(*kind) != Some("storage") {
            return None;
        }
        let (_, name) = self.global(*class)?;
        let key = match self.get(*key) {
            Value::Text(key) => key.clone(),
            Value::Int(key) => key.to_string(),
            _ => return None,
        };
        let part = fields.get(5).and_then(|part| self.sequence(*part));
        let offset = part.and_then(|p| self.int(*p.get(1)?)).unwrap_or(0);
        Some(Storage {
            key,
            dtype: Dtype::from_name(name),
            class: name.into(),
            offset: u64::try_from(offset).ok()?,
        })
    }

    /// The tensor a value stands for; nothing when it is none.
    ///
    /// # Errors
    /// When it is a tensor that cannot be read: number type, broken arguments.
    pub(super) fn tensor(&self, id: Id) -> Option<Result<View, String>> {
        // Parameters wrap tensors; a handful of levels is all that exists.
        self.tensor_at(id, 4)
    }

    fn tensor_at(&self, id: Id, depth: usize) -> Option<Result<View, String>> {
        let (callee, args) = self.call(id)?;
        let depth = depth.checked_sub(1)?;
        match callee {
            ("torch._utils", "_rebuild_parameter" | "_rebuild_parameter_with_state") => {
                self.tensor_at(*args.first()?, depth)
            }
            ("torch.nn.parameter", "Parameter" | "Buffer") => self.tensor_at(*args.first()?, depth),
            ("torch._tensor", "_rebuild_from_type_v2") => {
                let (function, inner) = (args.first()?, args.get(2)?);
                Some(self.rebuild(self.global(*function)?, self.sequence(*inner)?))
            }
            ("torch._utils", name) if name.starts_with("_rebuild_") => {
                Some(self.rebuild(callee, args))
            }
            _ => None,
        }
    }

    fn rebuild(&self, (_, function): (&str, &str), args: &[Id]) -> Result<View, String> {
        let dtype = match function {
            "_rebuild_tensor" | "_rebuild_tensor_v2" => None,
            "_rebuild_tensor_v3" => args.get(6).and_then(|d| self.global(*d)),
            _ => return Err(format!("it is made with {function}; only dense tensors are read")),
        };
        let broken = || format!("its description ({function}) is not understood");
        let [storage, offset, shape, strides, ..] = args else { return Err(broken()) };
        let storage = self.storage(*storage).ok_or_else(broken)?;
        let dtype = match dtype {
            Some((_, name)) => Dtype::from_name(name)
                .ok_or_else(|| format!("its number type {name} is not read"))?,
            None => storage
                .dtype
                .ok_or_else(|| format!("its number type {} is not read", storage.class))?,
        };
        let sizes = |id: Id| -> Option<Vec<u64>> {
            let axes = self.sequence(id)?;
            if axes.len() > MAX_AXES {
                return None;
            }
            axes.iter().map(|i| u64::try_from(self.int(*i)?).ok()).collect()
        };
        let (shape, strides) =
            (sizes(*shape).ok_or_else(broken)?, sizes(*strides).ok_or_else(broken)?);
        let offset = self.int(*offset).and_then(|o| u64::try_from(o).ok()).ok_or_else(broken)?;
        let offset = offset.checked_add(storage.offset).ok_or_else(broken)?;
        if shape.len() != strides.len() {
            return Err(broken());
        }
        Ok(View { storage: storage.key, dtype, offset, shape, strides })
    }

    /// All storages the pickle names.
    pub(super) fn storages(&self) -> impl Iterator<Item = Storage> {
        (0..self.values.len()).filter_map(|i| self.storage(Id(i as u32)))
    }
}

/// What is wrong with a tensor, with its name.
pub(super) fn tensor_error(name: &str, reason: impl Into<String>) -> TorchError {
    TorchError::Tensor { tensor: name.into(), reason: reason.into() }
}
