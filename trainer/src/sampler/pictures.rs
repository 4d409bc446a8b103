//! Decoded pictures, kept in memory: a still is drawn thousands of times, decoding would dominate.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use tsda_eval::dataset::{DatasetError, Picture, Sequence};
use tsda_runtime::Modality;

/// One frame of one sensor of one sequence of one source.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct FrameRef {
    /// Index of the source.
    pub source: usize,
    /// Index of the sequence in the source.
    pub sequence: usize,
    /// 0-based frame.
    pub frame: usize,
    /// The sensor.
    pub modality: Modality,
}

#[derive(Default)]
struct Store {
    pictures: HashMap<FrameRef, (Arc<Picture>, u64)>,
    bytes: usize,
    clock: u64,
}

/// A bounded cache of decoded pictures; the longest unused ones go first. What it holds never
/// changes what is drawn.
pub struct PictureCache {
    limit: usize,
    store: Mutex<Store>,
}

impl PictureCache {
    /// A cache of at most `mib` MiB of pixels.
    pub fn new(mib: usize) -> Self {
        Self { limit: mib.saturating_mul(1 << 20), store: Mutex::default() }
    }

    /// The picture, decoded unless it is held already.
    ///
    /// # Errors
    /// When the picture cannot be read.
    pub fn get(&self, at: FrameRef, sequence: &dyn Sequence) -> Result<Arc<Picture>, DatasetError> {
        {
            let mut store = self.store.lock().unwrap_or_else(PoisonError::into_inner);
            store.clock += 1;
            let clock = store.clock;
            if let Some((picture, used)) = store.pictures.get_mut(&at) {
                *used = clock;
                return Ok(picture.clone());
            }
        }
        // Decoded outside the lock: two workers may decode the same picture once in a while.
        let picture = Arc::new(sequence.picture(at.frame, at.modality)?);
        let mut store = self.store.lock().unwrap_or_else(PoisonError::into_inner);
        let size = picture.data.len();
        if size <= self.limit {
            while store.bytes + size > self.limit {
                let oldest = store.pictures.iter().min_by_key(|(_, (_, used))| *used);
                let Some(key) = oldest.map(|(key, _)| *key) else { break };
                if let Some((gone, _)) = store.pictures.remove(&key) {
                    store.bytes -= gone.data.len();
                }
            }
            let clock = store.clock;
            match store.pictures.insert(at, (picture.clone(), clock)) {
                Some((twin, _)) => store.bytes = store.bytes - twin.data.len() + size,
                None => store.bytes += size,
            }
        }
        Ok(picture)
    }

    /// Bytes of pixels held.
    pub fn bytes(&self) -> usize {
        self.store.lock().unwrap_or_else(PoisonError::into_inner).bytes
    }
}
