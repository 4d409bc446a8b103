//! Encoder and decoder as the reference writes them (spec 1.6): several rows over all tokens, keys
//! hidden by a mask, every key and value projected. Every intermediate is kept.

use super::{Attention, DecoderLayer, EncoderLayer, Transformer};
use crate::import::StateDict;
use crate::model::inspect::keep;
use burn::prelude::*;
use burn::tensor::activation::{relu, softmax};
use burn::tensor::module::linear;

impl Attention {
    /// Attention of `(B, Q, d)` on keys and values `(B, L, d)`; `mask` `(B, 1, 1, L)` is added to
    /// the logits.
    fn inspect(
        &self,
        queries: Tensor<3>,
        keys: Tensor<3>,
        values: Tensor<3>,
        mask: Option<&Tensor<4>>,
    ) -> Tensor<3> {
        let [b, q, d] = queries.dims();
        let (heads, depth) = (self.heads, d / self.heads);
        let project = |x: Tensor<3>, part: usize| {
            let (weight, bias) = self.projection(part * d, (part + 1) * d);
            let l = x.dims()[1];
            linear(x, weight, Some(bias)).reshape([b, l, heads, depth]).swap_dims(1, 2)
        };
        let logits = project(queries, 0).matmul(project(keys, 1).swap_dims(2, 3));
        let logits = logits.mul_scalar(1.0 / (depth as f64).sqrt());
        let logits = match mask {
            Some(mask) => logits + mask.clone(),
            None => logits,
        };
        let mixed = softmax(logits, 3).matmul(project(values, 2));
        self.out_proj.forward(mixed.swap_dims(1, 2).reshape([b, q, d]))
    }
}

/// Rows last but one, as the reference keeps them: `(B, L, d)` to `(L, B, d)`.
fn rows_second(x: &Tensor<3>) -> Tensor<3> {
    x.clone().swap_dims(0, 1)
}

impl EncoderLayer {
    fn inspect(
        &self,
        x: Tensor<3>,
        position: &Tensor<3>,
        mask: Option<&Tensor<4>>,
        name: &str,
        found: &mut StateDict,
    ) -> Tensor<3> {
        let place = x.clone() + position.clone();
        let a = self.self_attn.inspect(place.clone(), place, x.clone(), mask);
        keep(found, &format!("{name}.attn"), rows_second(&a));
        let x = self.norm1.forward(x + a);
        let h = self.linear2.forward(relu(self.linear1.forward(x.clone())));
        let x = self.norm2.forward(x + h);
        keep(found, name, rows_second(&x));
        x
    }
}

/// What every decoder layer looks at.
struct Memory<'a> {
    /// `(B, L, d)`.
    tokens: &'a Tensor<3>,
    /// `(1, L, d)`.
    position: &'a Tensor<3>,
    mask: Option<&'a Tensor<4>>,
}

impl DecoderLayer {
    fn inspect(
        &self,
        t: Tensor<3>,
        query: &Tensor<3>,
        memory: &Memory<'_>,
        name: &str,
        found: &mut StateDict,
    ) -> Tensor<3> {
        let q = t.clone() + query.clone();
        let a = self.self_attn.inspect(q.clone(), q, t.clone(), None);
        keep(found, &format!("{name}.self_attn"), rows_second(&a));
        let t = self.norm1.forward(t + a);
        let keys = memory.tokens.clone() + memory.position.clone();
        let q = t.clone() + query.clone();
        let a = self.multihead_attn.inspect(q, keys, memory.tokens.clone(), memory.mask);
        keep(found, &format!("{name}.cross_attn"), rows_second(&a));
        let t = self.norm2.forward(t + a);
        let h = self.linear2.forward(relu(self.linear1.forward(t.clone())));
        let t = self.norm3.forward(t + h);
        keep(found, name, rows_second(&t));
        t
    }
}

impl Transformer {
    /// Memory `(B, L, d)` and filter `(B, d)` of tokens `(B, L, d)` with positional code
    /// `(1, L, d)`, decoder query `(1, d)` and an additive mask `(B, 1, 1, L)`.
    pub fn inspect(
        &self,
        tokens: Tensor<3>,
        position: &Tensor<3>,
        query: Tensor<2>,
        mask: Option<&Tensor<4>>,
        found: &mut StateDict,
    ) -> (Tensor<3>, Tensor<2>) {
        let [b, _, d] = tokens.dims();
        let mut x = tokens;
        for (i, layer) in self.encoder.layers.iter().enumerate() {
            x = layer.inspect(x, position, mask, &format!("encoder.layer{i}"), found);
        }
        keep(found, "encoder.last", rows_second(&x));
        let query = query.reshape([1, 1, d]);
        let memory = Memory { tokens: &x, position, mask };
        let mut t = Tensor::zeros([b, 1, d], &x.device());
        for (i, layer) in self.decoder.layers.iter().enumerate() {
            t = layer.inspect(t, &query, &memory, &format!("decoder.layer{i}"), found);
        }
        let filter = self.decoder.norm.forward(t);
        keep(found, "decoder.norm", rows_second(&filter));
        (x, filter.reshape([b, d]))
    }
}
