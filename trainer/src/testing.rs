//! Sequences made up for tests.

use tsda_eval::dataset::{DatasetError, Picture, Sequence};
use tsda_runtime::{BBox, Modality};

/// A registered still pair with one target on textured ground.
pub(crate) struct StillPair {
    id: String,
    seed: usize,
}

impl StillPair {
    /// Pairs `0..n`.
    pub fn several(n: usize) -> Vec<Box<dyn Sequence>> {
        (0..n)
            .map(|i| Box::new(Self { id: format!("still{i}"), seed: i }) as Box<dyn Sequence>)
            .collect()
    }
}

impl Sequence for StillPair {
    fn id(&self) -> &str {
        &self.id
    }
    fn frames(&self) -> usize {
        1
    }
    fn modalities(&self) -> &[Modality] {
        &[Modality::Rgb, Modality::Thermal]
    }
    fn targets(&self) -> usize {
        1
    }
    fn truth(&self, _: usize, frame: usize, _: Modality) -> Option<BBox> {
        (frame == 0).then(|| BBox::new(60.0 + self.seed as f32, 40.0, 30.0, 24.0))
    }
    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        if frame != 0 {
            return Err(DatasetError::NoSuchFrame { sequence: self.id.clone(), frame, modality });
        }
        let (width, height) = (160, 120);
        let channels = if modality == Modality::Rgb { 3 } else { 1 };
        let mut data = Vec::new();
        for y in 0..height {
            for x in 0..width {
                for c in 0..channels {
                    data.push(
                        ((x / 3 * 41 + y / 3 * 67 + 29 * c + 13 * self.seed) % 200 + 20) as u8,
                    );
                }
            }
        }
        Ok(Picture { width, height, channels, data })
    }
}

/// A clip with one target that is seen where `seen` says.
pub(crate) struct Clip {
    /// Sensors.
    pub modalities: Vec<Modality>,
    /// Frames.
    pub frames: usize,
    /// Is the target seen in this frame of this sensor?
    pub seen: fn(usize, Modality) -> bool,
}

impl Sequence for Clip {
    fn id(&self) -> &str {
        "clip"
    }
    fn frames(&self) -> usize {
        self.frames
    }
    fn modalities(&self) -> &[Modality] {
        &self.modalities
    }
    fn targets(&self) -> usize {
        1
    }
    fn truth(&self, _: usize, frame: usize, modality: Modality) -> Option<BBox> {
        (frame < self.frames && (self.seen)(frame, modality))
            // Inside the picture at all times: what lies outside is not drawn.
            .then(|| BBox::new((frame % 20) as f32, 4.0, 12.0, 12.0))
    }
    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        if frame >= self.frames || !(self.seen)(frame, modality) {
            let sequence = "clip".into();
            return Err(DatasetError::NoSuchFrame { sequence, frame, modality });
        }
        Ok(Picture { width: 32, height: 24, channels: 1, data: vec![frame as u8; 32 * 24] })
    }
}
