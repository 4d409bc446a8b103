//! Writes the MCAP container (https://mcap.dev/spec): chunks with an index, uncompressed, since
//! pictures already are. Whatever was flushed can be read though the file was never finished: readers
//! go from chunk to chunk.

use std::io::{self, Write};

const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];
const HEADER: u8 = 0x01;
const FOOTER: u8 = 0x02;
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const CHUNK: u8 = 0x06;
const MESSAGE_INDEX: u8 = 0x07;
const CHUNK_INDEX: u8 = 0x08;
const STATISTICS: u8 = 0x0B;
const DATA_END: u8 = 0x0F;

/// A kind of JSON message.
#[derive(Clone, Copy, Debug)]
pub struct Schema {
    /// As viewers know it.
    pub name: &'static str,
    /// JSON Schema.
    pub text: &'static str,
}

/// What messages belong to; its place in the list is its number.
#[derive(Clone, Debug)]
pub struct Topic {
    /// Name.
    pub name: String,
    /// Place in the list of schemas.
    pub schema: usize,
}

/// A record's content being written, in little endian.
#[derive(Debug, Default)]
struct Content(Vec<u8>);

impl Content {
    fn bytes(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn u16(self, v: u16) -> Self {
        self.bytes(&v.to_le_bytes())
    }

    fn u32(self, v: u32) -> Self {
        self.bytes(&v.to_le_bytes())
    }

    fn u64(self, v: u64) -> Self {
        self.bytes(&v.to_le_bytes())
    }

    /// With its length before it.
    fn block(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).bytes(bytes)
    }

    fn text(self, text: &str) -> Self {
        self.block(text.as_bytes())
    }
}

fn record(out: &mut Vec<u8>, kind: u8, content: &[u8]) {
    out.push(kind);
    out.extend_from_slice(&(content.len() as u64).to_le_bytes());
    out.extend_from_slice(content);
}

/// Schemas and channels, as they stand at the start of the data and again in the summary.
fn declarations(schemas: &[Schema], topics: &[Topic]) -> Vec<u8> {
    let mut out = Vec::new();
    for (i, schema) in schemas.iter().enumerate() {
        let content = Content::default().u16(i as u16 + 1).text(schema.name).text("jsonschema");
        record(&mut out, SCHEMA, &content.text(schema.text).0);
    }
    for (i, topic) in topics.iter().enumerate() {
        let content = Content::default().u16(i as u16).u16(topic.schema as u16 + 1);
        record(&mut out, CHANNEL, &content.text(&topic.name).text("json").block(&[]).0);
    }
    out
}

/// First and last time of messages.
type Span = Option<(u64, u64)>;

fn widened(span: Span, time: u64) -> Span {
    span.map_or(Some((time, time)), |(a, b)| Some((a.min(time), b.max(time))))
}

/// A recording being written. Its buffers are kept from chunk to chunk and from file to file, so that
/// memory does not depend on how long a recording goes on.
#[derive(Debug)]
pub struct Writer<W> {
    to: W,
    /// Bytes written.
    at: u64,
    declared: Vec<u8>,
    schemas: usize,
    chunk: Vec<u8>,
    span: Span,
    /// Per topic: time and place of its messages in the chunk.
    index: Vec<Vec<(u64, u64)>>,
    /// What stands around the chunk in the file.
    around: Vec<u8>,
    /// The summary's chunk indexes, as records.
    chunk_indexes: Vec<u8>,
    chunks: u32,
    counts: Vec<u64>,
    whole: Span,
}

impl<W: Write> Writer<W> {
    /// Begins a recording. `chunk`: bytes that a chunk is expected to get, at which the caller
    /// flushes.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn new(to: W, schemas: &[Schema], topics: &[Topic], chunk: usize) -> io::Result<Self> {
        let mut writer = Self {
            to,
            at: 0,
            declared: declarations(schemas, topics),
            schemas: schemas.len(),
            chunk: Vec::with_capacity(chunk),
            span: None,
            index: vec![Vec::new(); topics.len()],
            around: Vec::with_capacity(1024),
            chunk_indexes: Vec::new(),
            chunks: 0,
            counts: vec![0; topics.len()],
            whole: None,
        };
        writer.begin()?;
        Ok(writer)
    }

    fn begin(&mut self) -> io::Result<()> {
        self.at = 0;
        self.chunk.clear();
        self.span = None;
        self.index.iter_mut().for_each(Vec::clear);
        self.chunk_indexes.clear();
        self.chunks = 0;
        self.counts.fill(0);
        self.whole = None;
        let mut start = MAGIC.to_vec();
        let library = concat!("tsda ", env!("CARGO_PKG_VERSION"));
        record(&mut start, HEADER, &Content::default().text("").text(library).0);
        start.extend_from_slice(&self.declared);
        self.to.write_all(&start)?;
        self.at = start.len() as u64;
        Ok(())
    }

    /// Bytes so far, those of the open chunk included.
    pub fn size(&self) -> u64 {
        self.at + self.chunk.len() as u64
    }

    /// Bytes that a cut would lose.
    pub fn unflushed(&self) -> usize {
        self.chunk.len()
    }

    /// Chunks written; the memory of their index is given back with the file.
    pub const fn chunks(&self) -> u32 {
        self.chunks
    }

    /// What it is written to.
    pub const fn inner(&self) -> &W {
        &self.to
    }

    /// Adds a message to the open chunk. `time`: nanoseconds since 1970.
    pub fn message(&mut self, topic: usize, time: u64, data: &[u8]) {
        let (Some(index), Some(count)) = (self.index.get_mut(topic), self.counts.get_mut(topic))
        else {
            return;
        };
        index.push((time, self.chunk.len() as u64));
        let chunk = &mut self.chunk;
        chunk.push(MESSAGE);
        chunk.extend_from_slice(&(2 + 4 + 8 + 8 + data.len() as u64).to_le_bytes());
        chunk.extend_from_slice(&(topic as u16).to_le_bytes());
        chunk.extend_from_slice(&(*count as u32).to_le_bytes());
        chunk.extend_from_slice(&time.to_le_bytes());
        chunk.extend_from_slice(&time.to_le_bytes());
        chunk.extend_from_slice(data);
        *count += 1;
        self.span = widened(self.span, time);
        self.whole = widened(self.whole, time);
    }

    /// Writes the open chunk out.
    ///
    /// # Errors
    /// When it cannot be written; the recording is unusable from there on.
    pub fn flush(&mut self) -> io::Result<()> {
        let Some((first, last)) = self.span.take() else { return Ok(()) };
        let size = self.chunk.len() as u64;
        let head = Content::default()
            .u64(first)
            .u64(last)
            .u64(size)
            .u32(crc32fast::hash(&self.chunk))
            .text("")
            .u64(size);
        let around = &mut self.around;
        around.clear();
        around.push(CHUNK);
        around.extend_from_slice(&(head.0.len() as u64 + size).to_le_bytes());
        around.extend_from_slice(&head.0);
        self.to.write_all(around)?;
        self.to.write_all(&self.chunk)?;
        let length = around.len() as u64 + size;
        around.clear();
        let mut offsets = Content::default();
        for (topic, entries) in self.index.iter_mut().enumerate().filter(|e| !e.1.is_empty()) {
            offsets = offsets.u16(topic as u16).u64(self.at + length + around.len() as u64);
            around.push(MESSAGE_INDEX);
            let list = 16 * entries.len() as u32;
            around.extend_from_slice(&(2 + 4 + u64::from(list)).to_le_bytes());
            around.extend_from_slice(&(topic as u16).to_le_bytes());
            around.extend_from_slice(&list.to_le_bytes());
            for (time, at) in entries.drain(..) {
                around.extend_from_slice(&time.to_le_bytes());
                around.extend_from_slice(&at.to_le_bytes());
            }
        }
        self.to.write_all(around)?;
        self.to.flush()?;
        let index = Content::default()
            .u64(first)
            .u64(last)
            .u64(self.at)
            .u64(length)
            .block(&offsets.0)
            .u64(around.len() as u64)
            .text("")
            .u64(size)
            .u64(size);
        record(&mut self.chunk_indexes, CHUNK_INDEX, &index.0);
        self.chunks += 1;
        self.at += length + around.len() as u64;
        self.chunk.clear();
        Ok(())
    }

    /// Ends this file as [`Self::finish`] does and goes on in another; gives back the first.
    ///
    /// # Errors
    /// When one of them cannot be written.
    pub fn next(&mut self, to: W) -> io::Result<W> {
        self.end()?;
        let done = std::mem::replace(&mut self.to, to);
        self.begin()?;
        Ok(done)
    }

    /// Writes what is left and the summary; gives back what it was written to.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn finish(mut self) -> io::Result<W> {
        self.end()?;
        Ok(self.to)
    }

    fn end(&mut self) -> io::Result<()> {
        self.flush()?;
        let mut out = Vec::new();
        record(&mut out, DATA_END, &Content::default().u32(0).0);
        let start = out.len();
        out.extend_from_slice(&self.declared);
        let (first, last) = self.whole.unwrap_or_default();
        let counts = self.counts.iter().enumerate();
        let counts = counts.fold(Content::default(), |c, (topic, n)| c.u16(topic as u16).u64(*n));
        let statistics = Content::default()
            .u64(self.counts.iter().sum())
            .u16(self.schemas as u16)
            .u32(self.counts.len() as u32)
            .u32(0)
            .u32(0)
            .u32(self.chunks)
            .u64(first)
            .u64(last)
            .block(&counts.0);
        record(&mut out, STATISTICS, &statistics.0);
        out.extend_from_slice(&self.chunk_indexes);
        // The checksum covers the summary up to itself.
        let mut footer = Content::default().u64(self.at + start as u64).u64(0);
        let mut covered = crc32fast::Hasher::new();
        covered.update(&out[start..]);
        covered.update(&[FOOTER]);
        covered.update(&20_u64.to_le_bytes());
        covered.update(&footer.0);
        footer = footer.u32(covered.finalize());
        record(&mut out, FOOTER, &footer.0);
        out.extend_from_slice(&MAGIC);
        self.to.write_all(&out)?;
        self.to.flush()
    }
}
