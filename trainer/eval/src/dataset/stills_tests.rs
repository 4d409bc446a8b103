use tsda_runtime::{BBox, Modality};

use crate::dataset::testing::{open, pictures, text};
use crate::dataset::{Severity, scan};

#[test]
fn lists_of_stills_with_either_sensor() {
    let dir = tempfile::tempdir().unwrap();
    pictures(&dir.path().join("images"), &["a.jpg", "b.png"]);
    let index = dir.path().join("index.json");
    let list = r#"[
        {"id": "a", "infrared": "images/a.jpg", "width": 6, "height": 4, "split": "val",
         "boxes": [{"xywh": [1, 1, 2.5, 2], "cls": "Car"}, {"xywh": [1, 1, 0, 2]}]},
        {"id": "b", "visible": "images/b.png", "infrared": "images/a.jpg",
         "boxes": [{"xywh": [9, 9, 2, 2]}], "width": 6, "height": 4}]"#;
    text(&index, list);
    let set = open("stills", dir.path(), "").unwrap();
    let (a, b) = (&set.sequences[0], &set.sequences[1]);
    assert_eq!((a.frames(), a.targets(), a.modalities()), (1, 1, &[Modality::Thermal][..]));
    assert_eq!(a.truth(0, 0, Modality::Thermal), Some(BBox::new(1.0, 1.0, 2.5, 2.0)));
    assert_eq!(a.truth(0, 0, Modality::Rgb), None);
    assert!(a.notes()[0].text.contains("1 boxes without area"), "{:?}", a.notes());
    assert_eq!(b.modalities().len(), 2);
    assert!(b.notes()[0].severity == Severity::Broken, "{:?}", b.notes());
    assert_eq!(b.picture(0, Modality::Rgb).unwrap().channels, 3);
    assert_eq!(open("stills", dir.path(), "@val").unwrap().sequences.len(), 1);
    let e = open("stills", dir.path(), "@test").unwrap_err().to_string();
    assert!(e.contains("none of the 2 stills"), "{e}");

    text(&index, &format!("{{\"stills\": {list}}}").replace("\"width\": 6", "\"width\": 7"));
    let e = open("stills", dir.path(), "").unwrap().sequences[0].picture(0, Modality::Thermal);
    assert!(e.unwrap_err().to_string().contains("6 x 4, but the annotation says 7 x 4"));

    for (from, to, want) in [
        ("\"id\": \"b\", ", "", "still 1 (0-based, id '?'): missing field `id`"),
        ("[9, 9, 2, 2]", "[9, 9, 2]", "still 1 (0-based, id 'b')"),
        ("images/b.png", "images/c.png", "c.png does not exist"),
        ("\"infrared\": \"images/a.jpg\", \"width\"", "\"width\"", "one of 'visible' and"),
        ("[9, 9, 2, 2]", "[9, 9, 2, 2", "line 5"),
    ] {
        text(&index, &list.replace(from, to));
        let e = open("stills", dir.path(), "").unwrap_err().to_string();
        assert!(e.contains(want) && e.contains("index.json"), "{want}: {e}");
    }
}

const COCO: &str = r#"{"images": [
    {"id": 7, "file_name": "a.jpg", "width": 6, "height": 4},
    {"id": 8, "file_name": "b.jpg", "width": 6, "height": 4}],
  "annotations": [
    {"id": 1, "image_id": 7, "category_id": 3, "bbox": [1, 1, 2, 2.5], "iscrowd": 0},
    {"id": 2, "image_id": 7, "category_id": 3, "bbox": [0, 0, 6, 4], "iscrowd": 1},
    {"id": 3, "image_id": 8, "category_id": 3, "bbox": [1, 1, 0, 2]}],
  "categories": [{"id": 3, "name": "person"}]}"#;

#[test]
fn coco_files_in_the_usual_places() {
    for (json, folder) in [
        ("annotations/instances_val2017.json", "val2017"),
        ("valid/_annotations.coco.json", "valid"),
        ("images_thermal_val/coco.json", "images_thermal_val"),
        ("val.json", "images"),
    ] {
        let dir = tempfile::tempdir().unwrap();
        pictures(&dir.path().join(folder), &["a.jpg", "b.jpg"]);
        text(dir.path().join(json), COCO);
        text(dir.path().join("annotations/captions_val2017.json"), "{}");
        let set = open("coco/thermal", dir.path(), "@val").unwrap();
        let (a, b) = (&set.sequences[0], &set.sequences[1]);
        assert_eq!((a.id(), a.targets(), b.targets()), ("a", 1, 0), "{json}");
        assert_eq!(a.truth(0, 0, Modality::Thermal), Some(BBox::new(1.0, 1.0, 2.0, 2.5)));
        assert_eq!(a.picture(0, Modality::Thermal).unwrap().width, 6, "{json}");
        let e = open("coco", dir.path(), "@train").unwrap_err().to_string();
        assert!(e.contains("split 'train'"), "{e}");
        // The file itself.
        let set = open("coco", &dir.path().join(json), "").unwrap();
        assert_eq!(set.sequences.len(), 2);
    }
}

#[test]
fn coco_defects_are_all_found() {
    let dir = tempfile::tempdir().unwrap();
    pictures(dir.path(), &["a.jpg"]);
    text(
        dir.path().join("all.json"),
        &COCO.replace("[1, 1, 0, 2]", "[1, 1]").replace("\"image_id\": 7", "\"image_id\": 9"),
    );
    let found = scan(&format!("coco:{}", dir.path().display())).unwrap();
    let all: Vec<String> = found.broken.iter().map(ToString::to_string).collect();
    assert_eq!((found.sequences.len(), all.len()), (1, 3), "{all:?}");
    for want in ["annotations[2]: bbox has 2", "image that is not listed", "b.jpg does not exist"] {
        assert!(all.iter().any(|e| e.contains(want) && e.contains("all.json")), "{all:?}");
    }
    text(dir.path().join("all.json"), "{\"images\": [\n{\"id\": 1}]}");
    let e = open("coco", dir.path(), "").unwrap_err().to_string();
    assert!(e.contains("all.json, line 2") && e.contains("file_name"), "{e}");
}
