//! `tsda devices`: V4L2 cameras, their lasting names, formats and sizes.

use crate::camera::FORMATS;
use crate::error::{EXIT_OK, HostError};
use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use v4l::framesize::FrameSizeEnum;
use v4l::video::Capture as _;
use v4l::{Device, context};

pub(super) fn run() -> Result<u8, HostError> {
    let mut nodes: Vec<(usize, PathBuf, String)> = context::enum_devices()
        .iter()
        .map(|n| (n.index(), n.path().to_path_buf(), n.name().unwrap_or_default()))
        .collect();
    nodes.sort();
    if nodes.is_empty() {
        println!("no V4L2 device found");
    }
    let names = lasting_names();
    for (_, path, name) in nodes {
        println!("{} {}", path.display(), name.trim());
        for lasting in names.get(&path).into_iter().flatten() {
            println!("  {}", lasting.display());
        }
        if let Err(e) = formats(&path) {
            println!("  cannot be opened: {e}");
        }
    }
    Ok(EXIT_OK)
}

fn formats(path: &Path) -> io::Result<()> {
    let device = Device::with_path(path)?;
    for format in device.enum_formats()? {
        let code = format.fourcc.to_string();
        let read = FORMATS.iter().any(|f| f.0.trim_end() == code.trim_end());
        let sizes: Vec<String> = device
            .enum_framesizes(format.fourcc)
            .unwrap_or_default()
            .iter()
            .map(|s| match &s.size {
                FrameSizeEnum::Discrete(d) => format!("{}x{}", d.width, d.height),
                FrameSizeEnum::Stepwise(s) => {
                    format!("{}x{} to {}x{}", s.min_width, s.min_height, s.max_width, s.max_height)
                }
            })
            .collect();
        let note = if read { "" } else { ", not read by tsda" };
        println!("  {} {}{note}: {}", code.trim_end(), format.description, sizes.join(", "));
    }
    Ok(())
}

/// Names that stay the same from one plug to the next, by device node.
fn lasting_names() -> BTreeMap<PathBuf, Vec<PathBuf>> {
    let mut names: BTreeMap<PathBuf, Vec<PathBuf>> = BTreeMap::new();
    for folder in ["/dev/v4l/by-id", "/dev/v4l/by-path"] {
        for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
            if let Ok(node) = entry.path().canonicalize() {
                names.entry(node).or_default().push(entry.path());
            }
        }
    }
    names
}
