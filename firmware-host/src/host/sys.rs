//! Requests to the system that the standard library has no words for: memory that stays in RAM, the
//! priority of a thread, the speed of a serial line. The only `unsafe` of `host`; every call gets
//! numbers, or a pointer to a structure of this very function that is alive and of the right type.

use std::io;
use std::os::fd::AsRawFd;
use std::time::Duration;

/// Keeps all memory of the process in RAM, also what it gets later.
///
/// # Errors
/// What the system says; usually that the limit (`LimitMEMLOCK`, `ulimit -l`) is too low.
#[cfg(target_os = "linux")]
pub fn lock_memory() -> io::Result<()> {
    // SAFETY: takes only flags; touches no memory of ours.
    check(unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) })
}

/// The calling thread runs before all others of lower priority. Threads that it starts later do not
/// inherit this.
///
/// # Errors
/// What the system says; usually that the right (`LimitRTPRIO`, CAP_SYS_NICE) is missing.
#[cfg(target_os = "linux")]
pub fn real_time(priority: u8) -> io::Result<()> {
    let parameter = libc::sched_param { sched_priority: priority.into() };
    let policy = libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK;
    // SAFETY: thread 0 is the calling one; the parameter is alive during the call.
    check(unsafe { libc::sched_setscheduler(0, policy, &raw const parameter) })
}

/// Not on this system.
///
/// # Errors
/// Always.
#[cfg(not(target_os = "linux"))]
pub fn lock_memory() -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Not on this system.
///
/// # Errors
/// Always.
#[cfg(not(target_os = "linux"))]
pub fn real_time(_: u8) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Lets all threads share two heaps. By default a thread that finds the others' heaps busy gets one of
/// its own, up to eight per core, each of which keeps what it once needed: with a thread per output and
/// per connection, memory grows for hours though nothing leaks. For the start of a program; on other
/// systems than Linux with glibc there is nothing to do.
pub fn share_heaps() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: takes only numbers, and allocators may be told at any time.
    // What it answers does not matter: the default is only larger.
    let _ = unsafe { libc::mallopt(libc::M_ARENA_MAX, 2) };
}

/// Sets a serial line to raw bytes at a speed, eight bits, no parity.
///
/// # Errors
/// When it is no serial line or does not know the speed.
pub fn serial(line: &impl AsRawFd, baud: u32) -> io::Result<()> {
    let speed = match baud {
        9_600 => libc::B9600,
        19_200 => libc::B19200,
        38_400 => libc::B38400,
        57_600 => libc::B57600,
        115_200 => libc::B115200,
        230_400 => libc::B230400,
        #[cfg(target_os = "linux")]
        460_800 => libc::B460800,
        #[cfg(target_os = "linux")]
        921_600 => libc::B921600,
        _ => return Err(io::Error::new(io::ErrorKind::InvalidInput, "no usual speed")),
    };
    let fd = line.as_raw_fd();
    // SAFETY: all-zero is a valid `termios`: it holds only numbers.
    let mut settings: libc::termios = unsafe { std::mem::zeroed() };
    // SAFETY: the descriptor belongs to the line that is borrowed; the structure is alive.
    check(unsafe { libc::tcgetattr(fd, &raw mut settings) })?;
    // SAFETY: as above.
    unsafe { libc::cfmakeraw(&raw mut settings) };
    settings.c_cflag |= libc::CLOCAL | libc::CREAD;
    settings.c_cc[libc::VMIN] = 0;
    settings.c_cc[libc::VTIME] = 0;
    // SAFETY: as above.
    check(unsafe { libc::cfsetspeed(&raw mut settings, speed) })?;
    // SAFETY: as above.
    check(unsafe { libc::tcsetattr(fd, libc::TCSANOW, &raw const settings) })
}

/// Waits for bytes; answers whether there are any.
///
/// # Errors
/// `BrokenPipe` when the other end is gone and nothing is left to be read.
pub fn readable(line: &impl AsRawFd, patience: Duration) -> io::Result<bool> {
    let mut asked = libc::pollfd { fd: line.as_raw_fd(), events: libc::POLLIN, revents: 0 };
    let millis = i32::try_from(patience.as_millis()).unwrap_or(i32::MAX);
    // SAFETY: one structure that is alive, of a descriptor that is borrowed.
    match unsafe { libc::poll(&raw mut asked, 1, millis) } {
        -1 => Err(io::Error::last_os_error()),
        0 => Ok(false),
        _ if asked.revents & libc::POLLIN != 0 => Ok(true),
        _ => Err(io::ErrorKind::BrokenPipe.into()),
    }
}

/// Our end of a pseudo-terminal, and the name of the end that is to be taken for a serial line.
#[cfg(all(test, target_os = "linux"))]
pub fn pseudo_terminal() -> io::Result<(std::fs::File, std::path::PathBuf)> {
    let ours = std::fs::OpenOptions::new().read(true).write(true).open("/dev/ptmx")?;
    let (fd, mut number, locked) = (ours.as_raw_fd(), 0u32, 0i32);
    // SAFETY: the descriptor is alive, and so are the numbers that the two requests read and write.
    check(unsafe { libc::ioctl(fd, libc::TIOCSPTLCK, &raw const locked) })?;
    // SAFETY: as above.
    check(unsafe { libc::ioctl(fd, libc::TIOCGPTN, &raw mut number) })?;
    Ok((ours, format!("/dev/pts/{number}").into()))
}

fn check(answer: i32) -> io::Result<()> {
    if answer == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}
