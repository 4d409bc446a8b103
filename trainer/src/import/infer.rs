//! What network a set of tensors belongs to.
//!
//! Nearly everything can be read off shapes and names. What cannot, the filter size (quirk Q1) and
//! the number of heads, comes from the constructor's arguments in pytracking files, else from the
//! preset or configuration given, else from the preset whose shapes the tensors have.

use super::torch::Constructor;
use super::{StateDict, WeightsError};
use crate::config::{ConfigError, ModelConfig};
use tsda_runtime::{Backbone, ModelSpec, TrackerParams};

/// Presets whose shapes files are compared with.
const PRESETS: [&str; 6] = ["tomp101", "tomp50", "nano", "pico", "pico-v3", "small"];

/// What the user says about the network.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Given {
    /// Nothing.
    #[default]
    Nothing,
    /// A preset: shapes must agree; filter size and test-frame embedding are the file's.
    Preset(String),
    /// The `[model]` table of a configuration: every field that is written there must agree.
    Config(Box<ModelConfig>),
}

impl Given {
    /// How messages call it.
    fn name(&self) -> String {
        match self {
            Self::Nothing => "the default".into(),
            Self::Preset(name) => format!("preset {name}"),
            Self::Config(_) => "the configuration".into(),
        }
    }

    /// The specification, if there is one.
    ///
    /// # Errors
    /// When the preset is unknown or a field is out of range.
    pub fn spec(&self) -> Result<Option<ModelSpec>, WeightsError> {
        Ok(match self {
            Self::Nothing => None,
            Self::Preset(name) => {
                let config = ModelConfig { preset: Some(name.clone()), ..ModelConfig::default() };
                Some(config.spec()?)
            }
            Self::Config(config) => Some(config.spec()?),
        })
    }

    /// Does it leave this field to the file?
    fn leaves_open(&self, field: &str) -> bool {
        match self {
            Self::Nothing => true,
            Self::Preset(_) => matches!(field, "filter_size" | "test_embedding"),
            Self::Config(config) => match field {
                "filter_size" => config.filter_size.is_none(),
                "test_embedding" => config.test_embedding.is_none(),
                _ => false,
            },
        }
    }
}

/// A specification, and where each of its fields comes from.
#[derive(Clone, Debug, PartialEq)]
pub struct Inferred {
    /// The network.
    pub spec: ModelSpec,
    /// Field, value, origin.
    pub origins: Vec<(&'static str, String, String)>,
}

/// Name and value of every field, in the order of the struct.
pub fn spec_fields(spec: &ModelSpec) -> [(&'static str, String); 15] {
    let backbone = match spec.backbone {
        Backbone::EfficientNetLite0 => "EfficientNet-Lite0".into(),
        Backbone::ResNet { base_channels, blocks: [a, b, c] } => {
            format!("ResNet, {base_channels} channels, blocks {a}-{b}-{c}")
        }
        Backbone::NanoTrackV2 => "NanoTrack v2".into(),
        Backbone::NanoTrackV3 => "NanoTrack v3".into(),
    };
    [
        ("backbone", backbone),
        ("crop", spec.crop.to_string()),
        ("search_factor", spec.search_factor.to_string()),
        ("width", spec.width.to_string()),
        ("heads", spec.heads.to_string()),
        ("feed_forward", spec.feed_forward.to_string()),
        ("encoder_layers", spec.encoder_layers.to_string()),
        ("decoder_layers", spec.decoder_layers.to_string()),
        ("ltrb_hidden", spec.ltrb_hidden.to_string()),
        ("filter_size", spec.filter_size.to_string()),
        ("test_embedding", spec.test_embedding.to_string()),
        ("templates", spec.templates.to_string()),
        ("label_sigma", spec.label_sigma.to_string()),
        ("input_mean", format!("{:?}", spec.input_mean)),
        ("input_std", format!("{:?}", spec.input_std)),
    ]
}

/// Largest index `i` of names `prefix.i.rest`, plus one.
fn count(dict: &StateDict, prefix: &str, rest: &str) -> Option<u8> {
    dict.names()
        .filter_map(|name| name.strip_prefix(prefix)?.strip_suffix(rest)?.parse::<u8>().ok())
        .max()?
        .checked_add(1)
}

/// First extent of a tensor.
fn rows(dict: &StateDict, name: &str) -> Option<u16> {
    u16::try_from(*dict.get(name)?.shape.first()?).ok()
}

/// The backbone whose tensors start with `prefix`, if it is one of the family's.
pub fn backbone(dict: &StateDict, prefix: &str) -> Option<Backbone> {
    let at = |name: &str| format!("{prefix}{name}");
    if dict.get(&at("_conv_stem.weight")).is_some() {
        return Some(Backbone::EfficientNetLite0);
    }
    if dict.get(&at("features.1.conv.0.weight")).is_some() {
        let ninth = dict.names().any(|name| name.starts_with(&at("features.9.")));
        return Some(if ninth { Backbone::NanoTrackV3 } else { Backbone::NanoTrackV2 });
    }
    let base_channels = rows(dict, &at("conv1.weight"))?;
    let stage = |n| count(dict, &at(&format!("layer{n}.")), ".conv3.weight");
    Some(Backbone::ResNet { base_channels, blocks: [stage(1)?, stage(2)?, stage(3)?] })
}

/// What shapes and names say; `None` where the tensors for it are missing.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    backbone: Option<Backbone>,
    width: Option<u16>,
    feed_forward: Option<u16>,
    encoder_layers: Option<u8>,
    decoder_layers: Option<u8>,
    ltrb_hidden: Option<u16>,
    test_embedding: bool,
}

impl Seen {
    fn new(dict: &StateDict) -> Self {
        const PREDICTOR: &str = "head.filter_predictor";
        let layers = |part: &str| {
            let prefix = format!("{PREDICTOR}.transformer.{part}.layers.");
            count(dict, &prefix, ".linear1.weight")
        };
        let first = format!("{PREDICTOR}.transformer.encoder.layers.0.linear1.weight");
        Self {
            backbone: backbone(dict, "feature_extractor."),
            width: rows(dict, "head.feature_extractor.0.weight"),
            feed_forward: rows(dict, &first),
            encoder_layers: layers("encoder"),
            decoder_layers: layers("decoder"),
            ltrb_hidden: rows(dict, &format!("{PREDICTOR}.box_encoding.0.weight")),
            test_embedding: dict.get(&format!("{PREDICTOR}.query_embed_test.weight")).is_some(),
        }
    }

    /// `base` with everything seen put in.
    fn over(&self, base: &ModelSpec) -> ModelSpec {
        ModelSpec {
            backbone: self.backbone.unwrap_or(base.backbone),
            width: self.width.unwrap_or(base.width),
            feed_forward: self.feed_forward.unwrap_or(base.feed_forward),
            encoder_layers: self.encoder_layers.unwrap_or(base.encoder_layers),
            decoder_layers: self.decoder_layers.unwrap_or(base.decoder_layers),
            ltrb_hidden: self.ltrb_hidden.unwrap_or(base.ltrb_hidden),
            test_embedding: self.test_embedding,
            ..*base
        }
    }

    /// Fields that were seen.
    fn fields(&self) -> Vec<&'static str> {
        [
            ("backbone", self.backbone.is_some()),
            ("width", self.width.is_some()),
            ("feed_forward", self.feed_forward.is_some()),
            ("encoder_layers", self.encoder_layers.is_some()),
            ("decoder_layers", self.decoder_layers.is_some()),
            ("ltrb_hidden", self.ltrb_hidden.is_some()),
            ("test_embedding", true),
        ]
        .into_iter()
        .filter_map(|(field, seen)| seen.then_some(field))
        .collect()
    }
}

/// A positive whole number among the arguments, under any of these names.
fn argument<T: TryFrom<u64>>(constructor: &Constructor, names: &[&str]) -> Option<T> {
    let value = names.iter().find_map(|name| constructor.kwargs.get(*name))?;
    T::try_from(value.as_u64().filter(|v| *v > 0)?).ok()
}

/// Checks what no tensor shows, the stored specification of some weights against the one they are to
/// be used with; `by` is how messages call the latter.
///
/// # Errors
/// Names the first field that differs.
pub fn check_hidden(stored: &ModelSpec, wanted: &ModelSpec, by: &str) -> Result<(), WeightsError> {
    for ((field, file), (_, wanted)) in spec_fields(stored).into_iter().zip(spec_fields(wanted)) {
        if file != wanted && matches!(field, "heads" | "filter_size" | "input_mean" | "input_std") {
            return Err(WeightsError::Conflict { field, file, wanted, by: by.into() });
        }
    }
    Ok(())
}

/// The `[model]` and `[tracker]` tables of an imported network, as TOML.
///
/// # Errors
/// When a value has no TOML form (none of a valid specification).
pub fn model_toml(spec: &ModelSpec, tracker: &TrackerParams) -> Result<String, ConfigError> {
    #[derive(serde::Serialize)]
    struct Tables<'a> {
        model: ModelConfig,
        tracker: &'a TrackerParams,
    }
    toml::to_string(&Tables { model: ModelConfig::from_spec(None, spec), tracker })
        .map_err(|e| ConfigError::Write { reason: e.to_string() })
}

/// The network of these tensors.
///
/// # Errors
/// When the file contradicts what was given, or nothing says how many heads there are.
pub fn infer(
    dict: &StateDict,
    constructor: Option<&Constructor>,
    stored: Option<&ModelSpec>,
    given: &Given,
) -> Result<Inferred, WeightsError> {
    let seen = Seen::new(dict);
    let of_given = given.spec()?;
    let preset = PRESETS.iter().find_map(|name| {
        let spec = ModelSpec::preset(name)?;
        let same = ModelSpec { test_embedding: spec.test_embedding, ..seen.over(&spec) } == spec;
        same.then_some((*name, spec))
    });
    let (base, base_name) = match (of_given, stored, preset) {
        (Some(spec), ..) => (spec, given.name()),
        (None, Some(spec), _) => (*spec, "the file's metadata".into()),
        (None, None, Some((name, spec))) => (spec, format!("preset {name}, whose shapes it has")),
        (None, None, None) => match seen.backbone {
            Some(Backbone::EfficientNetLite0) => (ModelSpec::NANO, "preset nano".into()),
            Some(Backbone::NanoTrackV2) => (ModelSpec::PICO, "preset pico".into()),
            Some(Backbone::NanoTrackV3) => (ModelSpec::PICO_V3, "preset pico-v3".into()),
            _ => (ModelSpec::TOMP50, "preset tomp50".into()),
        },
    };
    let mut spec = seen.over(&base);
    // Field and origin of everything the file itself says.
    let mut known: Vec<(&'static str, &str)> =
        seen.fields().into_iter().map(|field| (field, "tensors")).collect();
    if let Some(stored) = stored {
        // Shapes were seen; these are what they do not show.
        let hidden = ModelSpec { backbone: spec.backbone, width: spec.width, ..*stored };
        spec = seen.over(&hidden);
        let names = spec_fields(&spec).map(|(name, _)| name);
        let hidden = names.into_iter().filter(|name| !known.iter().any(|(k, _)| k == name));
        known.extend(hidden.collect::<Vec<_>>().into_iter().map(|name| (name, "metadata")));
    }
    if let Some(c) = constructor {
        const HEADS: [&str; 4] = ["nhead", "nheads", "n_heads", "num_heads"];
        // The first positional argument of pytracking's constructors is the filter size.
        let positional = c.args.first().and_then(|v| u8::try_from(v.as_u64()?).ok());
        if let Some(k) = argument(c, &["filter_size"]).or(positional.filter(|k| *k > 0)) {
            spec.filter_size = k;
            known.push(("filter_size", "constructor"));
        }
        if let Some(heads) = argument(c, &HEADS) {
            spec.heads = heads;
            known.push(("heads", "constructor"));
        }
        let side: Option<u16> = argument(c, &["feature_sz"]);
        if let Some(crop) = side.and_then(|side| side.checked_mul(ModelSpec::STRIDE as u16)) {
            spec.crop = crop;
            known.push(("crop", "constructor"));
        }
    }
    let is_known = |field: &str| known.iter().any(|(k, _)| *k == field);
    if !is_known("heads") && of_given.is_none() && preset.is_none() {
        return Err(WeightsError::Heads { width: spec.width });
    }
    if let Some(wanted) = &of_given {
        for ((field, file), (_, wanted)) in spec_fields(&spec).into_iter().zip(spec_fields(wanted))
        {
            if file != wanted && is_known(field) && !given.leaves_open(field) {
                let by = given.name();
                return Err(WeightsError::Conflict { field, file, wanted, by });
            }
        }
    }
    spec.validate()?;
    let origins = spec_fields(&spec)
        .into_iter()
        .map(|(field, value)| {
            let origin = known.iter().rev().find(|(k, _)| *k == field);
            (field, value, origin.map_or_else(|| base_name.clone(), |(_, o)| (*o).to_owned()))
        })
        .collect();
    Ok(Inferred { spec, origins })
}
