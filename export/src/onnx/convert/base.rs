//! Moving and selecting elements; the same for floats, integers and booleans.

use super::{Attribute, Converted, Converter, Data, Elem, Refusal, dims, elem, i64s, setting};
use burn::backend::ir::{BaseOperationIr as B, ScalarIr, SliceOpIr, TensorIr};

impl Converter<'_> {
    pub(super) fn base(&mut self, op: &B) -> Converted {
        match op {
            B::Reshape(d) => {
                let (x, shape) = (self.read(&d.input)?, self.list("shape", i64s(&dims(&d.out))));
                self.node("Reshape", [x, shape], &d.out, vec![])
            }
            B::Expand(d) => {
                let (x, shape) = (self.read(&d.input)?, self.list("shape", i64s(&dims(&d.out))));
                self.node("Expand", [x, shape], &d.out, vec![])
            }
            B::SwapDims(d) => {
                let mut perm: Vec<usize> = (0..d.input.shape.num_dims()).collect();
                perm.swap(d.dim1, d.dim2);
                let x = self.read(&d.input)?;
                self.node("Transpose", [x], &d.out, vec![("perm", Attribute::Ints(i64s(&perm)))])
            }
            B::Permute(d) => {
                let x = self.read(&d.input)?;
                let perm = Attribute::Ints(i64s(&d.axes));
                self.node("Transpose", [x], &d.out, vec![("perm", perm)])
            }
            B::Flip(d) => {
                let x = self.read(&d.input)?;
                let n = d.axes.len();
                let starts = self.list("starts", vec![-1; n]);
                let ends = self.list("ends", vec![i64::MIN + 1; n]);
                let axes = self.list("axes", i64s(&d.axes));
                let steps = self.list("steps", vec![-1; n]);
                self.node("Slice", [x, starts, ends, axes, steps], &d.out, vec![])
            }
            B::Slice(d) => self.slice(d),
            B::Select(d) => {
                let (x, indices) = (self.read(&d.tensor)?, self.read(&d.indices)?);
                let axis = Attribute::Int(d.dim as i64);
                self.node("Gather", [x, indices], &d.out, vec![("axis", axis)])
            }
            B::Gather(d) => {
                let (x, indices) = (self.read(&d.tensor)?, self.read(&d.indices)?);
                let axis = Attribute::Int(d.dim as i64);
                self.node("GatherElements", [x, indices], &d.out, vec![("axis", axis)])
            }
            B::MaskWhere(d) => {
                let mask = self.read(&d.mask)?;
                let (value, x) = (self.read(&d.value)?, self.read(&d.tensor)?);
                self.node("Where", [mask, value, x], &d.out, vec![])
            }
            B::MaskFill(d) => {
                let (mask, value) = (self.read(&d.mask)?, self.scalar(d.value, &d.tensor)?);
                let x = self.read(&d.tensor)?;
                self.node("Where", [mask, value, x], &d.out, vec![])
            }
            B::Equal(d) => self.binary("Equal", &d.lhs, &d.rhs, &d.out),
            B::EqualElem(d) => self.with_scalar("Equal", &d.lhs, d.rhs, &d.out),
            B::NotEqual(d) => {
                let inputs = [self.read(&d.lhs)?, self.read(&d.rhs)?];
                let equal = self.push("Equal", inputs, &dims(&d.out), Elem::Bool, vec![]);
                self.node("Not", [equal], &d.out, vec![])
            }
            B::NotEqualElem(d) => {
                let inputs = [self.read(&d.lhs)?, self.scalar(d.rhs, &d.lhs)?];
                let equal = self.push("Equal", inputs, &dims(&d.out), Elem::Bool, vec![]);
                self.node("Not", [equal], &d.out, vec![])
            }
            B::RepeatDim(d) => {
                let mut repeats = vec![1; d.tensor.shape.num_dims()];
                repeats[d.dim] = d.times as i64;
                let (x, repeats) = (self.read(&d.tensor)?, self.list("repeats", repeats));
                self.node("Tile", [x, repeats], &d.out, vec![])
            }
            B::Cat(d) => {
                let parts =
                    d.tensors.iter().map(|t| self.read(t)).collect::<Result<Vec<_>, _>>()?;
                let axis = Attribute::Int(d.dim as i64);
                self.node("Concat", parts, &d.out, vec![("axis", axis)])
            }
            B::Cast(d) => self.cast(&d.input, &d.out),
            B::Ones(d) => self.filled(&d.out, ScalarIr::Int(1)),
            B::Zeros(d) => self.filled(&d.out, ScalarIr::Int(0)),
            _ => Err(Refusal::Operation),
        }
    }

    fn slice(&mut self, d: &SliceOpIr) -> Converted {
        let (mut starts, mut ends, mut axes, mut steps) = (vec![], vec![], vec![], vec![]);
        for (axis, range) in d.ranges.iter().enumerate() {
            if range.step < 1 {
                return setting("a slice with a negative step; use `flip`");
            }
            let side = d.tensor.shape[axis] as isize;
            // Negative positions count from the end.
            let place = |v: isize| (if v < 0 { v + side } else { v }).clamp(0, side) as i64;
            let (start, end) = (place(range.start), place(range.end.unwrap_or(side)));
            if start != 0 || end != side as i64 || range.step != 1 {
                starts.push(start);
                ends.push(end);
                axes.push(axis as i64);
                steps.push(range.step as i64);
            }
        }
        let x = self.read(&d.tensor)?;
        if axes.is_empty() {
            return self.node("Identity", [x], &d.out, vec![]);
        }
        let inputs = [
            x,
            self.list("starts", starts),
            self.list("ends", ends),
            self.list("axes", axes),
            self.list("steps", steps),
        ];
        self.node("Slice", inputs, &d.out, vec![])
    }

    pub(super) fn cast(&mut self, input: &TensorIr, out: &TensorIr) -> Converted {
        use super::super::proto::data_type;
        let to = match elem(out.dtype)? {
            Elem::F32 => data_type::FLOAT,
            Elem::I64 => data_type::INT64,
            Elem::Bool => data_type::BOOL,
        };
        let x = self.read(input)?;
        self.node("Cast", [x], out, vec![("to", Attribute::Int(to.into()))])
    }

    /// A constant of one value everywhere.
    pub(super) fn filled(&mut self, out: &TensorIr, value: ScalarIr) -> Converted {
        let dims = dims(out);
        let n = dims.iter().product();
        let data = match elem(out.dtype)? {
            Elem::F32 => Data::F32(vec![value.elem(); n]),
            Elem::I64 => Data::I64(vec![value.elem(); n]),
            Elem::Bool => Data::Bool(vec![value.elem(); n]),
        };
        let id = self.graph.add_constant("constant", &dims, data);
        self.values.insert(out.id, id);
        Ok(())
    }
}
