//! Remarks on sequences that could be opened all the same.

use std::fmt;
use std::path::PathBuf;

use serde::Serialize;

/// How much a [`Note`] matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// A known peculiarity that was dealt with: unequal folders cut to the shorter, boxes of one
    /// sensor used for both.
    Quirk,
    /// Something is wrong with the files; what can be used is used.
    Broken,
}

/// One remark.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Note {
    /// How much it matters.
    pub severity: Severity,
    /// File or folder it is about.
    pub path: PathBuf,
    /// What, in words.
    pub text: String,
}

impl Note {
    pub(crate) fn quirk(path: impl Into<PathBuf>, text: impl Into<String>) -> Self {
        Self { severity: Severity::Quirk, path: path.into(), text: text.into() }
    }

    pub(crate) fn broken(path: impl Into<PathBuf>, text: impl Into<String>) -> Self {
        Self { severity: Severity::Broken, path: path.into(), text: text.into() }
    }
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.path.display(), self.text)
    }
}
