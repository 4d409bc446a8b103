//! `tsda data-write`: any dataset as plain folders, so that other programs can be run on the very
//! same frames; above all clips made from stills, which exist nowhere else.

use super::progress_bar;
use crate::error::{EXIT_OK, HostError};
use crate::output::{PartDir, write_file};
use clap::Args;
use serde_json::json;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use tsda_eval::dataset::{DatasetError, Picture, Sequence, scan_with};
use tsda_eval::pseudo::PseudoOptions;
use tsda_runtime::Modality;

/// Arguments of `tsda data-write`.
#[derive(Debug, Args)]
pub struct DataWriteArgs {
    /// What to write (`tsda data-check --help` lists the kinds)
    #[arg(value_name = "KIND[/OPTION]:PATH[@SPLIT]")]
    pub dataset: String,
    /// Folder for index.json and a folder per target with visible/, infrared/, visible.txt and
    /// infrared.txt, made if needed. Targets that stand there already are left as they are
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Frames per clip made from stills
    #[arg(long, value_name = "N", default_value_t = PseudoOptions::default().frames)]
    pub pseudo_frames: usize,
}

const SIDES: [(Modality, &str); 2] = [(Modality::Rgb, "visible"), (Modality::Thermal, "infrared")];

pub(super) fn run(args: &DataWriteArgs) -> Result<u8, HostError> {
    let clips = PseudoOptions { frames: args.pseudo_frames, ..PseudoOptions::default() };
    let scan = scan_with(&args.dataset, clips).map_err(|e| argument(e.to_string()))?;
    // A table that lacks what could not be read would pass for the whole.
    if let Some(first) = scan.broken.first() {
        return Err(argument(format!("{} sequences cannot be read: {first}", scan.broken.len())));
    }
    make(&args.out)?;
    let total: usize = scan.sequences.iter().map(|s| s.targets()).sum();
    let bar = progress_bar(Some(total), "targets");
    let mut index = Vec::with_capacity(total);
    for sequence in &scan.sequences {
        for target in 0..sequence.targets() {
            let name = match sequence.targets() {
                1 => sequence.id().to_owned(),
                _ => format!("{}-{target}", sequence.id()),
            };
            // Ids may hold folders of their own.
            let name = name.replace(['/', '\\'], "-");
            let folder = args.out.join(&name);
            if !folder.exists() {
                write_target(sequence.as_ref(), target, &folder)?;
            }
            index.push(json!({"name": name, "path": name, "frames": sequence.frames()}));
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    let text =
        serde_json::to_string_pretty(&json!({"source": args.dataset, "sequences": index}))
            .map_err(|e| HostError::Encode { path: "index.json".into(), reason: e.to_string() })?;
    write_file(&args.out.join("index.json"), text.as_bytes())?;
    println!("{}: {total} targets", args.out.display());
    Ok(EXIT_OK)
}

/// One target in a folder, which appears when it is whole.
fn write_target(sequence: &dyn Sequence, target: usize, folder: &Path) -> Result<(), HostError> {
    let part = PartDir::create(folder)?;
    for (modality, name) in SIDES {
        if !sequence.modalities().contains(&modality) {
            continue;
        }
        let pictures = part.place(name);
        make(&pictures)?;
        let mut boxes = String::new();
        for frame in 0..sequence.frames() {
            let unusable = |e: DatasetError| argument(e.to_string());
            let picture = sequence.picture(frame, modality).map_err(unusable)?;
            write_png(&picture, &pictures.join(format!("{:06}.png", frame + 1)))?;
            // Writing into a String cannot fail.
            let _ = match sequence.truth(target, frame, modality) {
                Some(b) => writeln!(boxes, "{:.3},{:.3},{:.3},{:.3}", b.x, b.y, b.w, b.h),
                None => writeln!(boxes, "0,0,0,0"),
            };
        }
        write_file(&part.place(&format!("{name}.txt")), boxes.as_bytes())?;
    }
    part.commit()
}

fn make(folder: &Path) -> Result<(), HostError> {
    let failed = |source| HostError::Create { path: folder.to_path_buf(), source };
    std::fs::create_dir_all(folder).map_err(failed)
}

fn argument(reason: String) -> HostError {
    HostError::Argument { what: "data-write".into(), reason }
}

fn write_png(picture: &Picture, path: &Path) -> Result<(), HostError> {
    let colour = match picture.channels {
        1 => image::ExtendedColorType::L8,
        _ => image::ExtendedColorType::Rgb8,
    };
    let (w, h) = (picture.width as u32, picture.height as u32);
    image::save_buffer(path, &picture.data, w, h, colour)
        .map_err(|e| HostError::Encode { path: path.into(), reason: e.to_string() })
}
