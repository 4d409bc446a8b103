use tsda_runtime::{BBox, Modality};

use crate::dataset::Severity;
use crate::dataset::testing::{open, pictures, text};

#[test]
fn otb_counts_pixels_from_one_and_separates_as_it_likes() {
    let dir = tempfile::tempdir().unwrap();
    for (name, truth) in [
        ("Crossing", "11,21,5,6\n12,21,5,6\n"),
        ("Dog1", "11\t21\t5\t6\r\n12\t21\t5\t6\r\n"),
        ("MotorRolling", "11 21 5 6\n12 21 5 6"),
    ] {
        pictures(&dir.path().join(name).join("img"), &["0001.jpg", "0002.jpg"]);
        text(dir.path().join(name).join("groundtruth_rect.txt"), truth);
    }
    let set = open("otb", dir.path(), "").unwrap();
    assert_eq!(set.sequences.len(), 3);
    for s in &set.sequences {
        assert_eq!(s.truth(0, 0, Modality::Rgb), Some(BBox::new(10.0, 20.0, 5.0, 6.0)));
        assert!(s.modalities() == [Modality::Rgb] && s.notes().is_empty());
    }
    let set = open("otb/thermal/zero-based", dir.path(), "").unwrap();
    let first = set.sequences[0].truth(0, 0, Modality::Thermal);
    assert_eq!(first, Some(BBox::new(11.0, 21.0, 5.0, 6.0)));
}

#[test]
fn otb_two_targets_and_late_starts() {
    let dir = tempfile::tempdir().unwrap();
    let jogging = dir.path().join("Jogging");
    pictures(&jogging.join("img"), &["0001.jpg", "0002.jpg"]);
    text(jogging.join("groundtruth_rect.1.txt"), "1,1,5,6\n2,1,5,6\n");
    text(jogging.join("groundtruth_rect.2.txt"), "31,1,5,6\n0,0,0,0\n");
    let david = dir.path().join("David");
    pictures(&david.join("img"), &["0298.jpg", "0299.jpg", "0300.jpg", "0301.jpg"]);
    text(david.join("groundtruth_rect.txt"), "1,1,5,6\n2,1,5,6\n");
    let diving = dir.path().join("Diving");
    pictures(&diving.join("img"), &["0001.jpg", "0002.jpg", "0003.jpg"]);
    text(diving.join("groundtruth_rect.txt"), "1,1,5,6\n2,1,5,6\n");
    let human = dir.path().join("Human3");
    pictures(&human.join("img"), &["0001.jpg", "0002.jpg", "0003.jpg"]);
    text(human.join("groundtruth_rect.txt"), "1,1,5,6\n2,1,5,6\n");
    let set = open("otb", dir.path(), "").unwrap();
    let by = |id: &str| set.sequences.iter().find(|s| s.id() == id).unwrap();
    let s = by("Jogging");
    assert_eq!((s.targets(), s.truth(1, 0, Modality::Rgb).unwrap().x), (2, 30.0));
    assert!(s.absent(1, 1, Modality::Rgb) && !s.absent(0, 1, Modality::Rgb));
    assert_eq!(s.truth_row(1, 1, Modality::Rgb), Some(BBox::default()));
    assert_eq!(s.truth(2, 0, Modality::Rgb), None);
    let s = by("David");
    assert_eq!(s.frames(), 2);
    assert!(s.picture_path(0, Modality::Rgb).unwrap().ends_with("0300.jpg"));
    assert!(s.notes()[0].text.contains("from picture 3 of 4"), "{:?}", s.notes());
    assert_eq!(by("Diving").frames(), 2);
    // Not one of the known ones: its last frame has no box, and that is a defect.
    let s = by("Human3");
    assert!(!s.annotated(0, 2, Modality::Rgb) && s.notes()[0].severity == Severity::Broken);
}

#[test]
fn got10k_follows_its_labels_and_its_list() {
    let dir = tempfile::tempdir().unwrap();
    let val = dir.path().join("val");
    for name in ["GOT-10k_Val_000001", "GOT-10k_Val_000002"] {
        let own = val.join(name);
        pictures(&own, &["00000001.jpg", "00000002.jpg", "00000003.jpg", "00000004.jpg"]);
        text(own.join("groundtruth.txt"), "1.5,2.0,3.0,4.0\n".repeat(4).as_str());
        text(own.join("absence.label"), "0\n1\n0\n0\n");
        text(own.join("cover.label"), "8\n0\n4\n0\n");
        text(own.join("cut_by_image.label"), "0\n0\n1\n0\n");
        text(own.join("meta_info.ini"), "[METAINFO]\nurl: x\n");
    }
    text(val.join("list.txt"), "GOT-10k_Val_000002\nGOT-10k_Val_000001\n");
    let test = dir.path().join("test/GOT-10k_Test_000001");
    pictures(&test, &["00000001.jpg", "00000002.jpg"]);
    text(test.join("groundtruth.txt"), "1.5,2.0,3.0,4.0");

    let set = open("got10k", dir.path(), "@val").unwrap();
    let s = &set.sequences[0];
    assert_eq!(s.id(), "GOT-10k_Val_000002");
    assert_eq!(s.truth(0, 0, Modality::Rgb), Some(BBox::new(1.5, 2.0, 3.0, 4.0)));
    let absent: Vec<bool> = (0..4).map(|f| s.absent(0, f, Modality::Rgb)).collect();
    assert_eq!(absent, [false, true, false, true]);
    assert_eq!(s.visibility(0, 2, Modality::Rgb), Some(0.5));
    assert_eq!((s.frame_attributes(2), s.frame_attributes(0).len()), (vec!["cut_by_image"], 0));
    let set = open("got10k", dir.path(), "@test").unwrap();
    let s = &set.sequences[0];
    assert!(s.notes().is_empty() && s.annotated(0, 0, Modality::Rgb));
    assert!(!s.annotated(0, 1, Modality::Rgb) && !s.absent(0, 1, Modality::Rgb));

    text(val.join("GOT-10k_Val_000001/cover.label"), "8\n");
    let set = open("got10k", dir.path(), "@val").unwrap();
    let notes = set.sequences[1].notes();
    assert!(notes[0].text.contains("1 entries for 4 boxes"), "{notes:?}");
    text(val.join("GOT-10k_Val_000001/absence.label"), "0\nno\n");
    let e = open("got10k", dir.path(), "@val").unwrap_err().to_string();
    assert!(e.contains("absence.label, line 2"), "{e}");
}
