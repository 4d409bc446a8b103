use super::*;
use tsda_runtime::BBox;

use crate::dataset::Picture;

fn write(folder: &Path, file: &str, text: &str) {
    let path = folder.join(file);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, text).unwrap();
}

const V: &str = "1,1,4,4\n2,1,4,4\n3,1,4,4\n";
const I: &str = "1,9,4,4\n2,9,4,4\n3,9,4,4\n";

#[test]
fn files_of_every_benchmark_are_found() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    write(at, "flat/s.txt", V);
    write(at, "rgbt234/s/visible.txt", V);
    write(at, "rgbt234/s/visible-o.txt", "broken");
    write(at, "rgbt234/s/infrared.txt", I);
    write(at, "rgbt234/s/init.txt", "1 1 4 5\n2 1 4 5\n3 1 4 5\n");
    write(at, "gtot/s/groundTruth_v.txt", "1 1 5 5\n2 1 6 5\n3 1 7 5\n");
    write(at, "gtot/s/groundTruth_i.txt", "1 9 5 13\n2 9 6 13\n3 9 7 13\n");
    write(at, "got/s/groundtruth.txt", V);
    write(at, "got/s/cover.label", "8\n0\n3\n");
    write(at, "got/s/meta_info.ini", "[METAINFO]\nurl: x\nresolution: (1920, 1080)\n");
    write(at, "otb/s/groundtruth_rect.txt", V);

    use Convention::*;
    for (folder, convention, protocol, y, infrared) in [
        ("flat", Lasher, None, [1.0, 1.0, 1.0], None),
        ("flat", Tsda, None, [1.0, 1.0, 1.0], None),
        ("rgbt234", Lasher, None, [1.0, 1.0, 1.0], None),
        ("rgbt234", Rgbt234, None, [1.0, 1.0, 1.0], Some(9.0)),
        ("rgbt234", Tsda, Some(Protocol::RgbToThermal), [1.0, 9.0, 9.0], None),
        ("rgbt234", Tsda, Some(Protocol::Thermal), [9.0, 9.0, 9.0], None),
        ("gtot", Gtot, None, [1.0, 1.0, 1.0], Some(9.0)),
        ("gtot", Tsda, Some(Protocol::ThermalToRgb), [9.0, 1.0, 1.0], None),
        ("gtot", Tsda, None, [1.0, 1.0, 1.0], None),
        ("got", Got10k, None, [1.0, 1.0, 1.0], None),
        ("otb", Otb, None, [1.0, 1.0, 1.0], None),
    ] {
        let what = format!("{folder} {convention} {protocol:?}");
        let set = TruthSet::read_folder(&at.join(folder), convention, None, protocol)
            .unwrap_or_else(|e| panic!("{what}: {e}"));
        assert_eq!(set.sequences.len(), 1, "{what}");
        let s = &set.sequences[0];
        assert_eq!(s.name, "s");
        let ys: Vec<f64> = s.visible.iter().map(|r| r[1]).collect();
        assert_eq!(ys, y, "{what}");
        assert!(s.visible.iter().all(|r| r[2] == 4.0 && r[3] == 4.0), "{what}");
        assert_eq!(s.infrared.as_ref().map(|r| r[0][1]), infrared, "{what}");
        assert_eq!(s.modalities.is_some(), protocol.is_some(), "{what}");
    }
    let set = TruthSet::read_folder(&at.join("rgbt234"), Rgbt210, None, None).unwrap();
    assert_eq!(set.sequences[0].visible[0][3], 5.0, "init.txt comes first");
    let set = TruthSet::read_folder(&at.join("got"), Got10k, None, None).unwrap();
    assert_eq!(set.sequences[0].cover, Some(vec![8, 0, 3]));
    assert_eq!(set.sequences[0].image, Some([1920.0, 1080.0]));
    assert_eq!(set.sequences[0].as_truth().image, Some([1920.0, 1080.0]));
}

#[test]
fn what_is_wrong_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    write(at, "a/visible.txt", V);
    write(at, "a/infrared.txt", "1,9,4,4\n");
    write(at, "b.txt", "1,1,4,4\n1,1,4\n");
    write(at, "list.txt", "\na\r\n\n");
    write(at, "none.txt", " \n");
    let names = |n: &str| Some(vec![n.to_owned()]);
    for (convention, list, words) in [
        (Convention::Rgbt234, names("a"), vec!["infrared.txt, line 2", "visible.txt has 3"]),
        (Convention::Lasher, names("b"), vec!["b.txt, line 2", "found 3"]),
        (Convention::Gtot, names("a"), vec!["no truth of convention gtot"]),
        (Convention::Gtot, None, vec!["no sequence with truth of convention gtot"]),
    ] {
        let e = TruthSet::read_folder(at, convention, list.as_deref(), None).unwrap_err();
        let e = e.to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    }
    assert!(TruthSet::read_folder(&at.join("gone"), Convention::Tsda, None, None).is_err());
    assert_eq!(read_names(&at.join("list.txt")).unwrap(), ["a"]);
    assert!(read_names(&at.join("none.txt")).unwrap_err().to_string().contains("no names"));
    write(at, "cover.label", "8\n9\n");
    let e = read_cover(&at.join("cover.label")).unwrap_err().to_string();
    assert!(e.contains("cover.label, line 2"), "{e}");
    write(at, "meta_info.ini", "resolution: wide\n");
    let e = read_resolution(&at.join("meta_info.ini")).unwrap_err().to_string();
    assert!(e.contains("meta_info.ini, line 1"), "{e}");
}

/// Four frames; absent in frame 0 of the visible sensor, and in frame 2 of both.
struct Clip(Vec<Modality>);

impl Sequence for Clip {
    fn id(&self) -> &str {
        "clip"
    }
    fn frames(&self) -> usize {
        4
    }
    fn modalities(&self) -> &[Modality] {
        &self.0
    }
    fn targets(&self) -> usize {
        2
    }
    fn truth(&self, target: usize, frame: usize, modality: Modality) -> Option<BBox> {
        let y = if modality == Modality::Rgb { 1.0 } else { 9.0 };
        let gone = frame == 2 || (frame == 0 && modality == Modality::Rgb);
        (!gone).then(|| BBox::new(frame as f32, y + target as f32, 4.0, 4.0))
    }
    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        Err(DatasetError::NoSuchFrame { sequence: "clip".into(), frame, modality })
    }
}

#[test]
fn datasets_give_the_truth_that_runs_are_scored_by() {
    let data = |modalities: &[Modality]| Dataset {
        name: "d".into(),
        sequences: vec![Box::new(Clip(modalities.to_vec()))],
    };
    let both = data(&[Modality::Rgb, Modality::Thermal]);
    let set = TruthSet::of_dataset(&both, Convention::Tsda, Some(Protocol::RgbToThermal));
    let names: Vec<&str> = set.sequences.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["clip", "clip#1"]);
    // The run starts in frame 1, the first with a visible box.
    let want = [[1.0, 1.0, 4.0, 4.0], [0.0; 4], [3.0, 9.0, 4.0, 4.0]];
    assert_eq!(set.sequences[0].visible, want);
    let sensors = [Modality::Rgb, Modality::Thermal, Modality::Thermal];
    assert_eq!(set.sequences[0].modalities.as_deref(), Some(&sensors[..]));

    let set = TruthSet::of_dataset(&both, Convention::Rgbt234, None);
    assert_eq!(set.sequences[0].visible.len(), 4);
    assert_eq!(set.sequences[0].infrared.as_ref().unwrap()[3][1], 9.0);

    let thermal = data(&[Modality::Thermal]);
    let set = TruthSet::of_dataset(&thermal, Convention::Lasher, None);
    assert_eq!(set.sequences[0].visible[0][1], 9.0);
    for (convention, protocol) in
        [(Convention::Gtot, None), (Convention::Tsda, Some(Protocol::RgbToThermal))]
    {
        let set = TruthSet::of_dataset(&thermal, convention, protocol);
        assert_eq!((set.sequences.len(), set.skipped.len()), (0, 2));
    }
}
