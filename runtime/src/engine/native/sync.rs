//! Meeting points of the worker threads: a short spin, then sleep. Nothing here allocates; the only
//! system calls are those that put a thread to sleep and wake it.

use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Most turns of the spin before a thread goes to sleep, about 20 microseconds: longer than the gap
/// between two threads that finish a step.
const MAX_SPIN: u32 = 2_000;
/// Fewest turns. Where two threads share a core every spin is in vain, so it is halved each time it
/// did not help, and doubled each time it did.
const MIN_SPIN: u32 = 50;

/// A counter that threads can wait for.
#[derive(Debug)]
pub struct Signal {
    count: AtomicUsize,
    /// Turns of the next spin; a hint, so nothing depends on its order.
    spin: AtomicU32,
    sleepers: AtomicUsize,
    lock: Mutex<()>,
    wake: Condvar,
}

impl Default for Signal {
    fn default() -> Self {
        Self {
            count: AtomicUsize::new(0),
            spin: AtomicU32::new(MAX_SPIN),
            sleepers: AtomicUsize::new(0),
            lock: Mutex::new(()),
            wake: Condvar::new(),
        }
    }
}

impl Signal {
    /// The count now.
    pub fn count(&self) -> usize {
        self.count.load(Ordering::Acquire)
    }

    /// Adds one and wakes everybody who waits.
    pub fn advance(&self) {
        // Sequentially consistent together with `wait`: either the sleeper is seen here, or the
        // sleeper sees the new count before it sleeps.
        self.count.fetch_add(1, Ordering::SeqCst);
        if self.sleepers.load(Ordering::SeqCst) > 0 {
            drop(self.locked());
            self.wake.notify_all();
        }
    }

    /// Returns when the count is no longer `seen`.
    pub fn wait(&self, seen: usize) {
        let spin = self.spin.load(Ordering::Relaxed);
        for _ in 0..spin {
            if self.count() != seen {
                if spin < MAX_SPIN {
                    self.spin.store((spin * 2).min(MAX_SPIN), Ordering::Relaxed);
                }
                return;
            }
            core::hint::spin_loop();
        }
        self.spin.store((spin / 2).max(MIN_SPIN), Ordering::Relaxed);
        let mut guard = self.locked();
        self.sleepers.fetch_add(1, Ordering::SeqCst);
        while self.count.load(Ordering::SeqCst) == seen {
            guard = self.wake.wait(guard).unwrap_or_else(PoisonError::into_inner);
        }
        self.sleepers.fetch_sub(1, Ordering::SeqCst);
    }

    /// The lock protects no data, so a poisoned one is as good.
    fn locked(&self) -> MutexGuard<'_, ()> {
        self.lock.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Holds threads until all of a team have come.
#[derive(Debug)]
pub struct Barrier {
    team: usize,
    here: AtomicUsize,
    passed: Signal,
}

impl Barrier {
    /// For a team of this many threads.
    pub fn new(team: usize) -> Self {
        Self { team, here: AtomicUsize::new(0), passed: Signal::default() }
    }

    /// Waits for the others; everything they wrote before is visible afterwards.
    pub fn wait(&self) {
        if self.team == 1 {
            return;
        }
        let seen = self.passed.count();
        if self.here.fetch_add(1, Ordering::AcqRel) + 1 == self.team {
            self.here.store(0, Ordering::Relaxed);
            self.passed.advance();
        } else {
            self.passed.wait(seen);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_passes_before_all_are_there() {
        const TEAM: usize = 3;
        let (barrier, arrived) = (Barrier::new(TEAM), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for thread in 0..TEAM {
                let (barrier, arrived) = (&barrier, &arrived);
                scope.spawn(move || {
                    for round in 0..200 {
                        // One thread late now and then, so that the others fall asleep.
                        if round % 50 == 0 && thread == round / 50 % TEAM {
                            std::thread::sleep(std::time::Duration::from_millis(2));
                        }
                        arrived.fetch_add(1, Ordering::SeqCst);
                        barrier.wait();
                        assert!(arrived.load(Ordering::SeqCst) >= TEAM * (round + 1));
                        barrier.wait();
                    }
                });
            }
        });
        assert_eq!(arrived.into_inner(), TEAM * 200);
    }
}
