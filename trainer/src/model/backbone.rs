//! The feature extractor and which of its layers train.

use super::efficientnet::{BLOCKS, EfficientNetLite0};
use super::mobilenet::{BEFORE_STRIDE16, BLOCKS_V2, BLOCKS_V3, MobileNetV3};
use super::resnet::ResNet;
use burn::module::ParamGroup;
use burn::prelude::*;
use serde::{Deserialize, Serialize};
use tsda_runtime::Backbone;

/// Which leading layers of the backbone stay as they were imported (spec 2.6).
///
/// Batch-norm *statistics* never change in the whole backbone, whatever is chosen here. Frozen
/// layers run outside autodiff and keep no graph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FreezePolicy {
    /// Everything before the stride-16 layers: ResNet stem, layer1 and layer2 (as in ToMP);
    /// EfficientNet stem and blocks 0 to 4; MobileNet stem and blocks 0 to 2.
    #[default]
    BeforeStride16,
    /// Stem and the first `n` groups: stages of a ResNet (0 to 3), blocks of an EfficientNet
    /// (0 to 11) or of NanoTrack's MobileNet (0 to 8 in v2, to 9 in v3). Larger numbers mean all.
    Leading(u8),
    /// The whole backbone.
    All,
    /// Nothing.
    None,
}

impl FreezePolicy {
    /// Leading groups of `backbone` outside autodiff; the stem counts as the first.
    pub(crate) fn frozen_groups(self, backbone: &Backbone) -> usize {
        let (groups, before_stride16) = match backbone {
            Backbone::EfficientNetLite0 => (1 + BLOCKS, 1 + 5),
            Backbone::NanoTrackV2 => (1 + BLOCKS_V2, 1 + BEFORE_STRIDE16),
            Backbone::NanoTrackV3 => (1 + BLOCKS_V3, 1 + BEFORE_STRIDE16),
            Backbone::ResNet { .. } => (1 + 3, 1 + 2),
        };
        match self {
            Self::BeforeStride16 => before_stride16,
            Self::Leading(n) => (1 + usize::from(n)).min(groups),
            Self::All => groups,
            Self::None => 0,
        }
    }

    /// The parameters that do not train, as burn paths: the frozen layers and every running
    /// statistic of the backbone.
    pub fn frozen_parameters(self, backbone: &Backbone) -> Vec<String> {
        let frozen = self.frozen_groups(backbone);
        let mut patterns = vec![r"^feature_extractor\..*running_(mean|var)$".to_string()];
        let (stem, group): (&str, fn(usize) -> String) = match backbone {
            Backbone::EfficientNetLite0 => (r"^feature_extractor\.\w+\.(conv_stem|bn0)\.", |i| {
                format!(r"^feature_extractor\.\w+\.blocks\.{i}\.")
            }),
            Backbone::NanoTrackV2 | Backbone::NanoTrackV3 => {
                (r"^feature_extractor\.\w+\.(stem|bn)\.", |i| {
                    format!(r"^feature_extractor\.\w+\.blocks\.{i}\.")
                })
            }
            Backbone::ResNet { .. } => (r"^feature_extractor\.\w+\.(conv1|bn1)\.", |i| {
                format!(r"^feature_extractor\.\w+\.layer{}\.", i + 1)
            }),
        };
        if frozen > 0 {
            patterns.push(stem.to_string());
            patterns.extend((0..frozen - 1).map(group));
        }
        patterns
    }

    /// Switches gradients off for what [`Self::frozen_parameters`] names.
    pub(crate) fn apply<M: Module>(self, module: M, backbone: &Backbone) -> M {
        self.frozen_parameters(backbone).iter().fold(module, |module, pattern| {
            match ParamGroup::from_regex(pattern) {
                Ok(group) => module.set_require_grad_group(group, false),
                // The patterns are constants of this file; a test compiles each.
                Err(_) => module,
            }
        })
    }
}

/// One of the feature extractors of [`Backbone`].
#[derive(Module, Debug)]
// One per program; the names are the networks' own.
#[allow(clippy::large_enum_variant, clippy::enum_variant_names)]
pub(crate) enum BackboneNet {
    /// See [`EfficientNetLite0`].
    EfficientNet(EfficientNetLite0),
    /// See [`ResNet`].
    ResNet(ResNet),
    /// See [`MobileNetV3`].
    MobileNet(MobileNetV3),
}

impl BackboneNet {
    /// Random weights.
    pub fn new(backbone: &Backbone, device: &Device) -> Self {
        match *backbone {
            Backbone::EfficientNetLite0 => Self::EfficientNet(EfficientNetLite0::new(device)),
            Backbone::NanoTrackV2 => Self::MobileNet(MobileNetV3::new(BLOCKS_V2, device)),
            Backbone::NanoTrackV3 => Self::MobileNet(MobileNetV3::new(BLOCKS_V3, device)),
            Backbone::ResNet { base_channels, blocks } => {
                Self::ResNet(ResNet::new(base_channels.into(), blocks, device))
            }
        }
    }

    /// `(B, 3, S, S)` to `(B, C, S/16, S/16)`.
    pub fn forward(&self, x: Tensor<4>, frozen: usize) -> Tensor<4> {
        match self {
            Self::EfficientNet(net) => net.forward(x, frozen),
            Self::ResNet(net) => net.forward(x, frozen),
            Self::MobileNet(net) => net.forward(x, frozen),
        }
    }

    /// [`Self::forward`] for training on the CPU, as a batch-wide map `(C, B, S/16, S/16)`; see
    /// [`super::kernels`].
    pub fn forward_wide(&self, x: Tensor<4>, frozen: usize) -> Tensor<4> {
        match self {
            Self::EfficientNet(net) if frozen > 0 => net.forward_wide(x, frozen),
            Self::MobileNet(net) if frozen > 0 => net.forward_wide(x, frozen),
            _ => self.forward(x, frozen).permute([1, 0, 2, 3]),
        }
    }
}
