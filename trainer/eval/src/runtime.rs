//! The runtime's own tracker, on any engine, as something to evaluate.

use tsda_runtime::tracker::Tracker;
use tsda_runtime::{BBox, Engine, Modality};

use crate::dataset::Picture;
use crate::protocol::{TrackerError, TrackerUnderTest};

/// A [`Tracker`] with a name for reports. It follows changes of the picture's size
/// ([`Tracker::follow_size`]), as the programs do.
#[derive(Debug)]
pub struct RuntimeTracker<E> {
    name: String,
    tracker: Tracker<E>,
    /// Of the frame before: sensors may differ in resolution.
    size: (usize, usize),
    last: BBox,
}

impl<E: Engine> RuntimeTracker<E> {
    /// `name` stands in tables and result files, for instance the bundle's name and the engine's.
    pub fn new(name: impl Into<String>, tracker: Tracker<E>) -> Self {
        Self { name: name.into(), tracker, size: (0, 0), last: BBox::default() }
    }

    /// The tracker.
    pub const fn tracker(&self) -> &Tracker<E> {
        &self.tracker
    }
}

impl<E: Engine> TrackerUnderTest for RuntimeTracker<E> {
    fn name(&self) -> &str {
        &self.name
    }

    fn init(
        &mut self,
        frame: &Picture,
        bbox: BBox,
        modality: Modality,
    ) -> Result<(), TrackerError> {
        let view = frame.view().map_err(TrackerError::new)?;
        (self.size, self.last) = ((frame.width, frame.height), bbox);
        self.tracker.init(&view, bbox, Some(modality)).map_err(TrackerError::new)
    }

    fn update(&mut self, frame: &Picture, modality: Modality) -> Result<(BBox, f32), TrackerError> {
        let view = frame.view().map_err(TrackerError::new)?;
        let now = (frame.width, frame.height);
        self.tracker.follow_size(self.last, self.size, now).map_err(TrackerError::new)?;
        self.size = now;
        let track = self.tracker.update(&view, Some(modality)).map_err(TrackerError::new)?;
        self.last = track.bbox;
        Ok((track.bbox, track.score))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tsda_runtime::engine::{Maps, TemplateInput};
    use tsda_runtime::{EngineError, ModelSpec, TrackerParams};

    /// Always sees the target in the middle of its map; its box is a quarter crop wide.
    struct Middle {
        spec: ModelSpec,
        crop: Vec<f32>,
        label: Vec<f32>,
        ltrb: Vec<f32>,
        scores: Vec<f32>,
        answer: Vec<f32>,
    }

    impl Middle {
        fn new() -> Self {
            let spec = ModelSpec::NANO;
            let mut scores = vec![0.0; spec.cells()];
            // Of an even number of cells, the tracker puts the target on the lower middle one.
            let middle = (spec.map_side() - 1) / 2;
            scores[middle * spec.map_side() + middle] = 0.9;
            Self {
                crop: vec![0.0; spec.crop_len()],
                label: vec![0.0; spec.cells()],
                ltrb: vec![0.0; 4 * spec.cells()],
                scores,
                answer: vec![0.125; 4 * spec.cells()],
                spec,
            }
        }
    }

    impl Engine for Middle {
        fn spec(&self) -> &ModelSpec {
            &self.spec
        }
        fn name(&self) -> &'static str {
            "middle"
        }
        fn crop_mut(&mut self) -> &mut [f32] {
            &mut self.crop
        }
        fn features(&mut self) -> Result<(), EngineError> {
            Ok(())
        }
        fn template_input_mut(&mut self) -> TemplateInput<'_> {
            TemplateInput { label: &mut self.label, ltrb: &mut self.ltrb }
        }
        fn write_template(&mut self, _: usize) -> Result<(), EngineError> {
            Ok(())
        }
        fn predict(&mut self, _: usize) -> Result<Maps<'_>, EngineError> {
            Ok(Maps { scores: &self.scores, ltrb: &self.answer })
        }
    }

    #[test]
    fn frames_of_both_sensors_reach_the_tracker_and_its_errors_come_back() {
        let tracker = Tracker::new(Middle::new(), TrackerParams::default()).unwrap();
        let mut under_test = RuntimeTracker::new("nano/middle", tracker);
        assert_eq!(under_test.name(), "nano/middle");
        let picture = |channels| Picture {
            width: 320,
            height: 320,
            channels,
            data: vec![90; 320 * 320 * channels],
        };
        let e = under_test.update(&picture(3), Modality::Rgb).unwrap_err().to_string();
        assert!(e.contains("init"), "{e}");
        let first = BBox::new(140.0, 140.0, 40.0, 40.0);
        under_test.init(&picture(3), first, Modality::Rgb).unwrap();
        let (found, score) = under_test.update(&picture(1), Modality::Thermal).unwrap();
        assert_eq!(score, 0.9);
        assert!(found.iou(&first) > 0.9, "{found:?}");
        let empty = Picture { width: 0, ..picture(1) };
        assert!(under_test.update(&empty, Modality::Thermal).is_err());
        let outside = BBox::new(330.0, 60.0, 40.0, 40.0);
        assert!(under_test.init(&picture(3), outside, Modality::Rgb).is_err());
        under_test.init(&picture(3), first, Modality::Rgb).unwrap();
        assert_eq!(under_test.tracker().target().map(|t| t.frame()), Some(0));
    }
}
