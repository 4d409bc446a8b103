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

#[cfg(test)]
mod tests {
    use super::super::output::FrameRecord;
    use super::*;

    fn record(condition: Condition) -> FrameRecord {
        FrameRecord {
            frame: 0,
            at: Duration::ZERO,
            capture: None,
            source: 0,
            size: (8, 8),
            sequence: 0,
            condition,
            target: None,
            latency: Duration::ZERO,
            tracking: Duration::ZERO,
            skipped: 0,
            allocations: 0,
        }
    }

    #[test]
    fn the_watchdog_is_fed_only_by_processed_pictures() {
        let dir = tempfile::tempdir().expect("temp");
        let path = dir.path().join("notify");
        let manager = UnixDatagram::bind(&path).expect("socket");
        manager.set_nonblocking(true).expect("socket");
        let heard = || {
            let mut bytes = [0; 100];
            let n = manager.recv(&mut bytes).ok()?;
            Some(String::from_utf8_lossy(&bytes[..n]).into_owned())
        };
        let path = path.to_str().expect("text");
        let mut notify = Notify::connect(path, Some(Duration::from_millis(90))).expect("connects");
        let event = |kind| Event { at: Duration::ZERO, frame: 0, kind };
        assert_eq!(heard(), None);
        notify.event(&event(EventKind::Started));
        assert_eq!(heard().as_deref(), Some("READY=1\nSTATUS=running"));
        for condition in [Condition::Late, Condition::Dark, Condition::Shutter] {
            notify.frame(&record(condition), &Views(&[]));
            assert_eq!(heard(), None, "{condition}");
        }
        notify.frame(&record(Condition::Good), &Views(&[]));
        assert_eq!(heard().as_deref(), Some("WATCHDOG=1"));
        std::thread::sleep(Duration::from_millis(31));
        notify.frame(&record(Condition::Good), &Views(&[]));
        assert_eq!(heard().as_deref(), Some("WATCHDOG=1"));
        notify.event(&event(EventKind::Ended { why: "signal" }));
        assert_eq!(heard().as_deref(), Some("STOPPING=1"));

        let mut quiet = Notify::connect(path, None).expect("connects");
        quiet.frame(&record(Condition::Good), &Views(&[]));
        assert_eq!(heard(), None, "no watchdog is set");
        drop(manager);
        notify.event(&event(EventKind::Started));
        assert_eq!(notify.losses().count(), 1);
        assert!(Notify::connect("/no/such/socket", None).is_err());
    }
}
