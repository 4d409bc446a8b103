//! Clips with one folder of pictures and one annotation file per sensor, and the reading of many.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use tsda_runtime::Modality;

use super::clip::{ClipSequence, Labels, Parts, Pictures, Stream};
use super::tree::{Listing, ids};
use super::{DatasetError, Note, Sequence, read_boxes};
use crate::boxes::Layout as BoxLayout;

/// Reads one sequence; made by a loader, run on any thread.
pub(crate) type Job = Box<dyn FnOnce() -> Result<Box<dyn Sequence>, DatasetError> + Send>;

/// What a loader found: sequences still to be read, and what is wrong beside them.
#[derive(Default)]
pub(crate) struct Jobs {
    pub(crate) jobs: Vec<Job>,
    pub(crate) problems: Vec<DatasetError>,
}

impl Jobs {
    /// One clip per folder, read by `read` given the folder and the id.
    pub(crate) fn clips<S: Sequence + 'static>(
        root: &Path,
        dirs: Vec<PathBuf>,
        read: impl Fn(&Path, String) -> Result<S, DatasetError> + Send + Sync + 'static,
    ) -> Self {
        let read = Arc::new(read);
        let job = |(dir, id): (PathBuf, String)| -> Job {
            let read = read.clone();
            Box::new(move || Ok(Box::new(read(&dir, id)?)))
        };
        let ids = ids(root, &dirs);
        Self { jobs: dirs.into_iter().zip(ids).map(job).collect(), problems: Vec::new() }
    }

    /// Sequences that need no more reading.
    pub(crate) fn ready<S: Sequence + 'static>(items: Vec<S>) -> Self {
        let job = |s: S| -> Job { Box::new(move || Ok(Box::new(s))) };
        Self { jobs: items.into_iter().map(job).collect(), problems: Vec::new() }
    }
}

/// Where one sensor's pictures and boxes are: the first name that is there counts.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Side {
    pub(crate) folders: &'static [&'static str],
    pub(crate) files: &'static [(&'static str, BoxLayout)],
}

/// A layout of two such sides.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Layout {
    pub(crate) rgb: Side,
    pub(crate) thermal: Side,
    /// Both sensors must be there.
    pub(crate) both: bool,
    /// The folders in words: `visible/ nor infrared/`.
    pub(crate) what: &'static str,
}

impl Layout {
    /// One of the sensors' folders is enough: a lost one must be reported, not passed over.
    pub(crate) fn is_sequence(&self, listing: &Listing) -> bool {
        [self.rgb, self.thermal].iter().any(|s| listing.find_dir(s.folders).is_some())
    }

    /// Pictures and boxes of both sensors.
    pub(crate) fn read(&self, dir: &Path, id: String) -> Result<Parts, DatasetError> {
        let listing = Listing::of(dir)?;
        let mut notes = Vec::new();
        let rgb = self.side(&self.rgb, &listing, &mut notes)?;
        let thermal = self.side(&self.thermal, &listing, &mut notes)?;
        if self.both && rgb.is_some() != thermal.is_some() {
            let (side, sensor) = if rgb.is_none() {
                (&self.rgb, Modality::Rgb)
            } else {
                (&self.thermal, Modality::Thermal)
            };
            return Err(DatasetError::Format {
                path: dir.to_owned(),
                line: None,
                reason: format!("the {sensor} folder {}/ is missing", side.folders.join("/ or ")),
            });
        }
        Ok(Parts { id, dir: dir.to_owned(), rgb, thermal, notes, ..Parts::default() })
    }

    /// [`Self::read`], paired.
    pub(crate) fn open(&self, dir: &Path, id: String) -> Result<ClipSequence, DatasetError> {
        ClipSequence::build(self.read(dir, id)?, self.what)
    }

    fn side(
        &self,
        side: &Side,
        listing: &Listing,
        notes: &mut Vec<Note>,
    ) -> Result<Option<Stream>, DatasetError> {
        let Some(folder) = listing.find_dir(side.folders) else { return Ok(None) };
        let pictures = Pictures::read(&folder)?;
        let found = side
            .files
            .iter()
            .enumerate()
            .find_map(|(i, (name, format))| Some((i, listing.find_file(&[name])?, *format)));
        let Some((i, path, format)) = found else {
            let names: Vec<&str> = side.files.iter().map(|(name, _)| *name).collect();
            return Err(DatasetError::Format {
                path: listing.dir().to_owned(),
                line: None,
                reason: format!(
                    "no boxes for {}: expected {}",
                    folder_name(&folder),
                    names.join(" or ")
                ),
            });
        };
        if i > 0 {
            notes.push(Note::quirk(
                listing.dir(),
                format!("no {}: boxes of {} used", side.files[0].0, side.files[i].0),
            ));
        }
        let rows = read_boxes(&path, format)?;
        Ok(Some(Stream { pictures, labels: vec![Arc::new(Labels::of(path, rows))] }))
    }
}

fn folder_name(folder: &Path) -> String {
    format!("{}/", super::tree::name_of(folder))
}
