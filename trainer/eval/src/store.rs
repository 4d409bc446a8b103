//! Results on disk, one folder per tracker and protocol, so that a run can go on where it stopped.
//!
//! | file | what |
//! |---|---|
//! | `run.json` | [`RunManifest`]: what the results were made with |
//! | `<sequence>.txt` | boxes as other tools read them, `x,y,w,h` with three decimals |
//! | `<sequence>_modality.txt` | sensor of every frame |
//! | `<sequence>.json` | [`Record`]: boxes in full precision, scores, times |
//!
//! Every file appears whole or not at all, the record last: a sequence with a record is finished.
//! Results of another bundle, dataset, protocol, engine or program version are refused, never
//! mixed in.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tsda_runtime::{BBox, Modality};

use crate::dataset::{DatasetError, Sequence};
use crate::otb::write_whole;
use crate::protocol::{Protocol, SequenceResult, label, start_frame};
use crate::results::{file_stem, write_otb};

/// Version of [`Record`] and [`RunManifest`].
pub const STORE_VERSION: u32 = 1;

/// Name of the manifest in its folder.
const MANIFEST: &str = "run.json";

/// What results were made with. Results go together when all of it but `dataset` is equal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunManifest {
    /// [`STORE_VERSION`] of the writer.
    pub version: u32,
    /// Version of the program.
    pub program: String,
    /// The tracker's name.
    pub tracker: String,
    /// [Fingerprint](crate::fingerprint::of_bytes) of the bundle; `built in` for the baselines.
    pub model: String,
    /// The engine and its options; empty for the baselines.
    pub engine: String,
    /// What the tracker was told beside that; empty for a tracker as its bundle has it.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub settings: String,
    /// The dataset as it was named; for people, folders may move.
    pub dataset: String,
    /// Its [fingerprint](crate::fingerprint::of_dataset).
    pub dataset_hash: String,
    /// The protocol.
    pub protocol: String,
}

impl RunManifest {
    /// What differs, in words, first theirs and then ours; `None` when results go together.
    fn difference(&self, ours: &Self) -> Option<String> {
        let fields = [
            ("program version", &self.program, &ours.program),
            ("tracker", &self.tracker, &ours.tracker),
            ("bundle", &self.model, &ours.model),
            ("engine", &self.engine, &ours.engine),
            ("settings", &self.settings, &ours.settings),
            ("dataset contents", &self.dataset_hash, &ours.dataset_hash),
            ("protocol", &self.protocol, &ours.protocol),
        ];
        let version = (self.version != ours.version)
            .then(|| format!("version of the files {}, now {}", self.version, ours.version));
        let others = fields.iter().filter(|(_, theirs, now)| theirs != now);
        let all: Vec<String> = version
            .into_iter()
            .chain(others.map(|(what, theirs, now)| {
                let [theirs, now] = [theirs, now].map(|v| if v.is_empty() { "none" } else { v });
                format!("{what} {theirs}, now {now}")
            }))
            .collect();
        (!all.is_empty()).then(|| all.join("; "))
    }
}

/// Results that cannot be kept or taken up.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The folder belongs to another run.
    #[error(
        "{path} holds results of another run ({difference}): choose another folder, or start over \
         with --fresh"
    )]
    OtherRun {
        /// The manifest.
        path: PathBuf,
        /// What differs.
        difference: String,
    },
    /// The manifest is none.
    #[error("{path}{}: not the manifest of a run: {reason}: start over with --fresh", .line.map(|l| format!(", line {l}")).unwrap_or_default())]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// 1-based line.
        line: Option<usize>,
        /// What does not fit.
        reason: String,
    },
    /// A file or folder could not be read, written or removed.
    #[error("{path}: {source}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A result file could not be written.
    #[error(transparent)]
    Write(#[from] DatasetError),
}

fn io_at(path: &Path) -> impl FnOnce(io::Error) -> StoreError {
    let path = path.to_owned();
    move |source| StoreError::Io { path, source }
}

/// One finished sequence as it stands in `<sequence>.json`; lists have an entry per frame tracked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// [`STORE_VERSION`] of the writer.
    pub version: u32,
    /// Sequence, as its dataset calls it.
    pub sequence: String,
    /// Target within it.
    pub target: usize,
    /// Frame of the sequence that entry 0 is of.
    pub start: usize,
    /// Sensors.
    pub modalities: Vec<Modality>,
    /// `x, y, w, h` in pixels; `null` for what is not finite.
    pub boxes: Vec<[Option<f32>; 4]>,
    /// Confidences; `null` for what is not finite.
    pub scores: Vec<Option<f32>>,
    /// Milliseconds inside the tracker; empty where not timed.
    pub milliseconds: Vec<f32>,
}

impl Record {
    fn of(result: &SequenceResult) -> Self {
        let some = |v: f32| Some(v).filter(|v| v.is_finite());
        Self {
            version: STORE_VERSION,
            sequence: result.sequence.clone(),
            target: result.target,
            start: result.start,
            modalities: result.modalities.clone(),
            boxes: result.predicted.iter().map(|b| [b.x, b.y, b.w, b.h].map(some)).collect(),
            scores: result.confidence.iter().map(|s| some(*s)).collect(),
            milliseconds: result.milliseconds.clone(),
        }
    }

    /// With the truth of its sequence; `None` when it is not what a run under `protocol` makes.
    fn into_result(
        self,
        sequence: &dyn Sequence,
        target: usize,
        protocol: Protocol,
    ) -> Option<SequenceResult> {
        let start = start_frame(sequence, target, protocol)?;
        let n = sequence.frames().checked_sub(start)?;
        let modalities: Vec<Modality> = (0..n).map(|i| protocol.modality(i)).collect();
        let fits = self.version == STORE_VERSION
            && (self.sequence.as_str(), self.target, self.start) == (sequence.id(), target, start)
            && self.modalities == modalities
            && (self.boxes.len(), self.scores.len()) == (n, n)
            && (self.milliseconds.is_empty() || self.milliseconds.len() == n);
        if !fits {
            return None;
        }
        let number = |v: Option<f32>| v.unwrap_or(f32::NAN);
        let truth = modalities.iter().enumerate();
        Some(SequenceResult {
            truth: truth.map(|(i, &m)| sequence.truth(target, start + i, m)).collect(),
            sequence: self.sequence,
            target,
            start,
            modalities,
            predicted: self
                .boxes
                .into_iter()
                .map(|b| {
                    let [x, y, w, h] = b.map(number);
                    BBox::new(x, y, w, h)
                })
                .collect(),
            confidence: self.scores.into_iter().map(number).collect(),
            milliseconds: self.milliseconds,
        })
    }
}

/// Results of one tracker under one protocol.
#[derive(Clone, Debug)]
pub struct ResultStore {
    folder: PathBuf,
    manifest: RunManifest,
    /// File stems by [`label`].
    stems: BTreeMap<String, String>,
}

impl ResultStore {
    /// Looks whether results made with `manifest` may go into `folder`, which need not exist;
    /// writes nothing. `sequences` are all that may come, each with its number of targets.
    ///
    /// # Errors
    /// When it holds results of another run, unless `fresh`.
    pub fn plan<'a>(
        folder: PathBuf,
        manifest: RunManifest,
        sequences: impl IntoIterator<Item = (&'a str, usize)>,
        fresh: bool,
    ) -> Result<Self, StoreError> {
        let path = folder.join(MANIFEST);
        if !fresh {
            match std::fs::read(&path) {
                Ok(bytes) => {
                    let theirs: RunManifest = serde_json::from_slice(&bytes).map_err(|e| {
                        let line = (e.line() > 0).then_some(e.line());
                        StoreError::Manifest { path: path.clone(), line, reason: e.to_string() }
                    })?;
                    if let Some(difference) = theirs.difference(&manifest) {
                        return Err(StoreError::OtherRun { path, difference });
                    }
                }
                Err(e) if e.kind() == io::ErrorKind::NotFound => {}
                Err(e) => return Err(io_at(&path)(e)),
            }
        }
        let labels =
            sequences.into_iter().flat_map(|(s, targets)| (0..targets).map(move |t| label(s, t)));
        Ok(Self { folder, manifest, stems: stems(labels) })
    }

    /// Makes the folder and its manifest; `fresh` removes the results in it first.
    ///
    /// # Errors
    /// When a file cannot be written or removed.
    pub fn prepare(&self, fresh: bool) -> Result<(), StoreError> {
        std::fs::create_dir_all(&self.folder).map_err(io_at(&self.folder))?;
        let path = self.folder.join(MANIFEST);
        if fresh {
            self.clear()?;
        }
        if path.is_file() {
            return Ok(());
        }
        let mut bytes = serde_json::to_vec_pretty(&self.manifest)
            .map_err(|e| io_at(&path)(io::Error::other(e)))?;
        bytes.push(b'\n');
        write_whole(&path, &bytes).map_err(io_at(&path))
    }

    /// Removes what [`Self::save`] may have written, records first: what is left after an
    /// interruption is not taken for finished.
    fn clear(&self) -> Result<(), StoreError> {
        for extension in ["json", "txt"] {
            for entry in std::fs::read_dir(&self.folder).map_err(io_at(&self.folder))? {
                let path = entry.map_err(io_at(&self.folder))?.path();
                if path.is_file() && path.extension().is_some_and(|e| e == extension) {
                    std::fs::remove_file(&path).map_err(io_at(&path))?;
                }
            }
        }
        Ok(())
    }

    /// Where the results are.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// What they are made with.
    pub const fn manifest(&self) -> &RunManifest {
        &self.manifest
    }

    /// What the files of a sequence are called, without extension.
    pub fn stem(&self, label: &str) -> String {
        self.stems.get(label).cloned().unwrap_or_else(|| file_stem(label))
    }

    /// The result of an earlier run; `None` when there is none, or none that fits the sequence.
    pub fn load(
        &self,
        sequence: &dyn Sequence,
        target: usize,
        protocol: Protocol,
    ) -> Option<SequenceResult> {
        let stem = self.stem(&label(sequence.id(), target));
        // A record that cannot be read is made anew, like one that is not there.
        let bytes = std::fs::read(self.folder.join(format!("{stem}.json"))).ok()?;
        let record: Record = serde_json::from_slice(&bytes).ok()?;
        let boxes = self.folder.join(format!("{stem}.txt"));
        record.into_result(sequence, target, protocol).filter(|_| boxes.is_file())
    }

    /// Keeps a finished result.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save(&self, result: &SequenceResult) -> Result<(), StoreError> {
        let stem = self.stem(&result.label());
        write_otb(&self.folder, &stem, &result.predicted, Some(&result.modalities))?;
        let path = self.folder.join(format!("{stem}.json"));
        let mut bytes = serde_json::to_vec(&Record::of(result))
            .map_err(|e| io_at(&path)(io::Error::other(e)))?;
        bytes.push(b'\n');
        write_whole(&path, &bytes).map_err(io_at(&path))
    }
}

/// One file stem per label. Names that fall together, also where case is ignored or with the file of
/// sensors, get a number behind a character that no other stem has.
fn stems(labels: impl Iterator<Item = String>) -> BTreeMap<String, String> {
    let mut used = BTreeSet::from(["run".to_owned()]);
    let mut stems = BTreeMap::new();
    for label in labels {
        let plain = file_stem(&label);
        let mut stem = plain.clone();
        let mut n = 1;
        loop {
            let key = stem.to_ascii_lowercase();
            let sensors = format!("{key}_modality");
            if !used.contains(&key) && !used.contains(&sensors) {
                used.extend([key, sensors]);
                break;
            }
            n += 1;
            stem = format!("{plain}~{n}");
        }
        stems.insert(label, stem);
    }
    stems
}

#[cfg(test)]
#[path = "store_tests.rs"]
mod tests;
