//! MAVLink 2: the tracker as a camera of an autopilot or ground station. Commands select and release
//! the target, CAMERA_TRACKING_IMAGE_STATUS says where it is.

mod link;
pub mod wire;

use self::link::Link;
use self::wire::{CommandMessage, Frame, ImageStatus, Parser, Sender};
use super::config::MavlinkConfig;
use super::control::{Command, Commands};
use super::output::{
    Event, EventKind, Feeder, FrameRecord, LINGER, Losses, Output, SourceInfo, Views, linger, queue,
};
use crate::error::HostError;
use std::net::SocketAddr;
use std::sync::mpsc::{Receiver, TryRecvError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};
use tsda_runtime::TrackState;

const NAME: &str = "TSDA-Track";
/// Time between two heartbeats.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Shortest interval that can be asked for.
const SHORTEST: Duration = Duration::from_millis(5);

const TRACK_POINT: u16 = 2004;
const TRACK_RECTANGLE: u16 = 2005;
const STOP_TRACKING: u16 = 2010;
const SET_MESSAGE_INTERVAL: u16 = 511;
const REQUEST_MESSAGE: u16 = 512;
const REQUEST_CAMERA_INFORMATION: u16 = 521;

/// MAV_RESULT.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Answer {
    Accepted = 0,
    /// Not now.
    Rejected = 1,
    /// Not like this.
    Denied = 2,
    Unsupported = 3,
}

enum Item {
    Frame(FrameRecord),
    Released,
}

/// MAVLink.
#[derive(Debug)]
pub struct Mavlink {
    name: String,
    address: Option<SocketAddr>,
    feeder: Feeder<Item>,
    worker: Option<JoinHandle<()>>,
}

impl std::fmt::Debug for Item {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Frame(record) => record.fmt(f),
            Self::Released => f.write_str("Released"),
        }
    }
}

impl Mavlink {
    /// Opens the line.
    ///
    /// # Errors
    /// When a key makes no sense or the line cannot be opened.
    pub fn open(
        config: &MavlinkConfig,
        sources: Vec<SourceInfo>,
        commands: Commands,
    ) -> Result<Self, HostError> {
        let refuse = |key: &str, reason: &str| HostError::Argument {
            what: format!("output.mavlink.{key}"),
            reason: reason.into(),
        };
        if config.system == 0 || config.component == 0 {
            return Err(refuse("system", "system and component are 1 to 255; 0 means everybody"));
        }
        if !(0.0..=200.0).contains(&config.status_rate) {
            return Err(refuse("status_rate", "0 to 200 per second"));
        }
        if !(0.001..=1.0).contains(&config.point_size) {
            return Err(refuse("point_size", "0.001 to 1, a share of the picture's width"));
        }
        let link = Link::open(&config.to)?;
        let address = link.local();
        let name = match address {
            Some(address) => format!("mavlink to {} from {address}", config.to),
            None => format!("mavlink to {}", config.to),
        };
        let (feeder, items) = queue(config.queue);
        let us = Sender { system: config.system, component: config.component };
        let camera = Camera {
            us,
            sources,
            commands: config.control.then_some(commands),
            point_size: config.point_size,
            usual: interval(config.status_rate),
            every: interval(config.status_rate),
            record: None,
            sequence: 0,
            start: Instant::now(),
            link,
        };
        let worker = thread::Builder::new()
            .name("tsda-mavlink".into())
            .spawn(move || camera.serve(&items))
            .map_err(|source| HostError::Create { path: name.clone().into(), source })?;
        Ok(Self { name, address, feeder, worker: Some(worker) })
    }

    /// Where it listens, for UDP.
    pub const fn address(&self) -> Option<SocketAddr> {
        self.address
    }
}

fn interval(rate: f64) -> Option<Duration> {
    if rate > 0.0 { Duration::try_from_secs_f64(1.0 / rate).ok() } else { None }
}

impl Output for Mavlink {
    fn name(&self) -> &str {
        &self.name
    }

    fn frame(&mut self, record: &FrameRecord, _: &Views<'_>) {
        self.feeder.offer(Item::Frame(*record));
    }

    fn event(&mut self, event: &Event) {
        if event.kind == EventKind::Released {
            self.feeder.offer(Item::Released);
        }
    }

    fn losses(&self) -> &Losses {
        self.feeder.losses()
    }

    fn finish(&mut self) {
        self.feeder.close();
        linger(self.worker.take(), LINGER);
    }
}

/// The output's thread.
struct Camera {
    us: Sender,
    sources: Vec<SourceInfo>,
    /// `None`: no commands are taken.
    commands: Option<Commands>,
    point_size: f32,
    /// Interval of the status without and with a wish of the station.
    usual: Option<Duration>,
    every: Option<Duration>,
    record: Option<FrameRecord>,
    sequence: u8,
    start: Instant,
    link: Link,
}

impl Camera {
    fn serve(mut self, items: &Receiver<Item>) {
        let (mut parser, mut buffer) = (Parser::default(), [0; 2048]);
        let (mut beat, mut told) = (None, None);
        loop {
            loop {
                match items.try_recv() {
                    Ok(Item::Frame(record)) => self.record = Some(record),
                    Ok(Item::Released) => {
                        if let Some(record) = &mut self.record {
                            record.target = None;
                        }
                    }
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Disconnected) => return,
                }
            }
            if due(&mut beat, HEARTBEAT) {
                self.send(wire::HEARTBEAT, &wire::heartbeat());
            }
            if let Some(every) = self.every
                && self.record.is_some()
                && due(&mut told, every)
            {
                self.send_status();
            }
            let n = self.link.read(&mut buffer);
            let mut found = Vec::new();
            parser.push(&buffer[..n], |frame| found.push(frame));
            for frame in found {
                self.take(&frame);
            }
        }
    }

    fn send(&mut self, id: u32, payload: &[u8]) {
        let mut frame = Vec::with_capacity(300);
        wire::write_frame(&mut frame, self.us, self.sequence, id, payload);
        self.sequence = self.sequence.wrapping_add(1);
        self.link.send(&frame);
    }

    fn send_status(&mut self) {
        let payload = status(self.record.as_ref()).payload();
        self.send(wire::CAMERA_TRACKING_IMAGE_STATUS, &payload);
    }

    fn send_information(&mut self) {
        let size = self.record.map_or((0, 0), |r| r.size);
        let side = |n: usize| u16::try_from(n).unwrap_or(u16::MAX);
        let number = |text: &str| text.parse().unwrap_or(0);
        let version = [
            number(env!("CARGO_PKG_VERSION_MAJOR")),
            number(env!("CARGO_PKG_VERSION_MINOR")),
            number(env!("CARGO_PKG_VERSION_PATCH")),
        ];
        let boot = self.start.elapsed().as_millis() as u32;
        let size = (side(size.0), side(size.1));
        self.send(wire::CAMERA_INFORMATION, &wire::camera_information(boot, version, size, NAME));
    }

    /// Does what a frame asks for and answers.
    fn take(&mut self, frame: &Frame) {
        let Some(command) = CommandMessage::read(frame) else { return };
        let (system, component) = (command.to.system, command.to.component);
        if (system != 0 && system != self.us.system)
            || (component != 0 && component != self.us.component)
        {
            return;
        }
        let answer = self.obey(&command);
        // What is for everybody may be for somebody else.
        if answer == Answer::Unsupported && component == 0 {
            return;
        }
        let ack = wire::command_ack(command.command, answer as u8, frame.from);
        self.send(wire::COMMAND_ACK, &ack);
        if answer == Answer::Accepted {
            match (command.command, command.params[0]) {
                (REQUEST_CAMERA_INFORMATION, _) => self.send_information(),
                (REQUEST_MESSAGE, id) if id == wire::CAMERA_INFORMATION as f32 => {
                    self.send_information();
                }
                (REQUEST_MESSAGE, id) if id == wire::HEARTBEAT as f32 => {
                    self.send(wire::HEARTBEAT, &wire::heartbeat());
                }
                (REQUEST_MESSAGE, _) => self.send_status(),
                _ => {}
            }
        }
    }

    fn obey(&mut self, command: &CommandMessage) -> Answer {
        let p = command.params;
        match command.command {
            TRACK_POINT => {
                let radius = if p[2] > 0.0 { p[2] } else { self.point_size / 2.0 };
                self.select(|(w, h)| {
                    let r = radius * w;
                    square_around(p[0] * w, p[1] * h, r)
                        .filter(|_| is_share(p[0]) && is_share(p[1]))
                })
            }
            TRACK_RECTANGLE => self.select(|(w, h)| {
                let inside = p.iter().all(|v| is_share(*v)) && p[2] > p[0] && p[3] > p[1];
                inside.then(|| [p[0] * w, p[1] * h, (p[2] - p[0]) * w, (p[3] - p[1]) * h])
            }),
            STOP_TRACKING => self.give(Command::Stop),
            SET_MESSAGE_INTERVAL if p[0] == wire::CAMERA_TRACKING_IMAGE_STATUS as f32 => {
                self.every = match p[1] {
                    0.0 => self.usual,
                    us if us > 0.0 => {
                        Duration::try_from_secs_f32(us / 1e6).ok().map(|every| every.max(SHORTEST))
                    }
                    -1.0 => None,
                    _ => return Answer::Denied,
                };
                Answer::Accepted
            }
            REQUEST_CAMERA_INFORMATION if p[0] == 1.0 => Answer::Accepted,
            REQUEST_MESSAGE
                if [
                    wire::CAMERA_INFORMATION,
                    wire::CAMERA_TRACKING_IMAGE_STATUS,
                    wire::HEARTBEAT,
                ]
                .iter()
                .any(|id| *id as f32 == p[0]) =>
            {
                Answer::Accepted
            }
            _ => Answer::Unsupported,
        }
    }

    /// Selects what `region` makes of the picture's size, in the picture the station sees.
    fn select(&self, region: impl Fn((f32, f32)) -> Option<[f32; 4]>) -> Answer {
        let Some(record) = self.record.filter(|r| r.size.0 > 0 && r.size.1 > 0) else {
            return Answer::Rejected;
        };
        match region((record.size.0 as f32, record.size.1 as f32)) {
            Some(bbox) => {
                let source = self.sources.get(record.source).map(|s| s.name.clone());
                self.give(Command::Select { bbox, source })
            }
            None => Answer::Denied,
        }
    }

    fn give(&self, command: Command) -> Answer {
        match self.commands.as_ref().map(|c| c.give(command)) {
            None => Answer::Denied,
            Some(Ok(())) => Answer::Accepted,
            Some(Err(_)) => Answer::Rejected,
        }
    }
}

/// Whether it is time again; the first time at once.
fn due(last: &mut Option<Instant>, every: Duration) -> bool {
    let now = Instant::now();
    let is = last.is_none_or(|l| now.duration_since(l) >= every);
    if is {
        *last = Some(now);
    }
    is
}

fn is_share(v: f32) -> bool {
    (0.0..=1.0).contains(&v)
}

/// A square box.
fn square_around(x: f32, y: f32, radius: f32) -> Option<[f32; 4]> {
    (radius.is_finite() && radius >= 0.5).then_some([
        x - radius,
        y - radius,
        2.0 * radius,
        2.0 * radius,
    ])
}

/// What a record means for a ground station.
fn status(record: Option<&FrameRecord>) -> ImageStatus {
    const IDLE: u8 = 0;
    const ACTIVE: u8 = 1;
    const ERROR: u8 = 2;
    const COASTING: u8 = 8;
    let Some((record, target)) = record.and_then(|r| Some((r, r.target?))) else {
        return ImageStatus { status: IDLE, rectangle: None };
    };
    let status = match target.state {
        _ if target.predicted => COASTING,
        TrackState::Tracking | TrackState::Uncertain => ACTIVE,
        TrackState::Searching => COASTING,
        TrackState::Lost => ERROR,
    };
    let (w, h) = (record.size.0.max(1) as f32, record.size.1.max(1) as f32);
    let b = target.bbox;
    let corners = [b.x / w, b.y / h, (b.x + b.w) / w, (b.y + b.h) / h];
    ImageStatus { status, rectangle: Some(corners.map(|v| v.clamp(0.0, 1.0))) }
}

#[cfg(all(test, target_os = "linux"))]
mod serial_tests;
#[cfg(test)]
mod tests;
