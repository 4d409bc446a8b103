//! Finding results: one tracker's folder, or everything `tsda eval --out` left behind.

use std::path::{Path, PathBuf};

use crate::dataset::DatasetError;
use crate::protocol::Protocol;

/// Levels searched for folders named after protocols.
const DEPTH: usize = 4;

/// A folder of results.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Run {
    /// The tracker's name.
    pub tracker: String,
    /// The protocol its folder is named after.
    pub protocol: Option<Protocol>,
    /// The folder.
    pub path: PathBuf,
}

/// Result folders in `path`: folders named after protocols (`rgb2t`, `switch_20`), each belonging
/// to the tracker its parent is named after; without such, `path` itself. A `name` replaces the
/// tracker's, where there is one tracker. Sorted by tracker, then protocol.
///
/// # Errors
/// When a folder cannot be listed, or `name` is given for several trackers.
pub fn find_runs(path: &Path, name: Option<&str>) -> Result<Vec<Run>, DatasetError> {
    let mut found = Vec::new();
    search(path, DEPTH, &mut found)?;
    let last = |path: &Path| {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned());
        name.unwrap_or_else(|| path.display().to_string())
    };
    if found.is_empty() {
        return Ok(vec![Run {
            tracker: name.map_or_else(|| last(path), str::to_owned),
            protocol: None,
            path: path.to_owned(),
        }]);
    }
    let mut runs: Vec<Run> = found
        .into_iter()
        .map(|(protocol, path)| Run {
            tracker: path.parent().map_or_else(String::new, last),
            protocol: Some(protocol),
            path,
        })
        .collect();
    runs.sort_by(|a, b| (&a.tracker, a.protocol).cmp(&(&b.tracker, b.protocol)));
    if let Some(name) = name {
        if let Some(other) = runs.iter().find(|r| r.tracker != runs[0].tracker) {
            return Err(DatasetError::Format {
                path: path.to_owned(),
                line: None,
                reason: format!(
                    "holds several trackers ({}, {}): one name does not fit them",
                    runs[0].tracker, other.tracker
                ),
            });
        }
        for run in &mut runs {
            name.clone_into(&mut run.tracker);
        }
    }
    Ok(runs)
}

fn search(
    path: &Path,
    depth: usize,
    found: &mut Vec<(Protocol, PathBuf)>,
) -> Result<(), DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    for entry in std::fs::read_dir(path).map_err(io)? {
        let entry = entry.map_err(io)?.path();
        if !entry.is_dir() {
            continue;
        }
        let protocol = entry.file_name().and_then(|n| n.to_str()).and_then(protocol_of);
        match protocol {
            Some(protocol) => found.push((protocol, entry)),
            None if depth > 1 => search(&entry, depth - 1, found)?,
            None => {}
        }
    }
    Ok(())
}

/// `switch_20` is how `switch:20` is written in file names.
fn protocol_of(folder: &str) -> Option<Protocol> {
    folder.parse().or_else(|_| folder.replacen('_', ":", 1).parse()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folders_of_tsda_eval_and_of_others() {
        let dir = tempfile::tempdir().unwrap();
        for p in ["out/boxes/b/rgb2t", "out/boxes/a/switch_20", "out/boxes/a/rgb2t", "plain/s1"] {
            std::fs::create_dir_all(dir.path().join(p)).unwrap();
        }
        let at = |p: &str| dir.path().join(p);
        let short = |runs: Vec<Run>| -> Vec<(String, Option<String>)> {
            runs.into_iter().map(|r| (r.tracker, r.protocol.map(|p| p.to_string()))).collect()
        };
        let some = |t: &str, p: &str| (t.to_owned(), Some(p.to_owned()));
        let all = [some("a", "rgb2t"), some("a", "switch:20"), some("b", "rgb2t")];
        assert_eq!(short(find_runs(&at("out"), None).unwrap()), all);
        assert_eq!(short(find_runs(&at("out/boxes/b"), Some("x")).unwrap()), [some("x", "rgb2t")]);
        assert_eq!(short(find_runs(&at("plain"), None).unwrap()), [("plain".to_owned(), None)]);
        assert_eq!(short(find_runs(&at("plain"), Some("y")).unwrap()), [("y".to_owned(), None)]);
        let e = find_runs(&at("out"), Some("x")).unwrap_err().to_string();
        assert!(e.contains("several trackers (a, b)"), "{e}");
        assert!(find_runs(&at("none"), None).is_err());
    }
}
