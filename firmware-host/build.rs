//! With the feature `embed`: embeds `models/nano.tsda` when the repository has it; without it the
//! program asks for `--bundle`. With the feature `camera`: says what to install when libclang is missing.

use std::path::{Path, PathBuf};
use std::{env, fs, io};

fn main() -> io::Result<()> {
    if env::var_os("CARGO_FEATURE_CAMERA").is_some() && !has_libclang() {
        println!(
            "cargo::error=the feature `camera` reads the kernel's headers with libclang, which is not \
             found. Debian, Ubuntu, Jetson: apt-get install libclang1 linux-libc-dev; Fedora: dnf \
             install clang-libs kernel-headers; elsewhere set LIBCLANG_PATH to the folder of \
             libclang.so. Without cameras, build without `--features camera`"
        );
    }
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

/// Whether the libclang that bindgen looks for is likely to be found. `LIBCLANG_PATH`, `llvm-config`
/// and the linker's folders are what its loader tries.
fn has_libclang() -> bool {
    println!("cargo::rerun-if-env-changed=LIBCLANG_PATH");
    let holds = |folder: &Path| {
        fs::read_dir(folder).into_iter().flatten().flatten().any(|entry| {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            name.starts_with("libclang.so") || name.starts_with("libclang-") && name.contains(".so")
        })
    };
    if let Some(path) = env::var_os("LIBCLANG_PATH") {
        let path = PathBuf::from(path);
        return path.is_file() || holds(&path);
    }
    let mut folders: Vec<PathBuf> = [
        "/usr/lib",
        "/usr/lib64",
        "/usr/local/lib",
        "/usr/local/lib64",
        "/opt/homebrew/opt/llvm/lib",
    ]
    .map(PathBuf::from)
    .to_vec();
    for parent in ["/usr/lib", "/usr/lib64", "/usr/local"] {
        for entry in fs::read_dir(parent).into_iter().flatten().flatten() {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            if name.contains("-linux-gnu") {
                folders.push(entry.path());
            } else if name.starts_with("llvm") {
                folders.push(entry.path().join("lib"));
                folders.push(entry.path().join("lib64"));
            }
        }
    }
    let found = std::process::Command::new("llvm-config").arg("--libdir").output();
    if let Ok(output) = found {
        folders.push(PathBuf::from(String::from_utf8_lossy(&output.stdout).trim()));
    }
    folders.iter().any(|f| holds(f))
}
