//! The pool by itself; the tests' own memory is the system's.

use super::*;
use proptest::prelude::*;

/// A block of the pool or of the system, filled with a pattern.
struct Held {
    block: NonNull<u8>,
    layout: Layout,
    seed: u8,
}

// SAFETY: a block belongs to whoever holds it.
unsafe impl Send for Held {}

fn byte(seed: u8, i: usize) -> u8 {
    seed.wrapping_add((i * 37) as u8)
}

impl Held {
    fn new(pool: &Pool, layout: Layout, seed: u8, growing: bool) -> Option<Self> {
        let block = pool.allocate(layout, growing)?;
        assert_eq!(block.addr().get() % layout.align(), 0, "{layout:?}");
        assert!(pool.owns(block.as_ptr()));
        let held = Self { block, layout, seed };
        held.fill();
        Some(held)
    }

    fn fill(&self) {
        for i in 0..self.layout.size() {
            // SAFETY: inside the block.
            unsafe { self.block.add(i).write(byte(self.seed, i)) };
        }
    }

    fn check(&self, len: usize) {
        for i in 0..len {
            // SAFETY: inside the block, which was written when it was made.
            assert_eq!(unsafe { self.block.add(i).read() }, byte(self.seed, i), "byte {i}");
        }
    }

    fn resize(self, pool: &Pool, size: usize, growing: bool) -> Self {
        let kept = self.layout.size().min(size);
        // SAFETY: a block of the pool with its layout.
        let block = unsafe { pool.reallocate(self.block, self.layout, size, growing, || {}) };
        let layout = Layout::from_size_align(size, self.layout.align()).unwrap();
        let held = Self { block: NonNull::new(block).unwrap(), layout, seed: self.seed };
        assert_eq!(held.block.addr().get() % layout.align(), 0, "{layout:?}");
        held.check(kept);
        held.fill();
        held
    }

    fn free(self, pool: &Pool) {
        self.check(self.layout.size());
        // SAFETY: a block of the pool or of the system with its layout, not used any more.
        unsafe {
            if pool.owns(self.block.as_ptr()) {
                pool.free(self.block, self.layout);
            } else {
                System.dealloc(self.block.as_ptr(), self.layout);
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: if cfg!(miri) { 4 } else { 60 },
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    /// Blocks of all alignments keep their bytes through any order of requests, in a pool that grows
    /// and in one that is soon full.
    #[test]
    fn blocks_keep_their_bytes_and_their_alignment(
        steps in prop::collection::vec((0u8..4, 1usize..if cfg!(miri) { 200 } else { 3000 }, 0u32..13, any::<u8>()), 1..if cfg!(miri) { 20 } else { 120 }),
        growing in any::<bool>(),
    ) {
        let pool = Pool::new();
        let size = if growing { 0 } else { 32 << 10 };
        prop_assert!(size == 0 || pool.reserve(size));
        let mut held: Vec<Held> = Vec::new();
        for (what, size, align, seed) in steps {
            let layout = Layout::from_size_align(size, 1 << align).unwrap();
            let at = seed as usize % held.len().max(1);
            match what {
                2 if !held.is_empty() => held.swap_remove(at).free(&pool),
                3 if !held.is_empty() && pool.owns(held[at].block.as_ptr()) => {
                    let block = held.swap_remove(at).resize(&pool, size, growing);
                    held.push(block);
                }
                _ => held.extend(Held::new(&pool, layout, seed, growing)),
            }
        }
        let usage = pool.usage();
        let mine = held.iter().filter(|h| pool.owns(h.block.as_ptr()));
        prop_assert_eq!(usage.in_use, mine.map(|h| h.layout.size()).sum::<usize>());
        prop_assert!(usage.in_use <= usage.high_water && usage.high_water <= usage.capacity);
        prop_assert!(!growing || usage.overflows == 0);
        held.into_iter().for_each(|h| h.free(&pool));
        prop_assert_eq!(pool.usage().in_use, 0);
    }
}

#[test]
fn a_full_pool_refuses_and_counts_and_goes_on_when_there_is_room() {
    let pool = Pool::new();
    assert!(pool.reserve(16 << 10) && pool.usage().capacity == 16 << 10);
    let layout = Layout::from_size_align(4 << 10, 64).unwrap();
    let mut held: Vec<Held> = std::iter::from_fn(|| Held::new(&pool, layout, 3, false)).collect();
    assert_eq!(held.len(), 3);
    assert_eq!((pool.usage().overflows, pool.usage().overflow_bytes), (1, 4 << 10));
    // Too large for what is left: it moves to the system, with its bytes.
    let moved = held.pop().unwrap().resize(&pool, 20 << 10, false);
    assert!(!pool.owns(moved.block.as_ptr()) && pool.usage().overflows == 2);
    held.push(Held::new(&pool, layout, 4, false).unwrap());
    assert_eq!(pool.usage().high_water, 3 * (4 << 10));
    held.push(moved);
    held.into_iter().for_each(|h| h.free(&pool));
    assert_eq!(pool.usage().in_use, 0);
}

#[test]
fn blocks_may_be_freed_by_other_threads() {
    const THREADS: usize = 4;
    let rounds = if cfg!(miri) { 10 } else { 2000 };
    let pool = Pool::new();
    std::thread::scope(|scope| {
        // A ring: each thread frees what the one before it made.
        let (senders, receivers): (Vec<_>, Vec<_>) =
            (0..THREADS).map(|_| std::sync::mpsc::sync_channel::<Held>(8)).unzip();
        for (id, receiver) in receivers.into_iter().enumerate() {
            let (pool, next) = (&pool, senders[(id + 1) % THREADS].clone());
            scope.spawn(move || {
                for round in 0..rounds {
                    let layout =
                        Layout::from_size_align(1 + (round * 61 + id) % 700, 1 << (round % 8));
                    let held = Held::new(pool, layout.unwrap(), round as u8, true).unwrap();
                    next.send(held).unwrap();
                    receiver.recv().unwrap().free(pool);
                }
            });
        }
    });
    let usage = pool.usage();
    assert_eq!((usage.in_use, usage.overflows), (0, 0));
    assert!(usage.high_water > 0);
}

#[test]
fn without_the_allocator_a_scope_changes_nothing() {
    // The test harness runs on the system's allocator.
    assert!(!is_installed());
    let text = growing(|| pooled(|| String::from("scope")));
    assert_eq!((text.as_str(), pool_usage()), ("scope", PoolUsage::default()));
}
