//! Copies of pictures for outputs that encode them: made on the loop's thread into buffers that come
//! back, turned into JPEG on the output's.

use super::output::{FrameRecord, Losses, Views};
use super::source::Held;
use crate::picture::Picture;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::Duration;
use tsda_runtime::{FrameView, PixelFormat};

/// The pictures of all sources with the record they belong to.
#[derive(Debug)]
pub struct Shot {
    /// The record.
    pub record: FrameRecord,
    /// One per source.
    pictures: Vec<(bool, Held)>,
}

impl Shot {
    /// A source's picture; `None` when it had none.
    pub fn view(&self, source: usize) -> Option<FrameView<'_>> {
        let (there, held) = self.pictures.get(source)?;
        if *there { held.view().ok() } else { None }
    }

    /// Number of sources.
    pub fn sources(&self) -> usize {
        self.pictures.len()
    }
}

/// The loop's end: makes shots at a bounded rate.
#[derive(Debug)]
pub struct Camera {
    free: Receiver<Option<Box<Shot>>>,
    sources: usize,
    every: Duration,
    due: Duration,
    missed: Losses,
}

/// The output's end: where shots go back to.
#[derive(Debug)]
pub struct Pool(SyncSender<Option<Box<Shot>>>);

impl Pool {
    /// Gives a buffer back.
    pub fn give_back(&self, shot: Box<Shot>) {
        let _ = self.0.try_send(Some(shot));
    }
}

/// A camera with so many buffers, for `rate` shots per second.
pub fn camera(sources: usize, buffers: usize, rate: f64) -> (Camera, Pool) {
    let (sender, free) = sync_channel(buffers);
    for _ in 0..buffers {
        let _ = sender.try_send(None);
    }
    let every = Duration::try_from_secs_f64(1.0 / rate).unwrap_or(Duration::MAX);
    let missed = Losses::default();
    (Camera { free, sources, every, due: Duration::ZERO, missed }, Pool(sender))
}

impl Camera {
    /// A shot, when one is due at `now` and a buffer is free. Buffers are made with the first shots;
    /// from then on nothing is allocated.
    pub fn shoot(
        &mut self,
        now: Duration,
        record: &FrameRecord,
        views: &Views<'_>,
    ) -> Option<Box<Shot>> {
        if now < self.due {
            return None;
        }
        let Ok(buffer) = self.free.try_recv() else {
            self.missed.add();
            return None;
        };
        let mut shot = buffer.unwrap_or_else(|| {
            let pictures = (0..self.sources).map(|_| (false, Held::empty())).collect();
            Box::new(Shot { record: *record, pictures })
        });
        // In step with the rate, unless it fell behind by more than one.
        self.due = if now < self.due.saturating_add(self.every) {
            self.due.saturating_add(self.every)
        } else {
            now.saturating_add(self.every)
        };
        shot.record = *record;
        for (source, (there, held)) in shot.pictures.iter_mut().enumerate() {
            let view = views.view(source);
            *there = view.is_some();
            if let Some(view) = view {
                held.hold(&view);
            }
        }
        Some(shot)
    }
}

/// Turns pictures of any format into JPEG; keeps its buffers.
#[derive(Debug)]
pub struct Encoder {
    quality: u8,
    longest: usize,
    picture: Picture,
}

impl Encoder {
    /// `longest`: longest side of what comes out.
    pub fn new(quality: u8, longest: usize) -> Self {
        Self {
            quality: quality.clamp(1, 100),
            longest: longest.max(16),
            picture: Picture::default(),
        }
    }

    /// How many pixels of a picture of this size one of its JPEG stands for along a side.
    pub fn step(&self, width: usize, height: usize) -> usize {
        width.max(height).div_ceil(self.longest).max(1)
    }

    /// A picture as JPEG, and how many pixels of it one of the JPEG stands for along a side.
    pub fn jpeg(&mut self, view: &FrameView<'_>, out: &mut Vec<u8>) -> Result<usize, String> {
        let step = self.step(view.width(), view.height());
        thin(view, step, &mut self.picture);
        let p = &self.picture;
        let side = |n: usize| u32::try_from(n).map_err(|_| format!("{n} pixels are too many"));
        let colour = if p.channels == 1 { ExtendedColorType::L8 } else { ExtendedColorType::Rgb8 };
        out.clear();
        JpegEncoder::new_with_quality(&mut *out, self.quality)
            .encode(&p.data, side(p.width)?, side(p.height)?, colour)
            .map_err(|e| e.to_string())?;
        Ok(step)
    }
}

/// Every `step`-th pixel of every `step`-th row, as grey or R, G, B.
fn thin(view: &FrameView<'_>, step: usize, out: &mut Picture) {
    let (w, h) = (view.width().div_ceil(step), view.height().div_ceil(step));
    let grey = matches!(view.format(), PixelFormat::Gray8 | PixelFormat::Y16 { .. });
    out.reset(w, h, if grey { 1 } else { 3 });
    let (data, stride) = (view.data(), view.stride());
    let channels = out.channels;
    for (y, row) in out.data.chunks_exact_mut(w * channels).enumerate() {
        let y = y * step;
        let line = &data[y * stride..];
        for (x, pixel) in row.chunks_exact_mut(channels).enumerate() {
            let x = x * step;
            match view.format() {
                PixelFormat::Gray8 => pixel[0] = line[x],
                PixelFormat::Y16 { low, high } => {
                    let v = u16::from_le_bytes([line[2 * x], line[2 * x + 1]]).clamp(low, high);
                    pixel[0] = (u32::from(v - low) * 255 / u32::from(high - low).max(1)) as u8;
                }
                PixelFormat::Rgb8 => pixel.copy_from_slice(&line[3 * x..3 * x + 3]),
                PixelFormat::Bgr8 => {
                    pixel.copy_from_slice(&[line[3 * x + 2], line[3 * x + 1], line[3 * x]]);
                }
                PixelFormat::Yuyv => {
                    let pair = 4 * (x / 2);
                    pixel.copy_from_slice(&colour(line[2 * x], line[pair + 1], line[pair + 3]));
                }
                PixelFormat::Uyvy => {
                    let pair = 4 * (x / 2);
                    pixel.copy_from_slice(&colour(line[2 * x + 1], line[pair], line[pair + 2]));
                }
                PixelFormat::Nv12 => {
                    let uv = (view.height() + y / 2) * stride + x / 2 * 2;
                    pixel.copy_from_slice(&colour(line[x], data[uv], data[uv + 1]));
                }
                // A format of a later runtime: grey rather than wrong.
                _ => pixel.fill(128),
            }
        }
    }
}

/// BT.601 limited range, in 8-bit fixed point.
fn colour(y: u8, u: u8, v: u8) -> [u8; 3] {
    let y = 298 * (i32::from(y) - 16) + 128;
    let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
    let byte = |x: i32| (x >> 8).clamp(0, 255) as u8;
    [byte(y + 409 * v), byte(y - 100 * u - 208 * v), byte(y + 516 * u)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_format_shows_the_same_colour() {
        // Pure red on four by two pixels; BT.601 limited: 81, 90, 240.
        let yuyv = [81, 90, 81, 240].repeat(4);
        let uyvy = [90, 81, 240, 81].repeat(4);
        let nv12 = [vec![81; 8], vec![90, 240, 90, 240]].concat();
        for (format, data, stride) in [
            (PixelFormat::Rgb8, [255, 0, 0].repeat(8), 12),
            (PixelFormat::Bgr8, [0, 0, 255].repeat(8), 12),
            (PixelFormat::Yuyv, yuyv, 8),
            (PixelFormat::Uyvy, uyvy, 8),
            (PixelFormat::Nv12, nv12, 4),
        ] {
            let view = FrameView::new(&data, 4, 2, stride, format).expect("view");
            for step in [1, 2, 3] {
                let mut out = Picture::default();
                thin(&view, step, &mut out);
                assert_eq!((out.width, out.height), (4usize.div_ceil(step), 2usize.div_ceil(step)));
                let [r, g, b] = out.rgb(out.width - 1, out.height - 1);
                assert!(r >= 253 && g <= 2 && b <= 2, "{format:?}: {r} {g} {b}");
            }
        }
    }

    #[test]
    fn sixteen_bits_are_shown_between_their_limits() {
        let data: Vec<u8> =
            [900u16, 1000, 1500, 3000].iter().flat_map(|v| v.to_le_bytes()).collect();
        let format = PixelFormat::Y16 { low: 1000, high: 2000 };
        let mut out = Picture::default();
        thin(&FrameView::new(&data, 4, 1, 8, format).expect("view"), 1, &mut out);
        assert_eq!(out.data, [0, 0, 127, 255]);
    }

    #[test]
    fn a_jpeg_is_as_small_as_asked_for() {
        let data = vec![90u8; 64 * 32];
        let (mut out, view) = (Vec::new(), FrameView::gray(&data, 64, 32).expect("view"));
        assert_eq!(Encoder::new(80, 16).jpeg(&view, &mut out), Ok(4));
        let back = image::load_from_memory(&out).expect("jpeg");
        assert_eq!((back.width(), back.height()), (16, 8));
        assert!((i32::from(back.to_luma8().as_raw()[0]) - 90).abs() < 3);
    }
}
