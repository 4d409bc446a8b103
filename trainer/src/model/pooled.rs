//! Pooled descriptors: one vector per crop, before and after the encoder; what modality alignment
//! compares.

use super::{TrackerNet, TrainOutput};
use burn::prelude::*;

impl TrackerNet {
    /// One descriptor per sequence, `(B, d)`, of head features `(B*T, d, F, F)` before any encoding
    /// is added: the mean over the `T` frames of the mean over the cells. `T` is 1 for search
    /// frames.
    pub fn pool_features(features: Tensor<4>, frames: usize) -> Tensor<2> {
        let [n, d, h, w] = features.dims();
        let b = n / frames;
        features.reshape([b, frames, d, h * w]).mean_dim(3).mean_dim(1).reshape([b, d])
    }

    /// Descriptors of templates and of search frames after the encoder, `(B, d)` each: means of the
    /// encoder's outputs over the template tokens (all `T` frames) and over the search tokens.
    ///
    /// * `templates`: head features `(B*T, d, F, F)`, sequence by sequence;
    /// * `search`: head features `(B, d, F, F)`;
    /// * `labels`: `(B*T, F, F)`, the templates' Gaussian labels;
    /// * `ltrb`: `(B*T, 4, F, F)`, the templates' boxes (spec 2.4).
    pub fn pool_encoded(
        &self,
        templates: Tensor<4>,
        search: Tensor<4>,
        labels: Tensor<3>,
        ltrb: Tensor<4>,
    ) -> (Tensor<2>, Tensor<2>) {
        let [b, d, f, _] = search.dims();
        let cells = f * f;
        let count = templates.dims()[0] / b * cells;
        let templates = self.head.template_tokens(templates, labels, ltrb).reshape([b, count, d]);
        let tokens = Tensor::cat(vec![templates, self.head.search_tokens(search)], 1);
        pool_memory(self.head.encode(tokens, f), cells)
    }
}

/// Means of the encoder's outputs `(B, frames * cells, d)` over the template tokens and over the
/// search tokens, the last `cells`.
fn pool_memory(memory: Tensor<3>, cells: usize) -> (Tensor<2>, Tensor<2>) {
    let [b, length, d] = memory.dims();
    let mean = |first: usize, length: usize| {
        memory.clone().narrow(1, first, length).mean_dim(1).reshape([b, d])
    };
    (mean(0, length - cells), mean(length - cells, cells))
}

impl TrainOutput {
    /// Descriptors of templates and search frames before the encoder, `(B, d)` each; see
    /// [`TrackerNet::pool_features`]. No part of the network runs again.
    pub fn pooled_features(&self) -> (Tensor<2>, Tensor<2>) {
        let [b, t, d, h, w] = self.template_features.dims();
        let templates = self.template_features.clone().reshape([b * t, d, h, w]);
        let search = self.search_features.clone();
        (TrackerNet::pool_features(templates, t), TrackerNet::pool_features(search, 1))
    }

    /// Descriptors of templates and search frames after the encoder, `(B, d)` each; see
    /// [`TrackerNet::pool_encoded`]. No part of the network runs again.
    pub fn pooled_encoded(&self) -> (Tensor<2>, Tensor<2>) {
        let [_, _, h, w] = self.search_features.dims();
        pool_memory(self.memory.clone(), h * w)
    }
}
