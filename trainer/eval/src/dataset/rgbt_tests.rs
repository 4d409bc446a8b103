use std::path::Path;

use tsda_runtime::{BBox, Modality};

use crate::dataset::testing::{open, pictures, text};

#[test]
fn rgbt234_keeps_a_truth_per_sensor_and_pairs_by_position() {
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("afterrain");
    // Numbers of a pair differ by two; more thermal pictures than rows.
    pictures(&own.join("visible"), &["00159v.jpg", "00160v.jpg"]);
    pictures(&own.join("infrared"), &["00157i.jpg", "00158i.jpg", "00159i.jpg"]);
    text(own.join("infrared/Thumbs.db"), "x");
    text(own.join("visible.txt"), "5,6,7,8\n5,6,7,8\n");
    text(own.join("infrared.txt"), "6,6,7,9\n6,6,7,9\n");
    text(own.join("visible-o.txt"), "not boxes");
    text(own.join("init.txt"), "5,6,7,8\n5,6,7,8\n");
    text(dir.path().join("attr_txt/SequencesName.txt"), "blackwoman\r\nafterrain\r\n");
    text(dir.path().join("attr_txt/TC.txt"), "1\r\n1\r\n");
    text(dir.path().join("attr_txt/LI.txt"), "1\r\n0\r\n");
    text(dir.path().join("attr_txt/BC.txt"), "0\r\n1\r\n");
    let set = open("rgbt234", dir.path(), "@test").unwrap();
    let s = &set.sequences[0];
    assert_eq!((s.id(), s.frames()), ("afterrain", 2));
    assert_eq!(s.truth(0, 0, Modality::Rgb), Some(BBox::new(5.0, 6.0, 7.0, 8.0)));
    assert_eq!(s.truth(0, 0, Modality::Thermal), Some(BBox::new(6.0, 6.0, 7.0, 9.0)));
    assert!(s.picture_path(1, Modality::Thermal).unwrap().ends_with("00158i.jpg"));
    assert_eq!(s.attributes(), ["BC", "TC"]);
    assert_eq!(s.notes().len(), 1, "{:?}", s.notes());

    text(dir.path().join("attr_txt/LI.txt"), "1\n");
    let e = open("rgbt234", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("LI.txt") && e.contains("1 flags for the 2 names"), "{e}");
    let e = open("rgbt234", dir.path(), "@train").unwrap_err().to_string();
    assert!(e.contains("RGBT234 is a test set"), "{e}");
}

#[test]
fn rgbt210_has_one_file_for_both_sensors() {
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("baby");
    pictures(&own.join("visible"), &["00001v.jpg"]);
    pictures(&own.join("infrared"), &["00001i.jpg"]);
    text(own.join("init.txt"), "5,6,0,8\n");
    let set = open("rgbt210", dir.path(), "").unwrap();
    let s = &set.sequences[0];
    assert!(s.absent(0, 0, Modality::Rgb) && s.absent(0, 0, Modality::Thermal));
    assert_eq!(s.truth_row(0, 0, Modality::Thermal), Some(BBox::new(5.0, 6.0, 0.0, 8.0)));
    assert!(s.notes().is_empty(), "{:?}", s.notes());
}

fn write_gtot(root: &Path) {
    let own = root.join("BlackCar");
    pictures(&own.join("v"), &["00001v.png", "00002v.png"]);
    pictures(&own.join("i"), &["img_00001.bmp", "img_00002.bmp"]);
    text(own.join("groundTruth_v.txt"), "10 20 14 26 \r\n14 26 10 20\r\n");
    text(own.join("groundTruth_i.txt"), "11 20 15 26\n11 20 15 26\n");
    text(own.join("init.txt"), "10\t20\t4\t6\n10\t20\t4\t6\n");
}

#[test]
fn gtot_corners_become_boxes() {
    let dir = tempfile::tempdir().unwrap();
    write_gtot(dir.path());
    let set = open("gtot", dir.path(), "").unwrap();
    let s = &set.sequences[0];
    assert_eq!(s.truth(0, 0, Modality::Rgb), Some(BBox::new(10.0, 20.0, 4.0, 6.0)));
    assert_eq!(s.truth(0, 1, Modality::Rgb), Some(BBox::new(10.0, 20.0, 4.0, 6.0)));
    assert_eq!(s.truth(0, 1, Modality::Thermal), Some(BBox::new(11.0, 20.0, 4.0, 6.0)));
    assert!(s.picture_path(1, Modality::Thermal).unwrap().ends_with("img_00002.bmp"));

    // Without the corner file, the tabbed one with width and height.
    std::fs::remove_file(dir.path().join("BlackCar/groundTruth_v.txt")).unwrap();
    let set = open("gtot", dir.path(), "").unwrap();
    let s = &set.sequences[0];
    assert_eq!(s.truth(0, 0, Modality::Rgb), Some(BBox::new(10.0, 20.0, 4.0, 6.0)));
    assert!(s.notes()[0].text.contains("no groundTruth_v.txt: boxes of init.txt used"));

    text(dir.path().join("BlackCar/groundTruth_i.txt"), "11 20 15\n");
    let e = open("gtot", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("groundTruth_i.txt, line 1") && e.contains("x1 y1 x2 y2"), "{e}");
}

#[test]
fn flags_without_names_are_a_problem() {
    let dir = tempfile::tempdir().unwrap();
    write_gtot(dir.path());
    text(dir.path().join("attr_txt/OCC.txt"), "1\n");
    let e = open("gtot", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("no SequencesName.txt"), "{e}");
}
