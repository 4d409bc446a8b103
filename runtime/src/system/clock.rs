//! What the process has used so far. Unsafe: one call into the C library that every program of std
//! is linked with.

use std::time::Duration;

/// Processor time of all threads of this process; zero where the system does not tell.
pub fn process_cpu() -> Duration {
    #[cfg(all(target_os = "linux", target_pointer_width = "64"))]
    {
        #[repr(C)]
        struct Time {
            seconds: i64,
            nanoseconds: i64,
        }
        unsafe extern "C" {
            fn clock_gettime(clock: i32, time: *mut Time) -> i32;
        }
        const PROCESS: i32 = 2;
        let mut time = Time { seconds: 0, nanoseconds: 0 };
        // SAFETY: the function fills in the struct it is given, whose layout is that of `timespec`
        // on a 64-bit Linux.
        if unsafe { clock_gettime(PROCESS, &mut time) } == 0 {
            return Duration::new(time.seconds as u64, time.nanoseconds as u32);
        }
    }
    Duration::ZERO
}

/// Most bytes of memory that this process has had at one time; `None` where the system does not
/// tell.
pub fn peak_rss() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn the_clock_runs_with_the_work_and_memory_is_seen() {
        let start = process_cpu();
        let mut x = 1u64;
        while process_cpu() < start + Duration::from_millis(2) {
            x = std::hint::black_box(x.wrapping_mul(3));
        }
        let before = peak_rss().unwrap();
        let block = std::hint::black_box(vec![1u8; 64 << 20]);
        assert!(peak_rss().unwrap() >= before.max(block.len() as u64));
    }
}
