//! The way to the client: pipes, or a port it listens on.

use super::error::TraxError;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpStream};

/// Reader and writer of a session.
pub struct Connection {
    /// From the client.
    pub input: Box<dyn Read>,
    /// To the client.
    pub output: Box<dyn Write>,
}

impl core::fmt::Debug for Connection {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Connection")
    }
}

impl Connection {
    /// As the environment says: the port `TRAX_SOCKET` of this machine, else the descriptors
    /// `TRAX_IN` and `TRAX_OUT`, else standard input and output.
    ///
    /// # Errors
    /// Names the variable that cannot be followed.
    pub fn from_environment() -> Result<Self, TraxError> {
        let get = |name| std::env::var_os(name).map(|v| v.to_string_lossy().into_owned());
        if let Some(value) = get("TRAX_SOCKET") {
            return Self::socket(&value);
        }
        let number = |name, standard| match get(name) {
            Some(value) => descriptor(name, &value, standard),
            None => Ok(None),
        };
        let input: Box<dyn Read> = match number("TRAX_IN", 0)? {
            Some(file) => Box::new(file),
            None => Box::new(std::io::stdin()),
        };
        let output: Box<dyn Write> = match number("TRAX_OUT", 1)? {
            Some(file) => Box::new(file),
            None => Box::new(std::io::stdout()),
        };
        Ok(Self { input, output })
    }

    fn socket(value: &str) -> Result<Self, TraxError> {
        let fail = |reason: String| TraxError::Environment {
            variable: "TRAX_SOCKET",
            value: value.to_owned(),
            reason,
        };
        let port = value.trim().parse::<u16>().ok().filter(|&p| p > 0);
        let port = port.ok_or_else(|| fail("a port from 1 to 65535 is expected".into()))?;
        let refused = |e| fail(format!("nobody can be reached on that port of this machine: {e}"));
        let stream = TcpStream::connect((Ipv4Addr::LOCALHOST, port)).map_err(refused)?;
        // Messages are short and waited for.
        stream.set_nodelay(true).map_err(refused)?;
        let output = stream.try_clone().map_err(refused)?;
        Ok(Self { input: Box::new(stream), output: Box::new(output) })
    }
}

/// Opens a descriptor by its number; `None` when that is the standard one. The system is asked for
/// it by name: taking over a number somebody else owns cannot be done safely.
fn descriptor(
    variable: &'static str,
    value: &str,
    standard: u32,
) -> Result<Option<File>, TraxError> {
    let fail =
        |reason: String| TraxError::Environment { variable, value: value.to_owned(), reason };
    let number: u32 = value
        .trim()
        .parse()
        .map_err(|_| fail("the number of an open file descriptor is expected".into()))?;
    if number == standard {
        return Ok(None);
    }
    if !cfg!(unix) {
        return Err(fail("descriptors are only known on Unix; use TRAX_SOCKET".into()));
    }
    OpenOptions::new()
        .read(standard == 0)
        .write(standard == 1)
        .open(format!("/dev/fd/{number}"))
        .map(Some)
        .map_err(|e| fail(format!("the descriptor cannot be opened: {e}")))
}
