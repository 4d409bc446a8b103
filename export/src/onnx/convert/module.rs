//! Layers: convolutions, normalisations, pooling, linear maps, attention.

use super::{Attribute, Converted, Converter, Elem, Refusal, dims, i64s, setting};
use burn::backend::ir::{AttentionOpIr, ModuleOperationIr as M, TensorIr};

/// Settings of a convolution, one entry per spatial side.
struct Window {
    stride: Vec<usize>,
    dilation: Vec<usize>,
    padding: Vec<(usize, usize)>,
    groups: usize,
}

/// `[begin.., end..]`, as ONNX wants them.
fn pads(padding: &[(usize, usize)]) -> Attribute {
    let begin = padding.iter().map(|p| p.0 as i64);
    Attribute::Ints(begin.chain(padding.iter().map(|p| p.1 as i64)).collect())
}

fn same(padding: &[usize]) -> Vec<(usize, usize)> {
    padding.iter().map(|p| (*p, *p)).collect()
}

impl Converter<'_> {
    pub(super) fn module(&mut self, op: &M) -> Converted {
        match op {
            M::Conv1d(d) => {
                let o = &d.options;
                let window = Window {
                    stride: o.stride.to_vec(),
                    dilation: o.dilation.to_vec(),
                    padding: o.padding.to_vec(),
                    groups: o.groups,
                };
                self.convolution(&d.x, &d.weight, d.bias.as_ref(), window, &d.out)
            }
            M::Conv2d(d) => {
                let o = &d.options;
                let window = Window {
                    stride: o.stride.to_vec(),
                    dilation: o.dilation.to_vec(),
                    padding: o.padding.to_vec(),
                    groups: o.groups,
                };
                self.convolution(&d.x, &d.weight, d.bias.as_ref(), window, &d.out)
            }
            M::ConvTranspose2d(d) => {
                let o = &d.options;
                let mut inputs = vec![self.read(&d.x)?, self.read(&d.weight)?];
                if let Some(bias) = &d.bias {
                    inputs.push(self.read(bias)?);
                }
                let attributes = vec![
                    ("kernel_shape", Attribute::Ints(i64s(&dims(&d.weight)[2..]))),
                    ("strides", Attribute::Ints(i64s(&o.stride))),
                    ("dilations", Attribute::Ints(i64s(&o.dilation))),
                    ("pads", pads(&same(&o.padding))),
                    ("output_padding", Attribute::Ints(i64s(&o.padding_out))),
                    ("group", Attribute::Int(o.groups as i64)),
                ];
                self.node("ConvTranspose", inputs, &d.out, attributes)
            }
            M::BatchNorm(d) => {
                let inputs = [&d.x, &d.gamma, &d.beta, &d.mean, &d.variance];
                let inputs =
                    inputs.map(|t| self.read(t)).into_iter().collect::<Result<Vec<_>, _>>()?;
                let epsilon = Attribute::Float(d.epsilon.elem());
                self.node("BatchNormalization", inputs, &d.out, vec![("epsilon", epsilon)])
            }
            M::LayerNorm(d) => {
                let mut inputs = vec![self.read(&d.input)?, self.read(&d.gamma)?];
                if let Some(beta) = &d.beta {
                    inputs.push(self.read(beta)?);
                }
                let attributes = vec![
                    ("axis", Attribute::Int(-1)),
                    ("epsilon", Attribute::Float(d.epsilon.elem())),
                ];
                self.node("LayerNormalization", inputs, &d.out, attributes)
            }
            M::Linear(d) => {
                let inputs = [self.read(&d.x)?, self.read(&d.weight)?];
                let Some(bias) = &d.bias else {
                    return self.node("MatMul", inputs, &d.out, vec![]);
                };
                let bias = self.read(bias)?;
                let product = self.push("MatMul", inputs, &dims(&d.out), Elem::F32, vec![]);
                self.node("Add", [product, bias], &d.out, vec![])
            }
            M::Embedding(d) => {
                let inputs = [self.read(&d.weights)?, self.read(&d.indices)?];
                self.node("Gather", inputs, &d.out, vec![("axis", Attribute::Int(0))])
            }
            M::MaxPool2d(d) => {
                let x = self.read(&d.x)?;
                let attributes = vec![
                    ("kernel_shape", Attribute::Ints(i64s(&d.kernel_size))),
                    ("strides", Attribute::Ints(i64s(&d.stride))),
                    ("dilations", Attribute::Ints(i64s(&d.dilation))),
                    ("pads", pads(&same(&d.padding))),
                    ("ceil_mode", Attribute::Int(d.ceil_mode.into())),
                ];
                self.node("MaxPool", [x], &d.out, attributes)
            }
            M::AvgPool2d(d) => {
                let x = self.read(&d.x)?;
                let attributes = vec![
                    ("kernel_shape", Attribute::Ints(i64s(&d.kernel_size))),
                    ("strides", Attribute::Ints(i64s(&d.stride))),
                    ("pads", pads(&same(&d.padding))),
                    ("count_include_pad", Attribute::Int(d.count_include_pad.into())),
                    ("ceil_mode", Attribute::Int(d.ceil_mode.into())),
                ];
                self.node("AveragePool", [x], &d.out, attributes)
            }
            M::AdaptiveAvgPool2d(d) => {
                let (x, sides) = (self.read(&d.x)?, &dims(&d.x)[2..]);
                let mut step = Vec::new();
                for (side, parts) in sides.iter().zip(d.output_size) {
                    if parts == 0 || !side.is_multiple_of(parts) {
                        return setting(format!(
                            "adaptive pooling of {side} cells to {parts}; the input has to be a \
                             multiple of the output"
                        ));
                    }
                    step.push(side / parts);
                }
                let attributes = vec![
                    ("kernel_shape", Attribute::Ints(i64s(&step))),
                    ("strides", Attribute::Ints(i64s(&step))),
                ];
                self.node("AveragePool", [x], &d.out, attributes)
            }
            M::Attention(d) => self.attention(d),
            _ => Err(Refusal::Operation),
        }
    }

    fn convolution(
        &mut self,
        x: &TensorIr,
        weight: &TensorIr,
        bias: Option<&TensorIr>,
        window: Window,
        out: &TensorIr,
    ) -> Converted {
        let mut inputs = vec![self.read(x)?, self.read(weight)?];
        if let Some(bias) = bias {
            inputs.push(self.read(bias)?);
        }
        let attributes = vec![
            ("kernel_shape", Attribute::Ints(i64s(&dims(weight)[2..]))),
            ("strides", Attribute::Ints(i64s(&window.stride))),
            ("dilations", Attribute::Ints(i64s(&window.dilation))),
            ("pads", pads(&window.padding)),
            ("group", Attribute::Int(window.groups as i64)),
        ];
        self.node("Conv", inputs, out, attributes)
    }

    /// `softmax(q k^T * scale + bias) v`.
    fn attention(&mut self, d: &AttentionOpIr) -> Converted {
        if d.mask.is_some() || d.options.is_causal || d.options.softcap.is_some() {
            return setting("attention with a mask, causal or with a soft cap; write it out");
        }
        let key_dims = dims(&d.key);
        let rank = key_dims.len();
        let (query, key, value) = (self.read(&d.query)?, self.read(&d.key)?, self.read(&d.value)?);
        let mut perm: Vec<usize> = (0..rank).collect();
        perm.swap(rank - 2, rank - 1);
        let turned: Vec<usize> = perm.iter().map(|i| key_dims[*i]).collect();
        let perm = vec![("perm", Attribute::Ints(i64s(&perm)))];
        let turned_key = self.push("Transpose", [key], &turned, Elem::F32, perm);
        let query_dims = dims(&d.query);
        let mut shape = query_dims.clone();
        shape[rank - 1] = key_dims[rank - 2];
        let width = query_dims[rank - 1] as f64;
        let scale = d.options.scale.map_or(1.0 / width.sqrt(), |s| s.elem());
        let scale = self.number(scale as f32);
        let mut logits = self.push("MatMul", [query, turned_key], &shape, Elem::F32, vec![]);
        logits = self.push("Mul", [logits, scale], &shape, Elem::F32, vec![]);
        if let Some(bias) = &d.attn_bias {
            let bias = self.read(bias)?;
            logits = self.push("Add", [logits, bias], &shape, Elem::F32, vec![]);
        }
        let axis = vec![("axis", Attribute::Int(rank as i64 - 1))];
        let weights = self.push("Softmax", [logits], &shape, Elem::F32, axis);
        self.node("MatMul", [weights, value], &d.out, vec![])
    }
}
