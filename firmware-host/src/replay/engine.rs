//! An engine that answers with maps it is given.

use tsda_runtime::engine::{EngineError, Maps, Stage, TemplateInput};
use tsda_runtime::{Engine, ModelSpec};

/// Keeps what the tracker writes; answers what the script says.
#[derive(Debug)]
pub(super) struct Scripted {
    spec: ModelSpec,
    /// Network input of the last frame, `(3, S, S)`.
    pub crop: Vec<f32>,
    /// Label of the last template, `(F, F)`.
    pub label: Vec<f32>,
    ltrb: Vec<f32>,
    /// Score map and distances for the next `predict`.
    pub answer: (Vec<f32>, Vec<f32>),
    /// Slot of the last template.
    pub slot: Option<usize>,
    /// Filled slots at the last `predict`.
    pub asked: usize,
}

impl Scripted {
    pub(super) fn new(spec: ModelSpec) -> Self {
        let cells = spec.cells();
        Self {
            spec,
            crop: vec![0.0; spec.crop_len()],
            label: vec![0.0; cells],
            ltrb: vec![0.0; 4 * cells],
            answer: (vec![0.0; cells], vec![0.0; 4 * cells]),
            slot: None,
            asked: 0,
        }
    }

    /// Value of the crop at channel, row and column, in grey levels.
    pub(super) fn grey(&self, [c, row, col]: [usize; 3]) -> Option<f32> {
        let side = self.spec.crop_side();
        if c > 2 || row >= side || col >= side {
            return None;
        }
        let v = self.crop.get((c * side + row) * side + col)?;
        Some((v * self.spec.input_std[c] + self.spec.input_mean[c]) * 255.0)
    }

    /// Mean of the crop in grey levels.
    pub(super) fn mean(&self) -> f32 {
        let plane = (self.crop.len() / 3).max(1);
        let (mean, std) = (&self.spec.input_mean, &self.spec.input_std);
        let grey = |(i, v): (usize, &f32)| {
            let c = (i / plane).min(2);
            f64::from(*v) * f64::from(std[c]) + f64::from(mean[c])
        };
        let sum: f64 = self.crop.iter().enumerate().map(grey).sum();
        (255.0 * sum / self.crop.len().max(1) as f64) as f32
    }

    /// Largest value of the label and its flat index, the first of equal ones.
    pub(super) fn label_peak(&self) -> (f32, usize) {
        let first = |(at, max), (i, &v): (usize, &f32)| if v > max { (i, v) } else { (at, max) };
        let (at, max) = self.label.iter().enumerate().fold((0, f32::MIN), first);
        (max, at)
    }
}

impl Engine for Scripted {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    fn name(&self) -> &'static str {
        "scripted"
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

    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        let slots = self.spec.templates;
        if slot >= usize::from(slots) {
            let detail = format_args!("slot {slot} of {slots}");
            return Err(EngineError::new("scripted", Stage::Template, detail));
        }
        self.slot = Some(slot);
        Ok(())
    }

    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        self.asked = filled;
        Ok(Maps { scores: &self.answer.0, ltrb: &self.answer.1 })
    }
}
