//! The burn model behind the runtime's [`Engine`] trait, so that validation during training and
//! parity tests drive the very same tracker as a board does.

use crate::model::TrackerNet;
use burn::module::Module;
use burn::prelude::*;
use tsda_runtime::engine::{EngineError, Maps, Stage, TemplateInput};
use tsda_runtime::{Engine, ModelSpec};

/// Runs a [`TrackerNet`] frame by frame.
#[derive(Debug)]
pub struct BurnEngine {
    net: TrackerNet,
    device: Device,
    crop: Vec<f32>,
    label: Vec<f32>,
    ltrb: Vec<f32>,
    feature: Option<Tensor<4>>,
    slots: Vec<Option<Tensor<2>>>,
    scores: Vec<f32>,
    boxes: Vec<f32>,
}

const NAME: &str = "burn";

impl BurnEngine {
    /// An engine on a snapshot of `net`, without autodiff and dropout, on the net's own device.
    pub fn new(net: &TrackerNet) -> Self {
        let net = net.valid();
        let spec = *net.spec();
        let device = net.devices().into_iter().next().unwrap_or_else(Device::flex);
        let cells = spec.cells();
        Self {
            device: device.inner(),
            crop: vec![0.0; spec.crop_len()],
            label: vec![0.0; cells],
            ltrb: vec![0.0; 4 * cells],
            feature: None,
            slots: vec![None; spec.templates.into()],
            scores: vec![0.0; cells],
            boxes: vec![0.0; 4 * cells],
            net,
        }
    }

    fn tensor<const D: usize>(&self, values: &[f32], shape: [usize; D]) -> Tensor<D> {
        Tensor::from_data(TensorData::new(values.to_vec(), shape), &self.device)
    }

    fn current_feature(&self, stage: Stage) -> Result<Tensor<4>, EngineError> {
        self.feature.clone().ok_or_else(|| {
            EngineError::new(NAME, stage, format_args!("no head feature yet: call features first"))
        })
    }
}

/// Copies a tensor into a buffer of its size.
fn read<const D: usize>(
    tensor: Tensor<D>,
    into: &mut [f32],
    stage: Stage,
) -> Result<(), EngineError> {
    let error = |detail: &dyn std::fmt::Display| {
        EngineError::new(NAME, stage, format_args!("cannot read the output: {detail}"))
    };
    let data = tensor.try_into_data().map_err(|e| error(&e))?;
    let values = data.as_slice::<f32>().map_err(|_| error(&"it is not f32"))?;
    if values.len() != into.len() {
        return Err(error(&format_args!("{} values instead of {}", values.len(), into.len())));
    }
    into.copy_from_slice(values);
    Ok(())
}

impl Engine for BurnEngine {
    fn spec(&self) -> &ModelSpec {
        self.net.spec()
    }

    fn name(&self) -> &'static str {
        NAME
    }

    fn crop_mut(&mut self) -> &mut [f32] {
        &mut self.crop
    }

    fn features(&mut self) -> Result<(), EngineError> {
        let side = self.spec().crop_side();
        let crop = self.tensor(&self.crop, [1, 3, side, side]);
        self.feature = Some(self.net.features(crop));
        Ok(())
    }

    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        TemplateInput { label: &mut self.label, ltrb: &mut self.ltrb }
    }

    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        let slots = self.slots.len();
        if slot >= slots {
            let detail = format_args!("slot {slot} does not exist, the network has {slots}");
            return Err(EngineError::new(NAME, Stage::Template, detail));
        }
        let feature = self.current_feature(Stage::Template)?;
        let side = self.spec().map_side();
        let label = self.tensor(&self.label, [side, side]);
        let ltrb = self.tensor(&self.ltrb, [4, side, side]);
        self.slots[slot] = Some(self.net.template(feature, label, ltrb));
        Ok(())
    }

    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        let error =
            |detail: std::fmt::Arguments<'_>| Err(EngineError::new(NAME, Stage::Predict, detail));
        let slots = self.slots.len();
        if filled == 0 || filled > slots {
            return error(format_args!("{filled} filled slots, must be 1 to {slots}"));
        }
        let Some(templates) = self.slots[..filled].iter().cloned().collect::<Option<Vec<_>>>()
        else {
            return error(format_args!("one of slots 0 to {} was never written", filled - 1));
        };
        let feature = self.current_feature(Stage::Predict)?;
        let (scores, boxes) = self.net.predict(templates, feature);
        read(scores, &mut self.scores, Stage::Predict)?;
        read(boxes, &mut self.boxes, Stage::Predict)?;
        Ok(Maps { scores: &self.scores, ltrb: &self.boxes })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::NetOptions;

    fn engine() -> BurnEngine {
        let spec = ModelSpec {
            crop: 32,
            width: 16,
            feed_forward: 16,
            encoder_layers: 1,
            decoder_layers: 1,
            ..ModelSpec::NANO
        };
        let device = Device::flex().autodiff();
        device.seed(7);
        BurnEngine::new(&TrackerNet::new(&spec, &NetOptions::default(), &device).unwrap())
    }

    #[test]
    fn a_frame_runs_as_the_trait_says() {
        let mut engine = engine();
        engine.crop_mut().iter_mut().enumerate().for_each(|(i, v)| *v = (i % 7) as f32 - 3.0);
        engine.features().unwrap();
        let input = engine.template_input_mut();
        input.label.fill(0.5);
        input.ltrb.fill(0.1);
        engine.write_template(0).unwrap();
        let one = engine.predict(1).unwrap();
        assert_eq!((one.scores.len(), one.ltrb.len()), (4, 16));
        assert!(one.scores.iter().all(|v| v.is_finite()));
        assert!(one.ltrb.iter().all(|v| *v > 0.0));
        let (scores, ltrb) = (one.scores.to_vec(), one.ltrb.to_vec());

        // A second template changes the scores, but never the boxes (spec 1.7).
        engine.template_input_mut().label.fill(0.0);
        engine.write_template(1).unwrap();
        let two = engine.predict(2).unwrap();
        assert_ne!(two.scores, scores);
        assert_eq!(two.ltrb, ltrb);
    }

    #[test]
    fn wrong_calls_are_errors() {
        let mut engine = engine();
        assert_eq!(engine.write_template(0).unwrap_err().stage, Stage::Template);
        engine.features().unwrap();
        assert_eq!(engine.write_template(2).unwrap_err().stage, Stage::Template);
        for filled in [0, 1, 3] {
            let error = engine.predict(filled).map(|_| ()).unwrap_err();
            assert_eq!(error.stage, Stage::Predict, "{filled}");
        }
    }
}
