//! One clip of files: what the folder loaders build, whatever the layout.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tsda_runtime::{BBox, Modality};

use super::tree::Listing;
use super::{DatasetError, Note, Picture, Registration, Sequence, decode_picture, picture_size};

/// Picture files of one sensor, in order. Only names are kept per file: LasHeR has 1.5 million.
#[derive(Clone, Debug)]
pub(crate) struct Pictures {
    dir: PathBuf,
    names: Vec<Box<OsStr>>,
}

impl Pictures {
    /// All pictures of a folder.
    ///
    /// # Errors
    /// When it cannot be listed or holds none.
    pub(crate) fn read(dir: &Path) -> Result<Self, DatasetError> {
        let listing = Listing::of(dir)?;
        Self::of(dir, listing.pictures())
    }

    /// Some pictures of a folder.
    ///
    /// # Errors
    /// When there are none.
    pub(crate) fn of(dir: &Path, names: Vec<Box<OsStr>>) -> Result<Self, DatasetError> {
        if names.is_empty() {
            return Err(DatasetError::Format {
                path: dir.to_owned(),
                line: None,
                reason: "no pictures in it (jpg, png or bmp)".into(),
            });
        }
        Ok(Self { dir: dir.to_owned(), names })
    }

    pub(crate) fn len(&self) -> usize {
        self.names.len()
    }

    pub(crate) fn path(&self, i: usize) -> Option<PathBuf> {
        self.names.get(i).map(|n| self.dir.join(&**n))
    }

    /// Number in each name: its last run of digits.
    pub(crate) fn numbers(&self) -> impl Iterator<Item = Option<u64>> + '_ {
        self.names.iter().map(|n| last_number(&Path::new(&**n).file_stem()?.to_string_lossy()))
    }

    /// Only the pictures `from..from + n`, as far as there are any.
    pub(crate) fn window(&mut self, from: usize, n: usize) {
        self.names.truncate(from.saturating_add(n));
        self.names.drain(..from.min(self.names.len()));
    }
}

/// Last run of digits of a name, as a number.
pub(crate) fn last_number(stem: &str) -> Option<u64> {
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end].rfind(|c: char| !c.is_ascii_digit());
    // The character before the digits may be wider than a byte.
    let start = start.map_or(0, |i| i + stem[i..].chars().next().map_or(1, char::len_utf8));
    stem[start..end].parse().ok()
}

/// Annotation of one target in one sensor. Row `k` speaks of frame `first + k * every`.
#[derive(Clone, Debug)]
pub(crate) struct Labels {
    /// The file, for messages.
    pub(crate) path: PathBuf,
    /// Boxes as annotated, in 0-based `x, y, w, h`; without area where absent.
    pub(crate) rows: Vec<BBox>,
    /// Absence by row, where the annotation marks it apart from the box; shorter lists say nothing.
    pub(crate) absent: Vec<bool>,
    /// Visible share by row; shorter lists say nothing.
    pub(crate) visibility: Vec<f32>,
    /// Frame of the first row.
    pub(crate) first: usize,
    /// Frames from row to row, at least 1.
    pub(crate) every: usize,
    /// Boxes between two rows are interpolated.
    pub(crate) interpolate: bool,
    /// The publisher holds rows back (test splits): fewer rows than frames are right.
    pub(crate) partial: bool,
}

impl Labels {
    pub(crate) fn of(path: impl Into<PathBuf>, rows: Vec<BBox>) -> Self {
        Self {
            path: path.into(),
            rows,
            absent: Vec::new(),
            visibility: Vec::new(),
            first: 0,
            every: 1,
            interpolate: false,
            partial: false,
        }
    }

    /// Row of a frame, and how far the frame lies behind it in units of rows.
    fn place(&self, frame: usize) -> Option<(usize, f32)> {
        let behind = frame.checked_sub(self.first)?;
        let every = self.every.max(1);
        Some((behind / every, (behind % every) as f32 / every as f32))
    }

    fn exact(&self, frame: usize) -> Option<usize> {
        self.place(frame).filter(|(k, t)| *t == 0.0 && *k < self.rows.len()).map(|(k, _)| k)
    }

    fn row_truth(&self, k: usize) -> Option<BBox> {
        let seen = !self.absent.get(k).copied().unwrap_or(false);
        self.rows.get(k).copied().filter(|b| seen && b.is_valid())
    }

    fn between(&self, frame: usize) -> Option<BBox> {
        if !self.interpolate {
            return None;
        }
        let (k, t) = self.place(frame)?;
        let (a, b) = (self.row_truth(k)?, self.row_truth(k + 1)?);
        let mix = |a: f32, b: f32| a + t * (b - a);
        Some(BBox::new(mix(a.x, b.x), mix(a.y, b.y), mix(a.w, b.w), mix(a.h, b.h)))
    }

    pub(crate) fn truth(&self, frame: usize) -> Option<BBox> {
        match self.exact(frame) {
            Some(k) => self.row_truth(k),
            None => self.between(frame),
        }
    }

    fn annotated(&self, frame: usize) -> bool {
        self.exact(frame).is_some() || self.between(frame).is_some()
    }

    fn row(&self, frame: usize) -> Option<BBox> {
        match self.exact(frame) {
            Some(k) => self.rows.get(k).copied(),
            None => self.between(frame),
        }
    }

    /// Rows that `frames` frames need.
    fn needed(&self, frames: usize) -> usize {
        match frames.checked_sub(self.first + 1) {
            Some(rest) => rest / self.every.max(1) + 1,
            None => 0,
        }
    }
}

/// Pictures of one sensor with the annotation of every target.
#[derive(Clone, Debug)]
pub(crate) struct Stream {
    pub(crate) pictures: Pictures,
    pub(crate) labels: Vec<Arc<Labels>>,
}

/// What a loader found out about a clip.
#[derive(Clone, Debug, Default)]
pub(crate) struct Parts {
    pub(crate) id: String,
    pub(crate) dir: PathBuf,
    pub(crate) rgb: Option<Stream>,
    pub(crate) thermal: Option<Stream>,
    pub(crate) attributes: Vec<String>,
    /// Flags by frame under their name.
    pub(crate) tags: Vec<(String, Vec<bool>)>,
    pub(crate) registration: Registration,
    pub(crate) notes: Vec<Note>,
}

/// A clip of picture files, of one or two sensors.
#[derive(Clone, Debug)]
pub struct ClipSequence {
    parts: Parts,
    frames: usize,
    targets: usize,
    modalities: Vec<Modality>,
}

impl ClipSequence {
    /// Pairs the sensors by position and notes what does not fit.
    ///
    /// # Errors
    /// When there is no sensor at all; `what` says what was looked for.
    pub(crate) fn build(mut parts: Parts, what: &str) -> Result<Self, DatasetError> {
        let streams = [(Modality::Rgb, &parts.rgb), (Modality::Thermal, &parts.thermal)];
        let there: Vec<(Modality, &Stream)> =
            streams.into_iter().filter_map(|(m, s)| Some((m, s.as_ref()?))).collect();
        let Some(frames) = there.iter().map(|(_, s)| s.pictures.len()).min() else {
            return Err(DatasetError::Format {
                path: parts.dir,
                line: None,
                reason: format!("not a sequence folder: it has neither {what}"),
            });
        };
        let mut notes = Vec::new();
        if let [(_, a), (_, b)] = there[..]
            && a.pictures.len() != b.pictures.len()
        {
            let text = format!(
                "{} and {} pictures in {} and {}: cut to {frames}",
                a.pictures.len(),
                b.pictures.len(),
                name(&a.pictures.dir),
                name(&b.pictures.dir)
            );
            notes.push(Note::quirk(&parts.dir, text));
        }
        let mut told: Vec<&Path> = Vec::new();
        for (_, stream) in &there {
            let own = stream.pictures.len();
            for labels in &stream.labels {
                let rows = labels.rows.len();
                // A second sensor that shares the file says nothing new.
                let fits = rows == labels.needed(own) || rows == labels.needed(frames);
                if fits || labels.partial || told.contains(&labels.path.as_path()) {
                    continue;
                }
                told.push(&labels.path);
                let needed = labels.needed(frames);
                notes.push(Note::broken(
                    &labels.path,
                    format!("{rows} boxes for {frames} frames: expected {needed}"),
                ));
            }
        }
        let targets = there.iter().map(|(_, s)| s.labels.len()).max().unwrap_or(0);
        let modalities = there.iter().map(|(m, _)| *m).collect();
        parts.notes.extend(notes);
        Ok(Self { parts, frames, targets, modalities })
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.parts.dir
    }

    /// File of one frame of one sensor.
    pub fn path(&self, frame: usize, modality: Modality) -> Option<PathBuf> {
        if frame >= self.frames {
            return None;
        }
        self.stream(modality)?.pictures.path(frame)
    }

    fn stream(&self, modality: Modality) -> Option<&Stream> {
        match modality {
            Modality::Rgb => self.parts.rgb.as_ref(),
            Modality::Thermal => self.parts.thermal.as_ref(),
        }
    }

    fn labels(&self, target: usize, frame: usize, modality: Modality) -> Option<&Labels> {
        let labels = self.stream(modality)?.labels.get(target)?;
        (frame < self.frames).then_some(labels)
    }
}

fn name(dir: &Path) -> String {
    format!("{}/", super::tree::name_of(dir))
}

impl Sequence for ClipSequence {
    fn id(&self) -> &str {
        &self.parts.id
    }

    fn frames(&self) -> usize {
        self.frames
    }

    fn modalities(&self) -> &[Modality] {
        &self.modalities
    }

    fn targets(&self) -> usize {
        self.targets
    }

    fn truth(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox> {
        self.labels(target, frame, modality)?.truth(frame)
    }

    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        match self.path(frame, modality) {
            Some(path) => decode_picture(&path, modality),
            None => {
                let sequence = self.parts.id.clone();
                Err(DatasetError::NoSuchFrame { sequence, frame, modality })
            }
        }
    }

    fn annotated(&self, target: usize, frame: usize, modality: Modality) -> bool {
        self.labels(target, frame, modality).is_some_and(|l| l.annotated(frame))
    }

    fn truth_row(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox> {
        self.labels(target, frame, modality)?.row(frame)
    }

    fn visibility(&self, target: usize, frame: usize, modality: Modality) -> Option<f32> {
        let labels = self.labels(target, frame, modality)?;
        labels.visibility.get(labels.exact(frame)?).copied()
    }

    fn attributes(&self) -> &[String] {
        &self.parts.attributes
    }

    fn frame_attributes(&self, frame: usize) -> Vec<&str> {
        let on = |flags: &[bool]| flags.get(frame).copied().unwrap_or(false);
        self.parts.tags.iter().filter(|(_, flags)| on(flags)).map(|(n, _)| n.as_str()).collect()
    }

    fn notes(&self) -> &[Note] {
        &self.parts.notes
    }

    fn registration(&self) -> Registration {
        self.parts.registration
    }

    fn picture_path(&self, frame: usize, modality: Modality) -> Option<PathBuf> {
        self.path(frame, modality)
    }

    fn resolution(&self, modality: Modality) -> Result<(usize, usize), DatasetError> {
        match self.path(0, modality) {
            Some(path) => picture_size(&path),
            None => {
                let sequence = self.parts.id.clone();
                Err(DatasetError::NoSuchFrame { sequence, frame: 0, modality })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn rows_speak_of_every_tenth_frame_or_of_those_between_too() {
        let rows = [0.0, 10.0, 0.0, 30.0].map(|x| match x {
            0.0 => BBox::new(0.0, 0.0, 0.0, 0.0),
            x => BBox::new(x, 0.0, 4.0, 4.0),
        });
        let mut labels = Labels::of("l.txt", rows.to_vec());
        (labels.first, labels.every) = (3, 10);
        assert_eq!(labels.truth(13).map(|b| b.x), Some(10.0));
        assert_eq!((labels.truth(14), labels.annotated(14)), (None, false));
        assert_eq!((labels.truth(23), labels.annotated(23)), (None, true));
        assert!(!labels.annotated(2) && !labels.annotated(43));
        assert_eq!([33, 34, 43, 44].map(|n| labels.needed(n)), [3, 4, 4, 5]);
        labels.interpolate = true;
        assert_eq!(labels.truth(14), None, "a neighbour is absent");
        labels.rows[2] = BBox::new(20.0, 10.0, 4.0, 8.0);
        assert_eq!(labels.truth(18), Some(BBox::new(15.0, 5.0, 4.0, 6.0)));
        assert_eq!(labels.truth(34), None, "nothing behind the last row");
    }

    #[test]
    fn a_mark_wins_over_a_stale_box() {
        let mut labels = Labels::of("l.json", vec![BBox::new(1.0, 1.0, 2.0, 2.0); 2]);
        labels.absent = vec![true, false];
        assert_eq!((labels.truth(0), labels.annotated(0)), (None, true));
        assert!(labels.row(0).is_some() && labels.truth(1).is_some());
    }

    #[test]
    fn numbers_in_names() {
        for (stem, want) in [
            ("00159v", Some(159)),
            ("img_00001", Some(1)),
            ("visibleI0007", Some(7)),
            ("00001_i", Some(1)),
            ("é12", Some(12)),
            ("none", None),
            ("99999999999999999999", None),
        ] {
            assert_eq!(last_number(stem), want, "{stem}");
        }
    }

    proptest! {
        #[test]
        fn numbers_never_panic(stem in "\\PC{0,12}") {
            let _ = last_number(&stem);
        }
    }
}
