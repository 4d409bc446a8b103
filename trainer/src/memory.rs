//! The allocator's settings.

#![allow(unsafe_code)]

/// Tells glibc's allocator to keep what is freed. A training step allocates and frees the same few
/// hundred megabytes every time; by default large blocks go back to the system and come again as
/// pages to be cleared, which is a tenth of a step's CPU time. Call it first in `main`; does nothing
/// with other C libraries, nor where the variables `MALLOC_*_` already say something.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        use core::ffi::c_int;
        // From malloc.h.
        const M_TRIM_THRESHOLD: c_int = -1;
        const M_MMAP_THRESHOLD: c_int = -3;
        const GIB: c_int = 1 << 30;
        // The largest that old versions take.
        const OLD_LIMIT: c_int = 32 << 20;
        unsafe extern "C" {
            fn mallopt(parameter: c_int, value: c_int) -> c_int;
        }
        let set = |variable: &str, parameter, values: &[c_int]| {
            if std::env::var_os(variable).is_none() {
                // SAFETY: `mallopt` takes any two integers and locks what it changes.
                let _taken = values.iter().any(|v| unsafe { mallopt(parameter, *v) } == 1);
            }
        };
        set("MALLOC_TRIM_THRESHOLD_", M_TRIM_THRESHOLD, &[GIB]);
        set("MALLOC_MMAP_THRESHOLD_", M_MMAP_THRESHOLD, &[GIB, OLD_LIMIT]);
    }
}
