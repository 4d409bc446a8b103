//! Borrowed pictures: the driver's buffer as it is, no copy, no conversion.

/// How the bytes of a [`FrameView`] are to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PixelFormat {
    /// Three bytes per pixel: R, G, B.
    Rgb8,
    /// Three bytes per pixel: B, G, R.
    Bgr8,
    /// One byte per pixel; replicated to three channels.
    Gray8,
    /// Two bytes per pixel, little endian, mapped linearly so that `low` becomes 0 and `high` 255
    /// (values outside are clamped); replicated to three channels. Sensors of 10, 12 or 14 bits in
    /// 16-bit words (V4L2 `Y10 `, `Y12 `, `Y14 `) are read with this too.
    Y16 {
        /// Raw value shown as 0.
        low: u16,
        /// Raw value shown as 255; must be above `low`.
        high: u16,
    },
    /// Packed 4:2:2, two pixels in four bytes: Y0 U Y1 V, BT.601 limited range. Even width.
    Yuyv,
    /// Packed 4:2:2 like [`Self::Yuyv`], in the order U Y0 V Y1.
    Uyvy,
    /// Planar luma followed by interleaved half-size U, V; BT.601 limited range. Even sides.
    Nv12,
}

impl PixelFormat {
    /// Bytes of one row of `width` pixels (for NV12: of the luma plane).
    pub const fn row_bytes(self, width: usize) -> usize {
        match self {
            Self::Rgb8 | Self::Bgr8 => width * 3,
            Self::Gray8 | Self::Nv12 => width,
            Self::Y16 { .. } | Self::Yuyv | Self::Uyvy => width * 2,
        }
    }
}

/// A picture someone else owns.
#[derive(Clone, Copy, Debug)]
pub struct FrameView<'a> {
    data: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
    format: PixelFormat,
}

/// A picture that cannot be read as described.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// Width or height is zero.
    #[error("frame is {width} x {height}: both sides must be at least 1 pixel")]
    Empty {
        /// Width given.
        width: usize,
        /// Height given.
        height: usize,
    },
    /// A row does not fit the stride.
    #[error("frame stride is {stride} bytes, but a row of {width} pixels needs {needed}")]
    Stride {
        /// Stride given, in bytes.
        stride: usize,
        /// Width given.
        width: usize,
        /// Bytes one row takes.
        needed: usize,
    },
    /// The buffer ends before the last row does.
    #[error("frame buffer holds {len} bytes, but {needed} are needed for its size and format")]
    Truncated {
        /// Bytes given.
        len: usize,
        /// Bytes needed.
        needed: usize,
    },
    /// The format cannot describe a picture of this size, or its range is empty.
    #[error("frame of {width} x {height} does not suit its pixel format: {want}")]
    Format {
        /// Width given.
        width: usize,
        /// Height given.
        height: usize,
        /// What the format needs.
        want: &'static str,
    },
}

impl<'a> FrameView<'a> {
    /// A view of `data`: `height` rows, `stride` bytes apart, `width` pixels each.
    ///
    /// # Errors
    /// When a side is zero, a row is longer than the stride, the buffer is too short, or the format
    /// does not suit the size.
    pub fn new(
        data: &'a [u8],
        width: usize,
        height: usize,
        stride: usize,
        format: PixelFormat,
    ) -> Result<Self, FrameError> {
        if width == 0 || height == 0 {
            return Err(FrameError::Empty { width, height });
        }
        let unsuited = |want| Err(FrameError::Format { width, height, want });
        match format {
            PixelFormat::Yuyv | PixelFormat::Uyvy if width % 2 == 1 => {
                return unsuited("YUYV and UYVY need an even width");
            }
            PixelFormat::Nv12 if width % 2 == 1 || height % 2 == 1 => {
                return unsuited("NV12 needs an even width and height");
            }
            PixelFormat::Y16 { low, high } if low >= high => {
                return unsuited("Y16 needs low < high");
            }
            _ => {}
        }
        let overflow = FrameError::Truncated { len: data.len(), needed: usize::MAX };
        let row = match format {
            PixelFormat::Rgb8 | PixelFormat::Bgr8 => width.checked_mul(3),
            PixelFormat::Gray8 | PixelFormat::Nv12 => Some(width),
            PixelFormat::Y16 { .. } | PixelFormat::Yuyv | PixelFormat::Uyvy => width.checked_mul(2),
        }
        .ok_or(overflow)?;
        if stride < row {
            return Err(FrameError::Stride { stride, width, needed: row });
        }
        let rows = if format == PixelFormat::Nv12 { height + height / 2 } else { height };
        let needed =
            stride.checked_mul(rows - 1).and_then(|n| n.checked_add(row)).ok_or(overflow)?;
        if data.len() < needed {
            return Err(FrameError::Truncated { len: data.len(), needed });
        }
        Ok(Self { data, width, height, stride, format })
    }

    /// Tightly packed 8-bit RGB.
    ///
    /// # Errors
    /// See [`Self::new`].
    pub fn rgb(data: &'a [u8], width: usize, height: usize) -> Result<Self, FrameError> {
        Self::new(data, width, height, width.saturating_mul(3), PixelFormat::Rgb8)
    }

    /// Tightly packed 8-bit grey.
    ///
    /// # Errors
    /// See [`Self::new`].
    pub fn gray(data: &'a [u8], width: usize, height: usize) -> Result<Self, FrameError> {
        Self::new(data, width, height, width, PixelFormat::Gray8)
    }

    /// Pixels per row.
    pub const fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub const fn height(&self) -> usize {
        self.height
    }

    /// Pixel format.
    pub const fn format(&self) -> PixelFormat {
        self.format
    }

    /// Bytes from one row to the next.
    pub const fn stride(&self) -> usize {
        self.stride
    }

    /// The bytes.
    pub const fn data(&self) -> &'a [u8] {
        self.data
    }
}
