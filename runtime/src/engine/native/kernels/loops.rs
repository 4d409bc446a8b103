//! Element by element: copies between layouts, functions of one and two tensors, reductions. The
//! tensors may have any strides.

use super::{Mem, Part, Place};
use crate::engine::native::graph::{Binary, Reduce, Unary};

/// Most dimensions left after neighbours have been joined.
const RANK: usize = 6;

/// The elements of `N` tensors side by side: sizes and the strides of every tensor, outermost
/// first. Built by [`Nest::new`], which joins dimensions where it can.
#[derive(Clone, Debug)]
pub struct Nest<const N: usize> {
    /// Sizes; the last one is the inner loop.
    pub size: [usize; RANK],
    /// Strides in floats.
    pub stride: [[usize; RANK]; N],
}

impl<const N: usize> Nest<N> {
    /// From a shape and the strides of each tensor; `None` with more than six dimensions. The
    /// innermost dimension becomes the one with the smallest strides, the largest on a tie.
    pub fn new(shape: &[usize], strides: [&[usize]; N]) -> Option<Self> {
        let mut dims: Vec<(usize, [usize; N])> = (0..shape.len())
            .filter(|&i| shape[i] != 1)
            .map(|i| (shape[i], strides.map(|s| s[i])))
            .collect();
        // The last tensor is the result: follow its order in memory.
        dims.sort_by_key(|(_, s)| core::cmp::Reverse(s[N - 1]));
        let mut joined: Vec<(usize, [usize; N])> = Vec::new();
        for (n, s) in dims {
            match joined.last_mut() {
                Some((size, outer)) if (0..N).all(|t| outer[t] == s[t] * n) => {
                    *size *= n;
                    *outer = s;
                }
                _ => joined.push((n, s)),
            }
        }
        if joined.is_empty() {
            joined.push((1, [1; N]));
        }
        // Three channels make a poor inner loop; put the longest run of a small map there instead.
        let last = joined.len() - 1;
        if joined[last].0 < 8
            && let Some(longest) = (0..last).max_by_key(|&i| joined[i].0)
            && joined[longest].0 >= 8
        {
            joined.swap(longest, last);
        }
        if joined.len() > RANK {
            return None;
        }
        let mut nest = Self { size: [1; RANK], stride: [[0; RANK]; N] };
        let shift = RANK - joined.len();
        for (i, (n, s)) in joined.into_iter().enumerate() {
            nest.size[shift + i] = n;
            for t in 0..N {
                nest.stride[t][shift + i] = s[t];
            }
        }
        Some(nest)
    }

    /// Elements.
    pub fn len(&self) -> usize {
        self.size.iter().product()
    }

    /// Floats from the first to behind the last element of a tensor.
    pub fn extent(&self, tensor: usize) -> usize {
        (0..RANK).map(|i| (self.size[i] - 1) * self.stride[tensor][i]).sum::<usize>() + 1
    }

    /// Whether no two elements of a tensor share a place.
    pub fn distinct(&self, tensor: usize) -> bool {
        let mut dims: Vec<_> = (0..RANK)
            .filter(|&i| self.size[i] > 1)
            .map(|i| (self.stride[tensor][i], self.size[i]))
            .collect();
        dims.sort_unstable();
        let mut reach = 0;
        dims.into_iter().all(|(stride, size)| {
            let apart = stride > reach;
            reach += stride * (size - 1);
            apart
        })
    }

    /// Calls `f` with the offsets of every inner loop in this thread's part, and its length.
    #[inline(always)]
    fn each(&self, part: Part, mut f: impl FnMut([usize; N], usize)) {
        let outer: usize = self.size[..RANK - 1].iter().product();
        let inner = self.size[RANK - 1];
        // One long loop is cut, many loops are dealt out.
        let (loops, cut) =
            if outer >= part.of { (part.of(outer), 0..inner) } else { (0..outer, part.of(inner)) };
        if cut.is_empty() {
            return;
        }
        for i in loops {
            let mut rest = i;
            let mut at = [0; N];
            for d in (0..RANK - 1).rev() {
                let index = rest % self.size[d];
                rest /= self.size[d];
                for t in 0..N {
                    at[t] += index * self.stride[t][d];
                }
            }
            for t in 0..N {
                at[t] += cut.start * self.stride[t][RANK - 1];
            }
            f(at, cut.len());
        }
    }

    const fn inner(&self, tensor: usize) -> usize {
        self.stride[tensor][RANK - 1]
    }
}

/// A tensor into another layout.
#[derive(Clone, Debug)]
pub struct Copy {
    /// Source, result.
    pub nest: Nest<2>,
    /// Source.
    pub input: Place,
    /// Result.
    pub output: usize,
}

impl Copy {
    /// # Safety
    /// The step was checked, nobody else touches the result.
    pub(super) unsafe fn run(&self, mem: Mem, part: Part) {
        // SAFETY: offsets of the nest, which the check covers.
        unsafe {
            let (from, to) = (mem.at(self.input), mem.arena.add(self.output));
            let (a, c) = (self.nest.inner(0), self.nest.inner(1));
            self.nest.each(part, |[i, o], n| {
                if (a, c) == (1, 1) {
                    core::ptr::copy_nonoverlapping(from.add(i), to.add(o), n);
                } else {
                    for k in 0..n {
                        *to.add(o + k * c) = *from.add(i + k * a);
                    }
                }
            });
        }
    }
}

/// `x` limited to 0 to 1; not a number stays one.
#[inline(always)]
fn ramp(x: f32) -> f32 {
    let x = if x < 0.0 { 0.0 } else { x };
    if x > 1.0 { 1.0 } else { x }
}

/// See [`Unary::HardSwish`].
#[inline(always)]
fn hard_swish(x: f32) -> f32 {
    x * ramp(x * (1.0 / 6.0) + 0.5)
}

/// A function of every element.
#[derive(Clone, Debug)]
pub struct Map {
    /// What is computed.
    pub op: Unary,
    /// Operand, result.
    pub nest: Nest<2>,
    /// Operand.
    pub input: Place,
    /// Result.
    pub output: usize,
}

/// # Safety
/// The step was checked, nobody else touches the result.
#[inline(always)]
pub unsafe fn map(s: &Map, mem: Mem, part: Part) {
    // SAFETY: passed on.
    unsafe {
        match s.op {
            Unary::Clamp(low, high) => {
                map_with(s, mem, part, |x| {
                    let x = if x < low { low } else { x };
                    if x > high { high } else { x }
                });
            }
            Unary::Exp => map_with(s, mem, part, f32::exp),
            Unary::Sqrt => map_with(s, mem, part, f32::sqrt),
            Unary::Reciprocal => map_with(s, mem, part, f32::recip),
            Unary::Sigmoid => map_with(s, mem, part, |x| 1.0 / (1.0 + (-x).exp())),
            Unary::HardSigmoid(alpha, beta) => {
                map_with(s, mem, part, |x| ramp(alpha * x + beta));
            }
            Unary::HardSwish => map_with(s, mem, part, hard_swish),
            Unary::Neg => map_with(s, mem, part, |x| -x),
            Unary::Abs => map_with(s, mem, part, f32::abs),
            Unary::Log => map_with(s, mem, part, f32::ln),
            Unary::Tanh => map_with(s, mem, part, f32::tanh),
            Unary::Sin => map_with(s, mem, part, f32::sin),
            Unary::Cos => map_with(s, mem, part, f32::cos),
            Unary::Round { scale, zero } => {
                let (factor, zero) = (1.0 / scale, f32::from(zero));
                map_with(s, mem, part, |x| {
                    let byte = (x * factor).round_ties_even() + zero;
                    let byte = if byte < 0.0 { 0.0 } else { byte };
                    (if byte > 255.0 { 255.0 } else { byte } - zero) * scale
                });
            }
        }
    }
}

#[inline(always)]
unsafe fn map_with(s: &Map, mem: Mem, part: Part, f: impl Fn(f32) -> f32) {
    // SAFETY: offsets of the nest, which the check covers.
    unsafe {
        let (from, to) = (mem.at(s.input), mem.arena.add(s.output));
        let (a, c) = (s.nest.inner(0), s.nest.inner(1));
        s.nest.each(part, |[i, o], n| {
            if (a, c) == (1, 1) {
                for k in 0..n {
                    *to.add(o + k) = f(*from.add(i + k));
                }
            } else {
                for k in 0..n {
                    *to.add(o + k * c) = f(*from.add(i + k * a));
                }
            }
        });
    }
}

/// A function of two tensors.
#[derive(Clone, Debug)]
pub struct Zip {
    /// What is computed.
    pub op: Binary,
    /// Operands, result.
    pub nest: Nest<3>,
    /// Operands.
    pub inputs: [Place; 2],
    /// Result.
    pub output: usize,
}

/// # Safety
/// The step was checked, nobody else touches the result.
#[inline(always)]
pub unsafe fn zip(s: &Zip, mem: Mem, part: Part) {
    // SAFETY: passed on.
    unsafe {
        match s.op {
            Binary::Add => zip_with(s, mem, part, |a, b| a + b),
            Binary::Sub => zip_with(s, mem, part, |a, b| a - b),
            Binary::Mul => zip_with(s, mem, part, |a, b| a * b),
            Binary::Div => zip_with(s, mem, part, |a, b| a / b),
            Binary::Min => zip_with(s, mem, part, |a, b| if b < a { b } else { a }),
            Binary::Max => zip_with(s, mem, part, |a, b| if b > a { b } else { a }),
            Binary::Pow => zip_with(s, mem, part, f32::powf),
            Binary::MulHardSwish => zip_with(s, mem, part, |a, b| hard_swish(a * b)),
        }
    }
}

#[inline(always)]
unsafe fn zip_with(s: &Zip, mem: Mem, part: Part, f: impl Fn(f32, f32) -> f32) {
    // SAFETY: offsets of the nest, which the check covers.
    unsafe {
        let (left, right) = (mem.at(s.inputs[0]), mem.at(s.inputs[1]));
        let to = mem.arena.add(s.output);
        let (a, b, c) = (s.nest.inner(0), s.nest.inner(1), s.nest.inner(2));
        s.nest.each(part, |[i, j, o], n| {
            let (left, right, to) = (left.add(i), right.add(j), to.add(o));
            match (a, b, c) {
                (1, 1, 1) => {
                    for k in 0..n {
                        *to.add(k) = f(*left.add(k), *right.add(k));
                    }
                }
                (1, 0, 1) => {
                    let y = *right;
                    for k in 0..n {
                        *to.add(k) = f(*left.add(k), y);
                    }
                }
                (0, 1, 1) => {
                    let x = *left;
                    for k in 0..n {
                        *to.add(k) = f(x, *right.add(k));
                    }
                }
                _ => {
                    for k in 0..n {
                        *to.add(k * c) = f(*left.add(k * a), *right.add(k * b));
                    }
                }
            }
        });
    }
}

/// A reduction: for every element of the result (`outer`) the elements of `inner` are joined.
#[derive(Clone, Debug)]
pub struct Fold {
    /// What is computed.
    pub kind: Reduce,
    /// Operand, result: the dimensions that stay.
    pub outer: Nest<2>,
    /// Operand: the dimensions that go.
    pub inner: Nest<1>,
    /// Operand.
    pub input: Place,
    /// Result.
    pub output: usize,
}

/// # Safety
/// The step was checked, nobody else touches the result.
#[inline(always)]
pub unsafe fn fold(s: &Fold, mem: Mem, part: Part) {
    let all = Part { id: 0, of: 1 };
    // SAFETY: offsets of the nests, which the check covers.
    unsafe {
        let (from, to) = (mem.at(s.input), mem.arena.add(s.output));
        let (a, c) = (s.outer.inner(0), s.outer.inner(1));
        s.outer.each(part, |[i, o], n| {
            for k in 0..n {
                let from = from.add(i + k * a);
                // In f64, so that long sums need no special order.
                let mut sum = 0.0f64;
                let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
                let step = s.inner.inner(0);
                s.inner.each(all, |[i], n| {
                    for k in 0..n {
                        let x = *from.add(i + k * step);
                        sum += f64::from(x);
                        low = low.min(x);
                        high = high.max(x);
                    }
                });
                *to.add(o + k * c) = match s.kind {
                    Reduce::Sum => sum as f32,
                    Reduce::Mean => (sum / s.inner.len() as f64) as f32,
                    Reduce::Max => high,
                    Reduce::Min => low,
                };
            }
        });
    }
}
