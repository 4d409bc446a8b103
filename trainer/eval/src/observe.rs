//! Runs a [`Tracker`] over a sequence and keeps what the tracker says of itself, which
//! [`crate::presence`] and [`crate::calibrate`] are computed from.

use tsda_runtime::{BBox, Engine, TrackState, Tracker};

use crate::dataset::Sequence;
use crate::presence::{Frame, Observation, Truth};
use crate::protocol::{EvalError, Protocol, TrackerError, start_frame};

/// Tracks one target from its first annotated frame to the end of the sequence; the protocol counts
/// from that frame. Frames may change size from sensor to sensor; both are then taken to see the
/// same field of view.
///
/// # Errors
/// When the sequence lacks a sensor or a first box, a frame cannot be read, or the tracker fails.
pub fn observe<E: Engine>(
    sequence: &dyn Sequence,
    target: usize,
    protocol: Protocol,
    tracker: &mut Tracker<E>,
) -> Result<Observation, EvalError> {
    let id = sequence.id();
    for &modality in protocol.needs() {
        if !sequence.modalities().contains(&modality) {
            return Err(EvalError::MissingSensor { sequence: id.to_owned(), modality, protocol });
        }
    }
    let modality = protocol.modality(0);
    let no_start = || EvalError::NoStart { sequence: id.to_owned(), target, modality };
    let start = start_frame(sequence, target, protocol).ok_or_else(no_start)?;
    let first = sequence.truth(target, start, modality).ok_or_else(no_start)?;

    let mut frames: Vec<Frame> = Vec::with_capacity(sequence.frames() - start);
    let mut size = (0, 0);
    for at in start..sequence.frames() {
        let failed = |source| EvalError::Tracker {
            tracker: tracker_name(protocol),
            sequence: id.to_owned(),
            frame: at,
            source,
        };
        let modality = protocol.modality(at - start);
        let picture = sequence.picture(at, modality).map_err(|source| EvalError::Frame {
            sequence: id.to_owned(),
            frame: at,
            source,
        })?;
        let view = picture.view().map_err(|e| failed(TrackerError::new(e)))?;
        let (predicted, score, state, redetected) = if at == start {
            tracker.init(&view, first, Some(modality)).map_err(|e| failed(TrackerError::new(e)))?;
            (first, 1.0, TrackState::Tracking, false)
        } else {
            let now = (picture.width, picture.height);
            if let Some(last) = frames.last().map(|f| f.predicted).filter(|_| now != size) {
                let (kx, ky) = (now.0 as f32 / size.0 as f32, now.1 as f32 / size.1 as f32);
                tracker
                    .set_box(BBox::new(last.x * kx, last.y * ky, last.w * kx, last.h * ky))
                    .map_err(|e| failed(TrackerError::new(e)))?;
            }
            let t =
                tracker.update(&view, Some(modality)).map_err(|e| failed(TrackerError::new(e)))?;
            (t.bbox, t.score, t.state, t.redetected)
        };
        size = (picture.width, picture.height);
        let truth = match sequence.truth(target, at, modality) {
            Some(b) => Truth::Visible(b),
            None if sequence.absent(target, at, modality) => Truth::Absent,
            None => Truth::Unknown,
        };
        frames.push(Frame { truth, predicted, score, state, redetected });
    }
    Ok(Observation { sequence: id.to_owned(), frames })
}

fn tracker_name(protocol: Protocol) -> String {
    format!("tracker under {protocol}")
}
