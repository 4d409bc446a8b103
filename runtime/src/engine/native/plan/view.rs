//! Tensors as views of a buffer: any order of dimensions, any strides. Reshapes, transpositions and
//! slices change the view and move nothing.

/// Where a view's elements are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Base {
    /// A constant of the graph, not placed yet.
    Constant(usize),
    /// The weights, at this place.
    Weights(usize),
    /// The arena, at this address.
    Arena(usize),
}

/// A tensor somewhere.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct View {
    /// Where the buffer starts.
    pub base: Base,
    /// First element, from there.
    pub offset: usize,
    /// Sizes.
    pub shape: Vec<usize>,
    /// Floats from element to element along each dimension; 0 repeats.
    pub stride: Vec<usize>,
    /// Width of the border of zeros around rows and columns of a map `(1, C, H, W)`.
    pub halo: usize,
}

/// Strides of a tensor without gaps.
pub fn dense(shape: &[usize]) -> Vec<usize> {
    let mut stride = vec![1; shape.len()];
    for i in (1..shape.len()).rev() {
        stride[i - 1] = stride[i] * shape[i];
    }
    stride
}

impl View {
    /// A tensor without gaps.
    pub fn dense(base: Base, shape: &[usize]) -> Self {
        Self { base, offset: 0, shape: shape.into(), stride: dense(shape), halo: 0 }
    }

    /// Dimension `i` of the result is `perm[i]` of this.
    pub fn transposed(&self, perm: &[usize]) -> Self {
        Self {
            shape: perm.iter().map(|&i| self.shape[i]).collect(),
            stride: perm.iter().map(|&i| self.stride[i]).collect(),
            halo: 0,
            ..self.clone()
        }
    }

    /// Every `step`th element from `start` along `axis`, `len` in all.
    pub fn sliced(&self, axis: usize, start: usize, step: usize, len: usize) -> Self {
        let mut view = self.clone();
        view.offset += start * self.stride[axis];
        view.shape[axis] = len;
        view.stride[axis] *= step;
        // A border around rows and columns stays one when channels go.
        if axis != 1 {
            view.halo = 0;
        }
        view
    }

    /// Repeated to a larger shape.
    pub fn expanded(&self, shape: &[usize]) -> Self {
        let missing = shape.len() - self.shape.len();
        let stride = (0..shape.len()).map(|i| match i.checked_sub(missing) {
            Some(j) if self.shape[j] == shape[i] => self.stride[j],
            _ => 0,
        });
        let stride = stride.collect();
        let halo = if self.shape == shape { self.halo } else { 0 };
        Self { shape: shape.into(), stride, halo, ..self.clone() }
    }

    /// Same elements in the same order with another shape, if that needs no copy.
    pub fn reshaped(&self, shape: &[usize]) -> Option<Self> {
        if shape == self.shape {
            return Some(self.clone());
        }
        // Runs of dimensions that are one behind the other in memory.
        let mut runs: Vec<(usize, usize)> = Vec::new();
        for (&n, &s) in self.shape.iter().zip(&self.stride) {
            match runs.last_mut() {
                _ if n == 1 => {}
                Some((size, stride)) if *stride == s * n => {
                    *size *= n;
                    *stride = s;
                }
                _ => runs.push((n, s)),
            }
        }
        // Every run is split into new dimensions, innermost first.
        let mut stride = vec![1; shape.len()];
        let mut run = runs.pop();
        for (i, &n) in shape.iter().enumerate().rev() {
            if n == 1 {
                continue;
            }
            let (size, s) = run?;
            if size % n != 0 {
                return None;
            }
            stride[i] = s;
            run = if size == n { runs.pop() } else { Some((size / n, s * n)) };
        }
        Some(Self { shape: shape.into(), stride, halo: 0, ..self.clone() })
    }

    /// Dimensions from the outermost in memory to the innermost; those of size one stay in place.
    pub fn order(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.shape.len()).collect();
        let wide: Vec<usize> = order.iter().copied().filter(|&i| self.shape[i] > 1).collect();
        let mut sorted = wide.clone();
        sorted.sort_by_key(|&i| core::cmp::Reverse(self.stride[i]));
        for (&to, from) in wide.iter().zip(sorted) {
            order[to] = from;
        }
        order
    }

    /// Whether elements along the last dimension are neighbours.
    pub fn is_run(&self) -> bool {
        match (self.shape.last(), self.stride.last()) {
            (Some(&n), Some(&s)) => n == 1 || s == 1,
            _ => true,
        }
    }
}

/// Joins dimensions of views with the same sizes where all of them allow it; sizes and, per view,
/// strides, outermost first.
pub fn join(shape: &[usize], strides: &[&[usize]]) -> Vec<(usize, Vec<usize>)> {
    let mut joined: Vec<(usize, Vec<usize>)> = Vec::new();
    for (i, &n) in shape.iter().enumerate() {
        if n == 1 {
            continue;
        }
        let inner: Vec<usize> = strides.iter().map(|s| s[i]).collect();
        match joined.last_mut() {
            Some((size, outer)) if outer.iter().zip(&inner).all(|(o, s)| *o == s * n) => {
                *size *= n;
                *outer = inner;
            }
            _ => joined.push((n, inner)),
        }
    }
    joined
}

#[cfg(test)]
mod tests {
    use super::*;

    fn addresses(view: &View) -> Vec<usize> {
        let len: usize = view.shape.iter().product();
        let steps = dense(&view.shape);
        (0..len)
            .map(|i| {
                let dims = steps.iter().zip(&view.shape).map(|(s, n)| i / s % n);
                view.offset + dims.zip(&view.stride).map(|(at, s)| at * s).sum::<usize>()
            })
            .collect()
    }

    #[test]
    fn reshapes_keep_the_order_of_elements_or_ask_for_a_copy() {
        let dense = View::dense(Base::Arena(0), &[2, 3, 4, 5]);
        let swapped = dense.transposed(&[0, 2, 3, 1]);
        let slice = dense.sliced(2, 1, 2, 2);
        let repeated = View::dense(Base::Arena(0), &[4, 1]).expanded(&[4, 6]);
        let cases: [(&View, &[usize], bool); 9] = [
            (&dense, &[6, 20], true),
            (&dense, &[2, 1, 12, 5, 1], true),
            (&dense, &[7, 5], false),
            (&swapped, &[2, 20, 3], true),
            (&swapped, &[2, 60], false),
            (&swapped, &[2, 2, 10, 3], true),
            (&slice, &[6, 2, 5], true),
            (&slice, &[6, 10], false),
            (&repeated, &[2, 2, 3, 2], true),
        ];
        for (view, shape, possible) in cases {
            let result = view.reshaped(shape);
            assert_eq!(result.is_some(), possible, "{view:?} to {shape:?}");
            if let Some(result) = result {
                assert_eq!(addresses(&result), addresses(view), "{view:?} to {shape:?}");
            }
        }
    }

    #[test]
    fn joining_needs_all_views_to_agree() {
        let (a, b) = ([20, 5, 1], [40, 10, 1]);
        assert_eq!(join(&[3, 4, 5], &[&a]), [(60, vec![1])]);
        assert_eq!(join(&[3, 4, 5], &[&a, &b]), [(12, vec![5, 10]), (5, vec![1, 1])]);
        assert_eq!(join(&[1, 1], &[&[7, 7]]), []);
    }
}
