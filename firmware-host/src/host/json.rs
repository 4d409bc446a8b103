//! One JSON object per line: records and events, to standard output, a UDP port or a Unix socket.

use super::config::JsonConfig;
use super::control::SocketFile;
use super::output::{
    Event, EventKind, Feeder, FrameRecord, LINGER, Losses, Output, SourceInfo, Views, linger, queue,
};
use crate::error::HostError;
use crate::thermal::Temperature;
use serde::Serialize;
use std::io::{self, Write};
use std::net::UdpSocket;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::sync::mpsc::Receiver;
use std::thread::{self, JoinHandle};
use std::time::Duration;
use tsda_runtime::{Modality, TrackState};

enum Line {
    Frame(FrameRecord),
    Event(Event),
}

/// Where lines go.
enum Way {
    Stdout,
    /// Events only, as text.
    Stderr,
    Udp(UdpSocket),
    Unix {
        listener: UnixListener,
        clients: Vec<UnixStream>,
        _file: SocketFile,
    },
}

/// JSON lines.
#[derive(Debug)]
pub struct JsonLines {
    name: String,
    feeder: Feeder<Line>,
    writer: Option<JoinHandle<()>>,
    frames: bool,
}

impl std::fmt::Debug for Line {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Frame(r) => r.fmt(f),
            Self::Event(e) => e.fmt(f),
        }
    }
}

impl JsonLines {
    /// Opens what the configuration names.
    ///
    /// # Errors
    /// When the destination is not understood or cannot be opened.
    pub fn open(config: &JsonConfig, sources: Vec<SourceInfo>) -> Result<Self, HostError> {
        let way = match config.to.split_once(':') {
            None if config.to == "stdout" => Way::Stdout,
            Some(("udp", address)) => {
                let fail = |source| HostError::Create { path: config.to.clone().into(), source };
                let local = if address.starts_with('[') { "[::]:0" } else { "0.0.0.0:0" };
                let socket = UdpSocket::bind(local).map_err(fail)?;
                socket.connect(address).map_err(fail)?;
                socket.set_nonblocking(true).map_err(fail)?;
                Way::Udp(socket)
            }
            Some(("unix", path)) => {
                let (listener, file) = SocketFile::listen(Path::new(path))?;
                listener
                    .set_nonblocking(true)
                    .map_err(|source| HostError::Create { path: path.into(), source })?;
                Way::Unix { listener, clients: Vec::new(), _file: file }
            }
            _ => {
                return Err(HostError::Argument {
                    what: "output.json.to".into(),
                    reason: format!("`{}` is none of stdout, udp:HOST:PORT, unix:PATH", config.to),
                });
            }
        };
        Self::start(format!("json to {}", config.to), way, config.queue, sources)
    }

    /// Events as lines of text on standard error, for people and the journal.
    ///
    /// # Errors
    /// When no thread can be started.
    pub fn log(sources: Vec<SourceInfo>) -> Result<Self, HostError> {
        let log = Self::start("log".into(), Way::Stderr, 64, sources)?;
        Ok(Self { frames: false, ..log })
    }

    fn start(
        name: String,
        way: Way,
        depth: usize,
        sources: Vec<SourceInfo>,
    ) -> Result<Self, HostError> {
        let (feeder, lines) = queue(depth);
        let writer = thread::Builder::new()
            .name("tsda-json".into())
            .spawn(move || write_lines(&lines, way, &sources))
            .map_err(|source| HostError::Create { path: name.clone().into(), source })?;
        Ok(Self { name, feeder, writer: Some(writer), frames: true })
    }
}

impl Output for JsonLines {
    fn name(&self) -> &str {
        &self.name
    }

    fn frame(&mut self, record: &FrameRecord, _: &Views<'_>) {
        if self.frames {
            self.feeder.offer(Line::Frame(*record));
        }
    }

    fn event(&mut self, event: &Event) {
        self.feeder.offer(Line::Event(event.clone()));
    }

    fn losses(&self) -> &Losses {
        self.feeder.losses()
    }

    fn finish(&mut self) {
        self.feeder.close();
        linger(self.writer.take(), LINGER);
    }
}

fn write_lines(lines: &Receiver<Line>, mut way: Way, sources: &[SourceInfo]) {
    let mut text = Vec::with_capacity(1024);
    while let Ok(line) = lines.recv() {
        text.clear();
        let encoded = match (&line, &way) {
            (Line::Event(event), Way::Stderr) => describe(event, sources, &mut text),
            (Line::Frame(record), _) => encode(&JsonFrame::new(record, sources), &mut text),
            (Line::Event(event), _) => encode(&JsonEvent::new(event, sources), &mut text),
        };
        // The end of a pipe or a socket ends the output, not the run.
        if encoded.and_then(|()| way.write(&text)).is_err() {
            return;
        }
    }
}

/// A record as a line of JSON.
pub(super) fn frame_line(record: &FrameRecord, sources: &[SourceInfo]) -> Vec<u8> {
    let mut text = Vec::with_capacity(512);
    // Plain numbers and names: cannot fail, and an empty line is skipped by every reader.
    let _ = encode(&JsonFrame::new(record, sources), &mut text);
    text
}

/// An event as a line of JSON.
pub(super) fn event_line(event: &Event, sources: &[SourceInfo]) -> Vec<u8> {
    let mut text = Vec::with_capacity(256);
    let _ = encode(&JsonEvent::new(event, sources), &mut text);
    text
}

fn encode(value: &impl Serialize, text: &mut Vec<u8>) -> io::Result<()> {
    serde_json::to_writer(&mut *text, value)?;
    text.push(b'\n');
    Ok(())
}

impl Way {
    fn write(&mut self, text: &[u8]) -> io::Result<()> {
        match self {
            Self::Stdout => {
                let mut out = io::stdout().lock();
                out.write_all(text)?;
                out.flush()
            }
            Self::Stderr => io::stderr().lock().write_all(text),
            Self::Udp(socket) => {
                // Nobody may be listening yet.
                let _ = socket.send(text);
                Ok(())
            }
            Self::Unix { listener, clients, .. } => {
                while let Ok((client, _)) = listener.accept() {
                    if client.set_nonblocking(true).is_ok() {
                        clients.push(client);
                    }
                }
                // A client that does not keep up would get half a line; it has to come again.
                clients.retain_mut(|c| c.write(text).is_ok_and(|n| n == text.len()));
                Ok(())
            }
        }
    }
}

#[derive(Serialize)]
struct JsonFrame<'a> {
    #[serde(rename = "type")]
    kind: &'static str,
    frame: u64,
    t: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    capture: Option<f64>,
    source: &'a str,
    sensor: Modality,
    size: [usize; 2],
    sequence: u32,
    picture: &'static str,
    #[serde(skip_serializing_if = "Option::is_none", rename = "box")]
    bbox: Option<[f32; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    score: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    confidence: Option<f32>,
    /// `idle` without a target.
    state: &'static str,
    predicted: bool,
    redetected: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    celsius: Option<Temperature>,
    latency_ms: f32,
    track_ms: f32,
    skipped: u32,
}

/// Milliseconds, to a microsecond.
fn ms(time: Duration) -> f32 {
    time.as_micros() as f32 / 1e3
}

fn source_name(sources: &[SourceInfo], index: usize) -> &str {
    sources.get(index).map_or("?", |s| s.name.as_str())
}

impl<'a> JsonFrame<'a> {
    fn new(r: &FrameRecord, sources: &'a [SourceInfo]) -> Self {
        let target = r.target.as_ref();
        Self {
            kind: "frame",
            frame: r.frame,
            t: r.at.as_secs_f64(),
            capture: r.capture.map(|c| c.as_secs_f64()),
            source: source_name(sources, r.source),
            sensor: sources.get(r.source).map_or(Modality::Rgb, |s| s.sensor),
            size: r.size.into(),
            sequence: r.sequence,
            picture: r.condition.as_str(),
            bbox: target.map(|t| [t.bbox.x, t.bbox.y, t.bbox.w, t.bbox.h]),
            score: target.map(|t| t.score),
            confidence: target.and_then(|t| t.confidence),
            state: target.map_or("idle", |t| TrackState::as_str(t.state)),
            predicted: target.is_some_and(|t| t.predicted),
            redetected: target.is_some_and(|t| t.redetected),
            celsius: target.and_then(|t| t.temperature),
            latency_ms: ms(r.latency),
            track_ms: ms(r.tracking),
            skipped: r.skipped,
        }
    }
}

#[derive(Default, Serialize)]
struct JsonEvent<'a> {
    #[serde(rename = "type")]
    kind: &'static str,
    t: f64,
    frame: u64,
    event: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    source: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    from: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    to: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none", rename = "box")]
    bbox: Option<[f32; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reason: Option<String>,
}

impl<'a> JsonEvent<'a> {
    fn new(e: &Event, sources: &'a [SourceInfo]) -> Self {
        let name = |i: usize| Some(source_name(sources, i));
        let base = Self { kind: "event", t: e.at.as_secs_f64(), frame: e.frame, ..Self::default() };
        match &e.kind {
            EventKind::Started => Self { event: "started", ..base },
            EventKind::Selected { source, bbox } => Self {
                event: "selected",
                source: name(*source),
                bbox: Some([bbox.x, bbox.y, bbox.w, bbox.h]),
                ..base
            },
            EventKind::Released => Self { event: "released", ..base },
            EventKind::Switched { from, to, reason } => Self {
                event: "switched",
                from: name(*from),
                to: name(*to),
                reason: Some(reason.to_string()),
                ..base
            },
            EventKind::Lost { source, condition } => Self {
                event: "camera_lost",
                source: name(*source),
                reason: Some(condition.to_string()),
                ..base
            },
            EventKind::Back { source } => {
                Self { event: "camera_back", source: name(*source), ..base }
            }
            EventKind::Unavailable { source, reason } => Self {
                event: "camera_unavailable",
                source: name(*source),
                reason: Some(reason.clone()),
                ..base
            },
            EventKind::Throttled { on, celsius } => Self {
                event: if *on { "throttled" } else { "unthrottled" },
                reason: Some(format!("{celsius:.1} degrees Celsius")),
                ..base
            },
            EventKind::Refused { what } => {
                Self { event: "refused", reason: Some(what.clone()), ..base }
            }
            EventKind::Ended { why } => {
                Self { event: "ended", reason: Some((*why).to_owned()), ..base }
            }
        }
    }
}

/// An event as a line of text.
fn describe(event: &Event, sources: &[SourceInfo], text: &mut Vec<u8>) -> io::Result<()> {
    let e = JsonEvent::new(event, sources);
    write!(text, "tsda: {:.3} s, frame {}: {}", e.t, e.frame, e.event.replace('_', " "))?;
    for (word, value) in [("", e.source), (" from", e.from), (" to", e.to)] {
        if let Some(value) = value {
            write!(text, "{word} {value}")?;
        }
    }
    if let Some([x, y, w, h]) = e.bbox {
        write!(text, " at {x:.1}, {y:.1}, {w:.1} x {h:.1}")?;
    }
    if let Some(reason) = e.reason {
        write!(text, " ({reason})")?;
    }
    text.push(b'\n');
    Ok(())
}
