//! Folders of pictures in natural order, and text lists.

use super::{Decoded, Frame, FrameSource, SourceError, natural_cmp};
use std::fs;
use std::path::{Path, PathBuf};
use tsda_runtime::Modality;

const EXTENSIONS: [&str; 4] = ["jpg", "jpeg", "png", "bmp"];

/// One entry: a file, and its sensor where someone said so.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// The file.
    pub path: PathBuf,
    /// Sensor, when given.
    pub modality: Option<Modality>,
}

/// Picture files one after the other.
#[derive(Debug)]
pub struct PictureFiles {
    entries: Vec<Listed>,
    next: usize,
    name: String,
    current: Option<Decoded>,
}

impl PictureFiles {
    /// These files in this order.
    pub fn new(entries: Vec<Listed>) -> Self {
        Self { entries, next: 0, name: String::new(), current: None }
    }

    /// The pictures of a folder in natural order; other files are passed over.
    ///
    /// # Errors
    /// When the folder cannot be read or holds no picture.
    pub fn folder(folder: &Path) -> Result<Self, SourceError> {
        let io = |source| SourceError::Io { path: folder.to_path_buf(), source };
        let mut files = Vec::new();
        for entry in fs::read_dir(folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            let known = path
                .extension()
                .is_some_and(|e| EXTENSIONS.contains(&e.to_string_lossy().to_lowercase().as_str()));
            if known && path.is_file() {
                files.push(path);
            }
        }
        if files.is_empty() {
            let sub: Vec<&str> = ["visible", "infrared", "img", "v", "i", "rgb", "ir", "thermal"]
                .into_iter()
                .filter(|s| folder.join(s).is_dir())
                .collect();
            let reason = if sub.is_empty() {
                format!("no pictures in this folder ({})", EXTENSIONS.join(", "))
            } else {
                format!(
                    "no pictures in this folder itself, but it has {}: pass one of those, a list \
                     that mixes them, or use `tsda demo --data` for a switch between them",
                    sub.join(", ")
                )
            };
            return Err(SourceError::NoFrames { path: folder.to_path_buf(), reason });
        }
        files.sort_by(|a, b| natural_cmp(&a.to_string_lossy(), &b.to_string_lossy()));
        Ok(Self::new(files.into_iter().map(|path| Listed { path, modality: None }).collect()))
    }

    /// A text list: one path per line, relative to the list; optionally a TAB and `rgb` or
    /// `thermal`. Empty lines and lines starting with `#` are passed over. Every file is looked for
    /// before the first is read.
    ///
    /// # Errors
    /// Names the list and the line that cannot be used.
    pub fn list(list: &Path) -> Result<Self, SourceError> {
        let bytes = fs::read(list)
            .map_err(|source| SourceError::Io { path: list.to_path_buf(), source })?;
        let text = String::from_utf8(bytes).map_err(|_| SourceError::NoFrames {
            path: list.to_path_buf(),
            reason: "neither a folder nor a text list with one picture path per line".into(),
        })?;
        let base = list.parent().unwrap_or(Path::new(""));
        let mut entries = Vec::new();
        for (i, line) in text.lines().enumerate() {
            let bad = |reason: String| SourceError::Line {
                path: list.to_path_buf(),
                line: i + 1,
                reason,
            };
            let line = line.trim_end_matches('\r');
            if line.trim().is_empty() || line.trim_start().starts_with('#') {
                continue;
            }
            let (name, tag) = line.split_once('\t').unwrap_or((line, ""));
            let modality = match tag.trim().to_lowercase().as_str() {
                "" => None,
                "rgb" | "visible" => Some(Modality::Rgb),
                "thermal" | "infrared" | "ir" => Some(Modality::Thermal),
                other => {
                    return Err(bad(format!("sensor \"{other}\" is neither rgb nor thermal")));
                }
            };
            let path = base.join(name.trim());
            if !path.is_file() {
                return Err(bad(format!("there is no file {}", path.display())));
            }
            entries.push(Listed { path, modality });
        }
        if entries.is_empty() {
            return Err(SourceError::NoFrames {
                path: list.to_path_buf(),
                reason: "the list names no picture".into(),
            });
        }
        Ok(Self::new(entries))
    }

    /// Files and sensors.
    pub fn entries(&self) -> &[Listed] {
        &self.entries
    }
}

impl FrameSource for PictureFiles {
    fn len_hint(&self) -> Option<usize> {
        Some(self.entries.len())
    }

    fn next_frame(&mut self) -> Result<Option<Frame<'_>>, SourceError> {
        let Some(entry) = self.entries.get(self.next) else { return Ok(None) };
        let decoded = self.current.insert(Decoded::open(&entry.path)?);
        self.name = entry.path.display().to_string();
        let modality = entry.modality.unwrap_or_else(|| decoded.modality(&entry.path));
        let view = decoded
            .view()
            .map_err(|source| SourceError::Frame { name: self.name.clone(), source })?;
        self.next += 1;
        Ok(Some(Frame { index: self.next - 1, name: &self.name, modality, view }))
    }
}
