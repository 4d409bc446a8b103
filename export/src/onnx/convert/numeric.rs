//! Arithmetic, comparisons and reductions.

use super::{Attribute, Converted, Converter, Elem, Refusal, dims, i64s, setting};
use burn::backend::ir::{
    BoolOperationIr as Bo, FloatOperationIr as F, IntOperationIr as I, NumericOperationIr as N,
    PadModeIr, ScalarIr, ScalarOpIr, TensorIr,
};

impl Converter<'_> {
    pub(super) fn numeric(&mut self, op: &N) -> Converted {
        match op {
            N::Add(d) => self.binary("Add", &d.lhs, &d.rhs, &d.out),
            N::Sub(d) => self.binary("Sub", &d.lhs, &d.rhs, &d.out),
            N::Mul(d) => self.binary("Mul", &d.lhs, &d.rhs, &d.out),
            N::Div(d) => self.binary("Div", &d.lhs, &d.rhs, &d.out),
            N::AddScalar(d) => self.with_scalar("Add", &d.lhs, d.rhs, &d.out),
            N::SubScalar(d) => self.with_scalar("Sub", &d.lhs, d.rhs, &d.out),
            N::MulScalar(d) => self.with_scalar("Mul", &d.lhs, d.rhs, &d.out),
            N::DivScalar(d) => self.with_scalar("Div", &d.lhs, d.rhs, &d.out),
            N::Powi(d) => self.binary("Pow", &d.lhs, &d.rhs, &d.out),
            N::PowiScalar(d) => self.power(d),
            N::Abs(d) => self.unary("Abs", &d.input, &d.out),
            N::Neg(d) => self.unary("Neg", &d.input, &d.out),
            N::Sign(d) => self.unary("Sign", &d.input, &d.out),
            N::Full(d) => self.filled(&d.out, d.value),
            N::Clamp(d) => {
                let (low, high) = (self.scalar(d.min, &d.tensor)?, self.scalar(d.max, &d.tensor)?);
                let x = self.read(&d.tensor)?;
                self.node("Clip", [x, low, high], &d.out, vec![])
            }
            N::ClampMin(d) => self.with_scalar("Max", &d.lhs, d.rhs, &d.out),
            N::ClampMax(d) => self.with_scalar("Min", &d.lhs, d.rhs, &d.out),
            N::Greater(d) => self.binary("Greater", &d.lhs, &d.rhs, &d.out),
            N::GreaterEqual(d) => self.binary("GreaterOrEqual", &d.lhs, &d.rhs, &d.out),
            N::Lower(d) => self.binary("Less", &d.lhs, &d.rhs, &d.out),
            N::LowerEqual(d) => self.binary("LessOrEqual", &d.lhs, &d.rhs, &d.out),
            N::GreaterElem(d) => self.with_scalar("Greater", &d.lhs, d.rhs, &d.out),
            N::GreaterEqualElem(d) => self.with_scalar("GreaterOrEqual", &d.lhs, d.rhs, &d.out),
            N::LowerElem(d) => self.with_scalar("Less", &d.lhs, d.rhs, &d.out),
            N::LowerEqualElem(d) => self.with_scalar("LessOrEqual", &d.lhs, d.rhs, &d.out),
            N::MeanDim(d) => self.reduce("ReduceMean", &d.input, &[d.axis], &d.out),
            N::SumDim(d) => self.reduce("ReduceSum", &d.input, &[d.axis], &d.out),
            N::SumDims(d) => self.reduce("ReduceSum", &d.input, &d.axes, &d.out),
            N::ProdDim(d) => self.reduce("ReduceProd", &d.input, &[d.axis], &d.out),
            N::MaxDim(d) => self.reduce("ReduceMax", &d.input, &[d.axis], &d.out),
            N::MinDim(d) => self.reduce("ReduceMin", &d.input, &[d.axis], &d.out),
            N::Mean(d) => self.reduce_all("ReduceMean", &d.input, &d.out),
            N::Sum(d) => self.reduce_all("ReduceSum", &d.input, &d.out),
            N::Prod(d) => self.reduce_all("ReduceProd", &d.input, &d.out),
            N::Max(d) => self.reduce_all("ReduceMax", &d.input, &d.out),
            N::Min(d) => self.reduce_all("ReduceMin", &d.input, &d.out),
            N::ArgMax(d) => self.arg("ArgMax", &d.input, d.axis, &d.out),
            N::ArgMin(d) => self.arg("ArgMin", &d.input, d.axis, &d.out),
            N::Pad(d) => {
                let PadModeIr::Constant(value) = &d.mode else {
                    return setting("padding other than with a constant");
                };
                let pads = (d.padding.iter().map(|p| p.0 as i64))
                    .chain(d.padding.iter().map(|p| p.1 as i64))
                    .collect();
                let (x, pads) = (self.read(&d.input)?, self.list("pads", pads));
                let value = self.scalar(*value, &d.input)?;
                let mode = Attribute::Text("constant");
                self.node("Pad", [x, pads, value], &d.out, vec![("mode", mode)])
            }
            _ => Err(Refusal::Operation),
        }
    }

    pub(super) fn float(&mut self, op: &F) -> Converted {
        match op {
            F::Exp(d) => self.unary("Exp", &d.input, &d.out),
            F::Log(d) => self.unary("Log", &d.input, &d.out),
            F::Log1p(d) => {
                let (x, one) = (self.read(&d.input)?, self.number(1.0));
                let sum = self.push("Add", [x, one], &dims(&d.out), Elem::F32, vec![]);
                self.node("Log", [sum], &d.out, vec![])
            }
            F::Erf(d) => self.unary("Erf", &d.input, &d.out),
            F::Sqrt(d) => self.unary("Sqrt", &d.input, &d.out),
            F::Recip(d) => self.unary("Reciprocal", &d.input, &d.out),
            F::Cos(d) => self.unary("Cos", &d.input, &d.out),
            F::Sin(d) => self.unary("Sin", &d.input, &d.out),
            F::Tan(d) => self.unary("Tan", &d.input, &d.out),
            F::Tanh(d) => self.unary("Tanh", &d.input, &d.out),
            F::ArcTan(d) => self.unary("Atan", &d.input, &d.out),
            F::Floor(d) => self.unary("Floor", &d.input, &d.out),
            F::Ceil(d) => self.unary("Ceil", &d.input, &d.out),
            // Both round halves to even.
            F::Round(d) => self.unary("Round", &d.input, &d.out),
            F::PowfScalar(d) => self.power(d),
            F::Powf(d) => self.binary("Pow", &d.lhs, &d.rhs, &d.out),
            F::Matmul(d) => self.binary("MatMul", &d.lhs, &d.rhs, &d.out),
            F::IntoInt(d) => self.cast(&d.input, &d.out),
            _ => Err(Refusal::Operation),
        }
    }

    pub(super) fn int(&mut self, op: &I) -> Converted {
        match op {
            I::IntoFloat(d) => self.cast(&d.input, &d.out),
            _ => Err(Refusal::Operation),
        }
    }

    pub(super) fn bool(&mut self, op: &Bo) -> Converted {
        match op {
            Bo::IntoFloat(d) | Bo::IntoInt(d) => self.cast(&d.input, &d.out),
            Bo::Not(d) => self.unary("Not", &d.input, &d.out),
            Bo::And(d) => self.binary("And", &d.lhs, &d.rhs, &d.out),
            Bo::Or(d) => self.binary("Or", &d.lhs, &d.rhs, &d.out),
            Bo::Xor(d) => self.binary("Xor", &d.lhs, &d.rhs, &d.out),
        }
    }

    /// Squares become products: engines compute a general power through logarithms.
    fn power(&mut self, d: &ScalarOpIr) -> Converted {
        let exponent: f64 = d.rhs.elem();
        if exponent == 2.0 {
            return self.binary("Mul", &d.lhs, &d.lhs, &d.out);
        }
        self.with_scalar("Pow", &d.lhs, ScalarIr::Float(exponent), &d.out)
    }

    /// Reduction that keeps the reduced sides as 1.
    fn reduce(
        &mut self,
        op: &'static str,
        input: &TensorIr,
        axes: &[usize],
        out: &TensorIr,
    ) -> Converted {
        let x = self.read(input)?;
        let keep = ("keepdims", Attribute::Int(1));
        // Opset 13 made the axes of ReduceSum an input; the others followed in opset 18.
        if op == "ReduceSum" {
            let axes = self.list("axes", i64s(axes));
            return self.node(op, [x, axes], out, vec![keep]);
        }
        self.node(op, [x], out, vec![("axes", Attribute::Ints(i64s(axes))), keep])
    }

    /// Reduction over everything; burn answers with shape `[1]`.
    fn reduce_all(&mut self, op: &'static str, input: &TensorIr, out: &TensorIr) -> Converted {
        let x = self.read(input)?;
        let keep = vec![("keepdims", Attribute::Int(1))];
        let ones = vec![1; input.shape.num_dims()];
        let kept = self.push(op, [x], &ones, super::elem(out.dtype)?, keep);
        let shape = self.list("shape", i64s(&dims(out)));
        self.node("Reshape", [kept, shape], out, vec![])
    }

    fn arg(&mut self, op: &'static str, x: &TensorIr, axis: usize, out: &TensorIr) -> Converted {
        let x = self.read(x)?;
        let attributes =
            vec![("axis", Attribute::Int(axis as i64)), ("keepdims", Attribute::Int(1))];
        self.node(op, [x], out, attributes)
    }
}
