//! Views as rows, maps and batches, which is how kernels want them.

use super::super::kernels::Pitch;
use super::view::{View, join};

/// Rows along all dimensions but the last.
#[derive(Clone, Debug)]
pub struct Rows {
    /// Lines and rows per line.
    pub size: [usize; 2],
    /// Of every view.
    pub pitch: Vec<Pitch>,
}

/// The rows of views with the same sizes but for the last; `None` when they are not rows on lines.
pub fn rows(views: &[&View]) -> Option<Rows> {
    let first = views.first()?;
    let outer = first.shape.len().checked_sub(1)?;
    let strides: Vec<&[usize]> = views.iter().map(|v| &v.stride[..outer]).collect();
    let joined = join(&first.shape[..outer], &strides);
    let pitch = |y: Option<&Vec<usize>>, x: Option<&Vec<usize>>| {
        let at = |s: Option<&Vec<usize>>, i: usize| s.map_or(0, |s| s[i]);
        (0..views.len()).map(|i| Pitch { y: at(y, i), x: at(x, i) }).collect()
    };
    match &*joined {
        [] => Some(Rows { size: [1, 1], pitch: pitch(None, None) }),
        [(n, s)] => Some(Rows { size: [1, *n], pitch: pitch(None, Some(s)) }),
        [(h, y), (w, x)] => Some(Rows { size: [*h, *w], pitch: pitch(Some(y), Some(x)) }),
        _ => None,
    }
}

/// Offsets of all index combinations of leading dimensions, last one fastest.
pub fn offsets<const N: usize>(shape: &[usize], strides: [&[usize]; N]) -> Vec<[usize; N]> {
    let mut all = vec![[0; N]];
    for (d, &n) in shape.iter().enumerate() {
        all = all
            .into_iter()
            .flat_map(|at| {
                (0..n).map(move |i| {
                    let mut at = at;
                    for (t, offset) in at.iter_mut().enumerate() {
                        *offset += i * strides[t][d];
                    }
                    at
                })
            })
            .collect();
    }
    all
}
