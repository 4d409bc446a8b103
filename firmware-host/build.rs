//! With feature `embed`: embeds `models/nano.tsda` when the repository has it; without it the program asks for `--bundle`.

use std::path::PathBuf;
use std::{env, fs, io};

fn main() -> io::Result<()> {
    let missing = |name| io::Error::new(io::ErrorKind::NotFound, format!("{name} is not set"));
    let root = env::var_os("CARGO_MANIFEST_DIR").ok_or_else(|| missing("CARGO_MANIFEST_DIR"))?;
    let out = env::var_os("OUT_DIR").ok_or_else(|| missing("OUT_DIR"))?;
    let model = PathBuf::from(root).join("../models/nano.tsda");
    println!("cargo::rerun-if-changed=build.rs");
    // The folder is watched while there is no file, so that a new model is noticed.
    let watched = if model.is_file() { model.clone() } else { model.with_file_name("") };
    println!("cargo::rerun-if-changed={}", watched.display());
    let embed = env::var_os("CARGO_FEATURE_EMBED").is_some();
    let value = if embed && model.is_file() {
        format!("Some(include_bytes!({:?}))", model.canonicalize()?)
    } else {
        "None".to_owned()
    };
    fs::write(PathBuf::from(out).join("embedded.rs"), value)
}
