//! Pictures of a track for people: PNG per frame, GIF, a self-contained page, a strip of key frames.

mod font;
mod gif;
mod html;
mod overlay;
mod paint;
mod png;
mod strip;

pub use self::gif::GifVideo;
pub use self::html::HtmlPage;
pub use self::overlay::{Limits, Overlay, sensor_colour, sensor_label};
pub use self::paint::{Colour, fill, outline, scaled, text};
pub use self::png::PngFolder;
pub use self::strip::Strip;

use crate::error::HostError;
use crate::track::Sink;
use std::path::Path;

/// The output a path asks for: `.gif`, `.html`, `.png` (strip of key frames), anything else is a
/// folder of PNG files.
///
/// # Errors
/// When the file or folder cannot be created.
pub fn open(path: &Path, total: Option<usize>) -> Result<Box<dyn Sink>, HostError> {
    let kind = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    Ok(match kind.as_str() {
        "gif" => Box::new(GifVideo::create(path, total)?),
        "html" | "htm" => Box::new(HtmlPage::create(path)?),
        "png" => Box::new(Strip::create(path)?),
        "mp4" | "avi" | "mkv" | "webm" | "jpg" | "jpeg" => {
            return Err(HostError::Argument {
                what: format!("--video-out {}", path.display()),
                reason: "only a folder (PNG files), .gif, .html and .png (strip) are written"
                    .into(),
            });
        }
        _ => Box::new(PngFolder::create(path, total)?),
    })
}

#[cfg(test)]
mod tests;
