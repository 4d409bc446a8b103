use super::super::control::channel;
use super::super::output::TargetRecord;
use super::*;
use crate::switch::Condition;
use std::net::UdpSocket;
use std::sync::mpsc::Receiver as Inbox;
use tsda_runtime::{BBox, Modality};

const STATION: Sender = Sender { system: 255, component: 190 };
const US: Sender = Sender { system: 1, component: 100 };

/// A ground station's end of a line.
pub(super) trait End {
    fn send(&mut self, bytes: &[u8]);
    /// Waits for bytes.
    fn receive(&mut self, bytes: &mut [u8]) -> usize;
}

impl End for UdpSocket {
    fn send(&mut self, bytes: &[u8]) {
        UdpSocket::send(self, bytes).expect("sends");
    }

    fn receive(&mut self, bytes: &mut [u8]) -> usize {
        self.recv(bytes).expect("answers")
    }
}

/// A ground station at the other end of a line.
pub(super) struct Station<E> {
    pub end: E,
    parser: Parser,
    waiting: Vec<Frame>,
}

impl Station<UdpSocket> {
    fn new(config: MavlinkConfig) -> (Self, Mavlink, Inbox<Command>) {
        let socket = UdpSocket::bind("127.0.0.1:0").expect("socket");
        socket.set_read_timeout(Some(Duration::from_secs(20))).expect("timeout");
        let (commands, inbox) = channel();
        let sources = vec![SourceInfo { name: "rgb".into(), sensor: Modality::Rgb }];
        let config = MavlinkConfig { to: "udpin:127.0.0.1:0".into(), ..config };
        let output = Mavlink::open(&config, sources, commands).expect("opens");
        socket.connect(output.address().expect("address")).expect("connects");
        (Self::at(socket), output, inbox)
    }
}

impl<E: End> Station<E> {
    pub fn at(end: E) -> Self {
        Self { end, parser: Parser::default(), waiting: Vec::new() }
    }

    /// The next message of a kind; others are passed over.
    pub fn next(&mut self, id: u32) -> Frame {
        loop {
            while !self.waiting.is_empty() {
                let frame = self.waiting.remove(0);
                if frame.id == id {
                    assert_eq!(frame.from, US);
                    return frame;
                }
            }
            let mut bytes = [0; 512];
            let n = self.end.receive(&mut bytes);
            let waiting = &mut self.waiting;
            self.parser.push(&bytes[..n], |f| waiting.push(f));
        }
    }

    fn command(&mut self, command: u16, params: [f32; 4], to: Sender) {
        let mut payload: Vec<u8> = params.iter().flat_map(|v| v.to_le_bytes()).collect();
        payload.extend([0; 12]);
        payload.extend(command.to_le_bytes());
        payload.extend([to.system, to.component, 0]);
        let mut frame = Vec::new();
        wire::write_frame(&mut frame, STATION, 0, wire::COMMAND_LONG, &payload);
        self.end.send(&frame);
    }

    /// Sends a command and answers its result.
    pub fn ask(&mut self, command: u16, params: [f32; 4]) -> u8 {
        self.command(command, params, US);
        let ack = self.next(wire::COMMAND_ACK).payload;
        assert_eq!(u16::from_le_bytes([ack[0], ack[1]]), command);
        assert_eq!(ack[8..10], [STATION.system, STATION.component]);
        ack[2]
    }
}

pub(super) fn record(state: Option<TrackState>, predicted: bool) -> FrameRecord {
    FrameRecord {
        frame: 1,
        at: Duration::from_secs(1),
        capture: None,
        source: 0,
        size: (640, 480),
        sequence: 0,
        condition: Condition::Good,
        target: state.map(|state| TargetRecord {
            bbox: BBox::new(160.0, 240.0, 80.0, 120.0),
            score: 0.8,
            confidence: None,
            state,
            predicted,
            redetected: false,
            temperature: None,
        }),
        latency: Duration::ZERO,
        tracking: Duration::ZERO,
        skipped: 0,
        allocations: 0,
    }
}

#[test]
fn a_ground_station_selects_and_releases() {
    let (mut station, mut output, inbox) = Station::new(MavlinkConfig::default());
    assert_eq!(station.ask(TRACK_RECTANGLE, [0.1, 0.1, 0.2, 0.2]), 1, "no picture yet");
    output.frame(&record(None, false), &Views(&[]));
    // Taken up within a few turns of the output's thread.
    while station.ask(STOP_TRACKING, [0.0; 4]) != 0
        || station.ask(TRACK_RECTANGLE, [0.25, 0.5, 0.375, 0.75]) != 0
    {}
    let select = |bbox| Command::Select { bbox, source: Some("rgb".into()) };
    let given: Vec<Command> = inbox.try_iter().collect();
    assert_eq!(given.first(), Some(&Command::Stop));
    assert_eq!(given.last(), Some(&select([160.0, 240.0, 80.0, 120.0])));
    assert_eq!(station.ask(TRACK_POINT, [0.5, 0.5, 0.1, 0.0]), 0);
    assert_eq!(station.ask(TRACK_POINT, [0.5, 0.5, 0.0, 0.0]), 0);
    let given: Vec<Command> = inbox.try_iter().collect();
    let want = [select([256.0, 176.0, 128.0, 128.0]), select([288.0, 208.0, 64.0, 64.0])];
    assert_eq!(given, want);
    for (command, params, result) in [
        (TRACK_POINT, [1.5, 0.5, 0.1, 0.0], 2),
        (TRACK_POINT, [f32::NAN, 0.5, 0.1, 0.0], 2),
        (TRACK_POINT, [0.5, 0.5, f32::INFINITY, 0.0], 2),
        (TRACK_RECTANGLE, [0.5, 0.5, 0.4, 0.6], 2),
        (TRACK_RECTANGLE, [0.5, 0.5, f32::NAN, 0.6], 2),
        (SET_MESSAGE_INTERVAL, [275.0, -7.0, 0.0, 0.0], 2),
        (SET_MESSAGE_INTERVAL, [30.0, 1e5, 0.0, 0.0], 3),
        (REQUEST_MESSAGE, [30.0, 0.0, 0.0, 0.0], 3),
        (400, [1.0; 4], 3),
    ] {
        assert_eq!(station.ask(command, params), result, "{command} {params:?}");
    }
    assert!(inbox.try_recv().is_err());
    output.finish();
}

#[test]
fn the_status_comes_as_often_as_asked_for() {
    let (mut station, mut output, _inbox) =
        Station::new(MavlinkConfig { status_rate: 0.0, ..MavlinkConfig::default() });
    // A heartbeat goes to whoever has spoken.
    assert_eq!(station.ask(REQUEST_CAMERA_INFORMATION, [1.0, 0.0, 0.0, 0.0]), 0);
    let flags = station.next(wire::CAMERA_INFORMATION).payload;
    assert_eq!(u32::from_le_bytes([flags[20], flags[21], flags[22], flags[23]]), 512 | 1024);
    station.next(wire::HEARTBEAT);
    output.frame(&record(Some(TrackState::Tracking), false), &Views(&[]));
    assert_eq!(station.ask(SET_MESSAGE_INTERVAL, [275.0, 20_000.0, 0.0, 0.0]), 0);
    let floats = |frame: &Frame| -> Vec<f32> {
        let number = |c: &[u8]| f32::from_le_bytes([c[0], c[1], c[2], c[3]]);
        frame.payload[..28].chunks(4).map(number).collect()
    };
    let first = station.next(wire::CAMERA_TRACKING_IMAGE_STATUS);
    assert_eq!(floats(&first)[3..], [0.25, 0.5, 0.375, 0.75]);
    assert_eq!(first.payload[28..31], [1, 2, 4]);
    for (state, predicted, want) in [
        (Some(TrackState::Uncertain), false, [1, 2]),
        (Some(TrackState::Searching), true, [8, 2]),
        (Some(TrackState::Lost), false, [2, 2]),
        (None, false, [0, 0]),
    ] {
        output.frame(&record(state, predicted), &Views(&[]));
        while station.next(wire::CAMERA_TRACKING_IMAGE_STATUS).payload[28..30] != want {}
    }
    let idle = station.next(wire::CAMERA_TRACKING_IMAGE_STATUS);
    assert!(floats(&idle).iter().all(|v| v.is_nan()));
    output.finish();
}

#[test]
fn others_commands_and_noise_are_passed_over() {
    let (mut station, mut output, inbox) =
        Station::new(MavlinkConfig { control: false, ..MavlinkConfig::default() });
    station.command(STOP_TRACKING, [0.0; 4], Sender { system: 2, component: 100 });
    station.command(STOP_TRACKING, [0.0; 4], Sender { system: 1, component: 1 });
    station.command(400, [0.0; 4], Sender { system: 1, component: 0 });
    End::send(&mut station.end, &[0xFD; 300]);
    End::send(&mut station.end, &[0xFD, 255, 0, 0]);
    End::send(&mut station.end, &[0; 300]);
    // The first answer is to the first command that is for us; it is not obeyed here.
    assert_eq!(station.ask(STOP_TRACKING, [0.0; 4]), 2);
    assert!(inbox.try_recv().is_err());
    output.finish();
}

#[test]
fn lines_that_make_no_sense_are_refused() {
    for (to, words) in [
        ("", "udpin:"),
        ("tcp:1.2.3.4:5", "udpin:"),
        ("udp:nowhere", "host and port"),
        ("serial:/dev/null", "speed"),
        ("serial:/no/such/line:57600", "/no/such/line"),
        // No serial line.
        ("serial:/dev/null:57600", "/dev/null"),
    ] {
        let config = MavlinkConfig { to: to.into(), ..MavlinkConfig::default() };
        let error = Mavlink::open(&config, Vec::new(), channel().0).expect_err(to).to_string();
        assert!(error.contains(words), "{error}");
    }
    let config = MavlinkConfig { system: 0, to: "udpin:127.0.0.1:0".into(), ..Default::default() };
    assert!(Mavlink::open(&config, Vec::new(), channel().0).is_err());
}
