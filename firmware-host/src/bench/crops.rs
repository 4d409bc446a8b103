//! The crop sampler by itself: its cost must follow the crop, not the size of the sensor's buffer.

use super::report::quantile;
use crate::error::HostError;
use serde::Serialize;
use std::hint::black_box;
use std::time::Instant;
use tsda_runtime::crop::{Window, reference};
use tsda_runtime::{FrameView, ModelSpec, PixelFormat, Yx};

/// Buffers that are sampled: name, format, bytes per pixel.
const FORMATS: [(&str, PixelFormat, usize); 3] = [
    ("rgb8", PixelFormat::Rgb8, 3),
    ("yuyv", PixelFormat::Yuyv, 2),
    ("y16", PixelFormat::Y16 { low: 7000, high: 9000 }, 2),
];
const SIZES: [(usize, usize); 3] = [(640, 480), (1920, 1080), (3840, 2160)];
/// Calls of which the one in the middle counts.
const CALLS: usize = 41;

/// One buffer.
#[derive(Clone, Debug, Serialize)]
pub struct CropTime {
    /// Pixel format.
    pub format: &'static str,
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Side of the search area in pixels of the buffer.
    pub area: f32,
    /// Milliseconds for one crop, the median.
    pub wall_ms_p50: f64,
}

/// Samples a search area of the network's input size times 1.37 from buffers of all formats and
/// sizes.
///
/// # Errors
/// When the specification allows no crop, which no valid one does.
pub fn measure(spec: &ModelSpec) -> Result<Vec<CropTime>, HostError> {
    let failed = |e: &dyn core::fmt::Display| HostError::Argument {
        what: "crop".into(),
        reason: e.to_string(),
    };
    let area = 1.37 * f32::from(spec.crop);
    let mut out = vec![0.0; spec.crop_len()];
    let mut all = Vec::new();
    for (name, format, bytes) in FORMATS {
        for (width, height) in SIZES {
            let data: Vec<u8> = (0..width * height * bytes).map(|i| (i * 31 % 251) as u8).collect();
            let view = FrameView::new(&data, width, height, width * bytes, format)
                .map_err(|e| failed(&e))?;
            let mut ms = Vec::with_capacity(CALLS);
            for call in 0..CALLS {
                // Wanders, as targets do.
                let shift = call as f32 * 2.0;
                let centre = Yx::new(height as f32 * 0.5 + shift, width as f32 * 0.5 - shift);
                let start = Instant::now();
                let window =
                    Window::search(&view, centre, area, spec, 1.5).map_err(|e| failed(&e))?;
                reference(&view, &window, spec, black_box(&mut out)).map_err(|e| failed(&e))?;
                ms.push(start.elapsed().as_secs_f64() * 1e3);
            }
            let wall_ms_p50 = quantile(&mut ms, 0.5);
            all.push(CropTime { format: name, width, height, area, wall_ms_p50 });
        }
    }
    Ok(all)
}
