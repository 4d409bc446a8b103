//! Activations.

use super::{Attribute, Converted, Converter, Elem, Refusal, dims, i64s};
use burn::backend::ir::ActivationOperationIr as A;

impl Converter<'_> {
    pub(super) fn activation(&mut self, op: &A) -> Converted {
        let axis = |axis: usize| vec![("axis", Attribute::Int(axis as i64))];
        match op {
            A::Relu(d) => self.unary("Relu", &d.input, &d.out),
            A::Sigmoid(d) => self.unary("Sigmoid", &d.input, &d.out),
            A::LeakyRelu(d) => {
                let x = self.read(&d.lhs)?;
                self.node("LeakyRelu", [x], &d.out, vec![("alpha", Attribute::Float(d.rhs.elem()))])
            }
            A::PRelu(d) => {
                let (x, mut slope) = (self.read(&d.lhs)?, self.read(&d.rhs)?);
                let (channels, rank) = (d.rhs.shape[0], d.lhs.shape.num_dims());
                if channels > 1 && rank > 2 {
                    // One slope per channel: ONNX broadcasts from the right.
                    let mut shape = vec![1; rank - 1];
                    shape[0] = channels;
                    let to = self.list("shape", i64s(&shape));
                    slope = self.push("Reshape", [slope, to], &shape, Elem::F32, vec![]);
                }
                self.node("PRelu", [x, slope], &d.out, vec![])
            }
            A::HardSigmoid(d) => {
                let x = self.read(&d.tensor)?;
                let attributes = vec![
                    ("alpha", Attribute::Float(d.alpha.elem())),
                    ("beta", Attribute::Float(d.beta.elem())),
                ];
                self.node("HardSigmoid", [x], &d.out, attributes)
            }
            // x / 2 * (1 + erf(x / sqrt 2)); Gelu is an operator only from opset 20.
            A::Gelu(d) => {
                let (x, shape) = (self.read(&d.input)?, dims(&d.out));
                let root = self.number(std::f32::consts::FRAC_1_SQRT_2);
                let scaled = self.push("Mul", [x, root], &shape, Elem::F32, vec![]);
                let erf = self.push("Erf", [scaled], &shape, Elem::F32, vec![]);
                let one = self.number(1.0);
                let sum = self.push("Add", [erf, one], &shape, Elem::F32, vec![]);
                let half = self.number(0.5);
                let halved = self.push("Mul", [x, half], &shape, Elem::F32, vec![]);
                self.node("Mul", [halved, sum], &d.out, vec![])
            }
            // -softplus(-x)
            A::LogSigmoid(d) => {
                let (x, shape) = (self.read(&d.input)?, dims(&d.out));
                let minus = self.push("Neg", [x], &shape, Elem::F32, vec![]);
                let soft = self.push("Softplus", [minus], &shape, Elem::F32, vec![]);
                self.node("Neg", [soft], &d.out, vec![])
            }
            A::Softmax(d) => {
                let x = self.read(&d.input)?;
                self.node("Softmax", [x], &d.out, axis(d.axis))
            }
            A::LogSoftmax(d) => {
                let x = self.read(&d.input)?;
                self.node("LogSoftmax", [x], &d.out, axis(d.axis))
            }
            A::Softmin(d) => {
                let x = self.read(&d.input)?;
                let minus = self.push("Neg", [x], &dims(&d.input), Elem::F32, vec![]);
                self.node("Softmax", [minus], &d.out, axis(d.axis))
            }
            _ => Err(Refusal::Operation),
        }
    }
}
