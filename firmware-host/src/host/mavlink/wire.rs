//! MAVLink 2 frames and the few messages a tracking camera needs. Field order and checksum seeds
//! (CRC_EXTRA) are those of the dialect `common`; `scripts/mavlink_vectors.py` makes the bytes the
//! tests compare with.

/// First byte of a frame.
const MAGIC: u8 = 0xFD;
/// Bytes before the payload.
const HEADER: usize = 10;
/// Bytes of a signature.
const SIGNATURE: usize = 13;
/// Flag of a frame that has one.
const SIGNED: u8 = 1;

/// HEARTBEAT.
pub const HEARTBEAT: u32 = 0;
/// COMMAND_INT.
pub const COMMAND_INT: u32 = 75;
/// COMMAND_LONG.
pub const COMMAND_LONG: u32 = 76;
/// COMMAND_ACK.
pub const COMMAND_ACK: u32 = 77;
/// CAMERA_INFORMATION.
pub const CAMERA_INFORMATION: u32 = 259;
/// CAMERA_TRACKING_IMAGE_STATUS.
pub const CAMERA_TRACKING_IMAGE_STATUS: u32 = 275;

/// Seed of a message's checksum; `None` for messages that are passed over.
pub const fn crc_extra(id: u32) -> Option<u8> {
    Some(match id {
        HEARTBEAT => 50,
        COMMAND_INT => 158,
        COMMAND_LONG => 152,
        COMMAND_ACK => 143,
        CAMERA_INFORMATION => 92,
        CAMERA_TRACKING_IMAGE_STATUS => 126,
        _ => return None,
    })
}

/// X.25 checksum of a frame without its first byte, with the seed at the end.
fn checksum(bytes: &[u8], extra: u8) -> u16 {
    bytes.iter().chain([&extra]).fold(0xFFFF_u16, |crc, byte| {
        let x = byte ^ crc as u8;
        let x = x ^ (x << 4);
        let wide = u16::from(x);
        (crc >> 8) ^ (wide << 8) ^ (wide << 3) ^ (wide >> 4)
    })
}

/// Who sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sender {
    /// Vehicle.
    pub system: u8,
    /// Part of it.
    pub component: u8,
}

/// Appends a frame. Zeros at the payload's end are left out, as the protocol wants it.
pub fn write_frame(out: &mut Vec<u8>, from: Sender, sequence: u8, id: u32, payload: &[u8]) {
    let Some(extra) = crc_extra(id) else { return };
    let payload = &payload[..payload.len().min(255)];
    let used = payload.iter().rposition(|b| *b != 0).map_or(1, |i| i + 1).min(payload.len());
    let start = out.len();
    let [a, b, c, _] = id.to_le_bytes();
    out.extend_from_slice(&[
        MAGIC,
        used as u8,
        0,
        0,
        sequence,
        from.system,
        from.component,
        a,
        b,
        c,
    ]);
    out.extend_from_slice(&payload[..used]);
    let crc = checksum(&out[start + 1..], extra);
    out.extend_from_slice(&crc.to_le_bytes());
}

/// A frame whose checksum is right.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Who sent it.
    pub from: Sender,
    /// Its number.
    pub sequence: u8,
    /// Kind of message.
    pub id: u32,
    /// With the zeros that were left out, up to the longest payload.
    pub payload: [u8; 255],
}

/// Finds frames in a stream of bytes.
#[derive(Debug, Default)]
pub struct Parser {
    bytes: Vec<u8>,
    /// Frames with a wrong checksum or flags nobody knows.
    pub bad: u64,
}

impl Parser {
    /// Takes bytes and calls `found` for every frame that ends in them.
    pub fn push(&mut self, bytes: &[u8], mut found: impl FnMut(Frame)) {
        self.bytes.extend_from_slice(bytes);
        let mut at = 0;
        loop {
            let rest = &self.bytes[at..];
            let Some(start) = rest.iter().position(|b| *b == MAGIC) else {
                self.bytes.clear();
                return;
            };
            at += start;
            let rest = &self.bytes[at..];
            let Some((&[_, length, flags, _, sequence, system, component, a, b, c], _)) =
                rest.split_first_chunk::<HEADER>()
            else {
                break;
            };
            let (end, signed) = (HEADER + usize::from(length), flags & SIGNED != 0);
            let whole = end + 2 + if signed { SIGNATURE } else { 0 };
            // A frame with other flags cannot be understood, says the protocol.
            if flags & !SIGNED != 0 {
                (self.bad, at) = (self.bad + 1, at + 1);
                continue;
            }
            if rest.len() < whole {
                break;
            }
            let id = u32::from_le_bytes([a, b, c, 0]);
            let crc = u16::from_le_bytes([rest[end], rest[end + 1]]);
            match crc_extra(id) {
                // Of no interest, and without its seed nobody can say whether it is whole.
                None => at += whole,
                Some(extra) if checksum(&rest[1..end], extra) != crc => {
                    (self.bad, at) = (self.bad + 1, at + 1);
                }
                Some(_) => {
                    let mut payload = [0; 255];
                    payload[..usize::from(length)].copy_from_slice(&rest[HEADER..end]);
                    found(Frame { from: Sender { system, component }, sequence, id, payload });
                    at += whole;
                }
            }
        }
        self.bytes.drain(..at);
    }
}

/// A payload being written, fields in the order of their size as the protocol sorts them.
#[derive(Debug, Default)]
struct Payload(Vec<u8>);

impl Payload {
    fn bytes(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn u32(self, v: u32) -> Self {
        self.bytes(&v.to_le_bytes())
    }

    fn u16(self, v: u16) -> Self {
        self.bytes(&v.to_le_bytes())
    }

    fn f32s(self, all: &[f32]) -> Self {
        all.iter().fold(self, |p, v| p.bytes(&v.to_le_bytes()))
    }

    /// Text in a field of `N` bytes, zeros behind it.
    fn text<const N: usize>(self, text: &str) -> Self {
        let (mut field, n) = ([0; N], text.len().min(N));
        field[..n].copy_from_slice(&text.as_bytes()[..n]);
        self.bytes(&field)
    }
}

/// HEARTBEAT of a camera that works.
pub fn heartbeat() -> Vec<u8> {
    const CAMERA: u8 = 30;
    const NO_AUTOPILOT: u8 = 8;
    const ACTIVE: u8 = 4;
    Payload::default().u32(0).bytes(&[CAMERA, NO_AUTOPILOT, 0, ACTIVE, 3]).0
}

/// COMMAND_ACK.
pub fn command_ack(command: u16, result: u8, to: Sender) -> Vec<u8> {
    let p = Payload::default().u16(command).bytes(&[result, 0]).u32(0);
    p.bytes(&[to.system, to.component]).0
}

/// CAMERA_INFORMATION with the abilities to track a point and a rectangle.
pub fn camera_information(boot_ms: u32, version: [u8; 3], size: (u16, u16), name: &str) -> Vec<u8> {
    const TRACKS_POINT: u32 = 512;
    const TRACKS_RECTANGLE: u32 = 1024;
    let [major, minor, patch] = version;
    Payload::default()
        .u32(boot_ms)
        .u32(u32::from_le_bytes([major, minor, patch, 0]))
        .f32s(&[f32::NAN; 3])
        .u32(TRACKS_POINT | TRACKS_RECTANGLE)
        .u16(size.0)
        .u16(size.1)
        .u16(0)
        .text::<32>("TSDA")
        .text::<32>(name)
        .bytes(&[0])
        .text::<140>("")
        .bytes(&[0, 0])
        .0
}

/// What CAMERA_TRACKING_IMAGE_STATUS says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageStatus {
    /// 0 idle, 1 active, 2 error, 8 coasting.
    pub status: u8,
    /// Left, top, right, bottom as shares of the picture; `None` without a target.
    pub rectangle: Option<[f32; 4]>,
}

impl ImageStatus {
    /// The payload.
    pub fn payload(&self) -> Vec<u8> {
        const RECTANGLE: u8 = 2;
        const IN_STATUS: u8 = 4;
        let mode = if self.rectangle.is_some() { [RECTANGLE, IN_STATUS] } else { [0, 0] };
        Payload::default()
            .f32s(&[f32::NAN; 3])
            .f32s(&self.rectangle.unwrap_or([f32::NAN; 4]))
            .bytes(&[self.status])
            .bytes(&mode)
            .bytes(&[0])
            .0
    }
}

/// COMMAND_LONG or COMMAND_INT.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommandMessage {
    /// Which command.
    pub command: u16,
    /// Parameters 1 to 4; no command here has more.
    pub params: [f32; 4],
    /// For whom; zeros: for all.
    pub to: Sender,
}

impl CommandMessage {
    /// The command in a frame, if there is one.
    pub fn read(frame: &Frame) -> Option<Self> {
        if !matches!(frame.id, COMMAND_LONG | COMMAND_INT) {
            return None;
        }
        let p = &frame.payload;
        let float = |i: usize| f32::from_le_bytes([p[i], p[i + 1], p[i + 2], p[i + 3]]);
        Some(Self {
            command: u16::from_le_bytes([p[28], p[29]]),
            params: [float(0), float(4), float(8), float(12)],
            to: Sender { system: p[30], component: p[31] },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const US: Sender = Sender { system: 1, component: 100 };

    fn hex(text: &str) -> Vec<u8> {
        let digits: Vec<u8> = text.bytes().filter(u8::is_ascii_hexdigit).collect();
        let byte =
            |p: &[u8]| u8::from_str_radix(str::from_utf8(p).expect("ascii"), 16).expect("hex");
        digits.chunks(2).map(byte).collect()
    }

    fn frames(bytes: &[u8]) -> Vec<Frame> {
        let (mut parser, mut found) = (Parser::default(), Vec::new());
        parser.push(bytes, |f| found.push(f));
        found
    }

    const HEART: &str = "fd090000070164000000000000001e08000403223a";
    const ACK: &str = "fd0a00000701644d0000d507000000000000ffbeacbb";
    const INFORMATION: &str = "fd48000007016403010040e20100010203000000c07f0000c07f0000c07f000600008002e0010000 \
        5453444100000000000000000000000000000000000000000000000000000000545344412d547261 \
        636bfb4c";
    const STATUS: &str = "fd1f00000701641301000000c07f0000c07f0000c07f0000803e0000003f0000c03e0000403f0102 \
        04344a";
    const IDLE: &str =
        "fd1c00000701641301000000c07f0000c07f0000c07f0000c07f0000c07f0000c07f0000c07fb19d";
    const COMMAND: &str = "fd200000c8ffbe4c00000000803e0000003f0000c03e0000403f000000000000000000000000d507 \
        01649e83";
    const COMMAND_AS_INT: &str = "fd200000c8ffbe4b00000000003f0000803ecdcccc3d00000000000000000000000000000000d407 \
        01647ce9";

    #[test]
    fn frames_are_those_of_pymavlink() {
        let status = ImageStatus { status: 1, rectangle: Some([0.25, 0.5, 0.375, 0.75]) }.payload();
        let idle = ImageStatus { status: 0, rectangle: None }.payload();
        let station = Sender { system: 255, component: 190 };
        for (id, payload, want) in [
            (HEARTBEAT, heartbeat(), HEART),
            (COMMAND_ACK, command_ack(2005, 0, station), ACK),
            (
                CAMERA_INFORMATION,
                camera_information(123_456, [1, 2, 3], (640, 480), "TSDA-Track"),
                INFORMATION,
            ),
            (CAMERA_TRACKING_IMAGE_STATUS, status, STATUS),
            (CAMERA_TRACKING_IMAGE_STATUS, idle, IDLE),
        ] {
            let mut frame = Vec::new();
            write_frame(&mut frame, US, 7, id, &payload);
            assert_eq!(frame, hex(want), "message {id}");
            assert_eq!(frames(&frame).len(), 1);
        }
    }

    #[test]
    fn commands_of_pymavlink_are_read() {
        let read = |text| {
            let found = frames(&hex(text));
            assert_eq!(found[0].from, Sender { system: 255, component: 190 });
            assert_eq!((found.len(), found[0].sequence), (1, 200));
            CommandMessage::read(&found[0]).expect("command")
        };
        let params = [0.25, 0.5, 0.375, 0.75];
        assert_eq!(read(COMMAND), CommandMessage { command: 2005, params, to: US });
        let params = [0.5, 0.25, 0.1, 0.0];
        assert_eq!(read(COMMAND_AS_INT), CommandMessage { command: 2004, params, to: US });
        assert!(CommandMessage::read(&frames(&hex(HEART))[0]).is_none());
    }

    #[test]
    fn frames_are_found_between_other_bytes() {
        let good = hex(COMMAND);
        let mut signed = good.clone();
        signed[2] = SIGNED;
        let end = signed.len() - 2;
        let crc = checksum(&signed[1..end], 152).to_le_bytes();
        signed[end..].copy_from_slice(&crc);
        signed.extend([7; SIGNATURE]);
        // An unknown message is passed over by its length.
        let unknown =
            [&[MAGIC, 3, 0, 0, 0, 1, 1, 0x40, 0, 0][..], &[MAGIC, 1, 2], &[9, 9]].concat();
        let all = [b"noise".as_slice(), &good, &unknown, &signed, b"\x00\xFE", &good].concat();
        assert_eq!(frames(&all).len(), 3);
        for cut in 0..all.len() {
            let (mut parser, mut n) = (Parser::default(), 0);
            parser.push(&all[..cut], |_| n += 1);
            parser.push(&all[cut..], |_| n += 1);
            assert_eq!(n, 3, "cut at {cut}");
        }
    }

    #[test]
    fn damaged_frames_are_not() {
        let good = hex(COMMAND);
        for i in 0..good.len() {
            for bit in 0..8 {
                let mut bad = good.clone();
                bad[i] ^= 1 << bit;
                assert!(frames(&bad).is_empty(), "bit {bit} of byte {i}");
            }
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_survived(parts in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..80), 0..20)) {
            let mut parser = Parser::default();
            for part in &parts {
                parser.push(part, |_| {});
                parser.push(&[MAGIC], |_| {});
            }
            prop_assert!(parser.bytes.len() <= HEADER + 255 + 2 + SIGNATURE);
        }

        #[test]
        fn what_is_written_is_read(payload in prop::collection::vec(any::<u8>(), 1..255), sequence: u8) {
            let mut bytes = Vec::new();
            write_frame(&mut bytes, US, sequence, COMMAND_LONG, &payload);
            let found = frames(&bytes);
            prop_assert_eq!(found.len(), 1);
            prop_assert_eq!(&found[0].payload[..payload.len()], &payload[..]);
            prop_assert_eq!((found[0].from, found[0].sequence, found[0].id), (US, sequence, COMMAND_LONG));
        }
    }
}
