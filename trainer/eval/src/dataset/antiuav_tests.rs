use std::path::Path;

use proptest::prelude::*;
use tsda_runtime::{BBox, Modality};

use super::parse_label;
use crate::dataset::testing::{open, pictures, pictures_of, text};
use crate::dataset::{Affine, Registration};

/// RGB of twice the size of thermal, shifted by (10, 4) RGB pixels; frame 3 absent as `[]`, frame 4
/// with a stale box.
fn write(own: &Path, n: usize) {
    let names = |letter: &str, n: usize| -> Vec<String> {
        (0..n).map(|i| format!("{letter}{i}.jpg")).collect()
    };
    let (rgb, ir) = (names("visibleI", n), names("infraredI", n + 2));
    let text_of = |v: &[String]| v.iter().map(String::as_str).collect::<Vec<_>>().join("|");
    pictures_of(&own.join("visible"), &text_of(&rgb).split('|').collect::<Vec<_>>(), (128, 96));
    pictures_of(&own.join("infrared"), &text_of(&ir).split('|').collect::<Vec<_>>(), (64, 48));
    let (mut exist, mut a, mut b) = (vec![], vec![], vec![]);
    for i in 0..n {
        exist.push(u8::from(i != 3 && i != 4));
        let (x, y) = (5 * i + 3, (i * i) % 30);
        match i {
            3 => {
                a.push("[]".to_owned());
                b.push("[]".to_owned());
            }
            _ => {
                a.push(format!("[{}, {}, 8, 6]", 2 * x + 10, 2 * y + 4));
                b.push(format!("[{x}, {y}, 4, 3]"));
            }
        }
    }
    let label =
        |rects: &[String]| format!("{{\"exist\": {exist:?}, \"gt_rect\": [{}]}}", rects.join(", "));
    text(own.join("visible.json"), &label(&a));
    text(own.join("infrared.json"), &label(&b));
}

#[test]
fn reads_both_cameras_with_their_own_size_and_boxes() {
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("test/20190925_1"), 12);
    write(&dir.path().join("val/20190925_2"), 12);
    let set = open("antiuav", dir.path(), "@test").unwrap();
    assert_eq!(set.sequences.len(), 1);
    let s = &set.sequences[0];
    assert_eq!((s.id(), s.frames()), ("20190925_1", 12));
    assert_eq!(s.resolution(Modality::Rgb).unwrap(), (128, 96));
    assert_eq!(s.resolution(Modality::Thermal).unwrap(), (64, 48));
    assert_eq!(s.truth(0, 0, Modality::Rgb), Some(BBox::new(16.0, 4.0, 8.0, 6.0)));
    assert_eq!(s.truth(0, 0, Modality::Thermal), Some(BBox::new(3.0, 0.0, 4.0, 3.0)));
    for m in [Modality::Rgb, Modality::Thermal] {
        assert!(s.absent(0, 3, m) && s.absent(0, 4, m) && !s.absent(0, 5, m));
    }
    assert!(s.truth_row(0, 4, Modality::Rgb).unwrap().is_valid(), "the stale box");
    assert!(s.picture_path(10, Modality::Rgb).unwrap().ends_with("visibleI10.jpg"));
    assert_eq!(s.registration(), Registration::Unknown);
    assert!(s.notes()[0].text.contains("12 and 14 pictures"), "{:?}", s.notes());
    let e = open("antiuav", dir.path(), "@train").unwrap_err().to_string();
    assert!(e.contains("split 'train'"), "{e}");
}

#[test]
fn registered_rgb_lies_on_the_thermal_frame() {
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("a"), 12);
    let set = open("antiuav/registered", dir.path(), "").unwrap();
    let s = &set.sequences[0];
    for frame in [0, 7, 11] {
        let (a, b) = (s.truth(0, frame, Modality::Rgb), s.truth(0, frame, Modality::Thermal));
        assert!(a.unwrap().iou(&b.unwrap()) > 0.98, "{a:?} {b:?}");
    }
    assert!(s.absent(0, 4, Modality::Rgb));
    assert_eq!(s.registration(), Registration::Aligned);
    let p = s.picture(2, Modality::Rgb).unwrap();
    assert_eq!((p.width, p.height, p.channels), (64, 48, 3));
    assert_eq!(s.resolution(Modality::Rgb).unwrap(), (64, 48));
    // Frame 2 is grey 20; RGB reaches from -5 to 59 in x.
    assert_eq!((p.data[0], p.data[3 * 62]), (20, 0));
    assert!(s.notes().iter().any(|n| n.text.contains("fitted to 10 frames")), "{:?}", s.notes());

    // A map that comes with the clip is used as it is.
    text(dir.path().join("a/registration.txt"), "0.5 0 0\n0 0.5 0\n");
    let set = open("antiuav", dir.path(), "").unwrap();
    let want = Affine { rows: [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]] };
    assert_eq!(set.sequences[0].registration(), Registration::Affine(want));
    let set = open("antiuav/registered", dir.path(), "").unwrap();
    let b = set.sequences[0].truth(0, 0, Modality::Rgb);
    assert_eq!(b, Some(BBox::new(8.0, 2.0, 4.0, 3.0)));
    text(dir.path().join("a/registration.txt"), "0.5 0 0 0 0");
    let e = open("antiuav", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("registration.txt") && e.contains("six numbers"), "{e}");
}

#[test]
fn too_few_common_boxes_cannot_be_registered() {
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("short"), 6);
    let e = open("antiuav/registered", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("short") && e.contains("4 frames have a box in both"), "{e}");
}

#[test]
fn thermal_alone_with_pictures_in_the_folder() {
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("train/01_1667_0001-1500");
    pictures(&own, &["000001.jpg", "000002.jpg"]);
    text(own.join("IR_label.json"), "{\"exist\": [1, 0], \"gt_rect\": [[1, 2, 3, 4], [0]]}");
    let set = open("antiuav", dir.path(), "@train").unwrap();
    let s = &set.sequences[0];
    assert_eq!(s.modalities(), [Modality::Thermal]);
    assert!(s.truth(0, 0, Modality::Thermal).is_some() && s.absent(0, 1, Modality::Thermal));
}

#[test]
fn videos_are_named_with_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("a");
    text(own.join("RGB_label.json"), "{\"exist\": [1], \"gt_rect\": [[1, 2, 3, 4]]}");
    text(own.join("RGB.mp4"), "video");
    let e = open("antiuav", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("ffmpeg -i RGB.mp4"), "{e}");
    std::fs::remove_file(own.join("RGB.mp4")).unwrap();
    let e = open("antiuav", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("labels but no pictures"), "{e}");
}

#[test]
fn defects_of_labels_name_file_and_place() {
    for (label, want) in [
        ("{\"exist\": [1],\n \"gt_rect\": [[1, 2, \"x\", 4]]}", "line 2"),
        ("{\"exist\": [1]}", "gt_rect"),
        ("{\"exist\": [1, 1], \"gt_rect\": [[]]}", "'exist' has 2 entries and 'gt_rect' 1"),
        ("{\"exist\": [1, 1], \"gt_rect\": [[], [1, 2]]}", "gt_rect[1] has 2 numbers"),
        ("", "line 1"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let own = dir.path().join("a");
        pictures(&own.join("infrared"), &["1.jpg"]);
        text(own.join("infrared.json"), label);
        let e = open("antiuav", dir.path(), "").unwrap_err().to_string();
        assert!(e.contains(want) && e.contains("infrared.json"), "{label}: {e}");
    }
    let marked =
        parse_label(b"\xEF\xBB\xBF{\"exist\": [true, 1.0], \"gt_rect\": [null, [1,2,3,4]]}");
    assert_eq!(marked.unwrap().2, 1, "visible without a box");
}

proptest! {
    #[test]
    fn labels_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        let _ = parse_label(&bytes);
    }

    #[test]
    fn almost_labels_never_panic(
        exist in "[0-9,. truefalse]{0,20}",
        rects in "[\\[\\]0-9,.eE nul-]{0,60}",
    ) {
        let _ = parse_label(format!("{{\"exist\":[{exist}],\"gt_rect\":[{rects}]}}").as_bytes());
    }
}
