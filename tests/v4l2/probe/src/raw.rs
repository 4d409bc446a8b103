//! Thin V4L2 layer for the tests: formats, controls, write(); 64-bit Linux, only `libc`.
use std::ffi::CString;
use std::io;
use std::mem::{size_of, zeroed};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd, RawFd};

pub const BUF_CAPTURE: u32 = 1;
pub const BUF_OUTPUT: u32 = 2;
pub const FIELD_NONE: u32 = 1;
pub const CTRL_NEXT: u32 = 0x8000_0000;

#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixFormat {
    pub width: u32,
    pub height: u32,
    pub pixelformat: u32,
    pub field: u32,
    pub bytesperline: u32,
    pub sizeimage: u32,
    pub colorspace: u32,
    pub private: u32,
    pub flags: u32,
    pub enc: u32,
    pub quantization: u32,
    pub xfer_func: u32,
}
#[repr(C, align(8))]
#[derive(Clone, Copy)]
struct FormatUnion([u8; 200]);
#[repr(C)]
#[derive(Clone, Copy)]
struct Format {
    typ: u32,
    _pad: u32,
    u: FormatUnion,
}
#[repr(C)]
#[derive(Clone, Copy)]
pub struct QueryCtrl {
    pub id: u32,
    pub typ: u32,
    pub name: [u8; 32],
    pub minimum: i32,
    pub maximum: i32,
    pub step: i32,
    pub default: i32,
    pub flags: u32,
    reserved: [u32; 2],
}
#[repr(C)]
pub struct Control {
    pub id: u32,
    pub value: i32,
}
const _: () = {
    assert!(size_of::<PixFormat>() == 48);
    assert!(size_of::<Format>() == 208);
    assert!(size_of::<QueryCtrl>() == 68);
};

const fn iowr<T>(nr: u32) -> u64 {
    (3u64 << 30) | ((size_of::<T>() as u64) << 16) | ((b'V' as u64) << 8) | nr as u64
}
fn xioctl<T>(fd: RawFd, req: u64, arg: &mut T) -> io::Result<()> {
    loop {
        // SAFETY: `arg` has exactly the size encoded in `req` (checked by the asserts above).
        let r = unsafe { libc::ioctl(fd, req as _, arg as *mut T) };
        if r != -1 {
            return Ok(());
        }
        let e = io::Error::last_os_error();
        if e.raw_os_error() != Some(libc::EINTR) {
            return Err(e);
        }
    }
}

pub fn fourcc(s: &str) -> u32 {
    let mut b = [b' '; 4];
    for (d, c) in b.iter_mut().zip(s.bytes()) {
        *d = c;
    }
    u32::from_le_bytes(b)
}
pub fn fourcc_str(v: u32) -> String {
    let s: String = (v & 0x7fff_ffff)
        .to_le_bytes()
        .iter()
        .map(|&b| if b.is_ascii_graphic() || b == b' ' { b as char } else { '.' })
        .collect();
    if v & 0x8000_0000 != 0 {
        format!("{s}-BE")
    } else {
        s
    }
}
pub fn cstr(b: &[u8]) -> String {
    let n = b.iter().position(|&c| c == 0).unwrap_or(b.len());
    String::from_utf8_lossy(&b[..n]).into_owned()
}

pub struct Device {
    fd: OwnedFd,
}

impl Device {
    pub fn open(path: &str) -> io::Result<Self> {
        let c = CString::new(path)?;
        let fd =
            unsafe { libc::open(c.as_ptr(), libc::O_RDWR | libc::O_NONBLOCK | libc::O_CLOEXEC) };
        if fd < 0 {
            return Err(io::Error::last_os_error());
        }
        Ok(Self { fd: unsafe { OwnedFd::from_raw_fd(fd) } })
    }
    pub fn fd(&self) -> RawFd {
        self.fd.as_raw_fd()
    }
    pub fn get_fmt(&self, typ: u32) -> io::Result<PixFormat> {
        let mut f: Format = unsafe { zeroed() };
        f.typ = typ;
        xioctl(self.fd(), iowr::<Format>(4), &mut f)?;
        Ok(unsafe { std::ptr::read(f.u.0.as_ptr().cast()) })
    }
    /// Returns what the driver really chose: it may differ from the request.
    pub fn set_fmt(&self, typ: u32, w: u32, h: u32, pixelformat: u32) -> io::Result<PixFormat> {
        let mut f: Format = unsafe { zeroed() };
        f.typ = typ;
        let mut p: PixFormat = unsafe { zeroed() };
        p.width = w;
        p.height = h;
        p.pixelformat = pixelformat;
        p.field = FIELD_NONE;
        unsafe { std::ptr::write(f.u.0.as_mut_ptr().cast(), p) };
        xioctl(self.fd(), iowr::<Format>(5), &mut f)?;
        Ok(unsafe { std::ptr::read(f.u.0.as_ptr().cast()) })
    }
    pub fn query_ctrl(&self, id: u32) -> io::Result<QueryCtrl> {
        let mut q: QueryCtrl = unsafe { zeroed() };
        q.id = id;
        xioctl(self.fd(), iowr::<QueryCtrl>(36), &mut q)?;
        Ok(q)
    }
    pub fn ctrls(&self) -> Vec<QueryCtrl> {
        let (mut v, mut id) = (Vec::new(), CTRL_NEXT);
        while let Ok(q) = self.query_ctrl(id) {
            id = q.id | CTRL_NEXT;
            v.push(q);
        }
        v
    }
    pub fn set_ctrl(&self, id: u32, value: i32) -> io::Result<()> {
        let mut c = Control { id, value };
        xioctl(self.fd(), iowr::<Control>(28), &mut c)
    }
    fn named(&self, name: &str) -> io::Result<QueryCtrl> {
        self.ctrls().into_iter().find(|q| cstr(&q.name) == name).ok_or_else(|| {
            io::Error::new(io::ErrorKind::NotFound, format!("no control named {name}"))
        })
    }
    pub fn set_ctrl_by_name(&self, name: &str, value: i32) -> io::Result<()> {
        let q = self.named(name)?;
        self.set_ctrl(q.id, value)
    }
    pub fn get_ctrl_by_name(&self, name: &str) -> io::Result<i32> {
        let q = self.named(name)?;
        let mut c = Control { id: q.id, value: 0 };
        xioctl(self.fd(), iowr::<Control>(27), &mut c)?;
        Ok(c.value)
    }
    /// write() I/O, used to feed v4l2loopback.
    pub fn write_frame(&self, b: &[u8]) -> io::Result<usize> {
        let r = unsafe { libc::write(self.fd(), b.as_ptr().cast(), b.len()) };
        if r < 0 {
            Err(io::Error::last_os_error())
        } else {
            Ok(r as usize)
        }
    }
}
