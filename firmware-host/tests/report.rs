//! `tsda report` as a program: the page of a small evaluation with the embedded model, and that page
//! in a real browser where one is installed.
#![cfg(feature = "eval")]

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn tsda(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_tsda"))
        .args(args)
        .current_dir(dir)
        .output()
        .expect("the program runs")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

const FRAMES: u32 = 24;

/// Two LasHeR sequences: `walks` shows a bright square on texture that moves two pixels per frame;
/// in `jumps` it appears in the opposite corner from frame 6 on, where no tracker looks.
fn lasher(dir: &Path) {
    for name in ["walks", "jumps"] {
        let own = dir.join("set/TestingSet/testingset").join(name);
        for (folder, bright) in [("visible", 230u8), ("infrared", 200)] {
            fs::create_dir_all(own.join(folder)).expect("mkdir");
            let mut boxes = String::new();
            for i in 0..FRAMES {
                let jumped = name == "jumps" && i >= 6;
                let (left, top) = if jumped { (280, 210) } else { (40 + 2 * i, 36) };
                image::GrayImage::from_fn(320, 240, |x, y| {
                    let inside = (left..left + 20).contains(&x) && (top..top + 20).contains(&y);
                    image::Luma([if inside { bright } else { ((x * 7 + y * 13) % 60) as u8 }])
                })
                .save(own.join(folder).join(format!("{i:05}.png")))
                .expect("png");
                boxes += &format!("{left},{top},20,20\n");
            }
            fs::write(own.join(format!("{folder}.txt")), &boxes).expect("txt");
        }
        let flags = "0,1,0,0,1,0,0,0,0,0,0,1,0,1,0,0,0,1,0";
        fs::create_dir_all(dir.join("set/AttriSeqsTxt")).expect("mkdir");
        fs::write(dir.join(format!("set/AttriSeqsTxt/{name}.txt")), flags).expect("flags");
    }
}

/// The dataset evaluated with a baseline, and the page of it: `page.html` in the folder.
fn evaluated(dir: &Path) -> String {
    lasher(dir);
    let eval = ["eval", "--dataset", "lasher:set@test", "--out", "out", "--baselines"];
    let protocols = ["--protocol", "rgb2t", "--protocol", "switch:6"];
    let output = tsda(dir, &[&eval[..], &protocols].concat());
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let bundle = tsda_host::model::embedded().expect("the embedded bundle");
    fs::write(dir.join("own.tsda"), bundle).expect("bundle");
    let report = ["report", "--results", "out", "--dataset", "lasher:set@test", "--bundle"];
    let more = ["own.tsda", "--convention", "lasher", "--out", "page.html"];
    let output = tsda(dir, &[&report[..], &more].concat());
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    fs::read_to_string(dir.join("page.html")).expect("the page")
}

/// Values of an attribute in the page.
fn values<'a>(page: &'a str, attribute: &str) -> Vec<&'a str> {
    let start = format!(" {attribute}=\"");
    page.split(start.as_str()).skip(1).filter_map(|rest| rest.split('"').next()).collect()
}

#[test]
fn the_page_of_an_evaluation_is_whole_and_loads_nothing() {
    let dir = tempfile::tempdir().expect("temp");
    let page = evaluated(dir.path());
    for part in [
        "Protocol rgb2t",
        "Protocol switch:6",
        // Curves, with one line per tracker.
        "Success",
        "Precision",
        "Normalised precision",
        "class=\"c s0\"",
        // Tables with the best value marked.
        "<table>",
        "class=\"best\"",
        // By attribute, by number of switches, after switches.
        "Attribute",
        "Number of sensor switches",
        "Recovery after a sensor switch",
        // The failure, in pictures.
        "Where nano fails",
        "<h4>jumps</h4>",
        "data:image/jpeg;base64,",
        // Histograms.
        "Scores and times of single frames",
        "id=\"model\"",
        "Model card",
    ] {
        assert!(page.contains(part), "no {part}");
    }
    // Radar or bars of attributes.
    assert!(page.contains("<polygon") || page.contains("<rect"), "no chart of groups");
    // What a file could load stands in these.
    for attribute in ["src", "href", "xlink:href", "action", "data", "poster", "srcset"] {
        for value in values(&page, attribute) {
            assert!(value.starts_with("data:") || value.starts_with('#'), "{attribute}={value}");
        }
    }
    for loading in ["<script", "<link", "<iframe", "@import", "url("] {
        assert!(!page.contains(loading), "{loading}");
    }
    // Nothing beside it either: the page is one file.
    let beside: BTreeSet<_> =
        fs::read_dir(dir.path()).expect("list").map(|e| e.expect("entry").file_name()).collect();
    assert_eq!(beside, ["out", "own.tsda", "page.html", "set"].map(Into::into).into());
    // `tsda eval` writes the same kind of page by itself.
    let own = fs::read_to_string(dir.path().join("out/report.html")).expect("the page of eval");
    assert!(own.contains("Where nano fails") && own.contains("Model card"));
}

#[test]
fn what_no_page_can_be_made_of_ends_with_2_and_one_line() {
    let dir = tempfile::tempdir().expect("temp");
    lasher(dir.path());
    let results = dir.path().join("short/rgb2t");
    fs::create_dir_all(&results).expect("mkdir");
    fs::write(results.join("walks.txt"), "1,2,3,4\n1,2,3,4\n").expect("boxes");
    fs::write(results.join("jumps.txt"), "1,2,3,4\n1,2,x,4\n").expect("boxes");
    fs::create_dir(dir.path().join("empty")).expect("mkdir");
    fs::write(dir.path().join("no.json"), "{\"version\": []}").expect("json");
    let dataset = ["--dataset", "lasher:set@test"];
    for (args, words) in [
        (&["--results", "nowhere"][..], &["nowhere", "comparison.json"][..]),
        (&["--results", "no.json"], &["no.json", "not a comparison"]),
        (&["--results", "empty", dataset[0], dataset[1]], &["empty"]),
        (&["--results", "short", "--dataset", "lasher:nowhere"], &["nowhere"]),
        (&["--results", "short", "--dataset", "what:set"], &["what"]),
        (&["--results", "short", dataset[0], dataset[1]], &["jumps.txt, line 2", "'x'"]),
        (&["--results", "short", dataset[0], dataset[1], "--bundle", "no.json"], &["no.json"]),
    ] {
        let output = tsda(dir.path(), &[&["report", "--out", "page.html"], args].concat());
        let text = said(&output);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {text}");
        assert_eq!(text.trim_end().lines().count(), 1, "{args:?}: {text}");
        for word in words {
            assert!(text.contains(word), "{args:?}: no {word} in {text}");
        }
        assert!(!dir.path().join("page.html").exists(), "{args:?}");
    }
    // A result that ends too early.
    fs::write(results.join("jumps.txt"), "1,2,3,4\n1,2,3,4\n").expect("boxes");
    let report = ["report", "--results", "short", "--out", "page.html"];
    let output = tsda(dir.path(), &[&report[..], &dataset].concat());
    let text = said(&output);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("jumps") && text.contains("24") && text.contains('2'), "{text}");
}

/// A Chromium, from `CHROMIUM` or `PATH`.
fn chromium() -> Option<PathBuf> {
    if let Some(path) = std::env::var_os("CHROMIUM") {
        return Some(path.into());
    }
    let path = std::env::var_os("PATH")?;
    ["chromium", "chromium-browser", "google-chrome"].into_iter().find_map(|name| {
        std::env::split_paths(&path).map(|folder| folder.join(name)).find(|p| p.is_file())
    })
}

#[test]
fn a_browser_draws_the_page_and_asks_nobody_for_anything() {
    let Some(browser) = chromium() else {
        eprintln!("skipped: no Chromium (CHROMIUM, or chromium, google-chrome on PATH)");
        return;
    };
    let dir = tempfile::tempdir().expect("temp");
    evaluated(dir.path());
    let net = dir.path().join("net.json");
    let shot = dir.path().join("page.png");
    let option = |name: &str, path: &Path| format!("--{name}={}", path.display());
    let output = Command::new(&browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"])
        // The browser's own traffic is not the page's.
        .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
        .args(["--no-first-run", "--hide-scrollbars", "--enable-logging=stderr", "--v=0"])
        .args(["--force-prefers-reduced-motion", "--window-size=1280,5200"])
        .arg(option("user-data-dir", &dir.path().join("profile")))
        .arg(option("log-net-log", &net))
        .arg(option("screenshot", &shot))
        .arg(format!("file://{}", dir.path().join("page.html").display()))
        .output()
        .expect("the browser starts");
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && shot.is_file(), "no screenshot: {log}");
    if let Some(keep) = std::env::var_os("TSDA_KEEP_SCREENSHOT") {
        fs::copy(&shot, keep).expect("a copy of the screenshot");
    }

    // Scripts, policies broken and files missing are told to the console.
    let complaints: Vec<&str> = log.lines().filter(|l| l.contains("CONSOLE")).collect();
    assert!(complaints.is_empty(), "{complaints:#?}");
    // Every request of a page is in the network log with its address.
    let net = fs::read_to_string(&net).expect("the network log");
    assert!(net.contains("\"constants\""), "no network log");
    let page = format!("file://{}", dir.path().join("page.html").display());
    for url in net.split("\"url\":\"").skip(1).filter_map(|rest| rest.split('"').next()) {
        let own = url == page || url.starts_with("data:");
        let of_browser = BROWSER_HOSTS.iter().any(|h| url.contains(h)) || url.starts_with("chrome");
        assert!(own || of_browser, "the page asked for {url}");
    }

    let picture = image::open(&shot).expect("a PNG").into_rgb8();
    assert_eq!(picture.dimensions(), (1280, 5200));
    let near = |colour: [u8; 3]| {
        let close = |p: &image::Rgb<u8>| p.0.iter().zip(colour).all(|(a, b)| a.abs_diff(b) <= 8);
        picture.pixels().filter(|p| close(p)).count()
    };
    let colours: BTreeSet<[u8; 3]> = picture.pixels().map(|p| p.0.map(|v| v >> 3)).collect();
    assert!(colours.len() > 100, "{} colours: nearly blank", colours.len());
    let all = picture.pixels().len();
    assert!((all / 2..all).contains(&near([255, 255, 255])), "not a light page");
    // The first three trackers' curves, the mark of the best value, text.
    for (what, colour, least) in [
        ("curve of the first tracker", [0x00, 0x72, 0xb2], 1000),
        ("curve of the second tracker", [0xd5, 0x5e, 0x00], 1000),
        ("curve of the third tracker", [0x00, 0x8f, 0x6b], 500),
        ("best values", [0xff, 0xf3, 0xc4], 2000),
        ("text", [0x1b, 0x1f, 0x24], 2000),
        ("box of the truth in a picture", [0x3d, 0xff, 0x9e], 50),
    ] {
        let found = near(colour);
        assert!(found >= least, "{what}: {found} pixels of {colour:?}");
    }
}

/// Whom a Chromium without background work still talks to for itself.
const BROWSER_HOSTS: [&str; 3] = ["google.com/", "googleapis.com/", "gvt1.com/"];
