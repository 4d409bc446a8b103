//! One session: hello, targets, frames, quit.

use super::error::TraxError;
use super::image::{ImageArg, ImageError};
use super::message::{Kind, Message};
use super::policy::{Channel, Channels, Chooser, SensorPolicy};
use super::reader::{MAX_MESSAGE, MessageReader};
use super::region::Region;
use crate::frames::{Decoded, looks_grey};
use std::io::{Read, Write};
use tsda_runtime::{BBox, Engine, FrameView, Modality, Track, TrackError, TrackState, Tracker};

/// Something that can follow a target: a tracker on any engine.
pub trait Follow {
    /// Takes the target from its first frame; may be called again for another target.
    ///
    /// # Errors
    /// When the box is unusable or the engine fails.
    fn init(
        &mut self,
        frame: &FrameView<'_>,
        bbox: BBox,
        modality: Modality,
    ) -> Result<(), TrackError>;

    /// Finds the target in the next frame.
    ///
    /// # Errors
    /// When the engine fails.
    fn update(&mut self, frame: &FrameView<'_>, modality: Modality) -> Result<Track, TrackError>;

    /// Moves the target, for a sensor that sees the scene at another scale.
    ///
    /// # Errors
    /// When the box is unusable.
    fn place(&mut self, bbox: BBox) -> Result<(), TrackError>;
}

impl<E: Engine> Follow for Tracker<E> {
    fn init(
        &mut self,
        frame: &FrameView<'_>,
        bbox: BBox,
        modality: Modality,
    ) -> Result<(), TrackError> {
        Self::init(self, frame, bbox, Some(modality))
    }

    fn update(&mut self, frame: &FrameView<'_>, modality: Modality) -> Result<Track, TrackError> {
        Self::update(self, frame, Some(modality))
    }

    fn place(&mut self, bbox: BBox) -> Result<(), TrackError> {
        self.set_box(bbox)
    }
}

/// Version of the protocol that is spoken. The server says which; the client follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Version {
    /// Color pictures only.
    V1,
    /// As version 1, with more kinds of pictures.
    V2,
    /// With channels.
    V3,
    /// Targets and pictures come in messages of their own.
    #[default]
    V4,
}

impl Version {
    /// From its number.
    pub const fn new(number: u8) -> Option<Self> {
        match number {
            1 => Some(Self::V1),
            2 => Some(Self::V2),
            3 => Some(Self::V3),
            4 => Some(Self::V4),
            _ => None,
        }
    }

    /// Its number.
    pub const fn number(self) -> u8 {
        match self {
            Self::V1 => 1,
            Self::V2 => 2,
            Self::V3 => 3,
            Self::V4 => 4,
        }
    }

    /// Whether pictures other than color can be asked for.
    pub const fn has_channels(self) -> bool {
        matches!(self, Self::V3 | Self::V4)
    }
}

/// What a session offers and how it chooses.
#[derive(Clone, Debug)]
pub struct Options {
    /// Version spoken.
    pub version: Version,
    /// Pictures asked for. Versions 1 and 2 know [`Channels::Color`] only.
    pub channels: Channels,
    /// Choice between two channels.
    pub policy: SensorPolicy,
    /// Most bytes of one message.
    pub max_message: usize,
    /// What the tracker calls itself, for the client's reports.
    pub description: String,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            version: Version::default(),
            channels: Channels::default(),
            policy: SensorPolicy::default(),
            max_message: MAX_MESSAGE,
            description: String::new(),
        }
    }
}

/// How a session ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The client said so.
    Quit,
    /// The client's stream ended between two messages.
    EndOfStream,
}

/// What a session did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Summary {
    /// Targets taken.
    pub targets: u64,
    /// Frames answered, first ones included.
    pub frames: u64,
    /// How it ended.
    pub end: End,
}

/// Speaks with a client until it has enough.
///
/// # Errors
/// On anything that cannot be answered; the client got a `quit` message with the reason then, unless
/// it can no longer be reached.
pub fn serve<R: Read, W: Write, F: Follow>(
    input: R,
    output: W,
    follower: &mut F,
    options: &Options,
) -> Result<Summary, TraxError> {
    let mut session = Session {
        input: MessageReader::new(input, options.max_message),
        output: Output { to: output, line: Vec::new() },
        follower,
        options,
        waiting: None,
        target: None,
        targets: 0,
        frames: 0,
    };
    let result = session.run();
    if let Err(error) = &result {
        // The error itself is what matters; the client may be gone.
        let _ = session.output.send(&quit(&crate::error::one_line(error)));
    }
    result
}

/// Tells a client that there will be no session at all.
///
/// # Errors
/// When it cannot be reached.
pub fn give_up<W: Write>(output: W, reason: &str) -> Result<(), TraxError> {
    Output { to: output, line: Vec::new() }.send(&quit(reason))
}

fn quit(reason: &str) -> Message {
    let plain: String = reason.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    Message::new(Kind::Quit).with("trax.reason", plain)
}

struct Output<W> {
    to: W,
    line: Vec<u8>,
}

impl<W: Write> Output<W> {
    /// One write and one flush per message: the client waits for whole lines.
    fn send(&mut self, message: &Message) -> Result<(), TraxError> {
        self.line.clear();
        message.encode(&mut self.line);
        self.to
            .write_all(&self.line)
            .and_then(|()| self.to.flush())
            .map_err(|source| TraxError::Write { source })
    }
}

/// The target being followed.
struct Target {
    chooser: Chooser,
    /// Last box in pixels of the picture it was found in.
    bbox: BBox,
    /// Width and height of that picture.
    size: (usize, usize),
    /// Width and height of the first channel's last picture.
    reference: (usize, usize),
    /// Frames answered.
    frame: u64,
}

struct Session<'a, R, W, F> {
    input: MessageReader<R>,
    output: Output<W>,
    follower: &'a mut F,
    options: &'a Options,
    /// Box of a target whose picture has not come yet (version 4).
    waiting: Option<BBox>,
    target: Option<Target>,
    targets: u64,
    frames: u64,
}

/// The picture of a frame that is tracked on.
struct Seen {
    channel: Channel,
    picture: Decoded,
    modality: Modality,
    /// Width and height of the first channel: boxes of messages are in its pixels.
    reference: (usize, usize),
}

impl<R: Read, W: Write, F: Follow> Session<'_, R, W, F> {
    fn run(&mut self) -> Result<Summary, TraxError> {
        let hello = self.hello();
        self.output.send(&hello)?;
        let end = loop {
            let Some(message) = self.input.next_message()? else { break End::EndOfStream };
            match message.kind {
                Kind::Quit => break End::Quit,
                Kind::Initialize if self.options.version == Version::V4 => {
                    self.expect_target(&message)?;
                }
                Kind::Initialize => self.initialize(&message)?,
                Kind::Frame => self.frame(&message)?,
                kind @ (Kind::Hello | Kind::State) => {
                    let why = "only trackers send it, never clients".into();
                    return Err(TraxError::Unexpected { kind, why });
                }
            }
        };
        Ok(Summary { targets: self.targets, frames: self.frames, end })
    }

    fn hello(&self) -> Message {
        let channels: String =
            self.options.channels.list().iter().map(|c| format!("{c};")).collect();
        Message::new(Kind::Hello)
            .with("trax.version", self.options.version.number().to_string())
            .with("trax.name", "TSDA-Track")
            .with("trax.family", "TSDA")
            .with("trax.description", self.options.description.as_str())
            .with("trax.image", "path;memory;buffer;")
            .with("trax.region", "rectangle;polygon;mask;")
            .with("trax.channels", channels)
    }

    /// Version 4: a region alone, its picture comes with the next frame; no region at all drops the
    /// target.
    fn expect_target(&mut self, message: &Message) -> Result<(), TraxError> {
        let unexpected = |why: String| Err(TraxError::Unexpected { kind: message.kind, why });
        match &message.args[..] {
            [] => {
                (self.waiting, self.target) = (None, None);
                Ok(())
            }
            [_] if self.waiting.is_some() => {
                unexpected("this tracker follows one target at a time; send its frame first".into())
            }
            [region] => {
                self.waiting = Some(self.region(region)?);
                Ok(())
            }
            more => unexpected(format!(
                "{} arguments; version 4 takes one region and its pictures with the next frame",
                more.len()
            )),
        }
    }

    /// Versions 1 to 3: pictures, then the region.
    fn initialize(&mut self, message: &Message) -> Result<(), TraxError> {
        let Some((region, pictures)) = message.args.split_last() else {
            let why = "pictures and a region are expected".into();
            return Err(TraxError::Unexpected { kind: message.kind, why });
        };
        self.count(message.kind, pictures, " and one region")?;
        let bbox = self.region(region)?;
        self.start(bbox, pictures)
    }

    fn frame(&mut self, message: &Message) -> Result<(), TraxError> {
        self.count(message.kind, &message.args, "")?;
        match (self.waiting.take(), self.target.take()) {
            (Some(bbox), _) => self.start(bbox, &message.args),
            (None, Some(target)) => self.follow(target, &message.args),
            (None, None) => {
                let why = "there is no target; send initialize with its region first".into();
                Err(TraxError::Unexpected { kind: message.kind, why })
            }
        }
    }

    /// Are there as many pictures as channels?
    fn count(&self, kind: Kind, pictures: &[String], and: &str) -> Result<(), TraxError> {
        let channels = self.options.channels.list();
        if pictures.len() == channels.len() {
            return Ok(());
        }
        let names: Vec<&str> = channels.iter().map(|c| c.as_str()).collect();
        Err(TraxError::Unexpected {
            kind,
            why: format!(
                "{} pictures came, expected are {} ({}){and}",
                pictures.len(),
                channels.len(),
                names.join(", ")
            ),
        })
    }

    /// The box around a region sent for the next target.
    fn region(&self, text: &str) -> Result<BBox, TraxError> {
        Region::parse(text)
            .and_then(|r| r.bounds())
            .map_err(|source| TraxError::Region { target: self.targets + 1, source })
    }

    /// First frame of a target.
    fn start(&mut self, bbox: BBox, pictures: &[String]) -> Result<(), TraxError> {
        self.target = None;
        self.targets += 1;
        let mut chooser = Chooser::new(self.options.policy);
        let seen = self.see(&mut chooser, 0, pictures, None)?;
        let view = seen.view(self.targets, 0)?;
        let size = (view.width(), view.height());
        let local = scaled(bbox, seen.reference, size);
        self.follower.init(&view, local, seen.modality).map_err(|source| self.failed(0, source))?;
        self.target =
            Some(Target { chooser, bbox: local, size, reference: seen.reference, frame: 1 });
        self.answer(bbox, 1.0, TrackState::Tracking, seen.modality)
    }

    /// Every later frame.
    fn follow(&mut self, mut target: Target, pictures: &[String]) -> Result<(), TraxError> {
        let number = target.frame;
        let seen = self.see(&mut target.chooser, number, pictures, Some(target.reference))?;
        let view = seen.view(self.targets, number)?;
        let size = (view.width(), view.height());
        if size != target.size {
            self.follower
                .place(scaled(target.bbox, target.size, size))
                .map_err(|source| self.failed(number, source))?;
        }
        let track = self
            .follower
            .update(&view, seen.modality)
            .map_err(|source| self.failed(number, source))?;
        target.chooser.note(track.state);
        let reference = seen.reference;
        self.target =
            Some(Target { bbox: track.bbox, size, reference, frame: number + 1, ..target });
        let bbox = scaled(track.bbox, size, reference);
        self.answer(bbox, track.confidence.unwrap_or(track.score), track.state, seen.modality)
    }

    /// Decodes what the policy wants to see.
    fn see(
        &self,
        chooser: &mut Chooser,
        frame: u64,
        pictures: &[String],
        before: Option<(usize, usize)>,
    ) -> Result<Seen, TraxError> {
        let channels = self.options.channels.list();
        let target = self.targets;
        let fail = |channel, source| TraxError::Image { target, frame, channel, source };
        let arg = |channel| {
            let index = channels.iter().position(|&c| c == channel).unwrap_or(0);
            ImageArg::parse(pictures.get(index).map_or("", String::as_str))
        };
        let decode = |channel| arg(channel).and_then(|a| a.decode()).map_err(|e| fail(channel, e));
        let (channel, picture) = match self.options.channels {
            Channels::Both => chooser.pick(decode)?,
            Channels::Color => (Channel::Color, decode(Channel::Color)?),
            Channels::Ir => (Channel::Ir, decode(Channel::Ir)?),
        };
        let size = picture.view().map_err(|e| fail(channel, e.into()))?;
        let size = (size.width(), size.height());
        let reference = match channels {
            // The first channel may have failed: that is when the second is needed.
            [first, _] if *first != channel => {
                arg(*first).and_then(|a| a.size()).ok().or(before).unwrap_or(size)
            }
            _ => size,
        };
        let modality = match (self.options.channels, channel, &picture) {
            (_, Channel::Ir, _) => Modality::Thermal,
            (Channels::Both, Channel::Color, _) => Modality::Rgb,
            // Cross-modal sequences come as one channel that changes its sensor.
            (_, Channel::Color, Decoded::Sixteen { .. }) => Modality::Thermal,
            (_, Channel::Color, Decoded::Eight(p)) if looks_grey(p) => Modality::Thermal,
            (_, Channel::Color, Decoded::Eight(_)) => Modality::Rgb,
        };
        Ok(Seen { channel, picture, modality, reference })
    }

    fn answer(
        &mut self,
        b: BBox,
        confidence: f32,
        state: TrackState,
        modality: Modality,
    ) -> Result<(), TraxError> {
        self.frames += 1;
        let region = format!("{:.4},{:.4},{:.4},{:.4}", b.x, b.y, b.w, b.h);
        let message = Message::new(Kind::State)
            .arg(region)
            .with("confidence", format!("{:.6}", confidence.clamp(0.0, 1.0)))
            .with("state", state.as_str())
            .with("modality", modality.as_str());
        self.output.send(&message)
    }

    fn failed(&self, frame: u64, source: TrackError) -> TraxError {
        TraxError::Track { target: self.targets, frame, source: Box::new(source) }
    }
}

impl Seen {
    fn view(&self, target: u64, frame: u64) -> Result<FrameView<'_>, TraxError> {
        self.picture.view().map_err(|e| TraxError::Image {
            target,
            frame,
            channel: self.channel,
            source: ImageError::Frame(e),
        })
    }
}

/// A box in pixels of a picture, in those of another that shows the same field of view.
fn scaled(b: BBox, from: (usize, usize), to: (usize, usize)) -> BBox {
    if from == to {
        return b;
    }
    let (kx, ky) = (to.0 as f32 / from.0 as f32, to.1 as f32 / from.1 as f32);
    BBox::new(b.x * kx, b.y * ky, b.w * kx, b.h * ky)
}
