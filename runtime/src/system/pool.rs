//! A pool of memory for engines that allocate while they compute: two-level segregated fit, so every
//! request takes constant time, no system call, and no page that had been given back has to be
//! mapped again.
//!
//! Work inside [`pooled`] is served from the pool, on whichever thread it says so; a worker thread
//! says so for itself. Blocks may outlive the scope and may be freed anywhere. [`growing`] makes the
//! pool larger where it is too small, which is how an engine finds its size while it is loaded.
//! Outside of it the pool keeps its size: what does not fit comes from the system and is counted.
//!
//! Unsafe: raw blocks, and a free list that only a lock keeps to one thread at a time.

use rlsf::Tlsf;
use std::alloc::{GlobalAlloc as _, Layout, System};
use std::cell::{Cell, UnsafeCell};
use std::ptr::NonNull;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};

/// Most pieces the pool consists of. Each is half as large as all before it, so this is plenty.
const MOST_REGIONS: usize = 32;
/// Smallest piece.
const SMALLEST: usize = 1 << 20;
/// Tries for the lock before the thread lets others run.
const SPINS: u32 = 1000;

/// Sizes of up to 8 GiB, 32 lists for each power of two.
type Lists = Tlsf<'static, u32, u32, 28, 32>;

/// How full the pool is and was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PoolUsage {
    /// Bytes the pool has.
    pub capacity: usize,
    /// Bytes of it that are in use.
    pub in_use: usize,
    /// Most bytes that were in use at one time.
    pub high_water: usize,
    /// Requests that did not fit and went to the system's allocator.
    pub overflows: u64,
    /// Bytes asked for in them.
    pub overflow_bytes: u64,
}

struct Region {
    start: AtomicUsize,
    end: AtomicUsize,
}

struct Pool {
    locked: AtomicBool,
    lists: UnsafeCell<Lists>,
    regions: [Region; MOST_REGIONS],
    /// Regions that are there; never fewer than before.
    count: AtomicUsize,
    capacity: AtomicUsize,
    in_use: AtomicUsize,
    high_water: AtomicUsize,
    overflows: AtomicU64,
    overflow_bytes: AtomicU64,
}

// SAFETY: the lists are reached through `with` only, which holds the lock; the rest is atomic.
unsafe impl Sync for Pool {}

impl Pool {
    const fn new() -> Self {
        Self {
            locked: AtomicBool::new(false),
            lists: UnsafeCell::new(Lists::new()),
            regions: [const { Region { start: AtomicUsize::new(0), end: AtomicUsize::new(0) } };
                MOST_REGIONS],
            count: AtomicUsize::new(0),
            capacity: AtomicUsize::new(0),
            in_use: AtomicUsize::new(0),
            high_water: AtomicUsize::new(0),
            overflows: AtomicU64::new(0),
            overflow_bytes: AtomicU64::new(0),
        }
    }

    /// The lists, with the lock held. `work` neither unwinds nor allocates.
    fn with<R>(&self, work: impl FnOnce(&mut Lists) -> R) -> R {
        let mut spins = 0;
        while self
            .locked
            .compare_exchange_weak(false, true, Ordering::Acquire, Ordering::Relaxed)
            .is_err()
        {
            spins += 1;
            if spins % SPINS == 0 {
                std::thread::yield_now();
            } else {
                std::hint::spin_loop();
            }
        }
        // SAFETY: the lock is held, so nobody else has a reference.
        let result = work(unsafe { &mut *self.lists.get() });
        self.locked.store(false, Ordering::Release);
        result
    }

    fn owns(&self, block: *const u8) -> bool {
        // Relaxed: whoever has a block of a region got it from a thread that saw the region.
        let count = self.count.load(Ordering::Relaxed);
        self.regions[..count].iter().any(|r| {
            (r.start.load(Ordering::Relaxed)..r.end.load(Ordering::Relaxed)).contains(&block.addr())
        })
    }

    /// Adds a region with room for `bytes`; false when there is none to be had.
    fn add(&self, bytes: usize) -> bool {
        let Ok(layout) = Layout::from_size_align(bytes, rlsf::GRANULARITY) else { return false };
        // SAFETY: the size is not zero, as both callers see to.
        let Some(start) = NonNull::new(unsafe { System.alloc(layout) }) else { return false };
        let added = self.with(|lists| {
            let index = self.count.load(Ordering::Relaxed);
            let Some(region) = self.regions.get(index) else { return false };
            // SAFETY: fresh memory of this size, which is never given back and which nobody else
            // knows of.
            let usable =
                unsafe { lists.insert_free_block_ptr(NonNull::slice_from_raw_parts(start, bytes)) };
            if usable.is_none() {
                return false;
            }
            region.start.store(start.addr().get(), Ordering::Relaxed);
            region.end.store(start.addr().get() + bytes, Ordering::Relaxed);
            self.count.store(index + 1, Ordering::Release);
            true
        });
        if added {
            self.capacity.fetch_add(bytes, Ordering::Relaxed);
        } else {
            // SAFETY: the block is the system's, of this layout, and was not put into the lists.
            unsafe { System.dealloc(start.as_ptr(), layout) };
        }
        added
    }

    /// Adds a region that a request of this layout fits in.
    fn grow(&self, layout: Layout) -> bool {
        // What the lists add to a request, and their rounding of sizes.
        let request = layout.size() + layout.size() / 16 + 2 * layout.align() + 4096;
        let half = self.capacity.load(Ordering::Relaxed) / 2;
        self.add(request.max(half).max(SMALLEST).next_multiple_of(rlsf::GRANULARITY))
    }

    fn reserve(&self, bytes: usize) -> bool {
        let bytes = bytes.next_multiple_of(rlsf::GRANULARITY);
        let free = self.capacity.load(Ordering::Relaxed) - self.in_use.load(Ordering::Relaxed);
        free >= bytes || self.add(bytes)
    }

    fn took(&self, bytes: usize) {
        let now = self.in_use.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.high_water.fetch_max(now, Ordering::Relaxed);
    }

    fn overflow(&self, bytes: usize) {
        self.overflows.fetch_add(1, Ordering::Relaxed);
        self.overflow_bytes.fetch_add(bytes as u64, Ordering::Relaxed);
    }

    /// A block, unless the pool is full.
    fn allocate(&self, layout: Layout, growing: bool) -> Option<NonNull<u8>> {
        let take = || self.with(|lists| lists.allocate(layout));
        let mut block = take();
        if block.is_none() && growing && self.grow(layout) {
            block = take();
        }
        match block {
            Some(_) => self.took(layout.size()),
            None => self.overflow(layout.size()),
        }
        block
    }

    /// # Safety
    /// As [`std::alloc::GlobalAlloc::dealloc`], for a block that this pool owns.
    unsafe fn free(&self, block: NonNull<u8>, layout: Layout) {
        self.in_use.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the block came from these lists with this alignment.
        self.with(|lists| unsafe { lists.deallocate(block, layout.align()) });
    }

    /// # Safety
    /// As [`std::alloc::GlobalAlloc::realloc`], for a block that this pool owns.
    unsafe fn reallocate(
        &self,
        block: NonNull<u8>,
        layout: Layout,
        size: usize,
        growing: bool,
        from_system: fn(),
    ) -> *mut u8 {
        // SAFETY: the caller promises that size and alignment make a layout.
        let wanted = unsafe { Layout::from_size_align_unchecked(size, layout.align()) };
        // SAFETY: the block came from these lists with this alignment.
        let again = || self.with(|lists| unsafe { lists.reallocate(block, wanted) });
        let mut moved = again();
        if moved.is_none() && growing && self.grow(wanted) {
            moved = again();
        }
        if let Some(moved) = moved {
            self.took(size);
            self.in_use.fetch_sub(layout.size(), Ordering::Relaxed);
            return moved.as_ptr();
        }
        self.overflow(size);
        from_system();
        // SAFETY: both blocks have the smaller number of bytes at least, and are apart; the old one
        // is the pool's.
        unsafe {
            let new = System.alloc(wanted);
            if !new.is_null() {
                new.copy_from_nonoverlapping(block.as_ptr(), layout.size().min(size));
                self.free(block, layout);
            }
            new
        }
    }

    fn usage(&self) -> PoolUsage {
        PoolUsage {
            capacity: self.capacity.load(Ordering::Relaxed),
            in_use: self.in_use.load(Ordering::Relaxed),
            high_water: self.high_water.load(Ordering::Relaxed),
            overflows: self.overflows.load(Ordering::Relaxed),
            overflow_bytes: self.overflow_bytes.load(Ordering::Relaxed),
        }
    }
}

static POOL: Pool = Pool::new();

/// What the allocator does for a thread.
#[derive(Clone, Copy, PartialEq)]
enum Mode {
    /// Leaves the pool alone.
    Off,
    /// Says that it is there.
    Ask,
    /// Serves from the pool as it is.
    Serve,
    /// Serves from the pool and makes it larger.
    Grow,
}

/// Threads inside a scope. While there is none, nobody looks at `MODE`.
static SCOPES: AtomicUsize = AtomicUsize::new(0);
static ASKED: AtomicBool = AtomicBool::new(false);

thread_local! {
    // Without a destructor, so that it can be read as long as the thread allocates.
    static MODE: Cell<Mode> = const { Cell::new(Mode::Off) };
}

fn mode() -> Mode {
    if SCOPES.load(Ordering::Relaxed) == 0 {
        return Mode::Off;
    }
    MODE.try_with(Cell::get).unwrap_or(Mode::Off)
}

fn scope<T>(mode: Mode, work: impl FnOnce() -> T) -> T {
    struct Back(Mode);
    impl Drop for Back {
        fn drop(&mut self) {
            MODE.set(self.0);
            SCOPES.fetch_sub(1, Ordering::Relaxed);
        }
    }
    SCOPES.fetch_add(1, Ordering::Relaxed);
    let _back = Back(MODE.replace(mode));
    work()
}

/// What this thread allocates in `work` comes from the pool, as far as there is room.
pub fn pooled<T>(work: impl FnOnce() -> T) -> T {
    scope(Mode::Serve, work)
}

/// As [`pooled`]; where there is no room the pool is made larger, for good.
pub fn growing<T>(work: impl FnOnce() -> T) -> T {
    scope(Mode::Grow, work)
}

/// Sees to it that this many bytes are free; false when the system does not have them.
pub fn reserve(bytes: usize) -> bool {
    bytes == 0 || POOL.reserve(bytes)
}

/// Whether [`super::Heap`] is the global allocator of this program. Without it the other functions
/// have no effect.
pub fn is_installed() -> bool {
    scope(Mode::Ask, || drop(std::hint::black_box(Box::new(0u8))));
    ASKED.load(Ordering::Relaxed)
}

/// How full the pool is and was.
pub fn pool_usage() -> PoolUsage {
    POOL.usage()
}

/// For [`super::Heap`]: a block for the calling thread, when it is in a scope and there is room.
#[inline]
pub(super) fn allocate(layout: Layout) -> Option<NonNull<u8>> {
    match mode() {
        Mode::Off => None,
        Mode::Ask => {
            ASKED.store(true, Ordering::Relaxed);
            None
        }
        now => POOL.allocate(layout, now == Mode::Grow),
    }
}

/// For [`super::Heap`].
#[inline]
pub(super) fn owns(block: *const u8) -> bool {
    POOL.owns(block)
}

/// For [`super::Heap`].
///
/// # Safety
/// As [`std::alloc::GlobalAlloc::dealloc`], for a block that the pool [`owns`].
pub(super) unsafe fn free(block: *mut u8, layout: Layout) {
    // SAFETY: the block is the pool's, so it is not null; the rest is passed on.
    unsafe { POOL.free(NonNull::new_unchecked(block), layout) }
}

/// For [`super::Heap`]; calls `from_system` when the system had to serve.
///
/// # Safety
/// As [`std::alloc::GlobalAlloc::realloc`], for a block that the pool [`owns`].
pub(super) unsafe fn reallocate(
    block: *mut u8,
    layout: Layout,
    size: usize,
    from_system: fn(),
) -> *mut u8 {
    let growing = mode() == Mode::Grow;
    // SAFETY: the block is the pool's, so it is not null; the rest is passed on.
    unsafe { POOL.reallocate(NonNull::new_unchecked(block), layout, size, growing, from_system) }
}

#[cfg(test)]
mod tests;
