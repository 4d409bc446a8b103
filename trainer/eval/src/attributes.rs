//! Challenge attributes of sequences, as the benchmarks ship them.
//!
//! | source | form |
//! |---|---|
//! | LasHeR `AttriSeqsTxt/` | one file per sequence, one line of 19 flags in the order of [`LASHER`] |
//! | RGBT234, RGBT210 `attr_txt/` | one file per attribute, one flag per sequence in the order of `SequencesName.txt` |
//! | JSON file | `{"sequence": ["OCC", "LI"], ..}` |

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use crate::boxes::read_text;
use crate::dataset::{Dataset, DatasetError};
use crate::truth::read_names;

/// LasHeR's attributes in the order of its files.
pub const LASHER: [&str; 19] = [
    "NO", "PO", "TO", "HO", "MB", "LI", "HI", "AIV", "LR", "DEF", "BC", "SA", "CM", "TC", "FL",
    "OV", "FM", "SV", "ARC",
];

/// Attributes by sequence.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Attributes(BTreeMap<String, BTreeSet<String>>);

impl Attributes {
    /// Attributes of one sequence, by name; `sequence#1` has those of `sequence`.
    pub fn of(&self, sequence: &str) -> Vec<String> {
        let found = self
            .0
            .get(sequence)
            .or_else(|| sequence.rsplit_once('#').and_then(|(sequence, _)| self.0.get(sequence)));
        found.map(|set| set.iter().cloned().collect()).unwrap_or_default()
    }

    /// Gives a sequence an attribute.
    pub fn insert(&mut self, sequence: &str, attribute: &str) {
        self.0.entry(sequence.to_owned()).or_default().insert(attribute.to_owned());
    }

    /// Those the loader of a dataset found.
    pub fn of_dataset(dataset: &Dataset) -> Self {
        let mut attributes = Self::default();
        for sequence in &dataset.sequences {
            for attribute in sequence.attributes() {
                attributes.insert(sequence.id(), attribute);
            }
        }
        attributes
    }

    /// Nothing known.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Reads any of the forms of the [module](self).
    ///
    /// # Errors
    /// When the file or folder cannot be read or has another form.
    pub fn read(path: &Path) -> Result<Self, DatasetError> {
        if path.is_dir() {
            let order = path.join("SequencesName.txt");
            return if order.is_file() {
                Self::read_by_attribute(path, &read_names(&order)?)
            } else {
                Self::read_by_sequence(path)
            };
        }
        let text = read_text(path)?;
        let map: BTreeMap<String, BTreeSet<String>> =
            serde_json::from_str(text.trim_start_matches('\u{feff}')).map_err(|e| {
                DatasetError::Format {
                    path: path.to_owned(),
                    line: (e.line() > 0).then_some(e.line()),
                    reason: format!("expected {{\"sequence\": [\"ATTRIBUTE\", ..], ..}}: {e}"),
                }
            })?;
        Ok(Self(map))
    }

    fn read_by_attribute(folder: &Path, names: &[String]) -> Result<Self, DatasetError> {
        let mut attributes = Self::default();
        for (stem, path) in text_files(folder)? {
            if stem == "SequencesName" {
                continue;
            }
            let flags = read_flags(&path)?;
            // Lists may be shorter than the names (RGBT210's files stop with its own sequences).
            for (name, flag) in names.iter().zip(flags) {
                if flag {
                    attributes.insert(name, &stem);
                }
            }
        }
        attributes.or_nothing(folder)
    }

    fn read_by_sequence(folder: &Path) -> Result<Self, DatasetError> {
        let mut attributes = Self::default();
        for (stem, path) in text_files(folder)? {
            let flags = read_flags(&path)?;
            if flags.len() != LASHER.len() {
                return Err(DatasetError::Format {
                    path,
                    line: Some(1),
                    reason: format!("expected {} flags, found {}", LASHER.len(), flags.len()),
                });
            }
            attributes.0.entry(stem.clone()).or_default();
            for (name, flag) in LASHER.iter().zip(flags) {
                if flag {
                    attributes.insert(&stem, name);
                }
            }
        }
        attributes.or_nothing(folder)
    }

    fn or_nothing(self, folder: &Path) -> Result<Self, DatasetError> {
        if self.is_empty() {
            return Err(DatasetError::Format {
                path: folder.to_owned(),
                line: None,
                reason: "no attributes in it: expected <sequence>.txt with 19 flags, or \
                         <ATTRIBUTE>.txt with SequencesName.txt"
                    .into(),
            });
        }
        Ok(self)
    }
}

fn text_files(folder: &Path) -> Result<BTreeMap<String, std::path::PathBuf>, DatasetError> {
    let io = |source| DatasetError::Io { path: folder.to_owned(), source };
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        if path.extension().is_some_and(|e| e == "txt")
            && let Some(stem) = path.file_stem().and_then(|s| s.to_str())
        {
            files.insert(stem.to_owned(), path);
        }
    }
    Ok(files)
}

/// Zeros and ones on any number of lines.
fn read_flags(path: &Path) -> Result<Vec<bool>, DatasetError> {
    let text = read_text(path)?;
    let mut flags = Vec::new();
    for (i, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        for field in line.split([',', ' ', '\t', '\r']).filter(|f| !f.is_empty()) {
            flags.push(match field {
                "0" | "0.0" => false,
                "1" | "1.0" => true,
                _ => {
                    return Err(DatasetError::Format {
                        path: path.to_owned(),
                        line: Some(i + 1),
                        reason: format!(
                            "'{}' is no flag: expected 0 or 1",
                            field.chars().take(40).collect::<String>()
                        ),
                    });
                }
            });
        }
    }
    Ok(flags)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_three_forms_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        std::fs::create_dir(at("lasher")).unwrap();
        std::fs::create_dir(at("rgbt")).unwrap();
        std::fs::write(at("lasher/a.txt"), "0,1,0,0,0,1,0,0,0,0,0,0,0,0,0,0,0,0,1\n").unwrap();
        std::fs::write(at("lasher/b.txt"), vec!["0"; 19].join(",")).unwrap();
        std::fs::write(at("rgbt/SequencesName.txt"), "a\r\nb\r\nc\r\n").unwrap();
        std::fs::write(at("rgbt/PO.txt"), "1\r\n0\r\n").unwrap();
        std::fs::write(at("rgbt/LI.txt"), "1\n0\n1\n").unwrap();
        std::fs::write(at("own.json"), r#"{"a": ["PO", "LI"], "c": ["LI"]}"#).unwrap();
        assert_eq!(Attributes::read(&at("lasher")).unwrap().of("a"), ["ARC", "LI", "PO"]);
        let want =
            [("a", vec!["LI", "PO"]), ("b", vec![]), ("c", vec!["LI"]), ("a#1", vec!["LI", "PO"])];
        for source in ["rgbt", "own.json"] {
            let attributes = Attributes::read(&at(source)).unwrap();
            for (sequence, list) in &want {
                assert_eq!(&attributes.of(sequence), list, "{source} {sequence}");
            }
        }
        for (file, text, words) in [
            ("lasher/b.txt", "0,1", "found 2"),
            ("lasher/b.txt", "0,1\n2", "b.txt, line 2: '2' is no flag"),
        ] {
            std::fs::write(at(file), text).unwrap();
            let e = Attributes::read(&at("lasher")).unwrap_err().to_string();
            assert!(e.contains(words), "{e}");
        }
        std::fs::write(at("own.json"), "{\n3}").unwrap();
        let e = Attributes::read(&at("own.json")).unwrap_err().to_string();
        assert!(e.contains("own.json, line 2"), "{e}");
        assert!(Attributes::read(&at("none")).is_err());
    }
}
