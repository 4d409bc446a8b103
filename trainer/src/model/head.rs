//! Everything after the backbone: head feature, encodings, filter prediction, classifier and box
//! regressor (spec 1.3 to 1.8).

use super::layers::{Conv, Geometry, instance_l2_norm, positional_code};
use super::transformer::{Shape, Transformer, linear_layer};
use burn::module::Param;
use burn::nn::{BatchNorm, BatchNormConfig, GroupNorm, GroupNormConfig, Linear};
use burn::prelude::*;
use burn::tensor::Distribution;
use burn::tensor::activation::relu;
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
        let x = relu(self.bn1.forward(self.conv0.forward(ltrb)));
        let x = relu(self.bn4.forward(self.conv3.forward(x)));
        self.conv6.forward(x)
    }
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

/// Layers of the box tower.
const TOWER: usize = 4;

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
            classifier: Classifier { linear: linear_layer(d, d, device) },
            bb_regressor: BoxRegressor {
                linear: linear_layer(d, d, device),
                tower: (0..TOWER)
                    .map(|_| TowerLayer {
                        conv: conv(d, d, true),
                        norm: GroupNormConfig::new(1, d).init(device),
                    })
                    .collect(),
                bbreg_layer: conv(d, 4, true),
            },
            filter_size: spec.filter_size.into(),
        }
    }

    /// Backbone feature `(B, C, F, F)` to head feature `(B, d, F, F)` (spec 1.3).
    pub fn feature(&self, x: Tensor<4>) -> Tensor<4> {
        instance_l2_norm(self.feature_extractor.forward(x), self.filter_size)
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

    /// Filter `(B, d)` and encoded search frame `(B, F*F, d)` from tokens `(B, frames * F*F, d)`,
    /// the search frame last.
    pub fn predict_filter(&self, tokens: Tensor<3>, side: usize) -> (Tensor<2>, Tensor<3>) {
        let [_, l, d] = tokens.dims();
        let cells = side * side;
        let code = TensorData::new(positional_code(side, d).repeat(l / cells), [1, l, d]);
        // Constants stay outside autodiff whatever device the tokens live on.
        let position = Tensor::<3>::from_data(code, &tokens.device()).inner();
        let predictor = &self.filter_predictor;
        let memory = predictor.transformer.encode(tokens, position.clone());
        let filter =
            predictor.transformer.decode(predictor.query_embed_fg.val(), memory.clone(), position);
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
        let x = (encoded * attention).swap_dims(1, 2).reshape([b, d, side, side]);
        let x = regressor
            .tower
            .iter()
            .fold(x, |x, layer| relu(layer.norm.forward(layer.conv.forward(x))));
        regressor.bbreg_layer.forward(x).exp()
    }
}

/// `(N, d, F, F)` to `(N, F*F, d)`.
fn map_to_tokens(map: Tensor<4>) -> Tensor<3> {
    let [n, d, h, w] = map.dims();
    map.reshape([n, d, h * w]).swap_dims(1, 2)
}
