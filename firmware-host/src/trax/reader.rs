//! Messages out of a byte stream that also carries noise.

use super::error::TraxError;
use super::message::{Message, MessageError, PREFIX};
use std::io::{BufRead as _, BufReader, ErrorKind, Read};

/// Most bytes of one message unless said otherwise: two channels of 4K pictures as raw RGB.
pub const MAX_MESSAGE: usize = 256 << 20;

/// Takes messages from a stream. Lines that are no messages are passed over without being kept,
/// however long they are.
#[derive(Debug)]
pub struct MessageReader<R> {
    input: BufReader<R>,
    line: Vec<u8>,
    limit: usize,
    /// Messages seen, for errors.
    count: u64,
}

impl<R: Read> MessageReader<R> {
    /// Reads messages of up to `limit` bytes.
    pub fn new(input: R, limit: usize) -> Self {
        Self { input: BufReader::with_capacity(1 << 16, input), line: Vec::new(), limit, count: 0 }
    }

    /// The next message; `None` when the stream ended between messages.
    ///
    /// # Errors
    /// When the stream breaks or ends inside a message, or a message is malformed or too long.
    pub fn next_message(&mut self) -> Result<Option<Message>, TraxError> {
        loop {
            let complete = self.read_line()?;
            let is_message = self.line.starts_with(PREFIX);
            if is_message {
                self.count += 1;
            }
            match (complete, is_message) {
                (false, true) => return Err(TraxError::CutOff { message: self.count }),
                (false, false) => return Ok(None),
                (true, _) => {}
            }
            let message = Message::parse(&self.line)
                .map_err(|source| TraxError::Message { message: self.count, source })?;
            // One large picture must not occupy its room for the rest of the session.
            self.line.shrink_to(1 << 20);
            if message.is_some() {
                return Ok(message);
            }
        }
    }

    /// Fills `line` up to the next line feed; false at the end of the stream.
    fn read_line(&mut self) -> Result<bool, TraxError> {
        self.line.clear();
        let mut noise = false;
        loop {
            let bytes = match self.input.fill_buf() {
                Ok(bytes) => bytes,
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(source) => return Err(TraxError::Read { source }),
            };
            if bytes.is_empty() {
                return Ok(false);
            }
            let end = bytes.iter().position(|&b| b == b'\n');
            let part = &bytes[..end.unwrap_or(bytes.len())];
            if !noise {
                if self.line.len() + part.len() > self.limit.max(PREFIX.len()) {
                    // Only what begins like a message is too long; the rest was never ours.
                    let mut start = self.line[..self.line.len().min(PREFIX.len())].to_vec();
                    start.extend(part.iter().take(PREFIX.len() - start.len()));
                    if start == PREFIX {
                        let source = MessageError::TooLong { limit: self.limit };
                        return Err(TraxError::Message { message: self.count + 1, source });
                    }
                    self.line.clear();
                    noise = true;
                } else {
                    self.line.extend_from_slice(part);
                    let n = self.line.len().min(PREFIX.len());
                    noise = self.line[..n] != PREFIX[..n];
                }
            }
            let taken = part.len() + usize::from(end.is_some());
            self.input.consume(taken);
            if end.is_some() {
                return Ok(true);
            }
        }
    }
}
