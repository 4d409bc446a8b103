//! Every operation family: burn on flex against tract on the exported file, before and after
//! optimisation.

use burn::module::Module;
use burn::nn;
use burn::nn::conv::{Conv1dConfig, Conv2dConfig, ConvTranspose2dConfig};
use burn::nn::{LinearConfig, PaddingConfig2d};
use burn::tensor::activation as act;
use burn::tensor::{Device, Int, Tensor, TensorData};
use tract_onnx::prelude::{Framework, InferenceModelExt, IntoRunnable as _, TValue, tvec};
use tsda_export::onnx::*;

const TOLERANCE: f32 = 1e-5;

/// A name and a function that keeps the rank.
type Case<const D: usize> = (&'static str, fn(Tensor<D>) -> Tensor<D>);

/// Numbers in -1..1, the same on every machine.
fn noise(n: usize, seed: u64) -> Vec<f32> {
    let mut state = seed;
    let mut next = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    };
    (0..n).map(|_| next()).collect()
}

fn tensor<const D: usize>(dims: [usize; D], seed: u64, device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(noise(dims.iter().product(), seed), dims), device)
}

fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec::<f32>().unwrap()
}

/// Runs an ONNX file with everything inside in tract.
fn run(onnx: &[u8], dims: &[usize], input: &[f32]) -> Vec<f32> {
    let model = tract_onnx::onnx().model_for_read(&mut &*onnx).expect("tract reads the file");
    let plan = model.into_optimized().expect("tract plans").into_runnable().unwrap();
    let input = tract_onnx::prelude::Tensor::from_shape(dims, input).unwrap();
    let out: Vec<TValue> = plan.run(tvec!(input.into())).unwrap().into_iter().collect();
    out[0].try_as_plain_ram().unwrap().as_slice::<f32>().unwrap().to_vec()
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// Asserts that the exported form of `f` computes what `f` computes; returns the simplified graph.
fn agree<M: Module, const I: usize, const O: usize>(
    name: &str,
    module: &M,
    dims: [usize; I],
    f: impl Fn(&M, Tensor<I>) -> Tensor<O>,
) -> Graph {
    let input = noise(dims.iter().product(), 7);
    let flex = Device::flex();
    let x = Tensor::from_data(TensorData::new(input.clone(), dims), &flex);
    let want = values(f(module, x));
    let mut graph = record(name, "", |r| {
        let module = r.module(module);
        let x = r.input("x", dims, "")?;
        r.output("y", f(&module, x), "")
    })
    .unwrap_or_else(|e| panic!("{name}: {e}"));
    let raw = run(&encode(&graph, Storage::Inline), &dims, &input);
    optimise(&mut graph);
    let optimised = run(&encode(&graph, Storage::Inline), &dims, &input);
    for (what, got) in [("recorded", raw), ("optimised", optimised)] {
        let diff = largest_difference(&want, &got);
        assert!(diff <= TOLERANCE, "{name}, {what}: differs by {diff}");
    }
    graph
}

/// The same for functions without parameters.
fn agree_fn<const I: usize, const O: usize>(
    name: &str,
    dims: [usize; I],
    f: impl Fn(Tensor<I>) -> Tensor<O>,
) -> Graph {
    agree(name, &Vec::<nn::Linear>::new(), dims, |_, x| f(x))
}

fn ops(graph: &Graph) -> Vec<&'static str> {
    graph.nodes.iter().map(|n| n.op).collect()
}

#[test]
fn arithmetic_and_functions() {
    let cases: Vec<Case<2>> = vec![
        ("add", |x| x.clone() + x * 2.0),
        ("sub", |x| (x.clone() - 0.25) - x.powi_scalar(2)),
        ("mul", |x| x.clone() * (x + 3.0)),
        ("div", |x| x.clone() / (x / 4.0 + 2.0)),
        ("powf", |x| (x + 2.0).powf_scalar(1.7)),
        ("pow cube", |x| x.powi_scalar(3)),
        ("pow tensor", |x| (x.clone() + 2.0).powf(x)),
        ("exp log", |x| (x.exp() + 1.0).log()),
        ("log1p", |x| x.abs().log1p()),
        ("sqrt recip", |x| (x + 2.0).sqrt().recip()),
        ("trigonometry", |x| x.clone().sin() + x.clone().cos() * x.tanh()),
        ("erf", |x| x.erf()),
        ("rounding", |x| (x.clone() * 9.0).floor() + (x.clone() * 7.0).ceil() + (x * 5.0).round()),
        ("neg abs sign", |x| -x.clone() + x.clone().abs() + x.sign()),
        ("clamp", |x| x.clone().clamp(-0.3, 0.4) + x.clone().clamp_min(0.1) * x.clamp_max(-0.2)),
        ("masks", |x| {
            let mask = x.clone().greater_elem(0.1).bool_and(x.clone().lower_elem(0.6));
            x.clone().mask_fill(mask.clone(), -5.0) + mask.bool_not().float()
        }),
        ("mask where", |x| {
            let other = x.clone() * 3.0;
            x.clone().mask_where(x.lower_equal_elem(0.0), other)
        }),
        ("comparisons", |x| {
            let y = x.clone() * x.clone();
            x.clone().greater(y.clone()).float()
                + x.clone().lower_equal(y.clone()).float() * 2.0
                + x.clone().not_equal(y).float() * 4.0
                + x.greater_equal_elem(0.5).float()
        }),
    ];
    for (name, f) in cases {
        agree_fn(name, [3, 5], f);
    }
}

#[test]
fn activations() {
    let cases: Vec<Case<3>> = vec![
        ("relu", act::relu),
        ("sigmoid", act::sigmoid),
        ("gelu", act::gelu),
        ("leaky relu", |x| act::leaky_relu(x, 0.1)),
        ("log sigmoid", act::log_sigmoid),
        ("hard sigmoid", |x| act::hard_sigmoid(x * 4.0, 0.2, 0.5)),
        ("softmax", |x| act::softmax(x, 2)),
        ("softmax in the middle", |x| act::softmax(x, 1)),
        ("log softmax", |x| act::log_softmax(x, 2)),
    ];
    for (name, f) in cases {
        agree_fn(name, [2, 3, 5], f);
    }
    let prelu = nn::PReluConfig::new().with_num_parameters(3).init(&Device::flex());
    agree("prelu", &prelu, [2, 3, 4, 4], |m, x| m.forward(x));
}

#[test]
fn reductions() {
    let cases: Vec<Case<3>> = vec![
        ("mean of a side", |x| x.mean_dim(1)),
        ("sum of a side", |x| x.sum_dim(2)),
        ("sum of sides", |x| x.sum_dims(&[0, 2])),
        ("largest", |x| x.clone().max_dim(1) + x.min_dim(1)),
        ("of everything", |x| {
            (x.clone().sum() + x.clone().mean() + x.clone().max() - x.min()).reshape([1, 1, 1])
        }),
        ("place of the largest", |x| x.argmax(2).float()),
        ("variance", |x| x.var(2)),
    ];
    for (name, f) in cases {
        agree_fn(name, [2, 4, 5], f);
    }
}

#[test]
fn moves_and_selections() {
    let cases: Vec<Case<3>> = vec![
        ("reshape", |x| x.reshape([5, 4, 2])),
        ("swap", |x| x.swap_dims(0, 2)),
        ("permute", |x| x.permute([1, 2, 0])),
        ("flip", |x| x.flip([0, 2])),
        ("expand", |x| x.slice([0..1, 0..4, 0..5]).expand([3, 4, 5])),
        ("slice", |x| x.slice([0..1, 1..3, 2..5])),
        ("slice with steps", |x| x.slice(burn::tensor::s![.., 0..4;2, -3..])),
        ("concatenate", |x| Tensor::cat(vec![x.clone(), x.clone() * 2.0, x], 1)),
        ("repeat", |x| x.repeat_dim(1, 3)),
        ("select", |x| {
            let device = x.device();
            x.select(1, Tensor::<1, Int>::from_data([3, 0, 3], &device))
        }),
        ("gather", |x| {
            let device = x.device();
            let ids = Tensor::<3, Int>::from_data([[[1, 0, 4], [2, 2, 3]]], &device);
            x.slice([0..1, 0..2, 0..5]).gather(2, ids)
        }),
        ("pad", |x| x.pad([(1, 2), (0, 3)], 0.5)),
        ("full", |x| {
            let device = x.device();
            x + Tensor::ones([2, 4, 5], &device) * Tensor::full([1, 1, 1], 0.5, &device)
        }),
        ("integers to floats", |x| {
            let device = x.device();
            let row = (Tensor::<1, Int>::arange(0..5, &device) * 2 + 1).float();
            x * row.reshape([1, 1, 5])
        }),
    ];
    for (name, f) in cases {
        agree_fn(name, [2, 4, 5], f);
    }
}

#[test]
fn convolutions() {
    let flex = Device::flex();
    for (name, groups, bias, stride, pad) in [
        ("plain", 1, true, 1, PaddingConfig2d::Valid),
        ("strided, no bias", 1, false, 2, PaddingConfig2d::Explicit(1, 1, 1, 1)),
        ("depthwise", 4, true, 1, PaddingConfig2d::Explicit(1, 1, 1, 1)),
        ("groups, one-sided padding", 2, false, 2, PaddingConfig2d::Explicit(0, 0, 1, 1)),
    ] {
        let conv = Conv2dConfig::new([4, 8], [3, 3])
            .with_groups(groups)
            .with_bias(bias)
            .with_stride([stride, stride])
            .with_padding(pad)
            .init(&flex);
        agree(name, &conv, [1, 4, 9, 9], |m, x| m.forward(x));
    }
    let dilated = Conv2dConfig::new([4, 2], [3, 3]).with_dilation([2, 2]).init(&flex);
    agree("dilated", &dilated, [2, 4, 9, 9], |m, x| m.forward(x));
    let row = Conv1dConfig::new(4, 3, 3).init(&flex);
    agree("one side", &row, [1, 4, 9], |m, x| m.forward(x));
    let up = ConvTranspose2dConfig::new([4, 3], [3, 3])
        .with_stride([2, 2])
        .with_padding([1, 1])
        .with_padding_out([1, 1])
        .init(&flex);
    agree("transposed", &up, [1, 4, 5, 5], |m, x| m.forward(x));
}

#[test]
fn pooling() {
    let flex = Device::flex();
    let max = nn::pool::MaxPool2dConfig::new([3, 3])
        .with_strides([2, 2])
        .with_padding(PaddingConfig2d::Explicit(1, 1, 1, 1))
        .init();
    agree_fn("max", [1, 2, 8, 8], |x| max.forward(x));
    let mean = nn::pool::AvgPool2dConfig::new([2, 2]).with_strides([2, 2]).init();
    agree_fn("mean", [1, 2, 8, 8], |x| mean.forward(x));
    let adaptive = nn::pool::AdaptiveAvgPool2dConfig::new([2, 4]).init();
    agree_fn("adaptive", [1, 2, 8, 8], |x| adaptive.forward(x));
    let odd = nn::pool::AdaptiveAvgPool2dConfig::new([3, 3]).init();
    let refused = record("odd", "", |r| {
        let x = r.input("x", [1, 2, 8, 8], "")?;
        r.output("y", odd.forward(x), "")
    });
    assert!(refused.unwrap_err().to_string().contains("8 cells to 3"));
    drop(flex);
}

#[test]
fn layers() {
    let flex = Device::flex();
    agree("linear", &LinearConfig::new(6, 4).init(&flex), [2, 3, 6], |m, x| m.forward(x));
    let bare = LinearConfig::new(6, 4).with_bias(false).init(&flex);
    agree("linear without bias", &bare, [3, 6], |m, x| m.forward(x));
    let norm = nn::LayerNormConfig::new(6).init(&flex);
    agree("layer norm", &norm, [2, 3, 6], |m, x| m.forward(x));
    let group = nn::GroupNormConfig::new(2, 4).init(&flex);
    agree("group norm", &group, [1, 4, 5, 5], |m, x| m.forward(x));
    agree_fn("products", [2, 3, 4, 5], |x| x.clone().matmul(x.swap_dims(2, 3)));
    agree_fn("attention", [1, 2, 6, 4], |x| {
        let (k, v) = (x.clone() * 0.7, x.clone() + 0.1);
        burn::tensor::module::attention(x, k, v, None, None, Default::default())
    });
    let table = nn::EmbeddingConfig::new(5, 3).init(&flex);
    agree("embedding", &table, [2, 4], |m, x| m.forward(x.abs().mul_scalar(4.0).int()));
}

/// A convolution with batch norm, as backbones have them.
#[derive(Module, Debug)]
struct Block {
    conv: nn::conv::Conv2d,
    bn: nn::BatchNorm,
}

fn block(groups: usize, bias: bool) -> Block {
    let flex = Device::flex();
    let mut bn = nn::BatchNormConfig::new(8).with_epsilon(1e-3).init(&flex);
    bn.gamma = burn::module::Param::from_tensor(tensor([8], 1, &flex) + 1.5);
    bn.beta = burn::module::Param::from_tensor(tensor([8], 2, &flex));
    bn.running_mean = burn::module::RunningState::new(tensor([8], 3, &flex));
    bn.running_var = burn::module::RunningState::new(tensor([8], 4, &flex).abs() + 0.1);
    let conv = Conv2dConfig::new([4, 8], [3, 3])
        .with_groups(groups)
        .with_bias(bias)
        .with_padding(PaddingConfig2d::Valid)
        .init(&flex);
    Block { conv, bn }
}

#[test]
fn batch_norm_goes_into_the_convolution() {
    for (groups, bias) in [(1, true), (1, false), (4, true), (2, false)] {
        let graph = agree("block", &block(groups, bias), [1, 4, 7, 7], |m, x| {
            act::relu(m.bn.forward(m.conv.forward(x)))
        });
        assert_eq!(ops(&graph), ["Conv", "Relu"], "groups {groups}, bias {bias}");
    }
    // The convolution's own output is needed too: both stay.
    let graph = agree("branch", &block(1, true), [1, 4, 7, 7], |m, x| {
        let y = m.conv.forward(x);
        m.bn.forward(y.clone()) * y
    });
    assert!(ops(&graph).contains(&"BatchNormalization"));
}

#[test]
fn batch_norm_on_its_own_stays() {
    let graph = agree("bn", &block(1, true), [1, 8, 5, 5], |m, x| m.bn.forward(x));
    assert_eq!(ops(&graph), ["BatchNormalization"]);
}

/// A linear layer with batch norm over tokens.
#[derive(Module, Debug)]
struct Tokens {
    linear: nn::Linear,
    bn: nn::BatchNorm,
}

#[test]
fn batch_norm_goes_into_the_product() {
    let tokens =
        Tokens { linear: LinearConfig::new(6, 8).init(&Device::flex()), bn: block(1, true).bn };
    let graph = agree("tokens", &tokens, [5, 6], |m, x| m.bn.forward(m.linear.forward(x)));
    assert_eq!(ops(&graph), ["MatMul", "Add"]);
    // A second reader of the product keeps it as it is.
    let graph = agree("tokens, read twice", &tokens, [5, 6], |m, x| {
        let y = m.linear.forward(x);
        m.bn.forward(y.clone()) + y
    });
    assert!(ops(&graph).contains(&"BatchNormalization"));
}

#[test]
fn constant_matrices_are_plain() {
    let linear = LinearConfig::new(6, 4).init(&Device::flex());
    let graph =
        agree("batched", &linear, [1, 5, 6], |m, x| x.matmul(m.weight.val().unsqueeze_dim::<3>(0)));
    assert_eq!(ops(&graph), ["MatMul"]);
    assert_eq!(graph.dims(graph.nodes[0].input(1).unwrap()), [6, 4]);
}

#[test]
fn scales_and_padding_go_into_the_convolution() {
    let graph = agree("pad", &block(1, false), [1, 4, 7, 7], |m, x| {
        let device = x.device();
        let scale = tensor([1, 8, 1, 1], 9, &device);
        let y = m.conv.forward(x.pad([(0, 1), (0, 1)], 0.0));
        (y * scale.clone() + 0.5) / 3.0 - scale
    });
    assert_eq!(ops(&graph), ["Conv"]);
    assert_eq!(graph.nodes[0].ints("pads"), Some(&[0, 0, 1, 1][..]));
    let graph = agree("pad with ones", &block(1, false), [1, 4, 7, 7], |m, x| {
        m.conv.forward(x.pad([(0, 1), (0, 1)], 1.0))
    });
    assert_eq!(ops(&graph), ["Pad", "Conv"]);
}

#[test]
fn constant_parts_are_computed() {
    let norm = nn::LayerNormConfig::new(6).init(&Device::flex());
    let graph = agree("constants", &norm, [2, 3, 6], |m, x| {
        let device = x.device();
        let a = tensor::<3>([1, 3, 6], 5, &device);
        let weights = act::softmax(m.forward(a.clone()).sin() * 3.0, 2);
        let b = a.clone().swap_dims(1, 2).matmul(weights).mean_dim(1).exp();
        let c = Tensor::cat(vec![b.clone(), b.clone(), b], 1).expand([2, 3, 6]);
        x.reshape([2, 3, 6])
            + c.slice([0..2, 0..3, 0..6])
                .select(2, Tensor::<1, Int>::arange(0..6, &device).flip([0]))
                * 1.0
    });
    // Addition reads the smallest constant that broadcasts to what is needed.
    assert!(graph.nodes.len() <= 4, "{:?}", ops(&graph));
    assert_eq!(graph.nodes.last().unwrap().op, "Add");
}

#[test]
fn a_module_in_training_is_recorded_in_its_inference_form() {
    let autodiff = Device::flex().autodiff();
    let bn = nn::BatchNormConfig::new(3).init(&autodiff);
    // Moves the running statistics away from their initial values.
    bn.forward(tensor([4, 3, 2, 2], 11, &autodiff) + 2.0);
    let dims = [1, 3, 2, 2];
    let input = noise(12, 3);
    let x = Tensor::<4>::from_data(TensorData::new(input.clone(), dims), &Device::flex());
    let want = values(bn.valid().forward(x));
    let graph = record("training", "", |r| {
        let bn = r.module(&bn);
        let x = r.input("x", dims, "")?;
        r.output("y", bn.forward(x), "")
    });
    let got = run(&encode(&graph.unwrap(), Storage::Inline), &dims, &input);
    assert!(largest_difference(&want, &got) <= TOLERANCE);
    // The module trains on as if nothing had happened.
    let y = bn.forward(tensor([4, 3, 2, 2], 12, &autodiff));
    assert!(values(y.inner()).iter().all(|v| v.is_finite()));
}

#[test]
fn every_kind_of_constant_is_computed_rightly() {
    let cases: Vec<Case<2>> = vec![
        ("arithmetic", |c| (c.clone() + 1.0) * c.clone() / (c.clone() + 3.0) - c),
        ("functions", |c| c.clone().exp() + (c.clone() + 2.0).log() + (c.abs() + 0.5).sqrt()),
        ("waves", |c| c.clone().sin() + c.clone().cos() + c.clone().tanh() + -c),
        ("powers", |c| (c.clone() + 2.0).powf_scalar(1.5) + (c + 2.0).recip()),
        ("activations", |c| act::relu(c.clone()) + act::sigmoid(c.clone()) + c.clamp(-0.1, 0.2)),
        ("rounding", |c| (c.clone() * 9.0).floor() + (c * 9.0).ceil()),
        ("softmax", |c| act::softmax(c, 1)),
        ("product", |c| c.clone().matmul(c.transpose()).slice([0..3, 0..1])),
        ("sums", |c| c.clone().sum_dim(0) + c.clone().mean_dim(1) + c.sum().reshape([1, 1])),
        ("moves", |c| c.clone().reshape([4, 3]).transpose() + c.flip([1])),
        ("steps", |c| c.repeat_dim(1, 2).slice(burn::tensor::s![.., 1..8;2])),
        ("broadcasts", |c| c.slice([1..2, 0..4]).expand([3, 4])),
        ("joins", |c| Tensor::cat(vec![c.clone(), c], 0).slice([2..5, 0..4])),
        ("choices", |c| {
            let device = c.device();
            c.select(0, Tensor::<1, Int>::from_data([2, 0, 1], &device))
        }),
        ("integers", |c| {
            let device = c.device();
            let row = (Tensor::<1, Int>::arange(0..4, &device) * 3 + 2).float();
            c * row.reshape([1, 4])
        }),
    ];
    for (name, f) in cases {
        let graph = agree_fn(name, [3, 4], |x| {
            let device = x.device();
            x + f(tensor([3, 4], 21, &device))
        });
        assert_eq!(ops(&graph), ["Add"], "{name}");
    }
}

#[test]
fn names_come_from_the_module() {
    let mut graph = record("block", "A block.", |r| {
        let m = r.module(&block(1, true));
        let x = r.input("crop", [1, 4, 7, 7], "the crop")?;
        let y = m.bn.forward(m.conv.forward(x));
        r.output("feature", act::relu(y.clone()), "first")?;
        r.output("raw", y, "second")
    })
    .unwrap();
    let names = |graph: &Graph| -> Vec<String> {
        graph.initialisers().iter().map(|id| graph.value(*id).name.clone()).collect()
    };
    assert_eq!(
        names(&graph),
        ["conv.weight", "conv.bias", "bn.gamma", "bn.beta", "bn.running_mean", "bn.running_var"]
    );
    optimise(&mut graph);
    assert_eq!(names(&graph), ["conv.weight.folded", "conv.bias.folded"]);
    let model = model(&graph, Storage::Inline);
    let proto = model.graph.unwrap();
    assert_eq!(proto.input[0].name.as_deref(), Some("crop"));
    assert_eq!(proto.input[0].doc_string.as_deref(), Some("the crop"));
    let outputs: Vec<_> = proto.output.iter().map(|o| o.name.clone().unwrap()).collect();
    assert_eq!(outputs, ["feature", "raw"]);
    assert_eq!(proto.doc_string.as_deref(), Some("A block."));
}

#[test]
fn what_cannot_be_converted_is_named() {
    let error = record("sorter", "", |r| {
        let x = r.input("x", [2, 4], "")?;
        r.output("y", act::relu(x).sort(1), "")
    })
    .unwrap_err();
    let text = error.to_string();
    for part in ["sorter", "NumericFloat/Sort", "operation 2"] {
        assert!(text.contains(part), "{text}");
    }
    let taken = record("names", "", |r| {
        let x = r.input("x", [2, 4], "")?;
        r.output("x", x, "")
    });
    assert!(matches!(taken.unwrap_err(), ExportError::Name { name, .. } if name == "x"));
}

#[test]
fn an_input_passed_through_is_an_output() {
    let graph = agree_fn("identity", [2, 3], |x| x);
    assert_eq!(ops(&graph), ["Identity"]);
}

#[test]
fn unused_parameters_and_operations_are_left_out() {
    let graph = agree("half", &block(1, true), [1, 4, 7, 7], |m, x| {
        let _unused = m.bn.forward(m.conv.forward(x.clone()));
        x * 2.0
    });
    assert_eq!(ops(&graph), ["Mul"]);
    assert_eq!(graph.initialisers().len(), 1);
}

#[test]
fn weights_are_stored_once() {
    let linear = LinearConfig::new(16, 16).init(&Device::flex());
    let graph = |name: &str| {
        record(name, "", |r| {
            let m = r.module(&linear);
            let x = r.input("x", [1, 16], "")?;
            r.output("y", m.forward(x), "")
        })
        .unwrap()
    };
    let mut store = WeightStore::new("w.bin");
    let first = encode(&graph("a"), Storage::External(&mut store));
    assert_eq!(store.bytes().len(), 16 * 16 * 4);
    let second = encode(&graph("b"), Storage::External(&mut store));
    assert_eq!(store.bytes().len(), 16 * 16 * 4);
    // The bias of 64 bytes stays inside.
    assert!(first.len() < 700 && second.len() < 700, "{} {}", first.len(), second.len());
    let model: proto::ModelProto = prost::Message::decode(&first[..]).unwrap();
    let weight = &model.graph.unwrap().initializer[0];
    assert_eq!(weight.external_data[0].value.as_deref(), Some("w.bin"));
    assert_eq!(weight.external_data[1].value.as_deref(), Some("0"));
    assert_eq!(weight.external_data[2].value.as_deref(), Some("1024"));
    assert_eq!(weight.data_location, Some(proto::DATA_LOCATION_EXTERNAL));
}
