//! Worker threads that prepare items ahead of the training loop.
//!
//! Items come out in order and depend on their index alone, so a run is the same whatever the
//! number of workers. At most `ahead` items wait in memory. Dropping the prefetcher stops and joins
//! every thread.

use crossbeam_channel::{Receiver, Sender, bounded};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;

/// An item that could not be prepared.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PrefetchError<E: std::error::Error + 'static> {
    /// The item's own error.
    #[error("{source}")]
    Item {
        /// Index of the item.
        index: u64,
        /// What went wrong.
        source: E,
    },
    /// Preparing the item panicked: a bug, reported instead of a hanging loop.
    #[error("preparing item {index} panicked: {message}")]
    Panicked {
        /// Index of the item.
        index: u64,
        /// The panic's message.
        message: String,
    },
    /// A worker thread could not be started.
    #[error("cannot start a worker thread: {0}")]
    Spawn(std::io::Error),
    /// The worker threads ended before the last item.
    #[error("worker threads ended before item {index}")]
    Ended {
        /// Index of the item waited for.
        index: u64,
    },
}

/// What workers and consumer agree on.
struct Window {
    /// Next index a worker takes.
    next: u64,
    /// Next index the consumer wants; workers stay less than `ahead` items in front of it.
    wanted: u64,
    stop: bool,
}

struct Shared {
    window: Mutex<Window>,
    moved: Condvar,
}

type Slot<T, E> = (u64, Result<T, PrefetchError<E>>);

/// Iterator over the prepared items, in order.
pub struct Prefetcher<T, E: std::error::Error + 'static> {
    // Taken in `drop`, so that workers blocked in `send` wake up.
    ready: Option<Receiver<Slot<T, E>>>,
    early: BTreeMap<u64, Result<T, PrefetchError<E>>>,
    wanted: u64,
    end: u64,
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
}

impl<T, E> Prefetcher<T, E>
where
    T: Send + 'static,
    E: std::error::Error + Send + 'static,
{
    /// Prepares `make(i)` for every `i` of `range` on `workers` threads, at most `ahead` at a time
    /// (both at least 1).
    ///
    /// # Errors
    /// When a thread cannot be started.
    pub fn new(
        range: std::ops::Range<u64>,
        workers: usize,
        ahead: usize,
        make: impl Fn(u64) -> Result<T, E> + Send + Sync + 'static,
    ) -> Result<Self, PrefetchError<E>> {
        let ahead = ahead.max(1);
        // The window bounds what is under way, so the channel never holds more than `ahead`.
        let (send, ready) = bounded(ahead);
        let window = Window { next: range.start, wanted: range.start, stop: false };
        let shared = Arc::new(Shared { window: Mutex::new(window), moved: Condvar::new() });
        let make = Arc::new(make);
        let mut this = Self {
            ready: Some(ready),
            early: BTreeMap::new(),
            wanted: range.start,
            end: range.end,
            shared: shared.clone(),
            threads: Vec::new(),
        };
        for n in 0..workers.max(1) {
            let (send, shared, make) = (send.clone(), shared.clone(), make.clone());
            let thread = std::thread::Builder::new()
                .name(format!("prefetch-{n}"))
                .spawn(move || work(&shared, &send, range.end, ahead as u64, make.as_ref()))
                .map_err(PrefetchError::Spawn)?;
            this.threads.push(thread);
        }
        Ok(this)
    }
}

fn work<T, E: std::error::Error + 'static>(
    shared: &Shared,
    send: &Sender<Slot<T, E>>,
    end: u64,
    ahead: u64,
    make: &(dyn Fn(u64) -> Result<T, E> + Send + Sync),
) {
    loop {
        let index = {
            let mut window = shared.window.lock().unwrap_or_else(PoisonError::into_inner);
            while !window.stop && window.next < end && window.next >= window.wanted + ahead {
                window = shared.moved.wait(window).unwrap_or_else(PoisonError::into_inner);
            }
            if window.stop || window.next >= end {
                return;
            }
            window.next += 1;
            window.next - 1
        };
        let item = match catch_unwind(AssertUnwindSafe(|| make(index))) {
            Ok(Ok(item)) => Ok(item),
            Ok(Err(source)) => Err(PrefetchError::Item { index, source }),
            Err(panic) => {
                let message = panic
                    .downcast_ref::<String>()
                    .cloned()
                    .or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned()))
                    .unwrap_or_else(|| "unknown panic".into());
                Err(PrefetchError::Panicked { index, message })
            }
        };
        if send.send((index, item)).is_err() {
            return;
        }
    }
}

impl<T, E: std::error::Error + 'static> Iterator for Prefetcher<T, E> {
    type Item = Result<T, PrefetchError<E>>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.wanted >= self.end {
            return None;
        }
        let item = loop {
            if let Some(item) = self.early.remove(&self.wanted) {
                break item;
            }
            match self.ready.as_ref().and_then(|r| r.recv().ok()) {
                Some((index, item)) => {
                    self.early.insert(index, item);
                }
                None => break Err(PrefetchError::Ended { index: self.wanted }),
            }
        };
        self.wanted += 1;
        self.shared.window.lock().unwrap_or_else(PoisonError::into_inner).wanted = self.wanted;
        self.shared.moved.notify_all();
        Some(item)
    }
}

impl<T, E: std::error::Error + 'static> Drop for Prefetcher<T, E> {
    fn drop(&mut self) {
        self.shared.window.lock().unwrap_or_else(PoisonError::into_inner).stop = true;
        self.shared.moved.notify_all();
        self.ready = None;
        for thread in self.threads.drain(..) {
            // A worker catches its own panics; nothing is left to report here.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::time::Duration;

    #[derive(Debug, thiserror::Error)]
    #[error("item is bad")]
    struct Bad;

    #[test]
    fn items_come_in_order_whatever_the_workers_and_their_speed() {
        for (workers, ahead) in [(1, 1), (2, 3), (5, 2), (4, 16)] {
            let p = Prefetcher::new(7..60, workers, ahead, |i| {
                std::thread::sleep(Duration::from_micros((i * 7919) % 400));
                Ok::<_, Bad>(i * i)
            })
            .unwrap();
            let got: Vec<u64> = p.map(Result::unwrap).collect();
            assert_eq!(got, (7..60).map(|i| i * i).collect::<Vec<_>>());
        }
    }

    #[test]
    fn no_more_than_ahead_items_are_prepared_before_they_are_wanted() {
        let made = Arc::new(AtomicU64::new(0));
        let count = made.clone();
        let mut p = Prefetcher::new(0..100, 3, 4, move |i| {
            count.fetch_add(1, Ordering::SeqCst);
            Ok::<_, Bad>(i)
        })
        .unwrap();
        p.next().unwrap().unwrap();
        std::thread::sleep(Duration::from_millis(50));
        let n = made.load(Ordering::SeqCst);
        assert!((1..=5).contains(&n), "{n} prepared");
        drop(p); // must not hang although workers wait
    }

    #[test]
    fn errors_and_panics_arrive_at_their_place() {
        let p = Prefetcher::new(0..5, 2, 2, |i| match i {
            1 => Err(Bad),
            3 => panic!("boom {i}"),
            _ => Ok(i),
        })
        .unwrap();
        let got: Vec<_> = p.collect();
        assert_eq!(got.len(), 5);
        assert!(matches!(got[0], Ok(0)));
        assert!(matches!(got[1], Err(PrefetchError::Item { index: 1, .. })));
        assert!(
            matches!(&got[3], Err(PrefetchError::Panicked { index: 3, message }) if message == "boom 3")
        );
        assert!(matches!(got[4], Ok(4)));
    }
}
