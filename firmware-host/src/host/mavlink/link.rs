//! The line MAVLink goes over.

use super::super::sys;
use crate::error::HostError;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read as _, Write as _};
use std::net::{SocketAddr, ToSocketAddrs as _, UdpSocket};
use std::time::{Duration, Instant};

/// How long a read may take; also how late records are seen.
const WAIT: Duration = Duration::from_millis(20);
/// Stations that are answered at a time.
const STATIONS: usize = 8;
/// A station that was silent for so long is forgotten.
const SILENCE: Duration = Duration::from_secs(10);

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
    Serial(File),
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
                let line = open_line(device).map_err(fail)?;
                sys::serial(&line, baud).map_err(fail)?;
                Ok(Self::Serial(line))
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
                let quiet = matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut);
                // Nobody there (refused), a line that was pulled out: not a reason to spin.
                if !quiet {
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
            Self::Serial(line) => drop(line.write_all(frame)),
        }
    }
}

#[cfg(target_os = "linux")]
fn open_line(device: &str) -> io::Result<File> {
    use std::os::unix::fs::OpenOptionsExt as _;
    // Not the program's controlling terminal.
    OpenOptions::new().read(true).write(true).custom_flags(libc::O_NOCTTY).open(device)
}

#[cfg(not(target_os = "linux"))]
fn open_line(device: &str) -> io::Result<File> {
    OpenOptions::new().read(true).write(true).open(device)
}
