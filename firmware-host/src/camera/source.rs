//! A camera as a source of the run: survives errors, unplugging and coming back.

use super::open::{OpenError, open};
use super::stream::{Progress, Stream};
use crate::error::HostError;
use crate::host::Clock;
use crate::host::config::V4l2Config;
use crate::host::source::{Captured, Counters, Polled, Source};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

/// How often a device that is not there is looked for.
const LOOK: Duration = Duration::from_millis(100);
/// Without a picture for so long, the stream is started anew.
const STALL: Duration = Duration::from_secs(5);

/// A V4L2 camera.
#[derive(Debug)]
pub struct CameraSource {
    config: V4l2Config,
    state: State,
    counters: Counters,
    /// Time of the run and moment of the newest picture.
    at: Duration,
    newest: Instant,
    what: String,
    rate: Option<f64>,
    trouble: Option<String>,
}

#[derive(Debug)]
enum State {
    Running(Box<Stream>),
    Opening { attempts: Receiver<Attempt>, stop: Arc<AtomicBool>, gone: bool },
}

/// What the thread that opens a device has to say.
#[derive(Debug)]
enum Attempt {
    Opened(Box<Stream>),
    /// Not yet, and why; said again only when the reason is another.
    Failed {
        reason: String,
        absent: bool,
    },
}

impl CameraSource {
    /// Opens a camera. One that is not there is an error unless it is to be waited for.
    ///
    /// # Errors
    /// When it cannot be used.
    pub fn open(name: &str, config: &V4l2Config) -> Result<Self, HostError> {
        let refused = |e: OpenError| HostError::Argument {
            what: format!("source `{name}`"),
            reason: e.to_string(),
        };
        let mut what = config.device.display().to_string();
        let mut rate = config.rate;
        let state = match open(config) {
            Ok(stream) => {
                stream.describe().clone_into(&mut what);
                rate = stream.shape().rate.or(rate);
                State::Running(Box::new(stream))
            }
            Err(e) if config.wait && e.may_pass() => opening(config, true).map_err(refused)?,
            Err(e) => return Err(refused(e)),
        };
        Ok(Self {
            config: config.clone(),
            state,
            counters: Counters::default(),
            at: Duration::ZERO,
            newest: Instant::now(),
            what,
            rate,
            trouble: None,
        })
    }

    /// Gives the stream up and looks for the device from another thread: opening one takes up to
    /// seconds.
    fn reopen(&mut self, gone: bool) -> Result<(), HostError> {
        let refused =
            |e: OpenError| HostError::Argument { what: "camera".into(), reason: e.to_string() };
        // The old stream has to be closed first: a device streams once.
        let (_, empty) = sync_channel(1);
        let none = Arc::new(AtomicBool::new(true));
        self.state = State::Opening { attempts: empty, stop: none, gone };
        self.state = opening(&self.config, gone).map_err(refused)?;
        Ok(())
    }
}

/// Starts a thread that opens the device as soon as it can be opened.
fn opening(config: &V4l2Config, gone: bool) -> Result<State, OpenError> {
    let (tell, attempts) = sync_channel(1);
    let stop = Arc::new(AtomicBool::new(false));
    let (config, stopped) = (config.clone(), Arc::clone(&stop));
    let device = config.device.display().to_string();
    thread::Builder::new()
        .name("tsda-reopen".into())
        .spawn(move || {
            let mut told = String::new();
            while !stopped.load(Ordering::Relaxed) {
                // Whatever is wrong now may be right later: another device may have the name for a
                // while, or the writer of a loopback may not have set its format yet.
                match open(&config) {
                    Ok(stream) => {
                        let _ = tell.send(Attempt::Opened(Box::new(stream)));
                        return;
                    }
                    Err(e) => {
                        let reason = e.to_string();
                        if told != reason {
                            told.clone_from(&reason);
                            let absent = e.is_absent();
                            if tell.send(Attempt::Failed { reason, absent }).is_err() {
                                return;
                            }
                        }
                        thread::sleep(LOOK);
                    }
                }
            }
        })
        .map_err(|source| OpenError::System { device, what: "start a thread", source })?;
    Ok(State::Opening { attempts, stop, gone })
}

impl Source for CameraSource {
    fn poll(&mut self, clock: &Clock, wait: Duration) -> Result<Polled, HostError> {
        match &mut self.state {
            State::Running(stream) => match stream.advance(wait, &mut self.counters) {
                Progress::Fresh => {
                    (self.at, self.newest) = (clock.now(), Instant::now());
                    return Ok(Polled::Fresh);
                }
                Progress::Nothing if self.newest.elapsed() < STALL => return Ok(Polled::Nothing),
                Progress::Nothing | Progress::Broken => {
                    self.counters.restarts += 1;
                    self.reopen(false)?;
                }
                Progress::Gone => {
                    self.counters.unplugged += 1;
                    self.reopen(true)?;
                }
            },
            State::Opening { attempts, gone, .. } => {
                let was_gone = *gone;
                match attempts.recv_timeout(wait) {
                    Ok(Attempt::Opened(stream)) => {
                        stream.describe().clone_into(&mut self.what);
                        self.newest = Instant::now();
                        self.state = State::Running(stream);
                        return Ok(Polled::Nothing);
                    }
                    Ok(Attempt::Failed { reason, absent }) => {
                        // Pulled out while its stream was being restarted.
                        if absent && !was_gone {
                            *gone = true;
                            self.counters.unplugged += 1;
                        }
                        self.trouble = Some(reason);
                    }
                    Err(RecvTimeoutError::Timeout) => {}
                    // The thread ended without a stream; it did not live long enough to wait.
                    Err(RecvTimeoutError::Disconnected) => {
                        clock.sleep(wait.min(LOOK));
                        self.reopen(was_gone)?;
                    }
                }
            }
        }
        let gone = matches!(self.state, State::Opening { gone: true, .. });
        Ok(if gone { Polled::Gone } else { Polled::Nothing })
    }

    fn frame(&self) -> Option<Captured<'_>> {
        match &self.state {
            State::Running(stream) => stream.frame(self.at),
            State::Opening { .. } => None,
        }
    }

    fn trouble(&mut self) -> Option<String> {
        self.trouble.take()
    }

    fn counters(&self) -> Counters {
        self.counters
    }

    fn rate(&self) -> Option<f64> {
        self.rate
    }

    fn describe(&self) -> String {
        self.what.clone()
    }
}

impl Drop for State {
    fn drop(&mut self) {
        if let Self::Opening { stop, .. } = self {
            stop.store(true, Ordering::Relaxed);
        }
    }
}
