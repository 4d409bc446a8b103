use std::path::Path;

use tsda_runtime::{BBox, Modality};

use crate::dataset::Severity;
use crate::dataset::testing::{open, pictures, text};

/// `n` pictures from `first` on, rows `x y w h` for every tenth; the thermal file ends blank.
fn write(dir: &Path, first: usize, n: usize, thermal: &str) {
    let names: Vec<String> = (first..first + n).map(|i| format!("{i:06}.jpg")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    pictures(&dir.join("rgb"), &names);
    pictures(&dir.join(thermal), &names);
    let rows: Vec<String> =
        (0..n.div_ceil(10)).map(|k| format!("{} 5 10 20", 100 + 10 * k)).collect();
    text(dir.join("rgb.txt"), &rows.join("\n"));
    text(dir.join("ir.txt"), &(rows.join("\n").replace(" 5 ", " 8 ") + "\n\n"));
}

#[test]
fn a_row_per_tenth_frame_and_separate_boxes() {
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("test_ST_001/animal_001"), 0, 21, "ir");
    let set = open("vtuav", dir.path(), "@test").unwrap();
    let s = &set.sequences[0];
    assert_eq!((s.id(), s.frames()), ("animal_001", 21));
    assert!(s.notes().is_empty(), "{:?}", s.notes());
    assert_eq!(s.truth(0, 10, Modality::Rgb), Some(BBox::new(110.0, 5.0, 10.0, 20.0)));
    assert_eq!(s.truth(0, 20, Modality::Thermal), Some(BBox::new(120.0, 8.0, 10.0, 20.0)));
    assert_eq!(s.truth(0, 5, Modality::Rgb), None);
    assert!(!s.annotated(0, 5, Modality::Rgb) && !s.absent(0, 5, Modality::Rgb));

    let set = open("vtuav/interpolated", dir.path(), "").unwrap();
    let s = &set.sequences[0];
    assert_eq!(s.truth(0, 15, Modality::Rgb), Some(BBox::new(115.0, 5.0, 10.0, 20.0)));
    assert!(s.annotated(0, 15, Modality::Rgb));
}

#[test]
fn names_repeat_in_parts_and_offsets_come_from_json() {
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("train_ST_004/pedestrian_042"), 3, 21, "ir_gray");
    write(&dir.path().join("train_ST_006/pedestrian_042"), 0, 11, "ir");
    write(&dir.path().join("train_ST_006/car_001"), 0, 11, "ir");
    let set = open("vtuav", dir.path(), "@train").unwrap();
    let ids: Vec<&str> = set.sequences.iter().map(|s| s.id()).collect();
    assert_eq!(ids, ["train_ST_004/pedestrian_042", "car_001", "train_ST_006/pedestrian_042"]);
    assert!(set.sequences[0].annotated(0, 10, Modality::Thermal));

    text(dir.path().join("init_frame.json"), r#"{"pedestrian_042": 5, "car_001": 0}"#);
    let set = open("vtuav", dir.path(), "@train").unwrap();
    let s = &set.sequences[0];
    // File numbers begin with 3: frame 2 is file 5.
    assert_eq!(s.truth(0, 2, Modality::Rgb).unwrap().x, 100.0);
    assert!(!s.annotated(0, 10, Modality::Rgb) && s.annotated(0, 12, Modality::Rgb));

    text(dir.path().join("ST_val_split.txt"), "car_001\n");
    assert_eq!(open("vtuav", dir.path(), "@val").unwrap().sequences.len(), 1);
    text(dir.path().join("init_frame.json"), "{\"car_001\": \n\"x\"}");
    let e = open("vtuav", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("init_frame.json, line 2"), "{e}");
}

#[test]
fn wrong_counts_and_gaps_are_noted() {
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("bus_001");
    write(&own, 0, 21, "ir");
    text(own.join("rgb.txt"), "1 2 3 4\n1 2 3 4\n");
    let set = open("vtuav", dir.path(), "").unwrap();
    let notes = set.sequences[0].notes();
    assert_eq!(notes.len(), 1, "{notes:?}");
    assert!(notes[0].severity == Severity::Broken && notes[0].path.ends_with("rgb.txt"));
    assert!(notes[0].text.contains("2 boxes for 21 frames: expected 3"), "{notes:?}");

    std::fs::remove_file(own.join("rgb/000004.jpg")).unwrap();
    std::fs::remove_file(own.join("ir/000004.jpg")).unwrap();
    let set = open("vtuav", dir.path(), "").unwrap();
    let notes = set.sequences[0].notes();
    assert!(notes.iter().any(|n| n.text.contains("frames are missing")), "{notes:?}");

    // A copy that holds the annotated frames only.
    let kept = dir.path().join("kept/bus_002");
    write(&kept, 0, 21, "ir");
    for i in (0..21).filter(|i| i % 10 != 0) {
        std::fs::remove_file(kept.join(format!("rgb/{i:06}.jpg"))).unwrap();
        std::fs::remove_file(kept.join(format!("ir/{i:06}.jpg"))).unwrap();
    }
    let set = open("vtuav", &kept, "").unwrap();
    assert!(set.sequences[0].notes().is_empty() && set.sequences[0].frames() == 3);
    assert_eq!(set.sequences[0].truth(0, 1, Modality::Rgb).unwrap().x, 110.0);
}
