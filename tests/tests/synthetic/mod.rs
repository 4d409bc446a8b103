//! Clips to calibrate on that need no files.
#![allow(dead_code, reason = "every test takes what it needs")]

use tsda_eval::dataset::{Dataset, DatasetError, Picture, Sequence};
use tsda_runtime::{BBox, Modality, probe};

/// Pixels per row.
pub const WIDTH: usize = 160;
/// Rows.
pub const HEIGHT: usize = 120;
const WIDE: usize = 260;

/// The recipe picture through a window that moves by 3 pixels per frame, in colour and in grey.
pub struct Moving(pub usize);

impl Moving {
    /// A frame in colour.
    pub fn rgb(&self, frame: usize) -> Vec<u8> {
        let mut wide = vec![0; WIDE * HEIGHT * 3];
        probe::recipe_image(self.0, WIDE, HEIGHT, &mut wide);
        let row = |y: usize| (y * WIDE + 3 * frame) * 3;
        (0..HEIGHT).flat_map(|y| wide[row(y)..row(y) + WIDTH * 3].iter().copied()).collect()
    }
}

impl Sequence for Moving {
    fn id(&self) -> &str {
        "moving"
    }
    fn frames(&self) -> usize {
        30
    }
    fn modalities(&self) -> &[Modality] {
        &[Modality::Rgb, Modality::Thermal]
    }
    fn targets(&self) -> usize {
        1
    }
    fn truth(&self, _: usize, frame: usize, _: Modality) -> Option<BBox> {
        Some(BBox::new(100.0 - 3.0 * frame as f32, 40.0, 30.0, 36.0))
    }
    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        let rgb = self.rgb(frame);
        let (channels, data) = match modality {
            Modality::Rgb => (3, rgb),
            _ => (1, rgb.chunks(3).map(|p| 255 - p[1]).collect()),
        };
        Ok(Picture { width: WIDTH, height: HEIGHT, channels, data })
    }
}

/// Four of them.
pub fn clips() -> Dataset {
    let sequences = (0..4).map(|i| Box::new(Moving(i)) as Box<dyn Sequence>).collect();
    Dataset { name: "moving".into(), sequences }
}
