//! The part of the zip format PyTorch writes: stored (not compressed) entries, zip64 sizes.

use super::TorchError;
use std::collections::BTreeMap;
use std::io::{Read, Seek, SeekFrom};

/// One entry: where its bytes are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Entry {
    /// Of the local header; the bytes follow it.
    header: u64,
    /// Number of bytes.
    pub length: u64,
    /// CRC-32 of the bytes; 0 when none was written.
    pub crc: u32,
}

const END: [u8; 4] = *b"PK\x05\x06";
const END64: [u8; 4] = *b"PK\x06\x06";
const END64_LOCATOR: [u8; 4] = *b"PK\x06\x07";
const CENTRAL: [u8; 4] = *b"PK\x01\x02";
const LOCAL: [u8; 4] = *b"PK\x03\x04";
/// Longest table of contents read.
const MAX_DIRECTORY: u64 = 64 << 20;

fn damaged(reason: impl Into<String>) -> TorchError {
    TorchError::Damaged { reason: reason.into() }
}

/// Little-endian numbers from a slice; an error where it is too short.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn take(&mut self, n: usize) -> Result<&'a [u8], TorchError> {
        let (head, rest) =
            self.0.split_at_checked(n).ok_or_else(|| damaged("the zip table is cut short"))?;
        self.0 = rest;
        Ok(head)
    }

    fn number(&mut self, bytes: usize) -> Result<u64, TorchError> {
        Ok(self.take(bytes)?.iter().rev().fold(0, |v, b| v << 8 | u64::from(*b)))
    }
}

/// `length` bytes at `offset`, checked against the file's length before anything is allocated.
pub(super) fn read_at(
    input: &mut (impl Read + Seek),
    file: u64,
    offset: u64,
    length: u64,
) -> Result<Vec<u8>, TorchError> {
    if offset.checked_add(length).is_none_or(|end| end > file) {
        return Err(damaged(format!(
            "{length} bytes are expected at {offset}, but the file ends at {file}; fetch it again"
        )));
    }
    let length = usize::try_from(length).map_err(|_| damaged("an entry is too long"))?;
    input.seek(SeekFrom::Start(offset)).map_err(TorchError::Io)?;
    let mut bytes = vec![0; length];
    input.read_exact(&mut bytes).map_err(TorchError::Io)?;
    Ok(bytes)
}

/// The table of contents by name.
pub(super) fn directory(
    input: &mut (impl Read + Seek),
    file: u64,
) -> Result<BTreeMap<String, Entry>, TorchError> {
    // The end record has 22 bytes and a comment of up to 64 KiB behind it.
    let tail_at = file.saturating_sub(22 + 0xffff);
    let tail = read_at(input, file, tail_at, file - tail_at)?;
    let end = tail
        .windows(4)
        .rposition(|w| w == END)
        .ok_or_else(|| damaged("the zip's end is missing: it was cut short; fetch it again"))?;
    let mut fields = Fields(&tail[end + 4..]);
    fields.take(6)?;
    let (mut count, mut size, mut offset) =
        (fields.number(2)?, fields.number(4)?, fields.number(4)?);
    let comment = fields.number(2)? as usize;
    fields.take(comment)?;
    let end_at = tail_at + end as u64;
    if let Some(locator_at) = end_at.checked_sub(20) {
        let locator = read_at(input, file, locator_at, 20)?;
        if locator.starts_with(&END64_LOCATOR) {
            let at = Fields(&locator[8..]).number(8)?;
            let record = read_at(input, file, at, 56)?;
            if !record.starts_with(&END64) {
                return Err(damaged("its zip64 end record is missing"));
            }
            let mut fields = Fields(&record[32..]);
            (count, size, offset) = (fields.number(8)?, fields.number(8)?, fields.number(8)?);
        }
    }
    if size > MAX_DIRECTORY {
        return Err(damaged(format!("its table of contents has {size} bytes")));
    }
    let bytes = read_at(input, file, offset, size)?;
    let mut fields = Fields(&bytes);
    let mut entries = BTreeMap::new();
    for _ in 0..count {
        let (name, entry) = central(&mut fields)?;
        if entries.insert(name.clone(), entry).is_some() {
            return Err(damaged(format!("{name} is in it twice")));
        }
    }
    Ok(entries)
}

/// One record of the table of contents.
fn central(fields: &mut Fields<'_>) -> Result<(String, Entry), TorchError> {
    if fields.take(4)? != CENTRAL {
        return Err(damaged("its table of contents is not where it should be"));
    }
    fields.take(4)?;
    let (flags, method) = (fields.number(2)?, fields.number(2)?);
    fields.take(4)?;
    let crc = fields.number(4)? as u32;
    let (mut packed, mut length) = (fields.number(4)?, fields.number(4)?);
    let (name, extra, comment) =
        (fields.number(2)? as usize, fields.number(2)? as usize, fields.number(2)? as usize);
    fields.take(8)?;
    let mut header = fields.number(4)?;
    let name = String::from_utf8_lossy(fields.take(name)?).into_owned();
    let mut extra = Fields(fields.take(extra)?);
    fields.take(comment)?;
    while extra.0.len() >= 4 {
        let (id, size) = (extra.number(2)?, extra.number(2)? as usize);
        let mut body = Fields(extra.take(size)?);
        if id == 1 {
            // Zip64: only the fields that did not fit, in this order.
            for field in [&mut length, &mut packed, &mut header] {
                if *field == 0xffff_ffff {
                    *field = body.number(8)?;
                }
            }
        }
    }
    if flags & 1 != 0 {
        return Err(damaged(format!("{name} is encrypted")));
    }
    if method != 0 || packed != length {
        return Err(TorchError::Unsupported {
            what: format!("{name} is compressed, which torch.save does not do"),
            help: "load the file in PyTorch and save it again",
        });
    }
    Ok((name, Entry { header, length, crc }))
}

/// Where the bytes of an entry start.
pub(super) fn data_start(
    input: &mut (impl Read + Seek),
    file: u64,
    entry: &Entry,
) -> Result<u64, TorchError> {
    let header = read_at(input, file, entry.header, 30)?;
    if !header.starts_with(&LOCAL) {
        return Err(damaged("an entry is not where the table of contents says"));
    }
    let mut fields = Fields(&header[26..]);
    let start = entry.header + 30 + fields.number(2)? + fields.number(2)?;
    if start.checked_add(entry.length).is_none_or(|end| end > file) {
        return Err(damaged("an entry goes beyond the end of the file; fetch it again"));
    }
    Ok(start)
}
