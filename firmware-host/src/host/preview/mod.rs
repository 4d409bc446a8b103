//! A page for a browser: what the sensors see, the box, score and latency; draw a box to select a
//! target. Pictures are made only while somebody looks.

use super::config::PreviewConfig;
use super::control::{Command, Commands};
use super::http::{Access, Handler, Method, Request, Responder, Server};
use super::json::{event_line, frame_line};
use super::metrics::Metrics;
use super::output::{
    Event, Feeder, FrameRecord, LINGER, Losses, Output, SourceInfo, Views, linger, queue,
};
use super::shot::{Camera, Encoder, Pool, Shot, camera};
use crate::error::HostError;
use std::collections::VecDeque;
use std::io::{self, Write as _};
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

const PAGE: &str = include_str!("page.html");
/// The page may load nothing from elsewhere.
const POLICY: &str = "Content-Security-Policy: default-src 'none'; script-src 'unsafe-inline'; \
                      style-src 'unsafe-inline'; connect-src 'self'; img-src blob:; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n";
/// Lines kept for clients of the event stream.
const LINES: usize = 512;
/// Longest wait for a new picture.
const PICTURE_WAIT: Duration = Duration::from_secs(2);
/// Pictures are made for so long after the last one was asked for.
const LOOKING: Duration = Duration::from_secs(3);
/// Shortest time between two bundles of lines.
const BUNDLE: Duration = Duration::from_millis(80);
/// A sign of life on a quiet event stream.
const ALIVE: Duration = Duration::from_secs(2);

enum Item {
    Frame(FrameRecord),
    Shot(Box<Shot>),
    Event(Event),
}

/// A source's newest picture.
struct Encoded {
    serial: u64,
    headers: String,
    jpeg: Vec<u8>,
}

#[derive(Default)]
struct State {
    /// Number of the newest line.
    serial: u64,
    lines: VecDeque<(u64, Arc<[u8]>)>,
    pictures: Vec<Option<Arc<Encoded>>>,
    shots: u64,
    ended: bool,
}

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    sources: Vec<SourceInfo>,
    commands: Commands,
    metrics: Option<Arc<Metrics>>,
    start: Instant,
    /// Milliseconds since `start` when a picture was last asked for; 0: never.
    looked: AtomicU64,
    /// Clients of the event stream.
    listeners: AtomicUsize,
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        // Every change is a single assignment: a poisoned state is as good as any.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn watched(&self) -> bool {
        let looked = self.looked.load(Ordering::Relaxed);
        let now = self.start.elapsed().as_millis() as u64;
        looked > 0 && now.saturating_sub(looked) < LOOKING.as_millis() as u64
    }
}

/// The preview.
pub struct Preview {
    name: String,
    feeder: Feeder<Item>,
    camera: Camera,
    shared: Arc<Shared>,
    worker: Option<JoinHandle<()>>,
    server: Option<Server>,
}

impl std::fmt::Debug for Preview {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Preview").field("name", &self.name).finish_non_exhaustive()
    }
}

impl Preview {
    /// Starts the server. `metrics`: also served here, under `/metrics`.
    ///
    /// # Errors
    /// When a key makes no sense or the address is taken.
    pub fn open(
        config: &PreviewConfig,
        access: Access,
        sources: Vec<SourceInfo>,
        commands: Commands,
        metrics: Option<Arc<Metrics>>,
    ) -> Result<Self, HostError> {
        let refuse = |key: &str, reason: &str| HostError::Argument {
            what: format!("output.preview.{key}"),
            reason: reason.into(),
        };
        if !(0.1..=120.0).contains(&config.rate) {
            return Err(refuse("rate", "between 0.1 and 120 pictures per second"));
        }
        if !(1..=100).contains(&config.quality) {
            return Err(refuse("quality", "between 1 and 100"));
        }
        let state = State { pictures: sources.iter().map(|_| None).collect(), ..State::default() };
        let (camera, pool) = camera(sources.len(), 3, config.rate);
        let shared = Arc::new(Shared {
            state: Mutex::new(state),
            changed: Condvar::new(),
            sources,
            commands,
            metrics,
            start: Instant::now(),
            looked: AtomicU64::new(0),
            listeners: AtomicUsize::new(0),
        });
        let server = Server::start(access, Arc::new(Page(Arc::clone(&shared))))?;
        let (feeder, items) = queue(config.queue);
        let (mine, encoder) = (Arc::clone(&shared), Encoder::new(config.quality, config.size));
        let name = format!("preview at http://{}", server.address());
        let worker = thread::Builder::new()
            .name("tsda-preview".into())
            .spawn(move || work(&items, &mine, encoder, &pool))
            .map_err(|source| HostError::Create { path: name.clone().into(), source })?;
        Ok(Self { name, feeder, camera, shared, worker: Some(worker), server: Some(server) })
    }

    /// Where it listens; `None` after the end.
    pub fn address(&self) -> Option<SocketAddr> {
        self.server.as_ref().map(Server::address)
    }
}

impl Output for Preview {
    fn name(&self) -> &str {
        &self.name
    }

    fn frame(&mut self, record: &FrameRecord, views: &Views<'_>) {
        if self.shared.listeners.load(Ordering::Relaxed) > 0 {
            self.feeder.offer(Item::Frame(*record));
        }
        if self.shared.watched()
            && let Some(shot) = self.camera.shoot(self.shared.start.elapsed(), record, views)
        {
            self.feeder.offer(Item::Shot(shot));
        }
    }

    fn event(&mut self, event: &Event) {
        self.feeder.offer(Item::Event(event.clone()));
    }

    fn losses(&self) -> &Losses {
        self.feeder.losses()
    }

    fn finish(&mut self) {
        self.feeder.close();
        linger(self.worker.take(), LINGER);
        self.shared.state().ended = true;
        self.shared.changed.notify_all();
        self.server = None;
    }
}

/// The output's thread: text and pictures from what the loop handed over.
fn work(items: &Receiver<Item>, shared: &Shared, mut encoder: Encoder, pool: &Pool) {
    while let Ok(item) = items.recv() {
        let line = match item {
            Item::Frame(record) => frame_line(&record, &shared.sources),
            Item::Event(event) => event_line(&event, &shared.sources),
            Item::Shot(shot) => {
                encode(&shot, shared, &mut encoder);
                pool.give_back(shot);
                continue;
            }
        };
        let mut state = shared.state();
        state.serial += 1;
        if state.lines.len() == LINES {
            state.lines.pop_front();
        }
        let entry = (state.serial, line.into());
        state.lines.push_back(entry);
        drop(state);
        shared.changed.notify_all();
    }
}

fn encode(shot: &Shot, shared: &Shared, encoder: &mut Encoder) {
    let record = ascii(&frame_line(&shot.record, &shared.sources));
    let mut pictures = Vec::with_capacity(shot.sources());
    for source in 0..shot.sources() {
        let mut jpeg = Vec::new();
        // A picture that cannot be encoded is as good as none.
        let made = shot
            .view(source)
            .and_then(|v| Some((encoder.jpeg(&v, &mut jpeg).ok()?, v.width(), v.height())));
        pictures.push(made.map(|(_, w, h)| (jpeg, w, h)));
    }
    let mut state = shared.state();
    state.shots += 1;
    let serial = state.shots;
    for (slot, made) in state.pictures.iter_mut().zip(pictures) {
        *slot = made.map(|(jpeg, w, h)| {
            let headers =
                format!("X-Serial: {serial}\r\nX-Size: {w} {h}\r\nX-Record: {record}\r\n");
            Arc::new(Encoded { serial, headers, jpeg })
        });
    }
    drop(state);
    shared.changed.notify_all();
}

/// A line of JSON as a header: other characters as escapes, no line end.
fn ascii(line: &[u8]) -> String {
    let mut text = String::with_capacity(line.len());
    for c in String::from_utf8_lossy(line).trim_end().chars() {
        if c.is_ascii() && !c.is_ascii_control() {
            text.push(c);
        } else {
            for unit in c.encode_utf16(&mut [0; 2]) {
                text += &format!("\\u{unit:04x}");
            }
        }
    }
    text
}

struct Page(Arc<Shared>);

impl Handler for Page {
    fn handle(&self, request: &Request, to: &mut Responder<'_>) -> io::Result<()> {
        match (request.method, request.path.as_str()) {
            (Method::Get, "/") => {
                to.reply(200, "text/html; charset=utf-8", POLICY, PAGE.as_bytes())
            }
            (Method::Get, "/info") => self.info(to),
            (Method::Get, "/picture") => self.picture(request, to),
            (Method::Get, "/events") => self.events(to),
            (Method::Post, "/command") => to.outcome(self.command(request)),
            (Method::Get, "/metrics") if self.0.metrics.is_some() => match &self.0.metrics {
                Some(metrics) => metrics.handle(request, to),
                None => Ok(()),
            },
            (_, "/" | "/info" | "/picture" | "/events" | "/command") => {
                to.outcome(Err((405, "not with this method".into())))
            }
            _ => to.outcome(Err((404, "there is nothing".into()))),
        }
    }
}

impl Page {
    fn info(&self, to: &mut Responder<'_>) -> io::Result<()> {
        let sources: Vec<_> = self
            .0
            .sources
            .iter()
            .map(|s| serde_json::json!({ "name": s.name, "sensor": s.sensor }))
            .collect();
        let info = serde_json::json!({ "version": env!("CARGO_PKG_VERSION"), "sources": sources });
        to.reply(200, "application/json", "", info.to_string().as_bytes())
    }

    /// The newest picture of a source, when it is newer than the one the client has.
    fn picture(&self, request: &Request, to: &mut Responder<'_>) -> io::Result<()> {
        let number = |name| request.query(name).and_then(|v| v.parse::<u64>().ok());
        let source = number("source").unwrap_or(0) as usize;
        if source >= self.0.sources.len() {
            return to.outcome(Err((404, "there is no such source".into())));
        }
        let (after, end) = (number("after").unwrap_or(0), Instant::now() + PICTURE_WAIT);
        let mut state = self.0.state();
        let found = loop {
            self.0
                .looked
                .store((self.0.start.elapsed().as_millis() as u64).max(1), Ordering::Relaxed);
            if let Some(newest) = &state.pictures[source]
                && newest.serial > after
            {
                break Some(Arc::clone(newest));
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() || state.ended {
                break None;
            }
            state = match self.0.changed.wait_timeout(state, left) {
                Ok((state, _)) => state,
                Err(e) => e.into_inner().0,
            };
        };
        drop(state);
        match found {
            Some(p) => to.reply(200, "image/jpeg", &p.headers, &p.jpeg),
            None => to.reply(204, "", "", &[]),
        }
    }

    /// Records and events as Server-Sent Events, from now on.
    fn events(&self, to: &mut Responder<'_>) -> io::Result<()> {
        let mut stream = to.endless("text/event-stream")?;
        self.0.listeners.fetch_add(1, Ordering::Relaxed);
        let mut done = || -> io::Result<()> {
            let (mut seen, mut text) = (self.0.state().serial, Vec::new());
            let mut spoke = Instant::now();
            loop {
                text.clear();
                let mut state = self.0.state();
                if state.serial == seen && !state.ended {
                    state = match self.0.changed.wait_timeout(state, Duration::from_millis(500)) {
                        Ok((state, _)) => state,
                        Err(e) => e.into_inner().0,
                    };
                }
                let ended = state.ended;
                for (_, line) in state.lines.iter().filter(|l| l.0 > seen) {
                    text.extend_from_slice(b"data: ");
                    text.extend_from_slice(line);
                    text.push(b'\n');
                }
                seen = state.serial;
                drop(state);
                if text.is_empty() && spoke.elapsed() > ALIVE {
                    text.extend_from_slice(b":\n\n");
                }
                if !text.is_empty() {
                    stream.write_all(&text)?;
                    spoke = Instant::now();
                }
                if ended {
                    return Ok(());
                }
                thread::sleep(BUNDLE);
            }
        };
        let done = done();
        self.0.listeners.fetch_sub(1, Ordering::Relaxed);
        done
    }

    fn command(&self, request: &Request) -> Result<(), (u16, String)> {
        // A form of another site cannot send this type without asking first.
        let kind = request.header("content-type").and_then(|v| v.split(';').next());
        if !kind.is_some_and(|k| k.trim().eq_ignore_ascii_case("application/json")) {
            return Err((415, "Content-Type has to be application/json".into()));
        }
        let text = str::from_utf8(&request.body).map_err(|e| (400, e.to_string()))?;
        let command = Command::parse(text).map_err(|e| (400, e))?;
        if command == Command::Quit {
            return Err((403, "the program is not ended from here".into()));
        }
        self.0.commands.give(command).map_err(|e| (503, e.into()))
    }
}

#[cfg(test)]
mod tests;
