//! What a bundle says about itself.

use crate::spec::{ModelSpec, SpecError, TrackerParams};
use crate::tracker::MotionPrior;
use serde::{Deserialize, Serialize};

/// The manifest: borrowed from the file's bytes, no allocation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest<'a> {
    /// Name of the model, as in `nano`.
    pub name: &'a str,
    /// Shape of the network and preprocessing.
    pub spec: ModelSpec,
    /// Thresholds the model was tuned with.
    pub tracker: TrackerParams,
    /// Sensors the model has seen in training.
    pub trained_on: TrainedOn,
    /// Map from score to probability, when one was fitted.
    pub calibration: Option<ScoreCalibration>,
    /// Where the weights come from.
    #[serde(borrow)]
    pub provenance: Provenance<'a>,
    /// Measured figures, as printed by `tsda info`.
    pub figures: heapless::Vec<Figure<'a>, 32>,
    /// SPDX expression or a sentence, for the weights (not the code).
    pub licence: &'a str,
    /// The model card, Markdown.
    pub card: &'a str,
    /// Where everything else is in the file.
    pub sections: heapless::Vec<Section, 16>,
    /// Which numbers the weights are stored in and what that costs, when it is not 32-bit floats
    /// throughout. Stands behind the rest of the manifest, in files of format version 2.
    #[serde(skip)]
    pub precision: Option<Precision<'a>>,
    /// What the last frame says about the next one, when the model was tuned with such a prior.
    /// Stands where [`Self::precision`] does.
    #[serde(skip)]
    pub motion: Option<MotionPrior>,
}

impl<'a> Manifest<'a> {
    /// Of a network that nothing else is known of: the reference's thresholds, no calibration,
    /// figures, card or motion prior, licence "none".
    pub fn new(name: &'a str, spec: ModelSpec) -> Self {
        Self {
            name,
            spec,
            tracker: TrackerParams::default(),
            trained_on: TrainedOn::default(),
            calibration: None,
            provenance: Provenance::default(),
            figures: heapless::Vec::new(),
            licence: "none",
            card: "",
            sections: heapless::Vec::new(),
            precision: None,
            motion: None,
        }
    }
}

/// What a file of format version 2 has behind the manifest of version 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Trailer<'a> {
    #[serde(borrow)]
    pub precision: Option<Precision<'a>>,
    pub motion: Option<MotionPrior>,
}

/// Narrow numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Numbers {
    /// Weights and activations of products in 8 bits, everything else in 32-bit floats.
    Int8,
    /// Weights stored as 16-bit floats, computed with as 32-bit ones.
    Half,
    /// Both: what is not in 8 bits is stored in 16.
    Int8Half,
}

impl Numbers {
    /// Whether products are computed in bytes.
    pub const fn has_bytes(self) -> bool {
        matches!(self, Self::Int8 | Self::Int8Half)
    }
}

impl core::fmt::Display for Numbers {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Int8 => "int8",
            Self::Half => "f16 weights",
            Self::Int8Half => "int8, f16 weights elsewhere",
        })
    }
}

/// How a network of 32-bit floats was made narrower.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Precision<'a> {
    /// Which numbers.
    pub numbers: Numbers,
    /// Products in bytes, over all graphs.
    pub layers: u32,
    /// Products with constant weights that stay in floats, over all graphs.
    pub kept: u32,
    /// What the ranges of activations were measured on; empty when there are none.
    pub data: &'a str,
    /// Frames of it.
    pub frames: u32,
    /// CRC-32 of the weights section before.
    pub from_crc: u32,
    /// Figures before and after.
    #[serde(borrow)]
    pub losses: heapless::Vec<Loss<'a>, 24>,
}

/// One figure of the tracker before and after.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Loss<'a> {
    /// What was measured, on what.
    pub name: &'a str,
    /// With 32-bit floats.
    pub before: f32,
    /// With the narrower numbers.
    pub after: f32,
}

impl Manifest<'_> {
    /// How far an engine may be off the stored reference outputs: rounding to bytes turns the last
    /// bit of a sum into a step now and then.
    pub fn probe_tolerance(&self) -> f32 {
        match &self.precision {
            Some(p) if p.numbers.has_bytes() => Self::BYTE_TOLERANCE,
            _ => 1e-4,
        }
    }

    /// See [`Self::probe_tolerance`].
    pub const BYTE_TOLERANCE: f32 = 5e-2;
}

/// Sensors seen in training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrainedOn {
    /// Visible light.
    pub rgb: bool,
    /// Long-wave infrared.
    pub thermal: bool,
    /// Templates of one sensor against searches of the other.
    pub cross_modal: bool,
}

/// Logistic map from the score to the probability that the box is right:
/// `1 / (1 + exp(-(slope * score + bias)))`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoreCalibration {
    /// Slope.
    pub slope: f32,
    /// Bias.
    pub bias: f32,
}

impl ScoreCalibration {
    /// Probability of a right box at this score, in `[0, 1]`.
    pub fn probability(&self, score: f32) -> f32 {
        1.0 / (1.0 + libm::expf(-(self.slope * score + self.bias)))
    }

    /// Checks that a higher score never means a lower probability.
    ///
    /// # Errors
    /// Names the field that is out of range.
    pub fn validate(&self) -> Result<(), SpecError> {
        if !(self.slope.is_finite() && self.slope > 0.0) {
            let (field, want) = ("calibration.slope", "a finite number above 0");
            return Err(SpecError { field, value: self.slope, want });
        }
        if !self.bias.is_finite() {
            let (field, want) = ("calibration.bias", "a finite number");
            return Err(SpecError { field, value: self.bias, want });
        }
        Ok(())
    }
}

/// How the weights were made.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance<'a> {
    /// Program and version that trained them.
    pub trainer: &'a str,
    /// The resolved training configuration, TOML.
    pub config: &'a str,
    /// Random seed of the run.
    pub seed: u64,
    /// Optimiser steps taken.
    pub steps: u64,
    /// Data sources and their licences, one per line.
    pub data: &'a str,
    /// CRC-32 of the weights file the bundle was built from.
    pub weights_crc: u32,
}

/// One measured figure.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figure<'a> {
    /// What was measured, on what.
    pub name: &'a str,
    /// The value.
    pub value: f32,
}

/// What a section holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub enum SectionKind {
    /// ONNX graph crop -> head feature; its weights are external data in [`SectionKind::Weights`].
    FeaturesOnnx,
    /// ONNX graph head feature, label, ltrb -> what a template slot keeps.
    TemplateOnnx,
    /// ONNX graph slots of this many templates, search feature -> score map, ltrb map.
    PredictOnnx(u8),
    /// Raw little-endian tensors, each 64-byte aligned; the graphs' external data.
    Weights,
    /// Reference outputs of the trainer's own network, see `probe`.
    Probe,
}

impl core::fmt::Display for SectionKind {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::FeaturesOnnx => f.write_str("features.onnx"),
            Self::TemplateOnnx => f.write_str("template.onnx"),
            Self::PredictOnnx(n) => write!(f, "predict{n}.onnx"),
            Self::Weights => f.write_str(super::WEIGHTS_FILE),
            Self::Probe => f.write_str("probe.bin"),
        }
    }
}

/// One entry of the table of contents.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Section {
    /// What it holds.
    pub kind: SectionKind,
    /// Start, in bytes from the start of the file; a multiple of 64.
    pub offset: u64,
    /// Length in bytes.
    pub length: u64,
    /// CRC-32 (IEEE) of the bytes.
    pub crc: u32,
}
