//! Tests by theme, and what they share.

mod image;
mod message;
mod policy;
mod region;
mod session;

use super::*;
use image_crate::ImageEncoder as _;

use ::image as image_crate;

/// A picture with something to see in it.
fn pattern(width: u32, height: u32) -> image_crate::RgbImage {
    image_crate::RgbImage::from_fn(width, height, |x, y| {
        image_crate::Rgb([
            40 + x as u8 * 3,
            60 + y as u8 * 5,
            if (x / 4 + y / 4) % 2 == 0 { 200 } else { 20 },
        ])
    })
}

fn png(picture: &image_crate::RgbImage) -> Vec<u8> {
    let mut bytes = Vec::new();
    image_crate::codecs::png::PngEncoder::new(&mut bytes)
        .write_image(
            picture.as_raw(),
            picture.width(),
            picture.height(),
            image_crate::ExtendedColorType::Rgb8,
        )
        .expect("png");
    bytes
}

fn jpeg(picture: &image_crate::RgbImage) -> Vec<u8> {
    let mut bytes = Vec::new();
    image_crate::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95)
        .encode_image(picture)
        .expect("jpeg");
    bytes
}
