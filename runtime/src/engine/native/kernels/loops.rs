//! Element by element: copies between layouts, functions of one and two tensors, reductions. The
//! tensors may have any strides.

use super::simd::{self, Simd};
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
        let mut index = [0; RANK - 1];
        let mut at: [usize; N] = core::array::from_fn(|t| cut.start * self.inner(t));
        let mut rest = loops.start;
        for d in (0..RANK - 1).rev() {
            index[d] = rest % self.size[d];
            rest /= self.size[d];
            for t in 0..N {
                at[t] += index[d] * self.stride[t][d];
            }
        }
        for _ in loops {
            f(at, cut.len());
            // To the next loop without a division: inner loops can be as short as a few channels.
            for d in (0..RANK - 1).rev() {
                index[d] += 1;
                for t in 0..N {
                    at[t] += self.stride[t][d];
                }
                if index[d] < self.size[d] {
                    break;
                }
                index[d] = 0;
                for t in 0..N {
                    at[t] -= self.size[d] * self.stride[t][d];
                }
            }
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

/// Colours of a picture, which lie as planes before the first convolution.
const PLANES: usize = 3;

impl Copy {
    /// Planes into pixels: the distance of the planes, and the loops over their lines.
    fn interleaved(&self) -> Option<(usize, Nest<2>)> {
        let mut lines = self.nest.clone();
        let [from, to] = &lines.stride;
        let planes = lines.size[RANK - 2] == PLANES
            && (from[RANK - 1], to[RANK - 1]) == (1, PLANES)
            && to[RANK - 2] == 1;
        let apart = from[RANK - 2];
        lines.size[RANK - 2] = 1;
        planes.then_some((apart, lines))
    }
}

/// # Safety
/// The step was checked, nobody else touches the result.
#[inline(always)]
pub unsafe fn copy(s: &Copy, mem: Mem, part: Part) {
    // SAFETY: offsets of the nest, which the check covers.
    unsafe {
        let (from, to) = (mem.at(s.input), mem.arena.add(s.output));
        if let Some((apart, lines)) = s.interleaved() {
            lines.each(part, |[i, o], n| {
                let planes = [0, 1, 2].map(|p| from.add(i + p * apart));
                let to = to.add(o);
                // All colours of a pixel in one go, which compilers turn into shuffles.
                for k in 0..n {
                    for p in 0..PLANES {
                        *to.add(k * PLANES + p) = *planes[p].add(k);
                    }
                }
            });
            return;
        }
        let (a, c) = (s.nest.inner(0), s.nest.inner(1));
        s.nest.each(part, |[i, o], n| {
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
/// The step was checked, the instruction set is there, nobody else touches the result.
#[inline(always)]
pub unsafe fn zip<S: Simd>(s: &Zip, mem: Mem, part: Part) {
    // SAFETY: passed on.
    unsafe {
        match s.op {
            Binary::Add => zip_vectors::<S>(s, mem, part, |a, b| S::add(a, b)),
            Binary::Sub => zip_vectors::<S>(s, mem, part, |a, b| S::sub(a, b)),
            Binary::Mul => zip_vectors::<S>(s, mem, part, |a, b| S::mul(a, b)),
            Binary::Min => zip_vectors::<S>(s, mem, part, |a, b| S::at_most(b, a)),
            Binary::Max => zip_vectors::<S>(s, mem, part, |a, b| S::at_least(b, a)),
            Binary::MulHardSwish => {
                zip_vectors::<S>(s, mem, part, |a, b| simd::hard_swish::<S>(S::mul(a, b)));
            }
            Binary::Div => zip_numbers(s, mem, part, |a, b| a / b),
            Binary::Pow => zip_numbers(s, mem, part, f32::powf),
        }
    }
}

/// Whole vectors where the elements lie side by side, one of the operands possibly one number for
/// all; element by element otherwise.
#[inline(always)]
unsafe fn zip_vectors<S: Simd>(s: &Zip, mem: Mem, part: Part, f: impl Fn(S::V, S::V) -> S::V) {
    // SAFETY: offsets of the nest, which the check covers; the caller promises the instruction set.
    unsafe {
        let (left, right) = (mem.at(s.inputs[0]), mem.at(s.inputs[1]));
        let to = mem.arena.add(s.output);
        let (a, b, c) = (s.nest.inner(0), s.nest.inner(1), s.nest.inner(2));
        s.nest.each(part, |[i, j, o], n| {
            let (left, right, to) = (left.add(i), right.add(j), to.add(o));
            if a > 1 || b > 1 || c != 1 {
                for k in 0..n {
                    let y = f(S::splat(*left.add(k * a)), S::splat(*right.add(k * b)));
                    S::store_n(to.add(k * c), y, 1);
                }
                return;
            }
            let mut k = 0;
            while k + S::LANES <= n {
                let x = if a == 1 { S::load(left.add(k)) } else { S::splat(*left) };
                let y = if b == 1 { S::load(right.add(k)) } else { S::splat(*right) };
                S::store(to.add(k), f(x, y));
                k += S::LANES;
            }
            if k < n {
                let x = if a == 1 { S::load_n(left.add(k), n - k) } else { S::splat(*left) };
                let y = if b == 1 { S::load_n(right.add(k), n - k) } else { S::splat(*right) };
                S::store_n(to.add(k), f(x, y), n - k);
            }
        });
    }
}

#[inline(always)]
unsafe fn zip_numbers(s: &Zip, mem: Mem, part: Part, f: impl Fn(f32, f32) -> f32) {
    // SAFETY: offsets of the nest, which the check covers.
    unsafe {
        let (left, right) = (mem.at(s.inputs[0]), mem.at(s.inputs[1]));
        let to = mem.arena.add(s.output);
        let (a, b, c) = (s.nest.inner(0), s.nest.inner(1), s.nest.inner(2));
        s.nest.each(part, |[i, j, o], n| {
            for k in 0..n {
                *to.add(o + k * c) = f(*left.add(i + k * a), *right.add(j + k * b));
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
    // In f64, so that long sums need no special order.
    let (zero, count) = (0.0f64, s.inner.len() as f64);
    let add = |sum: f64, x: f32| sum + f64::from(x);
    let join = |a: f64, b: f64| a + b;
    let (low, high) = (f32::NEG_INFINITY, f32::INFINITY);
    // SAFETY: passed on.
    unsafe {
        match s.kind {
            Reduce::Sum => fold_with(s, mem, part, zero, add, join, |sum| sum as f32),
            Reduce::Mean => fold_with(s, mem, part, zero, add, join, |sum| (sum / count) as f32),
            Reduce::Max => fold_with(s, mem, part, low, f32::max, f32::max, |x| x),
            Reduce::Min => fold_with(s, mem, part, high, f32::min, f32::min, |x| x),
        }
    }
}

/// Partial results side by side, so that none waits for the one before.
const ABREAST: usize = 16;

/// Results side by side are computed together; a single one is joined from the elements of every
/// sixteenth place where those of a run lie side by side.
#[inline(always)]
unsafe fn fold_with<A: core::marker::Copy>(
    s: &Fold,
    mem: Mem,
    part: Part,
    start: A,
    add: impl Fn(A, f32) -> A,
    join: impl Fn(A, A) -> A,
    end: impl Fn(A) -> f32,
) {
    let all = Part { id: 0, of: 1 };
    // SAFETY: offsets of the nests, which the check covers.
    unsafe {
        let (from, to) = (mem.at(s.input), mem.arena.add(s.output));
        let (a, c) = (s.outer.inner(0), s.outer.inner(1));
        let step = s.inner.inner(0);
        s.outer.each(part, |[i, o], n| {
            let together = if a == 1 { n / ABREAST * ABREAST } else { 0 };
            for k in (0..together).step_by(ABREAST) {
                let from = from.add(i + k);
                let mut sums = [start; ABREAST];
                s.inner.each(all, |[i], n| {
                    for j in 0..n {
                        let from = from.add(i + j * step);
                        for l in 0..ABREAST {
                            sums[l] = add(sums[l], *from.add(l));
                        }
                    }
                });
                for (l, &sum) in sums.iter().enumerate() {
                    *to.add(o + (k + l) * c) = end(sum);
                }
            }
            for k in together..n {
                let from = from.add(i + k * a);
                let (mut sums, mut sum) = ([start; ABREAST], start);
                s.inner.each(all, |[i], n| {
                    let from = from.add(i);
                    let whole = if step == 1 { n / ABREAST * ABREAST } else { 0 };
                    for j in (0..whole).step_by(ABREAST) {
                        for l in 0..ABREAST {
                            sums[l] = add(sums[l], *from.add(j + l));
                        }
                    }
                    for j in whole..n {
                        sum = add(sum, *from.add(j * step));
                    }
                });
                *to.add(o + k * c) = end(sums.into_iter().fold(sum, &join));
            }
        });
    }
}
