//! A contact sheet: what the network sees, for a person to look at.

use super::{Crop, Sample};
use image::{Rgb, RgbImage};
use tsda_runtime::{BBox, Modality, ModelSpec};

/// Pixels between crops.
const GAP: usize = 4;

/// One row per sample: its templates, then the search crop, with the target's box and, as a bar
/// above each crop, the sensor (blue: RGB, orange: thermal). A grey box is where an absent target would be.
pub fn contact_sheet(spec: &ModelSpec, samples: &[Sample]) -> RgbImage {
    let columns = samples.iter().map(|s| s.templates.len() + 1).max().unwrap_or(1);
    let cell = spec.crop_side() + GAP;
    let (width, height) = (columns * cell + GAP, samples.len().max(1) * cell + GAP);
    let mut sheet = RgbImage::from_pixel(width as u32, height as u32, Rgb([24, 24, 24]));
    for (row, sample) in samples.iter().enumerate() {
        let crops = sample.templates.iter().chain([&sample.search]);
        for (column, crop) in crops.enumerate() {
            let colour = match column < sample.templates.len() {
                true => [80, 255, 80],
                false if sample.present => [255, 60, 60],
                false => [150, 150, 150],
            };
            draw(&mut sheet, spec, crop, (GAP + column * cell, GAP + row * cell), Rgb(colour));
        }
    }
    sheet
}

fn draw(
    sheet: &mut RgbImage,
    spec: &ModelSpec,
    crop: &Crop,
    origin: (usize, usize),
    colour: Rgb<u8>,
) {
    let side = spec.crop_side();
    let n = side * side;
    let mut put = |x: usize, y: usize, p: Rgb<u8>| {
        sheet.put_pixel((origin.0 + x) as u32, (origin.1 + y) as u32, p);
    };
    for y in 0..side {
        for x in 0..side {
            let value = |c: usize| {
                let v = crop.pixels[c * n + y * side + x];
                ((v * spec.input_std[c] + spec.input_mean[c]) * 255.0).round().clamp(0.0, 255.0)
                    as u8
            };
            put(x, y, Rgb([value(0), value(1), value(2)]));
        }
    }
    let bar = match crop.modality {
        Modality::Rgb => Rgb([70, 130, 255]),
        Modality::Thermal => Rgb([255, 150, 40]),
    };
    for x in 0..side {
        put(x, 0, bar);
        put(x, 1, bar);
    }
    outline(&crop.bbox, side, |x, y| put(x, y, colour));
}

/// Calls `put` for the pixels of the box's outline that lie inside a square of `side` pixels.
fn outline(bbox: &BBox, side: usize, mut put: impl FnMut(usize, usize)) {
    let last = side as i64 - 1;
    let (x0, y0) = (bbox.x.round() as i64, bbox.y.round() as i64);
    let (x1, y1) = (bbox.right().round() as i64 - 1, bbox.bottom().round() as i64 - 1);
    let mut dot = |x: i64, y: i64| {
        if (0..=last).contains(&x) && (0..=last).contains(&y) {
            put(x as usize, y as usize);
        }
    };
    for x in x0.max(0)..=x1.min(last) {
        dot(x, y0);
        dot(x, y1);
    }
    for y in y0.max(0)..=y1.min(last) {
        dot(x0, y);
        dot(x1, y);
    }
}
