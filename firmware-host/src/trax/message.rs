//! One line of the protocol: its type, arguments and properties.

/// What every message begins with, at the start of a line.
pub const PREFIX: &[u8] = b"@@TRAX:";

/// Longest name of a property.
const MAX_KEY: usize = 64;

/// What a message is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Server to client, once: version and abilities.
    Hello,
    /// Client to server: a target.
    Initialize,
    /// Client to server: the next pictures.
    Frame,
    /// Server to client: where the target is.
    State,
    /// Either way: the end.
    Quit,
}

impl Kind {
    /// The word on the wire.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Hello => "hello",
            Self::Initialize => "initialize",
            Self::Frame => "frame",
            Self::State => "state",
            Self::Quit => "quit",
        }
    }

    fn parse(word: &[u8]) -> Option<Self> {
        // The C library reads `status` as `state`.
        let known = [
            ("hello", Self::Hello),
            ("initialize", Self::Initialize),
            ("frame", Self::Frame),
            ("state", Self::State),
            ("status", Self::State),
            ("quit", Self::Quit),
        ];
        known.iter().find(|(w, _)| word.eq_ignore_ascii_case(w.as_bytes())).map(|(_, k)| *k)
    }
}

impl core::fmt::Display for Kind {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A message, escapes resolved.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// What it is for.
    pub kind: Kind,
    /// Arguments in order.
    pub args: Vec<String>,
    /// `key=value` tokens in order. Keys are 1 to 64 letters, digits, dots, underscores.
    pub properties: Vec<(String, String)>,
}

/// A line that begins like a message and cannot be read as one.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MessageError {
    /// Longer than allowed.
    #[error("longer than {limit} bytes; send smaller pictures, or their paths")]
    TooLong {
        /// Most bytes allowed.
        limit: usize,
    },
    /// Bytes that are no text.
    #[error("byte {at} is not UTF-8; file names have to be")]
    NotUtf8 {
        /// 0-based position in the line.
        at: usize,
    },
    /// A quoted token without its end.
    #[error("token {token}: the closing quote is missing")]
    UnclosedQuote {
        /// 1-based, the type of the message not counted.
        token: usize,
    },
    /// No space between a quoted token and the next.
    #[error("token {token}: a space is expected after the closing quote")]
    AfterQuote {
        /// 1-based, the type of the message not counted.
        token: usize,
    },
    /// A backslash with nothing behind it.
    #[error("token {token}: the line ends after a backslash")]
    DanglingEscape {
        /// 1-based, the type of the message not counted.
        token: usize,
    },
}

impl Message {
    /// A message without arguments and properties.
    pub const fn new(kind: Kind) -> Self {
        Self { kind, args: Vec::new(), properties: Vec::new() }
    }

    /// Adds an argument. One that looks like `key=value` is read back as a property.
    #[must_use]
    pub fn arg(mut self, text: impl Into<String>) -> Self {
        self.args.push(text.into());
        self
    }

    /// Adds a property.
    #[must_use]
    pub fn with(mut self, key: &str, value: impl Into<String>) -> Self {
        debug_assert!(is_key(key), "{key}");
        self.properties.push((key.to_owned(), value.into()));
        self
    }

    /// Value of a property; of several, the last.
    pub fn property(&self, key: &str) -> Option<&str> {
        self.properties.iter().rev().find(|(k, _)| k == key).map(|(_, v)| v.as_str())
    }

    /// Reads a line without its line feed; `None` when it is no message (noise, or a type this
    /// version of the protocol does not have). A carriage return at the end is passed over.
    ///
    /// # Errors
    /// When the line begins as a message and its tokens cannot be told apart.
    pub fn parse(line: &[u8]) -> Result<Option<Self>, MessageError> {
        let Some(rest) = line.strip_prefix(PREFIX) else { return Ok(None) };
        let rest = rest.strip_suffix(b"\r").unwrap_or(rest);
        let end = rest.iter().position(|&b| b == b' ').unwrap_or(rest.len());
        let Some(kind) = Kind::parse(&rest[..end]) else { return Ok(None) };
        let text = std::str::from_utf8(&rest[end..])
            .map_err(|e| MessageError::NotUtf8 { at: PREFIX.len() + end + e.valid_up_to() })?;
        let mut message = Self::new(kind);
        let mut tokens = Tokens { text, at: 0, count: 0 };
        while let Some(token) = tokens.next()? {
            match token.split_once('=') {
                Some((key, value)) if is_key(key) => {
                    message.properties.push((key.to_owned(), value.to_owned()));
                }
                _ => message.args.push(token),
            }
        }
        Ok(Some(message))
    }

    /// Appends the line, with its line feed, as the C library writes it.
    pub fn encode(&self, out: &mut Vec<u8>) {
        out.extend_from_slice(PREFIX);
        out.extend_from_slice(self.kind.as_str().as_bytes());
        out.push(b' ');
        for arg in &self.args {
            quote(&[arg], out);
        }
        for (key, value) in &self.properties {
            quote(&[key, "=", value], out);
        }
        out.push(b'\n');
    }
}

fn is_key(text: &str) -> bool {
    (1..=MAX_KEY).contains(&text.len())
        && text.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'.' || b == b'_')
}

fn quote(parts: &[&str], out: &mut Vec<u8>) {
    out.push(b'"');
    for byte in parts.iter().flat_map(|p| p.bytes()) {
        match byte {
            b'"' | b'\\' => out.extend_from_slice(&[b'\\', byte]),
            b'\n' => out.extend_from_slice(b"\\n"),
            _ => out.push(byte),
        }
    }
    out.extend_from_slice(b"\" ");
}

/// Tokens of a line: bare or in quotes, spaces between.
struct Tokens<'a> {
    text: &'a str,
    at: usize,
    count: usize,
}

impl Tokens<'_> {
    fn next(&mut self) -> Result<Option<String>, MessageError> {
        let bytes = self.text.as_bytes();
        while bytes.get(self.at) == Some(&b' ') {
            self.at += 1;
        }
        if self.at == bytes.len() {
            return Ok(None);
        }
        self.count += 1;
        let quoted = bytes[self.at] == b'"';
        self.at += usize::from(quoted);
        // What is copied at a time: pictures come as megabytes without a single escape.
        let mut from = self.at;
        let mut token = String::new();
        loop {
            match bytes.get(self.at) {
                None if quoted => return Err(MessageError::UnclosedQuote { token: self.count }),
                None => break,
                Some(b' ') if !quoted => break,
                Some(b'"') if quoted => break,
                Some(b'\\') => {
                    token.push_str(&self.text[from..self.at]);
                    let escaped = self.text[self.at + 1..].chars().next();
                    let c = escaped.ok_or(MessageError::DanglingEscape { token: self.count })?;
                    token.push(if c == 'n' { '\n' } else { c });
                    self.at += 1 + c.len_utf8();
                    from = self.at;
                }
                Some(_) => self.at += 1,
            }
        }
        token.push_str(&self.text[from..self.at]);
        if quoted {
            self.at += 1;
            if bytes.get(self.at).is_some_and(|&b| b != b' ') {
                return Err(MessageError::AfterQuote { token: self.count });
            }
        }
        Ok(Some(token))
    }
}
