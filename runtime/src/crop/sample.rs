//! The resampling: every row of the picture that is needed is converted and resampled across once,
//! into numbers per channel; two such rows give a row of the output. What a row of numbers costs is
//! paid per row of the picture where the crop is enlarged, not per row of the output.

use super::{CropError, Tap, Window};
use crate::frame::{FrameView, PixelFormat};
use crate::spec::ModelSpec;

/// Columns of the output that are computed at a time.
const STRIPE: usize = 64;
/// Pixels of a row, decimated, that a stripe may read. Decimation keeps the ratio near two at most;
/// where it is larger, a stripe is narrower.
const SPAN: usize = 160;

/// Resamples a window as the reference does (spec 3.4, step 9; spec 1.1): bilinear with half-pixel
/// centres, no antialias, values stay real-valued, then `(value / 255 - mean) / std`, as one product
/// and one sum, into `out`, `(3, side, side)` in the order R, G, B.
///
/// # Errors
/// When `out` has not exactly three planes of [`Window::output`] squared.
pub fn reference(
    frame: &FrameView<'_>,
    window: &Window,
    spec: &ModelSpec,
    out: &mut [f32],
) -> Result<(), CropError> {
    let side = window.output();
    let needed = 3 * side * side;
    if out.len() != needed || side == 0 {
        return Err(CropError::Output { len: out.len(), needed });
    }
    let (data, stride) = (frame.data(), frame.stride());
    let line = |y: usize, x: usize, bytes: usize| &data[y * stride + x * bytes..];
    match frame.format() {
        PixelFormat::Rgb8 => resample(window, spec, out, |y, x, step, pixels| {
            each(line(y, x, 3), step, pixels, |&[r, g, b]| [r.into(), g.into(), b.into()]);
        }),
        PixelFormat::Bgr8 => resample(window, spec, out, |y, x, step, pixels| {
            each(line(y, x, 3), step, pixels, |&[b, g, r]| [r.into(), g.into(), b.into()]);
        }),
        PixelFormat::Gray8 => resample(window, spec, out, |y, x, step, pixels| {
            each(line(y, x, 1), step, pixels, |&[v]| [v.into()]);
        }),
        PixelFormat::Y16 { low, high } => {
            let gain = 255.0 / (f32::from(high) - f32::from(low)).max(1.0);
            resample(window, spec, out, |y, x, step, pixels| {
                each(line(y, x, 2), step, pixels, |&raw| {
                    [f32::from(u16::from_le_bytes(raw).clamp(low, high) - low) * gain]
                });
            });
        }
        PixelFormat::Yuyv => resample(window, spec, out, |y, x, step, pixels| {
            packed(line(y, 0, 2), x, step, pixels, |&[y0, u, y1, v]| ([y0, y1], u, v));
        }),
        PixelFormat::Uyvy => resample(window, spec, out, |y, x, step, pixels| {
            packed(line(y, 0, 2), x, step, pixels, |&[u, y0, v, y1]| ([y0, y1], u, v));
        }),
        PixelFormat::Nv12 => {
            let chroma = frame.height() * stride;
            resample(window, spec, out, |y, x, step, pixels| {
                let (luma, chroma) = (line(y, 0, 1), &data[chroma + y / 2 * stride..]);
                for (i, pixel) in pixels.iter_mut().enumerate() {
                    let x = x + i * step;
                    *pixel = rgb(luma[x], &Chroma::new(chroma[x / 2 * 2], chroma[x / 2 * 2 + 1]));
                }
            });
        }
    }
    Ok(())
}

/// Every `step`-th group of `N` bytes, as a pixel.
fn each<const N: usize, const C: usize>(
    line: &[u8],
    step: usize,
    pixels: &mut [[f32; C]],
    convert: impl Fn(&[u8; N]) -> [f32; C],
) {
    if step == 1 {
        for (pixel, bytes) in pixels.iter_mut().zip(line.as_chunks().0) {
            *pixel = convert(bytes);
        }
        return;
    }
    for (pixel, group) in pixels.iter_mut().zip(line.chunks(N * step)) {
        if let Some(bytes) = group.first_chunk() {
            *pixel = convert(bytes);
        }
    }
}

/// Every `step`-th pixel from `x` on of a row of pairs, `split` into both lumas, U and V.
fn packed(
    line: &[u8],
    x: usize,
    step: usize,
    pixels: &mut [[f32; 3]],
    split: impl Fn(&[u8; 4]) -> ([u8; 2], u8, u8),
) {
    let pairs = line.as_chunks().0;
    if step > 1 {
        for (i, pixel) in pixels.iter_mut().enumerate() {
            let x = x + i * step;
            let (luma, u, v) = split(&pairs[x / 2]);
            *pixel = rgb(luma[x % 2], &Chroma::new(u, v));
        }
        return;
    }
    // Two pixels share their chroma.
    let odd = (x % 2).min(pixels.len());
    let (head, rest) = pixels.split_at_mut(odd);
    if let [pixel] = head {
        let (luma, u, v) = split(&pairs[x / 2]);
        *pixel = rgb(luma[1], &Chroma::new(u, v));
    }
    for (pixels, pair) in rest.chunks_mut(2).zip(&pairs[(x + odd) / 2..]) {
        let (luma, u, v) = split(pair);
        let chroma = Chroma::new(u, v);
        for (pixel, luma) in pixels.iter_mut().zip(luma) {
            *pixel = rgb(luma, &chroma);
        }
    }
}

/// What U and V add to red, green (in two parts) and blue.
struct Chroma {
    red: f32,
    green: [f32; 2],
    blue: f32,
}

impl Chroma {
    fn new(u: u8, v: u8) -> Self {
        let (u, v) = (f32::from(u) - 128.0, f32::from(v) - 128.0);
        Self {
            red: 1.596_026_8 * v,
            green: [0.391_762_3 * u, 0.812_967_65 * v],
            blue: 2.017_232_2 * u,
        }
    }
}

/// BT.601 limited range to 0..255, real-valued.
fn rgb(luma: u8, chroma: &Chroma) -> [f32; 3] {
    let y = 1.164_383_6 * (f32::from(luma) - 16.0);
    [y + chroma.red, y - chroma.green[0] - chroma.green[1], y + chroma.blue]
        .map(|v| v.clamp(0.0, 255.0))
}

/// A row of the picture resampled to a stripe's columns, by channel.
type Row<const C: usize> = [[f32; STRIPE]; C];

/// The loop over the output; `read(row, column, step, pixels)` reads every `step`-th pixel of a row
/// from a column on, with `C` channels each, 1 or 3.
fn resample<const C: usize>(
    window: &Window,
    spec: &ModelSpec,
    out: &mut [f32],
    read: impl Fn(usize, usize, usize, &mut [[f32; C]]),
) {
    let (side, step, full) = (window.output(), window.decimation, window.side as f32);
    let (ratio_y, ratio_x) = (window.y.len as f32 / full, window.x.len as f32 / full);
    let plane = side * side;
    // A division takes as long as all the rest of a number.
    let normal: [(f32, f32); 3] = core::array::from_fn(|c| {
        let (mean, std) = (f64::from(spec.input_mean[c]), f64::from(spec.input_std[c]));
        ((1.0 / (255.0 * std)) as f32, (-mean / std) as f32)
    });
    let mut pixels = [[0.0; C]; SPAN];
    let mut taps = [Tap::default(); STRIPE];
    let mut rows: [Row<C>; 2] = [[[0.0; STRIPE]; C]; 2];
    let mut left = 0;
    while left < side {
        // Taps count from the stripe's first pixel on.
        let first = window.x.tap(left + window.margin, ratio_x, step).near;
        let mut columns = 0;
        while columns < STRIPE.min(side - left) {
            let tap = window.x.tap(left + columns + window.margin, ratio_x, step);
            let [near, far] = [tap.near, tap.far].map(|x| (x - first) / step);
            if far >= SPAN {
                break;
            }
            taps[columns] = Tap { near, far, ..tap };
            columns += 1;
        }
        let taps = &taps[..columns];
        let span = taps[columns - 1].far + 1;
        let mut fill = |row: &mut Row<C>, y: usize| {
            read(y, first, step, &mut pixels[..span]);
            across(&pixels, taps, row);
        };
        let mut held = [usize::MAX; 2];
        for r in 0..side {
            let v = window.y.tap(r + window.margin, ratio_y, step);
            let near = held.iter().position(|&y| y == v.near).unwrap_or_else(|| {
                let free = usize::from(held[0] == v.far);
                fill(&mut rows[free], v.near);
                held[free] = v.near;
                free
            });
            let far = if v.far == v.near { near } else { 1 - near };
            if held[far] != v.far {
                fill(&mut rows[far], v.far);
                held[far] = v.far;
            }
            let mut values = [[0.0; STRIPE]; C];
            for (values, (above, below)) in values.iter_mut().zip(rows[near].iter().zip(&rows[far]))
            {
                for (value, (above, below)) in values.iter_mut().zip(above.iter().zip(below)) {
                    *value = (1.0 - v.weight) * above + v.weight * below;
                }
            }
            for (channel, (gain, shift)) in normal.iter().enumerate() {
                // One channel stands for all three.
                let values = &values[channel.min(C - 1)];
                let at = channel * plane + r * side + left;
                for (out, value) in out[at..at + columns].iter_mut().zip(values) {
                    *out = value * gain + shift;
                }
            }
        }
        left += columns;
    }
}

/// Resamples pixels of a row.
fn across<const C: usize>(pixels: &[[f32; C]; SPAN], taps: &[Tap], row: &mut Row<C>) {
    for (i, tap) in taps.iter().enumerate().take(STRIPE) {
        let (near, far) = (&pixels[tap.near], &pixels[tap.far]);
        for (channel, row) in row.iter_mut().enumerate() {
            row[i] = (1.0 - tap.weight) * near[channel] + tap.weight * far[channel];
        }
    }
}
