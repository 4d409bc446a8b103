//! Results as OTB text: one `x,y,w,h` per line and frame, pixels, top-left origin. The layouts of
//! whole result folders are in [`crate::results`].

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use tsda_runtime::BBox;

use crate::boxes::{self, Layout, Style};
use crate::dataset::DatasetError;
use crate::metrics::score::{bbox, row};

/// Writes boxes with three decimals, the first line being the initial box.
///
/// # Errors
/// When the file cannot be written; then nothing is left behind and an older file stays.
pub fn write(path: &Path, boxes: &[BBox]) -> Result<(), DatasetError> {
    let rows: Vec<_> = boxes.iter().map(|b| row(Some(*b))).collect();
    write_whole(path, boxes::format(&rows, Style::Comma).as_bytes())
        .map_err(|source| DatasetError::Io { path: path.to_owned(), source })
}

/// Reads boxes as they stand, with or without area; [`boxes`] says which texts are understood.
///
/// # Errors
/// When the file cannot be read, holds no line, or a line does not hold four numbers; the error
/// names file and line.
pub fn read_rows(path: &Path) -> Result<Vec<BBox>, DatasetError> {
    Ok(boxes::read(path, Layout::Xywh)?.into_iter().map(bbox).collect())
}

/// Writes a whole file or nothing: a temporary neighbour, then a rename.
///
/// # Errors
/// What the system says; the temporary file is removed.
pub fn write_whole(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let name = path.file_name().ok_or_else(|| {
        io::Error::new(io::ErrorKind::InvalidInput, "the path does not end in a file name")
    })?;
    let temporary: PathBuf =
        path.with_file_name(format!(".{}.{}.tmp", name.to_string_lossy(), std::process::id()));
    let written = std::fs::File::create(&temporary)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_all()))
        .and_then(|()| std::fs::rename(&temporary, path));
    if written.is_err() {
        // The first failure is the one to report.
        let _ = std::fs::remove_file(&temporary);
    }
    written
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_come_back_to_a_thousandth() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.txt");
        let boxes = [BBox::new(1.25, -2.0, 30.1234, 4.0), BBox::new(0.0, 0.0, 0.0, 0.0)];
        write(&path, &boxes).unwrap();
        assert_eq!(
            std::fs::read_to_string(&path).unwrap(),
            "1.250,-2.000,30.123,4.000\n0.000,0.000,0.000,0.000\n"
        );
        for (a, b) in read_rows(&path).unwrap().iter().zip(boxes) {
            assert!((a.x - b.x).abs() < 1e-3 && (a.w - b.w).abs() < 1e-3);
        }
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "no temporary file left");
    }

    #[test]
    fn a_failed_write_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("taken");
        std::fs::create_dir(&folder).unwrap();
        let e = write(&folder, &[BBox::default()]).unwrap_err().to_string();
        assert!(e.contains("taken"), "{e}");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
        assert!(write(&dir.path().join("no/such/folder.txt"), &[]).is_err());
        assert!(write_whole(Path::new("/"), b"").is_err());
    }
}
