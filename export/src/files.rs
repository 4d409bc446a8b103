//! Files that are either whole or not there.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

/// A file or folder that could not be read or written.
#[derive(Debug, thiserror::Error)]
#[error("cannot {action} {}: {source}", path.display())]
pub struct FileError {
    /// `read`, `write`, `create folder`.
    pub action: &'static str,
    /// The file or folder.
    pub path: PathBuf,
    /// What the system said.
    pub source: io::Error,
}

/// Reads a text file.
///
/// # Errors
/// When it cannot be read or is not UTF-8.
pub fn read_text(path: &Path) -> Result<String, FileError> {
    std::fs::read_to_string(path).map_err(|source| FileError {
        action: "read",
        path: path.into(),
        source,
    })
}

/// Writes a file under a temporary name beside it, then renames: whoever looks sees the old file or
/// the whole new one.
///
/// # Errors
/// When the file cannot be written; the temporary one is removed.
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), FileError> {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(format!(".{}.part", std::process::id()));
    let temporary = PathBuf::from(temporary);
    let whole = || {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(bytes)?;
        // On disk before the old file is given up.
        file.sync_all()?;
        std::fs::rename(&temporary, path)
    };
    whole().map_err(|source| {
        // It may never have been created.
        let _ = std::fs::remove_file(&temporary);
        FileError { action: "write", path: path.into(), source }
    })
}
