//! Regions as text: rectangle, polygon, mask; and the box a tracker starts from.

use core::fmt;
use tsda_runtime::BBox;

/// Where a target is. Coordinates are continuous: a picture of width `W` covers `[0, W)`.
#[derive(Clone, Debug, PartialEq)]
pub enum Region {
    /// A code instead of a place (0: no target).
    Special(i32),
    /// `left,top,width,height`.
    Rectangle(BBox),
    /// Corners `x, y`; at least three.
    Polygon(Vec<[f32; 2]>),
    /// Pixels.
    Mask(Mask),
}

/// A set of pixels within a window, as run lengths.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    /// Left column of the window.
    pub x: i32,
    /// Top row of the window.
    pub y: i32,
    /// Columns of the window.
    pub width: u32,
    /// Rows of the window.
    pub height: u32,
    runs: Vec<u32>,
}

/// A region that cannot be read, or that no target can be taken from.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RegionError {
    /// A number that is none.
    #[error("region: \"{text}\" (number {index}) is not {want}")]
    Number {
        /// 1-based.
        index: usize,
        /// What was found, shortened.
        text: String,
        /// What was expected.
        want: &'static str,
    },
    /// NaN or infinity.
    #[error("region: number {index} is not finite")]
    NotFinite {
        /// 1-based.
        index: usize,
    },
    /// A count that fits no kind of region.
    #[error(
        "region of {count} numbers: a rectangle has 4 (left,top,width,height), a polygon an even \
         number of at least 6"
    )]
    Count {
        /// Numbers found.
        count: usize,
    },
    /// A prefix that names no kind of region.
    #[error("region kind \"{kind}\" is not known: rectangle, polygon, mask are")]
    Kind {
        /// What was found, shortened.
        kind: String,
    },
    /// A code instead of a place.
    #[error("special region {code} says where no target is: send a rectangle, polygon or mask")]
    Special {
        /// The code.
        code: i32,
    },
    /// Less than its four leading numbers.
    #[error("mask of {count} numbers: left, top, width, height and run lengths are expected")]
    MaskHeader {
        /// Numbers found.
        count: usize,
    },
    /// More run lengths than pixels.
    #[error("mask of {width} x {height} pixels has run lengths for {pixels} pixels")]
    MaskRuns {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Sum of the run lengths.
        pixels: u64,
    },
    /// No pixel belongs to the target.
    #[error("mask of {width} x {height} pixels is empty: no pixel belongs to a target")]
    EmptyMask {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// A width or height that is not positive.
    #[error("region {width} x {height} has no area")]
    NoArea {
        /// Width.
        width: f32,
        /// Height.
        height: f32,
    },
}

impl Region {
    /// Reads a region; its kind is told by a prefix (`mask:`), else by the count of numbers.
    ///
    /// # Errors
    /// Says which number or count is wrong.
    pub fn parse(text: &str) -> Result<Self, RegionError> {
        let (kind, numbers) = match text.split_once(':') {
            Some((kind, numbers)) => (Some(kind.trim()), numbers),
            None => (None, text),
        };
        let words = || numbers.split(',').map(str::trim);
        match kind {
            Some("mask") => Mask::parse(words()).map(Self::Mask),
            Some("special") => Self::special(numbers.trim()),
            Some("rect" | "rectangle") => match finite(words())?[..] {
                [x, y, w, h] => Ok(Self::Rectangle(BBox::new(x, y, w, h))),
                ref other => Err(RegionError::Count { count: other.len() }),
            },
            Some("poly" | "polygon") => Self::polygon(&finite(words())?),
            Some(other) => Err(RegionError::Kind { kind: shortened(other) }),
            None => match words().count() {
                1 => Self::special(numbers.trim()),
                4 => {
                    let n = finite(words())?;
                    Ok(Self::Rectangle(BBox::new(n[0], n[1], n[2], n[3])))
                }
                _ => Self::polygon(&finite(words())?),
            },
        }
    }

    fn special(text: &str) -> Result<Self, RegionError> {
        integer(0, text, "a special code, and four numbers were expected").map(Self::Special)
    }

    fn polygon(numbers: &[f32]) -> Result<Self, RegionError> {
        let (corners, rest) = numbers.as_chunks::<2>();
        if corners.len() < 3 || !rest.is_empty() {
            return Err(RegionError::Count { count: numbers.len() });
        }
        Ok(Self::Polygon(corners.to_vec()))
    }

    /// The smallest box around the region.
    ///
    /// # Errors
    /// When the region is a code, has no area, or is a mask without a pixel.
    pub fn bounds(&self) -> Result<BBox, RegionError> {
        let b = match self {
            Self::Special(code) => return Err(RegionError::Special { code: *code }),
            Self::Rectangle(b) => *b,
            Self::Polygon(corners) => {
                let mut low = [f32::INFINITY; 2];
                let mut high = [f32::NEG_INFINITY; 2];
                for corner in corners {
                    for k in 0..2 {
                        low[k] = low[k].min(corner[k]);
                        high[k] = high[k].max(corner[k]);
                    }
                }
                BBox::new(low[0], low[1], high[0] - low[0], high[1] - low[1])
            }
            Self::Mask(mask) => mask.bounds()?,
        };
        if b.w > 0.0 && b.h > 0.0 {
            Ok(b)
        } else {
            Err(RegionError::NoArea { width: b.w, height: b.h })
        }
    }
}

impl fmt::Display for Region {
    /// The text on the wire; numbers are written so that the same ones are read back.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Special(code) => write!(f, "{code}"),
            Self::Rectangle(b) => write!(f, "{},{},{},{}", b.x, b.y, b.w, b.h),
            Self::Polygon(corners) => {
                for (i, [x, y]) in corners.iter().enumerate() {
                    write!(f, "{}{x},{y}", if i == 0 { "" } else { "," })?;
                }
                Ok(())
            }
            Self::Mask(m) => {
                write!(f, "mask:{},{},{},{}", m.x, m.y, m.width, m.height)?;
                m.runs.iter().try_for_each(|run| write!(f, ",{run}"))
            }
        }
    }
}

impl Mask {
    /// From run lengths, row by row, alternating between outside and inside, the first outside.
    /// What follows the last run is outside.
    ///
    /// # Errors
    /// When there are runs for more pixels than the window has.
    pub fn new(
        x: i32,
        y: i32,
        width: u32,
        height: u32,
        runs: Vec<u32>,
    ) -> Result<Self, RegionError> {
        let pixels: u64 = runs.iter().map(|&r| u64::from(r)).sum();
        if pixels > u64::from(width) * u64::from(height) {
            return Err(RegionError::MaskRuns { width, height, pixels });
        }
        Ok(Self { x, y, width, height, runs })
    }

    fn parse<'a>(words: impl Iterator<Item = &'a str>) -> Result<Self, RegionError> {
        let mut words = words.enumerate();
        let mut header = [0i32; 4];
        for (k, value) in header.iter_mut().enumerate() {
            let (i, word) = words.next().ok_or(RegionError::MaskHeader { count: k })?;
            let want = if k < 2 { "a whole number" } else { "a number of pixels" };
            *value = integer(i, word, want)?;
            if k >= 2 && *value < 0 {
                return Err(RegionError::Number { index: i + 1, text: shortened(word), want });
            }
        }
        let runs = words
            .map(|(i, word)| {
                word.parse::<u32>().map_err(|_| RegionError::Number {
                    index: i + 1,
                    text: shortened(word),
                    want: "a run length",
                })
            })
            .collect::<Result<_, _>>()?;
        let [x, y, width, height] = header;
        Self::new(x, y, width.unsigned_abs(), height.unsigned_abs(), runs)
    }

    /// The run lengths.
    pub fn runs(&self) -> &[u32] {
        &self.runs
    }

    /// The smallest box around the pixels inside.
    ///
    /// # Errors
    /// When there is none.
    pub fn bounds(&self) -> Result<BBox, RegionError> {
        let width = u64::from(self.width);
        let (mut left, mut right) = (u64::MAX, 0u64);
        let (mut top, mut bottom) = (u64::MAX, 0u64);
        let mut at = 0u64;
        for (i, &run) in self.runs.iter().enumerate() {
            let (start, end) = (at, at + u64::from(run));
            at = end;
            if i % 2 == 0 || run == 0 {
                continue;
            }
            // A run has pixels, so the window has columns.
            let (first, last) = (start / width, (end - 1) / width);
            top = top.min(first);
            bottom = bottom.max(last + 1);
            if first == last {
                left = left.min(start % width);
                right = right.max((end - 1) % width + 1);
            } else {
                // Over the end of a row into the start of the next: both edges are touched.
                left = 0;
                right = width;
            }
        }
        if right == 0 {
            return Err(RegionError::EmptyMask { width: self.width, height: self.height });
        }
        Ok(BBox::new(
            (i64::from(self.x) + left as i64) as f32,
            (i64::from(self.y) + top as i64) as f32,
            (right - left) as f32,
            (bottom - top) as f32,
        ))
    }
}

/// All numbers, finite.
fn finite<'a>(words: impl Iterator<Item = &'a str>) -> Result<Vec<f32>, RegionError> {
    words
        .enumerate()
        .map(|(i, word)| match word.parse::<f32>() {
            Ok(v) if v.is_finite() => Ok(v),
            Ok(_) => Err(RegionError::NotFinite { index: i + 1 }),
            Err(_) => {
                Err(RegionError::Number { index: i + 1, text: shortened(word), want: "a number" })
            }
        })
        .collect()
}

fn integer(index: usize, word: &str, want: &'static str) -> Result<i32, RegionError> {
    word.parse().map_err(|_| RegionError::Number { index: index + 1, text: shortened(word), want })
}

/// Messages quote what they got, but not megabytes of it.
pub(super) fn shortened(text: &str) -> String {
    match text.char_indices().nth(40) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text.to_owned(),
    }
}
