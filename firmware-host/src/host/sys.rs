//! Requests to the system that the standard library has no words for: memory that stays in RAM, the
//! priority of a thread, the speed of a serial line. The only `unsafe` of `host`; every call gets
//! numbers, or a pointer to a structure of this very function that is alive and of the right type.

use std::io;
use std::os::fd::AsRawFd;

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

/// Sets a serial line to raw bytes at a speed, eight bits, no parity; reads answer after a tenth of a
/// second at the latest.
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
    settings.c_cc[libc::VTIME] = 1;
    // SAFETY: as above.
    check(unsafe { libc::cfsetspeed(&raw mut settings, speed) })?;
    // SAFETY: as above.
    check(unsafe { libc::tcsetattr(fd, libc::TCSANOW, &raw const settings) })
}

fn check(answer: i32) -> io::Result<()> {
    if answer == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}
