//! Unsafe code stays where it is meant to be: the workspace denies it, and a place that allows it is
//! one of those listed here, with what checks it.

use std::fs;
use std::path::{Path, PathBuf};

/// Files that say `allow(unsafe_code)`, relative to the crate, and what they cover.
const ALLOWED: [&str; 2] = [
    // The kernels folder: property tests against loops written out, Miri on the scalar ones.
    "src/engine/native/kernels/mod.rs",
    // The system folder: allocator, pool (property tests, Miri), clock, mapped files.
    "src/system/mod.rs",
];

fn sources(dir: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
}

#[test]
fn unsafe_code_is_in_the_listed_modules_only() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let workspace = fs::read_to_string(root.join("../Cargo.toml")).unwrap();
    assert!(workspace.contains("unsafe_code = \"deny\""), "the workspace no longer denies it");
    let own = fs::read_to_string(root.join("Cargo.toml")).unwrap();
    assert!(own.contains("[lints]\nworkspace = true"), "this crate left the workspace's lints");

    let mut files = Vec::new();
    sources(&root.join("src"), &mut files);
    let mut allowing = Vec::new();
    for file in files {
        let name = file.strip_prefix(root).unwrap().to_str().unwrap().replace('\\', "/");
        let text = fs::read_to_string(&file).unwrap();
        let code: Vec<&str> =
            text.lines().map(str::trim_start).filter(|l| !l.starts_with("//")).collect();
        let inside = ALLOWED.iter().any(|a| name.starts_with(a.trim_end_matches("mod.rs")));
        if code.iter().any(|l| l.contains("unsafe_code")) {
            allowing.push(name.clone());
        }
        let uses = code.iter().any(|l| l.contains("unsafe {") || l.contains("unsafe fn"));
        assert!(inside || !uses, "{name} has unsafe code outside of {ALLOWED:?}");
    }
    allowing.sort();
    println!("modules with unsafe code: {allowing:?}");
    assert_eq!(allowing, ALLOWED, "a module with unsafe code came or went: list what checks it");
}
