//! The global allocator of our programs: the system's, with a counter that can be switched on, one per
//! thread that always counts, and the pool for whoever asks for it.
//!
//! ```
//! #[global_allocator]
//! static HEAP: tsda_runtime::system::Heap = tsda_runtime::system::Heap;
//! ```
//!
//! While nothing is counted and no pool is in use, an allocation costs two loads of a number that
//! nobody writes and the change of one that is the thread's own; the loop of the native engine, which
//! allocates nothing, does not notice it.
//! Unsafe: `GlobalAlloc` is an unsafe trait.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

/// The allocator; see the module.
#[derive(Clone, Copy, Debug, Default)]
pub struct Heap;

/// What was asked for while [`count`] watched, by all threads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Allocations, and reallocations to another size.
    pub allocations: u64,
    /// Bytes asked for in them.
    pub bytes: u64,
    /// Those of them that the system's allocator served; the others came from the pool.
    pub system: u64,
}

static COUNTING: AtomicBool = AtomicBool::new(false);
static ALLOCATIONS: AtomicU64 = AtomicU64::new(0);
static BYTES: AtomicU64 = AtomicU64::new(0);
static SYSTEM: AtomicU64 = AtomicU64::new(0);

/// Counts what all threads allocate during `work`; all zero where [`Heap`] is not the global
/// allocator. One at a time: of two that overlap, both are wrong.
pub fn count<T>(work: impl FnOnce() -> T) -> (T, Counts) {
    let read = || Counts {
        allocations: ALLOCATIONS.load(Relaxed),
        bytes: BYTES.load(Relaxed),
        system: SYSTEM.load(Relaxed),
    };
    let before = read();
    COUNTING.store(true, Relaxed);
    let result = work();
    COUNTING.store(false, Relaxed);
    let after = read();
    let counts = Counts {
        allocations: after.allocations - before.allocations,
        bytes: after.bytes - before.bytes,
        system: after.system - before.system,
    };
    (result, counts)
}

thread_local! {
    // Constant and without a destructor: reading it allocates nothing, at no time of a thread's life.
    static HERE: Cell<u64> = const { Cell::new(0) };
}

/// How often the calling thread has allocated so far, reallocations included; 0 for ever where
/// [`Heap`] is not the global allocator.
pub fn allocations_here() -> u64 {
    HERE.get()
}

#[inline]
fn asked(bytes: usize) {
    HERE.set(HERE.get() + 1);
    if COUNTING.load(Relaxed) {
        ALLOCATIONS.fetch_add(1, Relaxed);
        BYTES.fetch_add(bytes as u64, Relaxed);
    }
}

#[inline]
fn from_system() {
    if COUNTING.load(Relaxed) {
        SYSTEM.fetch_add(1, Relaxed);
    }
}

// SAFETY: every block comes either from the system's allocator or from the pool, both of which keep
// the contract; the pool knows its own addresses, so each block goes back to where it came from, on
// whichever thread. Nothing here unwinds or allocates by itself.
unsafe impl GlobalAlloc for Heap {
    #[inline]
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        asked(layout.size());
        #[cfg(feature = "pool")]
        if let Some(block) = super::pool::allocate(layout) {
            return block.as_ptr();
        }
        from_system();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    #[inline]
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        asked(layout.size());
        #[cfg(feature = "pool")]
        if let Some(block) = super::pool::allocate(layout) {
            // SAFETY: the block has this many bytes; those of the pool may have been used before.
            unsafe { block.as_ptr().write_bytes(0, layout.size()) };
            return block.as_ptr();
        }
        from_system();
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    #[inline]
    unsafe fn realloc(&self, block: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        asked(size);
        #[cfg(feature = "pool")]
        if super::pool::owns(block) {
            // SAFETY: the block is of the pool and of this layout, as the caller promises.
            return unsafe { super::pool::reallocate(block, layout, size, from_system) };
        }
        from_system();
        // SAFETY: the caller's promises are passed on; the block is the system's.
        unsafe { System.realloc(block, layout, size) }
    }

    #[inline]
    unsafe fn dealloc(&self, block: *mut u8, layout: Layout) {
        #[cfg(feature = "pool")]
        if super::pool::owns(block) {
            // SAFETY: the block is of the pool and of this layout, as the caller promises.
            return unsafe { super::pool::free(block, layout) };
        }
        // SAFETY: the caller's promises are passed on; the block is the system's.
        unsafe { System.dealloc(block, layout) }
    }
}
