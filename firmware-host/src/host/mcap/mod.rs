//! Recordings in MCAP files that Foxglove opens: pictures as JPEG, the box over them, records and
//! events. Files grow under their own name and are readable up to the last flushed chunk whatever
//! happens; a new one is begun at a size, and the oldest go when all together become too large.

mod schemas;
pub mod writer;

use self::writer::{Topic, Writer};
use super::config::McapConfig;
use super::json::{event_line, frame_line};
use super::output::{Event, Feeder, FrameRecord, Losses, Output, SourceInfo, Views, linger, queue};
use super::shot::{Camera, Encoder, Pool, Shot, camera};
use crate::error::HostError;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// A chunk is written out at this size at the latest.
const CHUNK: usize = 1 << 20;
/// A file has at most so many chunks: their index stays in memory until the file ends, about 150 bytes
/// each.
const CHUNKS: u32 = 4096;
/// After a failure a new file is tried so much later.
const RETRY: Duration = Duration::from_secs(10);
/// The last chunk has to reach the disk, which may be slow.
const SYNCED: Duration = Duration::from_secs(5);
const MEGABYTE: u64 = 1 << 20;

enum Item {
    Frame(FrameRecord),
    Shot(Box<Shot>),
    Event(Event),
}

/// A recording.
pub struct Recorder {
    name: String,
    feeder: Feeder<Item>,
    camera: Option<Camera>,
    worker: Option<JoinHandle<()>>,
}

impl std::fmt::Debug for Recorder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Recorder").field("name", &self.name).finish_non_exhaustive()
    }
}

impl Recorder {
    /// Begins the first file in `dir`.
    ///
    /// # Errors
    /// When a key makes no sense or the folder cannot be written to.
    pub fn open(
        config: &McapConfig,
        dir: PathBuf,
        sources: Vec<SourceInfo>,
    ) -> Result<Self, HostError> {
        let refuse = |key: &str, reason: &str| HostError::Argument {
            what: format!("output.mcap.{key}"),
            reason: reason.into(),
        };
        if config.dir.as_os_str().is_empty() {
            return Err(refuse("dir", "a folder has to be given"));
        }
        if !(0.0..=1000.0).contains(&config.rate) {
            return Err(refuse("rate", "0 to 1000 pictures per second"));
        }
        if !(1..=100).contains(&config.quality) {
            return Err(refuse("quality", "between 1 and 100"));
        }
        if config.file_mb == 0 || (config.total_mb > 0 && config.total_mb < 2 * config.file_mb) {
            return Err(refuse(
                "total_mb",
                "file_mb at least 1, total_mb 0 or at least twice file_mb",
            ));
        }
        if !(0.05..=3600.0).contains(&config.flush_s) {
            return Err(refuse("flush_s", "0.05 to 3600 seconds"));
        }
        let name = format!("recording in {}", dir.display());
        let fail = |source| HostError::Create { path: dir.clone(), source };
        fs::create_dir_all(&dir).map_err(fail)?;
        let (camera, pool) = if config.rate > 0.0 {
            let (camera, pool) = camera(sources.len(), 4, config.rate);
            (Some(camera), Some(pool))
        } else {
            (None, None)
        };
        let (feeder, items) = queue(config.queue);
        let mut files = Files {
            topics: topics(&sources),
            dir: dir.clone(),
            file_bytes: config.file_mb * MEGABYTE,
            total_bytes: config.total_mb * MEGABYTE,
            flush: Duration::from_secs_f64(config.flush_s),
            number: 0,
            open: None,
            flushed: Instant::now(),
            failed: None,
            losses: feeder.losses().clone(),
        };
        files.begin().map_err(fail)?;
        let recording = Recording {
            files,
            sources,
            encoder: Encoder::new(config.quality, config.size),
            pool,
            jpeg: Vec::new(),
            message: Vec::new(),
            origin: None,
            last: None,
        };
        let worker = thread::Builder::new()
            .name("tsda-mcap".into())
            .spawn(move || recording.write(&items))
            .map_err(fail)?;
        Ok(Self { name, feeder, camera, worker: Some(worker) })
    }
}

impl Output for Recorder {
    fn name(&self) -> &str {
        &self.name
    }

    fn frame(&mut self, record: &FrameRecord, views: &Views<'_>) {
        self.feeder.offer(Item::Frame(*record));
        let shot = self.camera.as_mut().and_then(|c| c.shoot(record.at, record, views));
        if let Some(shot) = shot {
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
        linger(self.worker.take(), SYNCED);
    }
}

/// Two per source, then records and events.
fn topics(sources: &[SourceInfo]) -> Vec<Topic> {
    let mut topics = Vec::with_capacity(sources.len() * 2 + 2);
    for source in sources {
        let plain = |c: char| if c.is_whitespace() || c == '/' { '_' } else { c };
        let name: String = source.name.chars().map(plain).collect();
        topics.push(Topic { name: format!("/{name}/image"), schema: schemas::IMAGE_AT });
        topics
            .push(Topic { name: format!("/{name}/annotations"), schema: schemas::ANNOTATIONS_AT });
    }
    topics.push(Topic { name: "/tracker/record".into(), schema: schemas::RECORD_AT });
    topics.push(Topic { name: "/tracker/event".into(), schema: schemas::EVENT_AT });
    topics
}

/// The output's thread.
struct Recording {
    files: Files,
    sources: Vec<SourceInfo>,
    encoder: Encoder,
    pool: Option<Pool>,
    /// A picture, and the message it goes into. Kept: large blocks of ever other sizes leave an
    /// allocator's heap in pieces.
    jpeg: Vec<u8>,
    message: Vec<u8>,
    /// Nanoseconds since 1970 at the time 0 of the run.
    origin: Option<u64>,
    /// Source of the last record.
    last: Option<usize>,
}

impl Recording {
    fn write(mut self, items: &Receiver<Item>) {
        loop {
            match items.recv_timeout(self.files.flush) {
                Ok(item) => self.take(item),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return self.files.end(),
            }
            self.files.keep_up();
        }
    }

    fn time(&mut self, at: Duration) -> u64 {
        let nanos = |d: Duration| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX);
        let origin = *self.origin.get_or_insert_with(|| {
            nanos(SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default())
                .saturating_sub(nanos(at))
        });
        origin.saturating_add(nanos(at))
    }

    fn take(&mut self, item: Item) {
        let n = self.sources.len();
        match item {
            Item::Frame(record) => {
                let time = self.time(record.at);
                if let Some(before) = self.last.replace(record.source)
                    && before != record.source
                {
                    self.files.message(2 * before + 1, time, &schemas::annotations(time, None, 1));
                }
                let step = self.encoder.step(record.size.0, record.size.1);
                let box_ = schemas::annotations(time, Some(&record), step);
                self.files.message(2 * record.source + 1, time, &box_);
                self.files.message(
                    2 * n,
                    time,
                    frame_line(&record, &self.sources).trim_ascii_end(),
                );
            }
            Item::Event(event) => {
                let time = self.time(event.at);
                let line = event_line(&event, &self.sources);
                self.files.message(2 * n + 1, time, line.trim_ascii_end());
            }
            Item::Shot(shot) => {
                let time = self.time(shot.record.at);
                for (i, source) in self.sources.iter().enumerate() {
                    let made = shot.view(i).map(|v| self.encoder.jpeg(&v, &mut self.jpeg));
                    if let Some(Ok(_)) = made {
                        schemas::image(time, &source.name, &self.jpeg, &mut self.message);
                        self.files.message(2 * i, time, &self.message);
                    }
                }
                if let Some(pool) = &self.pool {
                    pool.give_back(shot);
                }
            }
        }
    }
}

/// The files of a folder.
struct Files {
    topics: Vec<Topic>,
    dir: PathBuf,
    file_bytes: u64,
    total_bytes: u64,
    flush: Duration,
    number: u32,
    open: Option<Writer<File>>,
    flushed: Instant,
    failed: Option<Instant>,
    losses: Losses,
}

impl Files {
    fn message(&mut self, topic: usize, time: u64, data: &[u8]) {
        match &mut self.open {
            Some(writer) => writer.message(topic, time, data),
            None => self.losses.add(),
        }
    }

    /// Writes out, begins a new file, removes old ones, when it is time.
    fn keep_up(&mut self) {
        let done = (|| {
            let Some(writer) = &mut self.open else {
                return match self.failed {
                    Some(at) if at.elapsed() < RETRY => Ok(()),
                    _ => self.begin(),
                };
            };
            let full = writer.size() >= self.file_bytes || writer.chunks() >= CHUNKS;
            if full || writer.unflushed() >= CHUNK || self.flushed.elapsed() >= self.flush {
                writer.flush()?;
                writer.inner().sync_data()?;
                self.flushed = Instant::now();
            }
            if full {
                let next = self.create()?;
                if let Some(writer) = &mut self.open {
                    writer.next(next)?.sync_data()?;
                }
            }
            Ok(())
        })();
        self.check(done);
    }

    /// A full disk must not end the run: it is said once, and tried again later.
    fn check(&mut self, done: io::Result<()>) {
        if let Err(e) = done {
            let place = self.dir.display();
            let _ = writeln!(io::stderr(), "tsda: warning: recording in {place} failed: {e}");
            self.open = None;
            self.failed = Some(Instant::now());
        }
    }

    fn end(&mut self) {
        let done = match self.open.take() {
            Some(writer) => writer.finish().and_then(|file| file.sync_data()),
            None => Ok(()),
        };
        self.check(done);
    }

    fn begin(&mut self) -> io::Result<()> {
        let file = self.create()?;
        self.open = Some(Writer::new(file, &schemas::ALL, &self.topics, CHUNK)?);
        self.flushed = Instant::now();
        self.failed = None;
        Ok(())
    }

    /// Makes the next file, and room for it.
    fn create(&mut self) -> io::Result<File> {
        self.make_room()?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
        loop {
            let path = self.dir.join(format!("tsda-{}-{:04}.mcap", date(now), self.number));
            match OpenOptions::new().write(true).create_new(true).open(path) {
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => self.number += 1,
                made => {
                    self.number += u32::from(made.is_ok());
                    return made;
                }
            }
        }
    }

    /// Removes the oldest recordings until another whole file fits.
    fn make_room(&self) -> io::Result<()> {
        if self.total_bytes == 0 {
            return Ok(());
        }
        let mut found = Vec::new();
        for entry in fs::read_dir(&self.dir)? {
            let entry = entry?;
            if is_ours(&entry.path()) {
                found.push((entry.path(), entry.metadata()?.len()));
            }
        }
        found.sort();
        let mut sum: u64 = found.iter().map(|f| f.1).sum();
        for (path, size) in found {
            if sum + self.file_bytes <= self.total_bytes {
                break;
            }
            fs::remove_file(path)?;
            sum -= size;
        }
        Ok(())
    }
}

/// `tsda-20261122-214500-0000.mcap`; anything else in the folder is left alone.
fn is_ours(path: &Path) -> bool {
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
    let Some(middle) = name.strip_prefix("tsda-").and_then(|n| n.strip_suffix(".mcap")) else {
        return false;
    };
    let parts: Vec<&str> = middle.split('-').collect();
    matches!(parts[..], [day, time, n] if day.len() == 8 && time.len() == 6 && n.len() >= 4)
        && parts.iter().all(|p| p.bytes().all(|b| b.is_ascii_digit()))
}

/// Universal time as `20261122-214500`; names in this form sort by age.
fn date(seconds: u64) -> String {
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    // Years begin in March here, so that the day of leap years is their last.
    let days = days + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let (month, turn) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    let year = era * 400 + year + turn;
    let (h, m, s) = (rest / 3600, rest / 60 % 60, rest % 60);
    format!("{year:04}{month:02}{day:02}-{h:02}{m:02}{s:02}")
}

#[cfg(test)]
mod tests;
