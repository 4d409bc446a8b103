//! What a network looks like and how the tracker behaves around it, as plain values.
//!
//! A [`ModelSpec`] describes every network of the family; presets are values, never code paths.
//! Both structs are `Copy`, hold no strings and travel unchanged in TOML (training configuration)
//! and postcard (bundle manifest).

use serde::{Deserialize, Serialize};

/// The feature extractor, cut at stride 16.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Backbone {
    /// EfficientNet-Lite0 up to its last stride-16 stage (112 channels out). No squeeze-excite,
    /// ReLU6, batch-norm eps 1e-3, TensorFlow "SAME" padding.
    EfficientNetLite0,
    /// Bottleneck ResNet up to its third stage (spec 1.2).
    ResNet {
        /// Channels of the stem and width of the first stage; 64 in ResNet-50/101.
        base_channels: u16,
        /// Bottleneck blocks in stages one to three.
        blocks: [u8; 3],
    },
    /// The backbone of NanoTrack v2: MobileNetV3-small up to its last stride-16 block (48 channels
    /// out). Squeeze-excite, ReLU and hard-swish, batch-norm eps 1e-5, symmetric padding. Wants
    /// [`RAW_MEAN`] and [`RAW_STD`].
    // New variants go to the end: bundles hold the index.
    #[serde(rename = "nanotrack_v2")]
    NanoTrackV2,
    /// The backbone of NanoTrack v3: one block more than v2, at stride 16 too (96 channels out).
    #[serde(rename = "nanotrack_v3")]
    NanoTrackV3,
}

impl Backbone {
    /// Channels of the stride-16 feature map.
    pub const fn out_channels(&self) -> usize {
        match self {
            Self::EfficientNetLite0 => 112,
            Self::ResNet { base_channels, .. } => *base_channels as usize * 16,
            Self::NanoTrackV2 => 48,
            Self::NanoTrackV3 => 96,
        }
    }

    /// Mean and divisor of the pictures its published weights were trained on, as
    /// [`ModelSpec::input_mean`] and [`ModelSpec::input_std`].
    pub const fn input_statistics(&self) -> ([f32; 3], [f32; 3]) {
        match self {
            Self::EfficientNetLite0 | Self::ResNet { .. } => (IMAGENET_MEAN, IMAGENET_STD),
            Self::NanoTrackV2 | Self::NanoTrackV3 => (RAW_MEAN, RAW_STD),
        }
    }
}

impl core::fmt::Display for Backbone {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::EfficientNetLite0 => f.write_str("EfficientNet-Lite0 to stride 16"),
            Self::ResNet { base_channels, blocks } => {
                write!(f, "ResNet, {base_channels} channels, blocks {blocks:?}")
            }
            Self::NanoTrackV2 => f.write_str("MobileNetV3 of NanoTrack v2, 48 channels"),
            Self::NanoTrackV3 => f.write_str("MobileNetV3 of NanoTrack v3, 96 channels"),
        }
    }
}

/// Everything that fixes the shape and the arithmetic of a network.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelSpec {
    /// Feature extractor.
    pub backbone: Backbone,
    /// Side `S` of the square input crop, in pixels; a multiple of [`Self::STRIDE`].
    pub crop: u16,
    /// Side of the crop in image, over the square root of the target's area (5 in ToMP).
    pub search_factor: f32,
    /// Width `d` of head feature and transformer.
    pub width: u16,
    /// Attention heads; divides `width`.
    pub heads: u8,
    /// Hidden width of the transformer's feed-forward layers.
    pub feed_forward: u16,
    /// Encoder layers.
    pub encoder_layers: u8,
    /// Decoder layers.
    pub decoder_layers: u8,
    /// Hidden width of the first layer of the box-encoding MLP (spec 1.4); 64 in ToMP.
    pub ltrb_hidden: u16,
    /// "Filter size" `k`, which acts only through the norm scale `1/sqrt(d k^2)` (quirk Q1).
    pub filter_size: u8,
    /// Whether the search tokens carry a learned embedding (quirk Q2).
    pub test_embedding: bool,
    /// Template slots the predict graphs are made for; slot 0 is the annotated frame.
    pub templates: u8,
    /// Sigma of the Gaussian label as a fraction of the target's side (0.25 in ToMP).
    pub label_sigma: f32,
    /// Mean subtracted from `value / 255`, R, G, B.
    pub input_mean: [f32; 3],
    /// Divisor after the mean, R, G, B.
    pub input_std: [f32; 3],
}

/// Most template slots a network of the family can have.
pub const MAX_TEMPLATES: usize = 8;

/// ImageNet statistics, as in ToMP (spec 1.1).
pub const IMAGENET_MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// See [`IMAGENET_MEAN`].
pub const IMAGENET_STD: [f32; 3] = [0.229, 0.224, 0.225];

/// With [`RAW_STD`]: values 0 to 255 as they are, as NanoTrack's backbones want them.
pub const RAW_MEAN: [f32; 3] = [0.0; 3];
/// See [`RAW_MEAN`].
pub const RAW_STD: [f32; 3] = [1.0 / 255.0; 3];

impl ModelSpec {
    /// Pixels of the crop per cell of the map; the same for the whole family.
    pub const STRIDE: usize = 16;

    /// CPU boards; the model that ships in the repository.
    pub const NANO: Self = Self {
        backbone: Backbone::EfficientNetLite0,
        crop: 160,
        search_factor: 4.0,
        width: 128,
        heads: 4,
        feed_forward: 256,
        encoder_layers: 2,
        decoder_layers: 2,
        ltrb_hidden: 32,
        filter_size: 1,
        test_embedding: true,
        templates: 2,
        label_sigma: 0.25,
        input_mean: IMAGENET_MEAN,
        input_std: IMAGENET_STD,
    };

    /// [`Self::NANO`] on the backbone of NanoTrack v2: the least work.
    pub const PICO: Self = Self {
        backbone: Backbone::NanoTrackV2,
        input_mean: RAW_MEAN,
        input_std: RAW_STD,
        ..Self::NANO
    };

    /// [`Self::NANO`] on the backbone of NanoTrack v3.
    pub const PICO_V3: Self = Self { backbone: Backbone::NanoTrackV3, ..Self::PICO };

    /// Names that [`Self::preset`] knows.
    pub const PRESETS: [&str; 6] = ["nano", "pico", "pico-v3", "tomp50", "tomp101", "small"];

    /// ToMP-101, the paper's tracker (spec 1).
    pub const TOMP101: Self = Self {
        backbone: Backbone::ResNet { base_channels: 64, blocks: [3, 4, 23] },
        crop: 288,
        search_factor: 5.0,
        width: 256,
        heads: 8,
        feed_forward: 2048,
        encoder_layers: 6,
        decoder_layers: 6,
        ltrb_hidden: 64,
        ..Self::NANO
    };

    /// ToMP-50.
    pub const TOMP50: Self = Self {
        backbone: Backbone::ResNet { base_channels: 64, blocks: [3, 4, 6] },
        ..Self::TOMP101
    };

    /// The small network of the golden figures: every part of ToMP at a size that a test runs in
    /// moments.
    pub const SMALL: Self = Self {
        backbone: Backbone::ResNet { base_channels: 16, blocks: [2, 2, 3] },
        crop: 144,
        search_factor: 5.0,
        width: 64,
        heads: 4,
        feed_forward: 128,
        encoder_layers: 2,
        decoder_layers: 2,
        ltrb_hidden: 16,
        ..Self::NANO
    };

    /// The preset of this name, if there is one.
    pub fn preset(name: &str) -> Option<Self> {
        match name {
            "nano" => Some(Self::NANO),
            "pico" => Some(Self::PICO),
            "pico-v3" => Some(Self::PICO_V3),
            "tomp50" => Some(Self::TOMP50),
            "tomp101" => Some(Self::TOMP101),
            "small" => Some(Self::SMALL),
            _ => None,
        }
    }

    /// Side `S` of the crop.
    pub const fn crop_side(&self) -> usize {
        self.crop as usize
    }

    /// Side `F` of the feature and score maps.
    pub const fn map_side(&self) -> usize {
        self.crop as usize / Self::STRIDE
    }

    /// Cells of a map, `F * F`: tokens per frame.
    pub const fn cells(&self) -> usize {
        self.map_side() * self.map_side()
    }

    /// Length of the crop tensor `(3, S, S)`.
    pub const fn crop_len(&self) -> usize {
        3 * self.crop as usize * self.crop as usize
    }

    /// Sigma of the Gaussian label in cells (spec 2.4): `label_sigma / search_factor * F`.
    pub fn label_sigma_cells(&self) -> f32 {
        self.label_sigma / self.search_factor * self.map_side() as f32
    }

    /// Checks every field against what the family can be.
    ///
    /// # Errors
    /// Names the first field that is out of range, with its value and the range.
    pub fn validate(&self) -> Result<(), SpecError> {
        let bad = |field, value: f32, want| Err(SpecError { field, value, want });
        if self.crop == 0 || !self.crop_side().is_multiple_of(Self::STRIDE) || self.crop > 1024 {
            return bad("crop", self.crop.into(), "a multiple of 16 from 16 to 1024");
        }
        if !(self.search_factor.is_finite() && (1.5..=16.0).contains(&self.search_factor)) {
            return bad("search_factor", self.search_factor, "a number from 1.5 to 16");
        }
        if self.width == 0 || !self.width.is_multiple_of(4) {
            return bad("width", self.width.into(), "a positive multiple of 4");
        }
        if self.heads == 0 || !self.width.is_multiple_of(self.heads.into()) {
            return bad("heads", self.heads.into(), "a divisor of width");
        }
        for (field, value) in [
            ("feed_forward", self.feed_forward),
            ("encoder_layers", self.encoder_layers.into()),
            ("decoder_layers", self.decoder_layers.into()),
            ("ltrb_hidden", self.ltrb_hidden),
            ("filter_size", self.filter_size.into()),
        ] {
            if value == 0 {
                return bad(field, 0.0, "at least 1");
            }
        }
        if !(1..=MAX_TEMPLATES).contains(&self.templates.into()) {
            return bad("templates", self.templates.into(), "1 to 8");
        }
        if !(self.label_sigma.is_finite() && self.label_sigma > 0.0) {
            return bad("label_sigma", self.label_sigma, "a positive number");
        }
        for v in self.input_mean {
            if !v.is_finite() {
                return bad("input_mean", v, "finite numbers");
            }
        }
        for v in self.input_std {
            if !(v.is_finite() && v > 0.0) {
                return bad("input_std", v, "positive numbers");
            }
        }
        if let Backbone::ResNet { base_channels, blocks } = self.backbone {
            if base_channels == 0 {
                return bad("backbone.base_channels", 0.0, "at least 1");
            }
            if blocks.contains(&0) {
                return bad("backbone.blocks", 0.0, "at least 1 block per stage");
            }
        }
        Ok(())
    }
}

/// A field of a [`ModelSpec`] or [`TrackerParams`] that cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{field} = {value} cannot be used: it must be {want}")]
pub struct SpecError {
    /// Name of the field.
    pub field: &'static str,
    /// Its value.
    pub value: f32,
    /// What it may be.
    pub want: &'static str,
}

/// Thresholds of the online tracker (spec 3.1). Sizes and distances follow the spec's conventions.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackerParams {
    /// Score under which the target counts as not found.
    pub not_found: f32,
    /// A second peak above this share of the first makes the frame uncertain or a hard negative.
    pub distractor: f32,
    /// A second peak above this share of the first (and above `not_found`) makes a hard negative.
    pub hard_negative: f32,
    /// Side of the block masked around the first peak, in target sizes.
    pub neighbourhood: f32,
    /// Largest credible displacement, as a share of half the map.
    pub displacement: f32,
    /// Score above which a frame is written to the memory.
    pub write_confidence: f32,
    /// Smallest reported side, in pixels.
    pub min_size: f32,
    /// Largest factor by which a crop may shrink to stay inside the picture ("inside_major").
    pub max_scale_change: f32,
    /// Consecutive frames without the target after which the state is `Lost`.
    pub lost_after: u16,
}

impl Default for TrackerParams {
    fn default() -> Self {
        Self {
            not_found: 0.25,
            distractor: 0.8,
            hard_negative: 0.5,
            neighbourhood: 2.2,
            displacement: 0.8,
            write_confidence: 0.9,
            min_size: 10.0,
            max_scale_change: 1.5,
            lost_after: 30,
        }
    }
}

impl TrackerParams {
    /// Checks every field.
    ///
    /// # Errors
    /// Names the first field that is out of range, with its value and the range.
    pub fn validate(&self) -> Result<(), SpecError> {
        for (field, value, low) in [
            ("not_found", self.not_found, 0.0),
            ("distractor", self.distractor, 0.0),
            ("hard_negative", self.hard_negative, 0.0),
            ("neighbourhood", self.neighbourhood, 0.0),
            ("displacement", self.displacement, 0.0),
            ("write_confidence", self.write_confidence, 0.0),
            ("min_size", self.min_size, 1.0),
            ("max_scale_change", self.max_scale_change, 1.0),
        ] {
            if !(value.is_finite() && value >= low) {
                let want = if low > 0.0 {
                    "a finite number of at least 1"
                } else {
                    "a finite number, not negative"
                };
                return Err(SpecError { field, value, want });
            }
        }
        if self.lost_after == 0 {
            return Err(SpecError { field: "lost_after", value: 0.0, want: "at least 1" });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_valid_and_named() {
        for name in ModelSpec::PRESETS {
            ModelSpec::preset(name).unwrap().validate().unwrap();
        }
        assert!(ModelSpec::preset("tomp").is_none());
        assert_eq!(ModelSpec::TOMP101.map_side(), 18);
        assert_eq!(ModelSpec::TOMP101.backbone.out_channels(), 1024);
        assert!((ModelSpec::TOMP101.label_sigma_cells() - 0.9).abs() < 1e-6);
    }

    #[test]
    fn a_bad_field_is_named() {
        type Change = fn(&mut ModelSpec);
        let cases: [(&str, Change); 7] = [
            ("crop", |s| s.crop = 150),
            ("search_factor", |s| s.search_factor = f32::NAN),
            ("heads", |s| s.heads = 5),
            ("templates", |s| s.templates = 0),
            ("input_std", |s| s.input_std[1] = 0.0),
            ("feed_forward", |s| s.feed_forward = 0),
            ("label_sigma", |s| s.label_sigma = -1.0),
        ];
        for (field, change) in cases {
            let mut spec = ModelSpec::NANO;
            change(&mut spec);
            assert_eq!(spec.validate().unwrap_err().field, field);
        }
        let params = TrackerParams { write_confidence: f32::INFINITY, ..Default::default() };
        assert_eq!(params.validate().unwrap_err().field, "write_confidence");
    }
}
