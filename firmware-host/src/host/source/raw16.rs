//! A folder of raw 16-bit pictures without headers, as thermal cameras are often recorded.

use crate::frames::{Frame, FrameSource, SourceError, natural_cmp};
use std::fs::{self, File};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use tsda_runtime::{FrameView, Modality, PixelFormat};

/// Files of `2 * width * height` bytes, little endian, in natural order of their names.
#[derive(Debug)]
pub struct Raw16Folder {
    files: Vec<PathBuf>,
    next: usize,
    width: usize,
    height: usize,
    data: Vec<u8>,
    name: String,
}

impl Raw16Folder {
    /// All files of a folder; each has to have the right length.
    ///
    /// # Errors
    /// When the folder cannot be read, is empty, or the first file has another length.
    pub fn open(folder: &Path, (width, height): (usize, usize)) -> Result<Self, SourceError> {
        let io = |source| SourceError::Io { path: folder.to_path_buf(), source };
        let mut files = Vec::new();
        for entry in fs::read_dir(folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            if path.is_file() {
                files.push(path);
            }
        }
        files.sort_by(|a, b| natural_cmp(&a.to_string_lossy(), &b.to_string_lossy()));
        let data = vec![0; width.saturating_mul(height).saturating_mul(2)];
        let first = files.first().ok_or_else(|| SourceError::NoFrames {
            path: folder.to_path_buf(),
            reason: "no files in this folder".into(),
        })?;
        check_length(first, data.len())?;
        Ok(Self { files, next: 0, width, height, data, name: String::new() })
    }
}

fn check_length(path: &Path, want: usize) -> Result<(), SourceError> {
    let length = fs::metadata(path)
        .map_err(|source| SourceError::Io { path: path.to_path_buf(), source })?
        .len();
    if length == want as u64 {
        return Ok(());
    }
    Err(SourceError::Decode {
        path: path.to_path_buf(),
        reason: format!(
            "{length} bytes; raw 16-bit pictures of this size have {want}: check `size`"
        ),
    })
}

impl FrameSource for Raw16Folder {
    fn len_hint(&self) -> Option<usize> {
        Some(self.files.len())
    }

    fn next_frame(&mut self) -> Result<Option<Frame<'_>>, SourceError> {
        let Some(path) = self.files.get(self.next) else { return Ok(None) };
        check_length(path, self.data.len())?;
        File::open(path)
            .and_then(|mut f| f.read_exact(&mut self.data))
            .map_err(|source| SourceError::Io { path: path.clone(), source })?;
        let index = self.next;
        self.next += 1;
        self.name.clear();
        self.name.push_str(&path.to_string_lossy());
        let format = PixelFormat::Y16 { low: 0, high: u16::MAX };
        let view = FrameView::new(&self.data, self.width, self.height, self.width * 2, format)
            .map_err(|source| SourceError::Frame { name: self.name.clone(), source })?;
        Ok(Some(Frame { index, name: &self.name, modality: Modality::Thermal, view }))
    }
}
