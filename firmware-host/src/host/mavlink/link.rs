//! The line MAVLink goes over.

use super::super::sys;
use crate::error::HostError;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read as _, Write as _};
use std::net::{SocketAddr, ToSocketAddrs as _, UdpSocket};
use std::os::unix::fs::OpenOptionsExt as _;
use std::time::{Duration, Instant};

/// How long a read may take; also how late records are seen.
const WAIT: Duration = Duration::from_millis(20);
/// Stations that are answered at a time.
const STATIONS: usize = 8;
/// A station that was silent for so long is forgotten.
const SILENCE: Duration = Duration::from_secs(10);
/// A serial line that was lost is tried again after so long.
const RETRY: Duration = Duration::from_millis(500);

/// A line.
#[derive(Debug)]
pub enum Link {
    /// To one station.
    Udp(UdpSocket),
    /// To all that have spoken lately.
    UdpIn {
        /// Listens.
        socket: UdpSocket,
        /// Who spoke, and when.
        stations: Vec<(SocketAddr, Instant)>,
    },
    /// To an autopilot.
    Serial(Serial),
}

/// A serial line, which may be pulled out and put back.
#[derive(Debug)]
pub struct Serial {
    device: String,
    baud: u32,
    line: Option<File>,
    /// When it was last tried to be opened.
    tried: Instant,
}

impl Serial {
    fn open(device: &str, baud: u32) -> io::Result<Self> {
        let line = Some(open_line(device, baud)?);
        Ok(Self { device: device.to_owned(), baud, line, tried: Instant::now() })
    }

    /// The line, opened again where it was lost.
    fn line(&mut self) -> Option<&mut File> {
        if self.line.is_none() && self.tried.elapsed() >= RETRY {
            self.tried = Instant::now();
            self.line = open_line(&self.device, self.baud).ok();
            if self.line.is_some() {
                let _ = writeln!(io::stderr(), "tsda: mavlink: {} is back", self.device);
            }
        }
        self.line.as_mut()
    }

    /// Says once that the line is gone.
    fn lose(&mut self, why: &io::Error) {
        if self.line.take().is_some() {
            let device = &self.device;
            let _ = writeln!(io::stderr(), "tsda: warning: mavlink: {device} is gone: {why}");
            self.tried = Instant::now();
        }
    }

    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let Some(line) = self.line() else { return Err(ErrorKind::NotConnected.into()) };
        let got = match sys::readable(line, WAIT) {
            Ok(false) => return Err(ErrorKind::WouldBlock.into()),
            // Ready without a byte: hung up.
            Ok(true) => match line.read(buffer) {
                Ok(0) => Err(ErrorKind::UnexpectedEof.into()),
                got => got,
            },
            Err(e) => Err(e),
        };
        if let Err(e) = &got
            && !is_quiet(e)
        {
            self.lose(e);
        }
        got
    }

    fn send(&mut self, frame: &[u8]) {
        // In one go or not at all: it does not wait for a line that is full, and half a frame is
        // recognised by its checksum.
        if let Some(Err(e)) = self.line().map(|line| line.write(frame))
            && !is_quiet(&e)
        {
            self.lose(&e);
        }
    }
}

/// Nothing there yet, or no room; not that something is wrong.
fn is_quiet(e: &io::Error) -> bool {
    matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

impl Link {
    /// Opens `udp:HOST:PORT`, `udpin:ADDRESS:PORT` or `serial:DEVICE:BAUD`.
    ///
    /// # Errors
    /// When it is none of these, or cannot be opened.
    pub fn open(to: &str) -> Result<Self, HostError> {
        let fail = |source| HostError::Create { path: to.into(), source };
        let refuse = |reason: String| HostError::Argument {
            what: "output.mavlink.to".into(),
            reason: format!("`{to}`: {reason}"),
        };
        let address = |text: &str| {
            let found = text.to_socket_addrs().ok().and_then(|mut a| a.next());
            found.ok_or_else(|| refuse("no host and port".into()))
        };
        match to.split_once(':') {
            Some(("udp", rest)) => {
                let to = address(rest)?;
                let local = if to.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
                let socket = UdpSocket::bind(local).map_err(fail)?;
                socket.connect(to).map_err(fail)?;
                socket.set_read_timeout(Some(WAIT)).map_err(fail)?;
                Ok(Self::Udp(socket))
            }
            Some(("udpin", rest)) => {
                let socket = UdpSocket::bind(address(rest)?).map_err(fail)?;
                socket.set_read_timeout(Some(WAIT)).map_err(fail)?;
                Ok(Self::UdpIn { socket, stations: Vec::with_capacity(STATIONS) })
            }
            Some(("serial", rest)) => {
                let (device, baud) = rest
                    .rsplit_once(':')
                    .and_then(|(device, baud)| Some((device, baud.parse::<u32>().ok()?)))
                    .ok_or_else(|| {
                        refuse("a device and a speed: serial:/dev/ttyTHS1:57600".into())
                    })?;
                Serial::open(device, baud).map(Self::Serial).map_err(fail)
            }
            _ => {
                Err(refuse("none of udp:HOST:PORT, udpin:ADDRESS:PORT, serial:DEVICE:BAUD".into()))
            }
        }
    }

    /// Where it listens, for UDP.
    pub fn local(&self) -> Option<SocketAddr> {
        match self {
            Self::Udp(socket) | Self::UdpIn { socket, .. } => socket.local_addr().ok(),
            Self::Serial(_) => None,
        }
    }

    /// Waits a little for bytes; answers how many there are.
    pub fn read(&mut self, buffer: &mut [u8]) -> usize {
        let read = match self {
            Self::Udp(socket) => socket.recv(buffer),
            Self::UdpIn { socket, stations } => socket.recv_from(buffer).map(|(n, from)| {
                let now = Instant::now();
                stations.retain(|s| s.0 != from && now.duration_since(s.1) < SILENCE);
                if stations.len() < STATIONS {
                    stations.push((from, now));
                }
                n
            }),
            Self::Serial(line) => line.read(buffer),
        };
        match read {
            Ok(n) => n,
            Err(e) => {
                // Nobody there (refused), a line that was pulled out: not a reason to spin.
                if !is_quiet(&e) {
                    std::thread::sleep(WAIT);
                }
                0
            }
        }
    }

    /// Sends a frame; what cannot be sent now is lost, as on any radio.
    pub fn send(&mut self, frame: &[u8]) {
        match self {
            Self::Udp(socket) => drop(socket.send(frame)),
            Self::UdpIn { socket, stations } => {
                for (station, _) in stations {
                    let _ = socket.send_to(frame, *station);
                }
            }
            Self::Serial(line) => line.send(frame),
        }
    }
}

/// Opens a device that is not to become the program's terminal, and never waits.
fn open_line(device: &str, baud: u32) -> io::Result<File> {
    let flags = libc::O_NOCTTY | libc::O_NONBLOCK;
    let line = OpenOptions::new().read(true).write(true).custom_flags(flags).open(device)?;
    sys::serial(&line, baud)?;
    Ok(line)
}
