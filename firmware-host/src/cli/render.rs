//! `tsda render`: the clip the project draws itself, as sequences of the VOT toolkit.
//!
//! Every sequence has a `color` and an `ir` channel. The `color` channel of the cross-modal ones
//! changes its sensor by frame, so that experiments that know one channel only can be used as they
//! are.

use crate::error::{EXIT_OK, HostError};
use crate::host::plan::{RAW_FIRST, RAW_STEP};
use crate::output::write_file;
use crate::picture::Picture;
use crate::render::{Clip, ClipConfig};
use clap::Args;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageResult};
use std::fs::create_dir_all;
use std::path::{Path, PathBuf};
use tsda_runtime::Modality;

/// Arguments of `tsda render`.
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// Folder for the sequences, made if needed
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Frames per sequence
    #[arg(long, value_name = "N", default_value_t = 60, value_parser = clap::value_parser!(u16).range(2..))]
    pub frames: u16,
    /// Instead, one scene for cameras that are played: rgb.rgb3, rgb.mjpg, thermal.y16 (0.01 K) and
    /// truth.txt, frame after frame without headers
    #[arg(long)]
    pub raw: bool,
}

/// Name, seed, and the sensor in the `color` channel of a frame.
type Sequence = (&'static str, u32, fn(usize) -> Modality);

const SEQUENCES: [Sequence; 3] = [
    ("rgbt", 7, |_| Modality::Rgb),
    ("rgb2t", 11, |frame| if frame == 0 { Modality::Rgb } else { Modality::Thermal }),
    ("switch", 23, |frame| if frame / 15 % 2 == 0 { Modality::Rgb } else { Modality::Thermal }),
];

/// Frames between two starts of the toolkit's multistart experiment.
const ANCHORS: usize = 20;

pub(super) fn run(args: &RenderArgs) -> Result<u8, HostError> {
    let frames = usize::from(args.frames);
    if args.raw {
        return raw(&Clip::new(ClipConfig { frames, ..ClipConfig::default() }), &args.out);
    }
    for (name, seed, sensor) in SEQUENCES {
        // Night falls in the middle of the story; shorter sequences show its beginning, not all of it
        // faster.
        let frames_told = frames.max(ClipConfig::default().frames);
        let config = ClipConfig { seed, frames: frames_told, ..ClipConfig::default() };
        sequence(&Clip::new(config), frames, sensor, &args.out.join(name), name)?;
    }
    let names: String = SEQUENCES.iter().map(|(name, ..)| format!("{name}\n")).collect();
    write_file(&args.out.join("list.txt"), names.as_bytes())?;
    Ok(EXIT_OK)
}

/// What tests/v4l2 plays to the drivers.
fn raw(clip: &Clip, out: &Path) -> Result<u8, HostError> {
    create_dir_all(out).map_err(|source| HostError::Create { path: out.to_path_buf(), source })?;
    let (mut rgb, mut mjpg, mut thermal) = (Vec::new(), Vec::new(), Vec::new());
    let (mut truth, mut picture) = (String::new(), Picture::default());
    for frame in 0..clip.frames() {
        clip.render(frame, Modality::Rgb, &mut picture);
        rgb.extend_from_slice(&picture.data);
        let bytes = jpeg(&picture)
            .map_err(|e| HostError::Encode { path: out.join("rgb.mjpg"), reason: e.to_string() })?;
        mjpg.extend(bytes);
        clip.render(frame, Modality::Thermal, &mut picture);
        let words = picture.data.iter().map(|v| RAW_FIRST + RAW_STEP * u16::from(*v));
        thermal.extend(words.flat_map(u16::to_le_bytes));
        let b = clip.truth(frame);
        truth += &format!("{:.3},{:.3},{:.3},{:.3}\n", b.x, b.y, b.w, b.h);
    }
    write_file(&out.join("rgb.rgb3"), &rgb)?;
    write_file(&out.join("rgb.mjpg"), &mjpg)?;
    write_file(&out.join("thermal.y16"), &thermal)?;
    write_file(&out.join("truth.txt"), truth.as_bytes())?;
    Ok(EXIT_OK)
}

fn sequence(
    clip: &Clip,
    frames: usize,
    sensor: fn(usize) -> Modality,
    dir: &Path,
    name: &str,
) -> Result<(), HostError> {
    for channel in ["color", "ir"] {
        let path = dir.join(channel);
        create_dir_all(&path).map_err(|source| HostError::Create { path, source })?;
    }
    let (mut truth, mut anchors) = (String::new(), String::new());
    let mut picture = Picture::default();
    for frame in 0..frames {
        for (channel, modality) in [("color", sensor(frame)), ("ir", Modality::Thermal)] {
            clip.render(frame, modality, &mut picture);
            let path = dir.join(channel).join(format!("{:08}.jpg", frame + 1));
            let bytes = jpeg(&picture)
                .map_err(|e| HostError::Encode { path: path.clone(), reason: e.to_string() })?;
            write_file(&path, &bytes)?;
        }
        let b = clip.truth(frame);
        truth += &format!("{:.4},{:.4},{:.4},{:.4}\n", b.x, b.y, b.w, b.h);
        // Forward from frames of the first half, backward from the last.
        let anchor = match frame {
            last if last + 1 == frames => -1,
            f if f % ANCHORS == 0 && f <= frames / 2 => 1,
            _ => 0,
        };
        anchors += &format!("{anchor}\n");
    }
    let (width, height) = (picture.width, picture.height);
    let description = format!(
        "name={name}\nfps={}\nformat=default\nchannel.default=color\n\
         channels.color=color/%08d.jpg\nchannels.ir=ir/%08d.jpg\n\
         width={width}\nheight={height}\nlength={frames}\n",
        ClipConfig::FPS
    );
    write_file(&dir.join("groundtruth.txt"), truth.as_bytes())?;
    write_file(&dir.join("anchor.value"), anchors.as_bytes())?;
    write_file(&dir.join("sequence"), description.as_bytes())
}

fn jpeg(picture: &Picture) -> ImageResult<Vec<u8>> {
    let colour =
        if picture.channels == 1 { ExtendedColorType::L8 } else { ExtendedColorType::Rgb8 };
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 92).encode(
        &picture.data,
        picture.width as u32,
        picture.height as u32,
        colour,
    )?;
    Ok(bytes)
}
