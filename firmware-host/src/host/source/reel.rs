//! Pictures from files or from memory, played at a rate, with faults on request.

use super::{Captured, Counters, Held, Polled, Source};
use crate::error::HostError;
use crate::frames::FrameSource;
use crate::host::Clock;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::time::Duration;
use tsda_runtime::BBox;

/// What goes wrong in a rehearsal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FaultKind {
    /// No pictures.
    Stop,
    /// The device is gone.
    Unplug,
    /// The same picture again and again.
    Freeze,
    /// Black pictures.
    Dark,
    /// White pictures.
    Saturate,
    /// Pictures marked as damaged.
    Damage,
    /// A closed shutter: the same grey picture, and the camera says so.
    Shutter,
}

/// A rehearsed fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// What.
    pub kind: FaultKind,
    /// First frame, from 0.
    pub at: u64,
    /// Number of frames.
    pub frames: u64,
}

/// Opens a stream of files again, to repeat it.
type Opener = Box<dyn Fn() -> Result<Box<dyn FrameSource>, HostError>>;

enum Content {
    Loaded(Vec<Held>),
    Stream { open: Opener, source: Box<dyn FrameSource>, at: u64, held: Option<Held> },
}

/// Pictures played at a rate.
pub struct Reel {
    content: Content,
    rate: f64,
    repeat: bool,
    faults: Vec<Fault>,
    what: String,
    full: u16,
    known_box: Option<BBox>,
    next: u64,
    /// Picture shown, of those loaded.
    shown: Option<usize>,
    /// Shown instead, during a fault.
    blank: Option<Held>,
    blanked: Option<FaultKind>,
    at: Duration,
    counters: Counters,
}

impl fmt::Debug for Reel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Reel").field("what", &self.what).field("next", &self.next).finish()
    }
}

impl Reel {
    /// Pictures in memory. `rate`: pictures per second.
    pub fn loaded(pictures: Vec<Held>, rate: f64, what: String) -> Self {
        Self::new(Content::Loaded(pictures), rate, what)
    }

    /// Files, read while playing.
    ///
    /// # Errors
    /// When they cannot be opened.
    pub fn stream(open: Opener, rate: f64, what: String) -> Result<Self, HostError> {
        let source = open()?;
        Ok(Self::new(Content::Stream { open, source, at: 0, held: None }, rate, what))
    }

    fn new(content: Content, rate: f64, what: String) -> Self {
        Self {
            content,
            rate,
            repeat: false,
            faults: Vec::new(),
            what,
            full: u16::MAX,
            known_box: None,
            next: 0,
            shown: None,
            blank: None,
            blanked: None,
            at: Duration::ZERO,
            counters: Counters::default(),
        }
    }

    /// Begins anew after the last picture.
    pub fn repeated(mut self, repeat: bool) -> Self {
        self.repeat = repeat;
        self
    }

    /// Rehearses faults.
    pub fn with_faults(mut self, faults: Vec<Fault>) -> Self {
        self.faults = faults;
        self
    }

    /// Where the target is in the first picture.
    pub fn with_box(mut self, bbox: Option<BBox>) -> Self {
        self.known_box = bbox;
        self
    }

    /// Largest value of a 16-bit sensor.
    pub fn with_full(mut self, full: u16) -> Self {
        self.full = full;
        self
    }

    fn fault(&self, index: u64) -> Option<FaultKind> {
        let hit = |f: &&Fault| (f.at..f.at.saturating_add(f.frames)).contains(&index);
        self.faults.iter().find(hit).map(|f| f.kind)
    }

    /// Goes to a picture; `false` after the last.
    fn load(&mut self, index: u64) -> Result<bool, HostError> {
        match &mut self.content {
            Content::Loaded(pictures) => {
                let n = pictures.len() as u64;
                if n == 0 || (index >= n && !self.repeat) {
                    return Ok(false);
                }
                self.shown = Some((index % n) as usize);
            }
            Content::Stream { open, source, at, held } => {
                let mut rewound = false;
                while *at <= index {
                    if let Some(frame) = source.next_frame()? {
                        *at += 1;
                        rewound = false;
                        // Only the picture that is wanted is kept.
                        if *at > index {
                            match held {
                                Some(held) => held.hold(&frame.view),
                                None => *held = Some(Held::of(&frame.view)),
                            }
                        }
                    } else if self.repeat && !rewound {
                        *source = open()?;
                        rewound = true;
                    } else {
                        return Ok(false);
                    }
                }
            }
        }
        Ok(true)
    }

    fn picture(&self) -> Option<&Held> {
        match &self.content {
            Content::Loaded(pictures) => pictures.get(self.shown?),
            Content::Stream { held, .. } => held.as_ref(),
        }
    }

    /// Prepares what is shown instead during a fault; allocates when one begins.
    fn cover(&mut self, kind: Option<FaultKind>) {
        if self.blanked == kind {
            return;
        }
        self.blank = match kind {
            Some(FaultKind::Dark | FaultKind::Saturate | FaultKind::Shutter) => {
                self.picture().cloned().map(|mut p| {
                    p.fill(match kind {
                        Some(FaultKind::Dark) => 0,
                        Some(FaultKind::Saturate) => 0xFF,
                        _ => 0x71,
                    });
                    p
                })
            }
            Some(FaultKind::Freeze) => self.blank.take().or_else(|| self.picture().cloned()),
            _ => None,
        };
        self.blanked = kind;
    }
}

impl Source for Reel {
    fn poll(&mut self, clock: &Clock, wait: Duration) -> Result<Polled, HostError> {
        let due = |now: Duration| (now.as_secs_f64() * self.rate + 1e-6) as u64;
        let mut index = due(clock.now());
        if index < self.next {
            let at = Duration::from_secs_f64(self.next as f64 / self.rate);
            clock.sleep(at.saturating_sub(clock.now()).min(wait));
            index = due(clock.now());
            if index < self.next {
                return Ok(Polled::Nothing);
            }
        }
        let passed = index - self.next;
        self.next = index + 1;
        let fault = self.fault(index);
        // A frozen picture is the one shown before; files go on underneath.
        if fault == Some(FaultKind::Freeze) {
            self.cover(fault);
        }
        if !self.load(index)? {
            return Ok(Polled::Ended);
        }
        self.cover(fault);
        match fault {
            Some(FaultKind::Stop) => return Ok(Polled::Nothing),
            Some(FaultKind::Unplug) => return Ok(Polled::Gone),
            Some(FaultKind::Damage) => self.counters.damaged += 1,
            _ => {}
        }
        self.counters.delivered += 1;
        self.counters.skipped += passed;
        self.at = clock.now();
        Ok(Polled::Fresh)
    }

    fn frame(&self) -> Option<Captured<'_>> {
        let held = self.blank.as_ref().or_else(|| self.picture())?;
        Some(Captured {
            view: held.view().ok()?,
            full: self.full,
            at: self.at,
            capture: None,
            taken: None,
            sequence: (self.next.saturating_sub(1) & u64::from(u32::MAX)) as u32,
            damaged: self.blanked == Some(FaultKind::Damage),
            shutter: self.blanked == Some(FaultKind::Shutter),
        })
    }

    fn counters(&self) -> Counters {
        self.counters
    }

    fn rate(&self) -> Option<f64> {
        Some(self.rate)
    }

    fn known_box(&self) -> Option<BBox> {
        self.known_box
    }

    fn describe(&self) -> String {
        format!("{}, {} pictures per second", self.what, self.rate)
    }
}
