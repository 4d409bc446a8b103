//! The network as the reference runs it (spec 1.2 to 1.8, tracking mode), written anew from the
//! specification: a batch of two rows with a mask, attention with every projection, a decoder with
//! self-attention, templates encoded in every frame. Shares no line with the network itself.
//!
//! [`Rearranged`] switches single re-arrangements on. The tests beside this file compare numbers;
//! the exporter's benchmark includes this file by path and compares costs.

use burn::prelude::*;
use burn::tensor::activation::{relu, softmax};
use burn::tensor::module::{batch_norm, conv2d, layer_norm, linear, max_pool2d};
use burn::tensor::ops::{ConvOptions, MaxPoolOptions};
use std::collections::BTreeMap;
use tsda_runtime::{Backbone, ModelSpec};

/// Shape and values of tensors by state-dict name.
pub type Weights = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// Re-arrangements to use, by number in the specification.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rearranged {
    /// 4.3.1 and 4.3.2: the box row is a sequence of its own without the templates that it masks;
    /// with one template there is no second row.
    pub short_row: bool,
    /// 4.3.3: the query goes into memory space instead of keys and values out of it.
    pub memory_space: bool,
    /// 4.3.4: decoder self-attention is its value.
    pub value_only: bool,
}

/// A template as the reference keeps it: backbone feature `(1, C, F, F)`, label `(F, F)`, ltrb map
/// `(4, F, F)`.
#[derive(Clone)]
pub struct Template {
    pub feature: Tensor<4>,
    pub label: Tensor<2>,
    pub ltrb: Tensor<3>,
}

/// The network on one device.
pub struct AsWritten<'a> {
    pub spec: ModelSpec,
    pub weights: &'a Weights,
    pub device: Device,
}

const TRANSFORMER: &str = "head.filter_predictor.transformer";

impl AsWritten<'_> {
    fn shape(&self, name: &str) -> &[usize] {
        &self.weights.get(name).unwrap_or_else(|| panic!("no weight {name}")).0
    }

    fn load<const D: usize>(&self, name: &str, dims: [usize; D]) -> Tensor<D> {
        let (_, values) = self.weights.get(name).unwrap_or_else(|| panic!("no weight {name}"));
        Tensor::from_data(TensorData::new(values.clone(), dims), &self.device)
    }

    fn vector(&self, name: &str) -> Tensor<1> {
        let n = self.shape(name).iter().product();
        self.load(name, [n])
    }

    /// `(out, in)`; kernels of side 1 are left out.
    fn matrix(&self, name: &str) -> Tensor<2> {
        let shape = self.shape(name);
        let (out, all) = (shape[0], shape.iter().product::<usize>());
        self.load(name, [out, all / out])
    }

    fn linear<const D: usize>(&self, layer: &str, x: Tensor<D>) -> Tensor<D> {
        let weight = self.matrix(&format!("{layer}.weight")).transpose();
        linear(x, weight, Some(self.vector(&format!("{layer}.bias"))))
    }

    fn norm<const D: usize>(&self, layer: &str, x: Tensor<D>) -> Tensor<D> {
        let gamma = self.vector(&format!("{layer}.weight"));
        layer_norm(x, gamma, Some(self.vector(&format!("{layer}.bias"))), 1e-5)
    }

    fn conv(&self, layer: &str, x: Tensor<4>, stride: usize) -> Tensor<4> {
        let name = format!("{layer}.weight");
        let [out, inp, k, _] = *self.shape(&name) else { panic!("{name} is no kernel") };
        let bias = format!("{layer}.bias");
        let bias = self.weights.contains_key(&bias).then(|| self.vector(&bias));
        let options = ConvOptions::new([stride; 2], [k / 2; 2], [1; 2], 1);
        conv2d(x, self.load(&name, [out, inp, k, k]), bias, options)
    }

    fn batch_norm<const D: usize>(&self, layer: &str, x: Tensor<D>) -> Tensor<D> {
        let of = |part: &str| self.vector(&format!("{layer}.{part}"));
        let (gamma, beta) = (of("weight"), of("bias"));
        batch_norm(x, gamma, beta, of("running_mean"), of("running_var"), 1e-5)
    }

    /// Crop `(1, 3, S, S)` to backbone feature `(1, C, F, F)`, batch norms unfolded (spec 1.2).
    pub fn backbone(&self, crop: Tensor<4>) -> Tensor<4> {
        let Backbone::ResNet { blocks, .. } = self.spec.backbone else {
            panic!("the reference has ResNets only")
        };
        let layer = |name: &str| format!("feature_extractor.{name}");
        let x = self.conv(&layer("conv1"), crop, 2);
        let x = relu(self.batch_norm(&layer("bn1"), x));
        let pool = MaxPoolOptions {
            kernel_size: [3; 2],
            stride: [2; 2],
            padding: [(1, 1); 2],
            dilation: [1; 2],
            ceil_mode: false,
        };
        let mut x = max_pool2d(x, pool);
        for (stage, count) in blocks.into_iter().enumerate() {
            for block in 0..count {
                let stride = if stage > 0 && block == 0 { 2 } else { 1 };
                x = self.bottleneck(&layer(&format!("layer{}.{block}", stage + 1)), x, stride);
            }
        }
        x
    }

    fn bottleneck(&self, block: &str, x: Tensor<4>, stride: usize) -> Tensor<4> {
        let conv_bn = |i: usize, x, stride| {
            let y = self.conv(&format!("{block}.conv{i}"), x, stride);
            self.batch_norm(&format!("{block}.bn{i}"), y)
        };
        let y = relu(conv_bn(1, x.clone(), 1));
        let y = relu(conv_bn(2, y, stride));
        let y = conv_bn(3, y, 1);
        let shortcut = if self.weights.contains_key(&format!("{block}.downsample.0.weight")) {
            let short = self.conv(&format!("{block}.downsample.0"), x, stride);
            self.batch_norm(&format!("{block}.downsample.1"), short)
        } else {
            x
        };
        relu(y + shortcut)
    }

    /// Backbone features `(N, C, F, F)` to head features `(N, d, F, F)` (spec 1.3).
    pub fn head_feature(&self, x: Tensor<4>) -> Tensor<4> {
        let x = self.conv("head.feature_extractor.0", x, 1);
        let [n, c, h, w] = x.dims();
        let k = f64::from(self.spec.filter_size);
        let flat = x.reshape([n, c * h * w]);
        let energy = flat.clone().powi_scalar(2).sum_dim(1).add_scalar(1e-5);
        let scale = (energy.recip() * (c * h * w) as f64).sqrt() / (c as f64 * k * k).sqrt();
        (flat * scale).reshape([n, c, h, w])
    }

    /// Tokens `(rows, T * F*F, d)` of templates, encoded for every row (spec 1.4).
    pub fn template_tokens(&self, templates: &[Template], rows: usize) -> Tensor<3> {
        let (cells, d) = (self.spec.cells(), usize::from(self.spec.width));
        let t = templates.len();
        let each = |part: &dyn Fn(&Template) -> Tensor<2>| {
            Tensor::cat(templates.iter().map(part).collect(), 0)
        };
        let features = Tensor::cat(templates.iter().map(|t| t.feature.clone()).collect(), 0);
        let features = self.head_feature(features).reshape([t, d, cells]).swap_dims(1, 2);
        let features = features.reshape([1, t * cells, d]).repeat_dim(0, rows);
        let labels = each(&|t| t.label.clone().reshape([cells, 1])).repeat_dim(0, rows);
        let ltrb = each(&|t| t.ltrb.clone().reshape([4, cells]).transpose()).repeat_dim(0, rows);
        let mlp = |i: usize| format!("head.filter_predictor.box_encoding.{i}");
        let x = relu(self.batch_norm(&mlp(1), self.linear(&mlp(0), ltrb)));
        let x = relu(self.batch_norm(&mlp(4), self.linear(&mlp(3), x)));
        let boxes = self.linear(&mlp(6), x).reshape([rows, t * cells, d]);
        let e_fg = self.matrix("head.filter_predictor.query_embed_fg.weight");
        let labels = labels.matmul(e_fg.reshape([1, d])).reshape([rows, t * cells, d]);
        features + labels + boxes
    }

    /// Search tokens `(1, F*F, d)` from a head feature `(1, d, F, F)`.
    fn search_tokens(&self, feature: Tensor<4>) -> Tensor<3> {
        let (cells, d) = (self.spec.cells(), usize::from(self.spec.width));
        let tokens = feature.reshape([1, d, cells]).swap_dims(1, 2);
        if !self.spec.test_embedding {
            return tokens;
        }
        let e_test = self.matrix("head.filter_predictor.query_embed_test.weight");
        tokens + e_test.reshape([1, 1, d])
    }

    /// The positional code of one frame, `(F*F, d)` (spec 1.5).
    fn code(&self) -> Vec<f32> {
        let (side, d) = (self.spec.map_side(), usize::from(self.spec.width));
        let mut code = Vec::with_capacity(side * side * d);
        for cell in 0..side * side {
            for channel in 0..d {
                let place = if channel % 2 == 0 { cell % side } else { cell / side };
                let at = (place as f32 + 0.5) / (side as f32 + 1e-6);
                let i = (channel % (d / 2)) / 2 + 1;
                let angle =
                    (i as f64 * (side as f64 / (d / 4) as f64) * std::f64::consts::PI) as f32 * at;
                code.push(if channel < d / 2 { angle.sin() } else { angle.cos() });
            }
        }
        code
    }

    /// Multi-head attention of queries `(B, Q, d)` on keys and values `(B, L, d)`; `mask`
    /// `(B, 1, 1, L)` is added to the logits.
    fn attention(
        &self,
        layer: &str,
        query: Tensor<3>,
        key: Tensor<3>,
        value: Tensor<3>,
        mask: Option<Tensor<4>>,
    ) -> Tensor<3> {
        let (d, heads) = (usize::from(self.spec.width), usize::from(self.spec.heads));
        let project = |part: usize, x: Tensor<3>| {
            let [b, l, _] = x.dims();
            let weight = self.matrix(&format!("{layer}.in_proj_weight")).narrow(0, part * d, d);
            let bias = self.vector(&format!("{layer}.in_proj_bias")).narrow(0, part * d, d);
            let y = linear(x, weight.transpose(), Some(bias));
            y.reshape([b, l, heads, d / heads]).swap_dims(1, 2)
        };
        let [b, q, _] = query.dims();
        let (query, key, value) = (project(0, query), project(1, key), project(2, value));
        let logits = query.matmul(key.swap_dims(2, 3)) / ((d / heads) as f64).sqrt();
        let logits = match mask {
            Some(mask) => logits + mask,
            None => logits,
        };
        let mixed = softmax(logits, 3).matmul(value).swap_dims(1, 2).reshape([b, q, d]);
        self.linear(&format!("{layer}.out_proj"), mixed)
    }

    fn feed_forward(&self, layer: &str, x: Tensor<3>) -> Tensor<3> {
        let hidden = relu(self.linear(&format!("{layer}.linear1"), x));
        self.linear(&format!("{layer}.linear2"), hidden)
    }

    fn encode(&self, mut x: Tensor<3>, code: &Tensor<3>, mask: Option<&Tensor<4>>) -> Tensor<3> {
        for i in 0..self.spec.encoder_layers {
            let layer = format!("{TRANSFORMER}.encoder.layers.{i}");
            let coded = x.clone() + code.clone();
            let attention = format!("{layer}.self_attn");
            let a = self.attention(&attention, coded.clone(), coded, x.clone(), mask.cloned());
            x = self.norm(&format!("{layer}.norm1"), x + a);
            let f = self.feed_forward(&layer, x.clone());
            x = self.norm(&format!("{layer}.norm2"), x + f);
        }
        x
    }

    /// Filters `(B, d)` from memory `(B, L, d)`.
    fn decode(
        &self,
        memory: Tensor<3>,
        code: &Tensor<3>,
        mask: Option<&Tensor<4>>,
        with: Rearranged,
    ) -> Tensor<2> {
        let [b, _, d] = memory.dims();
        let e_fg = self.matrix("head.filter_predictor.query_embed_fg.weight");
        let e_fg = e_fg.reshape([1, 1, d]).repeat_dim(0, b);
        let coded = memory.clone() + code.clone();
        let mut t = Tensor::<3>::zeros([b, 1, d], &self.device);
        for i in 0..self.spec.decoder_layers {
            let layer = format!("{TRANSFORMER}.decoder.layers.{i}");
            let attention = format!("{layer}.self_attn");
            let a = if with.value_only {
                let weight = self.matrix(&format!("{attention}.in_proj_weight"));
                let bias = self.vector(&format!("{attention}.in_proj_bias")).narrow(0, 2 * d, d);
                let v = linear(t.clone(), weight.narrow(0, 2 * d, d).transpose(), Some(bias));
                self.linear(&format!("{attention}.out_proj"), v)
            } else {
                let query = t.clone() + e_fg.clone();
                self.attention(&attention, query.clone(), query, t.clone(), None)
            };
            t = self.norm(&format!("{layer}.norm1"), t + a);
            let attention = format!("{layer}.multihead_attn");
            let query = t.clone() + e_fg.clone();
            let a = if with.memory_space {
                self.in_memory_space(&attention, query, &coded, &memory, mask)
            } else {
                self.attention(&attention, query, coded.clone(), memory.clone(), mask.cloned())
            };
            t = self.norm(&format!("{layer}.norm2"), t + a);
            let f = self.feed_forward(&layer, t.clone());
            t = self.norm(&format!("{layer}.norm3"), t + f);
        }
        self.norm(&format!("{TRANSFORMER}.decoder.norm"), t).reshape([b, d])
    }

    /// Attention of one query `(B, 1, d)`, head by head: keys and values stay as they are.
    fn in_memory_space(
        &self,
        layer: &str,
        query: Tensor<3>,
        coded: &Tensor<3>,
        memory: &Tensor<3>,
        mask: Option<&Tensor<4>>,
    ) -> Tensor<3> {
        let (d, heads) = (usize::from(self.spec.width), usize::from(self.spec.heads));
        let depth = d / heads;
        let [b, l, _] = memory.dims();
        let rows = |part: usize, head: usize| {
            let from = part * d + head * depth;
            let weight = self.matrix(&format!("{layer}.in_proj_weight")).narrow(0, from, depth);
            (weight, self.vector(&format!("{layer}.in_proj_bias")).narrow(0, from, depth))
        };
        let each = (0..heads).map(|head| {
            let (w_q, b_q) = rows(0, head);
            let (w_k, _) = rows(1, head);
            let (w_v, b_v) = rows(2, head);
            let q = linear(query.clone(), w_q.transpose(), Some(b_q));
            let q = q.matmul(w_k.reshape([1, depth, d])) / (depth as f64).sqrt();
            let logits = q.matmul(coded.clone().swap_dims(1, 2));
            let logits = match mask {
                Some(mask) => logits + mask.clone().reshape([b, 1, l]),
                None => logits,
            };
            linear(softmax(logits, 2).matmul(memory.clone()), w_v.transpose(), Some(b_v))
        });
        let values = Tensor::cat(each.collect(), 2);
        self.linear(&format!("{layer}.out_proj"), values)
    }

    /// Filters and encoded search frames of the classification and the box row.
    fn rows(
        &self,
        templates: Tensor<3>,
        search: Tensor<3>,
        with: Rearranged,
    ) -> [(Tensor<2>, Tensor<3>); 2] {
        let (cells, d) = (self.spec.cells(), usize::from(self.spec.width));
        let t = templates.dims()[1] / cells;
        let l = (t + 1) * cells;
        let run = |tokens: Tensor<3>, mask: Option<Tensor<4>>| {
            let [b, l, _] = tokens.dims();
            let code = TensorData::new(self.code().repeat(l / cells), [1, l, d]);
            let code = Tensor::<3>::from_data(code, &self.device);
            let memory = self.encode(tokens, &code, mask.as_ref());
            let filter = self.decode(memory.clone(), &code, mask.as_ref(), with);
            let encoded = memory.narrow(1, l - cells, cells);
            let of =
                |row: usize| (filter.clone().narrow(0, row, 1), encoded.clone().narrow(0, row, 1));
            [of(0), of(b - 1)]
        };
        if with.short_row {
            let one = |templates: Tensor<3>| {
                let [row, _] = run(Tensor::cat(vec![templates, search.clone()], 1), None);
                row
            };
            let first = one(templates.clone().narrow(0, 0, 1));
            let second = match t {
                1 => first.clone(),
                _ => one(templates.narrow(0, 0, 1).narrow(1, 0, cells)),
            };
            return [first, second];
        }
        let templates = match templates.dims()[0] {
            1 => templates.repeat_dim(0, 2),
            _ => templates,
        };
        let tokens = Tensor::cat(vec![templates, search.repeat_dim(0, 2)], 1);
        // Row 1 does not see the templates after the first.
        let hidden = |i: usize| i >= l && (cells..t * cells).contains(&(i - l));
        let mask = (0..2 * l).map(|i| if hidden(i) { f32::NEG_INFINITY } else { 0.0 });
        let mask = TensorData::new(mask.collect::<Vec<f32>>(), [2, 1, 1, l]);
        run(tokens, Some(Tensor::from_data(mask, &self.device)))
    }

    /// Score map `(F, F)` and distances `(4, F, F)` (spec 1.8) from template tokens
    /// `(1 or 2 rows, T * F*F, d)` and the head feature `(1, d, F, F)` of the search crop.
    pub fn predict(
        &self,
        templates: Tensor<3>,
        search: Tensor<4>,
        with: Rearranged,
    ) -> (Tensor<2>, Tensor<3>) {
        let (side, cells, d) =
            (self.spec.map_side(), self.spec.cells(), usize::from(self.spec.width));
        let [(filter, encoded), boxes] = self.rows(templates, self.search_tokens(search), with);
        let weights = self.linear("head.classifier.linear", filter).reshape([1, d, 1]);
        let scores = encoded.matmul(weights).reshape([side, side]);
        let (filter, encoded) = boxes;
        let weights = self.linear("head.bb_regressor.linear", filter).reshape([1, d, 1]);
        let x = encoded.clone() * encoded.matmul(weights);
        let mut x = x.swap_dims(1, 2).reshape([1, d, side, side]);
        for i in 0..4 {
            x = self.conv(&format!("head.bb_regressor.tower.{}", 3 * i), x, 1);
            // One group: mean and variance over everything.
            let flat = x.reshape([1, d * cells]);
            let centred = flat.clone() - flat.mean_dim(1);
            let variance = centred.clone().powi_scalar(2).mean_dim(1).add_scalar(1e-5);
            let norm = format!("head.bb_regressor.tower.{}", 3 * i + 1);
            let of = |part: &str| self.vector(&format!("{norm}.{part}")).reshape([1, d, 1, 1]);
            let normed = (centred / variance.sqrt()).reshape([1, d, side, side]);
            x = relu(normed * of("weight") + of("bias"));
        }
        let ltrb = self.conv("head.bb_regressor.bbreg_layer", x, 1).exp();
        (scores, ltrb.reshape([4, side, side]))
    }
}
