//! The program on input it cannot use: exit code 2, one line that names what is wrong, no file left.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

fn tsda(dir: &Path, args: &[&str], stdin: &[u8]) -> Output {
    let mut child = Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(args)
        .current_dir(dir)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    // The program may end before it has read everything.
    let _ = child.stdin.take().expect("pipe").write_all(stdin);
    child.wait_with_output().expect("the program ends")
}

/// Everything below a folder.
fn files(dir: &Path) -> Vec<PathBuf> {
    let mut all = Vec::new();
    for entry in fs::read_dir(dir).expect("folder") {
        let path = entry.expect("entry").path();
        if path.is_dir() {
            all.extend(files(&path));
        }
        all.push(path);
    }
    all.sort();
    all
}

/// Frames of 64 x 48 pixels, a list of them, and bundles that are none.
fn workplace() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("temp");
    let at = |name: &str| dir.path().join(name);
    fs::create_dir(at("frames")).expect("mkdir");
    fs::create_dir(at("empty")).expect("mkdir");
    fs::create_dir(at("cut")).expect("mkdir");
    for i in 0..3 {
        image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([x as u8 * 3, y as u8 * 5, i * 40]))
            .save(at(&format!("frames/{i}.png")))
            .expect("png");
    }
    let bytes = fs::read(at("frames/0.png")).expect("read");
    fs::write(at("cut/0.png"), &bytes[..bytes.len() / 2]).expect("write");
    let mut zero = vec![0u8; 54];
    zero[..2].copy_from_slice(b"BM");
    (zero[10], zero[14], zero[26], zero[28]) = (54, 40, 1, 24);
    fs::write(at("zero.bmp"), zero).expect("write");
    fs::write(at("zero.txt"), "zero.bmp\n").expect("write");
    fs::write(at("gone.txt"), "frames/0.png\nframes/7.png\n").expect("write");
    fs::write(at("tag.txt"), "frames/0.png\tsonar\n").expect("write");
    fs::write(at("text.tsda"), "this is no bundle, whatever its name says").expect("write");
    fs::write(at("short.tsda"), b"TSDA\r\n\x1a\n\x01\0\0\0").expect("write");
    fs::write(at("nothing.tsda"), b"").expect("write");
    dir
}

/// Runs a case; asserts code 2, the words in the message, one line, and no new file.
fn refused(dir: &Path, args: &[&str], stdin: &[u8], words: &[&str]) {
    let before = files(dir);
    let output = tsda(dir, args, stdin);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args:?}: {message}");
    for word in words {
        assert!(message.contains(word), "{args:?}: no \"{word}\" in: {message}");
    }
    assert_eq!(message.trim_end().lines().count(), 1, "{args:?}: {message}");
    assert!(!message.contains("panicked"), "{message}");
    assert_eq!(files(dir), before, "{args:?} left something behind");
}

#[test]
fn frames_and_boxes_that_cannot_be_used() {
    let dir = workplace();
    let track = |frames: &'static str, init: &'static str| {
        ["track", "--frames", frames, "--init", init, "--out", "boxes.txt", "--json", "t.jsonl"]
    };
    for (frames, init, words) in [
        ("nowhere", "1,1,9,9", &["nowhere"][..]),
        ("empty", "1,1,9,9", &["empty", "no pictures"]),
        ("gone.txt", "1,1,9,9", &["gone.txt, line 2", "7.png"]),
        ("tag.txt", "1,1,9,9", &["tag.txt, line 1", "sonar", "rgb nor thermal"]),
        ("frames", "1,1,9", &["--init 1,1,9", "3 numbers"]),
        ("frames", "1,one,9,9", &["--init", "\"one\" is not a number"]),
    ] {
        refused(dir.path(), &track(frames, init), b"", words);
    }
    let no_box = ["track", "--frames", "frames", "--out", "boxes.txt"];
    refused(dir.path(), &no_box, b"", &["no first box", "--init x,y,w,h", "groundtruth.txt"]);
    refused(dir.path(), &track("-", "1,1,9,9"), b"", &["stdin", "empty", "YUV4MPEG2"]);
    refused(dir.path(), &track("-", "1,1,9,9"), b"RIFF\n", &["stdin", "YUV4MPEG2"]);
    let p10 = b"YUV4MPEG2 W64 H48 C420p10\n";
    refused(dir.path(), &track("-", "1,1,9,9"), p10, &["C420p10", "yuv420p"]);
}

#[test]
fn bundles_that_cannot_be_used() {
    let dir = workplace();
    for (bundle, words) in [
        ("missing.tsda", &["cannot read bundle missing.tsda"][..]),
        ("text.tsda", &["text.tsda", "not a .tsda bundle"]),
        ("short.tsda", &["short.tsda", "truncated"]),
        ("nothing.tsda", &["nothing.tsda", "truncated"]),
    ] {
        for args in [
            &["info", bundle][..],
            &["verify", bundle],
            &["demo", "--bundle", bundle, "--out", "results"],
            &[
                "track",
                "--frames",
                "frames",
                "--init",
                "9,9,20,20",
                "--out",
                "boxes.txt",
                "--bundle",
                bundle,
            ],
        ] {
            refused(dir.path(), args, b"", words);
        }
    }
}

#[test]
fn arguments_that_make_no_sense() {
    let dir = workplace();
    for args in [
        &["track", "--out", "b.txt"][..],
        &["track", "--frames", "frames", "--out", "b.txt", "--modality", "radar"],
        &["demo", "--switch-every", "0"],
        &["frobnicate"],
    ] {
        let output = tsda(dir.path(), args, b"");
        assert_eq!(output.status.code(), Some(2), "{args:?}");
    }
    refused(dir.path(), &["verify", "--tolerance", "NaN"], b"", &["--tolerance NaN"]);
}

/// Cases that need a network to get as far as they do.
mod with_model {
    use super::*;

    #[test]
    fn boxes_outside_the_picture_or_without_area() {
        let dir = workplace();
        for (init, words) in [
            ("200,10,20,20", &["--init 200,10,20,20", "outside", "64 x 48"][..]),
            ("-50,10,20,20", &["outside"]),
            ("10,10,0,20", &["no area"]),
            ("10,10,20,-4", &["no area"]),
            ("10,nan,20,20", &["finite"]),
            ("10,10,inf,20", &["finite"]),
        ] {
            let args = [
                "track",
                "--frames",
                "frames",
                "--init",
                init,
                "--out",
                "boxes.txt",
                "--json",
                "t.jsonl",
                "--video-out",
                "v.gif",
                "--video-out",
                "v.html",
                "--video-out",
                "png",
            ];
            refused(dir.path(), &args, b"", words);
        }
    }

    #[test]
    fn pictures_that_are_cut_or_empty() {
        let dir = workplace();
        let run = |frames, stdin: &[u8], words: &[&str]| {
            let args = ["track", "--frames", frames, "--init", "9,9,20,20", "--out", "boxes.txt"];
            refused(dir.path(), &args, stdin, words);
        };
        run("cut", b"", &["0.png", "not a picture that can be read"]);
        run("zero.txt", b"", &["zero.bmp"]);
        // One good frame, then the stream ends within the second.
        let mut stream = b"YUV4MPEG2 W64 H48 Cmono\nFRAME\n".to_vec();
        stream.extend((0..64 * 48).map(|i| (i * 7) as u8));
        stream.extend(b"FRAME\nabc");
        run("-", &stream, &["stdin, frame 1", "ends within"]);
    }

    #[test]
    fn outputs_that_cannot_be_written() {
        let dir = workplace();
        for (out, more) in [
            ("no/such/folder/b.txt", &[][..]),
            ("frames", &[]),
            ("b.txt", &["--json", "no/such/t.jsonl"]),
            ("b.txt", &["--video-out", "no/such/v.gif"]),
            ("b.txt", &["--video-out", "v.mp4"]),
            ("b.txt", &["--video-out", "zero.bmp"]),
        ] {
            let mut args = vec!["track", "--frames", "frames", "--init", "9,9,20,20", "--out", out];
            args.extend(more);
            refused(dir.path(), &args, b"", &[more.get(1).copied().unwrap_or(out)]);
        }
        refused(dir.path(), &["demo", "--out", "zero.bmp/x"], b"", &["cannot write zero.bmp/x"]);
    }
}
