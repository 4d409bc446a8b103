//! RGBT234, RGBT210 and GTOT: pure test sets of registered pairs.
//!
//! ```text
//! RGBT234   <name>/visible/00159v.jpg  <name>/infrared/00157i.jpg   numbers of a pair may differ
//!           <name>/visible.txt, infrared.txt                        x,y,w,h, one file per sensor
//! RGBT210   the same pictures          <name>/init.txt              x,y,w,h for both sensors
//! GTOT      <name>/v/00001v.png        <name>/i/00001i.png          names of many kinds, some bmp
//!           <name>/groundTruth_v.txt, groundTruth_i.txt             corners x1 y1 x2 y2, spaces
//!           <name>/init.txt                                         x y w h, tabs (fallback)
//! all       attr_txt/SequencesName.txt, attr_txt/<CODE>.txt         one flag per sequence
//! ```
//! RGBT234 has no absent frames (occluded targets keep an estimated box), RGBT210 and GTOT hardly
//! any.

use std::collections::HashMap;
use std::path::Path;

use super::clip::ClipSequence;
use super::layout::{Jobs, Layout, Side};
use super::text::{read_flags, read_names};
use super::tree::{Listing, find_sequences, locate, name_of};
use super::{DatasetError, Split};
use crate::boxes::Layout as BoxLayout;

const XYWH: BoxLayout = BoxLayout::Xywh;
const CORNERS: BoxLayout = BoxLayout::GTOT;

const RGBT234: Layout = Layout {
    rgb: Side { folders: &["visible"], files: &[("visible.txt", XYWH), ("init.txt", XYWH)] },
    thermal: Side { folders: &["infrared"], files: &[("infrared.txt", XYWH), ("init.txt", XYWH)] },
    both: true,
    what: "visible/ nor infrared/",
};

const RGBT210: Layout = Layout {
    rgb: Side { folders: &["visible"], files: &[("init.txt", XYWH), ("visible.txt", XYWH)] },
    thermal: Side { folders: &["infrared"], files: &[("init.txt", XYWH), ("infrared.txt", XYWH)] },
    both: true,
    what: "visible/ nor infrared/",
};

const GTOT: Layout = Layout {
    rgb: Side { folders: &["v"], files: &[("groundTruth_v.txt", CORNERS), ("init.txt", XYWH)] },
    thermal: Side { folders: &["i"], files: &[("groundTruth_i.txt", CORNERS), ("init.txt", XYWH)] },
    both: true,
    what: "v/ nor i/",
};

pub(crate) fn rgbt234(root: &Path, split: Split) -> Result<Jobs, DatasetError> {
    jobs(root, split, "RGBT234", &RGBT234, "visible/ and infrared/")
}

pub(crate) fn rgbt210(root: &Path, split: Split) -> Result<Jobs, DatasetError> {
    jobs(root, split, "RGBT210", &RGBT210, "visible/ and infrared/")
}

pub(crate) fn gtot(root: &Path, split: Split) -> Result<Jobs, DatasetError> {
    jobs(root, split, "GTOT", &GTOT, "v/ and i/")
}

fn jobs(
    root: &Path,
    split: Split,
    name: &str,
    layout: &'static Layout,
    what: &str,
) -> Result<Jobs, DatasetError> {
    if matches!(split, Split::Train | Split::Val) {
        return Err(DatasetError::Format {
            path: root.to_owned(),
            line: None,
            reason: format!("split '{split}': {name} is a test set; ask for 'test' or 'all'"),
        });
    }
    let dirs = find_sequences(root, what, &|l| layout.is_sequence(l))?;
    let mut problems = Vec::new();
    let attributes = match locate(root, &["attr_txt"]).filter(|d| d.is_dir()) {
        Some(folder) => read_attributes(&folder, &mut problems)?,
        None => HashMap::new(),
    };
    let read = move |dir: &Path, id: String| {
        let mut parts = layout.read(dir, id)?;
        parts.attributes = attributes.get(&name_of(dir)).cloned().unwrap_or_default();
        ClipSequence::build(parts, layout.what)
    };
    let mut found = Jobs::clips(root, dirs, read);
    found.problems = problems;
    Ok(found)
}

/// Attributes by sequence: every file but the list of names holds one flag per name.
fn read_attributes(
    folder: &Path,
    problems: &mut Vec<DatasetError>,
) -> Result<HashMap<String, Vec<String>>, DatasetError> {
    const NAMES: &str = "SequencesName.txt";
    let listing = Listing::of(folder)?;
    let Some(list) = listing.find_file(&[NAMES]) else {
        problems.push(DatasetError::Format {
            path: folder.to_owned(),
            line: None,
            reason: format!("no {NAMES}, so nobody knows which sequence a flag belongs to"),
        });
        return Ok(HashMap::new());
    };
    let names: Vec<String> = read_names(&list)?.into_iter().map(|(_, name)| name).collect();
    let mut attributes: HashMap<String, Vec<String>> = HashMap::new();
    for (file, path) in listing.texts() {
        let Some(code) = file.strip_suffix(".txt").or(file.strip_suffix(".TXT")) else { continue };
        if path == list {
            continue;
        }
        match read_flags(&path) {
            Ok(flags) if flags.len() == names.len() => {
                for (name, _) in names.iter().zip(flags).filter(|(_, on)| *on) {
                    attributes.entry(name.clone()).or_default().push(code.to_owned());
                }
            }
            Ok(flags) => problems.push(DatasetError::Format {
                path: path.clone(),
                line: None,
                reason: format!("{} flags for the {} names in {NAMES}", flags.len(), names.len()),
            }),
            Err(e) => problems.push(e),
        }
    }
    Ok(attributes)
}

#[cfg(test)]
#[path = "rgbt_tests.rs"]
mod tests;
