//! Where a run's figures go: `log.jsonl`, one object per line, and TensorBoard event files.

mod jsonl;
mod tensorboard;

pub use jsonl::JsonLog;
pub use tensorboard::{EventFile, read_events};

use serde::Serialize;
use std::path::Path;

/// Both logs of a run.
pub struct RunLog {
    json: JsonLog,
    board: EventFile,
}

impl RunLog {
    /// Opens `out/log.jsonl` for appending and a new event file `out/events.out.tfevents.*`.
    ///
    /// # Errors
    /// When a file cannot be opened.
    pub fn open(out: &Path) -> std::io::Result<Self> {
        Ok(Self { json: JsonLog::open(&out.join("log.jsonl"))?, board: EventFile::create(out)? })
    }

    /// Writes one entry: `{"event": event, "step": step, ...fields}`. Numbers among the fields that
    /// are named in `scalars` go to TensorBoard as `event/name` too.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn entry<T: Serialize>(
        &mut self,
        event: &str,
        step: u64,
        fields: &T,
        scalars: &[(&str, f64)],
    ) -> std::io::Result<()> {
        self.json.entry(event, step, fields)?;
        if scalars.is_empty() {
            return Ok(());
        }
        let named: Vec<(String, f32)> =
            scalars.iter().map(|(name, v)| (format!("{event}/{name}"), *v as f32)).collect();
        self.board.scalars(step, &named)
    }
}
