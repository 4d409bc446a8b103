//! `kind:path[@split]`: how configurations and command lines name a dataset.
//!
//! | kind | what |
//! |---|---|
//! | `pairs` | registered stills, one frame each ([`PairsDataset`]) |
//! | `pseudo` | the same stills as clips, one per target ([`pseudo::clips`], default options) |
//! | `sequences` | LasHeR-like clips ([`SequencesDataset`]) |

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use super::pairs::PairsDataset;
use super::sequences::{SequenceFilter, SequencesDataset};
use super::{DatasetError, Sequence};
use crate::pseudo::{self, PseudoError, PseudoOptions};

/// Which part of a dataset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Split {
    /// What a network is fitted on.
    Train,
    /// What is looked at while developing.
    Val,
    /// What is looked at once, at the end.
    Test,
    /// Everything, whatever its split.
    #[default]
    All,
}

impl Split {
    /// Name as it stands in index files and dataset texts.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Val => "val",
            Self::Test => "test",
            Self::All => "all",
        }
    }

    /// Does an entry marked `marked` belong to this part?
    pub fn takes(self, marked: &str) -> bool {
        self == Self::All || self.as_str() == marked
    }
}

impl fmt::Display for Split {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A split name that is none.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown split '{0}': expected train, val, test or all")]
pub struct UnknownSplit(pub String);

impl FromStr for Split {
    type Err = UnknownSplit;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        [Self::Train, Self::Val, Self::Test, Self::All]
            .into_iter()
            .find(|split| split.as_str() == s)
            .ok_or_else(|| UnknownSplit(s.to_owned()))
    }
}

/// Sequences of any layout under one name.
pub struct Dataset {
    /// The text it was opened by, or a name given by the caller; stands in reports.
    pub name: String,
    /// The sequences, in a fixed order.
    pub sequences: Vec<Box<dyn Sequence>>,
}

impl fmt::Debug for Dataset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ids: Vec<&str> = self.sequences.iter().map(|s| s.id()).collect();
        f.debug_struct("Dataset").field("name", &self.name).field("sequences", &ids).finish()
    }
}

/// A dataset text that cannot be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The text does not begin with a known kind.
    #[error(
        "dataset '{text}': expected pairs:PATH[@split], pseudo:PATH[@split] or sequences:PATH[@split]"
    )]
    Kind {
        /// The text given.
        text: String,
    },
    /// What follows the `@` is no split.
    #[error("dataset '{text}': {source}")]
    Split {
        /// The text given.
        text: String,
        /// The name that is none.
        source: UnknownSplit,
    },
    /// The folder could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// No clips could be made from the stills.
    #[error(transparent)]
    Pseudo(#[from] PseudoError),
    /// None of the stills has a target of a usable size.
    #[error("dataset '{text}': no target of a size that clips can be made from")]
    NoClips {
        /// The text given.
        text: String,
    },
}

/// Opens `pairs:PATH[@split]`, `pseudo:PATH[@split]` or `sequences:PATH[@split]`; without a split,
/// everything. Of `pseudo`, all stills used are decoded at once and kept.
///
/// # Errors
/// For a text of another form, an unknown split, or a folder that cannot be read.
pub fn open(text: &str) -> Result<Dataset, OpenError> {
    let (kind, rest) =
        text.split_once(':').ok_or_else(|| OpenError::Kind { text: text.to_owned() })?;
    // An '@' followed by a path separator belongs to the path.
    let (path, split) = match rest.rsplit_once('@') {
        Some((path, split)) if !split.contains(['/', '\\']) => {
            let split = split
                .parse()
                .map_err(|source| OpenError::Split { text: text.to_owned(), source })?;
            (path, split)
        }
        _ => (rest, Split::All),
    };
    if path.is_empty() {
        return Err(OpenError::Kind { text: text.to_owned() });
    }
    let path = Path::new(path);
    let sequences: Vec<Box<dyn Sequence>> = match kind {
        "pairs" => boxed(PairsDataset::open(path, split)?.into_pairs()),
        "pseudo" => {
            let pairs = PairsDataset::open(path, split)?;
            let stills = pairs.pairs().iter().map(|p| p as &dyn Sequence);
            let clips = pseudo::clips(stills, PseudoOptions::default())?;
            if clips.is_empty() {
                return Err(OpenError::NoClips { text: text.to_owned() });
            }
            boxed(clips)
        }
        "sequences" => {
            let filter = SequenceFilter { split, ..SequenceFilter::default() };
            boxed(SequencesDataset::open(path, &filter)?.into_sequences())
        }
        _ => return Err(OpenError::Kind { text: text.to_owned() }),
    };
    Ok(Dataset { name: text.to_owned(), sequences })
}

fn boxed<S: Sequence + 'static>(items: Vec<S>) -> Vec<Box<dyn Sequence>> {
    items.into_iter().map(|s| Box::new(s) as Box<dyn Sequence>).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_texts_say_what_was_expected() {
        for (text, want) in [
            ("here", "pairs:PATH"),
            ("video:here", "pairs:PATH"),
            ("pairs:", "pairs:PATH"),
            ("pairs:here@vall", "unknown split 'vall'"),
            ("sequences:not/there", "not/there"),
        ] {
            let e = open(text).unwrap_err().to_string();
            assert!(e.contains(want), "{text}: {e}");
        }
    }

    #[test]
    fn splits_read_back_what_they_print() {
        for split in [Split::Train, Split::Val, Split::Test, Split::All] {
            assert_eq!(split.to_string().parse(), Ok(split));
        }
        assert!(Split::All.takes("anything") && !Split::Val.takes("train"));
    }
}
