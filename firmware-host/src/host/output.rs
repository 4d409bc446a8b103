//! What comes out of a run: a record per frame, events, and what takes them.

use super::sensor::Sensor;
use super::source::Counters;
use crate::switch::{Condition, Reason};
use crate::thermal::Temperature;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};
use tsda_runtime::{BBox, FrameView, Modality, TrackState};

/// What outputs know about a source from the start; its place in the list is its number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceInfo {
    /// Name in the configuration.
    pub name: String,
    /// Kind of sensor.
    pub sensor: Modality,
}

/// The target in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TargetRecord {
    /// Pixels of the record's source.
    pub bbox: BBox,
    /// Highest score of the map; that of the last tracked frame while predicted.
    pub score: f32,
    /// Probability that the box is right, when the model is calibrated.
    pub confidence: Option<f32>,
    /// How far the box can be relied on; [`TrackState::Searching`] while predicted.
    pub state: TrackState,
    /// Not seen: moved on with constant velocity because the picture cannot be used.
    pub predicted: bool,
    /// Found by the scan of the whole frame.
    pub redetected: bool,
    /// In the middle of the box, from a camera that measures it.
    pub temperature: Option<Temperature>,
}

/// What a frame gave. Plain data: copying it allocates nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameRecord {
    /// Number of the record, from 0.
    pub frame: u64,
    /// Time of the run.
    pub at: Duration,
    /// The driver's own time stamp, where there is one (its clock, usually monotonic).
    pub capture: Option<Duration>,
    /// Active source.
    pub source: usize,
    /// Width and height of the picture.
    pub size: (usize, usize),
    /// The driver's frame number; wraps.
    pub sequence: u32,
    /// State of the active source.
    pub condition: Condition,
    /// The target; `None` while there is none.
    pub target: Option<TargetRecord>,
    /// To this record, from when the picture was taken where the driver tells it on the machine's
    /// monotonic clock, else from when it was found; while predicted, from the begin of this turn.
    pub latency: Duration,
    /// Part of it inside the tracker.
    pub tracking: Duration,
    /// Older pictures of this source passed over since the last record.
    pub skipped: u32,
    /// Allocations of the loop's thread since the last record; 0 also where nothing counts them.
    pub allocations: u64,
}

/// Something that happens now and then.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// Time of the run.
    pub at: Duration,
    /// Number of the next record.
    pub frame: u64,
    /// What.
    pub kind: EventKind,
}

/// Kinds of events.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum EventKind {
    /// The loop begins.
    Started,
    /// A target was taken.
    Selected {
        /// In which source's picture.
        source: usize,
        /// Its box.
        bbox: BBox,
    },
    /// The target was given up by command.
    Released,
    /// The active sensor changed.
    Switched {
        /// From this source.
        from: usize,
        /// To this one.
        to: usize,
        /// Why.
        reason: Reason,
    },
    /// A source's pictures cannot be used any more.
    Lost {
        /// Which.
        source: usize,
        /// What is wrong.
        condition: Condition,
    },
    /// They can be used again.
    Back {
        /// Which.
        source: usize,
    },
    /// A camera that was lost cannot be opened again for now; it is tried on.
    Unavailable {
        /// Which.
        source: usize,
        /// What the driver or the system says.
        reason: String,
    },
    /// The machine is too warm, frames are left out; or no longer.
    Throttled {
        /// Whether it begins.
        on: bool,
        /// The warmest zone, in degrees Celsius.
        celsius: f32,
    },
    /// Something that was asked for cannot be done.
    Refused {
        /// What and why.
        what: String,
    },
    /// The loop ended.
    Ended {
        /// Why.
        why: &'static str,
    },
}

/// The newest pictures of all sources, as the tracker sees them (telemetry rows cut off, 16-bit
/// values with their range).
#[derive(Clone, Copy, Debug)]
pub struct Views<'a>(pub(super) &'a [Sensor]);

impl<'a> Views<'a> {
    /// Newest picture of a source; `None` before its first and while it is unplugged.
    pub fn view(&self, source: usize) -> Option<FrameView<'a>> {
        self.0.get(source)?.view()
    }

    /// State of a source at a time of the run.
    pub fn condition(&self, source: usize, now: Duration) -> Option<Condition> {
        Some(self.0.get(source)?.watch().condition(now))
    }

    /// Counts of a source since the start.
    pub fn counters(&self, source: usize) -> Option<Counters> {
        Some(self.0.get(source)?.source().counters())
    }
}

/// Takes what comes out of a run.
///
/// Called on the loop's thread: an output hands everything over to a thread of its own (see
/// [`queue`]) and neither waits nor, in steady state, allocates. What its queue has no room for is
/// lost and counted.
pub trait Output {
    /// What it is and where it goes, for messages.
    fn name(&self) -> &str;

    /// Takes a frame. The pictures are only there during the call; an output that wants one copies
    /// it to a buffer of its own.
    fn frame(&mut self, record: &FrameRecord, views: &Views<'_>);

    /// Takes an event.
    fn event(&mut self, event: &Event);

    /// Where lost frames and events are counted.
    fn losses(&self) -> &Losses;

    /// Frames and events that were lost so far.
    fn dropped(&self) -> u64 {
        self.losses().count()
    }

    /// Writes what is left, for at most a second or two.
    fn finish(&mut self);
}

/// How long the last items of an output may take.
pub(super) const LINGER: Duration = Duration::from_secs(2);

/// A count of what an output lost; its clones count the same.
#[derive(Clone, Debug, Default)]
pub struct Losses(Arc<AtomicU64>);

impl Losses {
    /// Counts one more.
    pub fn add(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// So many so far.
    pub fn count(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// The sending end of a bounded queue that never waits.
#[derive(Debug)]
pub struct Feeder<T> {
    sender: Option<SyncSender<T>>,
    losses: Losses,
}

impl<T> Feeder<T> {
    /// Hands an item over, or counts it as lost when the queue is full or its reader gone.
    pub fn offer(&mut self, item: T) {
        let sent = self.sender.as_ref().map(|s| s.try_send(item));
        if !matches!(sent, Some(Ok(()))) {
            self.losses.add();
        }
    }

    /// Items lost so far.
    pub const fn losses(&self) -> &Losses {
        &self.losses
    }

    /// Closes the queue; its reader ends after what is in it.
    pub fn close(&mut self) {
        self.sender = None;
    }
}

/// A bounded queue between the loop and an output's thread.
pub fn queue<T>(depth: usize) -> (Feeder<T>, Receiver<T>) {
    let (sender, receiver) = sync_channel(depth.max(1));
    (Feeder { sender: Some(sender), losses: Losses::default() }, receiver)
}

/// Waits for an output's thread, but not for ever: a reader that does not read must not keep the
/// program from ending.
pub(super) fn linger(writer: Option<JoinHandle<()>>, time: Duration) {
    let (Some(writer), end) = (writer, Instant::now() + time) else { return };
    while !writer.is_finished() && Instant::now() < end {
        thread::sleep(Duration::from_millis(2));
    }
    if writer.is_finished() {
        let _ = writer.join();
    }
}
