//! Animated GIF.

use super::overlay::{Limits, Overlay};
use crate::error::HostError;
use crate::output::PartFile;
use crate::track::{Sink, Step};
use gif::{Encoder, Repeat};
use std::path::{Path, PathBuf};
use tsda_runtime::{BBox, FrameView};

/// Hundredths of a second per frame.
const DELAY: u16 = 6;

/// An endless animation, at most 480 pixels wide.
pub struct GifVideo {
    path: PathBuf,
    state: State,
    overlay: Overlay,
}

/// The encoder wants the size at its birth, which only the first frame tells.
enum State {
    Waiting(PartFile),
    Running { encoder: Encoder<PartFile>, width: usize, height: usize },
    Broken,
}

impl std::fmt::Debug for GifVideo {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("GifVideo").field("path", &self.path).finish_non_exhaustive()
    }
}

impl GifVideo {
    /// Starts writing a file.
    ///
    /// # Errors
    /// When it cannot be created.
    pub fn create(path: &Path, total: Option<usize>) -> Result<Self, HostError> {
        Ok(Self {
            path: path.to_path_buf(),
            state: State::Waiting(PartFile::create(path)?),
            overlay: Overlay::new(Limits { min: 320, max: 480 }, total),
        })
    }
}

impl Sink for GifVideo {
    fn frame(
        &mut self,
        view: &FrameView<'_>,
        step: &Step,
        truth: Option<BBox>,
    ) -> Result<(), HostError> {
        let failed = |reason: String| HostError::Encode { path: self.path.clone(), reason };
        let picture = self.overlay.draw(view, step, truth);
        let side = |v: usize| u16::try_from(v).map_err(|_| failed("picture too large".into()));
        let (w, h) = (side(picture.width)?, side(picture.height)?);
        if let State::Waiting(_) = self.state
            && let State::Waiting(file) = std::mem::replace(&mut self.state, State::Broken)
        {
            let mut encoder = Encoder::new(file, w, h, &[]).map_err(|e| failed(e.to_string()))?;
            encoder.set_repeat(Repeat::Infinite).map_err(|e| failed(e.to_string()))?;
            let (width, height) = (picture.width, picture.height);
            self.state = State::Running { encoder, width, height };
        }
        let State::Running { encoder, width, height } = &mut self.state else {
            return Err(failed("the file could not be started".into()));
        };
        // Sensors may differ in size: a GIF has one, so later frames are cut or padded to it.
        let mut pixels = vec![0u8; *width * *height * 3];
        let row = picture.width.min(*width) * 3;
        for y in 0..picture.height.min(*height) {
            let (to, from) = (y * *width * 3, y * picture.width * 3);
            pixels[to..to + row].copy_from_slice(&picture.data[from..from + row]);
        }
        // Dropping the lowest bits hides sensor noise from the compressor.
        for v in &mut pixels {
            *v = (*v & 0xF8) | (*v >> 5);
        }
        let mut frame = gif::Frame::from_rgb_speed(side(*width)?, side(*height)?, &pixels, 20);
        frame.delay = DELAY;
        encoder.write_frame(&frame).map_err(|e| failed(e.to_string()))
    }

    fn finish(self: Box<Self>) -> Result<(), HostError> {
        let failed = |reason: String| HostError::Encode { path: self.path.clone(), reason };
        match self.state {
            State::Running { encoder, .. } => {
                encoder.into_inner().map_err(|e| failed(e.to_string()))?.commit()
            }
            State::Waiting(_) | State::Broken => Err(failed("there was no frame".into())),
        }
    }
}
