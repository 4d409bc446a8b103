//! A USB camera made in software, attached to the kernel's vhci-hcd over a socket pair (the
//! USB/IP wire protocol). The real uvcvideo driver binds to it, so formats, short frames,
//! payload errors, stalls and unplugging all take the path that a real camera takes.
use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

pub struct Format {
    pub fourcc: [u8; 4],
    pub bpp: u8,
    pub sizes: &'static [(u16, u16)],
}
pub struct Model {
    pub name: &'static str,
    pub vid: u16,
    pub pid: u16,
    pub maker: &'static str,
    pub product: &'static str,
    pub serial: &'static str,
    pub formats: &'static [Format],
}
/// What the boards announce, as far as uvcvideo looks at it.
pub const MODELS: &[Model] = &[
    Model {
        name: "purethermal",
        vid: 0x1e4e,
        pid: 0x0100,
        maker: "GroupGets",
        product: "PureThermal (fw:v1.3.0)",
        serial: "004f005b-5008-564e-3536-203400000000",
        formats: &[
            Format { fourcc: *b"UYVY", bpp: 16, sizes: &[(160, 120)] },
            Format { fourcc: *b"Y16 ", bpp: 16, sizes: &[(160, 120), (160, 122)] },
            Format { fourcc: *b"Y8  ", bpp: 8, sizes: &[(160, 120)] },
        ],
    },
    // Play files: a colour camera and a thermal one of the same scene.
    Model {
        name: "webcam",
        vid: 0x1d6b,
        pid: 0x0102,
        maker: "Test",
        product: "Colour camera",
        serial: "1",
        formats: &[Format { fourcc: *b"YUY2", bpp: 16, sizes: &[(320, 240)] }],
    },
    Model {
        name: "thermal",
        vid: 0x1d6b,
        pid: 0x0103,
        maker: "Test",
        product: "Thermal camera",
        serial: "2",
        formats: &[Format { fourcc: *b"Y16 ", bpp: 16, sizes: &[(320, 240)] }],
    },
    Model {
        name: "boson",
        vid: 0x09cb,
        pid: 0x4007,
        maker: "FLIR",
        product: "Boson",
        serial: "12345",
        formats: &[Format { fourcc: *b"Y16 ", bpp: 16, sizes: &[(640, 512), (640, 514)] }],
    },
    Model {
        name: "p2pro",
        vid: 0x0bda,
        pid: 0x5830,
        maker: "Infiray",
        product: "USB Camera",
        serial: "0001",
        formats: &[Format { fourcc: *b"YUY2", bpp: 16, sizes: &[(256, 192), (256, 384)] }],
    },
];

const PAYLOAD: usize = 16384; // one URB of uvcvideo
const HEADER: usize = 12;
const VS_CTRL: usize = 26; // UVC 1.0 probe/commit block

fn le16(v: &mut Vec<u8>, x: u16) {
    v.extend(x.to_le_bytes());
}
fn le32(v: &mut Vec<u8>, x: u32) {
    v.extend(x.to_le_bytes());
}
fn string_desc(s: &str) -> Vec<u8> {
    let mut v = vec![0, 3];
    s.encode_utf16().for_each(|u| le16(&mut v, u));
    v[0] = v.len() as u8;
    v
}
fn device_desc(m: &Model) -> Vec<u8> {
    let mut v = vec![18, 1, 0x00, 0x02, 0xef, 2, 1, 64];
    le16(&mut v, m.vid);
    le16(&mut v, m.pid);
    v.extend([0x00, 0x01, 1, 2, 3, 1]);
    v
}
fn config_desc(m: &Model, interval: u32) -> Vec<u8> {
    let mut vs = Vec::new();
    for (i, f) in m.formats.iter().enumerate() {
        vs.extend([27, 0x24, 4, i as u8 + 1, f.sizes.len() as u8]);
        vs.extend(f.fourcc);
        vs.extend([0, 0, 0x10, 0, 0x80, 0, 0, 0xaa, 0, 0x38, 0x9b, 0x71]);
        vs.extend([f.bpp, 1, 0, 0, 0, 0]);
        for (j, &(w, h)) in f.sizes.iter().enumerate() {
            let bytes = w as u32 * h as u32 * f.bpp as u32 / 8;
            vs.extend([30, 0x24, 5, j as u8 + 1, 2]);
            le16(&mut vs, w);
            le16(&mut vs, h);
            let rate = (bytes as u64 * 8 * 10_000_000 / interval as u64) as u32;
            le32(&mut vs, rate);
            le32(&mut vs, rate);
            le32(&mut vs, bytes);
            le32(&mut vs, interval);
            vs.push(1);
            le32(&mut vs, interval);
        }
        vs.extend([6, 0x24, 13, 1, 1, 4]); // colour matching
    }
    let mut vc = vec![13, 0x24, 1, 0x00, 0x01];
    le16(&mut vc, 13 + 17 + 9);
    le32(&mut vc, 6_000_000);
    vc.extend([1, 1]); // one streaming interface: number 1
    vc.extend([17, 0x24, 2, 1, 0x01, 0x02, 0, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0]); // camera terminal, no controls
    vc.extend([9, 0x24, 3, 2, 0x01, 0x01, 0, 1, 0]); // output terminal
    let n = m.formats.len() as u8;
    let mut hdr = vec![13 + n, 0x24, 1, n];
    le16(&mut hdr, (13 + n as usize + vs.len()) as u16);
    hdr.extend([0x81, 0, 2, 0, 0, 0, 1]);
    hdr.extend(std::iter::repeat(0).take(n as usize));

    let mut c = vec![9, 2, 0, 0, 2, 1, 0, 0x80, 250];
    c.extend([8, 11, 0, 2, 14, 3, 0, 2]); // association: video
    c.extend([9, 4, 0, 0, 0, 14, 1, 0, 2]); // VideoControl
    c.extend(&vc);
    c.extend([9, 4, 1, 0, 1, 14, 2, 0, 0]); // VideoStreaming, bulk: no alternate settings
    c.extend(&hdr);
    c.extend(&vs);
    c.extend([7, 5, 0x81, 2, 0x00, 0x02, 0]);
    let total = c.len() as u16;
    c[2..4].copy_from_slice(&total.to_le_bytes());
    c
}

/// What goes wrong, and at which frame.
#[derive(Default, Clone, Debug)]
pub struct Plan {
    pub short_every: u32, // drop one payload: the frame comes up short
    pub error_every: u32, // set the error bit in the payload header
    pub stall_at: u32,    // stop sending at this frame ...
    pub stall_ms: u64,    // ... for so long
    pub unplug_at: u32,   // pull the plug at this frame
}

struct Urb {
    seq: u32,
    len: usize,
}

pub struct Camera<'m> {
    m: &'m Model,
    s: UnixStream,
    cur: (usize, usize), // format, frame (zero-based)
    interval: u32,
    probe: [u8; VS_CTRL],
    committed: bool,
    urbs: VecDeque<Urb>,
    fid: u8,
    pub frames: u32,
}

fn be(b: &[u8], i: usize) -> u32 {
    u32::from_be_bytes(b[i..i + 4].try_into().unwrap())
}

/// Attach to a free high-speed port of vhci-hcd. Returns our end of the cable.
pub fn plug<'m>(m: &'m Model, fps: u32) -> io::Result<Camera<'m>> {
    let (ours, kernels) = UnixStream::pair()?;
    let base = "/sys/devices/platform/vhci_hcd.0";
    let status = std::fs::read_to_string(format!("{base}/status"))?;
    // columns: hub port sta spd dev sockfd local_busid; sta 004 is a free port
    let port = status
        .lines()
        .filter_map(|l| {
            let c: Vec<&str> = l.split_whitespace().collect();
            (c.len() > 2 && c[0] == "hs" && c[2] == "004").then(|| c[1].parse::<u32>().unwrap())
        })
        .next()
        .ok_or_else(|| io::Error::other("no free vhci port"))?;
    std::fs::write(
        format!("{base}/attach"),
        format!("{port} {} {} 3", kernels.as_raw_fd(), 0x10002),
    )?;
    let mut c = Camera {
        m,
        s: ours,
        cur: (0, 0),
        interval: 10_000_000 / fps,
        probe: [0; VS_CTRL],
        committed: false,
        urbs: VecDeque::new(),
        fid: 0,
        frames: 0,
    };
    c.set_probe();
    Ok(c)
}

impl Camera<'_> {
    pub fn size(&self) -> (u16, u16, u8) {
        let f = &self.m.formats[self.cur.0];
        let (w, h) = f.sizes[self.cur.1];
        (w, h, f.bpp)
    }
    fn set_probe(&mut self) {
        let (w, h, bpp) = self.size();
        let mut v = vec![1, 0, self.cur.0 as u8 + 1, self.cur.1 as u8 + 1];
        le32(&mut v, self.interval);
        v.extend([0; 10]);
        le32(&mut v, w as u32 * h as u32 * bpp as u32 / 8);
        le32(&mut v, PAYLOAD as u32);
        self.probe.copy_from_slice(&v);
    }
    fn reply(&mut self, seq: u32, status: i32, data: &[u8], actual: usize) -> io::Result<()> {
        let mut h = [0u8; 48];
        h[..4].copy_from_slice(&3u32.to_be_bytes());
        h[4..8].copy_from_slice(&seq.to_be_bytes());
        h[20..24].copy_from_slice(&status.to_be_bytes());
        h[24..28].copy_from_slice(&(actual as i32).to_be_bytes());
        self.s.write_all(&h)?;
        self.s.write_all(data)
    }
    /// Endpoint 0. `None` is a stall.
    fn control(&mut self, setup: &[u8], out: &[u8]) -> Option<Vec<u8>> {
        let (typ, req) = (setup[0], setup[1]);
        let value = u16::from_le_bytes([setup[2], setup[3]]);
        let index = u16::from_le_bytes([setup[4], setup[5]]);
        match (typ, req) {
            (0x80, 6) => match value >> 8 {
                1 => Some(device_desc(self.m)),
                2 => Some(config_desc(self.m, self.interval)),
                3 => Some(match value & 0xff {
                    0 => vec![4, 3, 9, 4],
                    1 => string_desc(self.m.maker),
                    2 => string_desc(self.m.product),
                    _ => string_desc(self.m.serial),
                }),
                _ => None, // device qualifier and the rest
            },
            (0x80, 0) => Some(vec![0, 0]),
            (0x00, 5) | (0x00, 9) | (0x02, 1) | (0x01, 11) => {
                self.committed = false; // SET_INTERFACE or clear halt: streaming stops
                Some(vec![])
            }
            (0x21, 1) if index & 0xff == 1 && matches!(value >> 8, 1 | 2) && out.len() >= 8 => {
                let f = (out[2].max(1) as usize - 1).min(self.m.formats.len() - 1);
                let n = (out[3].max(1) as usize - 1).min(self.m.formats[f].sizes.len() - 1);
                self.cur = (f, n);
                self.set_probe();
                self.committed = value >> 8 == 2;
                Some(vec![])
            }
            (0xa1, 0x81..=0x84 | 0x87) if index & 0xff == 1 && matches!(value >> 8, 1 | 2) => {
                Some(self.probe.to_vec())
            }
            (0xa1, 0x86) => Some(vec![3]),
            (0xa1, 0x85) => Some(vec![VS_CTRL as u8, 0]),
            _ => None,
        }
    }
    /// Takes one message from the kernel.
    fn message(&mut self) -> io::Result<()> {
        let mut h = [0u8; 48];
        self.s.read_exact(&mut h)?;
        let (cmd, seq, dir, ep) = (be(&h, 0), be(&h, 4), be(&h, 12), be(&h, 16));
        match cmd {
            1 => {
                let len = be(&h, 24) as usize;
                let mut out = vec![0; if dir == 0 { len } else { 0 }];
                self.s.read_exact(&mut out)?;
                if ep == 0 {
                    match self.control(&h[40..48], &out) {
                        Some(mut d) => {
                            d.truncate(len);
                            let n = if dir == 0 { len } else { d.len() };
                            if dir == 0 {
                                d.clear();
                            }
                            self.reply(seq, 0, &d, n)
                        }
                        None => self.reply(seq, -libc::EPIPE, &[], 0),
                    }
                } else {
                    self.urbs.push_back(Urb { seq, len });
                    Ok(())
                }
            }
            2 => {
                let victim = be(&h, 20);
                let before = self.urbs.len();
                self.urbs.retain(|u| u.seq != victim);
                let status = if self.urbs.len() < before { -libc::ECONNRESET } else { 0 };
                let mut r = [0u8; 48];
                r[..4].copy_from_slice(&4u32.to_be_bytes());
                r[4..8].copy_from_slice(&seq.to_be_bytes());
                r[20..24].copy_from_slice(&status.to_be_bytes());
                self.s.write_all(&r)
            }
            _ => Err(io::Error::other("unknown USB/IP command")),
        }
    }
    fn wait(&mut self, until: Instant) -> io::Result<()> {
        loop {
            let ms = until.saturating_duration_since(Instant::now()).as_millis() as i32;
            let mut p = libc::pollfd { fd: self.s.as_raw_fd(), events: libc::POLLIN, revents: 0 };
            if unsafe { libc::poll(&mut p, 1, ms) } > 0 {
                self.message()?;
            } else if Instant::now() >= until {
                return Ok(());
            }
        }
    }
    /// Runs until `frames` are out or the plan pulls the plug (closing the socket does that).
    pub fn run(
        mut self,
        frames: u32,
        plan: &Plan,
        mut paint: impl FnMut(&mut [u8], u32, u16, u16),
    ) -> io::Result<u32> {
        let mut img = Vec::new();
        let mut due = Instant::now();
        while self.frames < frames {
            due += Duration::from_nanos(self.interval as u64 * 100);
            due = due.max(Instant::now() - Duration::from_millis(500));
            self.wait(due)?;
            if !self.committed || self.urbs.is_empty() {
                continue;
            }
            let n = self.frames;
            self.frames += 1;
            if plan.unplug_at > 0 && n == plan.unplug_at {
                return Ok(n);
            }
            if plan.stall_at > 0 && n == plan.stall_at {
                self.wait(Instant::now() + Duration::from_millis(plan.stall_ms))?;
            }
            let (w, h, bpp) = self.size();
            img.resize(w as usize * h as usize * bpp as usize / 8, 0);
            paint(&mut img, n, w, h);
            let short = plan.short_every > 0 && n % plan.short_every == plan.short_every - 1;
            let error = plan.error_every > 0 && n % plan.error_every == plan.error_every - 1;
            self.fid ^= 1;
            let chunks = img.len().div_ceil(PAYLOAD - HEADER);
            for i in 0..chunks {
                if short && i + 1 == chunks.div_ceil(2) && chunks > 1 {
                    continue;
                }
                while self.urbs.is_empty() {
                    self.wait(Instant::now() + Duration::from_millis(5))?;
                    if !self.committed {
                        break;
                    }
                }
                let Some(u) = self.urbs.pop_front() else { break };
                let part =
                    &img[i * (PAYLOAD - HEADER)..((i + 1) * (PAYLOAD - HEADER)).min(img.len())];
                let part = &part[..part.len().min(u.len - HEADER)];
                let mut buf = [0u8; PAYLOAD];
                buf[0] = HEADER as u8;
                buf[1] = 0x80
                    | self.fid
                    | if i + 1 == chunks { 2 } else { 0 }
                    | if error { 0x40 } else { 0 };
                buf[HEADER..HEADER + part.len()].copy_from_slice(part);
                self.reply(u.seq, 0, &buf[..HEADER + part.len()], HEADER + part.len())?;
            }
        }
        Ok(self.frames)
    }
}
