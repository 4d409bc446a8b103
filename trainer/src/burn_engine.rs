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
