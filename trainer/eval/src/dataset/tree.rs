//! Folders: listing, finding sequences, split lists.

use std::collections::{HashMap, HashSet};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use super::picture::is_picture;
use super::text::read_names;
use super::{DatasetError, Split, natural_cmp};

/// How deep below the root sequence folders are looked for: `<root>/<split>/<part>/<name>`.
const DEPTH: usize = 3;

/// What a folder holds, in natural order; hidden names are left out.
#[derive(Debug)]
pub(crate) struct Listing {
    dir: PathBuf,
    names: Vec<OsString>,
}

impl Listing {
    pub(crate) fn of(dir: &Path) -> Result<Self, DatasetError> {
        let io = |source| DatasetError::Io { path: dir.to_owned(), source };
        let mut names = Vec::new();
        for entry in std::fs::read_dir(dir).map_err(io)? {
            let name = entry.map_err(io)?.file_name();
            if !name.to_string_lossy().starts_with('.') {
                names.push(name);
            }
        }
        names.sort_by(|a, b| natural_cmp(&a.to_string_lossy(), &b.to_string_lossy()));
        Ok(Self { dir: dir.to_owned(), names })
    }

    pub(crate) fn dir(&self) -> &Path {
        &self.dir
    }

    fn paths(&self) -> impl Iterator<Item = PathBuf> + '_ {
        self.names.iter().map(|n| self.dir.join(n))
    }

    pub(crate) fn dirs(&self) -> impl Iterator<Item = PathBuf> + '_ {
        self.paths().filter(|p| p.is_dir())
    }

    pub(crate) fn texts(&self) -> impl Iterator<Item = (&str, PathBuf)> + '_ {
        self.names.iter().filter_map(|n| Some((n.to_str()?, self.dir.join(n))))
    }

    /// First of `names` that is there; whole names only, upper and lower case alike.
    pub(crate) fn find(&self, names: &[&str]) -> Option<PathBuf> {
        let of = |wanted: &&str| {
            let exact = self.names.iter().find(|n| n.to_str() == Some(*wanted));
            let any_case = || {
                self.names
                    .iter()
                    .find(|n| n.to_str().is_some_and(|n| n.eq_ignore_ascii_case(wanted)))
            };
            exact.or_else(any_case).map(|n| self.dir.join(n))
        };
        names.iter().find_map(of)
    }

    pub(crate) fn find_dir(&self, names: &[&str]) -> Option<PathBuf> {
        self.find(names).filter(|p| p.is_dir())
    }

    pub(crate) fn find_file(&self, names: &[&str]) -> Option<PathBuf> {
        self.find(names).filter(|p| p.is_file())
    }

    /// Names of the pictures in it.
    pub(crate) fn pictures(&self) -> Vec<Box<std::ffi::OsStr>> {
        let pictures = self.names.iter().filter(|n| is_picture(Path::new(n)));
        pictures.map(|n| n.clone().into_boxed_os_str()).collect()
    }

    /// Names of videos in it: frames that still have to be extracted.
    pub(crate) fn videos(&self) -> Vec<PathBuf> {
        let is_video = |p: &PathBuf| {
            p.extension().and_then(|e| e.to_str()).is_some_and(|e| {
                ["mp4", "avi", "mkv", "mov"].iter().any(|v| e.eq_ignore_ascii_case(v))
            })
        };
        self.paths().filter(is_video).collect()
    }
}

/// Folders below `root` (or `root` itself) for which `is_sequence` holds, in natural order. Below
/// such a folder nothing more is looked for.
pub(crate) fn find_sequences(
    root: &Path,
    what: &str,
    is_sequence: &dyn Fn(&Listing) -> bool,
) -> Result<Vec<PathBuf>, DatasetError> {
    let mut found = Vec::new();
    let listing = Listing::of(root)?;
    let videos = listing.videos().len();
    if is_sequence(&listing) {
        found.push(root.to_owned());
    } else {
        descend(&listing, DEPTH, is_sequence, &mut found)?;
    }
    if found.is_empty() {
        let hint = match videos {
            0 => String::new(),
            n => format!("; it holds {n} video files, whose frames must be extracted first"),
        };
        return Err(DatasetError::Format {
            path: root.to_owned(),
            line: None,
            reason: format!(
                "no sequence folder in it, up to {DEPTH} levels down; a sequence folder holds \
                 {what}{hint}"
            ),
        });
    }
    Ok(found)
}

fn descend(
    listing: &Listing,
    depth: usize,
    is_sequence: &dyn Fn(&Listing) -> bool,
    found: &mut Vec<PathBuf>,
) -> Result<(), DatasetError> {
    for dir in listing.dirs() {
        let inner = Listing::of(&dir)?;
        if is_sequence(&inner) {
            found.push(dir);
        } else if depth > 1 {
            descend(&inner, depth - 1, is_sequence, found)?;
        }
    }
    Ok(())
}

/// Last part of a path as text.
pub(crate) fn name_of(dir: &Path) -> String {
    match dir.file_name() {
        Some(name) => name.to_string_lossy().into_owned(),
        None => dir.display().to_string(),
    }
}

/// An id per folder: its name, or its path below `root` where a name stands twice (VTUAV numbers
/// its parts separately).
pub(crate) fn ids(root: &Path, dirs: &[PathBuf]) -> Vec<String> {
    let mut count: HashMap<String, usize> = HashMap::new();
    for dir in dirs {
        *count.entry(name_of(dir)).or_default() += 1;
    }
    let id = |dir: &PathBuf| {
        let name = name_of(dir);
        if count.get(&name) == Some(&1) {
            return name;
        }
        let below = dir.strip_prefix(root).unwrap_or(dir);
        let parts: Vec<_> = below.iter().map(|p| p.to_string_lossy()).collect();
        parts.join("/")
    };
    dirs.iter().map(id).collect()
}

/// The split a folder lies in by the names on its way: `train`, `TrainingSet`, `test_ST_001`, ..
/// The name of `root` itself counts too, so that a split folder can be opened on its own.
pub(crate) fn split_of(root: &Path, dir: &Path) -> Option<Split> {
    let below = dir.strip_prefix(root).unwrap_or(dir);
    let own = root.file_name().into_iter();
    // The sequence's own name says nothing: `train3` is a sequence of RGBT234.
    let above = below.parent().into_iter().flat_map(Path::iter);
    own.chain(above).rev().find_map(|part| {
        let part = part.to_string_lossy().to_ascii_lowercase();
        [("train", Split::Train), ("val", Split::Val), ("test", Split::Test)]
            .into_iter()
            .find_map(|(name, split)| part.starts_with(name).then_some(split))
    })
}

/// First of `names` in `root`, the folder above it, or one of the folders in it.
pub(crate) fn locate(root: &Path, names: &[&str]) -> Option<PathBuf> {
    let here = Listing::of(root).ok()?;
    if let Some(found) = here.find(names) {
        return Some(found);
    }
    if let Some(found) =
        root.parent().and_then(|up| Listing::of(up).ok()).and_then(|up| up.find(names))
    {
        return Some(found);
    }
    // Only folders that are no sequences by their looks: a benchmark has hundreds of those.
    let likely = here.dirs().filter(|d| {
        let name = name_of(d).to_ascii_lowercase();
        ["attr", "anno", "list", "split", "gt"].iter().any(|part| name.contains(part))
    });
    likely.filter_map(|d| Listing::of(&d).ok()).find_map(|l| l.find(names))
}

/// Keeps the folders of `dirs` that a list file names, in the order of the list.
///
/// Names without a folder come back as errors with file and line.
pub(crate) fn select(
    list: &Path,
    dirs: &[PathBuf],
) -> Result<(Vec<PathBuf>, Vec<DatasetError>), DatasetError> {
    let by_name: HashMap<String, &PathBuf> = dirs.iter().map(|d| (name_of(d), d)).collect();
    let (mut kept, mut missing) = (Vec::new(), Vec::new());
    let mut seen = HashSet::new();
    for (line, name) in read_names(list)? {
        match by_name.get(&name) {
            Some(&dir) => {
                if seen.insert(name) {
                    kept.push(dir.clone());
                }
            }
            None => missing.push(DatasetError::Format {
                path: list.to_owned(),
                line: Some(line),
                reason: format!("sequence '{name}' is listed but has no folder"),
            }),
        }
    }
    Ok((kept, missing))
}

/// Keeps the folders of `split` by the names on their way.
///
/// # Errors
/// When a split is asked for and no folder is in it.
pub(crate) fn in_split(
    root: &Path,
    dirs: Vec<PathBuf>,
    split: Split,
    how: &str,
) -> Result<Vec<PathBuf>, DatasetError> {
    if split == Split::All {
        return Ok(dirs);
    }
    let total = dirs.len();
    let kept: Vec<PathBuf> =
        dirs.into_iter().filter(|d| split_of(root, d) == Some(split)).collect();
    if kept.is_empty() {
        return Err(DatasetError::Format {
            path: root.to_owned(),
            line: None,
            reason: format!("none of its {total} sequence folders is in split '{split}': {how}"),
        });
    }
    Ok(kept)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splits_are_read_off_the_way_to_a_sequence() {
        let root = Path::new("data/set");
        for (dir, want) in [
            ("data/set/train/a", Some(Split::Train)),
            ("data/set/TrainingSet/trainingset/a", Some(Split::Train)),
            ("data/set/test_ST_001/a", Some(Split::Test)),
            ("data/set/VAL/a", Some(Split::Val)),
            ("data/set/train", None),
            ("data/set/other/train", None),
        ] {
            assert_eq!(split_of(root, Path::new(dir)), want, "{dir}");
        }
        assert_eq!(split_of(Path::new("x/test"), Path::new("x/test/a")), Some(Split::Test));
    }

    #[test]
    fn names_that_stand_twice_get_their_path() {
        let root = Path::new("r");
        let dirs = ["r/p1/a", "r/p2/a", "r/p2/b"].map(PathBuf::from);
        assert_eq!(ids(root, &dirs), ["p1/a", "p2/a", "b"]);
    }

    #[test]
    fn files_are_found_by_whole_names_in_any_case() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["visible-o.txt", "INIT.TXT", "clip.MP4", ".hidden.txt"] {
            std::fs::write(dir.path().join(name), "x").unwrap();
        }
        let listing = Listing::of(dir.path()).unwrap();
        assert_eq!(listing.find(&["visible.txt"]), None);
        assert_eq!(listing.find(&[".hidden.txt"]), None);
        assert!(listing.find_file(&["visible.txt", "init.txt"]).unwrap().ends_with("INIT.TXT"));
        assert_eq!(listing.videos().len(), 1);
    }
}
