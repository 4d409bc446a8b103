//! Files mapped into memory, so that a large bundle is never held twice: what has been read is handed
//! back to the system, page by page. Unsafe: calls into the C library, and a slice over what they
//! answer.

use std::fs::File;
use std::io;

/// A file, readable as bytes. Whoever changes the file meanwhile changes the bytes, and who shortens
/// it ends the program, so files are to be replaced by renaming, as all our programs do.
#[derive(Debug)]
pub struct Mapping {
    start: *const u8,
    len: usize,
}

// SAFETY: read-only memory that belongs to no thread.
unsafe impl Send for Mapping {}
// SAFETY: as above.
unsafe impl Sync for Mapping {}

#[cfg(all(target_os = "linux", target_pointer_width = "64", not(miri)))]
mod os {
    use std::ffi::c_void;

    pub const PROT_READ: i32 = 1;
    pub const MAP_PRIVATE: i32 = 2;
    pub const MADV_DONTNEED: i32 = 4;

    unsafe extern "C" {
        pub fn mmap(
            address: *mut c_void,
            len: usize,
            protection: i32,
            flags: i32,
            file: i32,
            offset: i64,
        ) -> *mut c_void;
        pub fn munmap(address: *mut c_void, len: usize) -> i32;
        pub fn madvise(address: *mut c_void, len: usize, advice: i32) -> i32;
    }
}

impl Mapping {
    /// Pages of all systems are multiples of this or divide it.
    const PAGE: usize = 1 << 16;

    /// Maps the whole file.
    ///
    /// # Errors
    /// When the system refuses, or this is none on which it is done; the file can then be read.
    #[cfg(all(target_os = "linux", target_pointer_width = "64", not(miri)))]
    pub fn new(file: &File) -> io::Result<Self> {
        use std::os::fd::AsRawFd as _;
        let len =
            usize::try_from(file.metadata()?.len()).map_err(|_| io::ErrorKind::FileTooLarge)?;
        if len == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        // SAFETY: a new mapping at a place the system chooses, of an open file.
        let start = unsafe {
            os::mmap(
                core::ptr::null_mut(),
                len,
                os::PROT_READ,
                os::MAP_PRIVATE,
                file.as_raw_fd(),
                0,
            )
        };
        // The system answers an address of -1 when it refuses.
        if start.addr() == usize::MAX || start.is_null() {
            return Err(io::Error::last_os_error());
        }
        Ok(Self { start: start.cast(), len })
    }

    /// Maps the whole file.
    ///
    /// # Errors
    /// Always: it is not done on this system. The file can be read.
    #[cfg(not(all(target_os = "linux", target_pointer_width = "64", not(miri))))]
    pub fn new(_: &File) -> io::Result<Self> {
        Err(io::ErrorKind::Unsupported.into())
    }

    /// The file.
    pub fn bytes(&self) -> &[u8] {
        // SAFETY: the mapping has this many readable bytes until it is dropped.
        unsafe { core::slice::from_raw_parts(self.start, self.len) }
    }

    /// Hands the memory of a part back to the system; whoever reads it again has it read from the
    /// file again. Does nothing for bytes that are not of this mapping.
    pub fn release(&self, part: &[u8]) {
        let (start, end) = (self.start.addr(), self.start.addr() + self.len);
        let (from, to) = (part.as_ptr().addr(), part.as_ptr().addr() + part.len());
        if from < start || to > end {
            return;
        }
        // Also the rest of the outermost pages: they are read again when they are needed.
        let from = start + (from - start) / Self::PAGE * Self::PAGE;
        let to = to.next_multiple_of(Self::PAGE).min(end);
        #[cfg(all(target_os = "linux", target_pointer_width = "64", not(miri)))]
        // SAFETY: whole pages of this mapping, whose start is that of a page. They are private and
        // were never written, so reading them again gives the same bytes.
        unsafe {
            let at = self.start.add(from - start).cast_mut().cast();
            // Only a wish.
            let _ = os::madvise(at, to - from, os::MADV_DONTNEED);
        }
        #[cfg(not(all(target_os = "linux", target_pointer_width = "64", not(miri))))]
        let _ = (from, to);
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        #[cfg(all(target_os = "linux", target_pointer_width = "64", not(miri)))]
        // SAFETY: the mapping, which nobody borrows any more.
        unsafe {
            let _ = os::munmap(self.start.cast_mut().cast(), self.len);
        }
    }
}

#[cfg(all(test, target_os = "linux", target_pointer_width = "64", not(miri)))]
mod tests {
    use super::*;

    #[test]
    fn released_parts_read_the_same_again() {
        let path = std::env::temp_dir().join(format!("tsda-map-{}", std::process::id()));
        let bytes: Vec<u8> = (0..300_001u32).map(|i| (i % 251) as u8).collect();
        std::fs::write(&path, &bytes).unwrap();
        let map = Mapping::new(&File::open(&path).unwrap()).unwrap();
        assert_eq!(map.bytes(), bytes);
        for part in [0..1, 70_000..200_000, 299_000..300_001, 5..5] {
            map.release(&map.bytes()[part]);
            assert_eq!(map.bytes(), bytes);
        }
        // Memory of others is left alone.
        let mut other = vec![7u8; 1 << 18];
        map.release(&other);
        other[0] = 8;
        assert!(other[1..].iter().all(|&b| b == 7));
        std::fs::write(&path, b"").unwrap();
        drop(map);
        assert!(Mapping::new(&File::open(&path).unwrap()).is_err());
        std::fs::remove_file(&path).unwrap();
    }
}
