//! The streaming queue of a V4L2 capture device: memory-mapped buffers, requests to the driver.
//!
//! The only module of the program with `unsafe`. What it relies on:
//! * every request gets a pointer to the structure that the request's number was made from, alive
//!   and writable during the call;
//! * a mapping is read only while the buffer is dequeued (the driver does not write to it then) and
//!   unmapped only when the queue is dropped, which nothing borrowed from it outlives.

use std::ffi::c_void;
use std::fmt;
use std::io;
use std::mem::zeroed;
use std::sync::Arc;
use std::time::Duration;
use v4l::device::Handle;
use v4l::v4l_sys::{v4l2_buffer, v4l2_requestbuffers};
use v4l::v4l2::{self, vidioc};

const CAPTURE: u32 = 1;
const MMAP: u32 = 1;
const FLAG_ERROR: u32 = 0x40;
/// Which clock a time stamp is of, and the value for `CLOCK_MONOTONIC`.
const FLAG_CLOCK: u32 = 0xe000;
const FLAG_CLOCK_MONOTONIC: u32 = 0x2000;
/// `POLLIN`.
const READABLE: i16 = 1;
// The same on every Linux.
const PROT_READ_WRITE: i32 = 3;
const MAP_SHARED: i32 = 1;
pub(super) const ENOENT: i32 = 2;
pub(super) const EIO: i32 = 5;
pub(super) const ENXIO: i32 = 6;
pub(super) const EAGAIN: i32 = 11;
pub(super) const EBUSY: i32 = 16;
pub(super) const ENODEV: i32 = 19;
pub(super) const EINVAL: i32 = 22;

/// A filled buffer. It belongs to the holder until [`Queue::give`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Filled {
    index: u32,
    /// Bytes the driver wrote.
    pub used: usize,
    /// Whether the driver marked it as damaged.
    pub error: bool,
    /// Frame number; wraps.
    pub sequence: u32,
    /// Time stamp on the driver's clock.
    pub stamp: Duration,
    /// Whether that clock is `CLOCK_MONOTONIC`, which [`monotonic`] reads.
    pub monotonic: bool,
}

struct Mapping {
    start: *mut c_void,
    length: usize,
}

/// Buffers of a device, streaming until dropped.
pub(super) struct Queue {
    device: Arc<Handle>,
    mappings: Vec<Mapping>,
    on: bool,
}

// SAFETY: the mappings are plain memory of the process, valid from any thread; `Queue` has no
// interior mutability, so moving it to another thread moves all access along.
unsafe impl Send for Queue {}

impl fmt::Debug for Queue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Queue").field("buffers", &self.mappings.len()).finish_non_exhaustive()
    }
}

/// Makes a request, again when a signal came in between.
fn request<T>(device: &Handle, number: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
    loop {
        let pointer = std::ptr::from_mut(argument).cast::<c_void>();
        // SAFETY: `argument` lives and is writable during the call, and every caller in this module
        // passes the structure that `number` was made from.
        match unsafe { v4l2::ioctl(device.fd(), number, pointer) } {
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            done => return done,
        }
    }
}

/// `CLOCK_MONOTONIC` now: the clock of most drivers' time stamps, and of [`std::time::Instant`].
pub(super) fn monotonic() -> Option<Duration> {
    let mut now = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the structure is alive and writable during the call.
    if unsafe { libc::clock_gettime(libc::CLOCK_MONOTONIC, &raw mut now) } != 0 {
        return None;
    }
    Some(Duration::new(u64::try_from(now.tv_sec).ok()?, u32::try_from(now.tv_nsec).ok()?))
}

fn descriptor(index: u32) -> v4l2_buffer {
    // SAFETY: a structure of integers and unions of integers and pointers; all zeros is a value.
    let mut buffer: v4l2_buffer = unsafe { zeroed() };
    buffer.index = index;
    buffer.type_ = CAPTURE;
    buffer.memory = MMAP;
    buffer
}

impl Queue {
    /// Asks for buffers, maps them, hands them to the driver and starts it.
    pub fn start(device: Arc<Handle>, count: u32) -> io::Result<Self> {
        // SAFETY: a structure of integers; all zeros is a value.
        let mut ask: v4l2_requestbuffers = unsafe { zeroed() };
        (ask.count, ask.type_, ask.memory) = (count, CAPTURE, MMAP);
        request(&device, vidioc::VIDIOC_REQBUFS, &mut ask)?;
        let mut queue =
            Self { device, mappings: Vec::with_capacity(ask.count as usize), on: false };
        for index in 0..ask.count {
            let mut buffer = descriptor(index);
            request(&queue.device, vidioc::VIDIOC_QUERYBUF, &mut buffer)?;
            let length = buffer.length as usize;
            // SAFETY: QUERYBUF of a memory-mapped buffer filled in `offset`.
            let offset = unsafe { buffer.m.offset };
            // SAFETY: a new mapping at a place the kernel chooses; offset and length are the driver's.
            let start = unsafe {
                v4l2::mmap(
                    std::ptr::null_mut(),
                    length,
                    PROT_READ_WRITE,
                    MAP_SHARED,
                    queue.device.fd(),
                    offset.into(),
                )?
            };
            queue.mappings.push(Mapping { start, length });
        }
        if queue.mappings.len() < 2 {
            let reason = format!("the driver gave {} buffers, two are needed", ask.count);
            return Err(io::Error::other(reason));
        }
        for index in 0..ask.count {
            queue.hand_over(index)?;
        }
        let mut kind = CAPTURE;
        request(&queue.device, vidioc::VIDIOC_STREAMON, &mut kind)?;
        queue.on = true;
        Ok(queue)
    }

    /// Length of the shortest buffer.
    pub fn shortest(&self) -> usize {
        self.mappings.iter().map(|m| m.length).min().unwrap_or(0)
    }

    fn hand_over(&self, index: u32) -> io::Result<()> {
        request(&self.device, vidioc::VIDIOC_QBUF, &mut descriptor(index))
    }

    /// Waits until a buffer is filled or something else is to be said; `false` after `wait`.
    pub fn wait(&self, wait: Duration) -> io::Result<bool> {
        let ms = i32::try_from(wait.as_micros().div_ceil(1000)).unwrap_or(i32::MAX);
        match self.device.poll(READABLE, ms) {
            Ok(n) => Ok(n > 0),
            // A signal: the caller looks at what it asks for.
            Err(e) if e.kind() == io::ErrorKind::Interrupted => Ok(false),
            Err(e) => Err(e),
        }
    }

    /// The next filled buffer; `None` when there is none.
    pub fn take(&mut self) -> io::Result<Option<Filled>> {
        let mut buffer = descriptor(0);
        match request(&self.device, vidioc::VIDIOC_DQBUF, &mut buffer) {
            Ok(()) => {}
            Err(e) if e.raw_os_error() == Some(EAGAIN) => return Ok(None),
            Err(e) => return Err(e),
        }
        if buffer.index as usize >= self.mappings.len() {
            return Err(io::Error::other("the driver returned a buffer that does not exist"));
        }
        let seconds = u64::try_from(buffer.timestamp.tv_sec).unwrap_or(0);
        let micros = u32::try_from(buffer.timestamp.tv_usec).unwrap_or(0).min(999_999);
        Ok(Some(Filled {
            index: buffer.index,
            used: buffer.bytesused as usize,
            error: buffer.flags & FLAG_ERROR != 0,
            sequence: buffer.sequence,
            stamp: Duration::new(seconds, micros * 1000),
            monotonic: buffer.flags & FLAG_CLOCK == FLAG_CLOCK_MONOTONIC,
        }))
    }

    /// Gives a buffer back to the driver.
    pub fn give(&mut self, filled: Filled) -> io::Result<()> {
        self.hand_over(filled.index)
    }

    /// All bytes of a filled buffer.
    pub fn bytes(&self, filled: &Filled) -> &[u8] {
        match self.mappings.get(filled.index as usize) {
            // SAFETY: a mapping of this length that lives as long as `self`; the buffer is dequeued
            // (a `Filled` exists only between `take` and `give`, which need `&mut self`), so nobody
            // writes to it.
            Some(m) => unsafe { std::slice::from_raw_parts(m.start.cast::<u8>(), m.length) },
            None => &[],
        }
    }
}

impl Drop for Queue {
    fn drop(&mut self) {
        // None of this can fail in a way that matters: an unplugged device answers ENODEV.
        if self.on {
            let mut kind = CAPTURE;
            let _ = request(&self.device, vidioc::VIDIOC_STREAMOFF, &mut kind);
        }
        for m in self.mappings.drain(..) {
            // SAFETY: mapped by `start` with this length; no slice of it outlives the queue.
            let _ = unsafe { v4l2::munmap(m.start, m.length) };
        }
        // SAFETY: a structure of integers; all zeros is a value.
        let mut none: v4l2_requestbuffers = unsafe { zeroed() };
        (none.type_, none.memory) = (CAPTURE, MMAP);
        let _ = request(&self.device, vidioc::VIDIOC_REQBUFS, &mut none);
    }
}
