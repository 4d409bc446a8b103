//! V4L2 cameras (feature `camera`).
//!
//! Devices, formats, frame rates and controls come from the crate `v4l`. Its streams are not used:
//! after a timeout they fail for good, and dropping one may panic. [`sys`] has a queue of its own on
//! the same file descriptor; all `unsafe` of the program is there.
//!
//! 1. [`open`]: a device becomes a [`Stream`], on a thread of its own.
//! 2. [`Stream`]: the newest picture, read where the driver put it.
//! 3. [`CameraSource`]: restarts and waits for the device to come back.

mod format;
mod open;
mod source;
mod stream;
#[allow(unsafe_code)]
mod sys;

pub use format::{Encoding, FORMATS};
pub use open::{OpenError, open};
pub use source::CameraSource;
pub use stream::Stream;
