//! The graph between recording and writing: ONNX operations with known shapes, easy to rewrite.

use std::collections::{HashMap, HashSet};

/// Index of a [`Value`] in its [`Graph`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ValueId(pub(crate) usize);

/// Element type of a tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Elem {
    /// 32-bit float.
    F32,
    /// 64-bit signed integer.
    I64,
    /// Boolean.
    Bool,
}

/// Elements of a constant, row-major.
#[derive(Clone, Debug, PartialEq)]
pub enum Data {
    /// 32-bit floats.
    F32(Vec<f32>),
    /// 64-bit signed integers.
    I64(Vec<i64>),
    /// Booleans.
    Bool(Vec<bool>),
}

impl Data {
    /// The element type.
    pub fn elem(&self) -> Elem {
        match self {
            Self::F32(_) => Elem::F32,
            Self::I64(_) => Elem::I64,
            Self::Bool(_) => Elem::Bool,
        }
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        match self {
            Self::F32(v) => v.len(),
            Self::I64(v) => v.len(),
            Self::Bool(v) => v.len(),
        }
    }

    /// Whether the elements are the same, bit by bit; -0 is not 0, a NaN is itself.
    pub(crate) fn same_as(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::F32(a), Self::F32(b)) => {
                a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
            }
            _ => self == other,
        }
    }

    /// Whether there are no elements.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The floats, if it holds floats.
    pub fn f32s(&self) -> Option<&[f32]> {
        match self {
            Self::F32(v) => Some(v),
            _ => None,
        }
    }

    /// The integers, if it holds integers.
    pub fn i64s(&self) -> Option<&[i64]> {
        match self {
            Self::I64(v) => Some(v),
            _ => None,
        }
    }
}

/// A tensor of the graph: an input, a constant, or what a node computes.
#[derive(Clone, Debug)]
pub struct Value {
    /// Name in the file; unique in the graph.
    pub name: String,
    /// Shape.
    pub dims: Vec<usize>,
    /// Element type.
    pub elem: Elem,
    /// The elements, where they are known.
    pub constant: Option<Data>,
}

/// An attribute of a node.
#[derive(Clone, Debug, PartialEq)]
pub enum Attribute {
    /// An integer.
    Int(i64),
    /// A float.
    Float(f32),
    /// A list of integers.
    Ints(Vec<i64>),
    /// A string.
    Text(&'static str),
}

/// One ONNX operation with a single output.
#[derive(Clone, Debug)]
pub struct Node {
    /// ONNX operator, opset 17.
    pub op: &'static str,
    /// Inputs; `None` where an optional one is left out.
    pub inputs: Vec<Option<ValueId>>,
    /// What it computes.
    pub output: ValueId,
    /// Attributes.
    pub attributes: Vec<(&'static str, Attribute)>,
}

impl Node {
    /// The input at `index`, if it is there.
    pub fn input(&self, index: usize) -> Option<ValueId> {
        self.inputs.get(index).copied().flatten()
    }

    /// The attribute `name`, if it is an integer.
    pub fn int(&self, name: &str) -> Option<i64> {
        match self.attribute(name) {
            Some(Attribute::Int(v)) => Some(*v),
            _ => None,
        }
    }

    /// The attribute `name`, if it is a list of integers.
    pub fn ints(&self, name: &str) -> Option<&[i64]> {
        match self.attribute(name) {
            Some(Attribute::Ints(v)) => Some(v),
            _ => None,
        }
    }

    /// The attribute `name`, if it is a float.
    pub fn float(&self, name: &str) -> Option<f32> {
        match self.attribute(name) {
            Some(Attribute::Float(v)) => Some(*v),
            _ => None,
        }
    }

    /// The attribute `name`.
    pub fn attribute(&self, name: &str) -> Option<&Attribute> {
        self.attributes.iter().find(|(n, _)| *n == name).map(|(_, v)| v)
    }
}

/// An input or output of a graph.
#[derive(Clone, Debug)]
pub struct Port {
    /// The tensor.
    pub value: ValueId,
    /// What it is, its layout and units; goes into the file.
    pub doc: String,
}

/// A computation with fixed shapes. Nodes are in execution order.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    /// Name of the graph.
    pub name: String,
    /// What it computes; goes into the file.
    pub doc: String,
    /// Every tensor, used or not.
    pub(crate) values: Vec<Value>,
    /// The operations.
    pub nodes: Vec<Node>,
    /// Inputs, in order.
    pub inputs: Vec<Port>,
    /// Outputs, in order.
    pub outputs: Vec<Port>,
    names: HashSet<String>,
}

impl Graph {
    /// An empty graph.
    pub fn new(name: &str, doc: &str) -> Self {
        Self { name: name.into(), doc: doc.into(), ..Self::default() }
    }

    /// A tensor of the graph.
    pub fn value(&self, id: ValueId) -> &Value {
        &self.values[id.0]
    }

    /// Shape of a tensor.
    pub fn dims(&self, id: ValueId) -> &[usize] {
        &self.values[id.0].dims
    }

    /// The elements of a tensor, where they are known.
    pub fn constant(&self, id: ValueId) -> Option<&Data> {
        self.values[id.0].constant.as_ref()
    }

    /// Adds a tensor; `name` is made unique.
    pub fn add_value(&mut self, name: &str, dims: &[usize], elem: Elem) -> ValueId {
        let name = self.unique(name);
        self.values.push(Value { name, dims: dims.to_vec(), elem, constant: None });
        ValueId(self.values.len() - 1)
    }

    /// Adds a constant; `name` is made unique.
    pub fn add_constant(&mut self, name: &str, dims: &[usize], data: Data) -> ValueId {
        let id = self.add_value(name, dims, data.elem());
        self.values[id.0].constant = Some(data);
        id
    }

    /// Exchanges the names of two tensors.
    pub(crate) fn swap_names(&mut self, a: ValueId, b: ValueId) {
        let name = std::mem::take(&mut self.values[a.0].name);
        self.values[a.0].name = std::mem::replace(&mut self.values[b.0].name, name);
    }

    /// Reads the same elements as a tensor of another shape.
    pub(crate) fn set_dims(&mut self, id: ValueId, dims: &[usize]) {
        self.values[id.0].dims = dims.to_vec();
    }

    pub(crate) fn set_constant(&mut self, id: ValueId, data: Data) {
        self.values[id.0].constant = Some(data);
    }

    fn unique(&mut self, name: &str) -> String {
        if self.names.insert(name.to_owned()) {
            return name.to_owned();
        }
        let mut n = 1usize;
        loop {
            let candidate = format!("{name}_{n}");
            if self.names.insert(candidate.clone()) {
                return candidate;
            }
            n += 1;
        }
    }

    /// Whether a tensor is an output of the graph.
    pub fn is_output(&self, id: ValueId) -> bool {
        self.outputs.iter().any(|p| p.value == id)
    }

    /// Index of the node that computes each tensor.
    pub fn producers(&self) -> HashMap<ValueId, usize> {
        self.nodes.iter().enumerate().map(|(i, n)| (n.output, i)).collect()
    }

    /// Number of reads of each tensor; being an output counts as one.
    pub fn uses(&self) -> HashMap<ValueId, usize> {
        let mut uses = HashMap::new();
        let reads = self.nodes.iter().flat_map(|n| n.inputs.iter().flatten());
        for id in reads.chain(self.outputs.iter().map(|p| &p.value)) {
            *uses.entry(*id).or_insert(0) += 1;
        }
        uses
    }

    /// Makes every reader of `old` read `new`. Outputs of the graph keep their tensor.
    pub fn redirect(&mut self, old: ValueId, new: ValueId) {
        for input in self.nodes.iter_mut().flat_map(|n| n.inputs.iter_mut()) {
            if *input == Some(old) {
                *input = Some(new);
            }
        }
    }

    /// Constants that nodes read, in order of first use: what the file has to hold.
    pub fn initialisers(&self) -> Vec<ValueId> {
        let computed: HashSet<ValueId> = self.nodes.iter().map(|n| n.output).collect();
        let mut seen = HashSet::new();
        self.nodes
            .iter()
            .flat_map(|n| n.inputs.iter().flatten())
            .copied()
            .filter(|id| self.constant(*id).is_some() && !computed.contains(id) && seen.insert(*id))
            .collect()
    }
}
