//! Pixel formats of V4L2 that the tracker reads.

use tsda_runtime::PixelFormat;

/// How a buffer is to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// As it is.
    Plain(PixelFormat),
    /// Decoded to RGB first.
    Jpeg,
}

const fn sixteen() -> Encoding {
    Encoding::Plain(PixelFormat::Y16 { low: 0, high: u16::MAX })
}

/// Code, reading, largest value of a 16-bit word; the best for tracking first.
pub const FORMATS: [(&str, Encoding, u16); 9] = [
    ("YUYV", Encoding::Plain(PixelFormat::Yuyv), u16::MAX),
    ("UYVY", Encoding::Plain(PixelFormat::Uyvy), u16::MAX),
    ("NV12", Encoding::Plain(PixelFormat::Nv12), u16::MAX),
    ("RGB3", Encoding::Plain(PixelFormat::Rgb8), u16::MAX),
    ("BGR3", Encoding::Plain(PixelFormat::Bgr8), u16::MAX),
    ("GREY", Encoding::Plain(PixelFormat::Gray8), u16::MAX),
    ("Y16 ", sixteen(), u16::MAX),
    ("Y10 ", sixteen(), 1023),
    ("MJPG", Encoding::Jpeg, u16::MAX),
];

/// Finds a format by its code, with or without the space at the end.
pub fn find(code: &str) -> Option<(&'static str, Encoding, u16)> {
    FORMATS.into_iter().find(|f| f.0 == code || f.0.trim_end() == code)
}

/// Bytes that a picture fills, when its rows are `stride` bytes apart.
pub fn needed(format: PixelFormat, width: usize, height: usize, stride: usize) -> usize {
    let rows = if format == PixelFormat::Nv12 { height + height / 2 } else { height };
    stride.saturating_mul(rows.saturating_sub(1)).saturating_add(format.row_bytes(width))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_found_with_and_without_their_space() {
        for code in ["Y16", "Y16 ", "Y10", "YUYV", "MJPG"] {
            assert!(find(code).is_some(), "{code}");
        }
        for code in ["", "Y", "yuyv", "H264", "Y16  "] {
            assert!(find(code).is_none(), "{code}");
        }
    }

    #[test]
    fn padding_after_the_last_row_is_not_needed() {
        assert_eq!(needed(PixelFormat::Yuyv, 640, 480, 1280), 640 * 480 * 2);
        assert_eq!(needed(PixelFormat::Gray8, 100, 3, 128), 2 * 128 + 100);
        assert_eq!(needed(PixelFormat::Nv12, 100, 4, 128), 5 * 128 + 100);
    }
}
