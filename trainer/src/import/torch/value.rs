//! What a pickle describes, as plain data.

/// Place of a value in its [`Arena`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Id(pub(super) u32);

/// One Python value. Containers hold places, so values that are shared, or contain themselves,
/// cost nothing extra and nothing here ever recurses by itself.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    None,
    Bool(bool),
    Int(i128),
    /// An integer of more than 16 bytes; nobody asks for its value.
    HugeInt,
    Float(f64),
    Text(String),
    Bytes(Vec<u8>),
    Tuple(Vec<Id>),
    List(Vec<Id>),
    Set(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    /// A class or function, by name.
    Global {
        module: String,
        name: String,
    },
    /// What the file keeps outside the pickle: a storage.
    Persistent(Id),
    /// Any other object: which callable with which arguments would make it. Nothing is called.
    Object(Box<Object>),
}

/// How an object would be made.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Object {
    pub callee: Id,
    pub args: Id,
    /// States set on it afterwards, in order.
    pub states: Vec<Id>,
    /// Items set on it afterwards (it is a kind of dictionary).
    pub items: Vec<(Id, Id)>,
    /// Elements appended or added afterwards (it is a kind of list or set).
    pub elements: Vec<Id>,
}

/// Containers may nest this deep where they are converted to plain values.
const MAX_DEPTH: usize = 16;
/// Most values converted for one container.
const MAX_PLAIN: usize = 1000;

/// All values of a pickle.
#[derive(Debug)]
pub(super) struct Arena {
    pub(super) values: Vec<Value>,
}

impl Arena {
    pub(super) fn get(&self, id: Id) -> &Value {
        // Places only ever come from this arena.
        self.values.get(id.0 as usize).unwrap_or(&Value::None)
    }

    pub(super) fn text(&self, id: Id) -> Option<&str> {
        match self.get(id) {
            Value::Text(text) => Some(text),
            _ => None,
        }
    }

    /// An integer, plain or as a numpy scalar.
    pub(super) fn int(&self, id: Id) -> Option<i128> {
        match self.get(id) {
            Value::Int(v) => Some(*v),
            Value::Bool(v) => Some(i128::from(*v)),
            Value::Object(_) => match self.numpy_scalar(id)? {
                serde_json::Value::Number(n) => n.as_i64().map(i128::from),
                _ => None,
            },
            _ => None,
        }
    }

    /// Elements of a tuple or list, or of a `torch.Size` or other subclass.
    pub(super) fn sequence(&self, id: Id) -> Option<&[Id]> {
        match self.get(id) {
            Value::Tuple(items) | Value::List(items) => Some(items),
            Value::Object(object) => match self.get(object.args) {
                // `torch.Size((2, 3))`, a named tuple.
                Value::Tuple(args) if args.len() == 1 => match self.get(args[0]) {
                    Value::Tuple(items) | Value::List(items) => Some(items),
                    _ => None,
                },
                _ => None,
            },
            _ => None,
        }
    }

    /// Module and name of a class or function.
    pub(super) fn global(&self, id: Id) -> Option<(&str, &str)> {
        match self.get(id) {
            Value::Global { module, name } => Some((module, name)),
            _ => None,
        }
    }

    /// Callable and arguments an object would be made with.
    pub(super) fn call(&self, id: Id) -> Option<((&str, &str), &[Id])> {
        let Value::Object(object) = self.get(id) else { return None };
        let args = match self.get(object.args) {
            Value::Tuple(args) => args.as_slice(),
            _ => &[],
        };
        match (self.global(object.callee)?, args) {
            // How protocols 0 and 1 make objects: `_reconstructor(class, base, state)`.
            (("copyreg" | "copy_reg", "_reconstructor"), [class, ..]) => {
                Some((self.global(*class)?, &[]))
            }
            (callee, args) => Some((callee, args)),
        }
    }

    /// Items of a dictionary, or of an `OrderedDict`, `defaultdict` or other subclass.
    pub(super) fn items(&self, id: Id) -> Option<Vec<(Id, Id)>> {
        match self.get(id) {
            Value::Dict(items) => Some(items.clone()),
            Value::Object(object) => {
                let mut items = Vec::new();
                let ordered = self.call(id).is_some_and(|(callee, _)| {
                    matches!(callee, ("collections", "OrderedDict" | "defaultdict" | "Counter"))
                });
                if !ordered && object.items.is_empty() {
                    return None;
                }
                // Python 2 and copies give the items as argument: `OrderedDict([(k, v), ..])`.
                if let Some((_, [first, ..])) = self.call(id)
                    && let Some(pairs) = self.sequence(*first)
                {
                    for pair in pairs {
                        if let Some(&[key, value]) = self.sequence(*pair) {
                            items.push((key, value));
                        }
                    }
                }
                items.extend_from_slice(&object.items);
                Some(items)
            }
            _ => None,
        }
    }

    /// Value of a text key; the last one counts, as in Python.
    pub(super) fn entry(&self, id: Id, key: &str) -> Option<Id> {
        let items = self.items(id)?;
        items.iter().rev().find(|(k, _)| self.text(*k) == Some(key)).map(|(_, v)| *v)
    }

    /// Attributes of an object of a Python class: its state, or the dictionary in a
    /// `(dictionary, slots)` pair.
    pub(super) fn attribute(&self, id: Id, name: &str) -> Option<Id> {
        let Value::Object(object) = self.get(id) else { return None };
        object.states.iter().rev().find_map(|state| match self.get(*state) {
            Value::Tuple(parts) => parts.iter().find_map(|part| self.entry(*part, name)),
            _ => self.entry(*state, name),
        })
    }

    /// Python's name of the type.
    pub(super) fn type_name(&self, id: Id) -> String {
        match self.get(id) {
            Value::None => "None".into(),
            Value::Bool(_) => "bool".into(),
            Value::Int(_) | Value::HugeInt => "int".into(),
            Value::Float(_) => "float".into(),
            Value::Text(_) => "str".into(),
            Value::Bytes(_) => "bytes".into(),
            Value::Tuple(_) => "tuple".into(),
            Value::List(_) => "list".into(),
            Value::Set(_) => "set".into(),
            Value::Dict(_) => "dict".into(),
            Value::Global { module, name } => format!("{module}.{name}"),
            Value::Persistent(_) => "torch storage".into(),
            Value::Object(_) => match self.call(id) {
                Some(((module, name), _)) => format!("{module}.{name}"),
                None => "object".into(),
            },
        }
    }

    /// The value as JSON; what has no such form becomes its type's name in angle brackets, what is
    /// too long or too deep is cut.
    pub(super) fn plain(&self, id: Id) -> serde_json::Value {
        let mut budget = MAX_PLAIN;
        self.plain_at(id, MAX_DEPTH, &mut budget)
    }

    fn plain_at(&self, id: Id, depth: usize, budget: &mut usize) -> serde_json::Value {
        use serde_json::Value as Json;
        let other = || Json::String(format!("<{}>", self.type_name(id)));
        if depth == 0 || *budget == 0 {
            return Json::String("<..>".into());
        }
        *budget -= 1;
        match self.get(id) {
            Value::None => Json::Null,
            Value::Bool(v) => Json::Bool(*v),
            Value::Int(v) => i64::try_from(*v).map_or_else(|_| other(), Json::from),
            Value::Float(v) => Json::from(*v),
            Value::Text(v) => Json::String(v.clone()),
            Value::Tuple(items) | Value::List(items) | Value::Set(items) => {
                let shown = items.iter().take(*budget);
                Json::Array(shown.map(|i| self.plain_at(*i, depth - 1, budget)).collect())
            }
            Value::Dict(_) | Value::Object(_) => match self.items(id) {
                None => self.numpy_scalar(id).unwrap_or_else(other),
                Some(items) => {
                    let mut named = serde_json::Map::new();
                    for (key, value) in items.iter().take(*budget) {
                        if let Some(key) = self.text(*key) {
                            named.insert(key.into(), self.plain_at(*value, depth - 1, budget));
                        }
                    }
                    Json::Object(named)
                }
            },
            _ => other(),
        }
    }

    /// A numpy scalar: `scalar(dtype('<f8', ..), bytes)`.
    fn numpy_scalar(&self, id: Id) -> Option<serde_json::Value> {
        let (callee, args) = self.call(id)?;
        let (("numpy.core.multiarray" | "numpy._core.multiarray", "scalar"), [dtype, data]) =
            (callee, args)
        else {
            return None;
        };
        let (_, dtype_args) = self.call(*dtype)?;
        let name = self.text(*dtype_args.first()?)?;
        let bytes = self.bytes(*data)?;
        let exact = |n: usize| (bytes.len() == n).then_some(bytes.as_slice());
        let json = match name.trim_start_matches(['<', '=', '|']) {
            "i8" => i64::from_le_bytes(exact(8)?.try_into().ok()?).into(),
            "i4" => i32::from_le_bytes(exact(4)?.try_into().ok()?).into(),
            "i2" => i16::from_le_bytes(exact(2)?.try_into().ok()?).into(),
            "i1" => i8::from_le_bytes(exact(1)?.try_into().ok()?).into(),
            "u8" => u64::from_le_bytes(exact(8)?.try_into().ok()?).into(),
            "u4" => u32::from_le_bytes(exact(4)?.try_into().ok()?).into(),
            "u1" => exact(1)?[0].into(),
            "f8" => f64::from_le_bytes(exact(8)?.try_into().ok()?).into(),
            "f4" => f32::from_le_bytes(exact(4)?.try_into().ok()?).into(),
            "b1" => (exact(1)?[0] != 0).into(),
            _ => return None,
        };
        Some(json)
    }

    /// Bytes, also in the way Python 3 writes them for protocol 2: `encode(text, 'latin1')`.
    fn bytes(&self, id: Id) -> Option<Vec<u8>> {
        if let Value::Bytes(bytes) = self.get(id) {
            return Some(bytes.clone());
        }
        match self.call(id)? {
            (("_codecs", "encode"), [text, ..]) => {
                self.text(*text)?.chars().map(|c| u8::try_from(u32::from(c)).ok()).collect()
            }
            _ => None,
        }
    }
}
