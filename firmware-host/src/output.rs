//! Files that appear whole or not at all: written under a temporary name beside their place, renamed
//! when complete, removed when anything goes wrong on the way.

use crate::error::HostError;
use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

fn part_name(path: &Path) -> Result<PathBuf, HostError> {
    let name = path.file_name().ok_or_else(|| HostError::Create {
        path: path.to_path_buf(),
        source: io::Error::new(io::ErrorKind::InvalidInput, "the path does not end in a name"),
    })?;
    let mut part = name.to_os_string();
    part.push(format!(".{}.part", std::process::id()));
    Ok(path.with_file_name(part))
}

/// A file being written.
#[derive(Debug)]
pub struct PartFile {
    path: PathBuf,
    part: PathBuf,
    // None after commit, so that dropping removes only what is unfinished.
    file: Option<BufWriter<File>>,
}

impl PartFile {
    /// Starts writing what will become `path`.
    ///
    /// # Errors
    /// When the folder is missing or not writable, or `path` is a folder.
    pub fn create(path: &Path) -> Result<Self, HostError> {
        let fail = |source| HostError::Create { path: path.to_path_buf(), source };
        if path.is_dir() {
            return Err(fail(io::Error::new(io::ErrorKind::IsADirectory, "it is a folder")));
        }
        let part = part_name(path)?;
        let file = File::create(&part).map_err(fail)?;
        Ok(Self { path: path.to_path_buf(), part, file: Some(BufWriter::new(file)) })
    }

    /// Puts the file in its place.
    ///
    /// # Errors
    /// When the last bytes cannot be written or the file cannot be renamed.
    pub fn commit(mut self) -> Result<(), HostError> {
        let done = match self.file.take() {
            Some(mut file) => file.flush().and_then(|()| fs::rename(&self.part, &self.path)),
            None => Ok(()),
        };
        done.map_err(|source| {
            let _ = fs::remove_file(&self.part);
            HostError::Write { path: self.path.clone(), source }
        })
    }

    /// Where the file will be.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Names this file in an error of writing it.
    pub fn failed(&self, source: io::Error) -> HostError {
        HostError::Write { path: self.path.clone(), source }
    }
}

impl Write for PartFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match &mut self.file {
            Some(file) => file.write(bytes),
            None => Err(io::Error::other("already complete")),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.as_mut().map_or(Ok(()), Write::flush)
    }
}

impl Drop for PartFile {
    fn drop(&mut self) {
        if self.file.take().is_some() {
            // Nothing can be done about a file that will not go; its name says what it is.
            let _ = fs::remove_file(&self.part);
        }
    }
}

/// Writes a whole file at once.
///
/// # Errors
/// See [`PartFile`].
pub fn write_file(path: &Path, bytes: &[u8]) -> Result<(), HostError> {
    let mut file = PartFile::create(path)?;
    file.write_all(bytes).map_err(|e| file.failed(e))?;
    file.commit()
}

/// A folder being filled. Its files move into place together at the end; files of the same name in
/// an existing folder are replaced, others stay.
#[derive(Debug)]
pub struct PartDir {
    path: PathBuf,
    part: Option<PathBuf>,
}

impl PartDir {
    /// Starts filling what will become `path`.
    ///
    /// # Errors
    /// When the folder above is missing or not writable, or `path` is a file.
    pub fn create(path: &Path) -> Result<Self, HostError> {
        let fail = |source| HostError::Create { path: path.to_path_buf(), source };
        if path.exists() && !path.is_dir() {
            return Err(fail(io::Error::new(io::ErrorKind::NotADirectory, "it is a file")));
        }
        // Inside an existing folder, so that a read-only one is found out now and not at the end.
        let part = if path.is_dir() {
            path.join(format!("frames.{}.part", std::process::id()))
        } else {
            part_name(path)?
        };
        fs::create_dir(&part).map_err(fail)?;
        Ok(Self { path: path.to_path_buf(), part: Some(part) })
    }

    /// Where to write the file of this name for now.
    pub fn place(&self, name: &str) -> PathBuf {
        self.part.as_deref().unwrap_or(&self.path).join(name)
    }

    /// Where the folder will be.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Puts the files in their place.
    ///
    /// # Errors
    /// When something cannot be renamed.
    pub fn commit(mut self) -> Result<(), HostError> {
        let Some(part) = self.part.take() else { return Ok(()) };
        let moved = if self.path.is_dir() {
            fs::read_dir(&part).and_then(|entries| {
                for entry in entries {
                    let entry = entry?;
                    fs::rename(entry.path(), self.path.join(entry.file_name()))?;
                }
                fs::remove_dir(&part)
            })
        } else {
            fs::rename(&part, &self.path)
        };
        moved.map_err(|source| {
            let _ = fs::remove_dir_all(&part);
            HostError::Write { path: self.path.clone(), source }
        })
    }
}

impl Drop for PartDir {
    fn drop(&mut self) {
        if let Some(part) = self.part.take() {
            let _ = fs::remove_dir_all(part);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<_> = fs::read_dir(dir)
            .expect("folder")
            .map(|e| e.expect("entry").file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn only_a_committed_file_appears() {
        let dir = tempfile::tempdir().expect("temp");
        let path = dir.path().join("boxes.txt");
        fs::write(&path, "old").expect("write");
        let mut file = PartFile::create(&path).expect("create");
        file.write_all(b"half").expect("write");
        drop(file);
        assert_eq!(fs::read_to_string(&path).expect("read"), "old");
        assert_eq!(names(dir.path()), ["boxes.txt"]);
        write_file(&path, b"new").expect("write");
        assert_eq!(fs::read_to_string(&path).expect("read"), "new");
        assert_eq!(names(dir.path()), ["boxes.txt"]);
    }

    #[test]
    fn only_a_committed_folder_appears() {
        let dir = tempfile::tempdir().expect("temp");
        let path = dir.path().join("out");
        let part = PartDir::create(&path).expect("create");
        fs::write(part.place("a"), "1").expect("write");
        drop(part);
        assert!(names(dir.path()).is_empty());
        for (name, want) in [("a", vec!["a"]), ("b", vec!["a", "b"])] {
            let part = PartDir::create(&path).expect("create");
            fs::write(part.place(name), "1").expect("write");
            part.commit().expect("commit");
            assert_eq!(names(&path), want);
        }
        assert_eq!(names(dir.path()), ["out"]);
    }

    #[test]
    fn a_missing_folder_is_named() {
        let e = PartFile::create(Path::new("no/such/folder/x.txt")).expect_err("missing");
        assert!(e.to_string().contains("no/such/folder/x.txt"), "{e}");
        assert_eq!(e.exit_code(), 2);
    }
}
