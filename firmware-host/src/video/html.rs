//! One self-contained page: frames, box, score over time.

use super::overlay::sensor_colour;
use super::paint::scaled;
use crate::error::HostError;
use crate::output::PartFile;
use crate::picture::Picture;
use crate::track::{Sink, Step};
use image::codecs::jpeg::JpegEncoder;
use serde::Serialize;
use std::io::Write;
use std::path::Path;
use tsda_runtime::{BBox, FrameView, Modality};

/// Frames wider than this are reduced.
const WIDTH: usize = 640;
const QUALITY: u8 = 82;

/// The page without its data; `/*DATA*/` is where frames and steps go.
const PAGE: &str = include_str!("player.html");

/// What the page knows about a frame; one-letter names keep the file small.
#[derive(Serialize)]
struct Row<'a> {
    f: &'a str,
    m: &'static str,
    /// Box in pixels of the embedded JPEG.
    b: [f32; 4],
    s: f32,
    t: &'static str,
    ms: f32,
    #[serde(skip_serializing_if = "Option::is_none")]
    g: Option<[f32; 4]>,
}

/// The page being written: frames go to the file as they come.
#[derive(Debug)]
pub struct HtmlPage {
    file: PartFile,
    rows: Vec<String>,
    picture: Picture,
}

impl HtmlPage {
    /// Starts writing a file.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn create(path: &Path) -> Result<Self, HostError> {
        let mut file = PartFile::create(path)?;
        let (head, _) = halves();
        let start = format!("{head}const FRAMES=[");
        file.write_all(start.as_bytes()).map_err(|e| file.failed(e))?;
        Ok(Self { file, rows: Vec::new(), picture: Picture::default() })
    }
}

fn halves() -> (&'static str, &'static str) {
    PAGE.split_once("/*DATA*/").unwrap_or((PAGE, ""))
}

fn hex([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

impl Sink for HtmlPage {
    fn frame(
        &mut self,
        view: &FrameView<'_>,
        step: &Step,
        truth: Option<BBox>,
    ) -> Result<(), HostError> {
        let scale = scaled(view, view.width().min(WIDTH), &mut self.picture);
        let failed =
            |reason: String| HostError::Encode { path: self.file.path().to_path_buf(), reason };
        let mut jpeg = Vec::new();
        JpegEncoder::new_with_quality(&mut jpeg, QUALITY)
            .encode(
                &self.picture.data,
                self.picture.width as u32,
                self.picture.height as u32,
                image::ExtendedColorType::Rgb8,
            )
            .map_err(|e| failed(e.to_string()))?;
        let on = |b: BBox| [b.x, b.y, b.w, b.h].map(|v| (v * scale * 10.0).round() / 10.0);
        let row = Row {
            f: &step.name,
            m: step.modality.as_str(),
            b: on(step.bbox),
            s: (step.score * 1000.0).round() / 1000.0,
            t: step.state.as_str(),
            ms: (step.ms * 100.0).round() / 100.0,
            g: truth.map(on),
        };
        // `<` could end the script element from within a file name.
        let row = serde_json::to_string(&row).map_err(|e| failed(e.to_string()))?;
        self.rows.push(row.replace('<', "\\u003c"));
        let comma = if self.rows.len() > 1 { "," } else { "" };
        let text = format!("{comma}\n\"{}\"", base64(&jpeg));
        self.file.write_all(text.as_bytes()).map_err(|e| self.file.failed(e))
    }

    fn finish(mut self: Box<Self>) -> Result<(), HostError> {
        let (_, tail) = halves();
        let colours = format!(
            "{{\"rgb\":\"{}\",\"thermal\":\"{}\"}}",
            hex(sensor_colour(Modality::Rgb)),
            hex(sensor_colour(Modality::Thermal))
        );
        let rest = format!(
            "\n];\nconst TRACK=[\n{}\n];\nconst COLOURS={colours};\n{tail}",
            self.rows.join(",\n")
        );
        self.file.write_all(rest.as_bytes()).map_err(|e| self.file.failed(e))?;
        self.file.commit()
    }
}

/// RFC 4648 with padding.
pub(super) fn base64(bytes: &[u8]) -> String {
    const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for chunk in bytes.chunks(3) {
        let word =
            chunk.iter().fold(0u32, |w, b| w << 8 | u32::from(*b)) << (8 * (3 - chunk.len()));
        for i in 0..4 {
            let symbol = ALPHABET[(word >> (18 - 6 * i) & 63) as usize];
            out.push(if i <= chunk.len() { symbol as char } else { '=' });
        }
    }
    out
}
