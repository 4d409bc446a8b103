//! TraX, the protocol the VOT toolkit talks to trackers with: this side is the tracker, which the
//! protocol calls the server, although the toolkit starts it. How to use it: `docs/trax.md`.
//!
//! 1. [`Connection`]: standard input and output, descriptors, or a TCP port the client listens on.
//! 2. [`MessageReader`] and [`Message`]: lines with a prefix, escapes, properties; noise between
//!    messages is passed over.
//! 3. [`Region`] and [`ImageArg`]: what messages carry.
//! 4. [`SensorPolicy`]: which of two channels is tracked on.
//! 5. [`serve`]: the session, over any reader and writer and anything that can [`Follow`] a target.

mod base64;
mod error;
mod image;
mod message;
mod policy;
mod reader;
mod region;
mod session;
mod transport;

pub use base64::{
    Base64Error, decode as decode_base64, encode as encode_base64,
    encode_into as encode_base64_into,
};
pub use error::TraxError;
pub use image::{ImageArg, ImageError, MemoryFormat};
pub use message::{Kind, Message, MessageError, PREFIX};
pub use policy::{Channel, Channels, Chooser, SensorPolicy};
pub use reader::{MAX_MESSAGE, MessageReader};
pub use region::{Mask, Region, RegionError};
pub use session::{End, Follow, Options, Summary, Version, give_up, serve};
pub use transport::Connection;

#[cfg(test)]
mod tests;
