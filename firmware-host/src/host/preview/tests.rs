use super::super::control::channel;
use super::super::output::TargetRecord;
use super::*;
use crate::switch::Condition;
use std::io::{BufRead as _, BufReader, Read as _};
use std::net::TcpStream;
use std::sync::mpsc::Receiver as Inbox;
use tsda_runtime::{BBox, Modality, TrackState};

fn preview(token: Option<&str>) -> (Preview, Inbox<Command>) {
    let sources = ["front", "wärme"]
        .map(|name| SourceInfo { name: name.into(), sensor: Modality::Rgb })
        .to_vec();
    let (commands, inbox) = channel();
    let access = Access::new("output.preview", "127.0.0.1:0", token, None).expect("access");
    let config = PreviewConfig::default();
    (Preview::open(&config, access, sources, commands, None).expect("opens"), inbox)
}

/// Status and everything after it.
fn ask(preview: &Preview, text: &str) -> (u16, String) {
    let address = preview.address().expect("listens");
    let mut stream = TcpStream::connect(address).expect("connects");
    stream.set_read_timeout(Some(Duration::from_secs(10))).expect("timeout");
    let text = text.replacen("\r\n", &format!("\r\nHost: {address}\r\nConnection: close\r\n"), 1);
    stream.write_all(text.as_bytes()).expect("asks");
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).expect("answers");
    let answer = String::from_utf8_lossy(&answer).into_owned();
    let status = answer.split(' ').nth(1).and_then(|s| s.parse().ok()).expect("status");
    (status, answer)
}

fn post(body: &str, kind: &str) -> String {
    let length = body.len();
    format!(
        "POST /command HTTP/1.1\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n\r\n{body}"
    )
}

fn record(frame: u64) -> FrameRecord {
    FrameRecord {
        frame,
        at: Duration::from_millis(40 * frame),
        capture: None,
        source: 0,
        size: (64, 48),
        sequence: 0,
        condition: Condition::Good,
        target: Some(TargetRecord {
            bbox: BBox::new(1.0, 2.0, 3.0, 4.0),
            score: 0.5,
            confidence: None,
            state: TrackState::Tracking,
            predicted: false,
            redetected: false,
            temperature: None,
        }),
        latency: Duration::from_millis(7),
        tracking: Duration::from_millis(6),
        skipped: 0,
        allocations: 0,
    }
}

#[test]
fn pages_and_refusals() {
    let (preview, _inbox) = preview(None);
    let (status, page) = ask(&preview, "GET / HTTP/1.1\r\n\r\n");
    assert_eq!(status, 200);
    assert!(page.contains("Content-Security-Policy: default-src 'none'"), "{page:.400}");
    assert!(!PAGE.contains("https://") && !PAGE.contains("http://"), "nothing from elsewhere");
    let (_, info) = ask(&preview, "GET /info HTTP/1.1\r\n\r\n");
    assert!(info.contains(r#""name":"wärme""#), "{info}");
    for (text, status) in [
        ("GET /nothing HTTP/1.1\r\n\r\n", 404),
        ("GET /metrics HTTP/1.1\r\n\r\n", 404),
        ("GET /picture?source=2 HTTP/1.1\r\n\r\n", 404),
        ("GET /command HTTP/1.1\r\n\r\n", 405),
        ("POST / HTTP/1.1\r\n\r\n", 405),
        ("PUT / HTTP/1.1\r\n\r\n", 405),
        ("GET / HTTP/1.1\r\nOrigin: http://other.example\r\n\r\n", 403),
    ] {
        assert_eq!(ask(&preview, text).0, status, "{text}");
    }
}

#[test]
fn commands_take_the_same_way_as_all_others() {
    let (preview, inbox) = preview(None);
    let json = "application/json";
    let select = r#"{"cmd":"select","box":[1,2,3,4],"source":"front"}"#;
    assert_eq!(ask(&preview, &post(select, json)).0, 200);
    let want = Command::Select { bbox: [1.0, 2.0, 3.0, 4.0], source: Some("front".into()) };
    assert_eq!(inbox.try_recv(), Ok(want));
    for (body, kind, status) in [
        (select, "text/plain", 415),
        (r#"{"cmd":"quit"}"#, json, 403),
        (r#"{"cmd":"dance"}"#, json, 400),
        ("", json, 400),
        (&"x".repeat(5000), json, 413),
    ] {
        assert_eq!(ask(&preview, &post(body, kind)).0, status, "{body:.40}");
    }
    assert!(inbox.try_recv().is_err());
    drop(inbox);
    assert_eq!(ask(&preview, &post(r#"{"cmd":"stop"}"#, json)).0, 503);
}

#[test]
fn the_token_is_asked_for() {
    let (preview, _inbox) = preview(Some("a-long-enough-token"));
    assert_eq!(ask(&preview, "GET / HTTP/1.1\r\n\r\n").0, 401);
    assert_eq!(ask(&preview, "GET /?token=a-long-enough-token HTTP/1.1\r\n\r\n").0, 200);
    assert_eq!(ask(&preview, "GET /picture?source=0&token=b HTTP/1.1\r\n\r\n").0, 401);
    assert_eq!(ask(&preview, &post(r#"{"cmd":"stop"}"#, "application/json")).0, 401);
}

#[test]
fn records_are_streamed() {
    let (mut preview, _inbox) = preview(None);
    let address = preview.address().expect("listens");
    let mut stream = TcpStream::connect(address).expect("connects");
    write!(stream, "GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("asks");
    stream.set_read_timeout(Some(Duration::from_secs(10))).expect("timeout");
    let mut lines = BufReader::new(stream).lines().map(|l| l.expect("line"));
    assert!(lines.next().expect("status").contains("200"));
    // From the moment somebody listens.
    while preview.shared.listeners.load(Ordering::Relaxed) == 0 {
        thread::sleep(Duration::from_millis(2));
    }
    thread::sleep(Duration::from_millis(20));
    for frame in 0..3 {
        preview.frame(&record(frame), &Views(&[]));
    }
    let frames: Vec<u64> = lines
        .filter_map(|l| Some(serde_json::from_str::<serde_json::Value>(l.strip_prefix("data: ")?)))
        .map(|l| l.expect("json")["frame"].as_u64().expect("frame"))
        .take(3)
        .collect();
    assert_eq!(frames, [0, 1, 2]);
    assert_eq!(preview.dropped(), 0);
    preview.finish();
    // The listening thread ends with the connection that wakes it up.
    let end = Instant::now() + Duration::from_secs(10);
    while TcpStream::connect(address).is_ok() {
        assert!(Instant::now() < end, "still listening");
        thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn headers_hold_ascii_only() {
    let text = ascii("{\"source\":\"wärme \u{1F525}\"}\n".as_bytes());
    assert_eq!(text, r#"{"source":"w\u00e4rme \ud83d\udd25"}"#);
    let back: serde_json::Value = serde_json::from_str(&text).expect("json");
    assert_eq!(back["source"], "wärme \u{1F525}");
}
