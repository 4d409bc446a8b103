//! Commands while running: one JSON object per line, on standard input or over a Unix socket.

use crate::error::HostError;
use serde::Deserialize;
use std::io::{self, BufRead, BufReader, Read as _, Write as _};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;

/// What can be asked for.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "cmd", rename_all = "snake_case", deny_unknown_fields)]
#[non_exhaustive]
pub enum Command {
    /// Follow what is in this box from the next good picture on.
    Select {
        /// x, y, width, height.
        #[serde(rename = "box")]
        bbox: [f32; 4],
        /// Source whose pixels these are; the active one without it.
        #[serde(default)]
        source: Option<String>,
    },
    /// Give the target up.
    Stop,
    /// Use this source and do not change by yourself, but on failure.
    Switch {
        /// Its name.
        to: String,
    },
    /// Decide by the configured policies again.
    Auto,
    /// End the run.
    Quit,
}

impl Command {
    /// Reads a line.
    ///
    /// # Errors
    /// Says what is wrong with it.
    pub fn parse(line: &str) -> Result<Self, String> {
        serde_json::from_str(line).map_err(|e| e.to_string())
    }
}

/// The end that commands are given to; may be cloned to any thread. The loop reads them between two
/// frames.
#[derive(Clone, Debug)]
pub struct Commands(SyncSender<Command>);

impl Commands {
    /// Hands a command over.
    ///
    /// # Errors
    /// When the run has ended or too many commands wait.
    pub fn give(&self, command: Command) -> Result<(), &'static str> {
        self.0.try_send(command).map_err(|_| "too many commands are waiting, or the run has ended")
    }
}

/// Commands that may wait.
const DEPTH: usize = 32;
/// Longest line that is read.
const LINE: u64 = 64 * 1024;
/// Clients of the socket at a time.
const CLIENTS: usize = 8;

/// The two ends of the way commands take.
pub fn channel() -> (Commands, Receiver<Command>) {
    let (sender, receiver) = sync_channel(DEPTH);
    (Commands(sender), receiver)
}

/// Reads commands from standard input until its end. Unusable lines are reported on standard error.
///
/// # Errors
/// When no thread can be started.
pub fn listen_stdin(commands: Commands) -> Result<(), HostError> {
    let serve = move || {
        serve(io::stdin().lock(), &commands, |answer| {
            if let Err(reason) = answer {
                let _ = writeln!(io::stderr(), "tsda: command: {reason}");
            }
            Ok(())
        });
    };
    spawn("tsda-stdin", serve)
}

/// A socket that is removed when this is dropped.
#[derive(Debug)]
pub struct SocketFile(PathBuf);

impl SocketFile {
    /// Listens at a path. A socket nobody listens at any more is replaced, a living one is not.
    ///
    /// # Errors
    /// When the path is taken or cannot be written.
    pub fn listen(path: &Path) -> Result<(UnixListener, Self), HostError> {
        let fail = |source| HostError::Create { path: path.to_path_buf(), source };
        if let Ok(meta) = std::fs::symlink_metadata(path) {
            use std::os::unix::fs::FileTypeExt as _;
            if !meta.file_type().is_socket() {
                return Err(fail(io::Error::new(io::ErrorKind::AlreadyExists, "it is no socket")));
            }
            if UnixStream::connect(path).is_ok() {
                let reason = "another program listens there";
                return Err(fail(io::Error::new(io::ErrorKind::AddrInUse, reason)));
            }
            std::fs::remove_file(path).map_err(fail)?;
        }
        Ok((UnixListener::bind(path).map_err(fail)?, Self(path.to_path_buf())))
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// Reads commands from clients of a Unix socket; each line is answered with `{"ok":true}` or
/// `{"error":".."}`. The socket goes when the answer is dropped.
///
/// # Errors
/// When the socket cannot be made.
pub fn listen_socket(path: &Path, commands: Commands) -> Result<SocketFile, HostError> {
    let (listener, file) = SocketFile::listen(path)?;
    let clients = Arc::new(AtomicUsize::new(0));
    let accept = move || {
        for stream in listener.incoming() {
            let Ok(stream) = stream else { continue };
            if clients.fetch_add(1, Ordering::Relaxed) >= CLIENTS {
                clients.fetch_sub(1, Ordering::Relaxed);
                continue;
            }
            let (commands, mine) = (commands.clone(), Arc::clone(&clients));
            let started = thread::Builder::new().name("tsda-client".into()).spawn(move || {
                client(stream, &commands);
                mine.fetch_sub(1, Ordering::Relaxed);
            });
            if started.is_err() {
                clients.fetch_sub(1, Ordering::Relaxed);
            }
        }
    };
    spawn("tsda-control", accept)?;
    Ok(file)
}

fn client(stream: UnixStream, commands: &Commands) {
    let Ok(mut back) = stream.try_clone() else { return };
    serve(BufReader::new(stream), commands, |answer| {
        let line = match answer {
            Ok(()) => serde_json::json!({ "ok": true }),
            Err(reason) => serde_json::json!({ "error": reason }),
        };
        writeln!(back, "{line}")
    });
}

fn serve(
    mut reader: impl BufRead,
    commands: &Commands,
    mut answer: impl FnMut(Result<(), String>) -> io::Result<()>,
) {
    let mut line = Vec::new();
    loop {
        line.clear();
        match (&mut reader).take(LINE).read_until(b'\n', &mut line) {
            Ok(n) if n > 0 => {}
            _ => return,
        }
        let text = String::from_utf8_lossy(&line);
        if text.trim().is_empty() {
            continue;
        }
        let done = Command::parse(text.trim())
            .and_then(|command| commands.give(command).map_err(str::to_owned));
        if answer(done).is_err() {
            return;
        }
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), HostError> {
    thread::Builder::new()
        .name(name.into())
        .spawn(work)
        .map(drop)
        .map_err(|source| HostError::Create { path: name.into(), source })
}
