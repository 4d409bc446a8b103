//! Tiny datasets for tests.

use std::path::Path;

/// Pictures of 6 x 4 pixels of grey 0, 10, 20, .. in `dir`, which is made.
pub(crate) fn pictures(dir: &Path, names: &[&str]) {
    pictures_of(dir, names, (6, 4));
}

/// Pictures of `size`.
pub(crate) fn pictures_of(dir: &Path, names: &[&str], (width, height): (u32, u32)) {
    std::fs::create_dir_all(dir).unwrap();
    for (i, name) in names.iter().enumerate() {
        image::GrayImage::from_pixel(width, height, image::Luma([10 * i as u8]))
            .save(dir.join(name))
            .unwrap();
    }
}

/// A text file, with the folders above it.
pub(crate) fn text(path: impl AsRef<Path>, text: &str) {
    let path = path.as_ref();
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, text).unwrap();
}

/// Opens `kind:dir[suffix]`.
pub(crate) fn open(
    kind: &str,
    dir: &Path,
    suffix: &str,
) -> Result<super::Dataset, super::OpenError> {
    super::open(&format!("{kind}:{}{suffix}", dir.display()))
}
