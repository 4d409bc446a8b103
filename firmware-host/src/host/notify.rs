//! Tells systemd that the program runs (`Type=notify`), and its watchdog that pictures are processed.

use super::output::{Event, EventKind, FrameRecord, Losses, Output, Views};
use crate::error::HostError;
use crate::switch::Condition;
use std::env;
use std::os::unix::net::UnixDatagram;
use std::time::{Duration, Instant};

/// Messages to the service manager.
#[derive(Debug)]
pub struct Notify {
    socket: UnixDatagram,
    /// Time between two signs of life.
    every: Option<Duration>,
    last: Option<Instant>,
    losses: Losses,
}

impl Notify {
    /// Connects to the manager that the environment names; `None` without one.
    ///
    /// # Errors
    /// When a manager is named that cannot be reached.
    pub fn from_env() -> Result<Option<Self>, HostError> {
        let Some(path) = env::var_os("NOTIFY_SOCKET") else { return Ok(None) };
        let path = path.to_string_lossy().into_owned();
        let number = |name: &str| env::var(name).ok().and_then(|v| v.parse::<u64>().ok());
        // The watchdog may be meant for another process.
        let mine = number("WATCHDOG_PID").is_none_or(|pid| pid == u64::from(std::process::id()));
        let watchdog = number("WATCHDOG_USEC").filter(|n| mine && *n > 0);
        Self::connect(&path, watchdog.map(Duration::from_micros)).map(Some)
    }

    /// Connects to a socket; `watchdog`: time after which the manager ends a silent program.
    ///
    /// # Errors
    /// When nobody listens there.
    pub fn connect(path: &str, watchdog: Option<Duration>) -> Result<Self, HostError> {
        let fail = |source| HostError::Create { path: path.into(), source };
        let socket = UnixDatagram::unbound().map_err(fail)?;
        match path.strip_prefix('@') {
            None => socket.connect(path).map_err(fail)?,
            #[cfg(target_os = "linux")]
            Some(name) => {
                use std::os::linux::net::SocketAddrExt as _;
                let address = std::os::unix::net::SocketAddr::from_abstract_name(name);
                address.and_then(|a| socket.connect_addr(&a)).map_err(fail)?;
            }
            #[cfg(not(target_os = "linux"))]
            Some(_) => return Err(fail(std::io::ErrorKind::Unsupported.into())),
        }
        socket.set_nonblocking(true).map_err(fail)?;
        // Thrice within the time: one may be late.
        Ok(Self { socket, every: watchdog.map(|w| w / 3), last: None, losses: Losses::default() })
    }

    fn say(&self, text: &str) {
        if self.socket.send(text.as_bytes()).is_err() {
            self.losses.add();
        }
    }
}

impl Output for Notify {
    fn name(&self) -> &str {
        "systemd"
    }

    fn frame(&mut self, record: &FrameRecord, _: &Views<'_>) {
        let Some(every) = self.every else { return };
        // Only what was really processed: a camera that delivers nothing ends up at the watchdog.
        if record.condition == Condition::Good && self.last.is_none_or(|l| l.elapsed() >= every) {
            self.last = Some(Instant::now());
            self.say("WATCHDOG=1");
        }
    }

    fn event(&mut self, event: &Event) {
        match &event.kind {
            EventKind::Started => self.say("READY=1\nSTATUS=running"),
            EventKind::Ended { .. } => self.say("STOPPING=1"),
            _ => {}
        }
    }

    fn losses(&self) -> &Losses {
        &self.losses
    }

    fn finish(&mut self) {}
}
