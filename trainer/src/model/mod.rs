//! The network, as a burn module (spec 1).
//!
//! [`TrackerNet`] is the only definition of the network: its three inference functions are what
//! the exporter records, and training is written around the same parts. For one crop
//!
//! 1. [`TrackerNet::features`] turns a crop into a head feature,
//! 2. [`TrackerNet::template`] turns a head feature with label and box into what a slot keeps,
//! 3. [`TrackerNet::predict`] turns filled slots and a search feature into maps;
//!
//! [`TrackerNet::forward_train`] is the single pass of spec 1.7 over a batch.
//!
//! # Devices
//! A net made on `Device::flex().autodiff()` trains (dropout and the batch statistics of the box
//! MLP are active); its [`valid`](burn::module::Module::valid) snapshot, or a net made on
//! `Device::flex()`, infers. To record graphs: `net.valid().to_device(&capture_device)`, then call
//! the inference functions with tensors of that device.
//!
//! # Parameters
//! Paths of parameters in burn start with `feature_extractor.` (backbone) and `head.`, which is
//! what learning-rate groups match. Files carry PyTorch state-dict names instead:
//! [`crate::import`] converts ([`state_dict_name`]).
//!
//! # Speed
//! On the CPU, training takes another road than inference through the convolutions: batch-wide maps
//! and the operations of `kernels`. Numbers and gradients are the same (tested);
//! `cargo bench -p tsda-trainer --bench throughput` measures a step, and
//! `scripts/torch_throughput.py` the same network in PyTorch (figures: docs/training.md).
//!
//! Frozen layers ([`FreezePolicy`]) run outside autodiff and keep no graph. Batch norms of the
//! backbone never update their statistics; they are folded into the convolutions before them in
//! every mode.

mod backbone;
mod efficientnet;
mod head;
pub mod inspect;
mod kernels;
mod layers;
mod mobilenet;
mod names;
mod pooled;
mod resnet;
#[cfg(test)]
pub(crate) mod tests;
mod transformer;

pub use backbone::FreezePolicy;
pub use names::{Layout, state_dict_name};

use backbone::BackboneNet;
use burn::prelude::*;
use head::Head;
pub(crate) use transformer::linear_layer;
use tsda_runtime::{ModelSpec, SpecError};

/// Settings of a net that matter only in training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NetOptions {
    /// Share of transformer activations dropped, 0 to below 1; 0.1 in ToMP.
    pub dropout: f64,
    /// Share of attention weights dropped, 0 to below 1; 0.1 in ToMP. Drawing the masks costs a
    /// noticeable part of a CPU training step.
    pub attention_dropout: f64,
    /// Which layers of the backbone do not train.
    pub freeze: FreezePolicy,
}

impl Default for NetOptions {
    fn default() -> Self {
        Self { dropout: 0.1, attention_dropout: 0.1, freeze: FreezePolicy::default() }
    }
}

/// What a template slot keeps from frame to frame (spec 4.2). Both forms give the same maps; the
/// default is what networks are exported with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SlotForm {
    /// Tokens, `(F*F, d)`.
    Tokens,
    /// Tokens with their queries (divided by the root of a head's depth), keys and values in the
    /// first encoder layer, positional code and biases included, side by side: `(F*F, 4d)`. Less
    /// work even if every frame is remembered: one frame's projections at the memory write against
    /// one per filled slot and search frame.
    #[default]
    Projected,
}

impl SlotForm {
    /// Columns of a slot.
    pub fn columns(self, spec: &ModelSpec) -> usize {
        let d = usize::from(spec.width);
        match self {
            Self::Tokens => d,
            Self::Projected => 4 * d,
        }
    }
}

/// The tracker's network; see the module documentation.
#[derive(Module, Debug)]
pub struct TrackerNet {
    feature_extractor: BackboneNet,
    head: Head,
    #[module(skip)]
    spec: ModelSpec,
    frozen: usize,
}

/// What a training pass gives.
#[derive(Clone, Debug)]
pub struct TrainOutput {
    /// Score maps of the search frames, `(B, F, F)`.
    pub scores: Tensor<3>,
    /// Distances of the search frames, `(B, 4, F, F)`, positive, in crop sides.
    pub ltrb: Tensor<4>,
    /// Head features of the templates before any encoding, `(B, T, d, F, F)`; what modality
    /// alignment compares.
    pub template_features: Tensor<5>,
    /// Head features of the search frames before any encoding, `(B, d, F, F)`.
    pub search_features: Tensor<4>,
    /// The encoder's outputs, `(B, (T + 1) * F*F, d)`: the templates frame by frame, then the search
    /// frame.
    pub memory: Tensor<3>,
}

impl TrackerNet {
    /// A net with random weights (backbone: PyTorch's default initialisation; see
    /// [`crate::import`] for pretrained ones). Randomness comes from `device.seed`.
    ///
    /// # Errors
    /// When `spec` is not valid or a dropout is outside `0..1`.
    pub fn new(spec: &ModelSpec, options: &NetOptions, device: &Device) -> Result<Self, SpecError> {
        spec.validate()?;
        for (field, value) in
            [("dropout", options.dropout), ("attention_dropout", options.attention_dropout)]
        {
            if !(0.0..1.0).contains(&value) {
                let want = "a number from 0 to below 1";
                return Err(SpecError { field, value: value as f32, want });
            }
        }
        let net = Self {
            feature_extractor: BackboneNet::new(&spec.backbone, device),
            head: Head::new(spec, options.dropout, options.attention_dropout, device),
            spec: *spec,
            frozen: options.freeze.frozen_groups(&spec.backbone),
        };
        Ok(options.freeze.apply(net, &spec.backbone))
    }

    /// The network's shape.
    pub fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    /// Head features `(B, d, F, F)` of crops `(B, 3, S, S)`, R, G, B, normalised
    /// `(value / 255 - mean) / std`.
    pub fn features(&self, crop: Tensor<4>) -> Tensor<4> {
        self.head.feature(self.feature_extractor.forward(crop, self.frozen))
    }

    /// What a slot keeps of a template, from its head feature `(1, d, F, F)`, the Gaussian label
    /// `(F, F)` and the box as distances `(4, F, F)` in crop sides (spec 1.4): `(F*F, 4d)`, the
    /// default [`SlotForm`].
    pub fn template(&self, feature: Tensor<4>, label: Tensor<2>, ltrb: Tensor<3>) -> Tensor<2> {
        self.template_as(SlotForm::default(), feature, label, ltrb)
    }

    /// [`Self::template`] in a form of choice.
    pub fn template_as(
        &self,
        form: SlotForm,
        feature: Tensor<4>,
        label: Tensor<2>,
        ltrb: Tensor<3>,
    ) -> Tensor<2> {
        let [_, d, f, _] = feature.dims();
        let tokens = self.head.template_tokens(
            feature,
            label.reshape([1, f, f]),
            ltrb.reshape([1, 4, f, f]),
        );
        match form {
            SlotForm::Tokens => tokens.reshape([f * f, d]),
            SlotForm::Projected => self.head.prepare(tokens, f).reshape([f * f, 4 * d]),
        }
    }

    /// Score map `(F, F)` and distances `(4, F, F)` of a search feature `(1, d, F, F)` against the
    /// filled slots in any [`SlotForm`], slot 0 (the annotated frame) first: the tracking mode of
    /// spec 1.7, with the box row as a second, shorter sequence (spec 4.3.1). What a frame
    /// contributes to the first encoder layer is computed once for both.
    ///
    /// # Panics
    /// When `templates` is empty; [`crate::burn_engine::BurnEngine`] checks.
    pub fn predict(&self, templates: Vec<Tensor<2>>, search: Tensor<4>) -> (Tensor<2>, Tensor<3>) {
        let parts = self.predict_parts(templates, search);
        (parts.scores, parts.ltrb)
    }

    /// Filled slots in any [`SlotForm`] and a search feature `(1, d, F, F)` as frames
    /// `(1, F*F, 4d)`, the search frame last: tokens with their projections in the first encoder
    /// layer.
    fn prepared(&self, templates: Vec<Tensor<2>>, search: Tensor<4>) -> Vec<Tensor<3>> {
        let [_, d, side, _] = search.dims();
        let prepare = |slot: Tensor<2>| {
            let width = slot.dims()[1];
            let slot = slot.unsqueeze_dim::<3>(0);
            if width == d { self.head.prepare(slot, side) } else { slot }
        };
        let search = self.head.prepare(self.head.search_tokens(search), side);
        templates.into_iter().map(prepare).chain([search]).collect()
    }

    /// The single pass of spec 1.7 over `B` sequences of `T` templates and one search frame.
    ///
    /// * `template_crops`: `(B*T, 3, S, S)`, sequence by sequence;
    /// * `search_crops`: `(B, 3, S, S)`;
    /// * `labels`: `(B*T, F, F)`, the templates' Gaussian labels;
    /// * `ltrb`: `(B*T, 4, F, F)`, the templates' boxes (spec 2.4).
    pub fn forward_train(
        &self,
        template_crops: Tensor<4>,
        search_crops: Tensor<4>,
        labels: Tensor<3>,
        ltrb: Tensor<4>,
    ) -> TrainOutput {
        let bt = template_crops.dims()[0];
        let b = search_crops.dims()[0];
        let t = bt / b;
        let crops = Tensor::cat(vec![template_crops, search_crops], 0);
        let features = self.training_features(crops);
        let [_, d, f, _] = features.dims();
        let template_features = features.clone().narrow(0, 0, bt);
        let search_features = features.narrow(0, bt, b);
        let templates = self
            .head
            .template_tokens(template_features.clone(), labels, ltrb)
            .reshape([b, t * f * f, d]);
        let search = self.head.search_tokens(search_features.clone());
        let (filter, memory) = self.head.predict_filter(Tensor::cat(vec![templates, search], 1), f);
        let encoded = memory.clone().narrow(1, t * f * f, f * f);
        TrainOutput {
            scores: self.head.scores(filter.clone(), encoded.clone(), f),
            ltrb: self.head.ltrb(filter, encoded, f),
            template_features: template_features.reshape([b, t, d, f, f]),
            search_features,
            memory,
        }
    }

    /// [`Self::features`] by the fastest road of the device.
    fn training_features(&self, crops: Tensor<4>) -> Tensor<4> {
        let device = self.head.device();
        if device.is_autodiff() && kernels::supports(&device) {
            self.head.feature_wide(self.feature_extractor.forward_wide(crops, self.frozen))
        } else {
            self.features(crops)
        }
    }
}
