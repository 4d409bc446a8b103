//! The network against the reference (golden vectors) and against itself.

mod as_written;
mod mobilenet;
mod rearrangements;

use super::*;
use crate::import::{self, StateDict, StateTensor};
use burn::module::{ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::Gradients;
use std::path::Path;
use tsda_runtime::Backbone;

/// The small configuration of the golden vectors.
pub(crate) fn small(test_embedding: bool) -> ModelSpec {
    ModelSpec { test_embedding, ..ModelSpec::SMALL }
}

pub(crate) const NO_DROPOUT: NetOptions =
    NetOptions { dropout: 0.0, attention_dropout: 0.0, freeze: FreezePolicy::BeforeStride16 };

/// Numbers in `[-1, 1)` from a name: FNV-1a seeds a splitmix64 stream (golden README).
pub(crate) fn stream(name: &str) -> impl Iterator<Item = u64> + use<> {
    let hash = name
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    (1u64..).map(move |i| {
        let mut z = hash.wrapping_add(i.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    })
}

/// The recipe's value of a tensor with this state-dict name.
pub(crate) fn recipe(name: &str, shape: &[usize]) -> Vec<f32> {
    let numel: usize = shape.iter().product();
    let (a, b) = if name.ends_with("running_mean") {
        (0.0, 0.2)
    } else if name.ends_with("running_var") {
        (1.0, 0.5)
    } else if name.contains("query_embed_") {
        (0.0, 1.0)
    } else if shape.len() == 1 && name.ends_with("bn3.weight") {
        (0.3, 0.1)
    } else if shape.len() == 1 && name.ends_with(".weight") {
        (1.0, 0.2)
    } else if shape.len() == 1 {
        (0.0, 0.1)
    } else {
        let g = match name {
            "head.classifier.linear.weight" | "head.bb_regressor.linear.weight" => 1.0 / 64.0,
            "head.bb_regressor.bbreg_layer.weight" => 0.25,
            n if n.starts_with("feature_extractor.") || n.contains(".tower.") => 2.0,
            _ => 1.0,
        };
        (0.0, (3.0f64 * g / (numel / shape[0]) as f64).sqrt())
    };
    stream(name)
        .take(numel)
        .map(|z| {
            let r = 2.0 * ((z >> 40) as f64 / 16_777_216.0) - 1.0;
            (a + b * r) as f32
        })
        .collect()
}

/// A net with the recipe's weights.
pub(crate) fn recipe_net(spec: &ModelSpec, options: &NetOptions, device: &Device) -> TrackerNet {
    let net = TrackerNet::new(spec, options, device).unwrap();
    let mut dict = StateDict::default();
    for (name, tensor) in import::state_dict(&net).iter() {
        let values = recipe(name, &tensor.shape);
        dict.insert(name.into(), StateTensor { shape: tensor.shape.clone(), values });
    }
    import::apply(net, &dict, "").unwrap().0
}

/// Normalised recipe image `(3, side, side)` of a frame.
pub(crate) fn recipe_image(frame: usize, side: usize) -> Vec<f32> {
    let tri = |t: usize, p: usize| (t % (2 * p)).abs_diff(p);
    let mut noise = stream(&format!("image.{frame}"));
    let mut image = Vec::with_capacity(3 * side * side);
    for c in 0..3 {
        let (mean, std) =
            (tsda_runtime::spec::IMAGENET_MEAN[c], tsda_runtime::spec::IMAGENET_STD[c]);
        for y in 0..side {
            for x in 0..side {
                let z = (noise.next().unwrap() >> 58) as usize;
                let v = tri(3 * x + 5 * y + 40 * c + 31 * frame, 128)
                    + tri(x + 2 * y + 17 * frame, 64)
                    + z;
                image.push((v.min(255) as f32 / 255.0 - mean) / std);
            }
        }
    }
    image
}

pub(crate) fn shared(name: &str) -> Option<StateDict> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/golden/small").join(name);
    if !path.exists() {
        println!("skipped: {} is not there", path.display());
        return None;
    }
    Some(StateDict::read(&path).unwrap())
}

/// A file of reference figures that lives in the repository.
pub(crate) fn committed(name: &str) -> StateDict {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/model");
    StateDict::read(&folder.join(name)).unwrap()
}

/// Compact copies of the small network's inputs and expected results.
pub(crate) fn compact() -> StateDict {
    committed("small.safetensors")
}

fn tensor<const D: usize>(
    dict: &StateDict,
    name: &str,
    shape: [usize; D],
    d: &Device,
) -> Tensor<D> {
    let found = dict.get(name).unwrap_or_else(|| panic!("no {name}"));
    Tensor::from_data(TensorData::new(found.values.clone(), shape), d)
}

pub(crate) fn values<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().iter::<f32>().collect()
}

/// Largest absolute difference; lengths must agree.
pub(crate) fn difference(got: &[f32], want: &[f32]) -> f32 {
    assert_eq!(got.len(), want.len());
    got.iter().zip(want).fold(0.0f32, |m, (g, w)| m.max((g - w).abs()))
}

/// Tracking mode of the recipe's net on sequence `seq` with `count` templates; score map and ltrb.
fn track(spec: &ModelSpec, seq: usize, count: usize, dict: &StateDict) -> (Vec<f32>, Vec<f32>) {
    track_with(&recipe_net(spec, &NO_DROPOUT, &Device::flex()), seq, count, dict)
}

/// [`track`] with any net of the small configuration.
pub(crate) fn track_with(
    net: &TrackerNet,
    seq: usize,
    count: usize,
    dict: &StateDict,
) -> (Vec<f32>, Vec<f32>) {
    let device = Device::flex();
    let (s, f) = (net.spec().crop_side(), net.spec().map_side());
    let image = |frame| {
        let data = TensorData::new(recipe_image(frame, s), [1, 3, s, s]);
        Tensor::<4>::from_data(data, &device)
    };
    let labels = tensor(dict, &format!("seq{seq}.train_label"), [2, f, f], &device);
    let ltrb = tensor(dict, &format!("seq{seq}.train_ltrb"), [2, 4, f, f], &device);
    let templates = (0..count)
        .map(|i| {
            let feature = net.features(image(10 * seq + i));
            let label = labels.clone().narrow(0, i, 1).reshape([f, f]);
            let ltrb = ltrb.clone().narrow(0, i, 1).reshape([4, f, f]);
            net.template(feature, label, ltrb)
        })
        .collect();
    let (scores, ltrb) = net.predict(templates, net.features(image(10 * seq + 2)));
    (values(scores), values(ltrb))
}

#[test]
fn tracking_mode_equals_the_reference() {
    let dict = compact();
    for (case, seq, count, test_embedding) in
        [("case_a", 0, 2, true), ("case_b", 1, 1, true), ("case_d", 2, 2, false)]
    {
        let (scores, ltrb) = track(&small(test_embedding), seq, count, &dict);
        let want = |what: &str| &dict.get(&format!("{case}.{what}")).unwrap().values;
        let (s, l) = (difference(&scores, want("scores")), difference(&ltrb, want("ltrb")));
        println!("{case}: scores {s:.1e}, ltrb {l:.1e}");
        assert!(s <= 2e-5 && l <= 2e-5, "{case}: scores {s}, ltrb {l}");
    }
}

#[test]
fn efficientnet_equals_a_numpy_reference() {
    let (spec, device) = (tiny(), Device::flex());
    let net = recipe_net(&spec, &NO_DROPOUT, &device);
    let image = TensorData::new(recipe_image(0, 64), [1, 3, 64, 64]);
    let image = Tensor::<4>::from_data(image, &device);
    let want = committed("efficientnet_lite0_64.safetensors");
    let want = &want.get("feature").unwrap().values;
    let peak = want.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let plain = net.feature_extractor.forward(image.clone(), net.frozen);
    let wide = net.feature_extractor.forward_wide(image, net.frozen).swap_dims(0, 1);
    for (road, map) in [("plain", plain), ("wide", wide)] {
        let off = difference(&values(map), want);
        assert!(off <= 1e-5 * peak, "{road}: off by {off} of {peak}");
    }
}

/// Inputs of the three golden sequences as one batch.
pub(crate) struct Batch {
    pub(crate) templates: Tensor<4>,
    pub(crate) search: Tensor<4>,
    pub(crate) labels: Tensor<3>,
    pub(crate) ltrb: Tensor<4>,
}

pub(crate) fn batch(dict: &StateDict, spec: &ModelSpec, device: &Device) -> Batch {
    let (s, f) = (spec.crop_side(), spec.map_side());
    let image = |frame| {
        let data = TensorData::new(recipe_image(frame, s), [1, 3, s, s]);
        Tensor::<4>::from_data(data, device)
    };
    let each = |part: &dyn Fn(usize) -> Tensor<4>| Tensor::cat((0..3).map(part).collect(), 0);
    Batch {
        templates: each(&|q| Tensor::cat(vec![image(10 * q), image(10 * q + 1)], 0)),
        search: each(&|q| image(10 * q + 2)),
        labels: each(&|q| tensor(dict, &format!("seq{q}.train_label"), [2, 1, f, f], device))
            .reshape([6, f, f]),
        ltrb: each(&|q| tensor(dict, &format!("seq{q}.train_ltrb"), [2, 4, f, f], device)),
    }
}

#[test]
fn single_mode_equals_the_reference() {
    let (dict, spec) = (compact(), small(true));
    let device = Device::flex();
    let net = recipe_net(&spec, &NO_DROPOUT, &device);
    let b = batch(&dict, &spec, &device);
    let out = net.forward_train(b.templates, b.search, b.labels, b.ltrb);
    let want = |what: &str| &dict.get(&format!("case_c.{what}")).unwrap().values;
    let s = difference(&values(out.scores), want("scores"));
    let l = difference(&values(out.ltrb), want("ltrb"));
    println!("case_c: scores {s:.1e}, ltrb {l:.1e}");
    assert!(s <= 2e-5 && l <= 2e-5, "scores {s}, ltrb {l}");
}

/// Real size: 50 million weights, some 100 billion operations.
#[test]
#[ignore = "half a minute of CPU time; run with --ignored"]
fn tomp101_equals_the_reference() {
    let (Some(case), Some(inputs)) =
        (shared("../full/tomp101.safetensors"), shared("../full/inputs.safetensors"))
    else {
        return;
    };
    let (spec, device) = (ModelSpec::TOMP101, Device::flex());
    let (s, f) = (spec.crop_side(), spec.map_side());
    let net = recipe_net(&spec, &NO_DROPOUT, &device);
    let feature = |frame| {
        let image = TensorData::new(recipe_image(frame, s), [1, 3, s, s]);
        net.features(Tensor::from_data(image, &device))
    };
    let labels = tensor(&inputs, "train_label", [2, f, f], &device);
    let ltrb = tensor(&inputs, "train_ltrb", [2, 4, f, f], &device);
    let templates: Vec<_> = (0..2)
        .map(|i| {
            let label = labels.clone().narrow(0, i, 1).reshape([f, f]);
            net.template(feature(i), label, ltrb.clone().narrow(0, i, 1).reshape([4, f, f]))
        })
        .collect();
    let search = feature(2);
    for (case_name, count) in [("parallel1", 1), ("parallel2", 2)] {
        let (scores, ltrb) = net.predict(templates[..count].to_vec(), search.clone());
        let want = |what: &str| &case.get(&format!("{case_name}.{what}")).unwrap().values;
        let (s, l) =
            (difference(&values(scores), want("scores")), difference(&values(ltrb), want("ltrb")));
        println!("{case_name}: scores {s:.1e}, ltrb {l:.1e}");
        assert!(s <= 2e-5 && l <= 2e-5, "{case_name}: scores {s}, ltrb {l}");
    }
}

#[test]
fn intermediate_figures_equal_the_reference() {
    let Some(case) = shared("case_a_parallel_2train_1gt.safetensors") else { return };
    let Some(inputs) = shared("inputs.safetensors") else { return };
    let (spec, device) = (small(true), Device::flex());
    let (s, f, d) = (spec.crop_side(), spec.map_side(), 64);
    let net = recipe_net(&spec, &NO_DROPOUT, &device);
    let close = |what: &str, got: Vec<f32>, tolerance: f32| {
        let off = difference(&got, &case.get(what).unwrap().values);
        assert!(off <= tolerance, "{what}: {off}");
    };
    let test = tensor(&inputs, "seq0.test_img", [1, 3, s, s], &device);
    assert!(difference(&recipe_image(2, s), &values(test.clone())) <= 1e-6);
    let layer3 = net.feature_extractor.forward(test, net.frozen);
    let peak = case.get("test_layer3").unwrap().values.iter().fold(0.0f32, |m, v| m.max(*v));
    close("test_layer3", values(layer3.clone()), 2e-6 * peak);
    let search = net.head.feature(layer3);
    close("test_feat", values(search.clone()), 1e-6);
    let train = net.features(tensor(&inputs, "seq0.train_img", [2, 3, s, s], &device));
    close("train_feat", values(train.clone()), 1e-6);

    let label = tensor(&inputs, "seq0.train_label", [2, f, f], &device);
    let ltrb = tensor(&inputs, "seq0.train_ltrb", [2, 4, f, f], &device);
    let templates = net.head.template_tokens(train, label, ltrb).reshape([1, 2 * f * f, d]);
    let tokens = Tensor::cat(vec![templates, net.head.search_tokens(search)], 1);
    // Both rows of the reference's input are equal; take row 0 of (tokens, rows, channels).
    let input = &case.get("inter.encoder.input").unwrap().values;
    let row: Vec<f32> = input.chunks(2 * d).flat_map(|both| &both[..d]).copied().collect();
    assert!(difference(&values(tokens.clone()), &row) <= 1e-5);
    let (filter, memory) = net.head.predict_filter(tokens, f);
    let encoded = memory.narrow(1, 2 * f * f, f * f).swap_dims(1, 2).reshape([1, d, f, f]);
    close("cls_enc", values(encoded), 2e-5);
    // `cls_filter` is the filter before the classifier's projection.
    close("cls_filter", values(filter), 2e-5);
}

#[test]
fn positional_code_equals_the_reference() {
    let (d, f) = (64, 9);
    let Some(case) = shared("case_a_parallel_2train_1gt.safetensors") else { return };
    let want = &case.get("inter.encoder.pos").unwrap().values[..f * f * d];
    assert!(difference(&layers::positional_code(f, d), want) <= 2e-6);
}

/// What a backward pass left behind, in one of burn's two forms.
pub(crate) trait GradientsOf {
    fn of<const D: usize>(&self, param: &Param<Tensor<D>>) -> Option<Tensor<D>>;
}

impl GradientsOf for Gradients {
    fn of<const D: usize>(&self, param: &Param<Tensor<D>>) -> Option<Tensor<D>> {
        param.val().grad(self)
    }
}

impl GradientsOf for GradientsParams {
    fn of<const D: usize>(&self, param: &Param<Tensor<D>>) -> Option<Tensor<D>> {
        self.get(param.id)
    }
}

/// Gradients by state-dict name.
struct GradientDict<'a, G> {
    path: Vec<String>,
    gradients: &'a G,
    dict: StateDict,
}

impl<G: GradientsOf> ModuleVisitor for GradientDict<'_, G> {
    fn enter_module(&mut self, name: &str, _container: &str) {
        self.path.push(name.into());
    }

    fn exit_module(&mut self, _name: &str, _container: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let Some(gradient) = self.gradients.of(param) else { return };
        let (name, layout) = state_dict_name(&self.path);
        let shape: Vec<usize> = gradient.dims().to_vec();
        let values = if layout.is_transposed() {
            values(gradient.swap_dims(0, 1))
        } else {
            values(gradient)
        };
        self.dict.insert(name, StateTensor { shape, values });
    }
}

pub(crate) fn gradients(net: &TrackerNet, gradients: &impl GradientsOf) -> StateDict {
    let mut visitor = GradientDict { path: Vec::new(), gradients, dict: StateDict::default() };
    net.visit(&mut visitor);
    visitor.dict
}

/// A nano-like network small enough for a test.
fn tiny() -> ModelSpec {
    ModelSpec { crop: 64, width: 32, feed_forward: 64, ltrb_hidden: 16, ..ModelSpec::NANO }
}

#[test]
fn the_fast_training_road_equals_the_plain_one() {
    let spec = tiny();
    let (s, f) = (spec.crop_side(), spec.map_side());
    let plain = Device::flex();
    let random = |name: &str, n: usize| -> Vec<f32> {
        stream(name).take(n).map(|z| (z >> 40) as f32 / 8_388_608.0 - 1.0).collect()
    };
    let crops = TensorData::new(random("x", 9 * s * s), [3, 3, s, s]);
    let crops = Tensor::<4>::from_data(crops, &plain);
    // Values with a gradient of their own for every output.
    let weight = TensorData::new(random("w", 3 * 32 * f * f), [3, 32, f, f]);
    let weight = Tensor::<4>::from_data(weight, &plain);
    // As shipped, and with every block (all kernels at both strides) on the graph.
    for (freeze, first) in [(FreezePolicy::BeforeStride16, 5), (FreezePolicy::Leading(0), 0)] {
        let options = NetOptions { freeze, ..NO_DROPOUT };
        let net = recipe_net(&spec, &options, &Device::flex().autodiff());
        let run = |features: Tensor<4>| {
            let gradient = (features.clone() * weight.clone()).sum().backward();
            (values(features), gradients(&net, &gradient))
        };
        let (fast, fast_gradients) = run(net.training_features(crops.clone()));
        let (slow, slow_gradients) = run(net.features(crops.clone()));
        assert!(difference(&fast, &slow) <= 1e-5);
        let names: Vec<&str> = slow_gradients.names().collect();
        assert_eq!(names, fast_gradients.names().collect::<Vec<_>>());
        let trains =
            |block: usize| names.iter().any(|n| n.contains(&format!("._blocks.{block}._dep")));
        assert!((0..11).all(|block| trains(block) == (block >= first)), "{names:?}");
        for name in &names {
            let [a, b] = [&fast_gradients, &slow_gradients].map(|g| &g.get(name).unwrap().values);
            let scale = b.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            let off = difference(a, b);
            assert!(off <= 2e-4 * scale, "{freeze:?} {name}: off by {off} of {scale}");
        }
    }
}

#[test]
fn names_and_shapes_are_those_of_the_published_checkpoints() {
    for (spec, file) in [(ModelSpec::TOMP50, "tomp50"), (small(true), "small")] {
        let net = TrackerNet::new(&spec, &NO_DROPOUT, &Device::flex()).unwrap();
        let ours = import::state_dict(&net);
        if file == "small" {
            let Some(dict) = shared("weights.safetensors") else { continue };
            let theirs: Vec<_> = dict.iter().map(|(n, t)| (n, t.shape.clone())).collect();
            let ours: Vec<_> = ours.iter().map(|(n, t)| (n, t.shape.clone())).collect();
            assert_eq!(ours, theirs);
            continue;
        }
        let table = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join(format!("../../shared/design/{file}-state-dict.tsv"));
        let Ok(table) = std::fs::read_to_string(&table) else {
            println!("skipped: {} is not there", table.display());
            continue;
        };
        for (name, tensor) in ours.iter() {
            let shape: Vec<String> = tensor.shape.iter().map(ToString::to_string).collect();
            let want = (Some(name), Some(shape.join("x")));
            let there = table.lines().any(|line| {
                let mut cells = line.split('\t');
                (cells.next(), cells.next().map(str::to_string)) == want
            });
            assert!(there, "{name} {:?}", tensor.shape);
        }
    }
}

#[test]
fn freeze_patterns_compile_and_match() {
    for (backbone, policy, trains, frozen) in [
        (
            Backbone::EfficientNetLite0,
            FreezePolicy::Leading(2),
            "feature_extractor.EfficientNet.blocks.2.bn1.weight",
            "feature_extractor.EfficientNet.blocks.1.bn1.weight",
        ),
        (
            Backbone::ResNet { base_channels: 8, blocks: [1, 1, 1] },
            FreezePolicy::BeforeStride16,
            "feature_extractor.ResNet.layer3.0.conv1.weight",
            "feature_extractor.ResNet.layer2.0.conv1.weight",
        ),
        (
            Backbone::EfficientNetLite0,
            FreezePolicy::All,
            "head.classifier.linear.weight",
            "feature_extractor.EfficientNet.blocks.10.project_conv.weight",
        ),
        (
            Backbone::EfficientNetLite0,
            FreezePolicy::None,
            "feature_extractor.EfficientNet.conv_stem.weight",
            "feature_extractor.EfficientNet.bn0.running_var",
        ),
    ] {
        let spec = ModelSpec { backbone, ..tiny() };
        let options = NetOptions { freeze: policy, ..NO_DROPOUT };
        let net = TrackerNet::new(&spec, &options, &Device::flex().autodiff()).unwrap();
        struct Find(Vec<String>, Vec<(String, bool)>);
        impl ModuleVisitor for Find {
            fn enter_module(&mut self, name: &str, _: &str) {
                self.0.push(name.into());
            }
            fn exit_module(&mut self, _: &str, _: &str) {
                self.0.pop();
            }
            fn visit_float<const D: usize>(&mut self, p: &Param<Tensor<D>>) {
                self.1.push((self.0.join("."), p.val().is_require_grad()));
            }
        }
        let mut find = Find(Vec::new(), Vec::new());
        net.visit(&mut find);
        let of = |path: &str| find.1.iter().find(|(p, _)| p == path).map(|(_, t)| *t);
        assert_eq!(of(trains), Some(true), "{policy:?}: {trains}");
        assert_eq!(of(frozen), Some(false), "{policy:?}: {frozen}");
    }
}

#[test]
fn bad_options_are_named() {
    let options = NetOptions { dropout: 1.0, ..NO_DROPOUT };
    let error = TrackerNet::new(&tiny(), &options, &Device::flex()).unwrap_err();
    assert_eq!(error.field, "dropout");
    let spec = ModelSpec { heads: 5, ..tiny() };
    assert_eq!(TrackerNet::new(&spec, &NO_DROPOUT, &Device::flex()).unwrap_err().field, "heads");
}
