//! YUV4MPEG2, the raw video of pipes (`ffmpeg -f yuv4mpegpipe -`, 8 bit).

use super::{Frame, FrameSource, SourceError};
use std::io::{BufRead, ErrorKind, Read};
use tsda_runtime::{FrameView, Modality, PixelFormat};

/// Longest line accepted; real headers have some 80 bytes.
const LINE_LIMIT: u64 = 1024;
/// Largest side accepted, so that a damaged header does not ask for terabytes.
const SIDE_LIMIT: usize = 16_384;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Chroma {
    Mono,
    /// Subsampling by this much across and down.
    Planar {
        across: usize,
        down: usize,
    },
}

/// What the header says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Y4mHeader {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    chroma: Chroma,
    full_range: bool,
}

impl Y4mHeader {
    /// Reads the header line without its newline.
    ///
    /// # Errors
    /// Says which field is missing, unknown or out of range.
    pub fn parse(line: &str) -> Result<Self, String> {
        let mut words = line.split(' ');
        if words.next() != Some("YUV4MPEG2") {
            return Err("the stream does not start with YUV4MPEG2".into());
        }
        let (mut width, mut height) = (None, None);
        let mut chroma = Chroma::Planar { across: 2, down: 2 };
        let mut full_range = false;
        for word in words.filter(|w| !w.is_empty()) {
            let (key, value) = word.split_at_checked(1).unwrap_or(("", word));
            let side = || match value.parse::<usize>() {
                Ok(n) if (1..=SIDE_LIMIT).contains(&n) => Ok(Some(n)),
                _ => Err(format!("{word} is not a size from 1 to {SIDE_LIMIT}")),
            };
            match key {
                "W" => width = side()?,
                "H" => height = side()?,
                "C" => {
                    chroma = match value {
                        "420" | "420jpeg" | "420mpeg2" | "420paldv" => {
                            Chroma::Planar { across: 2, down: 2 }
                        }
                        "422" => Chroma::Planar { across: 2, down: 1 },
                        "444" => Chroma::Planar { across: 1, down: 1 },
                        "mono" => Chroma::Mono,
                        _ => {
                            return Err(format!(
                                "pixel format {word} is not read; 8-bit C420*, C422, C444 and \
                                 Cmono are (ffmpeg: -pix_fmt yuv420p)"
                            ));
                        }
                    };
                }
                "X" if value == "COLORRANGE=FULL" => full_range = true,
                // Frame rate, interlacing, aspect and comments do not matter here.
                _ => {}
            }
        }
        match (width, height) {
            (Some(width), Some(height)) => Ok(Self { width, height, chroma, full_range }),
            (None, _) => Err("the width (W) is missing".into()),
            (_, None) => Err("the height (H) is missing".into()),
        }
    }

    /// Width and height of a chroma plane.
    fn chroma_size(&self) -> (usize, usize) {
        match self.chroma {
            Chroma::Mono => (0, 0),
            Chroma::Planar { across, down } => {
                (self.width.div_ceil(across), self.height.div_ceil(down))
            }
        }
    }

    /// The format frames are delivered in. 4:2:0 becomes NV12 and 4:2:2 YUYV, which only moves
    /// chroma bytes; what those cannot describe (odd sides, full range, 4:4:4) becomes RGB.
    fn format(&self) -> PixelFormat {
        let even = self.width.is_multiple_of(2) && self.height.is_multiple_of(2);
        match self.chroma {
            Chroma::Mono => PixelFormat::Gray8,
            Chroma::Planar { across: 2, down: 2 } if even && !self.full_range => PixelFormat::Nv12,
            Chroma::Planar { across: 2, down: 1 }
                if self.width.is_multiple_of(2) && !self.full_range =>
            {
                PixelFormat::Yuyv
            }
            Chroma::Planar { .. } => PixelFormat::Rgb8,
        }
    }
}

/// Frames of a Y4M stream.
#[derive(Debug)]
pub struct Y4m<R> {
    reader: R,
    name: String,
    header: Y4mHeader,
    modality: Option<Modality>,
    next: usize,
    label: String,
    /// The luma plane is read straight into its place here; for RGB this is the output.
    frame: Vec<u8>,
    /// Planes that have to be rearranged.
    planes: Vec<u8>,
}

impl<R: BufRead> Y4m<R> {
    /// Reads the header. `name` is used in messages; `modality` overrides what the pixels say.
    ///
    /// # Errors
    /// When the header is missing, damaged or of a format that is not read.
    pub fn open(
        mut reader: R,
        name: &str,
        modality: Option<Modality>,
    ) -> Result<Self, SourceError> {
        let bad = |reason: String| SourceError::Y4m {
            name: name.into(),
            place: "Y4M header".into(),
            reason,
        };
        let line = read_line(&mut reader)
            .map_err(bad)?
            .ok_or_else(|| bad("the stream is empty (a YUV4MPEG2 stream was expected)".into()))?;
        let header = Y4mHeader::parse(&line).map_err(bad)?;
        Ok(Self {
            reader,
            name: name.into(),
            header,
            modality,
            next: 0,
            label: String::new(),
            frame: Vec::new(),
            planes: Vec::new(),
        })
    }

    /// What the header says.
    pub fn header(&self) -> Y4mHeader {
        self.header
    }

    /// Reads the frame after its `FRAME` line into `self.frame`; answers whether it is colourless.
    fn read_planes(&mut self) -> std::io::Result<bool> {
        let Y4mHeader { width, height, .. } = self.header;
        let (cw, ch) = self.header.chroma_size();
        let (luma, chroma) = (width * height, cw * ch);
        match self.header.format() {
            PixelFormat::Gray8 => {
                self.frame.resize(luma, 0);
                self.reader.read_exact(&mut self.frame)?;
                return Ok(true);
            }
            PixelFormat::Nv12 => {
                self.frame.resize(luma + 2 * chroma, 0);
                self.reader.read_exact(&mut self.frame[..luma])?;
                self.planes.resize(2 * chroma, 0);
                self.reader.read_exact(&mut self.planes)?;
                let (u, v) = self.planes.split_at(chroma);
                for (pair, (u, v)) in self.frame[luma..].chunks_exact_mut(2).zip(u.iter().zip(v)) {
                    pair.copy_from_slice(&[*u, *v]);
                }
            }
            PixelFormat::Yuyv => {
                self.frame.resize(luma * 2, 0);
                self.planes.resize(luma + 2 * chroma, 0);
                self.reader.read_exact(&mut self.planes)?;
                let (y, uv) = self.planes.split_at(luma);
                let (u, v) = uv.split_at(chroma);
                for (quad, (y, (u, v))) in
                    self.frame.chunks_exact_mut(4).zip(y.chunks_exact(2).zip(u.iter().zip(v)))
                {
                    quad.copy_from_slice(&[y[0], *u, y[1], *v]);
                }
            }
            _ => {
                self.planes.resize(luma + 2 * chroma, 0);
                self.reader.read_exact(&mut self.planes)?;
                self.frame.resize(luma * 3, 0);
                self.fill_rgb(cw);
            }
        }
        let colour = &self.planes[self.planes.len() - 2 * chroma..];
        Ok(colour.iter().step_by(7).all(|c| c.abs_diff(128) <= 2))
    }

    fn fill_rgb(&mut self, cw: usize) {
        let Y4mHeader { width, height, chroma, full_range } = self.header;
        let Chroma::Planar { across, down } = chroma else { return };
        let (y, uv) = self.planes.split_at(width * height);
        let (u, v) = uv.split_at(uv.len() / 2);
        for (i, rgb) in self.frame.chunks_exact_mut(3).enumerate() {
            let c = (i / width / down) * cw + (i % width) / across;
            rgb.copy_from_slice(&yuv_to_rgb(y[i], u[c], v[c], full_range));
        }
    }
}

/// BT.601.
pub(crate) fn yuv_to_rgb(y: u8, u: u8, v: u8, full_range: bool) -> [u8; 3] {
    let (y, u, v) = (f32::from(y), f32::from(u) - 128.0, f32::from(v) - 128.0);
    let (luma, chroma) =
        if full_range { (y, 1.0) } else { ((y - 16.0) * (255.0 / 219.0), 255.0 / 224.0) };
    [
        luma + 1.402 * chroma * v,
        luma - (0.344_136 * u + 0.714_136 * v) * chroma,
        luma + 1.772 * chroma * u,
    ]
    .map(|c| (c + 0.5).clamp(0.0, 255.0) as u8)
}

/// A line without its newline; `None` at the end of the stream.
fn read_line(reader: &mut impl BufRead) -> Result<Option<String>, String> {
    let mut line = Vec::new();
    let n = reader.take(LINE_LIMIT).read_until(b'\n', &mut line).map_err(|e| e.to_string())?;
    if n == 0 {
        return Ok(None);
    }
    if line.pop() != Some(b'\n') {
        return Err("the line does not end; this is no Y4M stream or it was cut".into());
    }
    String::from_utf8(line).map(Some).map_err(|_| "the line is not text".into())
}

impl<R: BufRead> FrameSource for Y4m<R> {
    fn len_hint(&self) -> Option<usize> {
        None
    }

    fn next_frame(&mut self) -> Result<Option<Frame<'_>>, SourceError> {
        let (name, index) = (self.name.clone(), self.next);
        let bad = |reason| SourceError::Y4m { name, place: format!("frame {index}"), reason };
        match read_line(&mut self.reader) {
            Ok(None) => return Ok(None),
            Ok(Some(line)) if line == "FRAME" || line.starts_with("FRAME ") => {}
            Ok(Some(_)) => return Err(bad("a FRAME line was expected".to_owned())),
            Err(reason) => return Err(bad(reason)),
        }
        let grey = match self.read_planes() {
            Ok(grey) => grey,
            Err(e) if e.kind() == ErrorKind::UnexpectedEof => {
                return Err(bad("the stream ends within the picture".to_owned()));
            }
            Err(e) => return Err(bad(e.to_string())),
        };
        self.next += 1;
        self.label = format!("frame {index}");
        let format = self.header.format();
        let (width, height) = (self.header.width, self.header.height);
        let view = FrameView::new(&self.frame, width, height, format.row_bytes(width), format)
            .map_err(|source| SourceError::Frame { name: self.label.clone(), source })?;
        let modality =
            self.modality.unwrap_or(if grey { Modality::Thermal } else { Modality::Rgb });
        Ok(Some(Frame { index, name: &self.label, modality, view }))
    }
}
