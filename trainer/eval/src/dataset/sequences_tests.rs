use super::*;
use crate::dataset::open;
use crate::dataset::testing::pictures;
use tsda_runtime::{BBox, Modality};

/// Two tiers, LasHeR letters in the names, unequal counts, every separator quirk.
fn write(root: &Path) {
    let a = root.join("permissive/a");
    pictures(&a.join("visible"), &["v9.png", "v10.png", "v11.png"]);
    pictures(&a.join("infrared"), &["i2.png", "i3.png", "i10.png", "i11.png"]);
    std::fs::write(a.join("infrared/Thumbs.db"), b"x").unwrap();
    std::fs::write(a.join("visible.txt"), "1,2,3,4\r\n0,0,0,0\r\nNaN,NaN,NaN,NaN\r\n\r\n").unwrap();
    std::fs::write(a.join("infrared.txt"), "1\t2\t3\t4.5\n 5 6 7 8 \n1, 1, 1, 1,\n").unwrap();
    let b = root.join("restricted/b2");
    pictures(&b.join("infrared"), &["1.png"]);
    std::fs::write(b.join("visible.txt"), "\u{feff}0,0,2,2").unwrap();
    let c = root.join("restricted/b10");
    pictures(&c.join("visible"), &["1.png", "2.png"]);
    std::fs::write(c.join("visible.txt"), "0;0;2;2\n").unwrap();
}

#[test]
fn reads_every_folder_with_its_quirks() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    let set = SequencesDataset::open(dir.path(), &SequenceFilter::default()).unwrap();
    let ids: Vec<&str> = set.sequences().iter().map(Sequence::id).collect();
    assert_eq!(ids, ["a", "b2", "b10"]);

    let a = &set.sequences()[0];
    assert_eq!((a.frames(), a.targets(), a.modalities().len()), (3, 1, 2));
    assert_eq!(a.truth(0, 0, Modality::Rgb), Some(BBox::new(1.0, 2.0, 3.0, 4.0)));
    assert_eq!(a.truth(0, 1, Modality::Rgb), None);
    assert_eq!(a.truth(0, 2, Modality::Rgb), None);
    assert_eq!(a.truth(0, 0, Modality::Thermal), Some(BBox::new(1.0, 2.0, 3.0, 4.5)));
    assert_eq!(a.truth(0, 2, Modality::Thermal), Some(BBox::new(1.0, 1.0, 1.0, 1.0)));
    assert!(a.notes()[0].text.contains("3 and 4 pictures"), "{:?}", a.notes());
    assert!(a.path(2, Modality::Thermal).unwrap().ends_with("i10.png"));
    assert_eq!(a.picture(1, Modality::Thermal).unwrap().data, [10; 24]);
    assert_eq!(a.picture(1, Modality::Rgb).unwrap().channels, 3);
    assert!(matches!(a.picture(3, Modality::Thermal), Err(DatasetError::NoSuchFrame { .. })));

    // One sensor, and the box file of the other.
    let b = &set.sequences()[1];
    assert_eq!(b.modalities(), [Modality::Thermal]);
    assert_eq!(b.truth(0, 0, Modality::Thermal), Some(BBox::new(0.0, 0.0, 2.0, 2.0)));
    assert!(b.notes()[0].text.contains("no infrared.txt"));
    assert!(matches!(b.picture(0, Modality::Rgb), Err(DatasetError::NoSuchFrame { .. })));

    // Fewer boxes than pictures: the rest is not annotated.
    let c = &set.sequences()[2];
    assert_eq!((c.frames(), c.truth(0, 1, Modality::Rgb)), (2, None));
}

#[test]
fn filters_by_split_sensors_and_name() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    let filter = SequenceFilter { split: Split::Val, ..SequenceFilter::default() };
    let e = SequencesDataset::open(dir.path(), &filter).unwrap_err().to_string();
    assert!(e.contains("index.json"), "{e}");
    std::fs::write(
        dir.path().join("index.json"),
        r#"{"version": 1, "sequences": [
            {"name": "b2", "path": "restricted/b2", "split": "val", "fps": 30},
            {"name": "a", "path": "permissive/a", "split": "train"}]}"#,
    )
    .unwrap();
    let ids = |filter: &SequenceFilter| -> Vec<String> {
        let set = SequencesDataset::open(dir.path(), filter).unwrap();
        set.sequences().iter().map(|s| s.id().to_owned()).collect()
    };
    assert_eq!(ids(&filter), ["b2"]);
    assert_eq!(ids(&SequenceFilter::default()), ["b2", "a"]);
    assert_eq!(ids(&SequenceFilter { both_sensors: true, ..SequenceFilter::default() }), ["a"]);
    let named = SequenceFilter { name_contains: Some("b".into()), ..SequenceFilter::default() };
    assert_eq!(ids(&named), ["b2"]);
    let text = format!("sequences:{}@train", dir.path().display());
    assert_eq!(open(&text).unwrap().sequences[0].id(), "a");
    let e = open(&format!("sequences:{}@test", dir.path().display())).unwrap_err().to_string();
    assert!(e.contains("none of its 2 sequence folders"), "{e}");
}

#[test]
fn one_sequence_folder_is_a_dataset_of_one() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    let set = SequencesDataset::open(dir.path().join("permissive/a"), &SequenceFilter::default());
    assert_eq!(set.unwrap().sequences()[0].id(), "a");
}

#[test]
fn bad_box_files_name_file_and_line() {
    for (text, line, want) in [
        ("1,2,3,4\n1,2,3\n", Some(2), "found 3"),
        ("1,2,3,4,5\n", Some(1), "found 5"),
        ("1,2,3,4\n\n1,2,3,4\n", Some(2), "found 0"),
        ("1,2,x3,4\n", Some(1), "'x3' is not a number"),
        ("1,2,inf,4\n", Some(1), "not finite"),
        ("\r\n\n", None, "no boxes"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path());
        std::fs::write(dir.path().join("permissive/a/visible.txt"), text).unwrap();
        let e = SequencesDataset::open(dir.path(), &SequenceFilter::default()).unwrap_err();
        match &e {
            DatasetError::Format { path, line: l, reason } => {
                assert!(path.ends_with("visible.txt") && *l == line, "{e}");
                assert!(reason.contains(want), "{e}");
            }
            other => panic!("{other}"),
        }
    }
}

#[test]
fn folders_without_what_they_need_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let empty = dir.path().join("s");
    std::fs::create_dir_all(empty.join("visible")).unwrap();
    let e = SequencesDataset::open(&empty, &SequenceFilter::default()).unwrap_err().to_string();
    assert!(e.contains("visible") && e.contains("no pictures"), "{e}");
    pictures(&empty.join("visible"), &["1.png"]);
    let e = SequencesDataset::open(&empty, &SequenceFilter::default()).unwrap_err().to_string();
    assert!(e.contains("visible.txt"), "{e}");
    let e = ClipSequence::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("neither visible/ nor infrared/"), "{e}");
    std::fs::write(dir.path().join("index.json"), r#"{"sequences": [{"path": "t"}]}"#).unwrap();
    let e = SequencesDataset::open(dir.path(), &SequenceFilter::default()).unwrap_err().to_string();
    assert!(e.contains("sequences[0]") && e.contains("index.json"), "{e}");
}

#[test]
fn opens_the_shared_sequences() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/sequences");
    if !dir.exists() {
        println!("skipped: {} is not there", dir.display());
        return;
    }
    let val = SequenceFilter { split: Split::Val, both_sensors: true, name_contains: None };
    let set = SequencesDataset::open(&dir, &val).unwrap();
    assert!(!set.sequences().is_empty());
    for s in set.sequences() {
        assert!(s.truth(0, 0, Modality::Rgb).is_some(), "{}", s.id());
        s.picture(s.frames() - 1, Modality::Thermal).unwrap();
    }
}
