//! The networks as the planner sees them: values with fixed shapes, operators with their settings
//! read and checked, constants as views of the bundle.

mod fuse;
mod read;

use super::proto;

pub use fuse::fuse;
pub use read::read;

/// Index into [`Graph::values`].
pub type ValueId = usize;

/// A graph that the engine cannot run.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GraphError {
    /// Not ONNX, or not whole.
    #[error(transparent)]
    Proto(#[from] proto::ProtoError),
    /// The graph as a whole or one of its inputs, outputs and constants.
    #[error("{0}")]
    Graph(String),
    /// An operator.
    #[error("node `{node}` ({op}): {reason}")]
    Node {
        /// Its name, or that of its first output.
        node: String,
        /// Kind of operator.
        op: String,
        /// What is not supported.
        reason: String,
    },
}

/// Elements of a constant.
#[derive(Clone, Debug)]
pub enum Data<'a> {
    /// Little-endian floats in the bundle.
    Bytes(&'a [u8]),
    /// Floats made while reading.
    Floats(Vec<f32>),
    /// Little-endian 16-bit floats in the bundle.
    Halves(&'a [u8]),
    /// Bytes in the bundle: weights before they are scaled, zero points. Known to the reader only.
    Bytes8 {
        /// The numbers.
        bytes: &'a [u8],
        /// Whether they go from -128 to 127.
        signed: bool,
    },
    /// Signed bytes in the bundle that stand for `byte * scale`.
    Scaled {
        /// The numbers.
        bytes: &'a [u8],
        /// One for all, or one per channel.
        scale: Vec<f32>,
        /// Elements from a channel to the next.
        inner: usize,
    },
    /// Shapes, axes, indices: known to the reader only.
    Ints(Vec<i64>),
}

impl Data<'_> {
    /// The floats, none for integers.
    pub fn floats(&self) -> Vec<f32> {
        match self {
            Self::Bytes(bytes) => proto::floats(bytes).collect(),
            Self::Floats(values) => values.clone(),
            Self::Halves(bytes) => {
                let halves = bytes.as_chunks::<2>().0.iter();
                halves.map(|b| half(u16::from_le_bytes(*b))).collect()
            }
            Self::Scaled { bytes, scale, inner } => {
                let numbers = bytes.iter().enumerate();
                let scaled = |(i, b): (usize, &u8)| {
                    f32::from(b.cast_signed()) * scale[i / inner % scale.len()]
                };
                numbers.map(scaled).collect()
            }
            Self::Bytes8 { .. } | Self::Ints(_) => Vec::new(),
        }
    }
}

/// A 16-bit float.
fn half(bits: u16) -> f32 {
    let sign = u32::from(bits & 0x8000) << 16;
    let (exponent, fraction) = (u32::from(bits >> 10 & 0x1f), u32::from(bits & 0x3ff));
    match exponent {
        // Below the smallest normal number steps are of 2^-24.
        0 => f32::from_bits((fraction as f32 * 2f32.powi(-24)).to_bits() | sign),
        31 => f32::from_bits(sign | 0x7f80_0000 | fraction << 13),
        _ => f32::from_bits(sign | (exponent + 112) << 23 | fraction << 13),
    }
}

/// A tensor of the graph.
#[derive(Clone, Debug)]
pub struct Value<'a> {
    /// Name in the file.
    pub name: String,
    /// Shape.
    pub shape: Vec<usize>,
    /// Elements, if it is a constant.
    pub data: Option<Data<'a>>,
}

/// A function of one number.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Unary {
    /// Limits to a range; ReLU is `0..inf`.
    Clamp(f32, f32),
    /// `e^x`.
    Exp,
    /// Square root.
    Sqrt,
    /// `1 / x`.
    Reciprocal,
    /// `1 / (1 + e^-x)`.
    Sigmoid,
    /// `clamp(alpha * x + beta, 0, 1)`.
    HardSigmoid(f32, f32),
    /// `x * clamp(x / 6 + 1 / 2, 0, 1)`.
    HardSwish,
    /// `-x`.
    Neg,
    /// Absolute value.
    Abs,
    /// Natural logarithm.
    Log,
    /// Hyperbolic tangent.
    Tanh,
    /// Sine.
    Sin,
    /// Cosine.
    Cos,
    /// To the nearest number that a byte stands for: `(byte - zero) * scale`.
    Round {
        /// Step.
        scale: f32,
        /// The byte for 0.
        zero: u8,
    },
}

/// A function of two numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Binary {
    /// Sum.
    Add,
    /// Difference.
    Sub,
    /// Product.
    Mul,
    /// Quotient.
    Div,
    /// Smaller one.
    Min,
    /// Larger one.
    Max,
    /// Power.
    Pow,
    /// Hard-swish of the product; see [`Unary::HardSwish`].
    MulHardSwish,
}

/// What a reduction computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reduce {
    /// Sum.
    Sum,
    /// Mean.
    Mean,
    /// Maximum.
    Max,
    /// Minimum.
    Min,
}

/// Geometry of a convolution or a pooling.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Rows and columns of the kernel.
    pub kernel: [usize; 2],
    /// Step, down and right.
    pub stride: [usize; 2],
    /// Top, left, bottom, right.
    pub pad: [usize; 4],
    /// Distance of neighbouring kernel elements.
    pub dilation: [usize; 2],
}

impl Window {
    /// Size of the result for an input of `size` rows and columns; `None` when the kernel does not
    /// fit.
    pub fn output(&self, size: [usize; 2]) -> Option<[usize; 2]> {
        let along = |i: usize| {
            let padded = size[i].checked_add(self.pad[i])?.checked_add(self.pad[i + 2])?;
            let reach = self.kernel[i].checked_sub(1)?.checked_mul(self.dilation[i])? + 1;
            Some(padded.checked_sub(reach)? / self.stride[i] + 1)
        };
        Some([along(0)?, along(1)?])
    }

    /// Largest padding of any side.
    pub fn halo(&self) -> usize {
        self.pad.into_iter().max().unwrap_or(0)
    }
}

/// What is done to a product before it is stored: `clamp(product + bias + residual)`, with a
/// hard-swish before the limits if wanted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Post {
    /// One number per output channel; a constant.
    pub bias: Option<ValueId>,
    /// A tensor of the product's shape; after a matrix product also a constant for each block of its
    /// rows.
    pub residual: Option<ValueId>,
    /// Whether the result is the hard-swish of the sum.
    pub swish: bool,
    /// Range of the result.
    pub clamp: (f32, f32),
}

/// No limit.
pub const UNLIMITED: (f32, f32) = (f32::NEG_INFINITY, f32::INFINITY);

impl Default for Post {
    fn default() -> Self {
        Self { bias: None, residual: None, swish: false, clamp: UNLIMITED }
    }
}

/// An operator. Inputs stand in [`Node::inputs`], in the order given here.
#[derive(Clone, Debug, PartialEq)]
pub enum Op {
    /// `x (1, C, H, W)`, weights `(N, C / group, kh, kw)`.
    Conv {
        /// Geometry.
        window: Window,
        /// Groups of channels.
        group: usize,
        /// What follows.
        post: Post,
    },
    /// `a (.., M, K)`, `b (.., K, N)`.
    MatMul {
        /// What follows; only with a constant `b` of two dimensions.
        post: Post,
    },
    /// `softmax(scale * q kt) v`: `q (.., L, D)`, `kt (.., D, T)`, `v (.., T, E)`.
    Attention {
        /// Factor of the logits.
        scale: f32,
    },
    /// `x`.
    Unary(Unary),
    /// `a`, `b`, broadcast.
    Binary(Binary),
    /// `x`, gain, optional offset over the last dimension.
    LayerNorm {
        /// Added to the variance.
        epsilon: f32,
    },
    /// `x (1, C, ..)`, optional gain and offset per channel: `(x - mean) / sqrt(var + epsilon)` over
    /// all elements, then gain, offset, limits.
    MapNorm {
        /// Added to the variance or sum.
        epsilon: f32,
        /// Whether the mean is taken off; if not, it is `x * factor / sqrt(sum(x^2) + epsilon)`.
        centre: bool,
        /// See `centre`.
        factor: f32,
        /// Range of the result.
        clamp: (f32, f32),
    },
    /// `x`, along the last dimension.
    Softmax,
    /// `x`.
    Reduce {
        /// What is computed.
        kind: Reduce,
        /// Dimensions that go; ascending.
        axes: Vec<usize>,
    },
    /// `x (1, C, H, W)`.
    Pool {
        /// Geometry.
        window: Window,
        /// Maximum, or the mean of all kernel elements.
        max: bool,
        /// Whether padding counts in a mean.
        count_pad: bool,
    },
    /// `x`: dimension `i` of the result is `perm[i]` of `x`.
    Transpose(Vec<usize>),
    /// `x`: same elements, another shape.
    Reshape,
    /// `x`: every `step`th element from `start` along `axis`.
    Slice {
        /// Dimension.
        axis: usize,
        /// First index.
        start: usize,
        /// Distance.
        step: usize,
    },
    /// `x`, repeated along dimensions of size one.
    Expand,
    /// Inputs one after the other along a dimension.
    Concat(usize),
}

impl Op {
    /// Name for messages.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Conv { .. } => "Conv",
            Self::MatMul { .. } => "MatMul",
            Self::Attention { .. } => "Attention",
            Self::Unary(_) => "Unary",
            Self::Binary(_) => "Binary",
            Self::LayerNorm { .. } => "LayerNorm",
            Self::MapNorm { .. } => "MapNorm",
            Self::Softmax => "Softmax",
            Self::Reduce { .. } => "Reduce",
            Self::Pool { .. } => "Pool",
            Self::Transpose(_) => "Transpose",
            Self::Reshape => "Reshape",
            Self::Slice { .. } => "Slice",
            Self::Expand => "Expand",
            Self::Concat(_) => "Concat",
        }
    }

    /// What follows, for operators that take it.
    pub const fn post(&self) -> Option<&Post> {
        match self {
            Self::Conv { post, .. } | Self::MatMul { post } => Some(post),
            _ => None,
        }
    }
}

/// An operator with its operands.
#[derive(Clone, Debug)]
pub struct Node {
    /// Name in the file.
    pub name: String,
    /// Kind and settings.
    pub op: Op,
    /// Operands.
    pub inputs: Vec<ValueId>,
    /// Result.
    pub output: ValueId,
}

impl Node {
    /// All values it needs, those of [`Post`] included.
    pub fn operands(&self) -> impl Iterator<Item = ValueId> + '_ {
        let post = self.op.post().into_iter().flat_map(|p| [p.bias, p.residual]).flatten();
        self.inputs.iter().copied().chain(post)
    }

    /// An error about it.
    pub fn error(&self, reason: impl Into<String>) -> GraphError {
        GraphError::Node {
            node: self.name.clone(),
            op: self.op.name().into(),
            reason: reason.into(),
        }
    }
}

/// A network in order of execution.
#[derive(Clone, Debug, Default)]
pub struct Graph<'a> {
    /// Tensors.
    pub values: Vec<Value<'a>>,
    /// Operators.
    pub nodes: Vec<Node>,
    /// Inputs, in file order.
    pub inputs: Vec<ValueId>,
    /// Outputs, in file order.
    pub outputs: Vec<ValueId>,
}

impl Graph<'_> {
    /// Shape of a value.
    pub fn shape(&self, id: ValueId) -> &[usize] {
        &self.values[id].shape
    }

    /// Whether a value is a constant.
    pub fn is_constant(&self, id: ValueId) -> bool {
        self.values[id].data.is_some()
    }

    /// The number, if a value is a constant of one element.
    pub fn scalar(&self, id: ValueId) -> Option<f32> {
        let value = &self.values[id];
        let data = value.data.as_ref()?;
        if value.shape.iter().product::<usize>() != 1 {
            return None;
        }
        data.floats().first().copied()
    }

    /// How often every value is used, graph outputs included.
    pub fn uses(&self) -> Vec<usize> {
        let mut uses = vec![0; self.values.len()];
        let operands = self.nodes.iter().flat_map(Node::operands);
        for id in operands.chain(self.outputs.iter().copied()) {
            uses[id] += 1;
        }
        uses
    }
}
