//! Which products become products of bytes, and the ONNX files that say so.

use super::QuantizeError;
use super::calibrate::{Rounding, Roundings};
use crate::onnx::proto::*;
use crate::onnx::{WeightStore, macs};
use prost::Message as _;
use std::collections::{BTreeMap, HashMap, HashSet};
use tsda_runtime::bundle::{Bundle, SectionKind, WEIGHTS_FILE};

/// Largest magnitude of a 16-bit float.
const HALF_MAX: f32 = 65504.0;
/// Tensors of fewer elements stay 32 bits wide.
const SMALLEST_HALF: usize = 256;

/// A graph of a bundle.
#[derive(Clone, Debug)]
pub struct File {
    /// Which one.
    pub kind: SectionKind,
    /// Its file.
    pub model: ModelProto,
}

/// A product with constant weights.
#[derive(Clone, Debug, PartialEq)]
pub struct Product {
    /// Index of its graph.
    pub file: usize,
    /// Index of its node.
    node: usize,
    /// Name of its node.
    pub name: String,
    /// Its input.
    pub input: String,
    /// Its weights.
    weights: String,
    /// Dimension of the weights that is that of its output channels.
    axis: usize,
    /// Multiply-accumulates of one run.
    pub macs: u64,
    /// Why it stays in floats.
    pub kept: Option<&'static str>,
}

/// The graphs of a bundle, in file order.
///
/// # Errors
/// When one holds what this program does not write: it could not be rewritten without loss.
pub fn read(bundle: &Bundle<'_>) -> Result<Vec<File>, QuantizeError> {
    let graphs = bundle
        .sections()
        .filter(|(kind, _)| !matches!(kind, SectionKind::Weights | SectionKind::Probe));
    graphs
        .map(|(kind, bytes)| {
            let foreign = |reason: String| QuantizeError::Graph { kind, reason };
            let model = ModelProto::decode(bytes).map_err(|e| foreign(e.to_string()))?;
            if model.encode_to_vec() != bytes {
                return Err(foreign("it has fields that are not known here".into()));
            }
            let nodes = model.graph.iter().flat_map(|g| &g.node);
            for node in nodes {
                let op = node.op_type.as_deref().unwrap_or_default();
                if matches!(op, "QuantizeLinear" | "DequantizeLinear" | "Cast") {
                    let name = node.name.as_deref().unwrap_or_default();
                    return Err(foreign(format!("node `{name}` ({op}) is narrow already")));
                }
            }
            Ok(File { kind, model })
        })
        .collect()
}

impl File {
    fn graph(&self) -> Result<&GraphProto, QuantizeError> {
        let missing =
            || QuantizeError::Graph { kind: self.kind, reason: "the file holds no graph".into() };
        self.model.graph.as_ref().ok_or_else(missing)
    }

    /// The file with more outputs.
    ///
    /// # Errors
    /// When a shape cannot be told.
    pub fn with_outputs(&self, names: &[String]) -> Result<Vec<u8>, QuantizeError> {
        let mut model = self.model.clone();
        let shapes = macs::shapes(self.graph()?)?;
        if let Some(graph) = &mut model.graph {
            for name in names {
                if graph.output.iter().any(|o| o.name.as_ref() == Some(name)) {
                    continue;
                }
                let dims = shapes.get(name).map(Vec::as_slice).unwrap_or_default();
                let side = |d: &usize| DimensionProto { dim_value: Some(*d as i64) };
                let shape = TensorShapeProto { dim: dims.iter().map(side).collect() };
                graph.output.push(ValueInfoProto {
                    name: Some(name.clone()),
                    r#type: Some(TypeProto {
                        tensor_type: Some(TensorTypeProto {
                            elem_type: Some(data_type::FLOAT),
                            shape: Some(shape),
                        }),
                    }),
                    doc_string: None,
                });
            }
        }
        Ok(model.encode_to_vec())
    }
}

/// All products with constant weights. In floats stay: the first convolution, the last products
/// before an output, the template graph (it runs once per memory write), those of fewer than
/// `smallest` multiply-accumulates, and those named in `keep`, by node or by layer.
///
/// # Errors
/// When a name in `keep` is that of no product, or shapes cannot be told.
pub fn choose(
    files: &[File],
    keep: &[String],
    smallest: u64,
) -> Result<Vec<Product>, QuantizeError> {
    let mut all = Vec::new();
    for (index, file) in files.iter().enumerate() {
        all.extend(products(index, file, smallest)?);
    }
    let named = |p: &Product, name: &str| {
        let output = p.name.split_once(':').map_or(&*p.name, |(_, output)| output);
        p.name == name || output == name || macs::layer(output) == name
    };
    if let Some(name) = keep.iter().find(|name| !all.iter().any(|p| named(p, name))) {
        return Err(QuantizeError::Keep { name: name.clone() });
    }
    for product in &mut all {
        if keep.iter().any(|name| named(product, name)) {
            product.kept = Some("named");
        }
    }
    Ok(all)
}

fn products(index: usize, file: &File, smallest: u64) -> Result<Vec<Product>, QuantizeError> {
    let graph = file.graph()?;
    let macs: HashMap<String, u64> =
        macs::count_model(&file.model)?.into_iter().map(|m| (m.name, m.macs)).collect();
    let constants: HashMap<&str, &TensorProto> =
        graph.initializer.iter().filter_map(|t| Some((t.name.as_deref()?, t))).collect();
    let last = last_products(graph, &constants);
    let mut found = Vec::new();
    for (at, node) in graph.node.iter().enumerate() {
        let (Some(weights), Some(output)) =
            (constant_weights(node, &constants), node.output.first())
        else {
            continue;
        };
        let macs = macs.get(output).copied().unwrap_or(0);
        let conv = node.op_type.as_deref() == Some("Conv");
        let kept = if file.kind == SectionKind::TemplateOnnx {
            Some("template graph")
        } else if conv && node.input.first().is_some_and(|x| x == "crop") {
            Some("first layer")
        } else if last.contains(&at) {
            Some("last layer")
        } else if macs < smallest {
            Some("small")
        } else {
            None
        };
        found.push(Product {
            file: index,
            node: at,
            name: node.name.clone().unwrap_or_default(),
            input: node.input.first().cloned().unwrap_or_default(),
            weights: weights.name.clone().unwrap_or_default(),
            axis: usize::from(!conv),
            macs,
            kept,
        });
    }
    Ok(found)
}

/// Weights of a product that can be one of bytes: floats, all input channels together.
fn constant_weights<'g>(
    node: &NodeProto,
    constants: &HashMap<&str, &'g TensorProto>,
) -> Option<&'g TensorProto> {
    let weights = constants.get(node.input.get(1)?.as_str())?;
    let grouped = |a: &AttributeProto| a.name.as_deref() == Some("group") && a.i != Some(1);
    let fits = match node.op_type.as_deref()? {
        "Conv" => weights.dims.len() == 4 && !node.attribute.iter().any(grouped),
        "MatMul" => weights.dims.len() == 2,
        _ => false,
    };
    let variable = !constants.contains_key(node.input.first()?.as_str());
    (fits && variable && weights.data_type == Some(data_type::FLOAT)).then_some(weights)
}

/// Products behind which there is no other before an output.
fn last_products(graph: &GraphProto, constants: &HashMap<&str, &TensorProto>) -> HashSet<usize> {
    let makers: HashMap<&str, usize> = (graph.node.iter().enumerate())
        .flat_map(|(i, n)| n.output.iter().map(move |o| (o.as_str(), i)))
        .collect();
    let heads = |o: &&ValueInfoProto| matches!(o.name.as_deref(), Some("scores" | "ltrb"));
    let outputs = graph.output.iter().filter(heads);
    let mut open: Vec<&str> = outputs.filter_map(|o| o.name.as_deref()).collect();
    let (mut seen, mut last) = (HashSet::new(), HashSet::new());
    while let Some(value) = open.pop() {
        let Some(&at) = makers.get(value).filter(|at| seen.insert(**at)) else { continue };
        let node = &graph.node[at];
        if constant_weights(node, constants).is_some() {
            last.insert(at);
        } else if !matches!(node.op_type.as_deref(), Some("Conv" | "MatMul")) {
            open.extend(node.input.iter().map(String::as_str));
        }
    }
    last
}

/// The sections of the narrow bundle, weights last.
///
/// # Errors
/// When a tensor is not where it should be.
pub fn write(
    files: &[File],
    weights: &[u8],
    products: &[Product],
    roundings: &Roundings,
    half: bool,
) -> Result<Vec<(SectionKind, Vec<u8>)>, QuantizeError> {
    let mut store = WeightStore::new(WEIGHTS_FILE);
    let mut sections = Vec::new();
    for (index, file) in files.iter().enumerate() {
        let taken: Vec<&Product> =
            products.iter().filter(|p| p.file == index && p.kept.is_none()).collect();
        let failed = |reason: String| QuantizeError::Graph { kind: file.kind, reason };
        let mut writer = Writer {
            graph: file.graph()?.clone(),
            weights,
            store: &mut store,
            extra: BTreeMap::new(),
            constants: Vec::new(),
        };
        for product in &taken {
            let rounding = roundings.get(&(index, product.input.clone())).ok_or_else(|| {
                failed(format!("nothing is known about the range of `{}`", product.input))
            })?;
            writer.bytes(product, *rounding).map_err(failed)?;
        }
        writer.constants(half).map_err(failed)?;
        let mut model = file.model.clone();
        model.graph = Some(writer.finish());
        sections.push((file.kind, model.encode_to_vec()));
    }
    sections.push((SectionKind::Weights, store.into_bytes()));
    Ok(sections)
}

/// Rewrites one graph.
struct Writer<'w> {
    graph: GraphProto,
    /// Old weights section.
    weights: &'w [u8],
    /// New one.
    store: &'w mut WeightStore,
    /// Nodes to stand before the node of this index.
    extra: BTreeMap<usize, Vec<NodeProto>>,
    /// New constants.
    constants: Vec<TensorProto>,
}

impl Writer<'_> {
    /// Turns a product into one of bytes.
    fn bytes(&mut self, product: &Product, rounding: Rounding) -> Result<(), String> {
        let input = format!("{}/rounded", product.input);
        if !self.defined(&input) {
            self.round(product, rounding, &input);
        }
        let weights = format!("{}/bytes", product.weights);
        if !self.defined(&weights) {
            self.narrow(product, &weights)?;
        }
        let node = &mut self.graph.node[product.node];
        node.input[0] = input;
        node.input[1] = weights;
        Ok(())
    }

    fn defined(&self, name: &str) -> bool {
        self.extra.values().flatten().any(|n| n.output.first().is_some_and(|o| o == name))
    }

    fn before(&mut self, at: usize, op: &str, input: [&str; 3], output: &str, axis: Option<usize>) {
        let attribute = axis.map(|axis| AttributeProto {
            name: Some("axis".into()),
            i: Some(axis as i64),
            r#type: Some(attribute_type::INT),
            ..AttributeProto::default()
        });
        self.extra.entry(at).or_default().push(NodeProto {
            input: input.into_iter().map(String::from).collect(),
            output: vec![output.into()],
            name: Some(format!("{op}:{output}")),
            op_type: Some(op.into()),
            attribute: attribute.into_iter().collect(),
        });
    }

    fn round(&mut self, product: &Product, rounding: Rounding, output: &str) {
        let name = |end: &str| format!("{}/{end}", product.input);
        let (scale, zero, bytes) = (name("scale"), name("zero"), name("byte"));
        let step = rounding.scale.to_le_bytes().to_vec();
        self.constants.push(inline(&scale, &[], data_type::FLOAT, step));
        self.constants.push(inline(&zero, &[], data_type::UINT8, vec![rounding.zero]));
        // Before the first product that reads it: nodes are taken in order.
        let at = product.node;
        self.before(at, "QuantizeLinear", [&product.input, &scale, &zero], &bytes, None);
        self.before(at, "DequantizeLinear", [&bytes, &scale, &zero], output, None);
    }

    fn narrow(&mut self, product: &Product, output: &str) -> Result<(), String> {
        let tensor = self.find(&product.weights)?.clone();
        let values = self.floats(&tensor)?;
        let dims: Vec<usize> = tensor.dims.iter().map(|d| *d as usize).collect();
        let channels = dims[product.axis];
        let inner: usize = dims[product.axis + 1..].iter().product();
        let channel = |i: usize| i / inner % channels;
        let mut scales = vec![0f32; channels];
        for (i, v) in values.iter().enumerate() {
            scales[channel(i)] = scales[channel(i)].max(v.abs());
        }
        // A channel of zeros needs a step all the same.
        scales.iter_mut().for_each(|s| *s = if *s > 0.0 { *s / 127.0 } else { 1.0 });
        let byte = |(i, v): (usize, &f32)| {
            let rounded = (v / scales[channel(i)]).round_ties_even().clamp(-127.0, 127.0);
            (rounded as i8).cast_unsigned()
        };
        let bytes: Vec<u8> = values.iter().enumerate().map(byte).collect();
        let raw: Vec<u8> = scales.iter().flat_map(|s| s.to_le_bytes()).collect();
        let name = |end: &str| format!("{}/{end}", product.weights);
        let (packed, scale, zero) = (name("int8"), name("scale"), name("zero"));
        self.outside(&packed, &tensor.dims, data_type::INT8, &bytes);
        self.outside(&scale, &[channels as i64], data_type::FLOAT, &raw);
        self.outside(&zero, &[channels as i64], data_type::INT8, &vec![0; channels]);
        let axis = Some(product.axis);
        self.before(product.node, "DequantizeLinear", [&packed, &scale, &zero], output, axis);
        Ok(())
    }

    /// Moves the constants that are still used into the new section, as 16-bit floats if they are
    /// large and fit.
    fn constants(&mut self, half: bool) -> Result<(), String> {
        let used: HashSet<String> =
            self.graph.node.iter().flat_map(|n| n.input.iter().cloned()).collect();
        let old = std::mem::take(&mut self.graph.initializer);
        for mut tensor in old {
            let name = tensor.name.clone().unwrap_or_default();
            if !used.contains(&name) {
                continue;
            }
            if tensor.data_location != Some(DATA_LOCATION_EXTERNAL) {
                self.constants.push(tensor);
                continue;
            }
            let raw = external(&tensor, self.weights)?;
            let values = floats_of(raw);
            let fits = values.len() >= SMALLEST_HALF && values.iter().all(|v| v.abs() <= HALF_MAX);
            if half && tensor.data_type == Some(data_type::FLOAT) && fits {
                let halves: Vec<u8> =
                    values.iter().flat_map(|v| half_bits(*v).to_le_bytes()).collect();
                let stored = format!("{name}/f16");
                self.outside(&stored, &tensor.dims, data_type::FLOAT16, &halves);
                let cast = NodeProto {
                    input: vec![stored],
                    output: vec![name.clone()],
                    name: Some(format!("Cast:{name}")),
                    op_type: Some("Cast".into()),
                    attribute: vec![AttributeProto {
                        name: Some("to".into()),
                        i: Some(i64::from(data_type::FLOAT)),
                        r#type: Some(attribute_type::INT),
                        ..AttributeProto::default()
                    }],
                };
                self.extra.entry(0).or_default().push(cast);
            } else {
                let entries = self.store.add(raw);
                tensor.external_data = entries;
                self.constants.push(tensor);
            }
        }
        Ok(())
    }

    /// A constant in the weights section.
    fn outside(&mut self, name: &str, dims: &[i64], kind: i32, raw: &[u8]) {
        if self.constants.iter().any(|t| t.name.as_deref() == Some(name)) {
            return;
        }
        let external_data = self.store.add(raw);
        self.constants.push(TensorProto {
            dims: dims.into(),
            data_type: Some(kind),
            name: Some(name.into()),
            raw_data: None,
            external_data,
            data_location: Some(DATA_LOCATION_EXTERNAL),
        });
    }

    fn find(&self, name: &str) -> Result<&TensorProto, String> {
        let found = self.graph.initializer.iter().find(|t| t.name.as_deref() == Some(name));
        found.ok_or_else(|| format!("no constant `{name}`"))
    }

    fn floats(&self, tensor: &TensorProto) -> Result<Vec<f32>, String> {
        let values = match &tensor.raw_data {
            Some(raw) => floats_of(raw),
            None => floats_of(external(tensor, self.weights)?),
        };
        let want: i64 = tensor.dims.iter().product();
        if values.len() as i64 != want {
            let name = tensor.name.as_deref().unwrap_or_default();
            return Err(format!("tensor `{name}` holds {} numbers, not {want}", values.len()));
        }
        Ok(values)
    }

    fn finish(mut self) -> GraphProto {
        let mut nodes = Vec::with_capacity(self.graph.node.len());
        for (i, node) in self.graph.node.into_iter().enumerate() {
            nodes.extend(self.extra.remove(&i).unwrap_or_default());
            nodes.push(node);
        }
        GraphProto { node: nodes, initializer: self.constants, ..self.graph }
    }
}

fn inline(name: &str, dims: &[i64], kind: i32, raw: Vec<u8>) -> TensorProto {
    TensorProto {
        dims: dims.into(),
        data_type: Some(kind),
        name: Some(name.into()),
        raw_data: Some(raw),
        ..TensorProto::default()
    }
}

fn floats_of(raw: &[u8]) -> Vec<f32> {
    raw.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

/// Bytes of a tensor in the weights section.
fn external<'w>(tensor: &TensorProto, weights: &'w [u8]) -> Result<&'w [u8], String> {
    let number = |key: &str| {
        let found = tensor.external_data.iter().find(|e| e.key.as_deref() == Some(key));
        found.and_then(|e| e.value.as_deref()).and_then(|v| v.parse::<usize>().ok())
    };
    let range = number("offset").zip(number("length"));
    let bytes = range.and_then(|(at, len)| weights.get(at..at.checked_add(len)?));
    bytes.ok_or_else(|| {
        let name = tensor.name.as_deref().unwrap_or_default();
        format!("the data of tensor `{name}` are not in the weights section")
    })
}

/// The 16-bit float nearest to a number of at most [`HALF_MAX`], ties to even.
pub fn half_bits(v: f32) -> u16 {
    let bits = v.to_bits();
    let sign = (bits >> 16 & 0x8000) as u16;
    let magnitude = f32::from_bits(bits & 0x7fff_ffff);
    // Below 2^-14 steps are of 2^-24, from there on of 2^-10 of the power of two.
    if magnitude < 6.103_515_6e-5 {
        return sign | (magnitude * 16_777_216.0).round_ties_even() as u16;
    }
    let bits = magnitude.to_bits();
    let rounded = bits + 0xfff + (bits >> 13 & 1);
    sign | ((rounded >> 13) - (112 << 10)).min(0x7bff) as u16
}
