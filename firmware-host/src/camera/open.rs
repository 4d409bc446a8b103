//! From a device's name to a running stream.

use super::format::{self, Encoding, FORMATS};
use super::stream::{Shape, Stream};
use super::sys::{EBUSY, EINVAL, ENODEV, ENOENT, ENXIO, Queue};
use crate::host::config::V4l2Config;
use std::io;
use std::thread;
use v4l::capability::Flags;
use v4l::video::Capture as _;
use v4l::{Device, Format, FourCC, Fraction};

/// A camera that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The system said no.
    #[error("{device}: {what}: {source}")]
    System {
        /// The device.
        device: String,
        /// What was tried.
        what: &'static str,
        /// What the system said.
        source: io::Error,
    },
    /// No picture can be had from this node; from a loopback perhaps later, when its writer is there.
    #[error(
        "{device}: no pictures by streaming (single-planar) from here; another node of the same camera \
         may have them (`tsda devices`), and a loopback has once it has a writer (`wait`)"
    )]
    NoCapture {
        /// The device.
        device: String,
    },
    /// The device is not what is needed, or does not do what was asked.
    #[error("{device}: {reason}")]
    Unsuited {
        /// The device.
        device: String,
        /// What and what to do.
        reason: String,
    },
}

impl OpenError {
    /// Whether the device is not there.
    pub fn is_absent(&self) -> bool {
        matches!(self, Self::System { source, .. }
            if matches!(source.raw_os_error(), Some(ENOENT | ENXIO | ENODEV)))
    }

    /// Whether waiting may help: the device is not there, in use, or without a writer.
    pub fn may_pass(&self) -> bool {
        match self {
            Self::System { source, .. } => self.is_absent() || source.raw_os_error() == Some(EBUSY),
            Self::NoCapture { .. } => true,
            Self::Unsuited { .. } => false,
        }
    }
}

/// Opens a camera and starts it. The crate below panics on some of what drivers say; that is kept
/// from the caller.
///
/// # Errors
/// When the device is not there, does not capture, or answers with another format or size.
pub fn open(config: &V4l2Config) -> Result<Stream, OpenError> {
    let (device, config) = (config.device.display().to_string(), config.clone());
    let name = device.clone();
    let work = thread::Builder::new().name("tsda-open".into()).spawn(move || start(&config, &name));
    match work.map(thread::JoinHandle::join) {
        Ok(Ok(done)) => done,
        Ok(Err(_)) => Err(OpenError::Unsuited {
            device,
            reason: "the driver answers with values that are not understood".into(),
        }),
        Err(source) => Err(OpenError::System { device, what: "starting a thread", source }),
    }
}

fn start(config: &V4l2Config, name: &str) -> Result<Stream, OpenError> {
    let system = |what| move |source| OpenError::System { device: name.to_owned(), what, source };
    let unsuited = |reason: String| OpenError::Unsuited { device: name.to_owned(), reason };
    if name.contains('\0') {
        return Err(unsuited("the name contains a zero byte".into()));
    }
    let device = Device::with_path(&config.device).map_err(system("open"))?;
    let no_capture = || OpenError::NoCapture { device: name.to_owned() };
    // Before the capabilities: v4l2loopback 0.12 keeps what it answers there, and a loopback asked after
    // its writer has gone refuses every later writer.
    let now = device.format().map_err(|e| match e.raw_os_error() {
        Some(EINVAL) => no_capture(),
        _ => system("read the format")(e),
    })?;
    let caps = device.query_caps().map_err(system("query capabilities"))?;
    if !caps.capabilities.contains(Flags::VIDEO_CAPTURE | Flags::STREAMING) {
        return Err(no_capture());
    }
    let (code, encoding, full) = choose(&device, config, &unsuited)?;
    let [width, height] = config.size.unwrap_or([now.width, now.height]);
    let fourcc = FourCC::new(&code_bytes(code));
    let got =
        device.set_format(&Format::new(width, height, fourcc)).map_err(system("set the format"))?;
    if got.fourcc != fourcc || (got.width, got.height) != (width, height) {
        let reason = format!(
            "asked for {width} x {height} {code}, the camera answers {} x {} {}; `tsda devices` \
             lists what it has",
            got.width, got.height, got.fourcc
        );
        return Err(unsuited(reason));
    }
    let mut rate = None;
    if let Some(asked) = config.rate {
        let interval = Fraction::new(1000, (asked * 1000.0).round().clamp(1.0, 1e9) as u32);
        let mut params = device.params().map_err(system("read the frame rate"))?;
        params.interval = interval;
        let got = device.set_params(&params).map_err(system("set the frame rate"))?.interval;
        if got.numerator > 0 {
            rate = Some(f64::from(got.denominator) / f64::from(got.numerator));
        }
    }
    controls(&device, config, &unsuited)?;
    let queue = Queue::start(device.handle(), config.buffers.clamp(3, 32))
        .map_err(system("start streaming"))?;
    let shape = Shape {
        width: width as usize,
        height: height as usize,
        stride: got.stride as usize,
        encoding,
        full,
        rate,
    };
    let what = format!("{} ({}), {width} x {height} {}", name, caps.card, code.trim_end());
    Stream::new(queue, shape, what).map_err(unsuited)
}

fn choose(
    device: &Device,
    config: &V4l2Config,
    unsuited: &dyn Fn(String) -> OpenError,
) -> Result<(&'static str, Encoding, u16), OpenError> {
    let known = || FORMATS.map(|f| f.0.trim_end()).join(", ");
    if let Some(code) = &config.format {
        return format::find(code)
            .ok_or_else(|| unsuited(format!("format `{code}` is none of {}", known())));
    }
    let offered: Vec<String> =
        device.enum_formats().unwrap_or_default().iter().map(|f| f.fourcc.to_string()).collect();
    FORMATS.into_iter().find(|f| offered.iter().any(|o| o.trim_end() == f.0.trim_end())).ok_or_else(
        || {
            let reason = format!("it offers {}; {} are read", offered.join(", "), known());
            unsuited(reason)
        },
    )
}

fn controls(
    device: &Device,
    config: &V4l2Config,
    unsuited: &dyn Fn(String) -> OpenError,
) -> Result<(), OpenError> {
    if config.controls.is_empty() {
        return Ok(());
    }
    let there = device.query_controls().unwrap_or_default();
    for (name, value) in &config.controls {
        let control = there.iter().find(|c| c.name == *name).ok_or_else(|| {
            let names: Vec<&str> = there.iter().map(|c| c.name.as_str()).collect();
            unsuited(format!("no control `{name}`; there are {}", names.join(", ")))
        })?;
        // Drivers take what is out of range for the nearest value and say nothing.
        if control.typ != v4l::control::Type::Button
            && !(control.minimum..=control.maximum).contains(value)
        {
            let (low, high) = (control.minimum, control.maximum);
            return Err(unsuited(format!(
                "control `{name}` = {value}: it goes from {low} to {high}"
            )));
        }
        device
            .set_control(v4l::Control {
                id: control.id,
                value: v4l::control::Value::Integer(*value),
            })
            .map_err(|e| unsuited(format!("control `{name}` = {value}: {e}")))?;
    }
    Ok(())
}

fn code_bytes(code: &str) -> [u8; 4] {
    let mut bytes = [b' '; 4];
    for (to, from) in bytes.iter_mut().zip(code.bytes()) {
        *to = from;
    }
    bytes
}
