//! LasHeR: 1224 aligned RGB-thermal sequences, 19 attributes, one box for both sensors.
//!
//! ```text
//! <root>/[TrainingSet/trainingset/]<name>/visible/v000.jpg ..   a letter, then any first number
//!                                        /infrared/i000.jpg ..
//!                                        /visible.txt           x,y,w,h per frame
//!                                        /infrared.txt, /init.txt
//! <root>/testingsetList.txt, trainingsetList.txt                a name per line
//! <root>/AttriSeqsTxt/<name>.txt                                19 flags, see [`ATTRIBUTES`]
//! ```
//! The lists and the attribute folder may also lie beside the root or in a folder of annotations
//! below it. Without lists, the split is read off the folders on the way (`TestingSet/..`). Rows
//! without area mean that the target is absent. Sequences marked `FL` lack frames in one sensor:
//! they are cut to the shorter.

use std::path::Path;

use super::clip::ClipSequence;
use super::layout::{Jobs, Layout, Side};
use super::text::read_flags;
use super::tree::{find_sequences, in_split, locate, name_of, select};
use super::{DatasetError, Note, Split};
use crate::boxes::Layout as BoxLayout;

/// Attribute codes in the order of the flags: no, partial, total occlusion, hyaline occlusion,
/// motion blur, low and high illumination, abrupt illumination variation, low resolution,
/// deformation, background clutter, similar appearance, camera moving, thermal crossover, frame
/// lost, out of view, fast motion, scale variation, aspect ratio change.
pub const ATTRIBUTES: [&str; 19] = [
    "NO", "PO", "TO", "HO", "MB", "LI", "HI", "AIV", "LR", "DEF", "BC", "SA", "CM", "TC", "FL",
    "OV", "FM", "SV", "ARC",
];

const LAYOUT: Layout = Layout {
    rgb: Side {
        folders: &["visible"],
        files: &[
            ("visible.txt", BoxLayout::Xywh),
            ("init.txt", BoxLayout::Xywh),
            ("infrared.txt", BoxLayout::Xywh),
        ],
    },
    thermal: Side {
        folders: &["infrared"],
        files: &[
            ("infrared.txt", BoxLayout::Xywh),
            ("init.txt", BoxLayout::Xywh),
            ("visible.txt", BoxLayout::Xywh),
        ],
    },
    both: true,
    what: "visible/ nor infrared/",
};

/// Sequences of `split`.
pub(crate) fn jobs(root: &Path, split: Split) -> Result<Jobs, DatasetError> {
    let dirs = find_sequences(root, "visible/ and infrared/", &|l| LAYOUT.is_sequence(l))?;
    let list = match split {
        Split::Train => locate(root, &["trainingsetList.txt", "lashertrain.txt"]),
        Split::Test => locate(root, &["testingsetList.txt", "lashertest.txt"]),
        Split::Val | Split::All => None,
    };
    let (dirs, problems) = match list {
        Some(list) => select(&list, &dirs)?,
        None => {
            let how = "LasHeR has train and test; they come from trainingsetList.txt and \
                       testingsetList.txt, or from folders named TrainingSet and TestingSet";
            (in_split(root, dirs, split, how)?, Vec::new())
        }
    };
    let attributes = locate(root, &["AttriSeqsTxt"]).filter(|d| d.is_dir());
    let read = move |dir: &Path, id: String| {
        let mut parts = LAYOUT.read(dir, id)?;
        if let Some(folder) = &attributes {
            let file = folder.join(format!("{}.txt", name_of(dir)));
            match read_flags(&file) {
                Ok(flags) if flags.len() == ATTRIBUTES.len() => {
                    let named = ATTRIBUTES.iter().zip(flags).filter(|(_, on)| *on);
                    parts.attributes = named.map(|(name, _)| (*name).to_owned()).collect();
                }
                Ok(flags) => parts.notes.push(Note::broken(
                    &file,
                    format!("{} attribute flags: expected {}", flags.len(), ATTRIBUTES.len()),
                )),
                Err(e) => parts.notes.push(Note::broken(&file, e.to_string())),
            }
        }
        ClipSequence::build(parts, LAYOUT.what)
    };
    let mut found = Jobs::clips(root, dirs, read);
    found.problems = problems;
    Ok(found)
}

#[cfg(test)]
#[path = "lasher_tests.rs"]
mod tests;
