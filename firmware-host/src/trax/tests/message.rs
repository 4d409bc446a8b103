//! Lines, escapes, streams.

use super::*;
use proptest::prelude::*;
use std::io::Read;

fn read_all(bytes: &[u8]) -> Result<Vec<Message>, TraxError> {
    messages(bytes, 1 << 16)
}

fn messages(input: impl Read, limit: usize) -> Result<Vec<Message>, TraxError> {
    let mut reader = MessageReader::new(input, limit);
    let mut all = Vec::new();
    while let Some(message) = reader.next_message()? {
        all.push(message);
    }
    Ok(all)
}

#[test]
fn lines_as_clients_write_them() {
    let frame = || Message::new(Kind::Frame);
    let cases: [(&str, &[u8], Option<Message>); 20] = [
        (
            "as the C library writes",
            b"@@TRAX:frame \"file:///a.jpg\" ",
            Some(frame().arg("file:///a.jpg")),
        ),
        ("no trailing space", b"@@TRAX:frame \"a\"", Some(frame().arg("a"))),
        ("bare tokens", b"@@TRAX:frame a  b", Some(frame().arg("a").arg("b"))),
        ("carriage return", b"@@TRAX:frame \"a\"\r", Some(frame().arg("a"))),
        ("upper case type", b"@@TRAX:FRAME a", Some(frame().arg("a"))),
        ("status", b"@@TRAX:status a", Some(Message::new(Kind::State).arg("a"))),
        ("alone", b"@@TRAX:quit", Some(Message::new(Kind::Quit))),
        ("spaces only", b"@@TRAX:quit   ", Some(Message::new(Kind::Quit))),
        ("empty argument", b"@@TRAX:frame \"\"", Some(frame().arg(""))),
        (
            "escapes in quotes",
            b"@@TRAX:frame \"a\\\"b\\\\c\\nd\\e\"",
            Some(frame().arg("a\"b\\c\nde")),
        ),
        ("escapes in a bare token", b"@@TRAX:frame a\\ b\\\"", Some(frame().arg("a b\""))),
        ("quote inside a bare token", b"@@TRAX:frame a\"b", Some(frame().arg("a\"b"))),
        (
            "property before an argument",
            b"@@TRAX:frame a.b_1=x=y c",
            Some(frame().arg("c").with("a.b_1", "x=y")),
        ),
        ("quoted property", b"@@TRAX:frame \"k=a b\"", Some(frame().with("k", "a b"))),
        (
            "base64 is no property",
            b"@@TRAX:frame data:image/png;AA==",
            Some(frame().arg("data:image/png;AA==")),
        ),
        ("equals sign first", b"@@TRAX:frame =x", Some(frame().arg("=x"))),
        ("noise", b"loading model", None),
        ("prefix not first", b" @@TRAX:quit", None),
        ("another type", b"@@TRAX:pause now", None),
        ("type with a tail", b"@@TRAX:quit!", None),
    ];
    for (name, line, want) in cases {
        assert_eq!(Message::parse(line), Ok(want), "{name}");
    }
    let long = format!("{}=v", "k".repeat(65));
    let message = Message::parse(format!("@@TRAX:frame {long}").as_bytes()).expect("parses");
    assert_eq!(message, Some(frame().arg(long)), "a key of 65 letters is none");
    let repeated = Message::parse(b"@@TRAX:frame k=1 k=2").expect("parses").expect("message");
    assert_eq!((repeated.property("k"), repeated.property("l")), (Some("2"), None));
}

#[test]
fn malformed_lines_say_what_is_wrong() {
    for (line, want) in [
        (&b"@@TRAX:frame \"a"[..], MessageError::UnclosedQuote { token: 1 }),
        (b"@@TRAX:frame x \"a\\\"", MessageError::UnclosedQuote { token: 2 }),
        (b"@@TRAX:frame \"a\"b", MessageError::AfterQuote { token: 1 }),
        (b"@@TRAX:frame \"a\"\"b\"", MessageError::AfterQuote { token: 1 }),
        (b"@@TRAX:frame a b\\", MessageError::DanglingEscape { token: 2 }),
        (b"@@TRAX:frame a\xFFb", MessageError::NotUtf8 { at: 14 }),
    ] {
        assert_eq!(Message::parse(line), Err(want), "{}", String::from_utf8_lossy(line));
    }
}

#[test]
fn streams_with_noise_and_broken_ends() {
    let stream = b"starting\n\n@@TRAX:frame a\r\n[warn] @@TRAX:quit\n@@TRAX:other\n@@TRAX:quit \n";
    let kinds: Vec<Kind> = read_all(stream).expect("reads").iter().map(|m| m.kind).collect();
    assert_eq!(kinds, [Kind::Frame, Kind::Quit]);
    assert!(read_all(b"").expect("empty").is_empty());
    assert!(read_all(b"noise without an end").expect("noise").is_empty());

    let cut = read_all(b"@@TRAX:frame a\n@@TRAX:fra").expect_err("cut off");
    assert!(matches!(cut, TraxError::CutOff { message: 2 }), "{cut}");
    assert!(!cut.is_input());
    let bad = read_all(b"@@TRAX:frame a\n@@TRAX:frame \"b\n").expect_err("malformed");
    assert_eq!(bad.to_string(), "message 2: token 1: the closing quote is missing");
    assert!(bad.is_input());
}

#[test]
fn long_noise_is_passed_over_and_long_messages_are_refused() {
    let noise = [vec![b'x'; 300_000], b"\n@@TRAX:quit\n".to_vec()].concat();
    assert_eq!(messages(&noise[..], 100).expect("noise").len(), 1);
    let fits = format!("@@TRAX:frame {}\n", "a".repeat(87));
    assert_eq!(messages(fits.as_bytes(), 100).expect("fits").len(), 1);
    for (name, length) in [("one more", 88), ("over several buffers", 300_000)] {
        let long = format!("@@TRAX:frame {}\n@@TRAX:quit\n", "a".repeat(length));
        let e = messages(long.as_bytes(), 100).expect_err(name);
        assert!(e.to_string().contains("message 1: longer than 100 bytes"), "{name}: {e}");
    }
}

/// Gives one byte at a time, with interruptions.
struct Drip<'a>(&'a [u8], bool);

impl Read for Drip<'_> {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        self.1 = !self.1;
        if self.1 {
            return Err(std::io::ErrorKind::Interrupted.into());
        }
        let (Some((first, rest)), Some(slot)) = (self.0.split_first(), out.first_mut()) else {
            return Ok(0);
        };
        *slot = *first;
        self.0 = rest;
        Ok(1)
    }
}

fn message() -> impl Strategy<Value = Message> {
    let kinds = [Kind::Hello, Kind::Initialize, Kind::Frame, Kind::State, Kind::Quit];
    let text = "[ -~\\n\\r\\\\\"=äλ]{0,12}";
    (
        prop::sample::select(kinds.to_vec()),
        // What looks like a property is one: see `Message::arg`.
        prop::collection::vec(text.prop_map(|t: String| format!(":{t}")), 0..4),
        prop::collection::vec(("[A-Za-z0-9._]{1,64}", text), 0..4),
    )
        .prop_map(|(kind, args, properties)| Message { kind, args, properties })
}

proptest! {
    #[test]
    fn what_is_written_is_read_back(all in prop::collection::vec(message(), 0..4)) {
        let mut bytes = Vec::new();
        for m in &all {
            m.encode(&mut bytes);
        }
        prop_assert_eq!(bytes.iter().filter(|&&b| b == b'\n').count(), all.len());
        prop_assert_eq!(&messages(Drip(&bytes, false), 1 << 16).expect("reads"), &all);
        prop_assert_eq!(&read_all(&bytes).expect("reads"), &all);
    }

    #[test]
    fn no_line_panics(line in prop::collection::vec(any::<u8>(), 0..80), prefix: bool) {
        let line = if prefix { [b"@@TRAX:frame ", &line[..]].concat() } else { line };
        let _ = Message::parse(&line);
        let _ = messages(&line[..], 40);
    }
}
