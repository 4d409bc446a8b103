//! Clips with known boxes for the demo: the rendered one, and sequence folders of the benchmarks.

use crate::error::HostError;
use crate::frames::{Frame, FrameSource, Listed, PictureFiles, SourceError, read_boxes};
use crate::picture::Picture;
use crate::render::Clip;
use std::path::{Path, PathBuf};
use tsda_runtime::{BBox, Modality};

/// Which sensor each frame comes from: RGB first where there is a choice, then in turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Switching {
    /// Once, in the middle.
    Middle,
    /// Every so many frames, at least 1.
    Every(usize),
}

impl Switching {
    /// Sensor of a frame of a clip with `frames` frames.
    pub fn modality(self, frame: usize, frames: usize) -> Modality {
        let thermal = match self {
            Self::Middle => frame >= frames.div_ceil(2),
            Self::Every(n) => (frame / n.max(1)) % 2 == 1,
        };
        if thermal { Modality::Thermal } else { Modality::Rgb }
    }
}

/// The rendered clip with its sensor switches.
#[derive(Debug)]
pub struct ClipFrames {
    clip: Clip,
    switching: Switching,
    next: usize,
    name: String,
    picture: Picture,
}

impl ClipFrames {
    /// From the first frame.
    pub fn new(clip: Clip, switching: Switching) -> Self {
        Self { clip, switching, next: 0, name: String::new(), picture: Picture::default() }
    }

    /// Known boxes of all frames.
    pub fn truth(&self) -> Vec<Option<BBox>> {
        (0..self.clip.frames()).map(|i| Some(self.clip.truth(i))).collect()
    }
}

impl FrameSource for ClipFrames {
    fn len_hint(&self) -> Option<usize> {
        Some(self.clip.frames())
    }

    fn next_frame(&mut self) -> Result<Option<Frame<'_>>, SourceError> {
        let index = self.next;
        if index >= self.clip.frames() {
            return Ok(None);
        }
        let modality = self.switching.modality(index, self.clip.frames());
        self.clip.render(index, modality, &mut self.picture);
        self.name = format!("rendered/{modality}/{index:06}");
        self.next += 1;
        let view = self
            .picture
            .view()
            .map_err(|source| SourceError::Frame { name: self.name.clone(), source })?;
        Ok(Some(Frame { index, name: &self.name, modality, view }))
    }
}

/// A sequence folder put together as one clip with sensor switches.
#[derive(Debug)]
pub struct SequenceFolder {
    /// The frames in the order they are tracked.
    pub frames: PictureFiles,
    /// Known boxes by frame, each of the sensor that is active then.
    pub truth: Vec<Option<BBox>>,
    /// Sensors found.
    pub sensors: Vec<Modality>,
}

const RGB: [&str; 5] = ["visible", "rgb", "v", "color", "img"];
const THERMAL: [&str; 4] = ["infrared", "ir", "i", "thermal"];

impl SequenceFolder {
    /// Reads a folder with one or two folders of pictures (`visible/` and `infrared/`, or the names
    /// other data sets use) and their box files (`visible.txt`, `infrared.txt`, else
    /// `groundtruth.txt` or `init.txt`). Frames are paired by position; the clip starts at the first
    /// frame with a known box.
    ///
    /// # Errors
    /// When pictures or boxes are missing or cannot be read.
    pub fn open(folder: &Path, switching: Switching) -> Result<Self, HostError> {
        let find = |names: &[&str]| names.iter().map(|n| folder.join(n)).find(|p| p.is_dir());
        let mut sensors = Vec::new();
        let mut listed: Vec<Vec<Listed>> = Vec::new();
        let mut boxes: Vec<Vec<Option<BBox>>> = Vec::new();
        for (modality, names) in [(Modality::Rgb, &RGB[..]), (Modality::Thermal, &THERMAL[..])] {
            if let Some(pictures) = find(names) {
                listed.push(PictureFiles::folder(&pictures)?.entries().to_vec());
                boxes.push(read_boxes(&box_file(folder, &pictures)?)?);
                sensors.push(modality);
            }
        }
        if sensors.is_empty() {
            return Err(SourceError::NoFrames {
                path: folder.to_path_buf(),
                reason: "no sequence folder: a folder visible or infrared with pictures was \
                         expected in it"
                    .into(),
            }
            .into());
        }
        let frames = listed.iter().map(Vec::len).min().unwrap_or(0);
        let start = boxes[0].iter().position(Option::is_some).filter(|&s| s < frames);
        let start = start.ok_or_else(|| SourceError::NoFrames {
            path: folder.to_path_buf(),
            reason: format!("no {} frame has a known box to start from", sensors[0]),
        })?;
        let total = frames - start;
        let (mut entries, mut truth) = (Vec::with_capacity(total), Vec::with_capacity(total));
        for i in 0..total {
            let wanted = switching.modality(i, total);
            let k = sensors.iter().position(|&s| s == wanted).unwrap_or(0);
            let path = listed[k][start + i].path.clone();
            entries.push(Listed { path, modality: Some(sensors[k]) });
            truth.push(boxes[k].get(start + i).copied().flatten());
        }
        Ok(Self { frames: PictureFiles::new(entries), truth, sensors })
    }
}

/// The box file that belongs to a folder of pictures.
fn box_file(folder: &Path, pictures: &Path) -> Result<PathBuf, SourceError> {
    let name = pictures.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let own = format!("{name}.txt");
    [own.as_str(), "groundtruth.txt", "groundtruth_rect.txt", "init.txt"]
        .iter()
        .map(|n| folder.join(n))
        .find(|p| p.is_file())
        .ok_or_else(|| SourceError::NoFrames {
            path: folder.to_path_buf(),
            reason: format!("no boxes for {name}: {own} or groundtruth.txt was expected"),
        })
}
