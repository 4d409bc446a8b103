//! Checkpoints that survive being interrupted at any instruction.
//!
//! A checkpoint is a folder `checkpoint-000500` of files and a `manifest.json` with their lengths
//! and CRC-32s. It is written as `.checkpoint-000500.partial`, manifest last, flushed to the disk
//! and renamed; a folder of the final name without a fitting manifest does not count. So a kill in
//! the middle of a write leaves the previous checkpoint as the newest complete one.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

const PREFIX: &str = "checkpoint-";
const PARTIAL: &str = ".partial";
const MANIFEST: &str = "manifest.json";

/// A checkpoint that cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// A file or folder could not be handled.
    #[error("cannot {action} {path}: {source}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file of the checkpoint is not what the manifest says.
    #[error("checkpoint {path} is damaged: {reason}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> CheckpointError {
    let path = path.to_owned();
    move |source| CheckpointError::Io { action, path, source }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    step: u64,
    files: BTreeMap<String, FileEntry>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileEntry {
    length: u64,
    crc32: u32,
}

/// A complete, verified checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Checkpoint {
    /// Its folder.
    pub path: PathBuf,
    /// Optimiser steps done.
    pub step: u64,
}

impl Checkpoint {
    /// Contents of one of its files.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn read(&self, name: &str) -> Result<Vec<u8>, CheckpointError> {
        let path = self.path.join(name);
        fs::read(&path).map_err(io("read", &path))
    }

    /// Does it hold a file of this name?
    pub fn has(&self, name: &str) -> bool {
        self.path.join(name).is_file()
    }
}

/// The checkpoints of one run.
#[derive(Clone, Debug)]
pub struct CheckpointStore {
    root: PathBuf,
    keep: usize,
}

/// What [`CheckpointStore::latest`] found.
#[derive(Clone, Debug, Default)]
pub struct Latest {
    /// The newest complete checkpoint.
    pub checkpoint: Option<Checkpoint>,
    /// Newer ones that were passed over, and why.
    pub skipped: Vec<String>,
}

impl CheckpointStore {
    /// The checkpoints under `root`, of which the newest `keep` are kept.
    pub fn new(root: &Path, keep: usize) -> Self {
        Self { root: root.to_owned(), keep: keep.max(1) }
    }

    /// Folders of the final name with their steps, newest first; complete or not.
    fn folders(&self) -> Result<Vec<(u64, PathBuf)>, CheckpointError> {
        let mut found = Vec::new();
        for entry in self.entries()? {
            let step = entry
                .file_name()
                .and_then(|n| n.to_str())
                .and_then(|n| n.strip_prefix(PREFIX))
                .and_then(|n| n.parse().ok());
            if let Some(step) = step {
                found.push((step, entry));
            }
        }
        found.sort();
        found.reverse();
        Ok(found)
    }

    fn entries(&self) -> Result<Vec<PathBuf>, CheckpointError> {
        if !self.root.is_dir() {
            return Ok(Vec::new());
        }
        fs::read_dir(&self.root)
            .map_err(io("list", &self.root))?
            .map(|e| e.map(|e| e.path()).map_err(io("list", &self.root)))
            .collect()
    }

    /// Are there any checkpoints, complete or not?
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn any(&self) -> Result<bool, CheckpointError> {
        Ok(!self.folders()?.is_empty())
    }

    /// The newest checkpoint whose files are all there with the right checksums.
    ///
    /// # Errors
    /// When the folder cannot be listed.
    pub fn latest(&self) -> Result<Latest, CheckpointError> {
        let mut latest = Latest::default();
        for (step, path) in self.folders()? {
            match verify(&path, step) {
                Ok(()) => {
                    latest.checkpoint = Some(Checkpoint { path, step });
                    break;
                }
                Err(e) => latest.skipped.push(e.to_string()),
            }
        }
        Ok(latest)
    }

    /// Removes what interrupted writes left behind.
    ///
    /// # Errors
    /// When a leftover cannot be removed.
    pub fn clean(&self) -> Result<usize, CheckpointError> {
        let mut removed = 0;
        for path in self.entries()? {
            let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
            if name.starts_with(&format!(".{PREFIX}")) && name.ends_with(PARTIAL) {
                fs::remove_dir_all(&path).map_err(io("remove", &path))?;
                removed += 1;
            }
        }
        Ok(removed)
    }

    /// Writes the checkpoint of a step: `fill` puts files into the folder it is given. Old
    /// checkpoints beyond the number to keep are removed afterwards.
    ///
    /// # Errors
    /// When a file cannot be written; the checkpoints that were there stay as they are.
    pub fn write<E: From<CheckpointError>>(
        &self,
        step: u64,
        fill: impl FnOnce(&Path) -> Result<(), E>,
    ) -> Result<Checkpoint, E> {
        let partial = self.root.join(format!(".{PREFIX}{step:06}{PARTIAL}"));
        let result = self.write_into(&partial, step, fill);
        if result.is_err() {
            // Best effort: a leftover is removed by `clean` as well.
            let _ = fs::remove_dir_all(&partial);
        }
        result
    }

    fn write_into<E: From<CheckpointError>>(
        &self,
        partial: &Path,
        step: u64,
        fill: impl FnOnce(&Path) -> Result<(), E>,
    ) -> Result<Checkpoint, E> {
        if partial.exists() {
            fs::remove_dir_all(partial).map_err(io("remove", partial))?;
        }
        fs::create_dir_all(partial).map_err(io("create", partial))?;
        fill(partial)?;
        seal(partial, step)?;
        let path = self.root.join(format!("{PREFIX}{step:06}"));
        if path.exists() {
            // A damaged one of the same step, or the same step trained again.
            let aside = self.root.join(format!(".{PREFIX}{step:06}.old{PARTIAL}"));
            fs::rename(&path, &aside).map_err(io("rename", &path))?;
            fs::rename(partial, &path).map_err(io("rename", partial))?;
            fs::remove_dir_all(&aside).map_err(io("remove", &aside))?;
        } else {
            fs::rename(partial, &path).map_err(io("rename", partial))?;
        }
        sync_folder(&self.root)?;
        self.prune(step)?;
        Ok(Checkpoint { path, step })
    }

    fn prune(&self, newest: u64) -> Result<(), CheckpointError> {
        let old = self.folders()?.into_iter().filter(|(step, _)| *step <= newest);
        for (step, path) in old.skip(self.keep) {
            // Renamed first, so that an interrupted removal does not look like a damaged checkpoint.
            let aside = self.root.join(format!(".{PREFIX}{step:06}.old{PARTIAL}"));
            fs::rename(&path, &aside).map_err(io("rename", &path))?;
            fs::remove_dir_all(&aside).map_err(io("remove", &aside))?;
        }
        Ok(())
    }
}

/// Flushes all files of a folder and writes its manifest.
fn seal(folder: &Path, step: u64) -> Result<(), CheckpointError> {
    let mut files = BTreeMap::new();
    for entry in fs::read_dir(folder).map_err(io("list", folder))? {
        let path = entry.map_err(io("list", folder))?.path();
        let bytes = fs::read(&path).map_err(io("read", &path))?;
        File::open(&path).and_then(|f| f.sync_all()).map_err(io("flush", &path))?;
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let entry = FileEntry { length: bytes.len() as u64, crc32: crc32fast::hash(&bytes) };
        files.insert(name, entry);
    }
    let path = folder.join(MANIFEST);
    let text = serde_json::to_vec_pretty(&Manifest { step, files })
        .map_err(|e| io("write", &path)(e.into()))?;
    write_synced(&path, &text)?;
    sync_folder(folder)
}

fn verify(folder: &Path, step: u64) -> Result<(), CheckpointError> {
    let damaged = |path: &Path, reason: String| {
        Err(CheckpointError::Damaged { path: path.to_owned(), reason })
    };
    let path = folder.join(MANIFEST);
    let bytes = fs::read(&path).map_err(io("read", &path))?;
    let manifest: Manifest = match serde_json::from_slice(&bytes) {
        Ok(manifest) => manifest,
        Err(e) => return damaged(&path, e.to_string()),
    };
    if manifest.step != step {
        return damaged(&path, format!("it is of step {}", manifest.step));
    }
    for (name, entry) in &manifest.files {
        let path = folder.join(name);
        let bytes = fs::read(&path).map_err(io("read", &path))?;
        if bytes.len() as u64 != entry.length {
            let want = entry.length;
            return damaged(&path, format!("{} bytes instead of {want}", bytes.len()));
        }
        if crc32fast::hash(&bytes) != entry.crc32 {
            return damaged(&path, "its checksum is wrong".into());
        }
    }
    Ok(())
}

fn write_synced(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let mut file = File::create(path).map_err(io("create", path))?;
    file.write_all(bytes).and_then(|()| file.sync_all()).map_err(io("write", path))
}

/// Makes renames and new names in a folder durable. Folders cannot be opened on some systems;
/// there the rename itself is all that can be done.
fn sync_folder(folder: &Path) -> Result<(), CheckpointError> {
    match File::open(folder) {
        Ok(file) => file.sync_all().map_err(io("flush", folder)),
        Err(_) => Ok(()),
    }
}

/// Writes a file under a temporary name beside it, flushes and renames it.
///
/// # Errors
/// When the file cannot be written.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), CheckpointError> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(PARTIAL);
    let partial = path.with_file_name(name);
    let written = write_synced(&partial, bytes)
        .and_then(|()| fs::rename(&partial, path).map_err(io("rename", path)));
    if written.is_err() {
        let _ = fs::remove_file(&partial);
    }
    written
}

#[cfg(test)]
mod tests {
    use super::*;

    fn put(store: &CheckpointStore, step: u64) -> Checkpoint {
        store
            .write::<CheckpointError>(step, |folder| {
                write_synced(&folder.join("model"), &step.to_le_bytes())?;
                write_synced(&folder.join("optim"), b"state")
            })
            .unwrap()
    }

    #[test]
    fn the_newest_are_kept_and_found() {
        let dir = tempfile::tempdir().unwrap();
        let store = CheckpointStore::new(dir.path(), 2);
        assert!(store.latest().unwrap().checkpoint.is_none() && !store.any().unwrap());
        for step in [5, 10, 1_000_000] {
            put(&store, step);
        }
        let latest = store.latest().unwrap().checkpoint.unwrap();
        assert_eq!(latest.step, 1_000_000);
        assert_eq!(latest.read("model").unwrap(), 1_000_000u64.to_le_bytes());
        assert_eq!(store.folders().unwrap().len(), 2);
        assert_eq!(put(&store, 1_000_000).step, 1_000_000);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
    }

    #[test]
    fn damage_of_any_kind_falls_back_to_the_one_before() {
        type Damage = (&'static str, fn(&Path));
        let damages: [Damage; 6] = [
            ("truncated", |p| fs::write(p.join("model"), [1, 2]).unwrap()),
            ("altered", |p| fs::write(p.join("model"), 99u64.to_le_bytes()).unwrap()),
            ("missing file", |p| fs::remove_file(p.join("optim")).unwrap()),
            ("missing manifest", |p| fs::remove_file(p.join(MANIFEST)).unwrap()),
            ("cut manifest", |p| fs::write(p.join(MANIFEST), "{\"step\": 2").unwrap()),
            ("empty", |p| {
                fs::remove_dir_all(p).unwrap();
                fs::create_dir(p).unwrap();
            }),
        ];
        for (name, damage) in damages {
            let dir = tempfile::tempdir().unwrap();
            let store = CheckpointStore::new(dir.path(), 3);
            put(&store, 1);
            damage(&put(&store, 2).path);
            let latest = store.latest().unwrap();
            assert_eq!(latest.checkpoint.unwrap().step, 1, "{name}");
            assert_eq!(latest.skipped.len(), 1, "{name}");
            assert!(
                latest.skipped[0].contains("checkpoint-000002"),
                "{name}: {:?}",
                latest.skipped
            );
            // Training on overwrites the damaged one.
            put(&store, 2);
            assert_eq!(store.latest().unwrap().checkpoint.unwrap().step, 2, "{name}");
        }
    }

    #[test]
    fn an_interrupted_write_changes_nothing_and_is_cleaned_up() {
        let dir = tempfile::tempdir().unwrap();
        let store = CheckpointStore::new(dir.path(), 3);
        put(&store, 1);
        // As a kill -9 leaves it: files without manifest under the temporary name.
        let partial = dir.path().join(".checkpoint-000002.partial");
        fs::create_dir(&partial).unwrap();
        fs::write(partial.join("model"), [0; 100]).unwrap();
        assert_eq!(store.latest().unwrap().checkpoint.unwrap().step, 1);
        assert_eq!(store.clean().unwrap(), 1);
        assert!(!partial.exists());
        // As a failing disk leaves it.
        let failed = store.write::<CheckpointError>(2, |folder| {
            fs::write(folder.join("model"), [0; 100]).unwrap();
            Err(CheckpointError::Damaged { path: folder.into(), reason: "full".into() })
        });
        assert!(failed.is_err() && !partial.exists());
        assert_eq!(store.latest().unwrap().checkpoint.unwrap().step, 1);
    }

    #[test]
    fn an_atomic_write_leaves_no_second_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.toml");
        write_atomic(&path, b"one").unwrap();
        write_atomic(&path, b"two").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"two");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        assert!(write_atomic(&dir.path().join("no/such/a.toml"), b"x").is_err());
    }
}
