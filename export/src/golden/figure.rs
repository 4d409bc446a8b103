//! What the names of golden figures mean: which value of the network, which part of it, and how
//! close is close.

use super::error::GoldenError;
use std::path::Path;
use tsda_runtime::ModelSpec;
use tsda_trainer::import::StateTensor;
use tsda_trainer::model::inspect::Mode;

/// One forward pass of spec 1.7.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Pass {
    /// Tracking or training mode.
    pub mode: Mode,
    /// Templates per sequence.
    pub templates: usize,
    /// Which sequences; one in tracking mode.
    pub sequences: Vec<usize>,
}

/// How far a figure may be off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Tolerance {
    /// This much.
    Absolute(f32),
    /// This share of the figure's largest value, or of `at_least` if that is more.
    Relative {
        /// Share.
        share: f32,
        /// Smallest reference size.
        at_least: f32,
    },
}

impl Tolerance {
    /// The bound for a figure whose largest value is `peak`.
    pub fn bound(self, peak: f32) -> f32 {
        match self {
            Self::Absolute(bound) => bound,
            Self::Relative { share, at_least } => share * peak.max(at_least),
        }
    }
}

/// Scores, filters, encoder output and everything inside the transformer.
const HEAD: Tolerance = Tolerance::Absolute(2e-5);
/// Head feature after its norm: 1e-6 for ToMP, whose feature has an RMS of 1/16, and in proportion
/// for narrower networks, whose RMS `1 / sqrt(d)` is larger (spec 1.3).
fn feature(spec: &ModelSpec) -> Tolerance {
    Tolerance::Absolute(1e-6 * (16.0 / f32::from(spec.width).sqrt()).max(1.0))
}
/// Maps whose size depends on the weights.
const MAP: Tolerance = Tolerance::Relative { share: 2e-6, at_least: 0.0 };
/// Distances: exponentials, so rounding grows with the value where it is above 1.
const BOXES: Tolerance = Tolerance::Relative { share: 2e-5, at_least: 1.0 };
/// Values of the box tower and before its exponential.
const TOWER: Tolerance = Tolerance::Relative { share: 2e-5, at_least: 1.0 };
/// Positional code: sines of single-precision angles.
const CODE: Tolerance = Tolerance::Absolute(2e-6);
const EXACT: Tolerance = Tolerance::Absolute(0.0);

/// A golden tensor and what it is.
#[derive(Clone, Debug)]
pub struct Figure {
    /// Name in the file.
    pub name: String,
    /// The reference.
    pub reference: StateTensor,
    /// What it is a part of.
    pub place: Place,
}

/// Where a figure is found among the values of a pass.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// `parallelN` or `singleN` before the name.
    pub scope: Option<Scope>,
    /// Name among the values; see [`tsda_trainer::model::inspect`].
    pub key: String,
    /// One template of several, where the name says so (`train0.layer3`).
    pub template: Option<usize>,
    /// Every n-th channel.
    pub channel_step: usize,
    /// Every n-th token.
    pub token_step: usize,
    /// How close is close.
    pub tolerance: Tolerance,
}

/// A pass as a name states it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scope {
    /// Tracking or training mode.
    pub mode: Mode,
    /// Templates.
    pub templates: usize,
}

impl Place {
    /// What a name says; nothing for a name this version does not know.
    pub fn parse(name: &str, spec: &ModelSpec) -> Option<Self> {
        let (scope, rest) = match name.split_once('.') {
            Some((first, rest)) => match Scope::parse(first) {
                Some(scope) => (Some(scope), rest),
                None => (None, name),
            },
            None => (None, name),
        };
        let (mut channel_step, mut token_step) = (1, 1);
        let mut base = rest;
        while let Some((before, last)) = base.rsplit_once('.') {
            let step = |kind: &str| {
                last.strip_prefix(kind)
                    .and_then(|s| s.strip_prefix("_step"))
                    .and_then(|n| n.parse::<usize>().ok())
                    .filter(|n| *n > 0)
            };
            match (step("ch"), step("tok")) {
                (Some(n), _) => channel_step = n,
                (_, Some(n)) => token_step = n,
                _ => break,
            }
            base = before;
        }
        let (key, template) = canonical(base.strip_prefix("inter.").unwrap_or(base));
        let tolerance = tolerance(&key, spec)?;
        Some(Self { scope, key, template, channel_step, token_step, tolerance })
    }

    /// Whether the value depends on the crops alone, not on the pass.
    pub fn is_feature(&self) -> bool {
        self.key.starts_with("test.") || self.key.starts_with("train.")
    }

    /// The part of `value` that the figure of this shape holds.
    ///
    /// # Errors
    /// When no part of it has this shape; both shapes are in the text.
    pub fn part(&self, value: &StateTensor, reference: &[usize]) -> Result<Vec<f32>, String> {
        let mut view = View { shape: value.shape.clone(), values: value.values.clone() };
        let whole = value.shape.clone();
        let fail = || Err(format!("shape {reference:?} is no such part of {whole:?}"));
        if let Some(i) = self.template {
            if view.shape.first().is_none_or(|n| i >= *n) {
                return fail();
            }
            view.pick(0, i);
        }
        let rank = view.shape.len();
        let map = rank >= 3 && !self.key.contains("coder.") && self.key != "enc.ltrb_mlp";
        let (channels, tokens) = match self.key.as_str() {
            "enc.ltrb_mlp" => (rank.checked_sub(2), rank.checked_sub(1)),
            key if key.starts_with("encoder.key_padding") => (None, Some(1)),
            key if key.starts_with("encoder.") => (rank.checked_sub(1), Some(0)),
            _ if map => (rank.checked_sub(3), None),
            _ => (rank.checked_sub(1), None),
        };
        for (axis, step) in [(channels, self.channel_step), (tokens, self.token_step)] {
            match axis {
                Some(axis) => view.every(axis, step),
                None if step > 1 => return fail(),
                None => {}
            }
        }
        // Large maps are also thinned out in rows and columns, without a word in the name.
        if let ([.., h, w], true) = (reference, map) {
            for (axis, want) in [(view.shape.len() - 2, *h), (view.shape.len() - 1, *w)] {
                let have = view.shape[axis];
                let step = have.div_ceil(want.max(1)).max(1);
                if have != want && have.div_ceil(step) == want {
                    view.every(axis, step);
                }
            }
        }
        // Both rows of the encoder's input are equal; files may hold one.
        let rows = matches!(self.key.as_str(), "encoder.input" | "encoder.pos");
        if rows && squeezed(reference).len() < squeezed(&view.shape).len() && view.shape.len() == 3
        {
            view.pick(1, 0);
        }
        if squeezed(&view.shape) == squeezed(reference) { Ok(view.values) } else { fail() }
    }
}

impl Scope {
    /// `parallel2`, `parallel3_2gt`, `single2`.
    fn parse(text: &str) -> Option<Self> {
        let number = |s: &str| s.parse::<usize>().ok().filter(|n| *n > 0);
        if let Some(rest) = text.strip_prefix("parallel") {
            let (templates, annotated) = match rest.split_once('_') {
                Some((n, gt)) => (number(n)?, number(gt.strip_suffix("gt")?)?),
                None => (number(rest)?, 1),
            };
            return Some(Self { mode: Mode::Parallel { annotated }, templates });
        }
        let templates = number(text.strip_prefix("single")?)?;
        Some(Self { mode: Mode::Single, templates })
    }
}

/// The name the values go by, and one template if the name means one.
fn canonical(base: &str) -> (String, Option<usize>) {
    match base {
        "encoder_input" => return ("encoder.input".into(), None),
        "pos" => return ("encoder.pos".into(), None),
        "ltrb_mlp" => return ("enc.ltrb_mlp".into(), None),
        _ => {}
    }
    // `test_feat`, `test.layer3`, `train.head_feat`, `train0.layer3`, `train.bb.layer1`.
    let split = base.find(['.', '_']).map(|at| (&base[..at], &base[at + 1..]));
    let Some((who, what)) = split else { return (base.into(), None) };
    let (who, template) = match who.strip_prefix("train") {
        Some("") => ("train", None),
        Some(digits) => match digits.parse() {
            Ok(i) => ("train", Some(i)),
            Err(_) => return (base.into(), None),
        },
        None if who == "test" => ("test", None),
        None => return (base.into(), None),
    };
    let what = match what {
        "feat" | "head_feat" => "head.feat",
        "stem_maxpool" | "maxpool" => "bb.maxpool",
        "layer1" => "bb.layer1",
        "layer2" => "bb.layer2",
        "layer3" => "bb.layer3",
        "head_conv" => "head.conv",
        other => other,
    };
    (format!("{who}.{what}"), template)
}

/// The tolerance of a known value; nothing for a name that is none.
fn tolerance(key: &str, spec: &ModelSpec) -> Option<Tolerance> {
    let known = match key {
        "ltrb" => BOXES,
        "scores" | "cls_filter" | "reg_filter" | "cls_enc" | "reg_enc" | "cls.filter_proj"
        | "reg.filter_proj" | "enc.ltrb_mlp" | "encoder.input" | "encoder.last"
        | "decoder.norm" => HEAD,
        "reg.tower" | "reg.pre_exp" => TOWER,
        "encoder.pos" => CODE,
        "encoder.key_padding_mask" => EXACT,
        _ => {
            if let Some(what) = key.strip_prefix("test.").or_else(|| key.strip_prefix("train.")) {
                return match what {
                    "head.feat" => Some(feature(spec)),
                    "bb.maxpool" | "bb.layer1" | "bb.layer2" | "bb.layer3" | "head.conv" => {
                        Some(MAP)
                    }
                    _ => None,
                };
            }
            let (layers, kinds, rest): (u8, &[&str], &str) =
                match (key.strip_prefix("encoder.layer"), key.strip_prefix("decoder.layer")) {
                    (Some(rest), _) => (spec.encoder_layers, &["attn"], rest),
                    (_, Some(rest)) => (spec.decoder_layers, &["self_attn", "cross_attn"], rest),
                    _ => return None,
                };
            let (index, kind) = match rest.split_once('.') {
                Some((index, kind)) => (index, Some(kind)),
                None => (rest, None),
            };
            if index.parse::<u8>().ok()? >= layers || kind.is_some_and(|k| !kinds.contains(&k)) {
                return None;
            }
            HEAD
        }
    };
    Some(known)
}

/// Whether a name belongs to a training step, which is compared elsewhere.
pub fn is_training(name: &str) -> bool {
    ["grad.", "after.", "after_step."].iter().any(|p| name.starts_with(p))
        || matches!(name, "loss" | "loss_clf" | "loss_giou" | "mIoU" | "mIoU_pred_center")
}

/// A shape without its sides of 1.
fn squeezed(shape: &[usize]) -> Vec<usize> {
    shape.iter().copied().filter(|n| *n != 1).collect()
}

/// Largest absolute difference; infinite where one of the two is no number or the lengths differ.
pub fn difference(got: &[f32], want: &[f32]) -> f32 {
    if got.len() != want.len() {
        return f32::INFINITY;
    }
    got.iter().zip(want).fold(0.0, |max: f32, (a, b)| {
        let off = (a - b).abs();
        if off.is_finite() || a == b {
            max.max(if a == b { 0.0 } else { off })
        } else {
            f32::INFINITY
        }
    })
}

/// Largest absolute value.
pub fn peak(values: &[f32]) -> f32 {
    values.iter().fold(0.0, |max: f32, v| max.max(v.abs()))
}

/// A tensor being cut down.
struct View {
    shape: Vec<usize>,
    values: Vec<f32>,
}

impl View {
    /// Keeps the places of `axis` that pass.
    fn keep(&mut self, axis: usize, kept: &[usize]) {
        let inner: usize = self.shape[axis + 1..].iter().product();
        let side = self.shape[axis];
        let outer: usize = self.shape[..axis].iter().product();
        let mut values = Vec::with_capacity(outer * kept.len() * inner);
        for o in 0..outer {
            for i in kept {
                let start = (o * side + i) * inner;
                values.extend_from_slice(&self.values[start..start + inner]);
            }
        }
        self.values = values;
        self.shape[axis] = kept.len();
    }

    fn every(&mut self, axis: usize, step: usize) {
        if step > 1 {
            let kept: Vec<usize> = (0..self.shape[axis]).step_by(step).collect();
            self.keep(axis, &kept);
        }
    }

    /// Keeps one place of an axis, and drops the axis.
    fn pick(&mut self, axis: usize, index: usize) {
        self.keep(axis, &[index]);
        self.shape.remove(axis);
    }
}

/// The filter size a head feature was normed with: its RMS is `1 / (sqrt(d) k)` (spec 1.3).
pub fn filter_size_of(feature: &[f32], spec: &ModelSpec) -> Option<u8> {
    let energy: f64 = feature.iter().map(|v| f64::from(*v).powi(2)).sum();
    let rms = (energy / feature.len().max(1) as f64).sqrt();
    let k = 1.0 / (rms * f64::from(spec.width).sqrt());
    let whole = k.round();
    // A part of the channels has about the RMS of the whole.
    ((1.0..=9.0).contains(&whole) && (k / whole - 1.0).abs() < 0.15).then_some(whole as u8)
}

/// A number from 1 that a file states.
pub fn number(path: &Path, what: &str, value: &str) -> Result<usize, GoldenError> {
    value.trim().parse().ok().filter(|n| *n > 0).ok_or_else(|| GoldenError::Statement {
        path: path.into(),
        what: what.into(),
        value: value.into(),
        expected: "a whole number from 1".into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(name: &str) -> Place {
        Place::parse(name, &ModelSpec::TOMP101).unwrap_or_else(|| panic!("{name} is not known"))
    }

    #[test]
    fn names_say_what_part_of_which_value_they_are() {
        for (name, key, scope, template, steps) in [
            ("parallel2.scores", "scores", Some((Some(1), 2)), None, (1, 1)),
            ("single7.ltrb", "ltrb", Some((None, 7)), None, (1, 1)),
            ("parallel3_2gt.reg_enc.ch_step4", "reg_enc", Some((Some(2), 3)), None, (4, 1)),
            ("train0.layer3.ch_step64", "train.bb.layer3", None, Some(0), (64, 1)),
            ("test.stem_maxpool.ch_step8", "test.bb.maxpool", None, None, (8, 1)),
            ("inter.encoder.layer1.attn", "encoder.layer1.attn", None, None, (1, 1)),
            ("pos.tok_step9", "encoder.pos", None, None, (1, 9)),
            ("encoder_input.tok_step9.ch_step2", "encoder.input", None, None, (2, 9)),
            ("test_feat", "test.head.feat", None, None, (1, 1)),
        ] {
            let p = place(name);
            let stated = p.scope.map(|s| match s.mode {
                Mode::Parallel { annotated } => (Some(annotated), s.templates),
                Mode::Single => (None, s.templates),
            });
            assert_eq!((p.key.as_str(), stated, p.template), (key, scope, template), "{name}");
            assert_eq!((p.channel_step, p.token_step), steps, "{name}");
        }
        for unknown in [
            "parallel2.score",
            "encoder.layer6",
            "encoder.layer0.self_attn",
            "decoder.layer0.attn",
            "test.layer4",
            "train.x",
            "trainx.layer3",
            "scores.step2",
            "parallel0.scores",
        ] {
            assert!(Place::parse(unknown, &ModelSpec::TOMP101).is_none(), "{unknown}");
        }
    }

    #[test]
    fn parts_are_cut_out_of_values() {
        let value = |shape: &[usize]| StateTensor {
            shape: shape.into(),
            values: (0..shape.iter().product::<usize>()).map(|v| v as f32).collect(),
        };
        let part = |name: &str, shape: &[usize], reference: &[usize]| {
            place(name).part(&value(shape), reference)
        };
        assert_eq!(part("cls_filter", &[1, 3, 1, 1], &[3]).unwrap(), [0.0, 1.0, 2.0]);
        // Two of four channels, every third row and column.
        let found = part("test.layer1.ch_step2", &[1, 4, 6, 6], &[2, 2, 2]).unwrap();
        assert_eq!(found, [0.0, 3.0, 18.0, 21.0, 72.0, 75.0, 90.0, 93.0]);
        let found = part("train1.layer3", &[2, 1, 2, 2], &[1, 2, 2]).unwrap();
        assert_eq!(found, [4.0, 5.0, 6.0, 7.0]);
        // Row 0 of two.
        let found = part("encoder_input.tok_step2", &[4, 2, 1], &[2, 1]).unwrap();
        assert_eq!(found, [0.0, 4.0]);
        let found = part("encoder.layer0.tok_step2", &[4, 2, 1], &[2, 2, 1]).unwrap();
        assert_eq!(found, [0.0, 1.0, 4.0, 5.0]);
        for (name, shape, reference) in [
            ("cls_filter", &[1, 3, 1, 1][..], &[4][..]),
            ("train5.layer3", &[2, 1, 2, 2], &[1, 2, 2]),
            ("encoder.layer0", &[4, 2, 1], &[4, 1]),
            ("scores.tok_step2", &[1, 1, 4, 4], &[1, 1, 2, 2]),
        ] {
            assert!(part(name, shape, reference).is_err(), "{name}");
        }
    }

    #[test]
    fn differences_that_are_no_numbers_are_infinite() {
        assert_eq!(difference(&[1.0, 2.5], &[1.0, 2.0]), 0.5);
        assert_eq!(difference(&[f32::NEG_INFINITY], &[f32::NEG_INFINITY]), 0.0);
        for (got, want) in [(&[f32::NAN][..], &[0.0][..]), (&[0.0], &[f32::NAN]), (&[], &[0.0])] {
            assert_eq!(difference(got, want), f32::INFINITY);
        }
    }
}
