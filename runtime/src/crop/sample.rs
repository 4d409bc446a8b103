//! The resampling: every row of the picture that is needed is converted and resampled across once,
//! into numbers per channel; two such rows give a row of the output. What a row of numbers costs is
//! paid per row of the picture where the crop is enlarged, not per row of the output.

use super::{CropError, Window};
use crate::frame::{FrameView, PixelFormat};
use crate::spec::ModelSpec;

/// Columns of the output that are computed at a time.
const STRIPE: usize = 64;
/// Pixels of a row, decimated, that a stripe may read: as many as a byte can count, so that every place
/// is inside. Decimation keeps the ratio near two at most; where it is larger, a stripe is narrower.
const SPAN: usize = 256;
/// Channels as they lie in pictures.
const RGB: usize = 3;
/// Numbers that are computed for three channels: processors take four as fast as one. The fourth is
/// nothing, or belongs to the next pixel; it goes nowhere.
const FOUR: usize = 4;

/// Pixels of a row, one after the other.
type Pixels = [f32; FOUR * SPAN];

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
    let forward = [0, 1, 2];
    match frame.format() {
        PixelFormat::Rgb8 => {
            resample::<RGB, FOUR>(window, spec, forward, out, |y, x, step, row| {
                triples(line(y, x, RGB), step, row);
            })
        }
        PixelFormat::Bgr8 => {
            resample::<RGB, FOUR>(window, spec, [2, 1, 0], out, |y, x, step, row| {
                triples(line(y, x, RGB), step, row);
            })
        }
        PixelFormat::Gray8 => resample::<1, 1>(window, spec, forward, out, |y, x, step, row| {
            each(line(y, x, 1), step, row, |&[v]| f32::from(v));
        }),
        PixelFormat::Y16 { low, high } => {
            let (low, high) = (f32::from(low), f32::from(high));
            let gain = 255.0 / (high - low).max(1.0);
            resample::<1, 1>(window, spec, forward, out, |y, x, step, row| {
                each(line(y, x, 2), step, row, |&raw| {
                    // Not `clamp`: its check of the limits keeps this from being vector code.
                    (f32::from(u16::from_le_bytes(raw)).max(low).min(high) - low) * gain
                });
            });
        }
        PixelFormat::Yuyv => {
            resample::<FOUR, FOUR>(window, spec, forward, out, |y, x, step, row| {
                packed(line(y, 0, 2), x, step, row, |pair| pair);
            })
        }
        PixelFormat::Uyvy => {
            resample::<FOUR, FOUR>(window, spec, forward, out, |y, x, step, row| {
                packed(line(y, 0, 2), x, step, row, |[u, y0, v, y1]| [y0, u, y1, v]);
            })
        }
        PixelFormat::Nv12 => {
            let chroma = frame.height() * stride;
            resample::<FOUR, FOUR>(window, spec, forward, out, |y, x, step, row| {
                let (luma, chroma) = (line(y, 0, 1), &data[chroma + y / 2 * stride..]);
                for (i, pixel) in row.as_chunks_mut().0.iter_mut().enumerate() {
                    let x = x + i * step;
                    let [u, v] = [0, 1].map(|i| f32::from(chroma[x / 2 * 2 + i]));
                    [*pixel, _] = rgb_pair([luma[x].into(), u, 0.0, v]);
                }
            });
        }
    }
    Ok(())
}

/// Every `step`-th group of `N` bytes, as a pixel of one channel.
fn each<const N: usize>(
    line: &[u8],
    step: usize,
    row: &mut [f32],
    convert: impl Fn(&[u8; N]) -> f32,
) {
    if step == 1 {
        for (pixel, bytes) in row.iter_mut().zip(line.as_chunks().0) {
            *pixel = convert(bytes);
        }
        return;
    }
    for (pixel, group) in row.iter_mut().zip(line.chunks(N * step)) {
        if let Some(bytes) = group.first_chunk() {
            *pixel = convert(bytes);
        }
    }
}

/// Every `step`-th group of three bytes.
fn triples(line: &[u8], step: usize, row: &mut [f32]) {
    if step == 1 {
        for (value, &byte) in row.iter_mut().zip(line) {
            *value = byte.into();
        }
        return;
    }
    for (pixel, bytes) in row.chunks_mut(RGB).zip(line.chunks(RGB * step)) {
        for (value, &byte) in pixel.iter_mut().zip(bytes) {
            *value = byte.into();
        }
    }
}

/// Every `step`-th pixel from `x` on of a row of pairs, each in the `order` Y, U, Y, V.
fn packed(
    line: &[u8],
    x: usize,
    step: usize,
    row: &mut [f32],
    order: impl Fn([f32; 4]) -> [f32; 4],
) {
    let pixels: &mut [[f32; FOUR]] = row.as_chunks_mut().0;
    let pairs: &[[u8; 4]] = line.as_chunks().0;
    let both = |pair: &[u8; 4]| rgb_pair(order(pair.map(f32::from)));
    // Single pixels: all of them, or those at the ends whose neighbour is not wanted.
    let odd = if step > 1 { pixels.len() } else { (x % 2).min(pixels.len()) };
    let (head, rest) = pixels.split_at_mut(odd);
    for (i, pixel) in head.iter_mut().enumerate() {
        let x = x + i * step;
        *pixel = both(&pairs[x / 2])[x % 2];
    }
    let (twos, tail) = rest.as_chunks_mut();
    let mut pairs = pairs[(x + odd) / 2..].iter();
    for (two, pair) in twos.iter_mut().zip(&mut pairs) {
        *two = both(pair);
    }
    if let ([pixel], Some(pair)) = (tail, pairs.next()) {
        *pixel = both(pair)[0];
    }
}

/// BT.601 limited range to 0..255, real-valued: two pixels of the numbers Y, U, Y, V. Every step is one
/// operation on four numbers.
fn rgb_pair(pair: [f32; 4]) -> [[f32; FOUR]; 2] {
    const ZERO: [f32; 4] = [16.0, 128.0, 16.0, 128.0];
    const GAIN: [f32; 4] = [1.164_383_6, 1.0, 1.164_383_6, 1.0];
    /// What U or V adds to red, green and blue, and what V adds to green besides.
    const CHROMA: [[f32; FOUR]; 2] =
        [[1.596_026_8, -0.391_762_3, 2.017_232_2, 0.0], [0.0, -0.812_967_65, 0.0, 0.0]];
    let [y0, u, y1, v]: [f32; 4] = core::array::from_fn(|i| (pair[i] - ZERO[i]) * GAIN[i]);
    let sources = [[v, u, u, u], [v; 4]];
    let [first, second]: [[f32; FOUR]; 2] =
        core::array::from_fn(|i| core::array::from_fn(|c| sources[i][c] * CHROMA[i][c]));
    [y0, y1].map(|y| core::array::from_fn(|c| (y + first[c] + second[c]).clamp(0.0, 255.0)))
}

/// A row of the picture resampled to a stripe's columns.
type Row<const L: usize> = [[f32; L]; STRIPE];

/// Where a column comes from: places among the pixels of a stripe and the share of the second one.
#[derive(Clone, Copy, Debug, Default)]
struct Column {
    near: u8,
    far: u8,
    weight: f32,
}

/// The loop over the output; `read(row, column, step, pixels)` reads every `step`-th pixel of a row
/// from a column on, with `C` numbers each, of which `L` are computed. `planes` says which
/// channel the planes of the output show; one channel stands for all three.
fn resample<const C: usize, const L: usize>(
    window: &Window,
    spec: &ModelSpec,
    planes: [usize; 3],
    out: &mut [f32],
    read: impl Fn(usize, usize, usize, &mut [f32]),
) {
    let (side, step, full) = (window.output(), window.decimation, window.side as f32);
    let (ratio_y, ratio_x) = (window.y.len as f32 / full, window.x.len as f32 / full);
    let plane = side * side;
    // A division takes as long as all the rest of a number.
    let normal: [(f32, f32); 3] = core::array::from_fn(|c| {
        let (mean, std) = (f64::from(spec.input_mean[c]), f64::from(spec.input_std[c]));
        ((1.0 / (255.0 * std)) as f32, (-mean / std) as f32)
    });
    let mut pixels: Pixels = [0.0; _];
    let mut stripe = [Column::default(); STRIPE];
    let mut rows: [Row<L>; 2] = [[[0.0; L]; STRIPE]; 2];
    let mut left = 0;
    while left < side {
        // Columns count from the stripe's first pixel on.
        let first = window.x.tap(left + window.margin, ratio_x, step).near;
        let (mut columns, mut span) = (0, 1);
        while columns < STRIPE.min(side - left) {
            let tap = window.x.tap(left + columns + window.margin, ratio_x, step);
            let [near, far] = [tap.near, tap.far].map(|x| u8::try_from((x - first) / step));
            let (Ok(near), Ok(far)) = (near, far) else { break };
            stripe[columns] = Column { near, far, weight: tap.weight };
            span = usize::from(far) + 1;
            columns += 1;
        }
        let mut fill = |row: &mut Row<L>, y: usize| {
            read(y, first, step, &mut pixels[..C * span]);
            across::<C, L>(&pixels, &stripe[..columns], row);
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
            let mut values: Row<L> = [[0.0; L]; STRIPE];
            let [above, below] = [near, far].map(|i| rows[i].as_flattened());
            for (value, pair) in values.as_flattened_mut().iter_mut().zip(above.iter().zip(below)) {
                *value = (1.0 - v.weight) * pair.0 + v.weight * pair.1;
            }
            for (p, (gain, shift)) in normal.iter().enumerate() {
                let (at, channel) = (p * plane + r * side + left, planes[p].min(C - 1));
                for (out, value) in out[at..at + columns].iter_mut().zip(&values) {
                    *out = value[channel] * gain + shift;
                }
            }
        }
        left += columns;
    }
}

/// The point at `weight` of the way from one pixel to another.
fn between<const L: usize>(from: &[f32; L], to: &[f32; L], weight: f32) -> [f32; L] {
    core::array::from_fn(|c| (1.0 - weight) * from[c] + weight * to[c])
}

/// Resamples pixels of a row.
fn across<const C: usize, const L: usize>(pixels: &Pixels, stripe: &[Column], row: &mut Row<L>) {
    let pixel = |i: u8| -> &[f32; L] {
        let at = C * usize::from(i);
        pixels[at..at + L].first_chunk().unwrap_or(&[0.0; L])
    };
    for (value, column) in row.iter_mut().zip(stripe) {
        *value = between(pixel(column.near), pixel(column.far), column.weight);
    }
}
