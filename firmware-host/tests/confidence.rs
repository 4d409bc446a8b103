//! Presence, re-detection and calibration with the embedded model, on the drawn clip in which the
//! target walks behind a screen and comes out elsewhere.
#![cfg(feature = "eval")]

use std::path::Path;
use std::process::Command;
use tsda_runtime::bundle::BundleFile;

fn tsda(dir: &Path, args: &[&str]) -> String {
    let output = Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(args)
        .current_dir(dir)
        .output()
        .expect("the program starts");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    text
}

/// A thermal sequence: the drawn clip for 10 frames, then the street without people for 40, then 15
/// with the target standing at the other end of the picture. The others on the street, who could be taken for
/// the target, are covered by what lies left of them throughout.
fn vanishing(dir: &Path) {
    use tsda_host::picture::Picture;
    let clip = tsda_host::render::Clip::new(tsda_host::render::ClipConfig::default());
    let folder = dir.join("set/gone/infrared");
    std::fs::create_dir_all(&folder).expect("mkdir");
    let (mut source, mut boxes) = (Picture::default(), String::new());
    for i in 0..65 {
        clip.render(i.min(10), tsda_runtime::Modality::Thermal, &mut source);
        let b = clip.truth(i.min(10));
        let mut shown = source.clone();
        let mut x = b.x;
        let (left, right) = (b.x as usize - 8, (b.x + b.w) as usize + 8);
        let width = source.width;
        for (from, to) in source.data.chunks_exact(width).zip(shown.data.chunks_exact_mut(width)) {
            to[230..].copy_from_slice(&from[120..120 + width - 230]);
            if i >= 10 {
                to[left..right].copy_from_slice(&from[right..2 * right - left]);
            }
        }
        if i >= 50 {
            let shift = 250 - left;
            x += shift as f32;
            for row in (b.y as usize - 5)..(b.y + b.h) as usize + 5 {
                let at = row * width + left;
                let patch = &source.data[at..at + right - left];
                shown.data[at + shift..][..patch.len()].copy_from_slice(patch);
            }
        }
        boxes += &match (10..50).contains(&i) {
            true => "0,0,0,0\n".to_owned(),
            false => format!("{x},{},{},{}\n", b.y, b.w, b.h),
        };
        let (w, h) = (shown.width as u32, shown.height as u32);
        let picture = image::GrayImage::from_raw(w, h, shown.data).expect("grey");
        picture.save(folder.join(format!("{i:03}.png"))).expect("png");
    }
    std::fs::write(dir.join("set/gone/infrared.txt"), boxes).expect("boxes");
}

#[test]
fn the_scan_finds_a_target_that_comes_out_elsewhere() {
    let dir = tempfile::tempdir().expect("temp");
    vanishing(dir.path());

    let figures = |more: &[&str]| {
        let base =
            ["presence", "--dataset", "sequences:set", "--protocol", "t", "--json", "p.json"];
        println!("{more:?}\n{}", tsda(dir.path(), &[&base, more].concat()));
        let text = std::fs::read_to_string(dir.path().join("p.json")).expect("written");
        let rows: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        rows[0].clone()
    };
    let without = figures(&[]);
    let with = figures(&["--scan-when-lost", "--scan-threshold", "0.6"]);
    assert_eq!(without["redetected"]["changes"], 1);
    assert_eq!((&without["redetected"]["came"], &without["found_by_scan"]), (&0.into(), &0.into()));
    assert_eq!((&with["redetected"]["came"], &with["found_by_scan"]), (&1.into(), &1.into()));
    let missed = |v: &serde_json::Value| v["missed_rate"].as_f64().expect("rate");
    assert!(missed(&with) < missed(&without));
}

#[test]
fn a_calibrated_bundle_differs_in_its_manifest_only_and_is_used() {
    let dir = tempfile::tempdir().expect("temp");
    let path = |name: &str| dir.path().join(name);
    std::fs::write(path("nano.tsda"), tsda_host::model::embedded().expect("embedded"))
        .expect("copy");
    std::fs::write(path("card.md"), "# another card").expect("card");
    let text = tsda(
        dir.path(),
        &[
            "calibrate",
            "--bundle",
            "nano.tsda",
            "--dataset",
            "rendered:7",
            "--protocol",
            "t",
            "--out",
            "calibrated.tsda",
            "--card",
            "card.md",
            "--json",
            "fit.json",
        ],
    );
    println!("{text}");
    let (old, new) =
        (BundleFile::open(path("nano.tsda")), BundleFile::open(path("calibrated.tsda")));
    let (old, new) = (old.expect("old"), new.expect("new"));
    let (old, new) = (old.bundle().expect("old"), new.bundle().expect("new"));
    assert_eq!(old.sections().collect::<Vec<_>>(), new.sections().collect::<Vec<_>>());
    let (before, after) = (old.manifest(), new.manifest());
    let calibration = after.calibration.expect("calibrated");
    assert_eq!((after.card, before.name), ("# another card", after.name));
    assert_eq!((&before.provenance, &before.figures), (&after.provenance, &after.figures));

    // A score and its probability go together in what `track` writes.
    let clip = tsda_host::render::Clip::new(tsda_host::render::ClipConfig::default());
    let mut picture = tsda_host::picture::Picture::default();
    let frames = path("frames");
    std::fs::create_dir(&frames).expect("folder");
    for i in 0..3 {
        clip.render(i, tsda_runtime::Modality::Thermal, &mut picture);
        let file = frames.join(format!("{i}.png"));
        let (w, h) = (picture.width as u32, picture.height as u32);
        image::GrayImage::from_raw(w, h, picture.data.clone())
            .expect("grey")
            .save(file)
            .expect("png");
    }
    let b = clip.truth(0);
    let init = format!("{},{},{},{}", b.x, b.y, b.w, b.h);
    let track = |bundle: &str| {
        let args = ["track", "--frames", "frames", "--init", &init, "--out", "b.txt"];
        let json = tsda(dir.path(), &[&args[..], &["--bundle", bundle, "--json", "-"]].concat());
        let row: serde_json::Value =
            serde_json::from_str(json.lines().nth(2).expect("frame 2")).expect("JSON");
        (row["score"].as_f64().expect("score") as f32, row.get("confidence").cloned())
    };
    let (score, confidence) = track("calibrated.tsda");
    let confidence = confidence.and_then(|c| c.as_f64()).expect("confidence") as f32;
    assert!((calibration.probability(score) - confidence).abs() < 1e-5, "{score} {confidence}");
}
