//! `tsda devices`: V4L2 cameras and the formats they offer.

use crate::error::{EXIT_OK, HostError};
use v4l::video::Capture as _;
use v4l::{Device, context};

pub(super) fn run() -> Result<u8, HostError> {
    let nodes = context::enum_devices();
    if nodes.is_empty() {
        println!("no V4L2 device found");
    }
    for node in nodes {
        println!("{} {}", node.path().display(), node.name().unwrap_or_default());
        match Device::with_path(node.path()).and_then(|d| d.enum_formats()) {
            Ok(formats) => {
                for format in formats {
                    println!("  {} {}", format.fourcc, format.description);
                }
            }
            Err(e) => println!("  cannot be opened: {e}"),
        }
    }
    Ok(EXIT_OK)
}
