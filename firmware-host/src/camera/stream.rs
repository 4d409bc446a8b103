//! A running camera: the newest picture, older ones given back.

use super::format::{Encoding, needed};
use super::sys::{self, Filled, Queue};
use crate::host::source::{Captured, Counters};
use std::io;
use std::time::{Duration, Instant};
use tsda_runtime::{FrameView, PixelFormat};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// What the pictures of a stream are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shape {
    pub width: usize,
    pub height: usize,
    /// Bytes from row to row; 0: tightly packed.
    pub stride: usize,
    pub encoding: Encoding,
    pub full: u16,
    pub rate: Option<f64>,
}

/// A camera that streams. Dropping it stops it.
#[derive(Debug)]
pub struct Stream {
    queue: Queue,
    shape: Shape,
    what: String,
    held: Option<Filled>,
    /// When the held picture was taken, where the driver says so on a clock that can be read.
    taken: Option<Instant>,
    damaged: bool,
    sequence: Option<u32>,
    /// Empty unless pictures are decoded.
    decoded: Vec<u8>,
    /// Times in a row that something was ready and nothing was there.
    idle: u32,
}

/// What a stream has to say.
#[derive(Debug)]
pub(super) enum Progress {
    /// A new picture.
    Fresh,
    /// Nothing within the time.
    Nothing,
    /// The device is gone.
    Gone,
    /// The queue is dead; a new stream may work.
    Broken,
}

/// Times in a row after which "ready, but nothing there" counts as broken.
const IDLE: u32 = 8;

impl Stream {
    pub(super) fn new(queue: Queue, mut shape: Shape, what: String) -> Result<Self, String> {
        let mut decoded = Vec::new();
        match shape.encoding {
            Encoding::Jpeg => decoded = vec![0; shape.width * shape.height * 3],
            Encoding::Plain(format) => {
                shape.stride = shape.stride.max(format.row_bytes(shape.width));
                let needed = needed(format, shape.width, shape.height, shape.stride);
                if queue.shortest() < needed {
                    return Err(format!(
                        "the driver's buffers hold {} bytes, a picture of {} x {} with {} bytes \
                         per row needs {needed}",
                        queue.shortest(),
                        shape.width,
                        shape.height,
                        shape.stride
                    ));
                }
            }
        }
        let stream = Self {
            queue,
            shape,
            what,
            held: None,
            taken: None,
            damaged: false,
            sequence: None,
            decoded,
            idle: 0,
        };
        Ok(stream)
    }

    /// Device, name of the camera, size and format.
    pub fn describe(&self) -> &str {
        &self.what
    }

    pub(super) const fn shape(&self) -> &Shape {
        &self.shape
    }

    /// Waits for a picture and takes the newest one. Allocates nothing, but for what the JPEG
    /// decoder takes.
    pub(super) fn advance(&mut self, wait: Duration, counters: &mut Counters) -> Progress {
        match self.newest(wait, counters) {
            Ok(Some(filled)) => {
                self.idle = 0;
                let clock = sys::monotonic().filter(|_| filled.monotonic);
                self.taken = taken(filled.stamp, clock, Instant::now());
                self.inspect(&filled, counters);
                counters.delivered += 1;
                self.held = Some(filled);
                Progress::Fresh
            }
            Ok(None) => Progress::Nothing,
            Err(e) if e.raw_os_error() == Some(sys::ENODEV) => Progress::Gone,
            Err(_) => Progress::Broken,
        }
    }

    fn newest(&mut self, wait: Duration, counters: &mut Counters) -> io::Result<Option<Filled>> {
        if !self.queue.wait(wait)? {
            return Ok(None);
        }
        let Some(mut newest) = self.queue.take()? else {
            self.idle += 1;
            // Ready for ever with nothing to take: the driver means an error.
            let broken = io::Error::from_raw_os_error(sys::EIO);
            return if self.idle > IDLE { Err(broken) } else { Ok(None) };
        };
        self.number(&newest, counters);
        // The driver needs buffers while the newest is looked for.
        if let Some(old) = self.held.take() {
            self.queue.give(old)?;
        }
        while let Some(newer) = self.queue.take()? {
            self.number(&newer, counters);
            self.queue.give(newest)?;
            counters.skipped += 1;
            counters.damaged += u64::from(newest.error);
            newest = newer;
        }
        Ok(Some(newest))
    }

    /// Follows the driver's numbering, which wraps.
    fn number(&mut self, filled: &Filled, counters: &mut Counters) {
        if let Some(last) = self.sequence {
            let step = filled.sequence.wrapping_sub(last);
            // Numbers that go back are a restart of the counting, not two billion lost pictures.
            if (2..=u32::MAX / 2).contains(&step) {
                counters.missing += u64::from(step - 1);
            }
        }
        self.sequence = Some(filled.sequence);
    }

    fn inspect(&mut self, filled: &Filled, counters: &mut Counters) {
        let Shape { width, height, stride, encoding, .. } = self.shape;
        let whole = match encoding {
            Encoding::Plain(format) => filled.used >= needed(format, width, height, stride),
            Encoding::Jpeg => {
                let bytes = self.queue.bytes(filled);
                let used = bytes.get(..filled.used).unwrap_or(bytes);
                decode(used, (width, height), &mut self.decoded)
            }
        };
        self.damaged = filled.error || !whole;
        counters.damaged += u64::from(self.damaged);
    }

    /// The newest picture.
    pub(super) fn frame(&self, at: Duration) -> Option<Captured<'_>> {
        let filled = self.held.as_ref()?;
        let Shape { width, height, stride, encoding, full, .. } = self.shape;
        let view = match encoding {
            Encoding::Plain(format) => {
                FrameView::new(self.queue.bytes(filled), width, height, stride, format)
            }
            Encoding::Jpeg => {
                FrameView::new(&self.decoded, width, height, width * 3, PixelFormat::Rgb8)
            }
        };
        Some(Captured {
            view: view.ok()?,
            full,
            at,
            capture: Some(filled.stamp),
            taken: self.taken,
            sequence: filled.sequence,
            damaged: self.damaged,
            shutter: false,
        })
    }
}

/// Pictures are never so old when they are dequeued: such a time stamp is wrong.
const OLDEST: Duration = Duration::from_secs(10);

/// When a picture with this time stamp was taken, `clock` being the same clock now; `None` when that
/// cannot be read or the time stamp makes no sense.
fn taken(stamp: Duration, clock: Option<Duration>, now: Instant) -> Option<Instant> {
    let age = clock?.checked_sub(stamp)?;
    if age < OLDEST { now.checked_sub(age) } else { None }
}

/// Decodes a JPEG of exactly this size into `out`; answers whether it could be.
fn decode(bytes: &[u8], (width, height): (usize, usize), out: &mut [u8]) -> bool {
    let options = DecoderOptions::default()
        .jpeg_set_out_colorspace(ColorSpace::RGB)
        .set_max_width(width)
        .set_max_height(height);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    if decoder.decode_headers().is_err() {
        return false;
    }
    let fits = decoder
        .info()
        .is_some_and(|i| (usize::from(i.width), usize::from(i.height)) == (width, height));
    fits && decoder.output_buffer_size() == Some(out.len()) && decoder.decode_into(out).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::ExtendedColorType;
    use image::codecs::jpeg::JpegEncoder;

    fn jpeg(width: u32, height: u32, colour: bool) -> Vec<u8> {
        let mut bytes = Vec::new();
        let (kind, channels) =
            if colour { (ExtendedColorType::Rgb8, 3) } else { (ExtendedColorType::L8, 1) };
        let data: Vec<u8> = [200u8, 90, 30]
            .iter()
            .take(channels)
            .copied()
            .cycle()
            .take((width * height) as usize * channels)
            .collect();
        JpegEncoder::new_with_quality(&mut bytes, 95)
            .encode(&data, width, height, kind)
            .expect("encodes");
        bytes
    }

    #[test]
    fn only_a_plausible_time_stamp_says_when_a_picture_was_taken() {
        let now = Instant::now() + Duration::from_secs(100);
        let clock = Some(Duration::from_secs(50));
        for (ms, age) in [
            (49_980, Some(20)),
            (50_000, Some(0)),
            // Later than now (vivid's wrapping time stamps), and long ago.
            (50_001, None),
            (40_000, None),
        ] {
            let want = age.map(|a| now - Duration::from_millis(a));
            assert_eq!(taken(Duration::from_millis(ms), clock, now), want, "{ms}");
        }
        assert_eq!(taken(Duration::from_secs(49), None, now), None);
    }

    #[test]
    fn jpeg_pictures_are_decoded_into_the_buffer_that_is_there() {
        let mut out = vec![0; 64 * 48 * 3];
        assert!(decode(&jpeg(64, 48, true), (64, 48), &mut out));
        assert!(
            out.chunks_exact(3)
                .all(|p| { p.iter().zip([200u8, 90, 30]).all(|(a, b)| a.abs_diff(b) < 6) })
        );
        assert!(decode(&jpeg(64, 48, false), (64, 48), &mut out), "grey becomes three channels");
        let good = jpeg(64, 48, true);
        for bad in [&good[..0], &good[..100], b"no picture".as_slice(), &jpeg(32, 48, true)] {
            assert!(!decode(bad, (64, 48), &mut out), "{} bytes", bad.len());
        }
    }
}
