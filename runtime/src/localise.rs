//! Reading the maps: where is the target, and how sure is that (spec 3.7).

use crate::crop::round_half_even;
use crate::geometry::Yx;
use crate::spec::TrackerParams;
use serde::{Deserialize, Serialize};

/// What the score map looks like.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Flag {
    /// One clear peak.
    Normal,
    /// A second peak that can be told from the target: worth learning from.
    HardNegative,
    /// A second peak about as high that cannot be told from the target.
    Uncertain,
    /// No peak.
    NotFound,
}

impl Flag {
    /// Lower-case name, as in logs.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::HardNegative => "hard_negative",
            Self::Uncertain => "uncertain",
            Self::NotFound => "not_found",
        }
    }
}

/// A cell of the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cell {
    /// Row, downwards.
    pub row: usize,
    /// Column, to the right.
    pub col: usize,
}

/// A peak of the score map.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Peak {
    /// Where.
    pub cell: Cell,
    /// How high.
    pub score: f32,
}

/// Result of [`localise`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Located {
    /// Verdict.
    pub flag: Flag,
    /// Where the target is taken to be: the highest peak, or the second one when only that is where
    /// the target can have moved to.
    pub cell: Cell,
    /// The highest peak.
    pub first: Peak,
    /// The highest peak outside the first one's neighbourhood; `None` when the first is too low to
    /// look for another.
    pub second: Option<Peak>,
}

/// Finds the target in a score map `(side, side)`, row-major.
///
/// `target` is the size of the target before this frame in cells (height, width); `previous` its
/// offset from the middle of the map in cells, before this frame.
pub fn localise(
    scores: &[f32],
    side: usize,
    params: &TrackerParams,
    target: Yx,
    previous: Yx,
) -> Located {
    localise_weighted(scores, side, params, target, previous, |_, _| 1.0)
}

/// [`localise`] on scores that are multiplied by `weight(row, column)` before they are compared with
/// one another. Whether the target is there at all is asked of the score itself, and that is what
/// peaks report.
pub(crate) fn localise_weighted(
    scores: &[f32],
    side: usize,
    params: &TrackerParams,
    target: Yx,
    previous: Yx,
    weight: impl Fn(usize, usize) -> f32,
) -> Located {
    let plain = |p: Peak| {
        let score = scores.get(p.cell.row * side + p.cell.col).copied().unwrap_or(p.score);
        Peak { score, ..p }
    };
    let first = peak(scores, side, |row, col| Some(weight(row, col)));
    if plain(first).score < params.not_found {
        return Located {
            flag: Flag::NotFound,
            cell: first.cell,
            first: plain(first),
            second: None,
        };
    }
    let rows = block(first.cell.row, params.neighbourhood * target.y, side);
    let cols = block(first.cell.col, params.neighbourhood * target.x, side);
    // Masked cells count as 0, not as minus infinity (quirk Q9).
    let second = peak(scores, side, |row, col| {
        (!(rows.contains(&row) && cols.contains(&col))).then(|| weight(row, col))
    });

    let middle = (side as f32 - 1.0) * 0.5;
    let moved = |p: &Peak| {
        let (y, x) = (p.cell.row as f32 - middle, p.cell.col as f32 - middle);
        libm::sqrtf((y - previous.y) * (y - previous.y) + (x - previous.x) * (x - previous.x))
    };
    let far = params.displacement * side as f32 * 0.5;
    let (a, b) = (moved(&first), moved(&second));
    let (flag, cell) = if second.score > params.distractor * first.score {
        if b > far && a < far {
            (Flag::HardNegative, first.cell)
        } else if b < far && a > far {
            (Flag::HardNegative, second.cell)
        } else {
            (Flag::Uncertain, first.cell)
        }
    } else if second.score > params.hard_negative * first.score && second.score > params.not_found {
        (Flag::HardNegative, first.cell)
    } else {
        (Flag::Normal, first.cell)
    };
    Located { flag, cell, first: plain(first), second: Some(second) }
}

/// Rows or columns of the block around a peak that the second peak may not come from.
fn block(centre: usize, length: f32, side: usize) -> core::ops::Range<usize> {
    let edge = |v: f32| round_half_even(v).clamp(0.0, side as f32) as usize;
    let centre = centre as f32;
    edge(centre - length * 0.5)..edge(centre + length * 0.5 + 1.0)
}

/// The maximum; of equal ones that with the smaller column, then the smaller row (quirk Q9). Scores
/// count times `weight(row, column)`, cells without a weight as 0.
fn peak(scores: &[f32], side: usize, weight: impl Fn(usize, usize) -> Option<f32>) -> Peak {
    let mut best = Peak { cell: Cell::default(), score: f32::NEG_INFINITY };
    for col in 0..side {
        for row in 0..side {
            let score = match weight(row, col) {
                Some(weight) => {
                    scores.get(row * side + col).map_or(f32::NEG_INFINITY, |score| score * weight)
                }
                None => 0.0,
            };
            if score > best.score {
                best = Peak { cell: Cell { row, col }, score };
            }
        }
    }
    best
}

#[cfg(test)]
mod tests;
