//! Encoder and decoder of the filter predictor (spec 1.6), written so that training and the
//! exported graphs share every line: exact re-arrangements of spec 4.3, dropout where it belongs.

mod inspect;

use super::layers::{dropout, filled, uniform};
use burn::module::Param;
use burn::nn::{Dropout, DropoutConfig, LayerNorm, LayerNormConfig, Linear, LinearConfig};
use burn::prelude::*;
use burn::tensor::Distribution;
use burn::tensor::activation::{relu, softmax};
use burn::tensor::module::linear;

/// Shape of a transformer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shape {
    /// Width `d`.
    pub width: usize,
    /// Heads.
    pub heads: usize,
    /// Hidden width of the feed-forward layers.
    pub feed_forward: usize,
    /// Share of activations dropped in training.
    pub dropout: f64,
    /// Share of attention weights dropped in training.
    pub attention_dropout: f64,
}

/// Multi-head attention with PyTorch's stacked input projection.
#[derive(Module, Debug)]
pub(crate) struct Attention {
    /// `(3d, d)`, rows `[Wq; Wk; Wv]`.
    in_proj_weight: Param<Tensor<2>>,
    /// `(3d)`.
    in_proj_bias: Param<Tensor<1>>,
    out_proj: Linear,
    dropout: Dropout,
    heads: usize,
}

fn xavier_linear(inp: usize, out: usize, device: &Device) -> Linear {
    let bound = 1.0 / (inp as f64).sqrt();
    let mut layer = linear_layer(inp, out, device);
    layer.weight = uniform([inp, out], (6.0 / (inp + out) as f64).sqrt(), device);
    layer.bias = Some(uniform([out], bound, device));
    layer
}

/// A linear layer with PyTorch's default initialisation.
pub(crate) fn linear_layer(inp: usize, out: usize, device: &Device) -> Linear {
    let bound = 1.0 / (inp as f64).sqrt();
    let mut layer = LinearConfig::new(inp, out).init(device);
    layer.weight = uniform([inp, out], bound, device);
    layer.bias = Some(uniform([out], bound, device));
    layer
}

impl Attention {
    fn new(shape: &Shape, device: &Device) -> Self {
        let d = shape.width;
        let mut out_proj = xavier_linear(d, d, device);
        out_proj.bias = Some(filled([d], 0.0, device));
        Self {
            in_proj_weight: uniform([3 * d, d], (6.0 / (4 * d) as f64).sqrt(), device),
            in_proj_bias: filled([3 * d], 0.0, device),
            out_proj,
            dropout: DropoutConfig::new(shape.attention_dropout).init(),
            heads: shape.heads,
        }
    }

    /// Rows `from..to` of the stacked projection, transposed for `linear`, and their biases.
    fn projection(&self, from: usize, to: usize) -> (Tensor<2>, Tensor<1>) {
        let weight = self.in_proj_weight.val().narrow(0, from, to - from).transpose();
        (weight, self.in_proj_bias.val().narrow(0, from, to - from))
    }

    /// Queries (divided by the root of a head's depth), keys and values of tokens `(B, L, d)`, side
    /// by side as `(B, L, 3d)`; `position` `(1, C, d)` is the code of one frame, on queries and keys.
    ///
    /// One product for all three: `(x + P) W = x W + P W`, and `P W` with the biases is a constant
    /// per cell (spec 4.2).
    fn project(&self, x: Tensor<3>, position: Tensor<3>) -> Tensor<3> {
        let [b, l, d] = x.dims();
        let cells = position.dims()[1];
        let scale = 1.0 / ((d / self.heads) as f64).sqrt();
        let scaled = |from: usize, to: usize| {
            let (weight, bias) = self.projection(from, to);
            if from == 0 { (weight * scale, bias * scale) } else { (weight, bias) }
        };
        let ((w_q, b_q), (w_k, b_k)) = (scaled(0, d), scaled(d, 2 * d));
        let (w_v, b_v) = scaled(2 * d, 3 * d);
        let w_qk = Tensor::cat(vec![w_q, w_k], 1);
        let by_cell = linear(position, w_qk.clone(), Some(Tensor::cat(vec![b_q, b_k], 0)));
        let b_v = b_v.reshape([1, 1, d]).repeat_dim(1, cells);
        let by_cell = Tensor::cat(vec![by_cell, b_v], 2);
        let frames = x.reshape([b * l / cells, cells, d]);
        let projected = linear(frames, Tensor::cat(vec![w_qk, w_v], 1), None) + by_cell;
        projected.reshape([b, l, 3 * d])
    }

    /// Self-attention among the tokens whose [`Self::project`] this is: `(B, L, 3d)` to `(B, L, d)`.
    fn attend(&self, projected: Tensor<3>) -> Tensor<3> {
        let [b, l, d3] = projected.dims();
        let d = d3 / 3;
        let depth = d / self.heads;
        let part = |from: usize| {
            let part = projected.clone().narrow(2, from, d);
            part.reshape([b, l, self.heads, depth]).swap_dims(1, 2)
        };
        let logits = part(0).matmul(part(d).swap_dims(2, 3));
        let weights = dropout(&self.dropout, softmax(logits, 3));
        let mixed = weights.matmul(part(2 * d)).swap_dims(1, 2).reshape([b, l, d]);
        self.out_proj.forward(mixed)
    }

    /// Self-attention of one token `(B, d)`: its softmax is 1, so only values matter (spec 4.3.4).
    ///
    /// The reference also drops that single weight in training with the attention-dropout
    /// probability, i.e. whole heads; here it never is.
    fn single_self_attention(&self, t: Tensor<2>) -> Tensor<2> {
        let d = t.dims()[1];
        let (w_v, b_v) = self.projection(2 * d, 3 * d);
        self.out_proj.forward(linear(t, w_v, Some(b_v)))
    }

    /// [`Self::single_self_attention`] of the zero token, `(1, d)`: the value bias alone.
    fn zero_self_attention(&self) -> Tensor<2> {
        let [d3, d] = self.in_proj_weight.dims();
        self.out_proj.forward(self.in_proj_bias.val().narrow(0, d3 - d, d).reshape([1, d]))
    }

    /// Attention of one query `(B, d)` on a memory, computed in memory space (spec 4.3.3): no key
    /// or value is ever projected.
    fn cross_attention(&self, query: Tensor<2>, memory: &Memory) -> Tensor<2> {
        let [b, d] = query.dims();
        let (heads, depth) = (self.heads, d / self.heads);
        let (w_q, b_q) = self.projection(0, d);
        let per_head = |from: usize| -> Tensor<3> {
            self.in_proj_weight.val().narrow(0, from, d).reshape([heads, depth, d])
        };
        let q = linear(query, w_q, Some(b_q)).mul_scalar(1.0 / (depth as f64).sqrt());
        let q = q.reshape([b, heads, depth]).swap_dims(0, 1);
        // (h, B, depth) x (h, depth, d): the query of every head in memory space. The key bias adds
        // one number to all logits of a head and cancels in the softmax.
        let q = q.matmul(per_head(d)).swap_dims(0, 1);
        let logits = q.matmul(memory.keys.clone());
        let weights = dropout(&self.dropout, softmax(logits, 2));
        let context = weights.clone().matmul(memory.tokens.clone()).swap_dims(0, 1);
        let values = context.matmul(per_head(2 * d).swap_dims(1, 2)).swap_dims(0, 1);
        let bias = self.in_proj_bias.val().narrow(0, 2 * d, d).reshape([1, heads, depth]);
        // Weights sum to 1 unless some were dropped.
        let dropping = self.dropout.prob > 0.0 && weights.is_autodiff();
        let bias = if dropping { weights.sum_dim(2) * bias } else { bias };
        self.out_proj.forward((values + bias).reshape([b, d]))
    }
}

/// Encoder layer, post-norm.
#[derive(Module, Debug)]
pub(crate) struct EncoderLayer {
    self_attn: Attention,
    linear1: Linear,
    linear2: Linear,
    norm1: LayerNorm,
    norm2: LayerNorm,
    dropout: Dropout,
}

impl EncoderLayer {
    fn new(shape: &Shape, device: &Device) -> Self {
        let norm = || LayerNormConfig::new(shape.width).init(device);
        Self {
            self_attn: Attention::new(shape, device),
            linear1: xavier_linear(shape.width, shape.feed_forward, device),
            linear2: xavier_linear(shape.feed_forward, shape.width, device),
            norm1: norm(),
            norm2: norm(),
            dropout: DropoutConfig::new(shape.dropout).init(),
        }
    }

    fn forward(&self, x: Tensor<3>, position: Tensor<3>) -> Tensor<3> {
        let projected = self.self_attn.project(x.clone(), position);
        self.forward_projected(x, projected)
    }

    /// [`Self::forward`] where the projections of the tokens, `(B, L, 3d)`, are known.
    fn forward_projected(&self, x: Tensor<3>, projected: Tensor<3>) -> Tensor<3> {
        let a = dropout(&self.dropout, self.self_attn.attend(projected));
        let x = self.norm1.forward(x + a);
        let h = dropout(&self.dropout, relu(self.linear1.forward(x.clone())));
        let f = dropout(&self.dropout, self.linear2.forward(h));
        self.norm2.forward(x + f)
    }
}

/// Decoder layer for a single query token, post-norm.
#[derive(Module, Debug)]
pub(crate) struct DecoderLayer {
    self_attn: Attention,
    multihead_attn: Attention,
    linear1: Linear,
    linear2: Linear,
    norm1: LayerNorm,
    norm2: LayerNorm,
    norm3: LayerNorm,
    dropout: Dropout,
}

impl DecoderLayer {
    fn new(shape: &Shape, device: &Device) -> Self {
        let norm = || LayerNormConfig::new(shape.width).init(device);
        Self {
            self_attn: Attention::new(shape, device),
            multihead_attn: Attention::new(shape, device),
            linear1: xavier_linear(shape.width, shape.feed_forward, device),
            linear2: xavier_linear(shape.feed_forward, shape.width, device),
            norm1: norm(),
            norm2: norm(),
            norm3: norm(),
            dropout: DropoutConfig::new(shape.dropout).init(),
        }
    }

    /// `token` is `None` for the zero token the first layer starts from.
    fn forward(&self, token: Option<Tensor<2>>, query: Tensor<2>, memory: &Memory) -> Tensor<2> {
        let b = memory.tokens.dims()[0];
        let t = match token {
            Some(t) => {
                let a = self.self_attn.single_self_attention(t.clone());
                t + dropout(&self.dropout, a)
            }
            None => {
                let a = self.self_attn.zero_self_attention();
                let a = if b > 1 { a.repeat_dim(0, b) } else { a };
                dropout(&self.dropout, a)
            }
        };
        let t = self.norm1.forward(t);
        let a = self.multihead_attn.cross_attention(t.clone() + query, memory);
        let t = self.norm2.forward(t + dropout(&self.dropout, a));
        let h = dropout(&self.dropout, relu(self.linear1.forward(t.clone())));
        let f = dropout(&self.dropout, self.linear2.forward(h));
        self.norm3.forward(t + f)
    }
}

/// What the decoder attends to.
struct Memory {
    /// Values, `(B, L, d)`.
    tokens: Tensor<3>,
    /// Keys, `(B, d, L)`: the tokens with their positional code; the same for every layer.
    keys: Tensor<3>,
}

impl Memory {
    /// `position` `(1, C, d)` is the code of one frame.
    fn new(tokens: Tensor<3>, position: Tensor<3>) -> Self {
        let [b, l, d] = tokens.dims();
        let cells = position.dims()[1];
        let keys = tokens.clone().reshape([b * l / cells, cells, d]) + position;
        Self { tokens, keys: keys.reshape([b, l, d]).swap_dims(1, 2) }
    }
}

/// The stack of encoder layers; no norm behind it.
#[derive(Module, Debug)]
pub(crate) struct Encoder {
    layers: Vec<EncoderLayer>,
}

/// The stack of decoder layers with its final norm.
#[derive(Module, Debug)]
pub(crate) struct Decoder {
    layers: Vec<DecoderLayer>,
    norm: LayerNorm,
}

/// Encoder and decoder.
#[derive(Module, Debug)]
pub(crate) struct Transformer {
    encoder: Encoder,
    decoder: Decoder,
}

impl Transformer {
    /// Xavier-uniform matrices, zero attention biases (spec 1.9), but for one: the decoder starts from
    /// a zero token, so the first thing it normalises is the bias of its first attention. At zero,
    /// that norm multiplies gradients by 1/sqrt(eps) = 316 and every early step throws the query
    /// into a new direction; a bias of unit size starts it somewhere and keeps it there.
    pub fn new(shape: &Shape, encoder: usize, decoder: usize, device: &Device) -> Self {
        let mut net = Self::by_specification(shape, encoder, decoder, device);
        if let Some(first) = net.decoder.layers.first_mut() {
            let start = Tensor::random([shape.width], Distribution::Normal(0.0, 1.0), device);
            first.self_attn.out_proj.bias = Some(Param::from_tensor(start));
        }
        net
    }

    fn by_specification(shape: &Shape, encoder: usize, decoder: usize, device: &Device) -> Self {
        Self {
            encoder: Encoder {
                layers: (0..encoder).map(|_| EncoderLayer::new(shape, device)).collect(),
            },
            decoder: Decoder {
                layers: (0..decoder).map(|_| DecoderLayer::new(shape, device)).collect(),
                norm: LayerNormConfig::new(shape.width).init(device),
            },
        }
    }

    /// Tokens `(B, L, d)` of whole frames to memory `(B, L, d)`; `position` `(1, C, d)` is the
    /// positional code of one frame.
    pub fn encode(&self, tokens: Tensor<3>, position: Tensor<3>) -> Tensor<3> {
        self.encoder.layers.iter().fold(tokens, |x, layer| layer.forward(x, position.clone()))
    }

    /// Queries, keys and values `(B, L, 3d)` of tokens `(B, L, d)` in the first encoder layer. They
    /// depend on the token and its cell only, so those of a template are known when it is written
    /// (spec 4.2).
    pub fn project_first(&self, tokens: Tensor<3>, position: Tensor<3>) -> Tensor<3> {
        match self.encoder.layers.first() {
            Some(layer) => layer.self_attn.project(tokens, position),
            // `ModelSpec::validate` asks for at least one encoder layer.
            None => tokens.repeat_dim(2, 3),
        }
    }

    /// [`Self::encode`] of tokens `(B, L, d)` with their [`Self::project_first`], `(B, L, 3d)`.
    pub fn encode_projected(
        &self,
        tokens: Tensor<3>,
        projected: Tensor<3>,
        position: Tensor<3>,
    ) -> Tensor<3> {
        let Some((first, others)) = self.encoder.layers.split_first() else { return tokens };
        let x = first.forward_projected(tokens, projected);
        others.iter().fold(x, |x, layer| layer.forward(x, position.clone()))
    }

    /// The target filter `(B, d)` from the memory `(B, L, d)`; `query` is `e_fg`, `(1, d)`,
    /// `position` `(1, C, d)` the positional code of one frame.
    pub fn decode(&self, query: Tensor<2>, memory: Tensor<3>, position: Tensor<3>) -> Tensor<2> {
        let [b, _, d] = memory.dims();
        let memory = Memory::new(memory, position);
        let mut token: Option<Tensor<2>> = None;
        for layer in &self.decoder.layers {
            token = Some(layer.forward(token, query.clone(), &memory));
        }
        // `ModelSpec::validate` asks for at least one decoder layer.
        let token = token.unwrap_or_else(|| Tensor::zeros([b, d], &memory.tokens.device()));
        self.decoder.norm.forward(token)
    }
}
