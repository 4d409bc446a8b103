//! PyTorch files (`torch.save`), read without PyTorch and without running anything in them.
//!
//! burn-store has a reader of its own (`pytorch-reader`), but it drops what unknown classes carry,
//! and pytracking keeps the filter size (quirk Q1) inside an object of one; and it refuses files
//! with such an object around a tensor, as pytracking's statistics are. So this is a reader for
//! checkpoints: everything in the pickle stays readable as plain data, tensors are read on demand.
//!
//! * `pickle`: all opcodes of protocols 0 to 5, to an arena of values; limits on size;
//! * `zip`: the container of PyTorch 1.6 and later;
//! * `tensor`: views on storages, with offsets and strides;
//! * [`TorchFile`]: both containers (also the older stream of pickles), weights, constructor.

mod pickle;
mod tensor;
#[cfg(test)]
mod tests;
mod value;
mod zip;

#[cfg(test)]
pub(super) use tests::check_folder;

use super::{StateDict, StateTensor};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io::{Read, Seek, SeekFrom};
use tensor::{View, tensor_error};
use value::{Arena, Id, Value};

/// A PyTorch file that cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TorchError {
    /// The system could not read it.
    #[error("cannot read the PyTorch file: {0}")]
    Io(#[source] std::io::Error),
    /// The container is cut short or altered.
    #[error("damaged PyTorch file: {reason}")]
    Damaged {
        /// What is wrong.
        reason: String,
    },
    /// The pickle is cut short, altered or beyond the limits.
    #[error("damaged PyTorch file: pickle, byte {offset}: {reason}")]
    Pickle {
        /// Bytes from the start of the pickle.
        offset: u64,
        /// What is wrong.
        reason: String,
    },
    /// A kind of file that is not read.
    #[error("{what}; {help}")]
    Unsupported {
        /// What it is.
        what: String,
        /// What to do.
        help: &'static str,
    },
    /// A tensor that cannot be read.
    #[error("tensor {tensor}: {reason}")]
    Tensor {
        /// Its name.
        tensor: String,
        /// What is wrong.
        reason: String,
    },
    /// No state dict is in it.
    #[error("no state dict (names with tensors) is in the PyTorch file; its root is {root}")]
    NoWeights {
        /// Type, and keys of a dictionary.
        root: String,
    },
}

/// Container of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TorchFormat {
    /// Zip archive, PyTorch 1.6 and later.
    Zip,
    /// Stream of pickles with the storages behind, `_use_new_zipfile_serialization=False`.
    Legacy,
}

impl std::fmt::Display for TorchFormat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Zip => "PyTorch zip file",
            Self::Legacy => "PyTorch legacy pickle",
        })
    }
}

/// How a network was made, as pytracking notes it beside the weights.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Constructor {
    /// Name of the function, as in `tompnet101`.
    pub function: String,
    /// Module of the function.
    pub module: String,
    /// Positional arguments.
    pub args: Vec<serde_json::Value>,
    /// Named arguments.
    pub kwargs: BTreeMap<String, serde_json::Value>,
}

/// The state dict of a file and what was found beside it.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// Container.
    pub format: TorchFormat,
    /// Key of the state dict, as in `net` or `checkpoint.state_dict`; none when it is the root.
    pub key: Option<String>,
    /// Its tensors.
    pub dict: StateDict,
    /// Entries of the state dict that are no tensors: name and Python type.
    pub others: Vec<(String, String)>,
    /// Names with one storage: the first one of each group, then its aliases.
    pub ties: Vec<Vec<String>>,
    /// Keys beside the state dict that were not read, with their Python type.
    pub beside: Vec<(String, String)>,
    /// The network's constructor, in pytracking files.
    pub constructor: Option<Constructor>,
}

/// Bytes of a storage in the file.
#[derive(Clone, Copy, Debug)]
struct Extent {
    offset: u64,
    length: u64,
    /// CRC-32, when the container has one.
    crc: Option<u32>,
}

enum Container {
    Zip { entries: BTreeMap<String, zip::Entry>, root: String },
    Legacy { storages: HashMap<String, Extent> },
}

/// An open PyTorch file: the pickle is read, tensors are not.
pub struct TorchFile<R> {
    input: R,
    length: u64,
    container: Container,
    arena: Arena,
    root: Id,
}

/// Does a file that starts so come from PyTorch? 16 bytes are enough.
pub fn is_torch(start: &[u8]) -> bool {
    // safetensors: length of the table, then `{`; that length may look like an opcode.
    let safetensors = start.get(8) == Some(&b'{') && start.get(6..8) == Some(&[0, 0]);
    start.starts_with(b"PK")
        || (start.starts_with(&[0x80]) && !safetensors)
        || start.starts_with(b"L1195")
}

/// `torch.save`'s mark at the start of legacy files.
const LEGACY_MAGIC: i128 = 0x1950_a86a_20f9_469c_fc6c;
const LEGACY_PROTOCOL: i128 = 1001;
/// Where state dicts live in checkpoints, in order of preference.
const WEIGHT_KEYS: [&str; 7] =
    ["net", "state_dict", "model_state_dict", "model", "net_state_dict", "module", "weights"];
/// How deep state dicts are looked for, and modules may nest.
const MAX_DEPTH: usize = 8;
/// Most entries of a state dict.
const MAX_TENSORS: usize = 100_000;
/// Most modules of a network that was pickled whole.
const MAX_MODULES: usize = 10_000;
/// Keys of a dictionary among which state dicts are looked for.
const MAX_KEYS: usize = 200;
/// Views may repeat elements (`expand`) and share storages; beyond this many bytes all of them
/// together may take no more than four times the length of the file.
const MAX_REPEATED: u64 = 16 << 20;

fn damaged(reason: impl Into<String>) -> TorchError {
    TorchError::Damaged { reason: reason.into() }
}

fn big_endian() -> TorchError {
    TorchError::Unsupported {
        what: "the file was written on a big-endian machine".into(),
        help: "load it there and save it with torch.save under a little-endian PyTorch, or as safetensors",
    }
}

impl<R: Read + Seek> TorchFile<R> {
    /// Reads the pickle and the table of contents.
    ///
    /// # Errors
    /// When it is no PyTorch file, or a damaged one.
    pub fn open(mut input: R) -> Result<Self, TorchError> {
        let length = input.seek(SeekFrom::End(0)).map_err(TorchError::Io)?;
        input.rewind().map_err(TorchError::Io)?;
        let mut start = [0; 4];
        let zipped = length >= 4 && {
            input.read_exact(&mut start).map_err(TorchError::Io)?;
            input.rewind().map_err(TorchError::Io)?;
            start.starts_with(b"PK")
        };
        if zipped { Self::open_zip(input, length) } else { Self::open_legacy(input, length) }
    }

    fn open_zip(mut input: R, length: u64) -> Result<Self, TorchError> {
        let entries = zip::directory(&mut input, length)?;
        let root = entries
            .keys()
            .find_map(|name| name.strip_suffix("data.pkl"))
            .filter(|root| root.is_empty() || root.ends_with('/'))
            .ok_or_else(|| TorchError::Unsupported {
                what: "a zip file without data.pkl".into(),
                help: "files of torch.save have one; unpack other archives first",
            })?
            .to_owned();
        let mut whole = |name: &str, most: u64| -> Result<Option<Vec<u8>>, TorchError> {
            let Some(entry) = entries.get(&format!("{root}{name}")) else { return Ok(None) };
            if entry.length > most {
                return Err(damaged(format!(
                    "{name} has {} bytes, at most {most} are read",
                    entry.length
                )));
            }
            let at = zip::data_start(&mut input, length, entry)?;
            let bytes = zip::read_at(&mut input, length, at, entry.length)?;
            if entry.crc != 0 && crc32fast::hash(&bytes) != entry.crc {
                return Err(damaged(format!(
                    "the checksum of {name} is wrong; fetch the file again"
                )));
            }
            Ok(Some(bytes))
        };
        if whole("byteorder", 64)?.is_some_and(|order| order.trim_ascii() == b"big") {
            return Err(big_endian());
        }
        let pickled = whole("data.pkl", pickle::MAX_BYTES)?.unwrap_or_default();
        let (arena, value) = pickle::read(&mut pickled.as_slice())?;
        let container = Container::Zip { entries, root };
        Ok(Self { input, length, container, arena, root: value })
    }

    fn open_legacy(input: R, length: u64) -> Result<Self, TorchError> {
        let mut input = std::io::BufReader::new(input);
        let no_torch_file = || TorchError::Unsupported {
            what: "neither a PyTorch file nor safetensors".into(),
            help: "files of torch.save (zip or legacy) and safetensors are read",
        };
        let (arena, magic) = pickle::read(&mut input).map_err(|e| match e {
            TorchError::Io(e) => TorchError::Io(e),
            _ => no_torch_file(),
        })?;
        if arena.int(magic) != Some(LEGACY_MAGIC) {
            return Err(no_torch_file());
        }
        let (arena, protocol) = pickle::read(&mut input)?;
        if arena.int(protocol) != Some(LEGACY_PROTOCOL) {
            return Err(TorchError::Unsupported {
                what: format!("legacy protocol {:?}", arena.get(protocol)),
                help: "load the file in PyTorch and save it again",
            });
        }
        let (arena, system) = pickle::read(&mut input)?;
        match arena.entry(system, "little_endian").map(|id| arena.get(id)) {
            Some(Value::Bool(true)) => {}
            Some(Value::Bool(false)) => return Err(big_endian()),
            _ => return Err(damaged("its system information does not say the byte order")),
        }
        let (arena, root) = pickle::read(&mut input)?;
        let (keys_arena, keys) = pickle::read(&mut input)?;
        let keys = keys_arena
            .sequence(keys)
            .ok_or_else(|| damaged("its list of storages is missing"))?
            .iter()
            .map(|key| keys_arena.text(*key).map(str::to_owned))
            .collect::<Option<Vec<_>>>()
            .ok_or_else(|| damaged("its list of storages holds what is no name"))?;
        let sizes: HashMap<String, u64> =
            arena.storages().map(|s| (s.key, s.dtype.map_or(1, tensor::Dtype::size))).collect();
        // Every storage: number of elements, then their bytes.
        let mut storages = HashMap::new();
        let mut at = input.stream_position().map_err(TorchError::Io)?;
        for key in keys {
            let size = *sizes
                .get(&key)
                .ok_or_else(|| damaged(format!("storage {key} belongs to no tensor")))?;
            let count = zip::read_at(&mut input, length, at, 8)?;
            let count = u64::from_le_bytes(count.try_into().unwrap_or([0xff; 8]));
            let extent = count
                .checked_mul(size)
                .filter(|bytes| at.checked_add(8 + bytes).is_some_and(|end| end <= length))
                .map(|length| Extent { offset: at + 8, length, crc: None })
                .ok_or_else(|| {
                    damaged(format!(
                        "storage {key} goes beyond the end of the file; fetch it again"
                    ))
                })?;
            at = extent.offset + extent.length;
            storages.insert(key, extent);
        }
        let container = Container::Legacy { storages };
        Ok(Self { input: input.into_inner(), length, container, arena, root })
    }

    /// Container of the file.
    pub fn format(&self) -> TorchFormat {
        match self.container {
            Container::Zip { .. } => TorchFormat::Zip,
            Container::Legacy { .. } => TorchFormat::Legacy,
        }
    }

    fn extent(&mut self, key: &str) -> Result<Option<Extent>, TorchError> {
        match &self.container {
            Container::Legacy { storages } => Ok(storages.get(key).copied()),
            Container::Zip { entries, root } => {
                let Some(entry) = entries.get(&format!("{root}data/{key}")) else {
                    return Ok(None);
                };
                let offset = zip::data_start(&mut self.input, self.length, entry)?;
                // `compute_crc32=False` writes 0.
                let crc = (entry.crc != 0).then_some(entry.crc);
                Ok(Some(Extent { offset, length: entry.length, crc }))
            }
        }
    }

    /// Values of a view; reads only its part of the storage.
    fn read(&mut self, name: &str, view: &View) -> Result<Vec<f32>, TorchError> {
        let error = |reason: String| tensor_error(name, reason);
        let extent = self.extent(&view.storage)?.ok_or_else(|| {
            error(format!("its storage {} is not in the file; fetch the file again", view.storage))
        })?;
        let size = view.dtype.size();
        let beyond = || error(format!("shape {:?} does not fit its storage", view.shape));
        let start = view.offset.checked_mul(size).ok_or_else(beyond)?;
        let bytes = view.reach().and_then(|r| r.checked_mul(size)).ok_or_else(beyond)?;
        if start.checked_add(bytes).is_none_or(|end| end > extent.length) {
            return Err(beyond());
        }
        let raw = zip::read_at(&mut self.input, self.length, extent.offset + start, bytes)?;
        if let Some(crc) = extent.crc
            && bytes == extent.length
            && crc32fast::hash(&raw) != crc
        {
            return Err(error("its checksum is wrong; fetch the file again".into()));
        }
        Ok(view.gather(&raw))
    }

    /// Entries of a state dict, or of a module saved whole: names and places.
    fn named(&self, id: Id) -> Vec<(String, Id)> {
        if let Some(items) = self.arena.items(id) {
            let name = |key: Id| match self.arena.text(key) {
                Some(text) => text.to_owned(),
                None => format!("<{}>", self.arena.type_name(key)),
            };
            return items.into_iter().map(|(key, value)| (name(key), value)).collect();
        }
        let (mut entries, mut budget) = (Vec::new(), MAX_MODULES);
        self.module(id, "", MAX_DEPTH, &mut budget, &mut entries);
        entries
    }

    /// Parameters and buffers of a `torch.nn.Module` that was pickled whole. `budget` bounds the work
    /// where modules hold themselves.
    fn module(
        &self,
        id: Id,
        prefix: &str,
        depth: usize,
        budget: &mut usize,
        out: &mut Vec<(String, Id)>,
    ) {
        let Some(depth) = depth.checked_sub(1) else { return };
        let table = |name| {
            let table = self.arena.attribute(id, name).and_then(|t| self.arena.items(t));
            table.unwrap_or_default().into_iter()
        };
        for (key, value) in table("_parameters").chain(table("_buffers")) {
            if let Some(key) = self.arena.text(key)
                && *self.arena.get(value) != Value::None
            {
                out.push((format!("{prefix}{key}"), value));
            }
        }
        for (key, value) in table("_modules") {
            let Some(left) = budget.checked_sub(1) else { return };
            *budget = left;
            if let Some(key) = self.arena.text(key) {
                self.module(value, &format!("{prefix}{key}."), depth, budget, out);
            }
        }
    }

    fn tensors_in(&self, id: Id) -> usize {
        self.named(id).iter().filter(|(_, value)| self.arena.tensor(*value).is_some()).count()
    }

    /// The state dict: path of keys and place.
    fn weights(&self) -> Result<(Vec<String>, Id), TorchError> {
        let mut at = self.root;
        let mut path = Vec::new();
        for _ in 0..4 {
            if self.tensors_in(at) > 0 {
                return Ok((path, at));
            }
            let with_tensors: Vec<(String, Id)> = self
                .arena
                .items(at)
                .unwrap_or_default()
                .into_iter()
                .take(MAX_KEYS)
                .filter_map(|(key, value)| Some((self.arena.text(key)?.to_owned(), value)))
                .filter(|(key, value)| {
                    self.tensors_in(*value) > 0 || WEIGHT_KEYS.contains(&key.as_str())
                })
                .collect();
            let known = WEIGHT_KEYS
                .iter()
                .find_map(|key| with_tensors.iter().find(|(name, _)| name == key));
            let next = match (known, with_tensors.as_slice()) {
                (Some(known), _) => known,
                (None, [only]) => only,
                _ => break,
            };
            path.push(next.0.clone());
            at = next.1;
        }
        let keys = self.named(self.root);
        let keys: Vec<&str> = keys.iter().take(20).map(|(key, _)| key.as_str()).collect();
        let root = format!("{} {keys:?}", self.arena.type_name(self.root));
        Err(TorchError::NoWeights { root })
    }

    /// Reads the state dict and what is beside it.
    ///
    /// # Errors
    /// When there is none, or a tensor in it cannot be read.
    pub fn checkpoint(&mut self) -> Result<Checkpoint, TorchError> {
        let (path, place) = self.weights()?;
        let entries = self.named(place);
        if entries.len() > MAX_TENSORS {
            return Err(damaged(format!("a state dict of {} entries", entries.len())));
        }
        let mut checkpoint = Checkpoint {
            format: self.format(),
            key: (!path.is_empty()).then(|| path.join(".")),
            dict: StateDict::default(),
            others: Vec::new(),
            ties: Vec::new(),
            beside: Vec::new(),
            constructor: self.constructor(),
        };
        let mut views: Vec<(View, Vec<String>)> = Vec::new();
        let mut known: HashMap<(String, u64, Vec<u64>), usize> = HashMap::new();
        // However often tensors share a storage, memory stays in proportion to the file.
        let mut budget = self.length.saturating_mul(4).saturating_add(MAX_REPEATED);
        let mut seen = BTreeSet::new();
        // The last value of a name counts, as in Python.
        for (name, id) in entries.into_iter().rev() {
            if !seen.insert(name.clone()) {
                continue;
            }
            let Some(view) = self.arena.tensor(id) else {
                checkpoint.others.push((name, self.arena.type_name(id)));
                continue;
            };
            let view = view.map_err(|reason| tensor_error(&name, reason))?;
            budget = view
                .elements()
                .and_then(|n| budget.checked_sub(n.checked_mul(4)?))
                .ok_or_else(|| tensor_error(&name, "the tensors are larger than the file"))?;
            let values = self.read(&name, &view)?;
            let shape = view.shape.iter().map(|d| *d as usize).collect();
            checkpoint.dict.insert(name.clone(), StateTensor { shape, values });
            let key = (view.storage.clone(), view.offset, view.shape.clone());
            match known.get(&key) {
                Some(group) => views[*group].1.push(name),
                None => {
                    known.insert(key, views.len());
                    views.push((view, vec![name]));
                }
            }
        }
        checkpoint.others.reverse();
        for (view, mut names) in views {
            if names.len() > 1 && view.elements() != Some(0) {
                names.sort();
                checkpoint.ties.push(names);
            }
        }
        checkpoint.ties.sort();
        if let Some(first) = path.first() {
            checkpoint.beside = self
                .named(self.root)
                .into_iter()
                .filter(|(key, _)| key != first && key != "constructor")
                .map(|(key, id)| (key, self.arena.type_name(id)))
                .collect();
        }
        Ok(checkpoint)
    }

    /// pytracking's `constructor`: an object whose attributes name a function and its arguments.
    fn constructor(&self) -> Option<Constructor> {
        let object = self.arena.entry(self.root, "constructor")?;
        let text = |name| {
            let id = self.arena.attribute(object, name)?;
            self.arena.text(id).map(str::to_owned)
        };
        let args = self.arena.attribute(object, "args").and_then(|id| self.arena.sequence(id));
        let kwargs = ["kwds", "kwargs"]
            .iter()
            .find_map(|name| self.arena.items(self.arena.attribute(object, name)?));
        Some(Constructor {
            function: text("fun_name").unwrap_or_default(),
            module: text("fun_module").unwrap_or_default(),
            args: args.unwrap_or_default().iter().map(|id| self.arena.plain(*id)).collect(),
            kwargs: kwargs
                .unwrap_or_default()
                .iter()
                .filter_map(|(k, v)| Some((self.arena.text(*k)?.to_owned(), self.arena.plain(*v))))
                .collect(),
        })
    }
}
