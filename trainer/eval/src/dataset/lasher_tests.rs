use std::path::Path;

use tsda_runtime::{BBox, Modality};

use crate::dataset::testing::{open, pictures, text};

/// Aligned release: letters in the names, any first number, an FL sequence, an apostrophe.
fn write(root: &Path) {
    let train = root.join("TrainingSet/trainingset/1boygo");
    pictures(&train.join("visible"), &["v98.JPG", "v99.JPG", "v100.JPG"]);
    pictures(&train.join("infrared"), &["i000.jpg", "i001.jpg", "i002.jpg"]);
    for name in ["visible.txt", "infrared.txt", "init.txt"] {
        text(train.join(name), "10,20,30,40\r\n0,0,0,0\r\n11,-2,30,40\r\n\r\n");
    }
    let test = root.join("TestingSet/testingset/leftgirl'swhitebag");
    pictures(&test.join("visible"), &["v0001.jpg", "v0002.jpg"]);
    pictures(&test.join("infrared"), &["i0001.jpg", "i0002.jpg", "i0003.jpg"]);
    text(test.join("visible.txt"), "1,1,2,2\n1,1,2,2");
    text(test.join("init.txt"), "1,1,2,2\n1,1,2,2");
    let flags = "0,1,0,0,0,0,0,0,0,0,0,1,0,1,1,0,0,1,0";
    text(root.join("AttriSeqsTxt/leftgirl'swhitebag.txt"), flags);
    text(root.join("AttriSeqsTxt/1boygo.txt"), "0 1 0");
}

#[test]
fn reads_both_sensors_with_absences_and_attributes() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    let train = open("lasher", dir.path(), "@train").unwrap();
    assert_eq!(train.sequences.len(), 1);
    let s = &train.sequences[0];
    assert_eq!((s.id(), s.frames(), s.targets()), ("1boygo", 3, 1));
    for m in [Modality::Rgb, Modality::Thermal] {
        assert_eq!(s.truth(0, 0, m), Some(BBox::new(10.0, 20.0, 30.0, 40.0)));
        assert!(s.absent(0, 1, m) && s.annotated(0, 1, m) && !s.absent(0, 2, m));
        assert_eq!(s.truth_row(0, 1, m), Some(BBox::default()));
    }
    assert!(s.picture_path(0, Modality::Rgb).unwrap().ends_with("v98.JPG"));
    assert_eq!(s.picture(2, Modality::Rgb).unwrap().channels, 3);
    assert_eq!(s.resolution(Modality::Thermal).unwrap(), (6, 4));
    assert!(s.attributes().is_empty());
    assert!(s.notes()[0].text.contains("3 attribute flags: expected 19"), "{:?}", s.notes());

    let test = open("lasher", dir.path(), "@test").unwrap();
    let s = &test.sequences[0];
    assert_eq!((s.id(), s.frames()), ("leftgirl'swhitebag", 2));
    assert_eq!(s.attributes(), ["PO", "SA", "TC", "FL", "SV"]);
    let notes: Vec<&str> = s.notes().iter().map(|n| n.text.as_str()).collect();
    assert!(notes[0].contains("no infrared.txt: boxes of init.txt used"), "{notes:?}");
    assert!(notes[1].contains("2 and 3 pictures"), "{notes:?}");
}

#[test]
fn lists_decide_the_split_and_name_what_is_missing() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    text(dir.path().join("testingsetList.txt"), "\u{feff}1boygo\r\n\r\n");
    let test = open("lasher", dir.path(), "@test").unwrap();
    assert_eq!(test.sequences[0].id(), "1boygo");
    text(dir.path().join("testingsetList.txt"), "1boygo\n\nnothere\n");
    let e = open("lasher", dir.path(), "@test").unwrap_err().to_string();
    assert!(e.contains("testingsetList.txt, line 3") && e.contains("'nothere'"), "{e}");
    let e = open("lasher", dir.path(), "@val").unwrap_err().to_string();
    assert!(e.contains("trainingsetList.txt"), "{e}");
    assert_eq!(open("lasher", dir.path(), "").unwrap().sequences.len(), 2);
}

#[test]
fn broken_sequences_name_their_files() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path());
    let own = dir.path().join("TrainingSet/trainingset/1boygo");
    text(own.join("infrared.txt"), "1,2,3,4\n1,2,3\n");
    let e = open("lasher", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("infrared.txt, line 2"), "{e}");
    std::fs::remove_dir_all(own.join("infrared")).unwrap();
    let e = open("lasher", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("1boygo") && e.contains("infrared/ is missing"), "{e}");
    let e = open("lasher", &dir.path().join("AttriSeqsTxt"), "").unwrap_err().to_string();
    assert!(e.contains("no sequence folder in it"), "{e}");
}
