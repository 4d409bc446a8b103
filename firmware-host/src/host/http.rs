//! A small HTTP/1.1 server for a handful of clients: the preview page and the metrics. Requests are
//! bounded in size and time; what is not understood is refused.

use crate::error::HostError;
use std::fmt::Write as _;
use std::io::{self, BufRead, BufReader, Read, Write as _};
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream, ToSocketAddrs as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

/// Longest request line with headers.
const HEAD: usize = 8 * 1024;
/// Most headers.
const HEADERS: usize = 64;
/// Longest body.
const BODY: usize = 4 * 1024;
/// Connections at a time.
const CONNECTIONS: usize = 24;
/// A request has to be complete after so long; an idle connection ends too.
const PATIENCE: Duration = Duration::from_secs(15);
/// A client that takes nothing for so long is left.
const WRITE_PATIENCE: Duration = Duration::from_secs(5);
/// Shortest token.
const TOKEN: usize = 16;

/// How a request is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// Read.
    Get,
    /// Do.
    Post,
}

/// A request that was read completely.
#[derive(Clone, Debug)]
pub struct Request {
    /// GET or POST.
    pub method: Method,
    /// Without the query.
    pub path: String,
    query: String,
    headers: Vec<(String, String)>,
    /// What was sent.
    pub body: Vec<u8>,
    keep: bool,
}

/// A request that is answered with an error; the connection ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// HTTP status.
    pub status: u16,
    /// What is wrong.
    pub reason: &'static str,
}

const fn refusal<T>(status: u16, reason: &'static str) -> Result<T, Refusal> {
    Err(Refusal { status, reason })
}

impl Request {
    /// Reads a request; `None` when the client has ended the connection.
    ///
    /// # Errors
    /// When it is malformed, too large, too slow, or of a kind that is not supported.
    pub fn read(reader: &mut impl BufRead) -> Result<Option<Self>, Refusal> {
        let mut left = HEAD;
        let Some(first) = line(reader, &mut left)? else { return Ok(None) };
        let mut parts = first.split(' ');
        let (method, target, version) = (parts.next(), parts.next(), parts.next());
        let (Some(method), Some(target), Some(version), None) =
            (method, target, version, parts.next())
        else {
            return refusal(400, "no request line");
        };
        let http11 = match version {
            "HTTP/1.1" => true,
            "HTTP/1.0" => false,
            v if v.starts_with("HTTP/") => return refusal(505, "HTTP/1.1 only"),
            _ => return refusal(400, "no request line"),
        };
        let method = match method {
            "GET" => Method::Get,
            "POST" => Method::Post,
            m if m.bytes().all(|b| b.is_ascii_uppercase()) => {
                return refusal(405, "GET and POST only");
            }
            _ => return refusal(400, "no request line"),
        };
        if !target.starts_with('/') || target.contains(|c: char| c.is_control()) {
            return refusal(400, "no path");
        }
        let (path, query) = target.split_once('?').unwrap_or((target, ""));
        let mut headers = Vec::new();
        loop {
            let Some(text) = line(reader, &mut left)? else {
                return refusal(400, "the request ends early");
            };
            if text.is_empty() {
                break;
            }
            let Some((name, value)) = text.split_once(':') else {
                return refusal(400, "no header");
            };
            let token = |b: u8| b.is_ascii_alphanumeric() || b == b'-' || b == b'_';
            if name.is_empty() || !name.bytes().all(token) {
                return refusal(400, "no header");
            }
            if headers.len() == HEADERS {
                return refusal(431, "too many headers");
            }
            headers.push((name.to_ascii_lowercase(), value.trim().to_owned()));
        }
        let mut request = Self {
            method,
            path: path.to_owned(),
            query: query.to_owned(),
            headers,
            body: Vec::new(),
            keep: http11,
        };
        if request.header("transfer-encoding").is_some() {
            return refusal(501, "a body needs Content-Length");
        }
        let mut lengths = request.headers.iter().filter(|h| h.0 == "content-length");
        let length = match (lengths.next(), lengths.next()) {
            (None, _) => 0,
            (Some((_, n)), None) if n.bytes().all(|b| b.is_ascii_digit()) && !n.is_empty() => {
                n.parse::<usize>().unwrap_or(usize::MAX)
            }
            _ => return refusal(400, "Content-Length is no number"),
        };
        if length > BODY {
            return refusal(413, "the body is too long");
        }
        request.body.resize(length, 0);
        if reader.read_exact(&mut request.body).is_err() {
            return refusal(400, "the request ends early");
        }
        if let Some(connection) = request.header("connection") {
            request.keep &= !connection.eq_ignore_ascii_case("close");
        }
        Ok(Some(request))
    }

    /// A header; names in lower case.
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|h| h.0 == name).map(|h| h.1.as_str())
    }

    /// A value of the query, as it stands there (our own pages need no escapes).
    pub fn query(&self, name: &str) -> Option<&str> {
        self.query.split('&').find_map(|part| part.strip_prefix(name)?.strip_prefix('='))
    }
}

/// A line without its end; `None` at the end of the connection before its first byte.
fn line(reader: &mut impl BufRead, left: &mut usize) -> Result<Option<String>, Refusal> {
    let mut bytes = Vec::new();
    match reader.by_ref().take(*left as u64).read_until(b'\n', &mut bytes) {
        Ok(0) if *left > 0 => return Ok(None),
        Ok(_) => {}
        Err(e) if bytes.is_empty() && e.kind() != io::ErrorKind::InvalidData => return Ok(None),
        Err(_) => return refusal(408, "too slow"),
    }
    *left -= bytes.len();
    if bytes.pop() != Some(b'\n') {
        return match *left {
            0 => refusal(431, "the headers are too long"),
            _ => refusal(400, "the request ends early"),
        };
    }
    if bytes.last() == Some(&b'\r') {
        bytes.pop();
    }
    match String::from_utf8(bytes) {
        Ok(text) if !text.contains(|c: char| c.is_control() && c != '\t') => Ok(Some(text)),
        _ => refusal(400, "not text"),
    }
}

/// Who may ask: everybody on this machine, or who knows the token.
#[derive(Clone)]
pub struct Access {
    address: SocketAddr,
    token: Option<String>,
}

impl std::fmt::Debug for Access {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Not the token.
        f.debug_struct("Access").field("address", &self.address).finish_non_exhaustive()
    }
}

impl Access {
    /// Checks `bind` and the token, of the file if one is given; errors name `key`.
    ///
    /// # Errors
    /// When the address is not understood, the token too short, or missing though other machines
    /// can connect.
    pub fn new(
        key: &str,
        bind: &str,
        token: Option<&str>,
        token_file: Option<&Path>,
    ) -> Result<Self, HostError> {
        let refuse = |part: &str, reason: String| HostError::Argument {
            what: format!("{key}.{part}"),
            reason,
        };
        let address = bind
            .to_socket_addrs()
            .ok()
            .and_then(|mut found| found.next())
            .ok_or_else(|| refuse("bind", format!("`{bind}` is no address and port")))?;
        let token = match (token, token_file) {
            (Some(_), Some(_)) => {
                return Err(refuse("token", "token and token_file exclude each other".into()));
            }
            (Some(token), None) => Some(token.to_owned()),
            (None, Some(path)) => {
                let text = std::fs::read_to_string(path).map_err(|e| {
                    refuse("token_file", format!("{} cannot be read: {e}", path.display()))
                })?;
                Some(text.trim().to_owned())
            }
            (None, None) => None,
        };
        match &token {
            None if !address.ip().is_loopback() => {
                let reason = format!(
                    "{address} can be reached from other machines: a token of at least {TOKEN} \
                     characters has to be given (`head -c 24 /dev/urandom | base64`)"
                );
                Err(refuse("token", reason))
            }
            // What needs no escapes in an address.
            Some(t)
                if t.len() < TOKEN
                    || !t.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.~+/=".contains(&b)) =>
            {
                let reason =
                    format!("at least {TOKEN} letters, digits, and - _ . ~ + / = are needed");
                Err(refuse("token", reason))
            }
            _ => Ok(Self { address, token }),
        }
    }

    /// Whether a request may be answered.
    ///
    /// # Errors
    /// 401 without the token, 403 for pages of other sites.
    pub fn check(&self, request: &Request) -> Result<(), Refusal> {
        if let Some(token) = &self.token {
            let bearer = request.header("authorization").and_then(|v| v.strip_prefix("Bearer "));
            let given = bearer.or_else(|| request.query("token")).unwrap_or_default();
            if !same(given.as_bytes(), token.as_bytes()) {
                return refusal(401, "the token is missing or wrong");
            }
        } else if !request.header("host").is_some_and(is_local) {
            // Another site's page whose name was pointed at this machine.
            return refusal(403, "only by the name of this machine: 127.0.0.1 or localhost");
        }
        if let Some(origin) = request.header("origin")
            && origin.split_once("://").map(|o| o.1) != request.header("host")
        {
            return refusal(403, "not from pages of other sites");
        }
        Ok(())
    }
}

/// Compares in a time that does not depend on where they differ.
fn same(a: &[u8], b: &[u8]) -> bool {
    let mut differ = usize::from(a.len() != b.len());
    for (i, known) in b.iter().enumerate() {
        let x = a.get(i).copied().unwrap_or(0);
        differ |= usize::from(std::hint::black_box(x ^ known));
    }
    std::hint::black_box(differ) == 0
}

/// Whether a Host header names this machine.
fn is_local(host: &str) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or(rest),
        None => host.split(':').next().unwrap_or(host),
    };
    name.eq_ignore_ascii_case("localhost")
        || name.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
}

/// Writes answers.
#[derive(Debug)]
pub struct Responder<'a> {
    stream: &'a TcpStream,
    stop: &'a AtomicBool,
    keep: bool,
}

impl Responder<'_> {
    /// A whole answer. `headers`: further lines, each with its end.
    ///
    /// # Errors
    /// When the client is gone.
    pub fn reply(&mut self, status: u16, kind: &str, headers: &str, body: &[u8]) -> io::Result<()> {
        let mut head = String::with_capacity(256 + headers.len());
        let connection = if self.keep { "keep-alive" } else { "close" };
        let _ = write!(
            head,
            "HTTP/1.1 {status} {}\r\nContent-Length: {}\r\nConnection: {connection}\r\n{COMMON}",
            phrase(status),
            body.len()
        );
        if !kind.is_empty() {
            let _ = write!(head, "Content-Type: {kind}\r\n");
        }
        head += headers;
        head += "\r\n";
        let mut all = head.into_bytes();
        all.extend_from_slice(body);
        let mut stream = self.stream;
        stream.write_all(&all)
    }

    /// A JSON answer: `{"ok":true}` or `{"error":".."}`.
    ///
    /// # Errors
    /// When the client is gone.
    pub fn outcome(&mut self, outcome: Result<(), (u16, String)>) -> io::Result<()> {
        let (status, value) = match outcome {
            Ok(()) => (200, serde_json::json!({ "ok": true })),
            Err((status, reason)) => (status, serde_json::json!({ "error": reason })),
        };
        self.reply(status, "application/json", "", value.to_string().as_bytes())
    }

    /// Begins an answer without end and gives what it is written to; the connection ends after it.
    ///
    /// # Errors
    /// When the client is gone.
    pub fn endless(&mut self, kind: &str) -> io::Result<&TcpStream> {
        self.keep = false;
        let head =
            format!("HTTP/1.1 200 OK\r\nConnection: close\r\n{COMMON}Content-Type: {kind}\r\n\r\n");
        let mut stream = self.stream;
        stream.write_all(head.as_bytes())?;
        Ok(self.stream)
    }

    /// Whether the server ends.
    pub fn stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

const COMMON: &str = "Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\n\
                      Referrer-Policy: no-referrer\r\n";

const fn phrase(status: u16) -> &'static str {
    match status {
        200 => "OK",
        204 => "No Content",
        400 => "Bad Request",
        401 => "Unauthorized",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        408 => "Request Timeout",
        413 => "Content Too Large",
        415 => "Unsupported Media Type",
        431 => "Request Header Fields Too Large",
        501 => "Not Implemented",
        503 => "Service Unavailable",
        505 => "HTTP Version Not Supported",
        _ => "Error",
    }
}

/// Answers requests that may be answered; called on a thread per connection.
pub trait Handler: Send + Sync + 'static {
    /// Answers.
    ///
    /// # Errors
    /// When the client is gone.
    fn handle(&self, request: &Request, to: &mut Responder<'_>) -> io::Result<()>;
}

/// A running server; ends when dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    stop: Arc<AtomicBool>,
}

impl Server {
    /// Listens and serves.
    ///
    /// # Errors
    /// When the address is taken, or no thread can be started.
    pub fn start(access: Access, handler: Arc<dyn Handler>) -> Result<Self, HostError> {
        let fail = |source| HostError::Create {
            path: format!("http://{}", access.address).into(),
            source,
        };
        let listener = TcpListener::bind(access.address).map_err(fail)?;
        let address = listener.local_addr().map_err(fail)?;
        let (stop, mine) = (Arc::new(AtomicBool::new(false)), access.clone());
        let flag = Arc::clone(&stop);
        thread::Builder::new()
            .name("tsda-http".into())
            .spawn(move || accept(&listener, &Arc::new(mine), &handler, &flag))
            .map_err(fail)?;
        Ok(Self { address, stop })
    }

    /// Where it listens.
    pub const fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // Wakes the listening thread up.
        let mut address = self.address;
        if address.ip().is_unspecified() {
            address.set_ip(match address {
                SocketAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
                SocketAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
            });
        }
        let _ = TcpStream::connect_timeout(&address, Duration::from_millis(200));
    }
}

fn accept(
    listener: &TcpListener,
    access: &Arc<Access>,
    handler: &Arc<dyn Handler>,
    stop: &Arc<AtomicBool>,
) {
    let open = Arc::new(AtomicUsize::new(0));
    for stream in listener.incoming() {
        if stop.load(Ordering::Relaxed) {
            return;
        }
        let Ok(stream) = stream else {
            // Out of descriptors, for instance: not a reason to spin.
            thread::sleep(Duration::from_millis(50));
            continue;
        };
        if open.fetch_add(1, Ordering::Relaxed) >= CONNECTIONS {
            open.fetch_sub(1, Ordering::Relaxed);
            let _ = stream.set_write_timeout(Some(Duration::from_millis(100)));
            let mut to = Responder { stream: &stream, stop, keep: false };
            let _ = to.outcome(Err((503, "too many connections".into())));
            continue;
        }
        let (access, handler, flag) = (Arc::clone(access), Arc::clone(handler), Arc::clone(stop));
        let mine = Arc::clone(&open);
        let started = thread::Builder::new().name("tsda-http".into()).spawn(move || {
            // Whatever ends it, the client sees only the connection end.
            let _ = serve(&stream, &access, handler.as_ref(), &flag);
            mine.fetch_sub(1, Ordering::Relaxed);
        });
        if started.is_err() {
            open.fetch_sub(1, Ordering::Relaxed);
        }
    }
}

/// Reads until a point in time.
struct Timed<'a> {
    stream: &'a TcpStream,
    until: Instant,
}

impl Read for Timed<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let left = self.until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        self.stream.set_read_timeout(Some(left))?;
        self.stream.read(buffer)
    }
}

fn serve(
    stream: &TcpStream,
    access: &Access,
    handler: &dyn Handler,
    stop: &AtomicBool,
) -> io::Result<()> {
    stream.set_write_timeout(Some(WRITE_PATIENCE))?;
    stream.set_nodelay(true)?;
    let mut reader = BufReader::new(Timed { stream, until: Instant::now() + PATIENCE });
    loop {
        reader.get_mut().until = Instant::now() + PATIENCE;
        let mut to = Responder { stream, stop, keep: false };
        let request = match Request::read(&mut reader) {
            Ok(None) => return Ok(()),
            Ok(Some(request)) => request,
            Err(e) => return to.outcome(Err((e.status, e.reason.into()))),
        };
        if let Err(e) = access.check(&request) {
            return to.outcome(Err((e.status, e.reason.into())));
        }
        to.keep = request.keep && !stop.load(Ordering::Relaxed);
        handler.handle(&request, &mut to)?;
        if !to.keep {
            return Ok(());
        }
    }
}

#[cfg(test)]
mod tests;
