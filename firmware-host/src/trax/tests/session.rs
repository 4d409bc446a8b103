//! Whole sessions on streams in memory.

use super::*;
use proptest::prelude::*;
use tsda_runtime::{
    BBox, BoxError, FrameView, Modality, Track, TrackError, TrackState, localise::Flag,
    tracker::check_box,
};

/// Follows by moving a pixel to the right per frame, and remembers what it was given.
#[derive(Default)]
struct Fake {
    bbox: Option<BBox>,
    /// Calls in order: `init rgb 12x8 1,2,3,4`.
    calls: Vec<String>,
    score: f32,
    confidence: Option<f32>,
    state: Option<TrackState>,
    frame: u64,
}

fn call(what: &str, view: &FrameView<'_>, modality: Modality, b: BBox) -> String {
    format!("{what} {modality} {}x{} {},{},{},{}", view.width(), view.height(), b.x, b.y, b.w, b.h)
}

impl Follow for Fake {
    fn init(&mut self, view: &FrameView<'_>, b: BBox, m: Modality) -> Result<(), TrackError> {
        check_box(&b, view.width(), view.height())?;
        self.calls.push(call("init", view, m, b));
        self.bbox = Some(b);
        self.frame = 0;
        Ok(())
    }

    fn update(&mut self, view: &FrameView<'_>, m: Modality) -> Result<Track, TrackError> {
        let b = self.bbox.ok_or(TrackError::NoTarget)?;
        self.calls.push(call("update", view, m, b));
        let bbox = BBox { x: b.x + 1.0, ..b };
        if bbox.x > 1e6 {
            return Err(TrackError::NotFinite { engine: "fake", what: "score map" });
        }
        self.bbox = Some(bbox);
        self.frame += 1;
        Ok(Track {
            bbox,
            score: self.score,
            confidence: self.confidence,
            state: self.state.unwrap_or(TrackState::Tracking),
            flag: Flag::Normal,
            wrote_memory: false,
            frame: self.frame,
            missing: 0,
            redetected: false,
        })
    }

    fn place(&mut self, b: BBox) -> Result<(), TrackError> {
        self.calls.push(format!("place {},{},{},{}", b.x, b.y, b.w, b.h));
        self.bbox = Some(b);
        Ok(())
    }
}

/// A colourful picture in a message.
fn color(width: u32, height: u32) -> String {
    let picture = pattern(width, height);
    format!("image:{width};{height};rgb;{}", encode_base64(picture.as_raw()))
}

/// A grey one.
fn grey(width: usize, height: usize) -> String {
    let pixels: Vec<u8> = (0..width * height).map(|i| (i * 7 % 251) as u8).collect();
    format!("image:{width};{height};gray8;{}", encode_base64(&pixels))
}

struct Played {
    result: Result<Summary, TraxError>,
    /// Lines of the server.
    lines: Vec<String>,
    calls: Vec<String>,
}

impl Played {
    /// Regions of the answers.
    fn regions(&self) -> Vec<&str> {
        self.lines
            .iter()
            .filter_map(|l| l.strip_prefix("@@TRAX:state \"")?.split('"').next())
            .collect()
    }

    fn reason(&self) -> Option<&str> {
        self.lines.last()?.strip_prefix("@@TRAX:quit \"trax.reason=")?.strip_suffix("\" ")
    }
}

fn play_with(options: &Options, fake: &mut Fake, input: &[u8]) -> Played {
    let mut output = Vec::new();
    let result = serve(input, &mut output, fake, options);
    let text = String::from_utf8(output).expect("text");
    assert!(text.ends_with('\n'), "{text}");
    Played {
        result,
        lines: text.lines().map(str::to_owned).collect(),
        calls: std::mem::take(&mut fake.calls),
    }
}

/// Plays lines, with `C` for a colour picture of 12 x 8 and `G` for a grey one of 24 x 16.
fn play(options: &Options, lines: &[&str]) -> Played {
    let (c, g) = (color(12, 8), grey(24, 16));
    let text: String = lines
        .iter()
        .map(|l| format!("@@TRAX:{}\n", l.replace("$C", &c).replace("$G", &g)))
        .collect();
    play_with(options, &mut Fake { score: 0.75, ..Fake::default() }, text.as_bytes())
}

fn version(number: u8) -> Options {
    Options { version: Version::new(number).expect("version"), ..Options::default() }
}

fn both(policy: &str) -> Options {
    Options {
        channels: Channels::Both,
        policy: policy.parse().expect("policy"),
        ..Options::default()
    }
}

#[test]
fn hello_of_every_version() {
    for number in 1..=4 {
        let played = play(&version(number), &["quit"]);
        assert_eq!(
            played.lines,
            [format!(
                "@@TRAX:hello \"trax.version={number}\" \"trax.name=TSDA-Track\" \
                 \"trax.family=TSDA\" \"trax.description=\" \"trax.image=path;memory;buffer;\" \
                 \"trax.region=rectangle;polygon;mask;\" \"trax.channels=color;\" "
            )]
        );
        let summary = Summary { targets: 0, frames: 0, end: End::Quit };
        assert_eq!(played.result.expect("session"), summary);
    }
    assert!(Version::new(0).is_none() && Version::new(5).is_none());
    let options = Options { description: "a \"b\"\nc".into(), ..both("auto") };
    let line = &play(&options, &["quit"]).lines[0];
    assert!(line.contains(r#""trax.description=a \"b\"\nc""#), "{line}");
    assert!(line.contains("\"trax.channels=color;ir;\""), "{line}");
}

const FIRST: &str = "@@TRAX:state \"1.0000,2.0000,3.0000,4.0000\" \"confidence=1.000000\" \
                     \"state=tracking\" \"modality=rgb\" ";
const SECOND: &str = "@@TRAX:state \"2.0000,2.0000,3.0000,4.0000\" \"confidence=0.750000\" \
                      \"state=tracking\" \"modality=rgb\" ";

#[test]
fn a_session_of_version_4() {
    let played = play(
        &version(4),
        &["initialize \"1,2,3,4\" \"some.key=value\"", "frame $C", "frame $C \"k=v\"", "quit"],
    );
    assert_eq!(played.lines[1..], [FIRST, SECOND]);
    assert_eq!(played.calls, ["init rgb 12x8 1,2,3,4", "update rgb 12x8 1,2,3,4"]);
    let summary = Summary { targets: 1, frames: 2, end: End::Quit };
    assert_eq!(played.result.expect("session"), summary);
}

#[test]
fn a_session_of_versions_1_to_3() {
    for number in 1..=3 {
        let played = play(&version(number), &["initialize $C \"1,2,3,4\"", "frame $C", "frame $C"]);
        assert_eq!(played.lines[1..3], [FIRST, SECOND], "version {number}");
        assert_eq!(played.regions().len(), 3);
        let summary = Summary { targets: 1, frames: 3, end: End::EndOfStream };
        assert_eq!(played.result.expect("session"), summary);
    }
}

#[test]
fn targets_may_follow_one_another() {
    let v4 = ["initialize \"1,2,3,4\"", "frame $C", "frame $C"];
    let again = ["initialize \"5,1,3,4\"", "frame $C", "frame $C", "quit"];
    for (name, between) in [("dropped first", &["initialize"][..]), ("replaced", &[])] {
        let lines = [&v4[..], between, &again[..]].concat();
        let played = play(&version(4), &lines);
        assert_eq!(
            played.regions(),
            [
                "1.0000,2.0000,3.0000,4.0000",
                "2.0000,2.0000,3.0000,4.0000",
                "5.0000,1.0000,3.0000,4.0000",
                "6.0000,1.0000,3.0000,4.0000",
            ],
            "{name}"
        );
        assert_eq!(played.result.expect("session").targets, 2);
    }
    let lines = ["initialize $C 1,2,3,4", "frame $C", "initialize $C 5,1,3,4", "frame $C"];
    let played = play(&version(3), &lines);
    assert_eq!(played.regions()[2], "5.0000,1.0000,3.0000,4.0000");
    assert_eq!(played.result.expect("session").targets, 2);
}

#[test]
fn polygons_and_masks_start_from_the_box_around_them() {
    for region in ["1,2,4,3,2,6", "mask:0,0,10,10,21,3,27,1", "poly:1,2,4,2,4,6,1,6"] {
        let played = play(&version(4), &[&format!("initialize {region}"), "frame $C", "quit"]);
        assert_eq!(played.regions(), ["1.0000,2.0000,3.0000,4.0000"], "{region}");
    }
}

#[test]
fn one_channel_names_its_sensor_by_its_pixels() {
    let played = play(&version(4), &["initialize 1,2,3,4", "frame $C", "frame $G", "frame $C"]);
    assert_eq!(
        played.calls,
        [
            "init rgb 12x8 1,2,3,4",
            // Another size: the box goes along.
            "place 2,4,6,8",
            "update thermal 24x16 2,4,6,8",
            "place 1.5,2,3,4",
            "update rgb 12x8 1.5,2,3,4",
        ]
    );
    let ir = Options { channels: Channels::Ir, ..Options::default() };
    let played = play(&ir, &["initialize 1,2,3,4", "frame $C", "quit"]);
    assert!(played.lines[0].contains("\"trax.channels=ir;\""));
    assert_eq!(played.calls, ["init thermal 12x8 1,2,3,4"]);
}

#[test]
fn with_two_channels_boxes_stay_in_pixels_of_the_first() {
    let lines = ["initialize 1,2,3,4", "frame $C $G", "frame $C $G", "frame $C $G", "quit"];
    let fixed = play(&both("ir"), &lines);
    assert_eq!(fixed.calls[0], "init thermal 24x16 2,4,6,8");
    assert_eq!(
        fixed.regions()[..2],
        ["1.0000,2.0000,3.0000,4.0000", "1.5000,2.0000,3.0000,4.0000"]
    );
    assert!(fixed.lines[1].contains("modality=thermal"));

    let switched = play(&both("switch:1"), &lines);
    assert_eq!(
        switched.calls,
        [
            "init rgb 12x8 1,2,3,4",
            "place 2,4,6,8",
            "update thermal 24x16 2,4,6,8",
            "place 1.5,2,3,4",
            "update rgb 12x8 1.5,2,3,4",
        ]
    );
    assert_eq!(
        switched.regions(),
        [
            "1.0000,2.0000,3.0000,4.0000",
            "1.5000,2.0000,3.0000,4.0000",
            "2.5000,2.0000,3.0000,4.0000"
        ]
    );

    // Version 3 sends both with initialize.
    let options = Options { version: Version::V3, ..both("color") };
    let played = play(&options, &["initialize $C $G 1,2,3,4", "frame $C $G", "quit"]);
    assert_eq!(played.calls, ["init rgb 12x8 1,2,3,4", "update rgb 12x8 1,2,3,4"]);
}

#[test]
fn auto_survives_a_camera_that_fails() {
    let lines = ["initialize 1,2,3,4", "frame $C $G", "frame gone.png $G", "frame gone.png $G"];
    let played = play(&both("auto"), &lines);
    // The size of the first channel is remembered while it is away.
    assert_eq!(
        played.regions(),
        [
            "1.0000,2.0000,3.0000,4.0000",
            "1.5000,2.0000,3.0000,4.0000",
            "2.0000,2.0000,3.0000,4.0000"
        ]
    );
    assert_eq!(played.result.expect("session").frames, 3);
    let played = play(&both("color"), &lines);
    let e = played.result.expect_err("fixed").to_string();
    assert!(e.starts_with("target 1, frame 1, channel color: cannot read gone.png"), "{e}");
}

#[test]
fn answers_say_how_sure_they_are() {
    let text =
        format!("@@TRAX:initialize 1,2,3,4\n@@TRAX:frame {0}\n@@TRAX:frame {0}\n", color(12, 8));
    for (score, state, want) in [
        (0.25, TrackState::Uncertain, "\"confidence=0.250000\" \"state=uncertain\""),
        (1.75, TrackState::Tracking, "\"confidence=1.000000\" \"state=tracking\""),
        (-0.5, TrackState::Lost, "\"confidence=0.000000\" \"state=lost\""),
    ] {
        let mut fake = Fake { score, state: Some(state), ..Fake::default() };
        let played = play_with(&version(4), &mut fake, text.as_bytes());
        assert!(played.lines[2].contains(want), "{}", played.lines[2]);
    }
    // A probability is said in the place of the score.
    let mut fake = Fake { score: 0.9, confidence: Some(0.625), ..Fake::default() };
    let played = play_with(&version(4), &mut fake, text.as_bytes());
    assert!(played.lines[2].contains("\"confidence=0.625000\""), "{}", played.lines[2]);
}

#[test]
fn what_cannot_be_answered_ends_the_session_with_a_reason() {
    let ready = ["initialize 1,2,3,4", "frame $C"];
    let cases: [(&str, Options, &[&str], &str); 19] = [
        (
            "no target",
            version(4),
            &["frame $C"],
            "unexpected \"frame\" message: there is no target",
        ),
        ("no target, version 3", version(3), &["frame $C"], "there is no target"),
        (
            "dropped",
            version(4),
            &[ready[0], ready[1], "initialize", "frame $C"],
            "there is no target",
        ),
        ("hello", version(4), &["hello"], "unexpected \"hello\" message: only trackers send it"),
        ("state", version(4), &["state 1,2,3,4"], "unexpected \"state\" message"),
        ("two targets", version(4), &[ready[0], ready[0]], "one target at a time"),
        (
            "version 3 to version 4",
            version(4),
            &["initialize $C 1,2,3,4"],
            "2 arguments; version 4 takes one region",
        ),
        (
            "version 4 to version 3",
            version(3),
            &["initialize 1,2,3,4"],
            "0 pictures came, expected are 1 (color) and one region",
        ),
        ("nothing to version 3", version(3), &["initialize"], "pictures and a region are expected"),
        (
            "too few pictures",
            both("auto"),
            &[ready[0], "frame $C"],
            "1 pictures came, expected are 2 (color, ir)",
        ),
        (
            "too many pictures",
            version(4),
            &[ready[0], "frame $C $C"],
            "2 pictures came, expected are 1 (color)",
        ),
        ("special region", version(4), &["initialize 0"], "target 1: special region 0"),
        ("NaN", version(4), &["initialize nan,2,3,4"], "target 1: region: number 1 is not finite"),
        (
            "empty mask",
            version(4),
            &["initialize mask:0,0,5,5,25"],
            "mask of 5 x 5 pixels is empty",
        ),
        ("no area", version(4), &["initialize 5,5,0,3"], "region 0 x 3 has no area"),
        (
            "outside",
            version(4),
            &["initialize 100,2,3,4", "frame $C"],
            "target 1, frame 0: box x 100 y 2 w 3 h 4 lies outside the picture of 12 x 8 pixels",
        ),
        (
            "no picture",
            version(4),
            &[ready[0], ready[1], "frame /none.png"],
            "target 1, frame 1, channel color: cannot read /none.png",
        ),
        (
            "broken picture",
            version(4),
            &[ready[0], "frame data:image/png;AAAA"],
            "not a picture that can be read",
        ),
        ("quotes", version(4), &["frame \"a"], "message 1: token 1: the closing quote is missing"),
    ];
    for (name, options, lines, words) in cases {
        let played = play(&options, lines);
        let reason =
            played.reason().unwrap_or_else(|| panic!("{name}: no quit: {:?}", played.lines));
        let plain = reason.replace("\\\"", "\"");
        assert!(plain.contains(words), "{name}: no \"{words}\" in: {reason}");
        let e = played.result.expect_err(name);
        assert!(e.is_input(), "{name}");
        assert_eq!(crate::error::HostError::from(e).exit_code(), 2, "{name}");
    }
}

#[test]
fn failures_that_are_not_the_clients_fault() {
    // The fake fails far to the right.
    let mut fake = Fake::default();
    let c = color(12, 8);
    let far = "@@TRAX:initialize 0,0,5,5\n";
    let text = format!("{far}@@TRAX:frame {c}\n@@TRAX:frame {c}\n@@TRAX:frame {c}\n");
    struct Jump(Fake);
    impl Follow for Jump {
        fn init(&mut self, v: &FrameView<'_>, b: BBox, m: Modality) -> Result<(), TrackError> {
            self.0.init(v, b, m)
        }
        fn update(&mut self, v: &FrameView<'_>, m: Modality) -> Result<Track, TrackError> {
            let track = self.0.update(v, m);
            self.0.bbox = Some(BBox::new(2e6, 0.0, 5.0, 5.0));
            track
        }
        fn place(&mut self, b: BBox) -> Result<(), TrackError> {
            self.0.place(b)
        }
    }
    let mut output = Vec::new();
    let e = serve(text.as_bytes(), &mut output, &mut Jump(std::mem::take(&mut fake)), &version(4))
        .expect_err("fails");
    assert!(!e.is_input());
    let line = String::from_utf8(output).expect("text");
    assert!(line.contains("quit \"trax.reason=target 1, frame 2: engine fake"), "{line}");

    let cut = play_with(&version(4), &mut fake, b"@@TRAX:initialize 1,2,");
    assert_eq!(cut.reason(), Some("message 1: the stream ended inside it"));
    assert!(!cut.result.expect_err("cut").is_input());

    struct Closed;
    impl std::io::Write for Closed {
        fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
            Err(std::io::ErrorKind::BrokenPipe.into())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    let e = serve(&b"@@TRAX:quit\n"[..], Closed, &mut fake, &version(4)).expect_err("closed");
    assert!(matches!(e, TraxError::Write { .. }) && !e.is_input(), "{e}");
}

#[test]
fn oversized_messages_are_refused_before_they_are_read() {
    let options = Options { max_message: 200, ..version(4) };
    let text = format!("@@TRAX:initialize 1,2,3,4\n@@TRAX:frame {}\n", color(24, 16));
    let played = play_with(&options, &mut Fake::default(), text.as_bytes());
    assert!(played.reason().expect("reason").contains("message 2: longer than 200 bytes"));
}

#[test]
fn a_server_without_a_model_says_so() {
    let mut output = Vec::new();
    give_up(&mut output, "x.tsda: cannot\nbe \"read\"").expect("writes");
    assert_eq!(output, b"@@TRAX:quit \"trax.reason=x.tsda: cannot be \\\"read\\\"\" \n");
}

#[test]
fn boxes_far_out_are_refused_by_the_tracker() {
    let e: TrackError = BoxError::TooLarge(BBox::new(0.0, 0.0, 2e6, 1.0)).into();
    let e = TraxError::Track { target: 1, frame: 0, source: Box::new(e) };
    assert!(e.is_input());
}

proptest! {
    #[test]
    fn no_client_makes_it_panic(
        version in 1u8..=4,
        two: bool,
        lines in prop::collection::vec(
            prop_oneof![
                Just("@@TRAX:initialize 1,2,3,4".to_owned()),
                Just("@@TRAX:initialize".to_owned()),
                Just("@@TRAX:initialize $C 1,2,3,4".to_owned()),
                Just("@@TRAX:frame $C".to_owned()),
                Just("@@TRAX:frame $C $G".to_owned()),
                Just("@@TRAX:quit".to_owned()),
                "@@TRAX:initialize (mask:|)[0-9,.-]{0,20}",
                "@@TRAX:frame (image:|data:|)[ -~]{0,20}",
                "@@TRAX:(frame|initialize|quit|state|hello) [ -~]{0,20}",
                "[ -~]{0,30}",
            ],
            0..8,
        ),
        tail in prop::collection::vec(any::<u8>(), 0..12),
    ) {
        let options = Options {
            version: Version::new(version).expect("version"),
            channels: if two { Channels::Both } else { Channels::Color },
            max_message: 1 << 14,
            ..Options::default()
        };
        let text = lines.join("\n").replace("$C", &color(12, 8)).replace("$G", &grey(24, 16));
        let input = [text.as_bytes(), b"\n", &tail[..]].concat();
        let played = play_with(&options, &mut Fake::default(), &input);
        prop_assert!(played.lines[0].starts_with("@@TRAX:hello "));
        // Every line is a message that a client can read; only errors end with a reason.
        for line in &played.lines {
            prop_assert!(Message::parse(line.as_bytes()).expect("well-formed").is_some());
        }
        prop_assert_eq!(played.result.is_err(), played.reason().is_some());
        if let Ok(summary) = played.result {
            prop_assert_eq!(summary.frames as usize, played.lines.len() - 1);
        }
    }
}
