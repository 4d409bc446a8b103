//! Everything after the backbone: head feature, encodings, filter prediction, classifier and box
//! regressor (spec 1.3 to 1.8).

mod inspect;

use super::kernels;
use super::layers::{
    Conv, Geometry, filled, instance_l2_norm, instance_l2_norm_wide, positional_code, uniform,
};
use super::transformer::{Shape, Transformer, linear_layer};
use burn::module::{Param, RunningState};
use burn::nn::{BatchNorm, BatchNormConfig, GroupNorm, GroupNormConfig, Linear};
use burn::prelude::*;
use burn::tensor::Distribution;
use burn::tensor::activation::relu;
use burn::tensor::module::batch_norm_train;
use tsda_runtime::ModelSpec;

/// MLP on `ltrb` (spec 1.4). Its batch norms are real ones: batch statistics in training.
#[derive(Module, Debug)]
pub(crate) struct BoxEncoding {
    conv0: Linear,
    bn1: BatchNorm,
    conv3: Linear,
    bn4: BatchNorm,
    conv6: Linear,
}

impl BoxEncoding {
    fn new(hidden: usize, width: usize, device: &Device) -> Self {
        Self {
            conv0: linear_layer(4, hidden, device),
            bn1: BatchNormConfig::new(hidden).init(device),
            conv3: linear_layer(hidden, width, device),
            bn4: BatchNormConfig::new(width).init(device),
            conv6: linear_layer(width, width, device),
        }
    }

    /// `(N, 4)` to `(N, d)`.
    fn forward(&self, ltrb: Tensor<2>) -> Tensor<2> {
        let x = relu(batch_norm(&self.bn1, self.conv0.forward(ltrb)));
        let x = relu(batch_norm(&self.bn4, self.conv3.forward(x)));
        self.conv6.forward(x)
    }
}

/// Batch norm of `(N, C)`. As [`BatchNorm::forward`], but the running variance takes the unbiased
/// estimate, as in PyTorch (spec 2.6).
fn batch_norm(bn: &BatchNorm, x: Tensor<2>) -> Tensor<2> {
    let count = x.dims()[0];
    if count < 2 || !x.is_autodiff() || !bn.training.is_enabled() {
        return bn.forward(x);
    }
    let batch = batch_norm_train(x, bn.gamma.val(), bn.beta.val(), bn.epsilon);
    let blend = |running: &RunningState<Tensor<1>>, new: Tensor<1>| {
        let new = new.inner().mul_scalar(bn.momentum);
        let blended = running.value_sync().inner().mul_scalar(1.0 - bn.momentum) + new;
        running.update(Tensor::from_inner(blended));
        // Updates wait in a per-thread slot that checkpoints do not see; a resumed run would lack
        // the last one.
        running.value_sync();
    };
    let unbiased = count as f64 / (count - 1) as f64;
    blend(&bn.running_mean, batch.mean);
    blend(&bn.running_var, batch.variance.mul_scalar(unbiased));
    batch.output
}

/// Encodings and transformer.
#[derive(Module, Debug)]
pub(crate) struct FilterPredictor {
    transformer: Transformer,
    box_encoding: BoxEncoding,
    /// `e_fg`, `(1, d)`: foreground embedding and decoder query (quirk Q11).
    query_embed_fg: Param<Tensor<2>>,
    /// `e_test`, `(1, d)`, when the model has the test-frame encoding (quirk Q2).
    query_embed_test: Option<Param<Tensor<2>>>,
}

/// Linear map from the filter to the classifier's weights.
#[derive(Module, Debug)]
pub(crate) struct Classifier {
    linear: Linear,
}

/// Convolution and norm of the box tower.
#[derive(Module, Debug)]
pub(crate) struct TowerLayer {
    conv: Conv,
    norm: GroupNorm,
}

/// Box regressor.
#[derive(Module, Debug)]
pub(crate) struct BoxRegressor {
    linear: Linear,
    tower: Vec<TowerLayer>,
    bbreg_layer: Conv,
}

/// The head.
#[derive(Module, Debug)]
pub(crate) struct Head {
    feature_extractor: Conv,
    filter_predictor: FilterPredictor,
    classifier: Classifier,
    bb_regressor: BoxRegressor,
    filter_size: usize,
}

impl BoxRegressor {
    /// Tower and last layer on a batch-wide map `(d, N, H, W)`, as `(N, 4, H, W)`.
    fn distances_wide(&self, x: Tensor<4>) -> Tensor<4> {
        let [d, n, h, w] = x.dims();
        let x = self.tower.iter().fold(x, |x, layer| {
            let y = layer.conv.forward_wide(x).reshape([d, n, h * w]);
            relu(layer.norm_wide(y)).reshape([d, n, h, w])
        });
        self.bbreg_layer.forward_wide(x).exp().reshape([4, n, h, w]).swap_dims(0, 1)
    }
}

impl TowerLayer {
    /// The one-group norm of a map `(B, d, H, W)`. Means are taken channel by channel first: engines
    /// add one axis from end to end, and 80,000 numbers in a row would cost a decimal place.
    fn norm(&self, x: Tensor<4>) -> Tensor<4> {
        let [b, d, h, w] = x.dims();
        let x = x.reshape([b, d, h * w]);
        let x = x.clone() - x.mean_dim(2).mean_dim(1);
        let variance = x.clone().powi_scalar(2).mean_dim(2).mean_dim(1);
        let x = x * variance.add_scalar(self.norm.epsilon).sqrt().recip();
        let x = match (&self.norm.gamma, &self.norm.beta) {
            (Some(gamma), Some(beta)) => {
                x * gamma.val().reshape([1, d, 1]) + beta.val().reshape([1, d, 1])
            }
            _ => x,
        };
        x.reshape([b, d, h, w])
    }

    /// The one-group norm of a batch-wide map `(d, N, H * W)`.
    fn norm_wide(&self, x: Tensor<3>) -> Tensor<3> {
        let d = x.dims()[0];
        let x = x.clone() - x.mean_dim(2).mean_dim(0);
        let variance = x.clone().powi_scalar(2).mean_dim(2).mean_dim(0);
        let x = x * variance.add_scalar(self.norm.epsilon).sqrt().recip();
        match (&self.norm.gamma, &self.norm.beta) {
            (Some(gamma), Some(beta)) => {
                x * gamma.val().reshape([d, 1, 1]) + beta.val().reshape([d, 1, 1])
            }
            _ => x,
        }
    }
}

/// Layers of the box tower.
const TOWER: usize = 4;

/// A fresh classifier whose scores are near 0: filter and encoder output are both layer-normed, so
/// the default initialisation would start with scores of some +-7 and a hundredfold loss.
fn quiet_linear(d: usize, device: &Device) -> Linear {
    let bound = 0.05 / (d as f64).sqrt();
    let mut linear = linear_layer(d, d, device);
    linear.weight = uniform([d, d], bound, device);
    linear.bias = Some(filled([d], 0.0, device));
    linear
}

impl Head {
    /// A fresh head (initialisation of spec 1.9).
    pub fn new(spec: &ModelSpec, dropout: f64, attention_dropout: f64, device: &Device) -> Self {
        let d = usize::from(spec.width);
        let shape = Shape {
            width: d,
            heads: spec.heads.into(),
            feed_forward: spec.feed_forward.into(),
            dropout,
            attention_dropout,
        };
        let conv = |i, o, bias| Conv::new(i, o, Geometry::centred(3, 1), bias, device);
        // exp(bias) of a fresh regressor is the mean ltrb of a centred target, so that training
        // starts from boxes of the right size.
        let half_target = (0.5 / spec.search_factor).ln();
        let embedding =
            || Param::from_tensor(Tensor::random([1, d], Distribution::Normal(0.0, 1.0), device));
        Self {
            feature_extractor: conv(spec.backbone.out_channels(), d, false),
            filter_predictor: FilterPredictor {
                transformer: Transformer::new(
                    &shape,
                    spec.encoder_layers.into(),
                    spec.decoder_layers.into(),
                    device,
                ),
                box_encoding: BoxEncoding::new(spec.ltrb_hidden.into(), d, device),
                query_embed_fg: embedding(),
                query_embed_test: spec.test_embedding.then(embedding),
            },
            classifier: Classifier { linear: quiet_linear(d, device) },
            bb_regressor: BoxRegressor {
                linear: linear_layer(d, d, device),
                tower: (0..TOWER)
                    .map(|_| TowerLayer {
                        conv: conv(d, d, true),
                        norm: GroupNormConfig::new(1, d).init(device),
                    })
                    .collect(),
                bbreg_layer: Conv {
                    bias: Some(filled([4], half_target, device)),
                    ..conv(d, 4, true)
                },
            },
            filter_size: spec.filter_size.into(),
        }
    }

    /// Where the parameters are, and whether they train.
    pub fn device(&self) -> Device {
        self.feature_extractor.weight.val().device()
    }

    /// Backbone feature `(B, C, F, F)` to head feature `(B, d, F, F)` (spec 1.3).
    pub fn feature(&self, x: Tensor<4>) -> Tensor<4> {
        instance_l2_norm(self.feature_extractor.forward(x), self.filter_size)
    }

    /// [`Self::feature`] of a batch-wide map `(C, N, F, F)`, as `(N, d, F, F)`.
    pub fn feature_wide(&self, x: Tensor<4>) -> Tensor<4> {
        let [_, n, h, w] = x.dims();
        let y = self.feature_extractor.forward_wide(x);
        let d = y.dims()[0];
        instance_l2_norm_wide(y.reshape([d, n, h * w]), self.filter_size)
            .swap_dims(0, 1)
            .reshape([n, d, h, w])
    }

    /// Tokens of template frames, `(N, F*F, d)`, from features `(N, d, F, F)`, labels `(N, F, F)`
    /// and ltrb maps `(N, 4, F, F)` (spec 1.4).
    pub fn template_tokens(
        &self,
        feature: Tensor<4>,
        label: Tensor<3>,
        ltrb: Tensor<4>,
    ) -> Tensor<3> {
        let [n, d, f, _] = feature.dims();
        let cells = f * f;
        let predictor = &self.filter_predictor;
        let ltrb = ltrb.reshape([n, 4, cells]).swap_dims(1, 2).reshape([n * cells, 4]);
        let boxes = predictor.box_encoding.forward(ltrb).reshape([n, cells, d]);
        let e_fg = predictor.query_embed_fg.val().reshape([1, 1, d]);
        map_to_tokens(feature) + label.reshape([n, cells, 1]) * e_fg + boxes
    }

    /// Tokens of search frames, `(N, F*F, d)`, from features `(N, d, F, F)`.
    pub fn search_tokens(&self, feature: Tensor<4>) -> Tensor<3> {
        let d = feature.dims()[1];
        let tokens = map_to_tokens(feature);
        match &self.filter_predictor.query_embed_test {
            Some(e_test) => tokens + e_test.val().reshape([1, 1, d]),
            None => tokens,
        }
    }

    /// Tokens `(N, F*F, d)` of frames with their queries, keys and values in the first encoder
    /// layer, `(N, F*F, 4d)`: all of a frame that does not depend on the other frames.
    pub fn prepare(&self, tokens: Tensor<3>, side: usize) -> Tensor<3> {
        let position = position(side, &tokens);
        let projected = self.filter_predictor.transformer.project_first(tokens.clone(), position);
        Tensor::cat(vec![tokens, projected], 2)
    }

    /// Filter `(B, d)` and encoded search frame `(B, F*F, d)` from prepared frames
    /// `(B, frames * F*F, 4d)`, the search frame last.
    pub fn predict_filter_prepared(
        &self,
        prepared: Tensor<3>,
        side: usize,
    ) -> (Tensor<2>, Tensor<3>) {
        let d = prepared.dims()[2] / 4;
        let tokens = prepared.clone().narrow(2, 0, d);
        let projected = prepared.narrow(2, d, 3 * d);
        let position = position(side, &tokens);
        let transformer = &self.filter_predictor.transformer;
        let memory = transformer.encode_projected(tokens, projected, position.clone());
        self.decode(memory, position)
    }

    /// Filter `(B, d)` and the encoder's outputs `(B, frames * F*F, d)` for tokens of that shape, the
    /// search frame last.
    pub fn predict_filter(&self, tokens: Tensor<3>, side: usize) -> (Tensor<2>, Tensor<3>) {
        let position = position(side, &tokens);
        let memory = self.filter_predictor.transformer.encode(tokens, position.clone());
        let (filter, _) = self.decode(memory.clone(), position);
        (filter, memory)
    }

    /// The encoder's outputs `(B, frames * F*F, d)` for tokens of that shape, the search frame last.
    pub fn encode(&self, tokens: Tensor<3>, side: usize) -> Tensor<3> {
        let position = position(side, &tokens);
        self.filter_predictor.transformer.encode(tokens, position)
    }

    fn decode(&self, memory: Tensor<3>, position: Tensor<3>) -> (Tensor<2>, Tensor<3>) {
        let ([_, l, _], cells) = (memory.dims(), position.dims()[1]);
        let predictor = &self.filter_predictor;
        let query = predictor.query_embed_fg.val();
        let filter = predictor.transformer.decode(query, memory.clone(), position);
        (filter, memory.narrow(1, l - cells, cells))
    }

    /// Score map `(B, F, F)` from filter `(B, d)` and encoded search frame `(B, F*F, d)`.
    pub fn scores(&self, filter: Tensor<2>, encoded: Tensor<3>, side: usize) -> Tensor<3> {
        let [b, _, d] = encoded.dims();
        let weights = self.classifier.linear.forward(filter).reshape([b, d, 1]);
        encoded.matmul(weights).reshape([b, side, side])
    }

    /// Distances `(B, 4, F, F)` in crop sides from filter `(B, d)` and encoded search frame
    /// `(B, F*F, d)` (spec 1.8).
    pub fn ltrb(&self, filter: Tensor<2>, encoded: Tensor<3>, side: usize) -> Tensor<4> {
        let [b, _, d] = encoded.dims();
        let regressor = &self.bb_regressor;
        let weights = regressor.linear.forward(filter).reshape([b, d, 1]);
        let attention = encoded.clone().matmul(weights);
        let x = encoded * attention;
        if x.is_autodiff() && kernels::supports(&x.device()) {
            return regressor.distances_wide(x.permute([2, 0, 1]).reshape([d, b, side, side]));
        }
        let x = x.swap_dims(1, 2).reshape([b, d, side, side]);
        let x = regressor.tower.iter().fold(x, |x, layer| relu(layer.norm(layer.conv.forward(x))));
        regressor.bbreg_layer.forward(x).exp()
    }
}

/// The positional code of one frame, `(1, F*F, d)`, where `tokens` `(.., .., d)` are.
fn position(side: usize, tokens: &Tensor<3>) -> Tensor<3> {
    let d = tokens.dims()[2];
    let code = TensorData::new(positional_code(side, d), [1, side * side, d]);
    // Constants stay outside autodiff whatever device the tokens live on.
    Tensor::from_data(code, &tokens.device()).inner()
}

/// `(N, d, F, F)` to `(N, F*F, d)`.
fn map_to_tokens(map: Tensor<4>) -> Tensor<3> {
    let [n, d, h, w] = map.dims();
    map.reshape([n, d, h * w]).swap_dims(1, 2)
}
