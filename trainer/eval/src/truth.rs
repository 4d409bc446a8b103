//! The truth that folders of results are scored against: from a dataset loader, or from a folder of
//! annotation files alone, without pictures.
//!
//! [`TruthSet::read_folder`] looks, per sequence, for
//!
//! | convention | files, the first that exists |
//! |---|---|
//! | `lasher` | `<s>.txt`, `<s>/visible.txt`, `<s>/init.txt`, `<s>/infrared.txt` |
//! | `rgbt234` | `<s>/visible.txt` and `<s>/infrared.txt` |
//! | `rgbt210` | `<s>/init.txt`, `<s>/visible.txt`, `<s>.txt` |
//! | `gtot` | `<s>/groundTruth_v.txt` and `<s>/groundTruth_i.txt` (corners) |
//! | `otb` | `<s>/groundtruth_rect.txt`, `<s>/groundtruth.txt`, `<s>.txt` |
//! | `got10k` | `<s>/groundtruth.txt`, `<s>.txt`; `<s>/cover.label`, and the `resolution` in `<s>/meta_info.ini` |
//! | `tsda` | any of these |

use std::path::{Path, PathBuf};

use tsda_runtime::Modality;

use crate::boxes::{self, Layout};
use crate::dataset::{Dataset, DatasetError, Sequence};
use crate::metrics::convention::Truths;
use crate::metrics::score::row;
use crate::metrics::{Convention, Row, Truth};
use crate::protocol::{Protocol, start_frame};

/// Truth of one sequence; frame 0 is the one trackers are initialised with.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SequenceTruth {
    /// Name; results are looked for under it.
    pub name: String,
    /// Boxes in the visible or only sensor, or in the active one under a protocol.
    pub visible: Vec<Row>,
    /// Boxes in the infrared sensor, for conventions that take both.
    pub infrared: Option<Vec<Row>>,
    /// Visible share per frame (GOT-10k).
    pub cover: Option<Vec<u8>>,
    /// Width and height of the pictures (GOT-10k).
    pub image: Option<[f64; 2]>,
    /// Sensor of every frame, under a protocol.
    pub modalities: Option<Vec<Modality>>,
    /// File the boxes came from, for messages.
    pub path: Option<PathBuf>,
}

impl SequenceTruth {
    /// As the metrics take it.
    pub fn as_truth(&self) -> Truth<'_> {
        Truth {
            visible: &self.visible,
            infrared: self.infrared.as_deref(),
            cover: self.cover.as_deref(),
            image: self.image,
        }
    }
}

/// Truth of many sequences.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TruthSet {
    /// The dataset's name in reports.
    pub name: String,
    /// The sequences, in a fixed order.
    pub sequences: Vec<SequenceTruth>,
    /// Sequences without truth for this convention and protocol.
    pub skipped: Vec<String>,
}

const ONE_BOX_FILES: [&str; 7] = [
    "visible.txt",
    "init.txt",
    "infrared.txt",
    "groundtruth_rect.txt",
    "groundtruth.txt",
    "rgb.txt",
    "ir.txt",
];

impl TruthSet {
    /// Reads annotation files. `sequences` limits and orders them; without it, everything found, by
    /// name. A `protocol` takes each frame's truth from the sensor that is active in it, which
    /// needs both, except under conventions that compare with both anyway.
    ///
    /// # Errors
    /// When the folder or a file cannot be read, a wanted sequence is not there, or nothing is.
    pub fn read_folder(
        folder: &Path,
        convention: Convention,
        sequences: Option<&[String]>,
        protocol: Option<Protocol>,
    ) -> Result<Self, DatasetError> {
        let names = match sequences {
            Some(names) => names.to_vec(),
            None => sequence_names(folder)?,
        };
        let mut set = Self { name: folder.display().to_string(), ..Self::default() };
        for name in names {
            match read_sequence(folder, &name, convention, protocol)? {
                Some(sequence) => set.sequences.push(sequence),
                None if sequences.is_some() => {
                    return Err(DatasetError::Format {
                        path: folder.join(&name),
                        line: None,
                        reason: format!("no truth of convention {convention} for this sequence"),
                    });
                }
                None => set.skipped.push(name),
            }
        }
        if set.sequences.is_empty() {
            return Err(DatasetError::Format {
                path: folder.to_owned(),
                line: None,
                reason: format!("no sequence with truth of convention {convention} in it"),
            });
        }
        Ok(set)
    }

    /// Takes the truth of a dataset; targets beyond the first are named `sequence#1` and so on, as
    /// `tsda eval` names their results. Under a `protocol`, frames count from the first one that
    /// is annotated in its first sensor, as when a tracker is run. Absent targets become zeros.
    pub fn of_dataset(
        dataset: &Dataset,
        convention: Convention,
        protocol: Option<Protocol>,
    ) -> Self {
        let mut set = Self { name: dataset.name.clone(), ..Self::default() };
        for sequence in &dataset.sequences {
            let sequence = sequence.as_ref();
            for target in 0..sequence.targets() {
                let name = match target {
                    0 => sequence.id().to_owned(),
                    n => format!("{}#{n}", sequence.id()),
                };
                match of_target(sequence, target, convention, protocol) {
                    Some(truth) => set.sequences.push(SequenceTruth { name, ..truth }),
                    None => set.skipped.push(name),
                }
            }
        }
        set
    }
}

fn of_target(
    sequence: &dyn Sequence,
    target: usize,
    convention: Convention,
    protocol: Option<Protocol>,
) -> Option<SequenceTruth> {
    let has = |m: Modality| sequence.modalities().contains(&m);
    let start = match protocol {
        Some(p) if p.needs().iter().all(|m| has(*m)) => start_frame(sequence, target, p)?,
        Some(_) => return None,
        None => 0,
    };
    let frames = sequence.frames().saturating_sub(start);
    let boxes = |sensor: &dyn Fn(usize) -> Modality| -> Vec<Row> {
        (0..frames).map(|i| row(sequence.truth(target, start + i, sensor(i)))).collect()
    };
    let both = has(Modality::Rgb) && has(Modality::Thermal);
    let (visible, infrared) = match (convention.truths(), protocol) {
        (Truths::Two, _) if !both => return None,
        (Truths::Two, _) => (boxes(&|_| Modality::Rgb), Some(boxes(&|_| Modality::Thermal))),
        (_, Some(p)) => (boxes(&|i| p.modality(i)), None),
        (_, None) => {
            let only = if has(Modality::Rgb) { Modality::Rgb } else { Modality::Thermal };
            (boxes(&|_| only), None)
        }
    };
    let (cover, image) = if convention == Convention::Got10k {
        let sensor = protocol.map_or(Modality::Rgb, |p| p.modality(0));
        let sensor = if has(sensor) { sensor } else { Modality::Thermal };
        let share = |i: usize| {
            let m = protocol.map_or(sensor, |p| p.modality(i));
            let seen = f32::from(u8::from(sequence.truth(target, start + i, m).is_some()));
            // GOT-10k grades in eighths; a row without area is hidden whatever the grade says.
            let share = sequence.visibility(target, start + i, m).unwrap_or(1.0).min(seen);
            (share * 8.0).round() as u8
        };
        let size = sequence.resolution(sensor).ok().map(|(w, h)| [w as f64, h as f64]);
        (Some((0..frames).map(share).collect()), size)
    } else {
        (None, None)
    };
    (frames > 0).then(|| SequenceTruth {
        cover,
        image,
        visible,
        infrared,
        modalities: protocol.map(|p| (0..frames).map(|i| p.modality(i)).collect()),
        ..SequenceTruth::default()
    })
}

fn sequence_names(folder: &Path) -> Result<Vec<String>, DatasetError> {
    let io = |source| DatasetError::Io { path: folder.to_owned(), source };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let name = if path.is_dir() { path.file_name() } else { path.file_stem() };
        let text = path.extension().is_some_and(|e| e == "txt");
        if let Some(name) = name.and_then(|n| n.to_str())
            && (path.is_dir() || text)
        {
            names.push(name.to_owned());
        }
    }
    names.sort();
    names.dedup();
    Ok(names)
}

fn read_sequence(
    folder: &Path,
    name: &str,
    convention: Convention,
    protocol: Option<Protocol>,
) -> Result<Option<SequenceTruth>, DatasetError> {
    let inside = |file: &str| Some(folder.join(name).join(file)).filter(|p| p.is_file());
    let flat = || Some(folder.join(format!("{name}.txt"))).filter(|p| p.is_file());
    let first = |files: &[&str]| files.iter().find_map(|f| inside(f));
    let separate = || Some((inside("visible.txt")?, inside("infrared.txt")?, Layout::Xywh));
    let gtot = || Some((inside("groundTruth_v.txt")?, inside("groundTruth_i.txt")?, Layout::GTOT));
    let pair = match convention {
        Convention::Rgbt234 => separate(),
        Convention::Gtot => gtot(),
        _ => separate().or_else(gtot),
    };

    let mut truth = SequenceTruth { name: name.to_owned(), ..SequenceTruth::default() };
    if convention.truths() == Truths::Two || protocol.is_some_and(|p| p.needs().len() > 1) {
        let Some((visible, infrared, layout)) = pair else { return Ok(None) };
        truth.visible = boxes::read(&visible, layout)?;
        let other = boxes::read(&infrared, layout)?;
        if other.len() != truth.visible.len() {
            return Err(DatasetError::Format {
                path: infrared,
                line: Some(other.len().min(truth.visible.len()) + 1),
                reason: format!(
                    "{} boxes, but {} has {}: both sensors need one per frame",
                    other.len(),
                    visible.display(),
                    truth.visible.len()
                ),
            });
        }
        truth.path = Some(visible);
        if convention.truths() == Truths::Two {
            truth.infrared = Some(other);
        } else if let Some(p) = protocol {
            for (i, (row, other)) in truth.visible.iter_mut().zip(other).enumerate() {
                if p.modality(i) == Modality::Thermal {
                    *row = other;
                }
            }
        }
    } else {
        let only_thermal = protocol == Some(Protocol::Thermal);
        let path = match convention {
            _ if only_thermal => first(&["infrared.txt", "ir.txt"]).or_else(flat),
            Convention::Lasher => {
                flat().or_else(|| first(&["visible.txt", "init.txt", "infrared.txt"]))
            }
            Convention::Rgbt210 => first(&["init.txt", "visible.txt"]).or_else(flat),
            Convention::Otb => first(&["groundtruth_rect.txt", "groundtruth.txt"]).or_else(flat),
            Convention::Got10k => first(&["groundtruth.txt"]).or_else(flat),
            _ => first(&ONE_BOX_FILES).or_else(flat),
        };
        let (path, layout) = match (path, pair) {
            (Some(path), _) => (path, Layout::Xywh),
            (None, Some((v, i, layout))) if convention == Convention::Tsda => {
                (if only_thermal { i } else { v }, layout)
            }
            _ => return Ok(None),
        };
        truth.visible = boxes::read(&path, layout)?;
        truth.path = Some(path);
    }
    truth.modalities = protocol.map(|p| (0..truth.visible.len()).map(|i| p.modality(i)).collect());
    if convention == Convention::Got10k {
        truth.cover = inside("cover.label").map(|p| read_cover(&p)).transpose()?;
        truth.image = inside("meta_info.ini").map(|p| read_resolution(&p)).transpose()?.flatten();
    }
    Ok(Some(truth))
}

/// Reads visible shares, one whole number 0 to 8 per line (GOT-10k's `cover.label`).
///
/// # Errors
/// When the file cannot be read or a line holds something else.
pub fn read_cover(path: &Path) -> Result<Vec<u8>, DatasetError> {
    let text = boxes::read_text(path)?;
    let lines = text.trim_end().lines().enumerate();
    lines
        .map(|(i, line)| match line.trim().parse::<u8>() {
            Ok(share @ 0..=8) => Ok(share),
            _ => Err(DatasetError::Format {
                path: path.to_owned(),
                line: Some(i + 1),
                reason: "expected a visible share, a whole number 0 to 8".into(),
            }),
        })
        .collect()
}

/// `resolution: (1920, 1080)` in GOT-10k's `meta_info.ini`; `None` without such a line.
fn read_resolution(path: &Path) -> Result<Option<[f64; 2]>, DatasetError> {
    let text = boxes::read_text(path)?;
    for (i, line) in text.lines().enumerate() {
        let Some(value) = line.trim().strip_prefix("resolution:") else { continue };
        let numbers: Vec<f64> = value
            .split(|c: char| !c.is_ascii_digit() && c != '.')
            .filter_map(|n| n.parse().ok())
            .collect();
        let &[width, height] = numbers.as_slice() else {
            return Err(DatasetError::Format {
                path: path.to_owned(),
                line: Some(i + 1),
                reason: format!("'{}' is no resolution (width, height)", value.trim()),
            });
        };
        return Ok(Some([width, height]));
    }
    Ok(None)
}

/// Reads a list of sequences, one name per line; blank lines are skipped.
///
/// # Errors
/// When the file cannot be read or names nothing.
pub fn read_names(path: &Path) -> Result<Vec<String>, DatasetError> {
    let text = boxes::read_text(path)?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    let names: Vec<String> =
        text.lines().map(|l| l.trim().to_owned()).filter(|l| !l.is_empty()).collect();
    if names.is_empty() {
        return Err(DatasetError::Format {
            path: path.to_owned(),
            line: None,
            reason: "no names in it: expected one sequence per line".into(),
        });
    }
    Ok(names)
}

#[cfg(test)]
#[path = "truth_tests.rs"]
mod tests;
