//! `tsda data-write`: any dataset as plain folders, so that other programs can be run on the very
//! same frames; above all clips made from stills, which exist nowhere else.

use super::progress_bar;
use crate::error::{EXIT_OK, HostError};
use crate::output::{PartDir, write_file};
use clap::Args;
use serde_json::json;
use std::collections::HashMap;
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
    let targets: Vec<(&dyn Sequence, usize)> = scan
        .sequences
        .iter()
        .flat_map(|s| (0..s.targets()).map(move |target| (s.as_ref(), target)))
        .collect();
    let total = targets.len();
    let names = folder_names(&targets).map_err(argument)?;
    make(&args.out)?;
    let bar = progress_bar(Some(total), "targets");
    let mut index = Vec::with_capacity(total);
    for ((sequence, target), name) in targets.into_iter().zip(names) {
        let folder = args.out.join(&name);
        if !folder.exists() {
            write_target(sequence, target, &folder)?;
        }
        index.push(json!({"name": name, "path": name, "frames": sequence.frames()}));
        bar.inc(1);
    }
    bar.finish_and_clear();
    let text =
        serde_json::to_string_pretty(&json!({"source": args.dataset, "sequences": index}))
            .map_err(|e| HostError::Encode { path: "index.json".into(), reason: e.to_string() })?;
    write_file(&args.out.join("index.json"), text.as_bytes())?;
    println!("{}: {total} targets", args.out.display());
    Ok(EXIT_OK)
}

/// A folder's name for every target: its sequence's id, with a number where there are several. Fails
/// where two would have the same one.
fn folder_names(targets: &[(&dyn Sequence, usize)]) -> Result<Vec<String>, String> {
    let mut taken: HashMap<String, &str> = HashMap::new();
    let name = |&(sequence, target): &(&dyn Sequence, usize)| match sequence.targets() {
        1 => sequence.id().to_owned(),
        _ => format!("{}-{target}", sequence.id()),
    };
    let mut names = Vec::with_capacity(targets.len());
    for target in targets {
        // Ids may hold folders of their own.
        let name = name(target).replace(['/', '\\'], "-");
        let id = target.0.id();
        if let Some(other) = taken.insert(name.clone(), id) {
            return Err(format!(
                "{other} and {id} would both be written to the folder {name}; rename one of them in \
                 the dataset"
            ));
        }
        names.push(name);
    }
    Ok(names)
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

#[cfg(test)]
mod tests {
    use super::*;
    use tsda_runtime::BBox;

    /// A sequence of this id and number of targets.
    struct Named(&'static str, usize);

    impl Sequence for Named {
        fn id(&self) -> &str {
            self.0
        }

        fn frames(&self) -> usize {
            1
        }

        fn modalities(&self) -> &[Modality] {
            &[Modality::Rgb]
        }

        fn targets(&self) -> usize {
            self.1
        }

        fn truth(&self, _: usize, _: usize, _: Modality) -> Option<BBox> {
            None
        }

        fn picture(&self, _: usize, _: Modality) -> Result<Picture, DatasetError> {
            Ok(Picture { width: 1, height: 1, channels: 1, data: vec![0] })
        }
    }

    fn names(sequences: &[Named]) -> Result<Vec<String>, String> {
        let targets: Vec<(&dyn Sequence, usize)> =
            sequences.iter().flat_map(|s| (0..s.1).map(move |i| (s as &dyn Sequence, i))).collect();
        folder_names(&targets)
    }

    #[test]
    fn folders_are_named_after_ids_and_never_shared() {
        let fine = names(&[Named("day/car", 1), Named("night/car", 2), Named("empty", 0)]);
        assert_eq!(fine.unwrap(), ["day-car", "night-car-0", "night-car-1"]);
        for twins in [
            [Named("day/car", 1), Named("day-car", 1)],
            [Named("car", 2), Named("car-1", 1)],
            [Named(r"a\b", 1), Named("a/b", 1)],
        ] {
            let said = names(&twins).unwrap_err();
            assert!(said.contains(twins[0].0) && said.contains(twins[1].0), "{said}");
        }
    }
}
