//! A strip of key frames in one PNG.

use super::overlay::{draw_boxes, draw_labels};
use super::paint::{fill, scaled};
use super::png::encode;
use crate::error::HostError;
use crate::output::PartFile;
use crate::picture::Picture;
use crate::track::{Sink, Step};
use std::path::Path;
use tsda_runtime::{BBox, FrameView, Modality};

/// Pictures across and down.
const COLUMNS: usize = 4;
const ROWS: usize = 2;
/// Width of one picture.
const WIDTH: usize = 320;
/// Pixels between pictures.
const GAP: usize = 4;
/// First frames after a change of the sensor that are always shown.
const SWITCHES: usize = 3;

/// Keeps evenly spaced frames of a clip of unknown length, and the first frames after each change
/// of the sensor; writes eight of them.
#[derive(Debug)]
pub struct Strip {
    file: PartFile,
    /// Frames kept so far: every `stride`-th.
    kept: Vec<(usize, Picture)>,
    stride: usize,
    switches: Vec<(usize, Picture)>,
    last: Option<(usize, Picture)>,
    sensor: Option<Modality>,
}

impl Strip {
    /// Starts writing a file.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn create(path: &Path) -> Result<Self, HostError> {
        Ok(Self {
            file: PartFile::create(path)?,
            kept: Vec::new(),
            stride: 1,
            switches: Vec::new(),
            last: None,
            sensor: None,
        })
    }

    /// The frames to show, in order.
    fn chosen(self) -> (PartFile, Vec<(usize, Picture)>) {
        let mut frames = self.switches;
        let places = COLUMNS * ROWS;
        let mut spare = self.kept;
        if let Some(last) = self.last {
            spare.retain(|k| k.0 != last.0);
            spare.push(last);
        }
        spare.retain(|k| frames.iter().all(|f| f.0 != k.0));
        let wanted = places.saturating_sub(frames.len()).min(spare.len());
        let pick = |i: usize| if wanted > 1 { i * (spare.len() - 1) / (wanted - 1) } else { 0 };
        let indices: Vec<usize> = (0..wanted).map(pick).collect();
        frames.extend(
            spare.into_iter().enumerate().filter(|(i, _)| indices.contains(i)).map(|(_, f)| f),
        );
        frames.sort_by_key(|f| f.0);
        (self.file, frames)
    }
}

impl Sink for Strip {
    fn frame(
        &mut self,
        view: &FrameView<'_>,
        step: &Step,
        truth: Option<BBox>,
    ) -> Result<(), HostError> {
        let mut picture = Picture::default();
        let scale = scaled(view, WIDTH, &mut picture);
        draw_boxes(&mut picture, scale, step, truth);
        draw_labels(&mut picture, step);
        if self.sensor.replace(step.modality).is_some_and(|before| before != step.modality)
            && self.switches.len() < SWITCHES
        {
            self.switches.push((step.frame, picture.clone()));
        }
        if step.frame.is_multiple_of(self.stride) {
            self.kept.push((step.frame, picture.clone()));
            // Twice as many as needed: drop every second one and go on at half the rate.
            if self.kept.len() > 4 * COLUMNS * ROWS {
                self.stride *= 2;
                let stride = self.stride;
                self.kept.retain(|k| k.0.is_multiple_of(stride));
            }
        }
        self.last = Some((step.frame, picture));
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<(), HostError> {
        let (mut file, frames) = self.chosen();
        let high = frames.iter().map(|f| f.1.height).max().unwrap_or(1);
        let columns = frames.len().clamp(1, COLUMNS);
        let rows = frames.len().div_ceil(columns).max(1);
        let mut sheet = Picture::default();
        sheet.reset(columns * (WIDTH + GAP) - GAP, rows * (high + GAP) - GAP, 3);
        let (w, h) = (sheet.width as i32, sheet.height as i32);
        fill(&mut sheet, 0, 0, w, h, [255, 255, 255], 255);
        for (i, (_, picture)) in frames.iter().enumerate() {
            let (x, y) = (i % columns * (WIDTH + GAP), i / columns * (high + GAP));
            for row in 0..picture.height {
                let to = ((y + row) * sheet.width + x) * 3;
                let from = row * picture.width * 3;
                sheet.data[to..to + picture.width * 3]
                    .copy_from_slice(&picture.data[from..from + picture.width * 3]);
            }
        }
        let path = file.path().to_path_buf();
        encode(&sheet, &mut file).map_err(|e| HostError::Encode { path, reason: e.to_string() })?;
        file.commit()
    }
}
