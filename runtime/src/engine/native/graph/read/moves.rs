//! Operators that move elements and compute nothing.

use super::super::Op;
use super::{Call, Reader, Step, axis, broadcast, checked, shape_of};

impl<'a> Reader<'a> {
    pub(super) fn transpose(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let x = call.input(0)?;
        let shape = self.shape(x);
        let perm = match call.ints("perm") {
            None => (0..shape.len()).rev().collect(),
            Some(p) => p.iter().map(|&a| axis(a, shape.len())).collect::<Step<Vec<_>>>()?,
        };
        let mut sorted = perm.clone();
        sorted.sort_unstable();
        if !sorted.into_iter().eq(0..shape.len()) {
            return Err(format!("perm {perm:?} of a tensor with {} dimensions", shape.len()));
        }
        let out = perm.iter().map(|&i| shape[i]).collect();
        self.push(call, Op::Transpose(perm), vec![x], out)
    }

    pub(super) fn reshape_to(&mut self, call: &Call<'_, 'a>, shape: Vec<usize>) -> Step<()> {
        let x = call.input(0)?;
        let from = self.shape(x);
        checked(&shape)?;
        if from.iter().product::<usize>() != shape.iter().product::<usize>() {
            return Err(format!("from {from:?} to {shape:?}"));
        }
        self.push(call, Op::Reshape, vec![x], shape)
    }

    pub(super) fn reshape(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let from = self.shape(call.input(0)?);
        let to = self.ints(call.input(1)?)?.to_vec();
        let zero_is_copy = call.int("allowzero", 0) == 0;
        let mut shape = Vec::with_capacity(to.len());
        let mut open = None;
        for (i, &n) in to.iter().enumerate() {
            shape.push(match n {
                -1 if open.is_none() => {
                    open = Some(i);
                    1
                }
                0 if zero_is_copy => *from.get(i).ok_or("a shape with a 0 that copies nothing")?,
                n => usize::try_from(n).map_err(|_| format!("the shape {to:?}"))?,
            });
        }
        if let Some(i) = open {
            checked(&shape)?;
            shape[i] = from.iter().product::<usize>() / shape.iter().product::<usize>();
        }
        self.reshape_to(call, shape)
    }

    pub(super) fn flatten(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let shape = self.shape(call.input(0)?);
        let at = match call.int("axis", 1) {
            end if end == shape.len() as i64 => shape.len(),
            other => axis(other, shape.len())?,
        };
        let (before, after) = shape.split_at(at);
        self.reshape_to(call, vec![before.iter().product(), after.iter().product()])
    }

    pub(super) fn squeeze(&mut self, call: &Call<'_, 'a>, add: bool) -> Step<()> {
        let shape = self.shape(call.input(0)?);
        let axes: Vec<i64> = match call.maybe(1) {
            Some(id) => self.ints(id)?.to_vec(),
            None => call.ints("axes").unwrap_or_default().to_vec(),
        };
        let rank = if add { shape.len() + axes.len() } else { shape.len() };
        let axes = axes.iter().map(|&a| axis(a, rank)).collect::<Step<Vec<_>>>()?;
        let mut out = Vec::with_capacity(rank);
        if add {
            let mut rest = shape.iter().copied();
            for i in 0..rank {
                out.push(if axes.contains(&i) { 1 } else { rest.next().ok_or("an axis twice")? });
            }
        } else {
            let goes = |i: usize| if axes.is_empty() { shape[i] == 1 } else { axes.contains(&i) };
            out.extend((0..rank).filter(|&i| !goes(i)).map(|i| shape[i]));
        }
        self.reshape_to(call, out)
    }

    pub(super) fn slice(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let mut x = call.input(0)?;
        let mut shape = self.shape(x);
        let starts = self.ints(call.input(1)?)?.to_vec();
        let ends = self.ints(call.input(2)?)?.to_vec();
        let axes = match call.maybe(3) {
            Some(id) => self.ints(id)?.to_vec(),
            None => (0..starts.len() as i64).collect(),
        };
        let steps = match call.maybe(4) {
            Some(id) => self.ints(id)?.to_vec(),
            None => vec![1; starts.len()],
        };
        let count = starts.len();
        if count == 0 || ends.len() != count || axes.len() != count || steps.len() != count {
            return Err("starts, ends, axes and steps of different lengths".into());
        }
        for i in 0..count {
            let along = axis(axes[i], shape.len())?;
            let size = shape[along] as i64;
            let step = steps[i];
            if !(1..=size).contains(&step) {
                return Err(format!("step {step}"));
            }
            let clamp = |v: i64| (if v < 0 { v.saturating_add(size) } else { v }).clamp(0, size);
            let (start, end) = (clamp(starts[i]), clamp(ends[i]));
            if end <= start {
                return Err(format!("the empty range {start}..{end}"));
            }
            shape[along] = ((end - start) as usize).div_ceil(step as usize);
            let op = Op::Slice { axis: along, start: start as usize, step: step as usize };
            if i + 1 == count {
                return self.push(call, op, vec![x], shape);
            }
            x = self.between(call, op, vec![x], shape.clone())?;
        }
        Ok(())
    }

    pub(super) fn split(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let x = call.input(0)?;
        let shape = self.shape(x);
        let along = axis(call.int("axis", 0), shape.len())?;
        let outputs = call.node.outputs.len();
        let sizes: Vec<usize> = match call.maybe(1) {
            Some(id) => shape_of(self.ints(id)?)?,
            None if outputs > 0 && shape[along].is_multiple_of(outputs) => {
                vec![shape[along] / outputs; outputs]
            }
            None => return Err(format!("{} into {outputs} parts", shape[along])),
        };
        if sizes.len() != outputs || sizes.iter().sum::<usize>() != shape[along] {
            return Err(format!("{} into {sizes:?}", shape[along]));
        }
        let mut start = 0;
        for (name, size) in call.node.outputs.iter().zip(sizes) {
            let mut part = shape.clone();
            part[along] = size;
            self.named(call, name, Op::Slice { axis: along, start, step: 1 }, vec![x], part)?;
            start += size;
        }
        Ok(())
    }

    pub(super) fn gather(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let (x, indices) = (call.input(0)?, call.input(1)?);
        let mut shape = self.shape(x);
        let along = axis(call.int("axis", 0), shape.len())?;
        let rank = self.shape(indices).len();
        let indices = self.ints(indices)?.to_vec();
        let indices = indices.iter().map(|&i| axis(i, shape[along])).collect::<Step<Vec<_>>>()?;
        let (first, count) = (indices[0], indices.len());
        let slice = Op::Slice { axis: along, start: first, step: 1 };
        shape[along] = 1;
        match rank {
            0 => {
                let one = self.between(call, slice, vec![x], shape.clone())?;
                shape.remove(along);
                self.push(call, Op::Reshape, vec![one], shape)
            }
            1 if indices.windows(2).all(|w| w[1] == w[0] + 1) => {
                shape[along] = count;
                self.push(call, slice, vec![x], shape)
            }
            1 => {
                let mut parts = Vec::with_capacity(count);
                for start in indices {
                    let op = Op::Slice { axis: along, start, step: 1 };
                    parts.push(self.between(call, op, vec![x], shape.clone())?);
                }
                shape[along] = count;
                self.push(call, Op::Concat(along), parts, shape)
            }
            _ => Err(format!("indices with {rank} dimensions")),
        }
    }

    pub(super) fn expand(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let x = call.input(0)?;
        let to = shape_of(self.ints(call.input(1)?)?)?;
        let shape = broadcast(&self.shape(x), &to)?;
        self.push(call, Op::Expand, vec![x], shape)
    }

    pub(super) fn concat(&mut self, call: &Call<'_, 'a>) -> Step<()> {
        let parts = (0..call.inputs.len()).map(|i| call.input(i)).collect::<Step<Vec<_>>>()?;
        let mut shape = self.shape(*parts.first().ok_or("no inputs")?);
        let along = axis(call.int("axis", 0), shape.len())?;
        shape[along] = 0;
        for &part in &parts {
            let mut other = self.shape(part);
            if other.len() != shape.len() {
                return Err("inputs with different numbers of dimensions".into());
            }
            let size = core::mem::replace(&mut other[along], shape[along]);
            if other != shape {
                return Err(format!("inputs of different shapes along {along}"));
            }
            shape[along] = shape[along].saturating_add(size);
        }
        self.push(call, Op::Concat(along), parts, shape)
    }
}
