//! Every re-arrangement of spec 4.2 and 4.3 against the network as the reference runs it.

use super::as_written::{AsWritten, Rearranged, Template, Weights};
use super::*;
use proptest::prelude::*;

const TOLERANCE: f32 = 2e-5;

fn weights(net: &TrackerNet) -> Weights {
    import::state_dict(net)
        .iter()
        .map(|(name, t)| (name.to_string(), (t.shape.clone(), t.values.clone())))
        .collect()
}

/// Numbers in `[-1, 1)`, different for every name.
fn random<const D: usize>(name: &str, dims: [usize; D]) -> Tensor<D> {
    let count = dims.iter().product();
    let values: Vec<f32> =
        stream(name).take(count).map(|z| (z >> 40) as f32 / 8_388_608.0 - 1.0).collect();
    Tensor::from_data(TensorData::new(values, dims), &Device::flex())
}

/// A template with a backbone feature, label and box of noise.
fn template(spec: &ModelSpec, i: usize) -> Template {
    let (c, f) = (spec.backbone.out_channels(), spec.map_side());
    Template {
        feature: random(&format!("template.{i}"), [1, c, f, f]),
        label: random(&format!("label.{i}"), [f, f]).abs(),
        ltrb: random(&format!("ltrb.{i}"), [4, f, f]),
    }
}

/// Head features, maps, filters and encoded search frames of one way to compute them.
struct Maps {
    scores: Vec<f32>,
    ltrb: Vec<f32>,
}

impl Maps {
    fn of((scores, ltrb): (Tensor<2>, Tensor<3>)) -> Self {
        Self { scores: values(scores), ltrb: values(ltrb) }
    }

    /// Largest absolute difference; of distances, relative to the largest where that is above 1.
    fn off(&self, want: &Self) -> f32 {
        let peak = want.ltrb.iter().fold(1.0f32, |m, v| m.max(*v));
        difference(&self.scores, &want.scores).max(difference(&self.ltrb, &want.ltrb) / peak)
    }
}

/// Largest difference of each way from the reference as written, for 1 to `spec.templates`
/// templates.
fn compare(spec: &ModelSpec) -> Vec<(String, f32)> {
    let device = Device::flex();
    let net = recipe_net(spec, &NO_DROPOUT, &device);
    let weights = weights(&net);
    let reference = AsWritten { spec: *spec, weights: &weights, device };
    let (c, f) = (spec.backbone.out_channels(), spec.map_side());
    let templates: Vec<Template> = (0..spec.templates.into()).map(|i| template(spec, i)).collect();
    let search = random("search", [1, c, f, f]);
    let ours = net.head.feature(search.clone());
    let theirs = reference.head_feature(search);
    let mut found = vec![(
        "head feature".to_string(),
        difference(&values(ours.clone()), &values(theirs.clone())) * 20.0,
    )];
    for count in 1..=templates.len() {
        let plain = Rearranged::default();
        let tokens = reference.template_tokens(&templates[..count], 2);
        let want = Maps::of(reference.predict(tokens.clone(), theirs.clone(), plain));
        assert!(want.scores.iter().chain(&want.ltrb).all(|v| v.is_finite()));
        let all = Rearranged { short_row: true, memory_space: true, value_only: true };
        for (name, with) in [
            ("short row", Rearranged { short_row: true, ..plain }),
            ("memory space", Rearranged { memory_space: true, ..plain }),
            ("value only", Rearranged { value_only: true, ..plain }),
            ("all three", all),
        ] {
            let got = Maps::of(reference.predict(tokens.clone(), theirs.clone(), with));
            found.push((format!("{name}, {count}"), got.off(&want)));
        }
        for form in [SlotForm::Tokens, SlotForm::Projected] {
            let slots: Vec<_> = templates[..count]
                .iter()
                .map(|t| {
                    let feature = net.head.feature(t.feature.clone());
                    net.template_as(form, feature, t.label.clone(), t.ltrb.clone())
                })
                .collect();
            let d = usize::from(spec.width);
            assert_eq!(slots[0].dims(), [f * f, form.columns(spec)]);
            // Tokens come first in either form.
            let tokens: Vec<_> = slots.iter().map(|s| s.clone().narrow(1, 0, d)).collect();
            let row = values(Tensor::cat(tokens, 0));
            let off = difference(&row, &values(reference.template_tokens(&templates[..count], 1)));
            found.push((format!("cached tokens, {form:?}, {count}"), off));
            let got = Maps::of(net.predict(slots, ours.clone()));
            found.push((format!("the network, {form:?}, {count}"), got.off(&want)));
        }
    }
    found
}

fn assert_close(spec: &ModelSpec) {
    let found = compare(spec);
    for (what, off) in &found {
        assert!(*off <= TOLERANCE, "{what}: off by {off:.1e} for {spec:?}");
    }
}

#[test]
fn every_rearrangement_equals_the_reference_as_written() {
    for test_embedding in [true, false] {
        let spec = ModelSpec { templates: 3, ..small(test_embedding) };
        for (what, off) in compare(&spec) {
            println!("{what}: {off:.1e}");
            assert!(off <= TOLERANCE, "{what}: off by {off:.1e}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, ..ProptestConfig::default() })]

    #[test]
    fn rearrangements_hold_for_any_shape(
        side in 2u16..8,
        (heads, depth) in (1u8..6, 1u16..6),
        feed_forward in 1u16..40,
        (encoder_layers, decoder_layers) in (1u8..4, 1u8..4),
        (templates, ltrb_hidden) in (1u8..5, 1u16..9),
        test_embedding: bool,
    ) {
        assert_close(&ModelSpec {
            backbone: Backbone::ResNet { base_channels: 2, blocks: [1, 1, 1] },
            crop: 16 * side,
            width: 4 * u16::from(heads) * depth,
            heads,
            feed_forward,
            encoder_layers,
            decoder_layers,
            ltrb_hidden,
            templates,
            test_embedding,
            ..ModelSpec::NANO
        });
    }
}

/// The reference as written is itself right: the golden cases, from the crops.
#[test]
fn the_reference_as_written_equals_the_golden_figures() {
    let dict = compact();
    let device = Device::flex();
    for (case, seq, count, test_embedding) in
        [("case_a", 0, 2, true), ("case_b", 1, 1, true), ("case_d", 2, 2, false)]
    {
        let spec = small(test_embedding);
        let net = recipe_net(&spec, &NO_DROPOUT, &device);
        let weights = weights(&net);
        let reference = AsWritten { spec, weights: &weights, device: device.clone() };
        let (s, f) = (spec.crop_side(), spec.map_side());
        let crop = |frame| {
            let data = TensorData::new(recipe_image(frame, s), [1, 3, s, s]);
            Tensor::<4>::from_data(data, &device)
        };
        let labels = tensor(&dict, &format!("seq{seq}.train_label"), [2, f, f], &device);
        let ltrb = tensor(&dict, &format!("seq{seq}.train_ltrb"), [2, 4, f, f], &device);
        let templates: Vec<Template> = (0..count)
            .map(|i| Template {
                feature: reference.backbone(crop(10 * seq + i)),
                label: labels.clone().narrow(0, i, 1).reshape([f, f]),
                ltrb: ltrb.clone().narrow(0, i, 1).reshape([4, f, f]),
            })
            .collect();
        let search = reference.head_feature(reference.backbone(crop(10 * seq + 2)));
        // Batch norms folded or not.
        let folded = net.features(crop(10 * seq + 2));
        let off = difference(&values(folded), &values(search.clone()));
        assert!(off <= 1e-6, "{case}: head feature off by {off}");
        let tokens = reference.template_tokens(&templates, 2);
        let (scores, ltrb) = reference.predict(tokens, search, Rearranged::default());
        for (what, got) in [("scores", values(scores)), ("ltrb", values(ltrb))] {
            let off = difference(&got, &dict.get(&format!("{case}.{what}")).unwrap().values);
            println!("{case}: {what} {off:.1e}");
            assert!(off <= TOLERANCE, "{case}: {what} off by {off}");
        }
    }
}
