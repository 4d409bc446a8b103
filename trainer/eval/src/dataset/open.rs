//! `kind[/option..]:path[@split]`: how configurations and command lines name a dataset.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use tsda_runtime::Modality;

use super::layout::Jobs;
use super::pairs::{self, PairsDataset};
use super::{DatasetError, Sequence};
use super::{antiuav, lasher, parallel, rgbt, sequences, single, stills, vtuav};
use crate::pseudo::{self, PseudoError, PseudoOptions};

/// One kind of dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kind {
    /// What stands before the colon.
    pub name: &'static str,
    /// What it reads, in a few words.
    pub about: &'static str,
    /// What may follow the name behind a slash.
    pub options: &'static [&'static str],
}

impl fmt::Display for Kind {
    /// `otb[/thermal|/zero-based]`: the name and what may follow it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.options {
            [] => f.write_str(self.name),
            options => write!(f, "{}[/{}]", self.name, options.join("|/")),
        }
    }
}

const fn kind(name: &'static str, about: &'static str, options: &'static [&'static str]) -> Kind {
    Kind { name, about, options }
}

/// Every kind [`open`] and [`scan`] know.
pub const KINDS: [Kind; 13] = [
    kind("sequences", "LasHeR-like clips of one or two sensors, optional index.json", &[]),
    kind("pairs", "registered RGB-thermal stills with an index.json", &[]),
    kind("pseudo", "clips made from such stills, one per target", &[]),
    kind("stills", "stills with boxes listed in an index.json", &[]),
    kind("coco", "stills with COCO annotation files", &["thermal"]),
    kind("lasher", "LasHeR", &[]),
    kind("rgbt234", "RGBT234", &[]),
    kind("rgbt210", "RGBT210", &[]),
    kind("gtot", "GTOT", &[]),
    kind("vtuav", "VTUAV", &["interpolated"]),
    kind("antiuav", "Anti-UAV, RGB-T or thermal only (Anti-UAV410)", &["registered"]),
    kind("otb", "OTB style clips of one sensor", &["thermal", "zero-based"]),
    kind("got10k", "GOT-10k style clips of one sensor", &["thermal"]),
];

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

/// What [`scan`] found: what could be read, and what could not.
pub struct Scan {
    /// The text it was opened by.
    pub name: String,
    /// The sequences that could be read, in a fixed order.
    pub sequences: Vec<Box<dyn Sequence>>,
    /// Why others could not, with file and line.
    pub broken: Vec<DatasetError>,
}

impl fmt::Debug for Scan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ids: Vec<&str> = self.sequences.iter().map(|s| s.id()).collect();
        f.debug_struct("Scan")
            .field("name", &self.name)
            .field("sequences", &ids)
            .field("broken", &self.broken)
            .finish()
    }
}

/// `KIND:PATH[@split] ..` for messages.
fn kinds() -> String {
    KINDS.iter().map(Kind::to_string).collect::<Vec<_>>().join(", ")
}

/// A dataset text that cannot be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The text does not begin with a known kind.
    #[error(
        "dataset '{text}': expected KIND:PATH[@train|@val|@test], KIND being one of {}",
        kinds()
    )]
    Kind {
        /// The text given.
        text: String,
    },
    /// The kind does not know an option.
    #[error("dataset '{text}': kind {kind} has no option '{option}'{}", known(.options))]
    Option {
        /// The text given.
        text: String,
        /// The kind.
        kind: &'static str,
        /// The option that is none.
        option: String,
        /// Options it has.
        options: &'static [&'static str],
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

fn known(options: &[&str]) -> String {
    match options {
        [] => "; it has none".into(),
        options => format!("; it has {}", options.join(", ")),
    }
}

/// A dataset text taken apart.
struct Parsed<'a> {
    kind: &'static Kind,
    options: Vec<&'a str>,
    path: &'a Path,
    split: Split,
}

/// Takes `KIND[/option..]` apart: what stands before the colon of a dataset text.
///
/// # Errors
/// For an unknown kind, or an option it does not have.
pub fn kind_of(head: &str) -> Result<(&'static Kind, Vec<&str>), OpenError> {
    read_kind(head, head)
}

fn read_kind<'a>(head: &'a str, text: &str) -> Result<(&'static Kind, Vec<&'a str>), OpenError> {
    let mut words = head.split('/');
    let name = words.next().unwrap_or_default();
    let known = KINDS.iter().find(|k| k.name == name);
    let kind = known.ok_or_else(|| OpenError::Kind { text: text.to_owned() })?;
    let options: Vec<&str> = words.collect();
    if let Some(option) = options.iter().find(|o| !kind.options.contains(o)) {
        return Err(OpenError::Option {
            text: text.to_owned(),
            kind: kind.name,
            option: (*option).to_owned(),
            options: kind.options,
        });
    }
    Ok((kind, options))
}

fn parse(text: &str) -> Result<Parsed<'_>, OpenError> {
    let no_kind = || OpenError::Kind { text: text.to_owned() };
    let (head, rest) = text.split_once(':').ok_or_else(no_kind)?;
    let (kind, options) = read_kind(head, text)?;
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
        return Err(no_kind());
    }
    Ok(Parsed { kind, options, path: Path::new(path), split })
}

fn jobs(text: &str, clips: PseudoOptions) -> Result<Jobs, OpenError> {
    let Parsed { kind, options, path, split } = parse(text)?;
    let on = |option: &str| options.contains(&option);
    let modality = if on("thermal") { Modality::Thermal } else { Modality::Rgb };
    Ok(match kind.name {
        "pairs" => {
            let (pairs, problems) = PairsDataset::scan(path, split)?;
            Jobs { problems, ..Jobs::ready(pairs.into_pairs()) }
        }
        "pseudo" => {
            let (pairs, mut problems) = PairsDataset::scan(path, split)?;
            let stills = pairs.pairs().iter().map(|p| p as &dyn Sequence);
            let made = pseudo::clips(stills, clips)?;
            problems.extend(made.broken.into_iter().map(|e| match e {
                PseudoError::Dataset(e) => e,
                // The text names the still.
                e => DatasetError::Format {
                    path: path.join(pairs::INDEX),
                    line: None,
                    reason: e.to_string(),
                },
            }));
            if made.clips.is_empty() && problems.is_empty() {
                return Err(OpenError::NoClips { text: text.to_owned() });
            }
            Jobs { problems, ..Jobs::ready(made.clips) }
        }
        "sequences" => sequences::jobs(path, split)?,
        "stills" => stills::stills(path, split)?,
        "coco" => stills::coco(path, split, modality)?,
        "lasher" => lasher::jobs(path, split)?,
        "rgbt234" => rgbt::rgbt234(path, split)?,
        "rgbt210" => rgbt::rgbt210(path, split)?,
        "gtot" => rgbt::gtot(path, split)?,
        "vtuav" => vtuav::jobs(path, split, on("interpolated"))?,
        "antiuav" => antiuav::jobs(path, split, on("registered"))?,
        "otb" => single::otb(path, split, modality, on("zero-based"))?,
        "got10k" => single::got10k(path, split, modality)?,
        _ => return Err(OpenError::Kind { text: text.to_owned() }),
    })
}

/// Opens `KIND[/option..]:PATH[@split]`, see [`KINDS`]; without a split, everything. Annotations
/// are read, several at a time, pictures only found. (Of `pseudo`, all stills used are decoded at
/// once and kept.)
///
/// # Errors
/// For a text of another form, an unknown kind, option or split, a folder that cannot be read, and
/// the first thing in it that is broken: figures on part of a benchmark would mean little.
/// [`scan`] finds everything that is.
pub fn open(text: &str) -> Result<Dataset, OpenError> {
    let Scan { name, sequences, broken } = scan(text)?;
    match broken.into_iter().next() {
        Some(first) => Err(first.into()),
        None => Ok(Dataset { name, sequences }),
    }
}

/// As [`open`], but goes on past sequences that cannot be read.
///
/// # Errors
/// When the text is wrong or there is nothing to look at.
pub fn scan(text: &str) -> Result<Scan, OpenError> {
    scan_with(text, PseudoOptions::default())
}

/// As [`scan`]; `clips` says how the clips of `pseudo` are made.
///
/// # Errors
/// As [`scan`], and when such an option is out of range.
pub fn scan_with(text: &str, clips: PseudoOptions) -> Result<Scan, OpenError> {
    let Jobs { jobs, problems: mut broken } = jobs(text, clips)?;
    let mut sequences = Vec::with_capacity(jobs.len());
    for outcome in parallel::map(jobs, parallel::threads(), |job| job()) {
        match outcome {
            Ok(sequence) => sequences.push(sequence),
            Err(e) => broken.push(e),
        }
    }
    Ok(Scan { name: text.to_owned(), sequences, broken })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_texts_say_what_was_expected() {
        for (text, want) in [
            ("here", "KIND:PATH"),
            ("video:here", "sequences, pairs, pseudo, stills, coco[/thermal], lasher"),
            ("pairs:", "KIND:PATH"),
            ("antiuav/warped:here", "has no option 'warped'; it has registered"),
            ("gtot/thermal:here", "'thermal'; it has none"),
            ("gtot:here@train", "here"),
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
