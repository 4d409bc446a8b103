//! The loop: poll, judge, decide, track, report. One thread; in steady state nothing is allocated.

use super::clock::Clock;
use super::control::Command;
use super::motion::{Motion, kept_inside};
use super::output::{Event, EventKind, FrameRecord, Output, SourceInfo, TargetRecord, Views};
use super::plan::{Plan, Registrations};
use super::sensor::{News, Sensor};
use super::source::Counters;
use super::zones::Zones;
use crate::error::HostError;
use crate::switch::policy::Policy;
use crate::switch::{Condition, Homography, Reason};
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};
use tsda_runtime::system::allocations_here;
use tsda_runtime::{BBox, Engine, TrackError, TrackState, Tracker};

/// Longest wait for a picture: how soon commands, signals and other sensors are looked at.
const WAIT: Duration = Duration::from_millis(40);
/// Frames in a row an engine may fail before the run ends.
const ENGINE_FAILURES: u32 = 10;

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// The pictures of the active source are at their end.
    Source,
    /// As many frames as were asked for.
    Frames,
    /// By signal.
    Signal,
    /// By command.
    Command,
    /// No usable picture from any sensor for as long as was allowed.
    NoPictures,
}

impl Ending {
    /// In a few words.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Source => "end of the pictures",
            Self::Frames => "all frames asked for",
            Self::Signal => "signal",
            Self::Command => "command",
            Self::NoPictures => "no usable pictures",
        }
    }
}

/// Allocations of the loop's thread, from its first turn on. What depends on the sensors is set up in
/// their first frames; from then on there should be none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Allocations {
    /// All of them; 0 also where nothing counts them.
    pub count: u64,
    /// Record that the last was made for.
    pub last: Option<u64>,
}

/// Figures of a run.
#[derive(Clone, Debug)]
pub struct Summary {
    /// How it ended.
    pub ending: Ending,
    /// Records written.
    pub frames: u64,
    /// Of which without a picture that could be used.
    pub predicted: u64,
    /// Sensor changes.
    pub switches: u64,
    /// Time of the run.
    pub time: Duration,
    /// Mean and largest latency of tracked frames.
    pub latency: (Duration, Duration),
    /// Of the loop's thread.
    pub allocations: Allocations,
    /// Name and counts of every source.
    pub sources: Vec<(String, Counters)>,
    /// Name of every output and what it lost.
    pub outputs: Vec<(String, u64)>,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |d: Duration| d.as_secs_f64() * 1e3;
        writeln!(
            f,
            "{}: {} frames in {:.1} s, {} predicted, {} switches, latency {:.1} ms mean, {:.1} ms \
             largest",
            self.ending.as_str(),
            self.frames,
            self.time.as_secs_f64(),
            self.predicted,
            self.switches,
            ms(self.latency.0),
            ms(self.latency.1)
        )?;
        let Allocations { count, last } = self.allocations;
        write!(f, "loop: {count} allocations")?;
        match last {
            Some(frame) => writeln!(f, ", the last in frame {frame}")?,
            None => writeln!(f)?,
        }
        for (name, c) in &self.sources {
            writeln!(
                f,
                "source {name}: {} pictures, {} passed over, {} missing, {} damaged, {} restarts, \
                 {} times unplugged",
                c.delivered, c.skipped, c.missing, c.damaged, c.restarts, c.unplugged
            )?;
        }
        for (name, lost) in self.outputs.iter().filter(|o| o.1 > 0) {
            writeln!(f, "output {name}: {lost} lines lost")?;
        }
        Ok(())
    }
}

/// Everything of one run.
pub struct Host<E> {
    sensors: Vec<Sensor>,
    tracker: Tracker<E>,
    policy: Policy,
    registrations: Registrations,
    outputs: Vec<Box<dyn Output>>,
    commands: Receiver<Command>,
    clock: Clock,
    frames: Option<u64>,
    give_up: Option<Duration>,
    active: usize,
    /// Target to be taken from the next good picture, in pixels of this sensor.
    pending: Option<(usize, BBox)>,
    /// The target's last record, until it is released.
    target: Option<TargetRecord>,
    motion: Motion,
    /// The tracker stands where the target was before a gap or a change of sensors.
    misplaced: bool,
    /// Last size and reported condition of every sensor.
    sizes: Vec<Option<(usize, usize)>>,
    reported: Vec<Condition>,
    skipped: u64,
    engine_failures: u32,
    zones: Option<Arc<Zones>>,
    /// Whether frames are left out, and when the last one was used.
    throttled: bool,
    used: Option<Duration>,
    record: u64,
    predicted: u64,
    switches: u64,
    tracked: u64,
    latency: (Duration, Duration),
    /// Of this thread, up to the last record.
    allocated: u64,
    allocations: Allocations,
}

impl<E: Engine> Host<E> {
    /// Puts a run together. `commands` is the reading end of [`super::control::channel`].
    pub fn new(
        plan: Plan,
        tracker: Tracker<E>,
        outputs: Vec<Box<dyn Output>>,
        commands: Receiver<Command>,
    ) -> Self {
        let n = plan.sensors.len();
        Self {
            active: plan.switch.preferred,
            policy: Policy::new(plan.switch),
            registrations: plan.registrations,
            clock: Clock::start(plan.clock.0, plan.clock.1),
            frames: plan.frames,
            give_up: plan.give_up,
            pending: plan.target,
            sensors: plan.sensors,
            tracker,
            outputs,
            commands,
            target: None,
            motion: Motion::default(),
            misplaced: false,
            sizes: vec![None; n],
            reported: vec![Condition::Waiting; n],
            skipped: 0,
            engine_failures: 0,
            zones: None,
            throttled: false,
            used: None,
            record: 0,
            predicted: 0,
            switches: 0,
            tracked: 0,
            latency: (Duration::ZERO, Duration::ZERO),
            allocated: 0,
            allocations: Allocations::default(),
        }
    }

    /// Leaves frames out while the machine is too warm.
    #[must_use]
    pub fn with_zones(self, zones: Option<Arc<Zones>>) -> Self {
        Self { zones, ..self }
    }

    /// What outputs need to know about the sensors of a plan.
    pub fn infos(plan: &Plan) -> Vec<SourceInfo> {
        plan.sensors.iter().map(|s| s.info().clone()).collect()
    }

    /// Runs until something ends it. `stop` may be set from a signal handler.
    ///
    /// # Errors
    /// A source or an engine that cannot go on. The outputs are finished all the same.
    pub fn run(&mut self, stop: &AtomicBool) -> Result<Summary, HostError> {
        self.start();
        let ending = loop {
            if stop.load(Ordering::Relaxed) {
                break Ok(Ending::Signal);
            }
            match self.step() {
                Ok(None) => self.tick(),
                Ok(Some(ending)) => break Ok(ending),
                Err(e) => break Err(e),
            }
        };
        let why = ending.as_ref().map_or("failure", |e| e.as_str());
        self.event(EventKind::Ended { why });
        for output in &mut self.outputs {
            output.finish();
        }
        Ok(self.summary(ending?))
    }

    /// Begins the time of the run, for a caller with a loop of its own around [`Self::step`] and
    /// [`Self::tick`].
    pub fn start(&mut self) {
        if let Clock::Wall(start) = &mut self.clock {
            *start = Instant::now();
        }
        self.event(EventKind::Started);
        self.allocated = allocations_here();
    }

    /// Lets the time go on by a frame, where it goes by frames.
    pub fn tick(&mut self) {
        self.clock.tick();
    }

    /// One turn of the loop; answers why the run has to end, if it has to.
    ///
    /// # Errors
    /// See [`Self::run`].
    pub fn step(&mut self) -> Result<Option<Ending>, HostError> {
        while let Ok(command) = self.commands.try_recv() {
            if self.obey(command) {
                return Ok(Some(Ending::Command));
            }
        }
        let mut fresh = 0u64;
        // The others first: what the active one waits for is used at once.
        let active = self.active;
        for i in (0..self.sensors.len()).filter(|i| *i != active).chain([active]) {
            let wait = if i == active { WAIT } else { Duration::ZERO };
            match self.sensors[i].poll(&self.clock, wait)? {
                News::Fresh => fresh |= 1 << i,
                News::Nothing => {}
                News::Ended if i == active => return Ok(Some(Ending::Source)),
                News::Ended => {}
            }
            if let Some(reason) = self.sensors[i].trouble() {
                self.event(EventKind::Unavailable { source: i, reason });
            }
        }
        let (arrived, now) = (Instant::now(), self.clock.now());
        self.report_conditions(now);
        if let Some(limit) = self.give_up
            && self.sensors.iter().all(|s| s.watch().bad_for(now) > limit)
        {
            return Ok(Some(Ending::NoPictures));
        }
        self.decide(now);
        let used = fresh & 1 << self.active != 0 && !self.left_out(now);
        self.follow(now, arrived, used)?;
        Ok(self.frames.is_some_and(|n| self.record >= n).then_some(Ending::Frames))
    }

    /// Whether a frame at `now` is left out because the machine is too warm.
    fn left_out(&mut self, now: Duration) -> bool {
        let Some(zones) = &self.zones else { return false };
        let (pause, celsius) = (zones.pause(), zones.warmest().unwrap_or(f32::NAN));
        if pause.is_some() != self.throttled {
            self.throttled = pause.is_some();
            self.event(EventKind::Throttled { on: self.throttled, celsius });
        }
        let early = matches!((pause, self.used), (Some(p), Some(u)) if now.saturating_sub(u) < p);
        if !early {
            self.used = Some(now);
        }
        early
    }

    fn decide(&mut self, now: Duration) {
        // The policy sees the sensors' health, which lives in the sensors.
        let sensors = &self.sensors;
        let decided = self.policy.decide(now, self.active, sensors.len(), |i| sensors[i].watch());
        if let Some((to, reason)) = decided {
            self.change(to, reason);
        }
    }

    fn event(&mut self, kind: EventKind) {
        let event = Event { at: self.clock.now(), frame: self.record, kind };
        for output in &mut self.outputs {
            output.event(&event);
        }
    }

    fn report_conditions(&mut self, now: Duration) {
        for i in 0..self.sensors.len() {
            let (new, old) = (self.sensors[i].watch().condition(now), self.reported[i]);
            if new == old {
                continue;
            }
            self.reported[i] = new;
            match (old, new) {
                (Condition::Waiting, Condition::Good) | (_, Condition::Waiting) => {}
                (_, Condition::Good) => self.event(EventKind::Back { source: i }),
                (_, condition) => self.event(EventKind::Lost { source: i, condition }),
            }
        }
    }

    /// Does what a command says; answers whether the run is to end.
    fn obey(&mut self, command: Command) -> bool {
        let find = |name: &str| self.sensors.iter().position(|s| s.info().name == name);
        let unknown = |name: &str| EventKind::Refused { what: format!("no source `{name}`") };
        match command {
            Command::Quit => return true,
            Command::Auto => self.policy.set_automatic(true),
            Command::Stop => {
                self.pending = None;
                if self.target.take().is_some() {
                    self.event(EventKind::Released);
                }
            }
            Command::Switch { to } => match find(&to) {
                Some(to) => {
                    self.policy.set_automatic(false);
                    if to != self.active {
                        self.change(to, Reason::Command);
                    }
                }
                None => self.event(unknown(&to)),
            },
            Command::Select { bbox: [x, y, w, h], source } => {
                let (b, at) = (BBox::new(x, y, w, h), source.as_deref().map(find));
                match at {
                    Some(None) => self.event(unknown(&source.unwrap_or_default())),
                    _ if !b.is_valid() => self.event(EventKind::Refused {
                        what: format!(
                            "box {x}, {y}, {w}, {h}: width and height have to be positive"
                        ),
                    }),
                    at => self.pending = Some((at.flatten().unwrap_or(self.active), b)),
                }
            }
        }
        false
    }

    fn registration(&self, from: usize, to: usize) -> Homography {
        if from == to {
            return Homography::IDENTITY;
        }
        self.registrations.between(from, to).unwrap_or_else(|| {
            // The same field of view: the sizes say the rest.
            let size = |i: usize| {
                self.sensors[i].view().map(|v| (v.width(), v.height())).or(self.sizes[i])
            };
            match (size(from), size(to)) {
                (Some(a), Some(b)) => {
                    Homography::scaling(b.0 as f64 / a.0 as f64, b.1 as f64 / a.1 as f64)
                }
                _ => Homography::IDENTITY,
            }
        })
    }

    fn change(&mut self, to: usize, reason: Reason) {
        let from = std::mem::replace(&mut self.active, to);
        let registration = self.registration(from, to);
        self.motion.map(&registration);
        self.misplaced = true;
        self.switches += 1;
        self.skipped = self.sensors[to].source().counters().skipped;
        self.event(EventKind::Switched { from, to, reason });
    }

    /// Takes, finds or predicts the target in the active sensor's newest picture and reports it.
    fn follow(&mut self, now: Duration, arrived: Instant, fresh: bool) -> Result<(), HostError> {
        let active = self.active;
        let condition = self.sensors[active].watch().condition(now);
        let usable = fresh && condition == Condition::Good;
        if !usable && matches!(condition, Condition::Good | Condition::Waiting) {
            return Ok(());
        }
        let started = Instant::now();
        if usable {
            self.take_pending(now);
            self.track(now)?;
        } else {
            self.predict(now);
        }
        let tracking = started.elapsed();

        let counters = self.sensors[active].source().counters();
        let skipped = counters.skipped.saturating_sub(self.skipped);
        self.skipped = counters.skipped;
        let sensor = &self.sensors[active];
        let captured = sensor.captured();
        let taken = captured.and_then(|c| c.taken).filter(|_| usable);
        let size = sensor.view().map(|v| (v.width(), v.height()));
        self.sizes[active] = size.or(self.sizes[active]);
        let record = FrameRecord {
            frame: self.record,
            at: now,
            capture: captured.and_then(|c| c.capture),
            source: active,
            size: self.sizes[active].unwrap_or_default(),
            sequence: captured.map_or(0, |c| c.sequence),
            condition,
            target: self.target,
            latency: taken.map_or(arrived, |t| t.min(arrived)).elapsed(),
            tracking,
            skipped: skipped.min(u64::from(u32::MAX)) as u32,
            allocations: self.count_allocations(),
        };
        let views = Views(&self.sensors);
        for output in &mut self.outputs {
            output.frame(&record, &views);
        }
        self.record += 1;
        if usable {
            self.tracked += 1;
            self.latency.0 += record.latency;
            self.latency.1 = self.latency.1.max(record.latency);
        } else {
            self.predicted += 1;
        }
        Ok(())
    }

    /// How many there were since the last call, from the first turn on.
    fn count_allocations(&mut self) -> u64 {
        let now = allocations_here();
        let new = now - std::mem::replace(&mut self.allocated, now);
        if new > 0 {
            self.allocations.count += new;
            self.allocations.last = Some(self.record);
        }
        new
    }

    fn take_pending(&mut self, now: Duration) {
        let Some((source, bbox)) = self.pending.take() else { return };
        let bbox = self.registration(source, self.active).map_box(&bbox);
        let sensor = &self.sensors[self.active];
        let Some(view) = sensor.view() else { return };
        let taken = self.tracker.init(&view, bbox, Some(sensor.modality()));
        let kind = match taken {
            Ok(()) => {
                self.motion.start(now, bbox);
                self.misplaced = false;
                self.target = Some(TargetRecord {
                    bbox,
                    score: 1.0,
                    confidence: self.tracker.calibration().map(|_| 1.0),
                    state: TrackState::Tracking,
                    predicted: false,
                    redetected: false,
                    temperature: sensor.temperature(&bbox),
                });
                EventKind::Selected { source: self.active, bbox }
            }
            Err(e) => {
                self.target = None;
                EventKind::Refused { what: format!("the target cannot be taken: {e}") }
            }
        };
        self.event(kind);
    }

    fn track(&mut self, now: Duration) -> Result<(), HostError> {
        let sensor = &self.sensors[self.active];
        let (Some(_), Some(view)) = (self.target, sensor.view()) else { return Ok(()) };
        // Taken from this very picture.
        let first = self.tracker.target().is_some_and(|t| t.frame() == 0);
        if first && !self.misplaced && self.motion.is_at(now) {
            return Ok(());
        }
        let found = (|| -> Result<_, TrackError> {
            if self.misplaced
                && let Some(b) = self.motion.predict(now)
            {
                self.tracker.set_box(kept_inside(b, view.width(), view.height()))?;
            }
            self.tracker.update(&view, Some(sensor.modality()))
        })();
        match found {
            Ok(track) => {
                self.misplaced = false;
                self.engine_failures = 0;
                match track.state {
                    TrackState::Tracking | TrackState::Uncertain => {
                        self.motion.seen(now, track.bbox);
                    }
                    // Nobody knows where it went.
                    TrackState::Searching => self.motion.unseen(now, track.bbox),
                    TrackState::Lost => self.motion.start(now, track.bbox),
                }
                self.target = Some(TargetRecord {
                    bbox: track.bbox,
                    score: track.score,
                    confidence: track.confidence,
                    state: track.state,
                    predicted: false,
                    redetected: track.redetected,
                    temperature: sensor.temperature(&track.bbox),
                });
                Ok(())
            }
            Err(e) => {
                self.engine_failures += 1;
                if self.engine_failures >= ENGINE_FAILURES {
                    let frame = usize::try_from(self.record).unwrap_or(usize::MAX);
                    return Err(HostError::Tracker { frame, source: Box::new(e) });
                }
                self.event(EventKind::Refused { what: e.to_string() });
                self.predict(now);
                Ok(())
            }
        }
    }

    /// The picture cannot be used: nothing is learnt from it.
    fn predict(&mut self, now: Duration) {
        self.misplaced = true;
        let (Some(target), Some(bbox)) = (&mut self.target, self.motion.predict(now)) else {
            return;
        };
        target.bbox = match self.sizes[self.active] {
            Some((w, h)) => kept_inside(bbox, w, h),
            None => bbox,
        };
        target.predicted = true;
        target.redetected = false;
        target.temperature = None;
        if target.state != TrackState::Lost {
            target.state = TrackState::Searching;
        }
    }

    fn summary(&self, ending: Ending) -> Summary {
        let mean = self.latency.0.checked_div(self.tracked.min(u64::from(u32::MAX)) as u32);
        Summary {
            ending,
            frames: self.record,
            predicted: self.predicted,
            switches: self.switches,
            time: self.clock.now(),
            latency: (mean.unwrap_or_default(), self.latency.1),
            allocations: self.allocations,
            sources: self
                .sensors
                .iter()
                .map(|s| (s.info().name.clone(), s.source().counters()))
                .collect(),
            outputs: self.outputs.iter().map(|o| (o.name().to_owned(), o.dropped())).collect(),
        }
    }
}

impl<E> fmt::Debug for Host<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Host")
            .field("active", &self.active)
            .field("record", &self.record)
            .finish_non_exhaustive()
    }
}
