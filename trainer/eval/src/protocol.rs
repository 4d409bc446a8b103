//! Which sensor a tracker sees in which frame, and running one over a sequence.

use std::fmt;
use std::ops::ControlFlow;
use std::str::FromStr;
use std::time::Instant;

use tsda_runtime::{BBox, Modality};

use crate::dataset::{DatasetError, Picture, Sequence};
use crate::metrics::{self, FirstFrame, LengthMismatch, Scores};
use crate::store::StoreError;

/// Which sensor each frame comes from, counted from the frame the tracker is initialised with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Protocol {
    /// Template RGB, every later frame thermal: `rgb2t`.
    RgbToThermal,
    /// Template thermal, every later frame RGB: `t2rgb`.
    ThermalToRgb,
    /// Template RGB, then thermal and RGB in turn, `every` frames each, thermal first: `switch:20`;
    /// `switch` alone is [`Self::SWITCH`].
    Switch {
        /// Frames between switches, at least 1.
        every: usize,
    },
    /// RGB throughout: `rgb`.
    Rgb,
    /// Thermal throughout: `t`.
    Thermal,
}

impl Protocol {
    /// Switch as the field runs it: every 200 frames.
    pub const SWITCH: Self = Self::Switch { every: 200 };

    /// The three cross-modal protocols results are reported for.
    pub const CROSS_MODAL: [Self; 3] = [Self::RgbToThermal, Self::ThermalToRgb, Self::SWITCH];

    /// Sensor of frame `i`; frame 0 is the one the tracker is initialised with.
    pub const fn modality(self, i: usize) -> Modality {
        let thermal = match self {
            Self::RgbToThermal => i > 0,
            Self::ThermalToRgb => i == 0,
            Self::Switch { every } => {
                // `every` is at least 1 when parsed; a hand-made 0 must not divide.
                let every = if every == 0 { 1 } else { every };
                i > 0 && ((i - 1) / every).is_multiple_of(2)
            }
            Self::Rgb => false,
            Self::Thermal => true,
        };
        if thermal { Modality::Thermal } else { Modality::Rgb }
    }

    /// Sensors a sequence must have.
    pub const fn needs(self) -> &'static [Modality] {
        match self {
            Self::Rgb => &[Modality::Rgb],
            Self::Thermal => &[Modality::Thermal],
            _ => &[Modality::Rgb, Modality::Thermal],
        }
    }
}

impl fmt::Display for Protocol {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::RgbToThermal => f.write_str("rgb2t"),
            Self::ThermalToRgb => f.write_str("t2rgb"),
            Self::Switch { every } => write!(f, "switch:{every}"),
            Self::Rgb => f.write_str("rgb"),
            Self::Thermal => f.write_str("t"),
        }
    }
}

/// A text that names no protocol.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "unknown protocol '{0}': expected rgb2t, t2rgb, switch:N (N at least 1; switch is switch:200), rgb or t"
)]
pub struct UnknownProtocol(pub String);

impl FromStr for Protocol {
    type Err = UnknownProtocol;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        let unknown = || UnknownProtocol(s.to_owned());
        Ok(match s {
            "rgb2t" => Self::RgbToThermal,
            "t2rgb" => Self::ThermalToRgb,
            "rgb" => Self::Rgb,
            "t" => Self::Thermal,
            "switch" => Self::SWITCH,
            _ => match s.strip_prefix("switch:").and_then(|n| n.parse().ok()) {
                Some(every) if every > 0 => Self::Switch { every },
                _ => return Err(unknown()),
            },
        })
    }
}

/// Anything that can be evaluated.
///
/// `init` must forget everything of earlier sequences: one tracker serves many of them, and which
/// ones depends on the number of threads, while results must not.
pub trait TrackerUnderTest {
    /// Name in reports.
    fn name(&self) -> &str;

    /// Is there work worth timing? A tracker that does not look at the picture has no frame rate.
    fn timed(&self) -> bool {
        true
    }

    /// Starts on a frame with the target's box.
    ///
    /// # Errors
    /// Whatever keeps the tracker from starting.
    fn init(&mut self, frame: &Picture, bbox: BBox, modality: Modality)
    -> Result<(), TrackerError>;

    /// Finds the target in the next frame: its box and a confidence (higher is surer).
    ///
    /// # Errors
    /// Whatever keeps the tracker from going on.
    fn update(&mut self, frame: &Picture, modality: Modality) -> Result<(BBox, f32), TrackerError>;
}

/// What a tracker reports when it cannot go on.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
pub struct TrackerError(Box<dyn std::error::Error + Send + Sync>);

impl TrackerError {
    /// Wraps an error or a message.
    pub fn new(source: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self(source.into())
    }
}

/// What one tracker did on one target. All lists are of one length; entry 0 is the frame the
/// tracker was initialised with, frame [`Self::start`] of the sequence.
#[derive(Clone, Debug)]
pub struct SequenceResult {
    /// Sequence.
    pub sequence: String,
    /// Target within it.
    pub target: usize,
    /// First annotated frame, where the run starts.
    pub start: usize,
    /// Sensor of every frame.
    pub modalities: Vec<Modality>,
    /// Truth in that sensor; `None` when absent.
    pub truth: Vec<Option<BBox>>,
    /// Boxes found; entry 0 is the initial box.
    pub predicted: Vec<BBox>,
    /// Confidence; entry 0 is 1.
    pub confidence: Vec<f32>,
    /// Milliseconds inside the tracker by frame, decoding excluded, entry 0 being the start; empty
    /// for a tracker that is not [timed](TrackerUnderTest::timed).
    pub milliseconds: Vec<f32>,
}

/// Milliseconds and number of the frames tracked, those that start a run left out.
pub fn tracking_time<'a>(results: impl IntoIterator<Item = &'a SequenceResult>) -> (f64, usize) {
    let frames = results.into_iter().flat_map(|r| r.milliseconds.iter().skip(1));
    frames.fold((0.0, 0), |(sum, n), ms| (sum + f64::from(*ms), n + 1))
}

/// Frames per second inside the tracker, those that start a run left out; `None` where nothing was
/// timed.
pub fn frame_rate<'a>(results: impl IntoIterator<Item = &'a SequenceResult>) -> Option<f64> {
    let (milliseconds, frames) = tracking_time(results);
    (milliseconds > 0.0).then(|| 1e3 * frames as f64 / milliseconds)
}

impl SequenceResult {
    /// Figures against the truth.
    ///
    /// # Errors
    /// When lists of a result made by hand differ in length.
    pub fn scores(&self, first: FirstFrame) -> Result<Scores, LengthMismatch> {
        metrics::measure(&self.truth, &self.predicted, first)
    }

    /// `sequence`, or `sequence#target` from the second target on: names result files.
    pub fn label(&self) -> String {
        label(&self.sequence, self.target)
    }
}

/// `sequence`, or `sequence#target` from the second target on.
pub fn label(sequence: &str, target: usize) -> String {
    match target {
        0 => sequence.to_owned(),
        n => format!("{sequence}#{n}"),
    }
}

/// An evaluation that could not be finished.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvalError {
    /// A frame could not be read.
    #[error("sequence {sequence}, frame {frame}: {source}")]
    Frame {
        /// The sequence.
        sequence: String,
        /// Frame of the sequence, 0-based.
        frame: usize,
        /// What is wrong with the file.
        source: DatasetError,
    },
    /// The tracker gave up.
    #[error("{tracker} on sequence {sequence}, frame {frame}: {source}")]
    Tracker {
        /// Its name.
        tracker: String,
        /// The sequence.
        sequence: String,
        /// Frame of the sequence, 0-based.
        frame: usize,
        /// What it said.
        source: TrackerError,
    },
    /// The tracker, or the decoder of its pictures, panicked: a bug there.
    #[error("sequence {sequence}: panicked: {message}")]
    Panicked {
        /// The sequence.
        sequence: String,
        /// The message of the panic.
        message: String,
    },
    /// No tracker could be made.
    #[error("cannot make a tracker: {0}")]
    MakeTracker(#[source] TrackerError),
    /// The sequence lacks a sensor of the protocol.
    #[error("sequence {sequence} has no {modality} frames, which protocol {protocol} needs")]
    MissingSensor {
        /// The sequence.
        sequence: String,
        /// What it lacks.
        modality: Modality,
        /// The protocol.
        protocol: Protocol,
    },
    /// The target is nowhere annotated in the sensor a run would start with.
    #[error("sequence {sequence}, target {target}: no {modality} box to start from")]
    NoStart {
        /// The sequence.
        sequence: String,
        /// The target.
        target: usize,
        /// The sensor of the first frame.
        modality: Modality,
    },
    /// Nothing to evaluate.
    #[error("dataset '{dataset}' has no target that protocol {protocol} can run on")]
    Empty {
        /// The dataset.
        dataset: String,
        /// The protocol.
        protocol: Protocol,
    },
    /// Results could not be kept.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// Stopped on request.
    #[error("interrupted: {finished} of {total} sequences of protocol {protocol} are finished")]
    Interrupted {
        /// The protocol.
        protocol: Protocol,
        /// Finished so far.
        finished: usize,
        /// In all.
        total: usize,
    },
    /// A result of unequal lists.
    #[error("sequence {sequence}: {source}")]
    Length {
        /// The sequence.
        sequence: String,
        /// What does not fit.
        source: LengthMismatch,
    },
}

/// First frame with a box of `target` in the sensor `protocol` starts with.
pub fn start_frame(sequence: &dyn Sequence, target: usize, protocol: Protocol) -> Option<usize> {
    (0..sequence.frames()).find(|&f| sequence.truth(target, f, protocol.modality(0)).is_some())
}

/// Runs `tracker` on one target from its first annotated frame to the end of the sequence. The
/// protocol counts from that frame.
///
/// # Errors
/// When the sequence lacks a sensor or a first box, a frame cannot be read, or the tracker fails.
pub fn run(
    sequence: &dyn Sequence,
    target: usize,
    protocol: Protocol,
    tracker: &mut dyn TrackerUnderTest,
) -> Result<SequenceResult, EvalError> {
    let whole = run_watched(sequence, target, protocol, tracker, || ControlFlow::Continue(()))?;
    // Nobody asked to stop.
    whole.ok_or(EvalError::Interrupted { protocol, finished: 0, total: 1 })
}

/// As [`run`], asking `watch` after every frame whether to go on; `None` when it was not to.
///
/// # Errors
/// As [`run`].
pub fn run_watched(
    sequence: &dyn Sequence,
    target: usize,
    protocol: Protocol,
    tracker: &mut dyn TrackerUnderTest,
    mut watch: impl FnMut() -> ControlFlow<()>,
) -> Result<Option<SequenceResult>, EvalError> {
    for &modality in protocol.needs() {
        if !sequence.modalities().contains(&modality) {
            let sequence = sequence.id().to_owned();
            return Err(EvalError::MissingSensor { sequence, modality, protocol });
        }
    }
    let no_start = || EvalError::NoStart {
        sequence: sequence.id().to_owned(),
        target,
        modality: protocol.modality(0),
    };
    let start = start_frame(sequence, target, protocol).ok_or_else(no_start)?;
    let first_box = sequence.truth(target, start, protocol.modality(0)).ok_or_else(no_start)?;

    let frames = sequence.frames() - start;
    let modalities: Vec<Modality> = (0..frames).map(|i| protocol.modality(i)).collect();
    let truth =
        modalities.iter().enumerate().map(|(i, &m)| sequence.truth(target, start + i, m)).collect();
    let mut predicted = Vec::with_capacity(frames);
    let mut confidence = Vec::with_capacity(frames);
    let mut milliseconds = Vec::with_capacity(frames);
    for (i, &modality) in modalities.iter().enumerate() {
        let picture = sequence.picture(start + i, modality).map_err(|source| EvalError::Frame {
            sequence: sequence.id().to_owned(),
            frame: start + i,
            source,
        })?;
        let clock = Instant::now();
        let answer = if i == 0 {
            tracker.init(&picture, first_box, modality).map(|()| (first_box, 1.0))
        } else {
            tracker.update(&picture, modality)
        };
        milliseconds.push(clock.elapsed().as_secs_f32() * 1e3);
        let (bbox, score) = answer.map_err(|source| EvalError::Tracker {
            tracker: tracker.name().to_owned(),
            sequence: sequence.id().to_owned(),
            frame: start + i,
            source,
        })?;
        predicted.push(bbox);
        confidence.push(score);
        if watch().is_break() {
            return Ok(None);
        }
    }
    if !tracker.timed() {
        milliseconds.clear();
    }
    Ok(Some(SequenceResult {
        sequence: sequence.id().to_owned(),
        target,
        start,
        modalities,
        truth,
        predicted,
        confidence,
        milliseconds,
    }))
}

#[cfg(test)]
#[path = "protocol_tests.rs"]
mod tests;
