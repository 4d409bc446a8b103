//! What plays cameras in the virtual machine of the V4L2 tests: writes frames into v4l2loopback, plays
//! USB cameras, sets controls of vivid, says what a device is set to.
mod raw;
mod usbcam;

use raw::*;
use std::path::Path;
use std::time::{Duration, Instant};

type R<T> = Result<T, Box<dyn std::error::Error>>;

fn arg(args: &[String], key: &str) -> Option<String> {
    args.iter().position(|a| a == key).and_then(|i| args.get(i + 1)).cloned()
}
fn num<T: std::str::FromStr>(args: &[String], key: &str, default: T) -> T {
    arg(args, key).and_then(|v| v.parse().ok()).unwrap_or(default)
}
fn size(args: &[String]) -> R<(u32, u32)> {
    let s = arg(args, "--size").unwrap_or_else(|| "640x480".into());
    let (w, h) = s.split_once('x').ok_or("--size is WxH")?;
    Ok((w.parse()?, h.parse()?))
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = args.iter().map(String::as_str).collect();
    let r = match words[..] {
        ["caps", device, ..] => caps(device),
        ["set", device, control, value, ..] => Device::open(device)
            .and_then(|d| d.set_ctrl_by_name(control, value.parse().unwrap_or(0)))
            .map_err(Into::into),
        ["get", device, control, ..] => Device::open(device)
            .and_then(|d| d.get_ctrl_by_name(control))
            .map(|value| println!("{value}"))
            .map_err(Into::into),
        ["feed", device, ..] => feed(device, &args),
        ["usbcam", model, ..] => usb_cam(model, &args),
        _ => {
            eprintln!(
                "usage: v4l2probe caps DEV | set DEV CONTROL VALUE | get DEV CONTROL | feed DEV .. | usbcam MODEL .."
            );
            std::process::exit(2)
        }
    };
    if let Err(e) = r {
        eprintln!("FAIL: {e}");
        std::process::exit(1);
    }
}

fn caps(path: &str) -> R<()> {
    let f = Device::open(path)?.get_fmt(BUF_CAPTURE)?;
    println!("current: {}x{} {}", f.width, f.height, fourcc_str(f.pixelformat));
    Ok(())
}

/// Frames of a file, in a loop: raw ones of one size, or JPEGs laid end to end for MJPG. With
/// `--go FILE` the first is repeated until that file is there, so that two feeders start together;
/// says how many frames that took.
fn feed(path: &str, args: &[String]) -> R<()> {
    let (w, h) = size(args)?;
    let fcc = arg(args, "--fourcc").unwrap_or_else(|| "YUYV".into());
    let (n, fps): (u32, u32) = (num(args, "-n", 100), num(args, "--fps", 30));
    let d = Device::open(path)?;
    let f =
        d.set_fmt(BUF_OUTPUT, w, h, fourcc(&fcc)).map_err(|e| format!("set the format: {e}"))?;
    if f.pixelformat != fourcc(&fcc) || (f.width, f.height) != (w, h) {
        return Err("the loopback took another format".into());
    }
    let file = std::fs::read(arg(args, "--file").ok_or("--file is missing")?)?;
    let mut frames: Vec<&[u8]> = Vec::new();
    if fcc == "MJPG" {
        let mut at = 0;
        while let Some(len) = file[at..].windows(2).position(|m| m == [0xff, 0xd9]) {
            frames.push(&file[at..at + len + 2]);
            at += len + 2;
        }
    } else {
        let bits = match fcc.as_str() {
            "NV12" => 12,
            "RGB3" | "BGR3" => 24,
            "GREY" => 8,
            _ => 16,
        };
        frames.extend(file.chunks_exact(w as usize * h as usize * bits / 8));
    }
    let pause = Duration::from_secs_f64(1.0 / f64::from(fps));
    let mut held = 0;
    if let Some(go) = arg(args, "--go") {
        while !Path::new(&go).exists() {
            d.write_frame(frames[0]).map_err(|e| format!("first write: {e}"))?;
            held += 1;
            std::thread::sleep(pause);
        }
    }
    println!("held {held}");
    let t0 = Instant::now();
    for i in 0..n {
        d.write_frame(frames[i as usize % frames.len()]).map_err(|e| format!("write {i}: {e}"))?;
        let due = t0 + pause * (i + 1);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
    Ok(())
}

/// Where the target is in frame `n`: a slow Lissajous path, the same on both sides.
fn target(n: u32, w: u32, h: u32) -> (f32, f32) {
    let t = n as f32 * 0.08;
    ((0.5 + 0.35 * t.sin()) * w as f32, (0.5 + 0.35 * (1.3 * t).cos()) * h as f32)
}
const BOX: f32 = 6.0;

fn paint(buf: &mut [u8], fcc: &str, n: u32, w: u32, h: u32) {
    let (cx, cy) = target(n, w, h);
    for y in 0..h {
        for x in 0..w {
            let hot = (x as f32 - cx).abs() <= BOX && (y as f32 - cy).abs() <= BOX;
            let i = ((y * w + x) * 2) as usize;
            if fcc == "YUYV" {
                buf[i] = if hot { 235 } else { 40 + ((x * 3 + y * 5) % 60) as u8 };
                buf[i + 1] = 128;
            } else {
                // radiometric counts: 0.01 K, background about 20 C, target 37 C
                let v: u16 = if hot { 31015 } else { 29315 + ((x * 3 + y * 5) % 200) as u16 };
                buf[i..i + 2].copy_from_slice(&v.to_le_bytes());
            }
        }
    }
    // frame stamp in the first two pixels and in the last two: a torn frame shows
    let end = (w * h * 2) as usize;
    buf[..4].copy_from_slice(&n.to_le_bytes());
    buf[end - 4..end].copy_from_slice(&n.to_le_bytes());
}

/// What a Lepton says under its picture: status (flat field correction in bits 4 and 5) in words 3
/// and 4, frame counter in words 20 and 21, low words first; whether raw values are temperatures, and that
/// their steps are 0.01 K, in words 48 and 49 of the third group of 80.
fn telemetry(rows: &mut [u8], n: u32, ffc: u32, tlinear: bool) {
    let mut long = |word: usize, value: u32| {
        rows[2 * word..2 * word + 4].copy_from_slice(&value.to_le_bytes());
    };
    long(3, ffc << 4);
    long(20, n);
    long(208, u32::from(tlinear) | 1 << 16);
}

/// Raw frames of a file that go by time from the moment `go` was made (the first one before), so that
/// cameras that play the same scene agree, also one that was plugged in again.
struct Reel {
    data: Vec<u8>,
    frame: usize,
    go: String,
    fps: f64,
}

impl Reel {
    fn open(args: &[String], frame: usize, fps: u32) -> R<Option<Self>> {
        let Some(file) = arg(args, "--file") else { return Ok(None) };
        let data = std::fs::read(file)?;
        if frame == 0 || data.len() < frame {
            return Err("the file holds no frame".into());
        }
        let go = arg(args, "--go").ok_or("--go is missing")?;
        Ok(Some(Self { data, frame, go, fps: f64::from(fps) }))
    }

    fn now(&self) -> &[u8] {
        let since = std::fs::metadata(&self.go).and_then(|m| m.modified()).ok();
        let time = since.and_then(|t| t.elapsed().ok()).unwrap_or_default();
        let last = self.data.len() / self.frame - 1;
        let i = ((time.as_secs_f64() * self.fps) as usize).min(last);
        &self.data[i * self.frame..][..self.frame]
    }
}

/// R, G, B to YUYV, BT.601 limited range.
fn to_yuyv(rgb: &[u8], out: &mut [u8]) {
    for (from, to) in rgb.chunks_exact(6).zip(out.chunks_exact_mut(4)) {
        let at = |i: usize| f32::from(from[i]);
        let y = |i| 16.0 + 0.257 * at(i) + 0.504 * at(i + 1) + 0.098 * at(i + 2);
        let [r, g, b] = [0, 1, 2].map(|i| (at(i) + at(i + 3)) / 2.0);
        let u = 128.0 - 0.148 * r - 0.291 * g + 0.439 * b;
        let v = 128.0 + 0.439 * r - 0.368 * g - 0.071 * b;
        to.copy_from_slice(&[y(0), u, y(3), v].map(|x| (x + 0.5) as u8));
    }
}

/// Plays a USB camera: `usbcam MODEL [--fps N] [--frames N] [--unplug-at N --replug-ms N] ...`
fn usb_cam(model: &str, args: &[String]) -> R<()> {
    let m = usbcam::MODELS.iter().find(|m| m.name == model).ok_or("no such model")?;
    let plan = usbcam::Plan {
        short_every: num(args, "--short-every", 0),
        error_every: num(args, "--error-every", 0),
        stall_at: num(args, "--stall-at", 0),
        stall_ms: num(args, "--stall-ms", 3000),
        unplug_at: num(args, "--unplug-at", 0),
    };
    let (ffc_every, ffc_frames): (u32, u32) =
        (num(args, "--ffc-every", 0), num(args, "--ffc-frames", 4));
    let tlinear = num(args, "--tlinear", 1) == 1;
    let mut left: u32 = num(args, "--plugs", if plan.unplug_at > 0 { 2 } else { 1 });
    while left > 0 {
        left -= 1;
        let fps = num(args, "--fps", 9);
        let bytes = 320 * 240 * if model == "webcam" { 3 } else { 2 };
        let reel = Reel::open(args, bytes, fps)?;
        let c = usbcam::plug(m, fps)?;
        let mut p = plan.clone();
        if left == 0 {
            p.unplug_at = 0;
        }
        let n = c.run(num(args, "--frames", 100_000), &p, |b, n, w, h| {
            let (w, h) = (w as u32, h as u32);
            if let Some(reel) = &reel {
                return match model {
                    "webcam" => to_yuyv(reel.now(), b),
                    _ => b.copy_from_slice(reel.now()),
                };
            }
            match (model, w, h) {
                // two telemetry rows under the picture; the shutter closes now and then
                ("purethermal", 160, 122) => {
                    let ffc = ffc_every > 0 && n % ffc_every >= ffc_every - ffc_frames;
                    if ffc {
                        b[..38400].fill(0x72);
                    } else {
                        paint(&mut b[..38400], "Y16 ", n, w, 120);
                    }
                    telemetry(&mut b[38400..], n, if ffc { 2 } else { 3 }, tlinear);
                }
                ("boson", _, 514) => paint(&mut b[..640 * 512 * 2], "Y16 ", n, w, 512),
                // picture above, temperatures below
                ("p2pro", _, 384) => {
                    let (top, low) = b.split_at_mut(256 * 192 * 2);
                    paint(top, "YUYV", n, w, 192);
                    paint(low, "Y16 ", n, w, 192);
                    for c in low.chunks_exact_mut(2).skip(2) {
                        let k = u16::from_le_bytes([c[0], c[1]]) as u32 * 64 / 100; // 0.01 K to 1/64 K
                        c.copy_from_slice(&(k as u16).to_le_bytes());
                    }
                }
                ("p2pro", ..) => paint(b, "YUYV", n, w, h),
                _ if b.len() == (w * h * 2) as usize => paint(b, "Y16 ", n, w, h),
                _ => b.fill(n as u8),
            }
        })?;
        println!("usbcam: {n} frames sent, plug pulled");
        std::thread::sleep(Duration::from_millis(num(args, "--replug-ms", 1500)));
    }
    Ok(())
}
