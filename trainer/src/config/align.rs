//! The `[align]` table: which training-only alignment losses a run has (paper, sections 3 and 4).

use serde::{Deserialize, Serialize};

/// A row of the paper's ablation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AlignPreset {
    /// No choice: sampling as `[sampler]` says, alignment as the other keys of `[align]` say.
    #[default]
    None,
    /// No cross-modal training at all: training samples have one sensor whatever
    /// `sampler.cross_modal_p` says; validation samples stay as they are for every other row.
    Baseline,
    /// Cross-modal sampling without alignment.
    Cm,
    /// Adversarial, on head features.
    PreAfa,
    /// Contrastive, on head features.
    PreCfa,
    /// Adversarial, on the encoder's outputs.
    EncAfa,
    /// Contrastive, on the encoder's outputs.
    EncCfa,
    /// Adversarial on head features and contrastive on the encoder's outputs (Pre-AFA+Enc-CFA).
    Joint,
}

impl AlignPreset {
    /// Every preset.
    pub const ALL: [Self; 8] = [
        Self::None,
        Self::Baseline,
        Self::Cm,
        Self::PreAfa,
        Self::PreCfa,
        Self::EncAfa,
        Self::EncCfa,
        Self::Joint,
    ];

    /// Name in files and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Baseline => "baseline",
            Self::Cm => "cm",
            Self::PreAfa => "pre-afa",
            Self::PreCfa => "pre-cfa",
            Self::EncAfa => "enc-afa",
            Self::EncCfa => "enc-cfa",
            Self::Joint => "joint",
        }
    }

    /// Stage and weight of its adversarial branch. The paper's pair (0.5, 0.1) is read as weight and
    /// gradient-reversal coefficient.
    fn adversarial(self) -> Option<Adversarial> {
        let branch = |stage, weight| Some(Adversarial { stage, weight, ..Adversarial::default() });
        match self {
            Self::PreAfa => branch(AlignStage::Pre, 0.5),
            Self::EncAfa => branch(AlignStage::Encoder, 0.5),
            Self::Joint => branch(AlignStage::Pre, 0.3),
            _ => None,
        }
    }

    /// Stage and weight of its contrastive branch. The paper's pair (0.1, tau 0.1) is weight and
    /// temperature.
    fn contrastive(self) -> Option<Contrastive> {
        let branch = |stage| Some(Contrastive { stage, ..Contrastive::default() });
        match self {
            Self::PreCfa => branch(AlignStage::Pre),
            Self::EncCfa | Self::Joint => branch(AlignStage::Encoder),
            _ => None,
        }
    }
}

impl std::str::FromStr for AlignPreset {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::ALL
            .into_iter()
            .find(|p| p.name() == name)
            .ok_or_else(|| format!("one of {} is wanted", Self::ALL.map(Self::name).join(", ")))
    }
}

/// Where descriptors are taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlignStage {
    /// Head features, before any encoding is added (spec 1.3).
    #[default]
    Pre,
    /// The encoder's outputs.
    Encoder,
}

/// The adversarial branch, complete.
#[derive(Clone, Debug, PartialEq)]
pub struct Adversarial {
    /// Where its descriptors are taken.
    pub stage: AlignStage,
    /// Weight of the discriminator's loss in the total.
    pub weight: f64,
    /// Gradient-reversal coefficient: the network gets `-reversal` times the gradient.
    pub reversal: f64,
    /// Hidden widths of the discriminator, a ReLU after each; none: a linear one.
    pub hidden: Vec<usize>,
    /// Bring every descriptor to mean 0 and variance 1 first. Head features have a root mean square
    /// of 1/16 or less (spec 1.3), with which a fresh discriminator starts slowly.
    pub normalise: bool,
}

impl Default for Adversarial {
    fn default() -> Self {
        Self {
            stage: AlignStage::Pre,
            weight: 0.5,
            reversal: 0.1,
            hidden: vec![256],
            normalise: false,
        }
    }
}

/// The contrastive branch, complete.
#[derive(Clone, Debug, PartialEq)]
pub struct Contrastive {
    /// Where its descriptors are taken.
    pub stage: AlignStage,
    /// Weight of its loss in the total.
    pub weight: f64,
    /// Similarities are divided by this.
    pub temperature: f64,
    /// Hidden widths of the projection, a ReLU after each; none: a linear one.
    pub hidden: Vec<usize>,
    /// Width of what is compared.
    pub dim: usize,
    /// As [`Adversarial::normalise`]. Without it, the biases of a fresh projection outweigh
    /// descriptors of head features, and all projections look alike.
    pub normalise: bool,
}

impl Default for Contrastive {
    fn default() -> Self {
        Self {
            stage: AlignStage::Encoder,
            weight: 0.1,
            temperature: 0.1,
            hidden: vec![256],
            dim: 128,
            normalise: false,
        }
    }
}

/// `[align.adversarial]`: what differs from the preset's branch, or from [`Adversarial::default`]
/// where the preset has none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdversarialConfig {
    /// See [`Adversarial::stage`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stage: Option<AlignStage>,
    /// See [`Adversarial::weight`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weight: Option<f64>,
    /// See [`Adversarial::reversal`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reversal: Option<f64>,
    /// See [`Adversarial::hidden`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hidden: Option<Vec<usize>>,
    /// See [`Adversarial::normalise`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub normalise: Option<bool>,
}

/// `[align.contrastive]`: what differs from the preset's branch, or from [`Contrastive::default`]
/// where the preset has none.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ContrastiveConfig {
    /// See [`Contrastive::stage`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stage: Option<AlignStage>,
    /// See [`Contrastive::weight`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weight: Option<f64>,
    /// See [`Contrastive::temperature`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub temperature: Option<f64>,
    /// See [`Contrastive::hidden`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hidden: Option<Vec<usize>>,
    /// See [`Contrastive::dim`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dim: Option<usize>,
    /// See [`Contrastive::normalise`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub normalise: Option<bool>,
}

/// The `[align]` table. [`AlignConfig::adversarial`] and [`AlignConfig::contrastive`] say what comes
/// of preset and tables.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AlignConfig {
    /// Row of the ablation to start from.
    pub preset: AlignPreset,
    /// Epochs without alignment; see [`AlignConfig::start_step`] for runs counted in steps.
    pub start_epoch: u64,
    /// Steps without alignment, instead of `start_epoch`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_step: Option<u64>,
    /// Steps over which both weights rise linearly from zero once alignment has started.
    pub ramp_steps: u64,
    /// Starting learning rate of the branches; `optim.lr_head` when not given. Follows the schedule.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lr: Option<f64>,
    /// Adversarial branch; there is one if this table or the preset has it.
    #[serde(rename = "adversarial", skip_serializing_if = "Option::is_none")]
    pub adversarial_table: Option<AdversarialConfig>,
    /// Contrastive branch; there is one if this table or the preset has it.
    #[serde(rename = "contrastive", skip_serializing_if = "Option::is_none")]
    pub contrastive_table: Option<ContrastiveConfig>,
}

impl Default for AlignConfig {
    fn default() -> Self {
        Self {
            preset: AlignPreset::None,
            start_epoch: 5,
            start_step: None,
            ramp_steps: 0,
            lr: None,
            adversarial_table: None,
            contrastive_table: None,
        }
    }
}

impl AlignConfig {
    /// The adversarial branch, if the run has one.
    pub fn adversarial(&self) -> Option<Adversarial> {
        let preset = self.preset.adversarial();
        let Some(table) = &self.adversarial_table else { return preset };
        let base = preset.unwrap_or_default();
        Some(Adversarial {
            stage: table.stage.unwrap_or(base.stage),
            weight: table.weight.unwrap_or(base.weight),
            reversal: table.reversal.unwrap_or(base.reversal),
            hidden: table.hidden.clone().unwrap_or(base.hidden),
            normalise: table.normalise.unwrap_or(base.normalise),
        })
    }

    /// The contrastive branch, if the run has one.
    pub fn contrastive(&self) -> Option<Contrastive> {
        let preset = self.preset.contrastive();
        let Some(table) = &self.contrastive_table else { return preset };
        let base = preset.unwrap_or_default();
        Some(Contrastive {
            stage: table.stage.unwrap_or(base.stage),
            weight: table.weight.unwrap_or(base.weight),
            temperature: table.temperature.unwrap_or(base.temperature),
            hidden: table.hidden.clone().unwrap_or(base.hidden),
            dim: table.dim.unwrap_or(base.dim),
            normalise: table.normalise.unwrap_or(base.normalise),
        })
    }

    /// Has the run any branch?
    pub fn is_on(&self) -> bool {
        self.adversarial().is_some() || self.contrastive().is_some()
    }

    /// Another row of the ablation with everything else equal: the tables, which say what differs
    /// from the preset there was, go with it.
    pub fn select(&mut self, preset: AlignPreset) {
        self.preset = preset;
        self.adversarial_table = None;
        self.contrastive_table = None;
    }

    /// The same with every field of the branches said, for the resolved configuration.
    pub(super) fn expanded(&self) -> Self {
        Self {
            adversarial_table: self.adversarial().map(|b| AdversarialConfig {
                stage: Some(b.stage),
                weight: Some(b.weight),
                reversal: Some(b.reversal),
                hidden: Some(b.hidden),
                normalise: Some(b.normalise),
            }),
            contrastive_table: self.contrastive().map(|b| ContrastiveConfig {
                stage: Some(b.stage),
                weight: Some(b.weight),
                temperature: Some(b.temperature),
                hidden: Some(b.hidden),
                dim: Some(b.dim),
                normalise: Some(b.normalise),
            }),
            ..self.clone()
        }
    }
}
