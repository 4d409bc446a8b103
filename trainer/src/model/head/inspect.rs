//! The head as the reference writes it (spec 1.3 to 1.8), every intermediate kept.

use super::{Head, instance_l2_norm, map_to_tokens, positional_code, relu};
use crate::import::StateDict;
use crate::model::inspect::{HeadInput, Mode, keep};
use burn::prelude::*;

impl Head {
    /// Convolution and norm of a head feature, `(B, C, F, F)` to `(B, d, F, F)`.
    pub fn inspect_feature(&self, map: Tensor<4>) -> [(&'static str, Tensor<4>); 2] {
        let conv = self.feature_extractor.forward(map);
        [("head.conv", conv.clone()), ("head.feat", instance_l2_norm(conv, self.filter_size))]
    }

    /// Everything from head features to maps; see [`crate::model::TrackerNet::inspect`].
    pub fn inspect(&self, input: &HeadInput, mode: Mode) -> StateDict {
        let mut found = StateDict::default();
        let [b, d, f, _] = input.search.dims();
        let (cells, device) = (f * f, input.search.device());
        let count = input.templates.dims()[0] / b;
        let predictor = &self.filter_predictor;
        // In tracking mode the one sequence stands in two rows: classification and boxes.
        let rows = |x: Tensor<3>| match mode {
            Mode::Parallel { .. } => x.repeat_dim(0, 2),
            Mode::Single => x,
        };

        let ltrb = input.ltrb.clone().reshape([b * count, 4, cells]).swap_dims(1, 2);
        let boxes = predictor.box_encoding.forward(ltrb.reshape([b * count * cells, 4]));
        let boxes = boxes.reshape([b, count * cells, d]);
        keep(&mut found, "enc.ltrb_mlp", rows(boxes.clone().swap_dims(1, 2)));
        let e_fg = predictor.query_embed_fg.val();
        let label = input.labels.clone().reshape([b, count * cells, 1]);
        let feature = map_to_tokens(input.templates.clone()).reshape([b, count * cells, d]);
        let templates = feature + label * e_fg.clone().reshape([1, 1, d]) + boxes;
        let search = map_to_tokens(input.search.clone());
        let search = match &predictor.query_embed_test {
            Some(e_test) => search + e_test.val().reshape([1, 1, d]),
            None => search,
        };
        let tokens = rows(Tensor::cat(vec![templates, search], 1));
        keep(&mut found, "encoder.input", tokens.clone().swap_dims(0, 1));
        let l = (count + 1) * cells;
        let code = TensorData::new(positional_code(f, d).repeat(count + 1), [1, l, d]);
        let position = Tensor::<3>::from_data(code, &device);
        keep(&mut found, "encoder.pos", position.clone().swap_dims(0, 1));
        let mask = match mode {
            Mode::Parallel { annotated } => {
                let hidden =
                    |i: usize| i >= l && (annotated * cells..count * cells).contains(&(i - l));
                let flags = (0..2 * l).map(|i| f32::from(u8::from(hidden(i)))).collect::<Vec<_>>();
                let data = TensorData::new(flags.clone(), [2, l]);
                keep(&mut found, "encoder.key_padding_mask", Tensor::<2>::from_data(data, &device));
                let logits = flags.iter().map(|v| if *v > 0.0 { f32::NEG_INFINITY } else { 0.0 });
                let data = TensorData::new(logits.collect::<Vec<_>>(), [2, 1, 1, l]);
                Some(Tensor::<4>::from_data(data, &device))
            }
            Mode::Single => None,
        };
        let (memory, filter) =
            predictor.transformer.inspect(tokens, &position, e_fg, mask.as_ref(), &mut found);
        let encoded = memory.narrow(1, l - cells, cells);
        let (cls, reg) = match mode {
            Mode::Parallel { .. } => (0..1, 1..2),
            Mode::Single => (0..b, 0..b),
        };
        let part = |range: std::ops::Range<usize>| {
            (filter.clone().slice([range.clone()]), encoded.clone().slice([range]))
        };
        self.inspect_maps("cls", part(cls), f, &mut found);
        self.inspect_maps("reg", part(reg), f, &mut found);
        found
    }

    /// One head on its row: `which` is `cls` or `reg`.
    fn inspect_maps(
        &self,
        which: &str,
        (filter, encoded): (Tensor<2>, Tensor<3>),
        f: usize,
        found: &mut StateDict,
    ) {
        let [b, cells, d] = encoded.dims();
        let map = encoded.clone().swap_dims(1, 2).reshape([b, d, f, f]);
        keep(found, &format!("{which}_filter"), filter.clone().reshape([b, d, 1, 1]));
        keep(found, &format!("{which}_enc"), map.clone().unsqueeze_dim::<5>(0));
        let linear =
            if which == "cls" { &self.classifier.linear } else { &self.bb_regressor.linear };
        let weights = linear.forward(filter);
        keep(found, &format!("{which}.filter_proj"), weights.clone());
        let attention = encoded.matmul(weights.reshape([b, d, 1])).reshape([b, 1, cells]);
        let attention = attention.reshape([b, 1, f, f]);
        if which == "cls" {
            keep(found, "scores", attention.swap_dims(0, 1));
            return;
        }
        let tower = &self.bb_regressor.tower;
        let x =
            tower.iter().fold(map * attention, |x, layer| relu(layer.norm(layer.conv.forward(x))));
        keep(found, "reg.tower", x.clone());
        let x = self.bb_regressor.bbreg_layer.forward(x);
        keep(found, "reg.pre_exp", x.clone());
        keep(found, "ltrb", x.exp().unsqueeze_dim::<5>(0));
    }
}
