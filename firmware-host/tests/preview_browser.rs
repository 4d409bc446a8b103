//! The preview page in headless Chromium, against a running `tsda run` on the drawn scene: a box is
//! drawn with the mouse, the tracker starts, the overlay follows. Driven over the DevTools protocol.

use serde_json::{Value, json};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tsda_host::render::{Clip, ClipConfig};
use tsda_runtime::BBox;

const CONFIG: &str = r#"
[[source]]
name = "rgb"
sensor = "rgb"
render = { repeat = true, rate = 4.0 }
health = { timeout_s = 30.0, frozen_s = 0 }
[[source]]
name = "thermal"
sensor = "thermal"
render = { repeat = true, rate = 4.0, raw16 = true }
health = { timeout_s = 30.0, frozen_s = 0 }
[output.preview]
bind = "127.0.0.1:0"
[output.metrics]
"#;

/// Longest wait for anything, on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

/// Ends a process that was started here.
struct Started(Child);

impl Drop for Started {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Started {
    /// Starts it and waits for the rest of a line on its standard error; the lines after it are
    /// thrown away.
    fn new(command: &mut Command, prefix: &str) -> (Self, String) {
        let mut child = command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("starts");
        let mut lines = BufReader::new(child.stderr.take().expect("stderr")).lines();
        let started = Self(child);
        let mut log = Vec::new();
        for line in lines.by_ref() {
            let line = line.expect("text");
            if let Some((_, rest)) = line.split_once(prefix) {
                let found = rest.trim().to_owned();
                std::thread::spawn(move || lines.for_each(drop));
                return (started, found);
            }
            log.push(line);
        }
        panic!("no `{prefix}` in {log:#?}");
    }
}

fn get(address: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("connects");
    stream.set_read_timeout(Some(PATIENCE)).expect("timeout");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")
        .expect("asks");
    let mut text = String::new();
    let mut reader = BufReader::new(stream);
    let mut length = None;
    loop {
        let mut line = String::new();
        assert!(reader.read_line(&mut line).expect("head") > 0, "ends early");
        if let Some((name, value)) = line.split_once(':')
            && name.eq_ignore_ascii_case("content-length")
        {
            length = value.trim().parse().ok();
        }
        if line == "\r\n" {
            break;
        }
    }
    reader.take(length.expect("length")).read_to_string(&mut text).expect("body");
    text
}

/// A page of the browser over a WebSocket (RFC 6455, text frames only).
struct Page {
    stream: BufReader<TcpStream>,
    id: u64,
}

impl Page {
    fn open(url: &str) -> Self {
        let (address, path) =
            url.strip_prefix("ws://").and_then(|u| u.split_once('/')).expect("url");
        let mut stream = TcpStream::connect(address).expect("connects");
        stream.set_read_timeout(Some(PATIENCE)).expect("timeout");
        write!(
            stream,
            "GET /{path} HTTP/1.1\r\nHost: {address}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        .expect("asks");
        let mut stream = BufReader::new(stream);
        let mut line = String::new();
        stream.read_line(&mut line).expect("status");
        assert!(line.contains("101"), "{line}");
        while line != "\r\n" {
            line.clear();
            stream.read_line(&mut line).expect("head");
        }
        Self { stream, id: 0 }
    }

    fn send(&mut self, text: &str) {
        let mut frame = vec![0x81];
        match text.len() {
            n @ 0..126 => frame.push(0x80 | n as u8),
            n => {
                frame.push(0x80 | 126);
                frame.extend(u16::try_from(n).expect("short").to_be_bytes());
            }
        }
        // A mask of zeros leaves the text as it is.
        frame.extend([0; 4]);
        frame.extend(text.as_bytes());
        self.stream.get_mut().write_all(&frame).expect("sends");
    }

    fn receive(&mut self) -> Value {
        let mut message = Vec::new();
        loop {
            let mut bytes = |n: usize| {
                let mut part = vec![0; n];
                self.stream.read_exact(&mut part).expect("receives");
                part
            };
            let head = bytes(2);
            let length = match head[1] & 0x7F {
                126 => u64::from(u16::from_be_bytes(bytes(2).try_into().expect("2"))),
                127 => u64::from_be_bytes(bytes(8).try_into().expect("8")),
                n => n.into(),
            };
            let part = bytes(length as usize);
            if head[0] & 0x0F <= 2 {
                message.extend(part);
                if head[0] & 0x80 != 0 {
                    return serde_json::from_slice(&message).expect("json");
                }
            }
        }
    }

    fn call(&mut self, method: &str, params: Value) -> Value {
        self.id += 1;
        let id = self.id;
        self.send(&json!({ "id": id, "method": method, "params": params }).to_string());
        loop {
            let mut answer = self.receive();
            if answer["id"] == id {
                assert!(answer["error"].is_null(), "{method}: {answer}");
                return answer["result"].take();
            }
        }
    }

    fn value(&mut self, script: &str) -> Value {
        let params = json!({ "expression": script, "returnByValue": true });
        self.call("Runtime.evaluate", params)["result"]["value"].take()
    }

    /// Waits until a script gives something other than null and false.
    fn wait(&mut self, script: &str) -> Value {
        let end = Instant::now() + PATIENCE;
        loop {
            let value = self.value(script);
            if !matches!(value, Value::Null | Value::Bool(false)) {
                return value;
            }
            if Instant::now() > end {
                let state = self.value("document.body.innerText + JSON.stringify(last)");
                panic!("never: {script}; {state}");
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn mouse(&mut self, kind: &str, at: (f64, f64)) {
        let buttons = u8::from(kind != "mouseReleased");
        let params = json!({ "type": kind, "x": at.0, "y": at.1, "button": "left",
            "buttons": buttons, "clickCount": 1 });
        self.call("Input.dispatchMouseEvent", params);
    }

    fn screenshot(&mut self, path: &Path) {
        let picture = self.call("Page.captureScreenshot", json!({ "format": "png" }));
        let text = picture["data"].as_str().expect("data");
        std::fs::write(path, tsda_host::trax::decode_base64(text).expect("base64")).expect("write");
    }
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("list").iter().map(|v| v.as_f64().expect("number")).collect()
}

#[test]
fn a_box_drawn_in_the_browser_is_followed() {
    let browser = ["chromium", "chromium-browser", "google-chrome"].into_iter().find(|name| {
        let mut command = Command::new(name);
        command.arg("--version").stdout(Stdio::null()).stderr(Stdio::null());
        command.status().is_ok_and(|s| s.success())
    });
    let Some(browser) = browser else {
        println!("skipped: no chromium");
        return;
    };
    let dir = tempfile::tempdir().expect("temp");
    let config = dir.path().join("host.toml");
    std::fs::write(&config, CONFIG).expect("config");
    let mut program = Command::new(env!("CARGO_BIN_EXE_tsda"));
    let (_program, address) =
        Started::new(program.args(["run", "--config"]).arg(&config), "preview at http://");

    let mut command = Command::new(browser);
    command
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"])
        .args(["--no-first-run", "--remote-debugging-port=0", "--window-size=1280,960"])
        .arg(format!("--user-data-dir={}", dir.path().join("profile").display()))
        .arg(format!("http://{address}/"));
    let (_browser, socket) = Started::new(&mut command, "DevTools listening on ");
    let devtools = socket.strip_prefix("ws://").and_then(|s| s.split('/').next()).expect("address");
    let end = Instant::now() + PATIENCE;
    let page = loop {
        let pages: Value = serde_json::from_str(&get(devtools, "/json/list")).expect("pages");
        let page = pages.as_array().into_iter().flatten().find(|p| p["type"] == "page");
        if let Some(url) = page.and_then(|p| p["webSocketDebuggerUrl"].as_str()) {
            break url.to_owned();
        }
        assert!(Instant::now() < end, "no page in {pages}");
        std::thread::sleep(Duration::from_millis(100));
    };
    let mut page = Page::open(&page);

    // Both sensors are shown; the drawn scene's own target is given up by the button.
    page.wait("[...document.querySelectorAll('figcaption')].length === 2 && last !== null");
    page.wait("document.querySelectorAll('figure')[1].querySelector('canvas').width > 300");
    page.value("document.getElementById('stop').click()");
    page.wait("last.state === 'idle'");

    // What the page shows right now, and where that is in the window.
    page.value(
        "window.shown = []; const old = Sensor.prototype.draw; \
         Sensor.prototype.draw = function () { old.call(this); if (this.record) window.shown[this.index] \
         = { record: this.record, size: this.size }; }",
    );
    let clip = Clip::new(ClipConfig::default());
    let truth = |record: &Value| {
        let n = record["sequence"].as_u64().expect("sequence") as usize;
        clip.truth(n % clip.frames())
    };
    let shown = page.wait("window.shown[0]");
    let canvas = numbers(&page.value(
        "(() => { const r = document.querySelector('figure[data-source=rgb] canvas')\
         .getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; })()",
    ));
    let (size, b) = (numbers(&shown["size"]), truth(&shown["record"]));
    let at = |x: f32, y: f32| {
        let part = (f64::from(x) / size[0], f64::from(y) / size[1]);
        (canvas[0] + part.0 * canvas[2], canvas[1] + part.1 * canvas[3])
    };
    page.mouse("mousePressed", at(b.x, b.y));
    page.mouse("mouseMoved", at(b.x + b.w / 2.0, b.y + b.h / 2.0));
    page.mouse("mouseReleased", at(b.x + b.w, b.y + b.h));
    page.wait("last.state === 'tracking' && last.box && last.score < 1");

    // The overlay is where the target is, and moves.
    let (mut boxes, mut overlap) = (Vec::new(), 0.0);
    let mut seen = Value::Null;
    while boxes.len() < 8 {
        let shown = page.wait("window.shown[0].record.box && window.shown[0].record");
        if shown["frame"] != seen {
            seen = shown["frame"].clone();
            let b: Vec<f32> = numbers(&shown["box"]).iter().map(|v| *v as f32).collect();
            let b = BBox::new(b[0], b[1], b[2], b[3]);
            overlap += truth(&shown).iou(&b) / 8.0;
            boxes.push(b);
        }
    }
    let moved = (boxes[7].x - boxes[0].x).abs() + (boxes[7].y - boxes[0].y).abs();
    println!("overlap {overlap:.3}, moved {moved:.1} pixels");
    assert!(overlap > 0.3 && moved > 2.0, "{overlap} {moved}: {boxes:?}");

    page.value("document.querySelector('figure[data-source=thermal] button').click()");
    page.wait("last.source === 'thermal' && last.box");
    page.wait("document.querySelector('figure[data-source=thermal]').classList.contains('active')");
    let metrics = get(&address, "/metrics");
    assert!(metrics.contains("tsda_switches_total{reason=\"command\"} 1"), "{metrics}");

    let picture = Path::new(env!("CARGO_TARGET_TMPDIR")).join("preview.png");
    page.screenshot(&picture);
    println!("screenshot: {}", picture.display());
    assert!(std::fs::metadata(&picture).expect("kept").len() > 10_000);
}
