//! Looking inside the network: every intermediate the golden figures hold.
//!
//! [`TrackerNet::inspect_features`] and [`TrackerNet::inspect`] run the parameters of the module the
//! way the reference writes the network down: batch norms unfolded, tracking mode as two rows over
//! all tokens of which one hides keys (spec 1.7), every key and value projected. They are slow and
//! allocate everything; they exist so that the re-arranged inference functions have something
//! independent to be compared with, with any number of templates.
//! [`TrackerNet::predict_parts`] and [`TrackerNet::single_parts`] are the re-arranged computations
//! themselves with the values that decide the maps, for recording as graphs with more outputs.
//!
//! Names are those of the golden figures without their `inter.` prefix; shapes too, e.g.
//! `encoder.layer0` is `(tokens, rows, d)`.

use super::TrackerNet;
use super::backbone::BackboneNet;
use crate::import::{StateDict, StateTensor};
use burn::prelude::*;

/// Which pass of spec 1.7.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Mode {
    /// Tracking: one sequence in two rows; the box row sees the first `annotated` templates and the
    /// search frame only.
    Parallel {
        /// Templates whose box is known, at least 1.
        annotated: usize,
    },
    /// Training: any number of sequences, both heads on the same row.
    Single,
}

/// What the head works on.
#[derive(Clone, Debug)]
pub struct HeadInput {
    /// Head features of the templates, `(B*N, d, F, F)`, sequence by sequence.
    pub templates: Tensor<4>,
    /// Head features of the search frames, `(B, d, F, F)`.
    pub search: Tensor<4>,
    /// Gaussian labels of the templates, `(B*N, F, F)`.
    pub labels: Tensor<3>,
    /// Boxes of the templates as distances, `(B*N, 4, F, F)`.
    pub ltrb: Tensor<4>,
}

/// The maps of one search frame and what they were computed from.
#[derive(Clone, Debug)]
pub struct Parts {
    /// `(F, F)`.
    pub scores: Tensor<2>,
    /// `(4, F, F)`.
    pub ltrb: Tensor<3>,
    /// Filter of the classifier before its projection, `(1, d)`.
    pub cls_filter: Tensor<2>,
    /// Filter of the box regressor before its projection, `(1, d)`.
    pub reg_filter: Tensor<2>,
    /// Encoded search frame the classifier works on, `(d, F, F)`.
    pub cls_enc: Tensor<3>,
    /// Encoded search frame the box regressor works on, `(d, F, F)`.
    pub reg_enc: Tensor<3>,
}

/// Adds a tensor to the figures found.
pub(crate) fn keep<const D: usize>(found: &mut StateDict, name: &str, tensor: Tensor<D>) {
    let shape = tensor.dims().to_vec();
    let values = tensor.into_data().iter::<f32>().collect();
    found.insert(name.into(), StateTensor { shape, values });
}

impl TrackerNet {
    /// Head features `(B, d, F, F)` of crops `(B, 3, S, S)` and the maps on the way there:
    /// `bb.maxpool`, `bb.layer1` to `bb.layer3` (the last only, for other backbones than ResNet),
    /// `head.conv` and `head.feat`.
    pub fn inspect_features(&self, crops: Tensor<4>) -> (Tensor<4>, StateDict) {
        let maps = match &self.feature_extractor {
            BackboneNet::ResNet(net) => net.inspect(crops),
            net => vec![("bb.layer3", net.forward(crops, self.frozen))],
        };
        let mut found = StateDict::default();
        for (name, map) in &maps {
            keep(&mut found, name, map.clone());
        }
        // A backbone has at least one map.
        let last = maps.into_iter().next_back().map(|(_, map)| map);
        let last = last.unwrap_or_else(|| Tensor::zeros([1, 1, 1, 1], &self.head.device()));
        let [conv, feature] = self.head.inspect_feature(last);
        keep(&mut found, conv.0, conv.1);
        keep(&mut found, feature.0, feature.1.clone());
        (feature.1, found)
    }

    /// Every intermediate from head features to maps, as written in the reference.
    ///
    /// # Panics
    /// When the shapes of `input` do not go together; in [`Mode::Parallel`] there is one sequence.
    pub fn inspect(&self, input: &HeadInput, mode: Mode) -> StateDict {
        self.head.inspect(input, mode)
    }

    /// [`TrackerNet::predict`] with the values its maps are computed from.
    ///
    /// # Panics
    /// When `templates` is empty.
    pub fn predict_parts(&self, templates: Vec<Tensor<2>>, search: Tensor<4>) -> Parts {
        assert!(!templates.is_empty(), "predict needs the slot of at least one template");
        let side = search.dims()[2];
        let frames = self.prepared(templates, search);
        let run = |frames| self.head.predict_filter_prepared(Tensor::cat(frames, 1), side);
        let cls = run(frames.clone());
        let reg = match frames.as_slice() {
            [_, _] => cls.clone(),
            [annotated, .., search] => run(vec![annotated.clone(), search.clone()]),
            _ => unreachable!("a template and the search frame"),
        };
        self.parts(cls, reg, side)
    }

    /// The single mode of spec 1.7 on one sequence: both heads see all templates.
    ///
    /// # Panics
    /// When `templates` is empty.
    pub fn single_parts(&self, templates: Vec<Tensor<2>>, search: Tensor<4>) -> Parts {
        assert!(!templates.is_empty(), "a pass needs the slot of at least one template");
        let side = search.dims()[2];
        let frames = self.prepared(templates, search);
        let both = self.head.predict_filter_prepared(Tensor::cat(frames, 1), side);
        self.parts(both.clone(), both, side)
    }

    fn parts(
        &self,
        cls: (Tensor<2>, Tensor<3>),
        reg: (Tensor<2>, Tensor<3>),
        side: usize,
    ) -> Parts {
        let d = cls.0.dims()[1];
        let map = |encoded: &Tensor<3>| encoded.clone().swap_dims(1, 2).reshape([d, side, side]);
        Parts {
            scores: self.head.scores(cls.0.clone(), cls.1.clone(), side).reshape([side, side]),
            ltrb: self.head.ltrb(reg.0.clone(), reg.1.clone(), side).reshape([4, side, side]),
            cls_enc: map(&cls.1),
            reg_enc: map(&reg.1),
            cls_filter: cls.0,
            reg_filter: reg.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::NetOptions;
    use burn::tensor::Distribution;
    use tsda_runtime::{Backbone, ModelSpec};

    fn net(seed: u64) -> TrackerNet {
        let spec = ModelSpec {
            backbone: Backbone::ResNet { base_channels: 4, blocks: [1, 1, 2] },
            crop: 64,
            width: 32,
            feed_forward: 48,
            ltrb_hidden: 8,
            ..ModelSpec::NANO
        };
        let device = Device::flex();
        device.seed(seed);
        TrackerNet::new(&spec, &NetOptions::default(), &device).unwrap()
    }

    fn random<const D: usize>(shape: [usize; D], low: f64, high: f64) -> Tensor<D> {
        Tensor::random(shape, Distribution::Uniform(low, high), &Device::flex())
    }

    fn difference<const D: usize>(got: Tensor<D>, found: &StateDict, name: &str) -> f32 {
        let want = &found.get(name).unwrap().values;
        let got: Vec<f32> = got.into_data().iter::<f32>().collect();
        assert_eq!(got.len(), want.len(), "{name}");
        got.iter().zip(want).fold(0.0, |max: f32, (a, b)| max.max((a - b).abs()))
    }

    #[test]
    fn the_rearranged_functions_equal_the_network_as_written() {
        let net = net(3);
        for count in 1..=4 {
            let crops = random([count + 1, 3, 64, 64], -2.0, 2.0);
            let (features, _) = net.inspect_features(crops.clone());
            let plain = net.features(crops);
            let off = (plain - features.clone()).abs().max().into_scalar::<f32>();
            assert!(off <= 1e-6, "{count}: features {off}");
            let input = HeadInput {
                templates: features.clone().narrow(0, 0, count),
                search: features.narrow(0, count, 1),
                labels: random([count, 4, 4], 0.0, 1.0),
                ltrb: random([count, 4, 4, 4], -0.5, 0.5),
            };
            let tokens: Vec<_> = (0..count)
                .map(|i| {
                    net.template(
                        input.templates.clone().narrow(0, i, 1),
                        input.labels.clone().narrow(0, i, 1).reshape([4, 4]),
                        input.ltrb.clone().narrow(0, i, 1).reshape([4, 4, 4]),
                    )
                })
                .collect();
            let written = net.inspect(&input, Mode::Parallel { annotated: 1 });
            let (scores, ltrb) = net.predict(tokens.clone(), input.search.clone());
            let parts = net.predict_parts(tokens.clone(), input.search.clone());
            let single = net.inspect(&input, Mode::Single);
            let one = net.single_parts(tokens, input.search.clone());
            for (what, off) in [
                ("scores", difference(scores, &written, "scores")),
                ("ltrb", difference(ltrb, &written, "ltrb")),
                ("parts scores", difference(parts.scores, &written, "scores")),
                ("parts ltrb", difference(parts.ltrb, &written, "ltrb")),
                ("cls_filter", difference(parts.cls_filter, &written, "cls_filter")),
                ("reg_filter", difference(parts.reg_filter, &written, "reg_filter")),
                ("cls_enc", difference(parts.cls_enc, &written, "cls_enc")),
                ("reg_enc", difference(parts.reg_enc, &written, "reg_enc")),
                ("single scores", difference(one.scores, &single, "scores")),
                ("single ltrb", difference(one.ltrb, &single, "ltrb")),
            ] {
                assert!(off <= 2e-5, "{count} templates, {what}: {off}");
            }
        }
    }

    #[test]
    fn hiding_more_or_fewer_templates_changes_the_box_row_only() {
        let net = net(4);
        let input = HeadInput {
            templates: random([3, 32, 4, 4], -0.3, 0.3),
            search: random([1, 32, 4, 4], -0.3, 0.3),
            labels: random([3, 4, 4], 0.0, 1.0),
            ltrb: random([3, 4, 4, 4], -0.5, 0.5),
        };
        let of = |annotated| net.inspect(&input, Mode::Parallel { annotated });
        let (one, two, all, single) = (of(1), of(2), of(3), net.inspect(&input, Mode::Single));
        let values = |d: &StateDict, name: &str| d.get(name).unwrap().values.clone();
        assert_eq!(values(&one, "scores"), values(&two, "scores"));
        assert_ne!(values(&one, "ltrb"), values(&two, "ltrb"));
        assert_ne!(values(&two, "ltrb"), values(&all, "ltrb"));
        // Nothing hidden: both rows are the single pass.
        let near = |a: Vec<f32>, b: Vec<f32>| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
        assert!(near(values(&all, "ltrb"), values(&single, "ltrb")));
        assert_eq!(one.get("encoder.key_padding_mask").unwrap().values.iter().sum::<f32>(), 32.0);
    }
}
