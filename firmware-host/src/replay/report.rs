//! What a replay found.

use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// A quantity that is off.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Violation {
    /// Name of the run.
    pub run: String,
    /// Number of the frame; 0 is the annotated one.
    pub frame: u64,
    /// Name of the field in the script.
    pub field: String,
    /// What the script says.
    pub expected: String,
    /// What the tracker did.
    pub got: String,
    /// Largest difference and the one allowed, for numbers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub difference: Option<(f64, f64)>,
}

/// One run.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RunReport {
    /// Its name.
    pub name: String,
    /// Frames after the annotated one, or crops.
    pub frames: usize,
    /// Largest difference per quantity, with its unit in the name.
    pub largest: BTreeMap<&'static str, f64>,
    /// Values compared exactly: flags, cells, slots, counters.
    pub exact: usize,
    /// Everything that is off.
    pub violations: Vec<Violation>,
}

/// All runs of a script.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// In the order of the script.
    pub runs: Vec<RunReport>,
    /// Fields and tensors this version does not know.
    pub unknown: BTreeSet<String>,
    /// Fields that are known, but have no counterpart to be compared with.
    pub not_compared: BTreeSet<&'static str>,
}

impl Report {
    /// Everything that is off, of all runs.
    pub fn violations(&self) -> impl Iterator<Item = &Violation> {
        self.runs.iter().flat_map(|run| &run.violations)
    }

    /// Whether something was compared and nothing is off.
    pub fn passed(&self) -> bool {
        !self.runs.is_empty() && self.violations().next().is_none()
    }
}

/// Compares one frame's fields and keeps the largest differences.
pub struct Comparer<'a> {
    /// Where findings go.
    pub run: &'a mut RunReport,
    /// The frame.
    pub frame: u64,
}

impl Comparer<'_> {
    fn violation(
        &mut self,
        field: &str,
        expected: String,
        got: String,
        difference: Option<(f64, f64)>,
    ) {
        let run = self.run.name.clone();
        let field = field.to_string();
        self.run.violations.push(Violation {
            run,
            frame: self.frame,
            field,
            expected,
            got,
            difference,
        });
    }

    /// Numbers; nothing to do when the script does not have them.
    pub fn numbers(
        &mut self,
        quantity: &'static str,
        field: &str,
        got: &[f32],
        expected: Option<&[f64]>,
        tolerance: f64,
    ) {
        let Some(expected) = expected else { return };
        let off = match got.len() == expected.len() {
            true => got.iter().zip(expected).map(|(a, b)| distance(f64::from(*a), *b)),
            false => {
                let (want, have) = (format!("{expected:?}"), format!("{got:?}"));
                return self.violation(field, want, have, None);
            }
        };
        let off = off.fold(0.0, f64::max);
        let largest = self.run.largest.entry(quantity).or_default();
        *largest = largest.max(off);
        if off > tolerance {
            let (want, have) = (format!("{expected:?}"), format!("{got:?}"));
            self.violation(field, want, have, Some((off, tolerance)));
        }
    }

    /// Values that have to be equal.
    pub fn exact<T: PartialEq + fmt::Debug>(&mut self, field: &str, got: T, expected: Option<T>) {
        let Some(expected) = expected else { return };
        self.run.exact += 1;
        if got != expected {
            self.violation(field, format!("{expected:?}"), format!("{got:?}"), None);
        }
    }
}

/// Absolute difference; infinite where one is no number.
fn distance(a: f64, b: f64) -> f64 {
    let off = (a - b).abs();
    if off.is_nan() { f64::INFINITY } else { off }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for v in self.violations() {
            write!(
                f,
                "run {}, frame {}, {}: expected {}, got {}",
                v.run, v.frame, v.field, v.expected, v.got
            )?;
            match v.difference {
                Some((off, allowed)) => writeln!(f, " (off by {off:.3e}, allowed {allowed:.1e})")?,
                None => writeln!(f)?,
            }
        }
        for field in &self.not_compared {
            writeln!(f, "{field}: known, not compared")?;
        }
        for field in &self.unknown {
            writeln!(f, "{field}: unknown, not compared")?;
        }
        for run in &self.runs {
            write!(f, "{}: {} frames, ", run.name, run.frames)?;
            match run.violations.len() {
                0 => write!(f, "ok")?,
                n => write!(f, "{n} VIOLATIONS")?,
            }
            write!(f, "; {} exact values", run.exact)?;
            for (quantity, off) in &run.largest {
                write!(f, ", {quantity} {off:.2e}")?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}
