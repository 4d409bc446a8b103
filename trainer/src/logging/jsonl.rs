//! One JSON object per line.

use serde::Serialize;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;

/// An append-only log file.
pub struct JsonLog {
    file: File,
}

impl JsonLog {
    /// Opens or creates the file. A half-written last line, left by a killed run, is cut off.
    ///
    /// # Errors
    /// When the file cannot be opened or read.
    pub fn open(path: &Path) -> std::io::Result<Self> {
        let mut file =
            OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        let whole = bytes.iter().rposition(|b| *b == b'\n').map_or(0, |at| at + 1);
        file.set_len(whole as u64)?;
        file.seek(SeekFrom::End(0))?;
        Ok(Self { file })
    }

    /// Appends one object with `event` and `step` before the fields. A line is written with one
    /// call, so a reader never sees half of it from a living run.
    ///
    /// # Errors
    /// When the fields are not an object or the file cannot be written.
    pub fn entry<T: Serialize>(
        &mut self,
        event: &str,
        step: u64,
        fields: &T,
    ) -> std::io::Result<()> {
        #[derive(Serialize)]
        struct Line<'a, T> {
            event: &'a str,
            step: u64,
            #[serde(flatten)]
            fields: &'a T,
        }
        let mut line = serde_json::to_vec(&Line { event, step, fields })?;
        line.push(b'\n');
        self.file.write_all(&line)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Serialize)]
    struct F {
        loss: f64,
    }

    #[test]
    fn entries_append_and_half_a_line_is_cut_off() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.jsonl");
        JsonLog::open(&path).unwrap().entry("train", 1, &F { loss: 0.5 }).unwrap();
        let mut text = std::fs::read_to_string(&path).unwrap();
        text.push_str("{\"event\":\"tra");
        std::fs::write(&path, text).unwrap();
        JsonLog::open(&path).unwrap().entry("train", 2, &F { loss: f64::NAN }).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<serde_json::Value> =
            text.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        assert_eq!(lines.len(), 2);
        assert_eq!(lines[0]["loss"], 0.5);
        assert_eq!(lines[1]["step"], 2);
        assert!(lines[1]["loss"].is_null());
    }
}
