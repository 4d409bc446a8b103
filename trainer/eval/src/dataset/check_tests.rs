use std::path::Path;

use proptest::prelude::*;

use super::*;
use crate::dataset::scan;
use crate::dataset::testing::{pictures, pictures_of, text};

fn look_at(kind: &str, dir: &Path, options: CheckOptions) -> CheckReport {
    check(&scan(&format!("{kind}:{}", dir.display())).unwrap(), options, &|_, _| {})
}

fn write(root: &Path) {
    let a = root.join("a");
    pictures(&a.join("visible"), &["1.jpg", "2.jpg", "3.jpg"]);
    pictures_of(&a.join("infrared"), &["1.jpg", "2.jpg", "3.jpg", "4.jpg"], (3, 2));
    text(a.join("visible.txt"), "1,1,2,2\n0,0,0,0\n40,40,2,2\n");
    text(a.join("infrared.txt"), "1,1,2,2\n1,1,1,1\n1,1,1,1\n1,1,1,1\n");
    let b = root.join("b");
    pictures(&b.join("infrared"), &["1.png"]);
    text(b.join("infrared.txt"), "1,1,2,2\n");
}

#[test]
fn counts_without_decoding() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    let report = look_at("sequences", dir.path(), CheckOptions::default());
    assert!(report.is_sound(), "{:?}", report.findings);
    assert_eq!((report.sequences, report.frames, report.targets), (2, 4, 2));
    assert_eq!(report.modalities.get("rgb+thermal"), Some(&1));
    assert_eq!(report.modalities.get("thermal"), Some(&1));
    assert_eq!(report.annotation["rgb"], Annotated { annotated: 3, absent: 1 });
    assert_eq!(report.annotation["thermal"], Annotated { annotated: 4, absent: 0 });
    assert_eq!((report.with_absence, report.headers, report.decoded), (1, 7, 0));
    let sizes: Vec<_> =
        report.resolutions.iter().map(|r| (r.modality, r.width, r.height, r.pictures)).collect();
    assert_eq!(sizes, [("rgb", 6, 4, 3), ("thermal", 3, 2, 3), ("thermal", 6, 4, 1)]);
    let quirks: Vec<&str> = report.quirks().map(|f| f.what.as_str()).collect();
    assert!(quirks.iter().any(|q| q.contains("3 and 4 pictures")), "{quirks:?}");
    assert!(quirks.iter().any(|q| q.contains("1 rgb boxes wholly outside")), "{quirks:?}");
}

#[test]
fn finds_everything_that_is_broken_in_one_go() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    let at = |name: &str| dir.path().join(name);
    std::fs::write(at("a/visible/2.jpg"), "no picture").unwrap();
    let whole = std::fs::read(at("a/infrared/3.jpg")).unwrap();
    std::fs::write(at("a/infrared/3.jpg"), &whole[..whole.len() - 20]).unwrap();
    pictures_of(&at("a/visible"), &["3.jpg"], (8, 8));
    text(at("b/infrared.txt"), "1,1,2,2\n1,1,2,2\n");
    pictures(&at("c/visible"), &["1.jpg"]);
    text(at("c/visible.txt"), "1,1,2\n");
    let report = look_at("sequences", dir.path(), CheckOptions::default());
    let broken: Vec<&str> = report.broken().map(|f| f.what.as_str()).collect();
    assert_eq!(broken.len(), 5, "{broken:?}");
    for want in [
        "c/visible.txt, line 1",
        "2 boxes for 1 frames",
        "2.jpg: not a JPEG",
        "3.jpg: the file is cut off",
        "several sizes: 1 of 6 x 4, 1 of 8 x 8",
    ] {
        assert!(broken.iter().any(|b| b.contains(want)), "{want}: {broken:?}");
    }
    assert!(!report.is_sound() && report.unreadable == 1);
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["findings"][0]["severity"], "broken");

    // The same on any number of threads.
    let alone = look_at("sequences", dir.path(), CheckOptions { threads: 1, decode: Decode::None });
    assert_eq!(serde_json::to_value(&alone).unwrap(), json);
}

#[test]
fn many_broken_pictures_are_counted() {
    let dir = tempfile::tempdir().unwrap();
    let names: Vec<String> = (0..600).map(|i| format!("{i}.png")).collect();
    for name in &names {
        text(dir.path().join("s/infrared").join(name), "x");
    }
    text(dir.path().join("s/infrared.txt"), &"1,1,2,2\n".repeat(600));
    let report = look_at("sequences", dir.path(), CheckOptions::default());
    let broken: Vec<&str> = report.broken().map(|f| f.what.as_str()).collect();
    assert_eq!(broken.len(), LISTED + 1, "{broken:?}");
    assert!(broken[LISTED].contains("595 more broken"), "{broken:?}");
}

#[test]
fn decoding_finds_what_headers_hide() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    // A PNG with a damaged body: header and end marker are fine.
    let path = dir.path().join("b/infrared/1.png");
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() - 20;
    bytes[middle] ^= 0xFF;
    std::fs::write(&path, bytes).unwrap();
    assert!(look_at("sequences", dir.path(), CheckOptions::default()).is_sound());
    let decode = Decode::Some(2);
    let report = look_at("sequences", dir.path(), CheckOptions { decode, threads: 2 });
    assert_eq!((report.decoded, report.broken().count()), (5, 1), "{:?}", report.findings);
    let report = look_at("sequences", dir.path(), CheckOptions { decode: Decode::All, threads: 2 });
    assert_eq!(report.decoded, 7);
}

#[test]
fn evenly_spread_frames() {
    for (k, n, want) in [(2, 10, vec![0, 5]), (3, 10, vec![0, 3, 6]), (9, 3, vec![0, 1, 2])] {
        let taken: Vec<usize> = (0..n).filter(|i| Decode::Some(k).takes(*i, n)).collect();
        assert_eq!(taken, want, "{k} of {n}");
    }
    assert!(!Decode::Some(0).takes(0, 5) && Decode::All.takes(4, 5));
}

/// A one-frame dataset of every kind, and its annotation file.
const FILES: [(&str, &str, &[&str]); 10] = [
    ("sequences", "s/visible.txt", &["s/visible/1.png"]),
    ("lasher", "s/init.txt", &["s/visible/1.png", "s/infrared/1.png"]),
    ("rgbt234", "s/init.txt", &["s/visible/1.png", "s/infrared/1.png"]),
    ("gtot", "s/init.txt", &["s/v/1.png", "s/i/1.png"]),
    ("antiuav", "s/infrared.json", &["s/infrared/1.png"]),
    ("otb", "s/groundtruth_rect.txt", &["s/img/1.png"]),
    ("got10k", "s/groundtruth.txt", &["s/1.png"]),
    ("stills", "index.json", &[]),
    ("pairs", "index.json", &[]),
    ("coco", "all.json", &[]),
];

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn no_kind_panics_on_what_an_annotation_file_holds(
        bytes in prop_oneof![
            proptest::collection::vec(any::<u8>(), 0..100),
            "[0-9,. \\n-]{0,60}".prop_map(String::into_bytes),
            "[\\[\\]{}\":,0-9a-z ]{0,60}".prop_map(String::into_bytes),
        ],
    ) {
        for (kind, file, frames) in FILES {
            let dir = tempfile::tempdir().unwrap();
            for frame in frames {
                let path = dir.path().join(frame);
                pictures(path.parent().unwrap(), &["1.png"]);
            }
            let file = dir.path().join(file);
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(&file, &bytes).unwrap();
            let options = CheckOptions { threads: 1, decode: Decode::All };
            match scan(&format!("{kind}:{}", dir.path().display())) {
                Ok(found) => {
                    let report = check(&found, options, &|_, _| {});
                    prop_assert!(report.sequences > 0 || !report.is_sound());
                }
                // A file that is wrong as a whole is named.
                Err(e) => prop_assert!(e.to_string().contains(&*dir.path().to_string_lossy())),
            }
        }
    }
}

#[test]
fn the_shared_material_is_sound() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    if !dir.exists() {
        println!("skipped: {} is not there", dir.display());
        return;
    }
    for (kind, folder, sequences, frames) in
        [("sequences", "sequences", 36, None), ("pairs", "pairs", 270, Some(270))]
    {
        let report = look_at(kind, &dir.join(folder), CheckOptions::default());
        let broken: Vec<_> = report.broken().collect();
        assert!(broken.is_empty(), "{broken:?}");
        assert_eq!(report.sequences, sequences);
        assert!(frames.is_none_or(|n| n == report.frames));
    }
}
