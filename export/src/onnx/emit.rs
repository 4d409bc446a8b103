//! Graphs to ONNX files.

use super::graph::{Attribute, Data, Elem, Graph, Node, Port, ValueId};
use super::proto::*;
use prost::Message as _;
use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};

/// ONNX operator set of the files written; the first with LayerNormalization.
pub const OPSET: i64 = 17;
const IR_VERSION: i64 = 8;

/// Tensors of less than this many bytes stay in the graph file: engines read shapes and scalars
/// while they build the graph, before external data is looked at.
const SMALLEST_EXTERNAL: usize = 256;

/// Weights of any number of graphs, stored once each.
#[derive(Clone, Debug)]
pub struct WeightStore {
    location: String,
    bytes: Vec<u8>,
    places: HashMap<u64, Vec<(usize, usize)>>,
}

impl WeightStore {
    /// Start of every tensor is a multiple of this many bytes.
    pub const ALIGN: usize = 64;

    /// An empty store that graphs will refer to by the file name `location`.
    pub fn new(location: &str) -> Self {
        Self { location: location.into(), bytes: Vec::new(), places: HashMap::new() }
    }

    /// Content of the file `location`.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The content, to keep.
    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    /// Where a tensor's bytes are, as its `external_data`; they are added unless equal ones are there.
    pub fn add(&mut self, raw: &[u8]) -> Vec<StringStringEntryProto> {
        let (offset, length) = self.place(raw);
        let entry = |key: &str, value: String| StringStringEntryProto {
            key: Some(key.into()),
            value: Some(value),
        };
        vec![
            entry("location", self.location.clone()),
            entry("offset", offset.to_string()),
            entry("length", length.to_string()),
        ]
    }

    /// Offset and length of bytes, which are added unless equal ones are there.
    fn place(&mut self, raw: &[u8]) -> (usize, usize) {
        let mut hasher = DefaultHasher::new();
        raw.hash(&mut hasher);
        let places = self.places.entry(hasher.finish()).or_default();
        let held = places.iter().find(|(at, len)| self.bytes[*at..*at + *len] == *raw);
        if let Some(place) = held {
            return *place;
        }
        let start = self.bytes.len().next_multiple_of(Self::ALIGN);
        self.bytes.resize(start, 0);
        self.bytes.extend_from_slice(raw);
        places.push((start, raw.len()));
        (start, raw.len())
    }
}

/// Where constants go.
#[derive(Debug)]
pub enum Storage<'a> {
    /// Into the model file.
    Inline,
    /// Floats of 256 bytes and more into one file beside it (ONNX external data).
    External(&'a mut WeightStore),
}

/// The ONNX file of a graph.
pub fn encode(graph: &Graph, storage: Storage<'_>) -> Vec<u8> {
    model(graph, storage).encode_to_vec()
}

/// The ONNX model of a graph.
pub fn model(graph: &Graph, mut storage: Storage<'_>) -> ModelProto {
    let initializer =
        graph.initialisers().into_iter().map(|id| tensor(graph, id, &mut storage)).collect();
    let ports = |ports: &[Port]| ports.iter().map(|p| port(graph, p)).collect();
    ModelProto {
        ir_version: Some(IR_VERSION),
        producer_name: Some(env!("CARGO_PKG_NAME").into()),
        producer_version: Some(env!("CARGO_PKG_VERSION").into()),
        doc_string: Some(graph.doc.clone()),
        graph: Some(GraphProto {
            node: graph.nodes.iter().map(|n| node(graph, n)).collect(),
            name: Some(graph.name.clone()),
            initializer,
            doc_string: Some(graph.doc.clone()),
            input: ports(&graph.inputs),
            output: ports(&graph.outputs),
        }),
        opset_import: vec![OperatorSetIdProto {
            domain: Some(String::new()),
            version: Some(OPSET),
        }],
        metadata_props: vec![],
    }
}

fn elem_type(elem: Elem) -> i32 {
    match elem {
        Elem::F32 => data_type::FLOAT,
        Elem::I64 => data_type::INT64,
        Elem::Bool => data_type::BOOL,
    }
}

fn tensor(graph: &Graph, id: ValueId, storage: &mut Storage<'_>) -> TensorProto {
    let value = graph.value(id);
    let mut proto = TensorProto {
        dims: value.dims.iter().map(|d| *d as i64).collect(),
        data_type: Some(elem_type(value.elem)),
        name: Some(value.name.clone()),
        ..TensorProto::default()
    };
    let raw = match (&value.constant, storage) {
        (Some(Data::F32(v)), Storage::External(store)) if v.len() * 4 >= SMALLEST_EXTERNAL => {
            let raw: Vec<u8> = v.iter().flat_map(|v| v.to_le_bytes()).collect();
            proto.external_data = store.add(&raw);
            proto.data_location = Some(DATA_LOCATION_EXTERNAL);
            return proto;
        }
        (Some(Data::F32(v)), _) => v.iter().flat_map(|v| v.to_le_bytes()).collect(),
        (Some(Data::I64(v)), _) => v.iter().flat_map(|v| v.to_le_bytes()).collect(),
        (Some(Data::Bool(v)), _) => v.iter().map(|v| u8::from(*v)).collect(),
        // `initialisers` answers constants only.
        (None, _) => Vec::new(),
    };
    proto.raw_data = Some(raw);
    proto
}

fn port(graph: &Graph, port: &Port) -> ValueInfoProto {
    let value = graph.value(port.value);
    let dim = value.dims.iter().map(|d| DimensionProto { dim_value: Some(*d as i64) }).collect();
    ValueInfoProto {
        name: Some(value.name.clone()),
        r#type: Some(TypeProto {
            tensor_type: Some(TensorTypeProto {
                elem_type: Some(elem_type(value.elem)),
                shape: Some(TensorShapeProto { dim }),
            }),
        }),
        doc_string: Some(port.doc.clone()),
    }
}

fn node(graph: &Graph, node: &Node) -> NodeProto {
    let name = |id: ValueId| graph.value(id).name.clone();
    NodeProto {
        input: node.inputs.iter().map(|i| i.map(name).unwrap_or_default()).collect(),
        output: vec![name(node.output)],
        name: Some(format!("{}:{}", node.op, name(node.output))),
        op_type: Some(node.op.into()),
        attribute: node.attributes.iter().map(|(name, value)| attribute(name, value)).collect(),
    }
}

fn attribute(name: &str, value: &Attribute) -> AttributeProto {
    let base = AttributeProto { name: Some(name.into()), ..AttributeProto::default() };
    match value {
        Attribute::Int(v) => {
            AttributeProto { i: Some(*v), r#type: Some(attribute_type::INT), ..base }
        }
        Attribute::Float(v) => {
            AttributeProto { f: Some(*v), r#type: Some(attribute_type::FLOAT), ..base }
        }
        Attribute::Ints(v) => {
            AttributeProto { ints: v.clone(), r#type: Some(attribute_type::INTS), ..base }
        }
        Attribute::Text(v) => AttributeProto {
            s: Some(v.as_bytes().to_vec()),
            r#type: Some(attribute_type::STRING),
            ..base
        },
    }
}
