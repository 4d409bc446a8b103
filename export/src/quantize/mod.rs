//! Narrower numbers for bundles of floats.
//!
//! 1. [`graph`] finds the products that can be done in bytes and rewrites the ONNX files with
//!    `QuantizeLinear` and `DequantizeLinear` around them, or with weights as 16-bit floats.
//! 2. [`calibrate`] tracks real material with the network of floats and measures the range of every
//!    activation that becomes bytes.
//! 3. [`measure`] evaluates both bundles and tells what was lost.
//!
//! The result is standard ONNX: every engine can run it; the native one does the marked products in
//! bytes.

pub mod calibrate;
pub mod data;
pub mod graph;
pub mod measure;
#[cfg(test)]
mod tests;

use crate::bundle::{self, WriteError};
use crate::onnx::macs::ShapeError;
use calibrate::Roundings;
use graph::{File, Product};
use serde::Serialize;
use tsda_eval::dataset::Dataset;
use tsda_eval::protocol::{EvalError, TrackerError};
use tsda_runtime::EngineError;
use tsda_runtime::bundle::{
    Bundle, BundleError, Loss, Manifest, Numbers, Precision, SectionKind, crc32,
};
use tsda_runtime::engine::{NativeEngine, NativeOptions};
use tsda_runtime::probe::{self, Probe, ProbeError};

/// A bundle that cannot be made narrower.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum QuantizeError {
    /// It is narrow.
    #[error("the bundle is {0} already; start from the one with 32-bit floats")]
    Already(Numbers),
    /// There are no frames to measure ranges on.
    #[error("no calibration data; give --calib KIND:PATH[@split], best of the training split")]
    NoData,
    /// The data cannot be opened or used.
    #[error("data {data}: {reason}")]
    Data {
        /// As it was given.
        data: String,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// A graph that this program did not write.
    #[error("{kind}: {reason}; only bundles that tsda-export wrote can be made narrower")]
    Graph {
        /// The graph.
        kind: SectionKind,
        /// What is wrong.
        reason: String,
    },
    /// A shape cannot be told.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// `--keep` of something that is not there.
    #[error("no product is called `{name}`; `--json` of a run without --keep lists them")]
    Keep {
        /// The name.
        name: String,
    },
    /// No frame ran a graph.
    #[error("no calibration frame ran {kind}; give more frames (--frames)")]
    Unseen {
        /// The graph.
        kind: SectionKind,
    },
    /// An activation was never a finite number other than 0.
    #[error("{kind}: tensor `{tensor}` has no range: {reason}")]
    Range {
        /// The graph.
        kind: SectionKind,
        /// The activation.
        tensor: String,
        /// What was seen.
        reason: &'static str,
    },
    /// The bundle lacks a section.
    #[error(transparent)]
    Bundle(#[from] BundleError),
    /// The engine refuses or fails.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The tracker cannot go on.
    #[error("tracking `{sequence}`, frame {frame}: {source}")]
    Track {
        /// The clip.
        sequence: String,
        /// Its frame.
        frame: usize,
        /// Why.
        source: TrackerError,
    },
    /// The evaluation failed.
    #[error(transparent)]
    Eval(#[from] EvalError),
    /// The reference outputs cannot be computed.
    #[error(transparent)]
    Probe(#[from] ProbeError),
    /// The bundle cannot be put together.
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// What to do with a bundle.
#[derive(Clone, Debug)]
pub struct QuantizeOptions {
    /// Which numbers.
    pub numbers: Numbers,
    /// Calibration data, `KIND:PATH[@split]`, or a folder of pairs.
    pub calib: Option<String>,
    /// Frames of it.
    pub frames: usize,
    /// Products that stay in floats: names of nodes or of their layers.
    pub keep: Vec<String>,
    /// Data to measure the loss on.
    pub measure: Vec<String>,
    /// Products of fewer multiply-accumulates stay in floats: rounding their inputs costs as much
    /// as it saves.
    pub smallest: u64,
}

impl Default for QuantizeOptions {
    fn default() -> Self {
        Self {
            numbers: Numbers::Int8,
            calib: None,
            frames: 400,
            keep: Vec::new(),
            measure: Vec::new(),
            smallest: 500_000,
        }
    }
}

/// One product with constant weights.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LayerReport {
    /// Its graph.
    pub graph: String,
    /// Its node.
    pub node: String,
    /// Multiply-accumulates of one run.
    pub macs: u64,
    /// Why it stays in floats; absent when it is one of bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub kept: Option<&'static str>,
    /// Step of its input, when that is one of bytes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f32>,
    /// The byte for 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zero: Option<u8>,
}

/// One figure before and after.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LossReport {
    /// What was measured, on what.
    pub name: String,
    /// With 32-bit floats.
    pub before: f32,
    /// With narrower numbers.
    pub after: f32,
}

/// What was done.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct QuantizeReport {
    /// Which numbers.
    pub numbers: String,
    /// Bytes of the bundle before.
    pub bytes_before: usize,
    /// And after.
    pub bytes_after: usize,
    /// Frames that were tracked to measure ranges.
    pub frames: usize,
    /// Largest differences of score map and ltrb map from the stored outputs of the network of
    /// floats, on the probe's noise-like pictures.
    pub probe: [f32; 2],
    /// Every product with constant weights.
    pub layers: Vec<LayerReport>,
    /// The tracker's figures, in per cent.
    pub losses: Vec<LossReport>,
}

impl std::fmt::Display for QuantizeReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let macs = |narrow: bool| -> u64 {
            let layers = self.layers.iter().filter(|l| l.kept.is_none() == narrow);
            layers.map(|l| l.macs).sum()
        };
        let million = |n: u64| n as f64 / 1e6;
        writeln!(f, "{}: {} bytes, was {}", self.numbers, self.bytes_after, self.bytes_before)?;
        let narrow = self.layers.iter().filter(|l| l.kept.is_none()).count();
        if narrow > 0 {
            writeln!(
                f,
                "{narrow} products in bytes ({:.1} million MAC), {} in floats ({:.1}); ranges from \
                 {} frames",
                million(macs(true)),
                self.layers.len() - narrow,
                million(macs(false)),
                self.frames
            )?;
        }
        for l in self.layers.iter().filter(|_| narrow > 0) {
            if let Some(why) = l.kept {
                writeln!(f, "  in floats: {} {} ({why})", l.graph, l.node)?;
            }
        }
        let [scores, ltrb] = self.probe;
        writeln!(f, "probe: score map off by up to {scores:.1e}, ltrb map by {ltrb:.1e}")?;
        for LossReport { name, before, after } in &self.losses {
            writeln!(f, "{name:<44} {before:>7.2} -> {after:>7.2} ({:+.2})", after - before)?;
        }
        Ok(())
    }
}

/// Data that were opened, with the name they go by.
pub type Named<'d> = (String, &'d Dataset);

/// Makes a bundle narrower; its bytes and what was done.
///
/// # Errors
/// When the bundle is narrow already, the data cannot be used, or a graph is not one of ours.
pub fn quantize(
    bundle: &Bundle<'_>,
    options: &QuantizeOptions,
    progress: &mut dyn FnMut(&str),
) -> Result<(Vec<u8>, QuantizeReport), QuantizeError> {
    // What is wrong with the bundle should be known before data are read, and whether all data are
    // there before hours of work.
    check(bundle)?;
    let calib = match &options.calib {
        Some(text) if options.numbers.has_bytes() => {
            Some((data::portable(text), data::open(text)?))
        }
        _ => None,
    };
    let open = |text: &String| Ok((data::portable(text), data::open(text)?));
    let measure: Vec<(String, Dataset)> =
        options.measure.iter().map(open).collect::<Result<_, QuantizeError>>()?;
    let measure: Vec<Named<'_>> = measure.iter().map(|(n, d)| (n.clone(), d)).collect();
    let calib = calib.as_ref().map(|(n, d)| (n.clone(), d));
    quantize_on(bundle, options, calib, &measure, progress)
}

/// Refuses what is narrow.
fn check(bundle: &Bundle<'_>) -> Result<(), QuantizeError> {
    match &bundle.manifest().precision {
        Some(precision) => Err(QuantizeError::Already(precision.numbers)),
        None => Ok(()),
    }
}

/// As [`quantize`], on data that are open.
///
/// # Errors
/// As [`quantize`].
pub fn quantize_on(
    bundle: &Bundle<'_>,
    options: &QuantizeOptions,
    calib: Option<Named<'_>>,
    measure: &[Named<'_>],
    progress: &mut dyn FnMut(&str),
) -> Result<(Vec<u8>, QuantizeReport), QuantizeError> {
    check(bundle)?;
    let manifest = bundle.manifest();
    let weights = bundle.require(SectionKind::Weights)?;
    let files = graph::read(bundle)?;
    let bytes = options.numbers.has_bytes();
    let products =
        if bytes { graph::choose(&files, &options.keep, options.smallest)? } else { Vec::new() };
    let (roundings, frames) = match (&calib, bytes) {
        (Some((name, data)), true) => {
            progress(&format!("calibrating on up to {} frames of {name}", options.frames));
            calibrate::ranges(bundle, &files, &products, data, options.frames)?
        }
        (None, true) => return Err(QuantizeError::NoData),
        (_, false) => (Roundings::new(), 0),
    };
    let half = matches!(options.numbers, Numbers::Half | Numbers::Int8Half);
    let mut sections = graph::write(&files, weights, &products, &roundings, half)?;

    let calibration = calib.map(|(name, _)| name).unwrap_or_default();
    let taken = products.iter().filter(|p| p.kept.is_none()).count();
    let precision = Precision {
        numbers: options.numbers,
        layers: taken as u32,
        kept: (products.len() - taken) as u32,
        data: if bytes { &calibration } else { "" },
        frames: frames as u32,
        from_crc: crc32(weights),
        losses: Default::default(),
    };
    // Declared before the manifest that will point into it.
    let mut losses: Vec<LossReport> = Vec::new();
    let mut narrow = Manifest { precision: Some(precision), ..manifest.clone() };

    // What the other engines are compared with is computed by the network as it is now.
    let before = bundle.require(SectionKind::Probe)?;
    sections.push((SectionKind::Probe, before.to_vec()));
    let draft = bundle::encode(&narrow, &sections)?;
    // As the file says it: attention in bytes is this engine's own.
    let plain = NativeOptions { float_attention: true, ..NativeOptions::default() };
    let mut engine = NativeEngine::with_options(&Bundle::parse(&draft)?, plain)?;
    let far = probe::run(&mut engine, &Probe::parse(before, &manifest.spec)?)?;
    let most = |of: fn(&probe::ProbeDiff) -> f32| far.diffs.iter().map(of).fold(0.0, f32::max);
    let probe = [most(|d| d.scores), most(|d| d.ltrb)];
    let own = probe::capture(&mut engine, &probe::default_boxes(&manifest.spec))?;
    sections.pop();
    sections.push((SectionKind::Probe, own));

    if !measure.is_empty() {
        let draft = bundle::encode(&narrow, &sections)?;
        let pair = [bundle, &Bundle::parse(&draft)?];
        for (name, data) in measure {
            losses.extend(measure::losses(pair, name, data, progress)?);
        }
    }
    if let Some(precision) = &mut narrow.precision {
        for LossReport { name, before, after } in &losses {
            // What does not fit into the manifest is in the report.
            let _ = precision.losses.push(Loss { name, before: *before, after: *after });
        }
    }
    let out = bundle::encode(&narrow, &sections)?;
    let report = QuantizeReport {
        numbers: options.numbers.to_string(),
        bytes_before: bundle.bytes().len(),
        bytes_after: out.len(),
        frames,
        probe,
        layers: products.iter().map(|p| layer(&files, p, &roundings)).collect(),
        losses: losses.clone(),
    };
    Ok((out, report))
}

fn layer(files: &[File], product: &Product, roundings: &Roundings) -> LayerReport {
    let rounding = match product.kept {
        None => roundings.get(&(product.file, product.input.clone())),
        Some(_) => None,
    };
    LayerReport {
        graph: files[product.file].kind.to_string(),
        node: product.name.clone(),
        macs: product.macs,
        kept: product.kept,
        scale: rounding.map(|r| r.scale),
        zero: rounding.map(|r| r.zero),
    }
}
