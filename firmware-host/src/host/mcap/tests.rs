use super::writer::Schema;
use super::*;
use crate::switch::Condition;
use serde_json::Value;
use tsda_runtime::Modality;

/// A message that was read.
#[derive(Clone, Debug, PartialEq)]
struct Message {
    topic: String,
    time: u64,
    data: Vec<u8>,
}

/// Reads as readers do that are given a damaged file: record by record until nothing whole is left.
fn read(bytes: &[u8]) -> Vec<Message> {
    let (mut topics, mut found) = (Vec::new(), Vec::new());
    if let Some(rest) = bytes.strip_prefix(b"\x89MCAP0\r\n") {
        records(rest, &mut topics, &mut found);
    }
    found
}

fn records(mut rest: &[u8], topics: &mut Vec<String>, found: &mut Vec<Message>) {
    let number = |b: &[u8]| b.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
    while rest.len() >= 9 {
        let (kind, length) = (rest[0], number(&rest[1..9]) as usize);
        let Some(content) = rest[9..].get(..length) else { return };
        rest = &rest[9 + length..];
        match kind {
            4 => {
                let n = number(&content[4..8]) as usize;
                assert_eq!(number(&content[..2]) as usize, topics.len());
                topics.push(String::from_utf8(content[8..8 + n].to_vec()).expect("text"));
            }
            5 => found.push(Message {
                topic: topics[number(&content[..2]) as usize].clone(),
                time: number(&content[6..14]),
                data: content[22..].to_vec(),
            }),
            6 => {
                let inner = &content[40..];
                assert_eq!(number(&content[16..24]) as usize, inner.len());
                assert_eq!(number(&content[24..28]), u64::from(crc32fast::hash(inner)));
                records(inner, topics, found);
            }
            15 => return,
            _ => {}
        }
    }
}

fn record(frame: u64, source: usize) -> FrameRecord {
    FrameRecord {
        frame,
        at: Duration::from_millis(40 * frame),
        capture: None,
        source,
        size: (64, 48),
        sequence: 0,
        condition: Condition::Good,
        target: None,
        latency: Duration::ZERO,
        tracking: Duration::ZERO,
        skipped: 0,
        allocations: 0,
    }
}

fn sources() -> Vec<SourceInfo> {
    ["rgb", "far / infrared"]
        .map(|name| SourceInfo { name: name.into(), sensor: Modality::Rgb })
        .to_vec()
}

fn files(dir: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> =
        fs::read_dir(dir).expect("dir").map(|e| e.expect("entry").path()).collect();
    found.sort();
    found
}

#[test]
fn a_file_cut_anywhere_is_read_up_to_the_cut() {
    let schema = Schema { name: "x", text: "{}" };
    let topics = ["a", "b"].map(|name| Topic { name: name.into(), schema: 0 });
    let mut writer = Writer::new(Vec::new(), &[schema], &topics, 64).expect("begins");
    let (mut want, mut ends) = (Vec::new(), vec![(0, 0)]);
    for i in 0..12u64 {
        let (topic, data) = ((i % 2) as usize, vec![i as u8; 20 + i as usize]);
        writer.message(topic, 1000 + i, &data);
        want.push(Message { topic: topics[topic].name.clone(), time: 1000 + i, data });
        if i % 3 == 2 {
            writer.flush().expect("flushes");
            ends.push((writer.size() as usize, want.len()));
        }
    }
    let bytes = writer.finish().expect("finishes");
    assert_eq!(read(&bytes), want);
    for cut in 0..bytes.len() {
        let found = read(&bytes[..cut]);
        let sure = ends.iter().rev().find(|e| e.0 <= cut).expect("start").1;
        assert!(found.len() >= sure, "cut at {cut}: {} of {sure}", found.len());
        assert_eq!(found, want[..found.len()], "cut at {cut}");
    }
}

#[test]
fn pictures_boxes_and_events_are_recorded() {
    let dir = tempfile::tempdir().expect("temp");
    let config = McapConfig { dir: "here".into(), ..McapConfig::default() };
    let mut recorder = Recorder::open(&config, dir.path().to_path_buf(), sources()).expect("opens");
    recorder.event(&Event { at: Duration::ZERO, frame: 0, kind: crate::host::EventKind::Started });
    recorder.frame(&record(0, 0), &Views(&[]));
    recorder.frame(&record(1, 1), &Views(&[]));
    recorder.finish();
    assert_eq!(recorder.dropped(), 0);
    let [file] = &files(dir.path())[..] else { panic!("one file") };
    let messages = read(&fs::read(file).expect("reads"));
    let topics: Vec<&str> = messages.iter().map(|m| m.topic.as_str()).collect();
    let want = [
        "/tracker/event",
        "/rgb/annotations",
        "/tracker/record",
        "/rgb/annotations",
        "/far___infrared/annotations",
        "/tracker/record",
    ];
    assert_eq!(topics, want);
    assert_eq!(messages[5].time - messages[1].time, 40_000_000);
    let last: Value = serde_json::from_slice(&messages[5].data).expect("json");
    assert_eq!(last["source"], "far / infrared");
}

#[test]
fn old_files_make_room_for_new_ones() {
    let dir = tempfile::tempdir().expect("temp");
    let other = dir.path().join("tsda-notes.mcap");
    fs::write(&other, vec![0; 3 << 20]).expect("write");
    let old = dir.path().join("tsda-20200101-000000-0000.mcap");
    fs::write(&old, vec![0; 2 << 20]).expect("write");
    let config = McapConfig { dir: "x".into(), file_mb: 1, total_mb: 3, ..McapConfig::default() };
    let mut recorder = Recorder::open(&config, dir.path().to_path_buf(), sources()).expect("opens");
    let what = "x".repeat(64 << 10);
    for _ in 0..70 {
        let kind = crate::host::EventKind::Refused { what: what.clone() };
        recorder.event(&Event { at: Duration::ZERO, frame: 0, kind });
    }
    recorder.finish();
    assert_eq!(recorder.dropped(), 0);
    let found = files(dir.path());
    let sizes: Vec<u64> =
        found.iter().filter(|f| is_ours(f)).map(|f| f.metadata().expect("size").len()).collect();
    assert!(other.exists() && !old.exists(), "{found:?}");
    assert!((2..=3).contains(&sizes.len()), "{sizes:?}");
    assert!(
        sizes.iter().sum::<u64>() <= 4 << 20 && sizes.iter().all(|s| *s < 2 << 20),
        "{sizes:?}"
    );
}

#[test]
fn the_next_file_begins_with_nothing_of_the_last() {
    let schema = Schema { name: "x", text: "{}" };
    let topics = ["a", "b"].map(|name| Topic { name: name.into(), schema: 0 });
    let fill = |writer: &mut Writer<Vec<u8>>| {
        for i in 0..5u64 {
            writer.message((i % 2) as usize, 1000 + i, &[i as u8; 40]);
            if i == 2 {
                writer.flush().expect("flushes");
            }
        }
    };
    let new = || Writer::new(Vec::new(), &[schema], &topics, 64).expect("begins");
    let mut writer = new();
    writer.message(1, 7, b"before");
    let first = writer.next(Vec::new()).expect("goes on");
    assert_eq!(read(&first).len(), 1);
    fill(&mut writer);
    assert_eq!((writer.chunks(), writer.unflushed() > 0), (1, true));
    let second = writer.finish().expect("finishes");
    let mut fresh = new();
    fill(&mut fresh);
    assert_eq!(second, fresh.finish().expect("finishes"));
}

#[test]
fn dates_are_those_of_the_calendar() {
    for (seconds, text) in [
        (0, "19700101-000000"),
        (951_782_399, "20000228-235959"),
        (951_782_400, "20000229-000000"),
        (1795384800, "20261122-220000"),
        (4_107_542_400, "21000301-000000"),
    ] {
        assert_eq!(date(seconds), text);
    }
}
