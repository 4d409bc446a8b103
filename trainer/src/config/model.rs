//! `[model]`: a preset and what differs from it.

use serde::{Deserialize, Serialize};
use tsda_runtime::{Backbone, ModelSpec, SpecError};

/// A preset name plus any field of [`ModelSpec`] to be different.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// `nano` (the default), `pico`, `pico-v3`, `tomp50` or `tomp101`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub preset: Option<String>,
    /// See [`ModelSpec::crop`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crop: Option<u16>,
    /// See [`ModelSpec::search_factor`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub search_factor: Option<f32>,
    /// See [`ModelSpec::width`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width: Option<u16>,
    /// See [`ModelSpec::heads`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub heads: Option<u8>,
    /// See [`ModelSpec::feed_forward`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub feed_forward: Option<u16>,
    /// See [`ModelSpec::encoder_layers`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub encoder_layers: Option<u8>,
    /// See [`ModelSpec::decoder_layers`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub decoder_layers: Option<u8>,
    /// See [`ModelSpec::ltrb_hidden`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ltrb_hidden: Option<u16>,
    /// See [`ModelSpec::filter_size`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filter_size: Option<u8>,
    /// See [`ModelSpec::test_embedding`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub test_embedding: Option<bool>,
    /// See [`ModelSpec::templates`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub templates: Option<u8>,
    /// See [`ModelSpec::label_sigma`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label_sigma: Option<f32>,
    /// See [`ModelSpec::input_mean`]; when not given, the preset's, or what another backbone wants.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub input_mean: Option<[f32; 3]>,
    /// See [`ModelSpec::input_std`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub input_std: Option<[f32; 3]>,
    /// See [`ModelSpec::backbone`]: `"efficient_net_lite0"`, `"nanotrack_v2"`, `"nanotrack_v3"` or
    /// `{ res_net = { base_channels = 64, blocks = [3, 4, 6] } }`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub backbone: Option<Backbone>,
}

impl ModelConfig {
    /// Preset and overrides put together and checked.
    ///
    /// # Errors
    /// When the preset is unknown or a field is out of range.
    pub fn spec(&self) -> Result<ModelSpec, SpecError> {
        let base = match &self.preset {
            None => ModelSpec::NANO,
            Some(name) => ModelSpec::preset(name).ok_or(SpecError {
                field: "preset",
                value: f32::NAN,
                want: "\"nano\", \"pico\", \"pico-v3\", \"tomp50\" or \"tomp101\"",
            })?,
        };
        // Another backbone wants its own input, whatever the preset has.
        let (mean, std) = match self.backbone {
            Some(backbone) if backbone != base.backbone => backbone.input_statistics(),
            _ => (base.input_mean, base.input_std),
        };
        let spec = ModelSpec {
            backbone: self.backbone.unwrap_or(base.backbone),
            crop: self.crop.unwrap_or(base.crop),
            search_factor: self.search_factor.unwrap_or(base.search_factor),
            width: self.width.unwrap_or(base.width),
            heads: self.heads.unwrap_or(base.heads),
            feed_forward: self.feed_forward.unwrap_or(base.feed_forward),
            encoder_layers: self.encoder_layers.unwrap_or(base.encoder_layers),
            decoder_layers: self.decoder_layers.unwrap_or(base.decoder_layers),
            ltrb_hidden: self.ltrb_hidden.unwrap_or(base.ltrb_hidden),
            filter_size: self.filter_size.unwrap_or(base.filter_size),
            test_embedding: self.test_embedding.unwrap_or(base.test_embedding),
            templates: self.templates.unwrap_or(base.templates),
            label_sigma: self.label_sigma.unwrap_or(base.label_sigma),
            input_mean: self.input_mean.unwrap_or(mean),
            input_std: self.input_std.unwrap_or(std),
        };
        spec.validate()?;
        Ok(spec)
    }

    /// The table that says a specification in full.
    pub fn from_spec(preset: Option<String>, spec: &ModelSpec) -> Self {
        Self {
            preset,
            backbone: Some(spec.backbone),
            crop: Some(spec.crop),
            search_factor: Some(spec.search_factor),
            width: Some(spec.width),
            heads: Some(spec.heads),
            feed_forward: Some(spec.feed_forward),
            encoder_layers: Some(spec.encoder_layers),
            decoder_layers: Some(spec.decoder_layers),
            ltrb_hidden: Some(spec.ltrb_hidden),
            filter_size: Some(spec.filter_size),
            test_embedding: Some(spec.test_embedding),
            templates: Some(spec.templates),
            label_sigma: Some(spec.label_sigma),
            input_mean: Some(spec.input_mean),
            input_std: Some(spec.input_std),
        }
    }
}
