//! Cross-crate tests live in `tests/tests`; this library only says where things are.

use std::path::{Path, PathBuf};

/// Root of the workspace.
pub fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The model that ships in the repository.
pub fn shipped_bundle() -> PathBuf {
    workspace().join("models/nano.tsda")
}

/// Real material beside a developer's checkout; `None` on a user's machine.
pub fn shared(path: &str) -> Option<PathBuf> {
    let path = workspace().join("../shared").join(path);
    path.exists().then_some(path)
}
