//! TensorBoard event files, written by hand: TFRecord framing around `Event` protobuf messages.
//!
//! A record is `length (u64 LE), masked crc32c(length) (u32 LE), payload, masked crc32c(payload)`.
//! The payload's fields used here: Event { 1 wall_time: double, 2 step: int64, 3 file_version:
//! string, 5 summary: Summary }, Summary { 1 value: repeated Value }, Value { 1 tag: string,
//! 2 simple_value: float }.

use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// An event file being written.
pub struct EventFile {
    file: File,
}

impl EventFile {
    /// Creates a new file in `dir`, named by the time so that a resumed run adds a file and
    /// TensorBoard joins them.
    ///
    /// # Errors
    /// When the file cannot be created or written.
    pub fn create(dir: &Path) -> std::io::Result<Self> {
        let nanos = now().as_nanos();
        let name = format!(
            "events.out.tfevents.{}.{:09}.tsda",
            nanos / 1_000_000_000,
            nanos % 1_000_000_000
        );
        let mut this = Self { file: File::create_new(dir.join(name))? };
        let mut event = Vec::new();
        put_double(&mut event, 1, now().as_secs_f64());
        put_bytes(&mut event, 3, b"brain.Event:2");
        this.record(&event)?;
        Ok(this)
    }

    /// Writes scalars of one step.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn scalars(&mut self, step: u64, values: &[(String, f32)]) -> std::io::Result<()> {
        let mut summary = Vec::new();
        for (tag, value) in values {
            let mut entry = Vec::new();
            put_bytes(&mut entry, 1, tag.as_bytes());
            entry.push((2 << 3) | 5);
            entry.extend_from_slice(&value.to_le_bytes());
            put_bytes(&mut summary, 1, &entry);
        }
        let mut event = Vec::new();
        put_double(&mut event, 1, now().as_secs_f64());
        event.push(2 << 3);
        put_varint(&mut event, step);
        put_bytes(&mut event, 5, &summary);
        self.record(&event)
    }

    fn record(&mut self, payload: &[u8]) -> std::io::Result<()> {
        let length = (payload.len() as u64).to_le_bytes();
        let mut bytes = Vec::with_capacity(payload.len() + 16);
        bytes.extend_from_slice(&length);
        bytes.extend_from_slice(&masked_crc(&length).to_le_bytes());
        bytes.extend_from_slice(payload);
        bytes.extend_from_slice(&masked_crc(payload).to_le_bytes());
        self.file.write_all(&bytes)
    }
}

/// Scalars `(step, tag, value)` of an event file, for tests and tools. Reading stops quietly at a
/// record cut short by a killed run.
///
/// # Errors
/// When the file cannot be read or a checksum is wrong.
pub fn read_events(path: &Path) -> std::io::Result<Vec<(u64, String, f32)>> {
    let bytes = std::fs::read(path)?;
    let corrupt = |at: usize| {
        let text = format!("{}: record at byte {at} is damaged", path.display());
        std::io::Error::new(std::io::ErrorKind::InvalidData, text)
    };
    let mut out = Vec::new();
    let mut at = 0;
    while let Some(head) = bytes.get(at..at + 12) {
        let (length, crc) = head.split_at(8);
        if masked_crc(length).to_le_bytes() != crc {
            return Err(corrupt(at));
        }
        let length = u64::from_le_bytes(length.try_into().map_err(|_| corrupt(at))?) as usize;
        let Some(rest) = length.checked_add(at + 16).and_then(|end| bytes.get(at + 12..end)) else {
            break;
        };
        let (payload, crc) = rest.split_at(length);
        if masked_crc(payload).to_le_bytes() != crc {
            return Err(corrupt(at));
        }
        decode_event(payload, &mut out).ok_or_else(|| corrupt(at))?;
        at += 16 + length;
    }
    Ok(out)
}

fn now() -> std::time::Duration {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}

fn put_varint(out: &mut Vec<u8>, mut v: u64) {
    while v >= 0x80 {
        out.push(v as u8 | 0x80);
        v >>= 7;
    }
    out.push(v as u8);
}

fn put_bytes(out: &mut Vec<u8>, field: u8, bytes: &[u8]) {
    out.push((field << 3) | 2);
    put_varint(out, bytes.len() as u64);
    out.extend_from_slice(bytes);
}

fn put_double(out: &mut Vec<u8>, field: u8, v: f64) {
    out.push((field << 3) | 1);
    out.extend_from_slice(&v.to_le_bytes());
}

enum Wire<'a> {
    Varint(u64),
    Fixed(&'a [u8]),
    Bytes(&'a [u8]),
}

/// Next field number and value, advancing `bytes`; `None` at the end or on damage.
fn field<'a>(bytes: &mut &'a [u8]) -> Option<(u64, Wire<'a>)> {
    let key = varint(bytes)?;
    let mut take = |n: usize| -> Option<&'a [u8]> {
        let (head, tail) = bytes.split_at_checked(n)?;
        *bytes = tail;
        Some(head)
    };
    let value = match key & 7 {
        0 => Wire::Varint(varint(bytes)?),
        1 => Wire::Fixed(take(8)?),
        5 => Wire::Fixed(take(4)?),
        2 => {
            let n = usize::try_from(varint(bytes)?).ok()?;
            let (head, tail) = bytes.split_at_checked(n)?;
            *bytes = tail;
            Wire::Bytes(head)
        }
        _ => return None,
    };
    Some((key >> 3, value))
}

fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut v = 0u64;
    for shift in (0..64).step_by(7) {
        let (first, tail) = bytes.split_first()?;
        *bytes = tail;
        v |= u64::from(first & 0x7f) << shift;
        if first & 0x80 == 0 {
            return Some(v);
        }
    }
    None
}

fn decode_event(mut payload: &[u8], out: &mut Vec<(u64, String, f32)>) -> Option<()> {
    let (mut step, mut summary): (u64, &[u8]) = (0, &[]);
    while !payload.is_empty() {
        match field(&mut payload)? {
            (2, Wire::Varint(v)) => step = v,
            (5, Wire::Bytes(b)) => summary = b,
            _ => {}
        }
    }
    while !summary.is_empty() {
        let (1, Wire::Bytes(mut entry)) = field(&mut summary)? else { continue };
        let (mut tag, mut value) = (String::new(), f32::NAN);
        while !entry.is_empty() {
            match field(&mut entry)? {
                (1, Wire::Bytes(b)) => tag = String::from_utf8(b.to_vec()).ok()?,
                (2, Wire::Fixed(b)) => value = f32::from_le_bytes(b.try_into().ok()?),
                _ => {}
            }
        }
        out.push((step, tag, value));
    }
    Some(())
}

fn masked_crc(bytes: &[u8]) -> u32 {
    crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// CRC-32C (Castagnoli), bit by bit: a few hundred bytes per log entry need no table.
fn crc32c(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, b| {
        (0..8).fold(
            crc ^ u32::from(*b),
            |c, _| {
                if c & 1 == 1 { (c >> 1) ^ 0x82f6_3b78 } else { c >> 1 }
            },
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crc_matches_the_published_check_value() {
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
    }

    #[test]
    fn what_is_written_is_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let mut file = EventFile::create(dir.path()).unwrap();
        file.scalars(7, &[("train/loss".into(), 1.5), ("train/lr".into(), -3e-5)]).unwrap();
        file.scalars(300, &[("val/iou".into(), 0.25)]).unwrap();
        let path = std::fs::read_dir(dir.path()).unwrap().next().unwrap().unwrap().path();
        let want = vec![
            (7, "train/loss".to_owned(), 1.5),
            (7, "train/lr".to_owned(), -3e-5),
            (300, "val/iou".to_owned(), 0.25),
        ];
        assert_eq!(read_events(&path).unwrap(), want);

        // A cut-off tail loses the last record only; an altered byte is noticed.
        let mut bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 3]).unwrap();
        assert_eq!(read_events(&path).unwrap(), want[..2]);
        let n = bytes.len();
        bytes[n - 8] ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        assert!(read_events(&path).is_err());
    }
}
