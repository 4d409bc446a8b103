//! Drawing on pictures: scaling, lines, boxes, text.

use super::font;
use crate::frames::yuv_to_rgb;
use crate::picture::Picture;
use tsda_runtime::{BBox, FrameView, PixelFormat};

/// Red, green, blue.
pub type Colour = [u8; 3];

/// Pixel of a view in any format it can have; formats this build does not know show grey.
fn pixel(view: &FrameView<'_>, x: usize, y: usize) -> Colour {
    let (data, row) = (view.data(), y * view.stride());
    match view.format() {
        PixelFormat::Rgb8 => [data[row + 3 * x], data[row + 3 * x + 1], data[row + 3 * x + 2]],
        PixelFormat::Bgr8 => [data[row + 3 * x + 2], data[row + 3 * x + 1], data[row + 3 * x]],
        PixelFormat::Gray8 => [data[row + x]; 3],
        PixelFormat::Y16 { low, high } => {
            let raw = u16::from_le_bytes([data[row + 2 * x], data[row + 2 * x + 1]]);
            let shown = u32::from(raw.clamp(low, high) - low) * 255 / u32::from(high - low);
            [shown as u8; 3]
        }
        PixelFormat::Yuyv => {
            let pair = row + (x / 2) * 4;
            yuv_to_rgb(data[row + 2 * x], data[pair + 1], data[pair + 3], false)
        }
        PixelFormat::Uyvy => {
            let pair = row + (x / 2) * 4;
            yuv_to_rgb(data[row + 2 * x + 1], data[pair], data[pair + 2], false)
        }
        PixelFormat::Nv12 => {
            let chroma = (view.height() + y / 2) * view.stride() + (x / 2) * 2;
            yuv_to_rgb(data[row + x], data[chroma], data[chroma + 1], false)
        }
        _ => [128; 3],
    }
}

/// Copies a view to an RGB picture of `width` pixels and as many rows as the shape asks for:
/// averages when it gets smaller, interpolates when it gets larger. Answers the scale.
pub fn scaled(view: &FrameView<'_>, width: usize, out: &mut Picture) -> f32 {
    let scale = width as f32 / view.width() as f32;
    let height = ((view.height() as f32 * scale + 0.5) as usize).max(1);
    out.reset(width, height, 3);
    for y in 0..height {
        for x in 0..width {
            let i = (y * width + x) * 3;
            let colour = if width == view.width() {
                pixel(view, x, y)
            } else if width > view.width() {
                bilinear(view, (x as f32 + 0.5) / scale - 0.5, (y as f32 + 0.5) / scale - 0.5)
            } else {
                average(view, (x, y), (width, height))
            };
            out.data[i..i + 3].copy_from_slice(&colour);
        }
    }
    scale
}

fn bilinear(view: &FrameView<'_>, x: f32, y: f32) -> Colour {
    let (x, y) = (x.max(0.0), y.max(0.0));
    let (x0, y0) = ((x as usize).min(view.width() - 1), (y as usize).min(view.height() - 1));
    let (x1, y1) = ((x0 + 1).min(view.width() - 1), (y0 + 1).min(view.height() - 1));
    let (u, v) = (x - x0 as f32, y - y0 as f32);
    let corners = [
        (pixel(view, x0, y0), (1.0 - u) * (1.0 - v)),
        (pixel(view, x1, y0), u * (1.0 - v)),
        (pixel(view, x0, y1), (1.0 - u) * v),
        (pixel(view, x1, y1), u * v),
    ];
    std::array::from_fn(|c| {
        corners.iter().map(|(p, w)| f32::from(p[c]) * w).sum::<f32>().round() as u8
    })
}

fn average(
    view: &FrameView<'_>,
    (x, y): (usize, usize),
    (width, height): (usize, usize),
) -> Colour {
    let span = |i: usize, n: usize, of: usize| {
        let first = (i * of / n).min(of - 1);
        first..((i + 1) * of / n).clamp(first + 1, of)
    };
    let (mut sum, mut n) = ([0u32; 3], 0u32);
    for py in span(y, height, view.height()) {
        for px in span(x, width, view.width()) {
            for (s, c) in sum.iter_mut().zip(pixel(view, px, py)) {
                *s += u32::from(c);
            }
            n += 1;
        }
    }
    sum.map(|s| ((s + n / 2) / n) as u8)
}

/// Covers a rectangle with a colour; `alpha` 255 hides what was there. Clipped to the picture.
pub fn fill(picture: &mut Picture, x: i32, y: i32, w: i32, h: i32, colour: Colour, alpha: u8) {
    let clip = |v: i32, max: usize| v.clamp(0, max as i32) as usize;
    for py in clip(y, picture.height)..clip(y.saturating_add(h), picture.height) {
        for px in clip(x, picture.width)..clip(x.saturating_add(w), picture.width) {
            let i = (py * picture.width + px) * 3;
            for (d, s) in picture.data[i..i + 3].iter_mut().zip(colour) {
                let blend =
                    u32::from(*d) * u32::from(255 - alpha) + u32::from(s) * u32::from(alpha);
                *d = (blend / 255) as u8;
            }
        }
    }
}

/// Outline of a box given in the picture's pixels, `line` pixels thick, drawn inside the box's edge.
pub fn outline(picture: &mut Picture, bbox: &BBox, colour: Colour, line: i32) {
    if !bbox.is_valid() {
        return;
    }
    // A box far outside would overflow nothing but draws nothing either.
    let edge = |v: f32| v.round().clamp(-30_000.0, 30_000.0) as i32;
    let (x0, y0, x1, y1) = (edge(bbox.x), edge(bbox.y), edge(bbox.right()), edge(bbox.bottom()));
    let (w, h) = ((x1 - x0).max(1), (y1 - y0).max(1));
    fill(picture, x0, y0, w, line.min(h), colour, 255);
    fill(picture, x0, y1 - line, w, line.min(h), colour, 255);
    fill(picture, x0, y0, line.min(w), h, colour, 255);
    fill(picture, x1 - line, y0, line.min(w), h, colour, 255);
}

/// Pixels a text takes across at this size (pixels per dot).
pub fn text_width(text: &str, size: i32) -> i32 {
    text.chars().count() as i32 * (font::WIDTH as i32 + 1) * size - size
}

/// Height of a line of text at this size.
pub const fn text_height(size: i32) -> i32 {
    font::HEIGHT as i32 * size
}

/// Writes one line with its top-left corner at `(x, y)`.
pub fn text(picture: &mut Picture, x: i32, y: i32, text: &str, colour: Colour, size: i32) {
    let mut left = x;
    for c in text.chars() {
        for (row, bits) in font::glyph(c).into_iter().enumerate() {
            for column in 0..font::WIDTH {
                if bits >> (font::WIDTH - 1 - column) & 1 == 1 {
                    let (px, py) = (left + column as i32 * size, y + row as i32 * size);
                    fill(picture, px, py, size, size, colour, 255);
                }
            }
        }
        left += (font::WIDTH as i32 + 1) * size;
    }
}

/// A straight line, one pixel wide.
pub fn line(picture: &mut Picture, a: (f32, f32), b: (f32, f32), colour: Colour) {
    let steps = (b.0 - a.0).abs().max((b.1 - a.1).abs()).ceil().max(1.0);
    for i in 0..=steps as usize {
        let t = i as f32 / steps;
        let (x, y) = (a.0 + (b.0 - a.0) * t, a.1 + (b.1 - a.1) * t);
        fill(picture, x.round() as i32, y.round() as i32, 1, 1, colour, 255);
    }
}
