//! The program with the model that ships in the repository and is built into it.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

fn tsda(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(args)
        .current_dir(dir)
        .output()
        .expect("the program starts")
}

fn ok(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    text
}

/// Reads `all   0-95   95   0.9 ...` from the demo's table.
fn figure(text: &str, row: &str, column: usize) -> f32 {
    let line = text.lines().find(|l| l.starts_with(row)).unwrap_or_else(|| panic!("{text}"));
    line.split_whitespace().nth(column).and_then(|w| w.parse().ok()).expect("number")
}

#[test]
fn the_demo_follows_the_target_through_the_switch() {
    let dir = tempfile::tempdir().expect("temp");
    let text = ok(&tsda(dir.path(), &["demo", "--out", "r"]));
    println!("{text}");
    for name in ["boxes.txt", "demo.gif", "demo.html", "strip.png"] {
        let size = fs::metadata(dir.path().join("r").join(name)).expect(name).len();
        assert!(size > 500, "{name}: {size} bytes");
    }
    assert!(text.contains("switch: rgb -> thermal at frame 48"), "{text}");
    // A box that never moves has a mean IoU below 0.2 on this clip.
    assert!(figure(&text, "thermal", 5) > 0.35, "{text}");
    assert!(figure(&text, "all", 3) > 0.4 && figure(&text, "all", 4) > 0.7, "{text}");
}

#[test]
fn the_shipped_model_passes_its_own_check() {
    let dir = tempfile::tempdir().expect("temp");
    let text = ok(&tsda(dir.path(), &["verify"]));
    println!("{text}");
    assert!(text.contains("tract") && text.trim_end().ends_with("ok"), "{text}");
    let failed = tsda(dir.path(), &["verify", "--tolerance", "0"]);
    assert_eq!(failed.status.code(), Some(1), "no engine is exact to the last bit");
    let info = ok(&tsda(dir.path(), &["info"]));
    for word in ["features.onnx", "licence", "NanoTrack v3"] {
        assert!(info.contains(word), "{word} in {info}");
    }
}

/// A list that changes the sensor in the middle, as the README tells people to write it.
#[test]
fn a_list_of_two_sensors_is_tracked() {
    use tsda_host::picture::Picture;
    use tsda_host::render::{Clip, ClipConfig};
    use tsda_runtime::Modality;
    let dir = tempfile::tempdir().expect("temp");
    let clip = Clip::new(ClipConfig::default());
    let (mut list, mut truth) = (String::new(), String::new());
    for i in 0..12 {
        let (folder, modality) =
            if i < 6 { ("visible", Modality::Rgb) } else { ("infrared", Modality::Thermal) };
        let mut p = Picture::default();
        clip.render(i, modality, &mut p);
        let name = format!("{folder}/{i}.png");
        fs::create_dir_all(dir.path().join(folder)).expect("mkdir");
        let colour = if p.channels == 1 { image::ColorType::L8 } else { image::ColorType::Rgb8 };
        let (w, h) = (p.width as u32, p.height as u32);
        image::save_buffer(dir.path().join(&name), &p.data, w, h, colour).expect("png");
        list += &format!("{name}\n");
        let b = clip.truth(i);
        truth += &format!("{},{},{},{}\n", b.x, b.y, b.w, b.h);
    }
    fs::write(dir.path().join("clip.txt"), list).expect("write");
    fs::write(dir.path().join("groundtruth.txt"), truth).expect("write");
    let args = [
        "track",
        "--frames",
        "clip.txt",
        "--out",
        "boxes.txt",
        "--json",
        "-",
        "--truth",
        "groundtruth.txt",
        "--video-out",
        "clip.html",
    ];
    let output = tsda(dir.path(), &args);
    let rows: Vec<serde_json::Value> =
        ok(&output).lines().map(|l| serde_json::from_str(l).expect("json")).collect();
    assert_eq!(rows.len(), 12);
    assert_eq!((&rows[5]["modality"], &rows[6]["modality"]), (&"rgb".into(), &"thermal".into()));
    let boxes = fs::read_to_string(dir.path().join("boxes.txt")).expect("boxes");
    assert_eq!(boxes.lines().count(), 12);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(told.contains("mean IoU") && told.contains("thermal"), "{told}");
}

/// Ctrl-C in the middle of a stream: code 3, one line, and nothing left in the folder.
#[cfg(unix)]
#[test]
fn an_interrupted_run_leaves_nothing() {
    use std::io::{Read as _, Write as _};
    use std::process::Stdio;
    let dir = tempfile::tempdir().expect("temp");
    let args = [
        "track",
        "--frames",
        "-",
        "--init",
        "9,9,20,20",
        "--out",
        "b.txt",
        "--json",
        "-",
        "--video-out",
        "v.gif",
        "--video-out",
        "png",
    ];
    let mut child = Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(args)
        .current_dir(dir.path())
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let mut stdin = child.stdin.take().expect("pipe");
    let mut stream = b"YUV4MPEG2 W64 H48 Cmono\nFRAME\n".to_vec();
    stream.extend((0..64 * 48).map(|i| (i * 7) as u8));
    stdin.write_all(&stream).expect("first frame");
    // A line on standard output says that the first frame is done and the outputs are open.
    let mut byte = [0];
    child.stdout.take().expect("pipe").read_exact(&mut byte).expect("first row");
    assert!(fs::read_dir(dir.path()).expect("folder").count() >= 3, "outputs in the making");
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(killed.expect("kill").success());
    std::thread::sleep(std::time::Duration::from_millis(200));
    drop(stdin);
    let output = child.wait_with_output().expect("the program ends");
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(3), "{message}");
    assert!(message.contains("interrupted"), "{message}");
    assert_eq!(fs::read_dir(dir.path()).expect("folder").count(), 0);
}
