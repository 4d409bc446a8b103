//! One run: frames from a source through a tracker into any number of outputs.

use crate::error::HostError;
use crate::frames::{Frame, FrameSource};
use crate::output::PartFile;
use serde::Serialize;
use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use tsda_runtime::{BBox, Engine, FrameView, Modality, Track, TrackError, TrackState, Tracker};

/// What is known about one frame after it was tracked.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// 0-based.
    pub frame: usize,
    /// File, or `frame 12` of a stream.
    pub name: String,
    /// Sensor.
    pub modality: Modality,
    /// Target in image pixels.
    pub bbox: BBox,
    /// Highest score of the map, about 1 on the target; 1 in the first frame.
    pub score: f32,
    /// Probability that the box is right, when the tracker knows a calibration; 1 in the first
    /// frame.
    pub confidence: Option<f32>,
    /// How far the box can be relied on.
    pub state: TrackState,
    /// Milliseconds inside the tracker.
    pub ms: f32,
}

/// An output that gets every frame and appears only when finished; dropping it unfinished leaves
/// nothing behind.
pub trait Sink {
    /// Takes the next frame. `truth` is the known box of the target, where there is one.
    ///
    /// # Errors
    /// When it cannot be written or encoded.
    fn frame(
        &mut self,
        view: &FrameView<'_>,
        step: &Step,
        truth: Option<BBox>,
    ) -> Result<(), HostError>;

    /// Puts the output in its place.
    ///
    /// # Errors
    /// When it cannot be written.
    fn finish(self: Box<Self>) -> Result<(), HostError>;
}

/// What a run needs besides frames and tracker.
#[derive(Clone, Copy, Debug)]
pub struct Run<'a> {
    /// Box of the target in the first frame.
    pub init: BBox,
    /// Where `init` came from, for messages.
    pub init_from: &'a str,
    /// Known boxes by frame; may be shorter than the clip.
    pub truth: &'a [Option<BBox>],
    /// Set from outside to stop; the run then ends with [`HostError::Interrupted`].
    pub stop: &'a AtomicBool,
}

impl Run<'_> {
    /// Tracks through all frames. The sinks are finished only when every frame went well.
    ///
    /// Sensors of one clip are taken to see the same field of view: when a frame has another size
    /// than the one before, the box is scaled along.
    ///
    /// # Errors
    /// An unusable box, a frame that cannot be read, a failing engine or output, an interruption.
    pub fn drive<E: Engine>(
        &self,
        tracker: &mut Tracker<E>,
        source: &mut dyn FrameSource,
        mut sinks: Vec<Box<dyn Sink>>,
        mut progress: impl FnMut(&Step),
    ) -> Result<Vec<Step>, HostError> {
        let mut steps: Vec<Step> = Vec::new();
        let mut size = None;
        let stopped = || self.stop.load(Ordering::Relaxed);
        loop {
            // Ctrl-C reaches the program that feeds the pipe too, so a stream often breaks then.
            let next_frame = source.next_frame();
            if stopped() {
                return Err(HostError::Interrupted);
            }
            let Some(frame) = next_frame? else { break };
            let step = match steps.last() {
                None => self.first(tracker, &frame)?,
                Some(before) => next(tracker, &frame, before.bbox, size)?,
            };
            size = Some((frame.view.width(), frame.view.height()));
            let truth = self.truth.get(step.frame).copied().flatten();
            for sink in &mut sinks {
                sink.frame(&frame.view, &step, truth)?;
            }
            progress(&step);
            steps.push(step);
        }
        if steps.is_empty() {
            return Err(HostError::Argument {
                what: "frames".into(),
                reason: "the source ended before its first frame".into(),
            });
        }
        for sink in sinks {
            sink.finish()?;
        }
        Ok(steps)
    }

    fn first<E: Engine>(
        &self,
        tracker: &mut Tracker<E>,
        frame: &Frame<'_>,
    ) -> Result<Step, HostError> {
        let start = Instant::now();
        tracker.init(&frame.view, self.init, Some(frame.modality)).map_err(|e| match e {
            TrackError::Box(_) => {
                HostError::Init { what: self.init_from.to_owned(), reason: e.to_string() }
            }
            e => HostError::Tracker { frame: frame.index, source: Box::new(e) },
        })?;
        let sure = tracker.calibration().map(|_| 1.0);
        Ok(step(frame, self.init, (1.0, sure), TrackState::Tracking, start))
    }
}

fn next<E: Engine>(
    tracker: &mut Tracker<E>,
    frame: &Frame<'_>,
    before: BBox,
    size: Option<(usize, usize)>,
) -> Result<Step, HostError> {
    let failed = |e| HostError::Tracker { frame: frame.index, source: Box::new(e) };
    let start = Instant::now();
    let now = (frame.view.width(), frame.view.height());
    tracker.follow_size(before, size.unwrap_or(now), now).map_err(failed)?;
    let Track { bbox, score, confidence, state, .. } =
        tracker.update(&frame.view, Some(frame.modality)).map_err(failed)?;
    Ok(step(frame, bbox, (score, confidence), state, start))
}

fn step(
    frame: &Frame<'_>,
    bbox: BBox,
    (score, confidence): (f32, Option<f32>),
    state: TrackState,
    start: Instant,
) -> Step {
    Step {
        frame: frame.index,
        name: frame.name.to_owned(),
        modality: frame.modality,
        bbox,
        score,
        confidence,
        state,
        ms: start.elapsed().as_secs_f32() * 1e3,
    }
}

/// `x,y,w,h` per frame, the text of OTB and its successors.
#[derive(Debug)]
pub struct BoxesFile(PartFile);

impl BoxesFile {
    /// Starts writing a file.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn create(path: &Path) -> Result<Self, HostError> {
        PartFile::create(path).map(Self)
    }
}

impl Sink for BoxesFile {
    fn frame(&mut self, _: &FrameView<'_>, step: &Step, _: Option<BBox>) -> Result<(), HostError> {
        let b = step.bbox;
        writeln!(self.0, "{:.2},{:.2},{:.2},{:.2}", b.x, b.y, b.w, b.h)
            .map_err(|e| self.0.failed(e))
    }

    fn finish(self: Box<Self>) -> Result<(), HostError> {
        self.0.commit()
    }
}

/// One JSON object per line and frame, into a file or to standard output as it happens.
#[derive(Debug)]
pub struct JsonLines(Option<PartFile>);

#[derive(Serialize)]
struct JsonStep<'a> {
    frame: usize,
    file: &'a str,
    modality: Modality,
    /// x, y, w, h.
    #[serde(rename = "box")]
    bbox: [f32; 4],
    score: f32,
    #[serde(skip_serializing_if = "Option::is_none")]
    confidence: Option<f32>,
    state: TrackState,
    ms: f32,
}

impl JsonLines {
    /// Starts writing a file; `-` is standard output.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn create(path: &Path) -> Result<Self, HostError> {
        if path == Path::new("-") {
            Ok(Self(None))
        } else {
            PartFile::create(path).map(|f| Self(Some(f)))
        }
    }
}

impl Sink for JsonLines {
    fn frame(&mut self, _: &FrameView<'_>, step: &Step, _: Option<BBox>) -> Result<(), HostError> {
        let b = step.bbox;
        let row = JsonStep {
            frame: step.frame,
            file: &step.name,
            modality: step.modality,
            bbox: [b.x, b.y, b.w, b.h],
            score: step.score,
            confidence: step.confidence,
            state: step.state,
            ms: step.ms,
        };
        let write = |out: &mut dyn Write| -> io::Result<()> {
            serde_json::to_writer(&mut *out, &row)?;
            out.write_all(b"\n")
        };
        match &mut self.0 {
            Some(file) => write(file).map_err(|e| file.failed(e)),
            None => write(&mut io::stdout().lock())
                .map_err(|source| HostError::Write { path: "standard output".into(), source }),
        }
    }

    fn finish(self: Box<Self>) -> Result<(), HostError> {
        self.0.map_or(Ok(()), PartFile::commit)
    }
}

#[cfg(test)]
mod tests;
