//! The threads and the memory they share.

use super::program::Program;
use super::table::Kernels;
use super::{Mem, Part};
use crate::engine::native::sync::{Barrier, Signal};
use std::cell::UnsafeCell;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Floats of a cache line, to which arena and weights are aligned.
const LINE: usize = 16;

/// A cache line of floats.
#[repr(align(64))]
struct Line(#[expect(dead_code, reason = "read and written through pointers")] [f32; LINE]);

/// Memory of a fixed size, aligned to cache lines.
struct Block(Box<[UnsafeCell<Line>]>);

impl Block {
    fn zeroed(floats: usize) -> Self {
        let lines = floats.div_ceil(LINE).max(1);
        Self((0..lines).map(|_| UnsafeCell::new(Line([0.0; LINE]))).collect())
    }

    const fn start(&self) -> *mut f32 {
        // The pointer comes from the whole slice, so it may be used for all of it.
        self.0.as_ptr().cast_mut().cast::<f32>()
    }

    const fn len(&self) -> usize {
        self.0.len() * LINE
    }
}

/// What all threads see.
struct Shared {
    arena: Block,
    weights: Vec<f32>,
    programs: Box<[Program]>,
    kernels: &'static Kernels,
    threads: usize,
    /// Advanced once per run and once at the end of everything.
    start: Signal,
    /// The program of the current run; `STOP` ends the threads.
    program: AtomicUsize,
    barrier: Barrier,
}

const STOP: usize = usize::MAX;

// SAFETY: the arena is the only part that is not `Sync` by itself. It is touched by threads only during `Team::run`, which holds
// the team exclusively, and then every thread writes places of its own, as `Program::new` has
// checked; between steps that depend on each other the threads wait for each other.
unsafe impl Sync for Shared {}
// SAFETY: as above; nothing in it belongs to a thread.
unsafe impl Send for Shared {}

impl Shared {
    /// One thread's part of a program.
    fn work(&self, program: usize, id: usize) {
        let mem = Mem { arena: self.arena.start(), weights: self.weights.as_ptr() };
        let part = Part { id, of: self.threads };
        let program = &self.programs[program];
        // SAFETY: the program was checked against memory of this size and this number of threads,
        // and all threads of the team run it, with the exclusive right to the arena.
        unsafe { program.run(self.kernels, mem, part, &self.barrier) }
        // Nobody leaves before all are done, or the next run would begin without the slowest.
        self.barrier.wait();
    }
}

/// Ends the process when a thread of the team panics: the others would wait for it for ever.
struct AbortOnPanic;

impl Drop for AbortOnPanic {
    fn drop(&mut self) {
        if std::thread::panicking() {
            std::process::abort();
        }
    }
}

/// Threads with their arena, weights and programs.
pub struct Team {
    shared: Arc<Shared>,
    handles: Vec<JoinHandle<()>>,
}

impl core::fmt::Debug for Team {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Team").field("threads", &self.shared.threads).finish_non_exhaustive()
    }
}

impl Team {
    /// Starts `threads - 1` threads; the caller of [`Self::run`] is the other one.
    ///
    /// # Errors
    /// When a program was checked for other sizes, or a thread cannot be started.
    pub fn new(
        arena: usize,
        weights: Vec<f32>,
        programs: Vec<Program>,
        kernels: &'static Kernels,
        threads: usize,
        pin: bool,
    ) -> Result<Self, String> {
        let arena = Block::zeroed(arena);
        for program in &programs {
            if !program.fits(arena.len(), weights.len(), threads, kernels) {
                return Err(
                    "a program for another arena, instruction set or number of threads".into()
                );
            }
        }
        let shared = Arc::new(Shared {
            arena,
            weights,
            programs: programs.into(),
            kernels,
            threads,
            start: Signal::default(),
            program: AtomicUsize::new(0),
            barrier: Barrier::new(threads),
        });
        let mut team = Self { shared, handles: Vec::with_capacity(threads - 1) };
        if pin {
            pin_to(0);
        }
        for id in 1..threads {
            let shared = Arc::clone(&team.shared);
            let work = move || {
                let _guard = AbortOnPanic;
                if pin {
                    pin_to(id);
                }
                let mut seen = 0;
                loop {
                    shared.start.wait(seen);
                    seen += 1;
                    match shared.program.load(Ordering::Acquire) {
                        STOP => return,
                        program => shared.work(program, id),
                    }
                }
            };
            let handle = std::thread::Builder::new()
                .name(format!("tsda-{id}"))
                .spawn(work)
                .map_err(|e| format!("thread {id} cannot be started: {e}"))?;
            team.handles.push(handle);
        }
        Ok(team)
    }

    /// Runs a program on all threads; when it returns, all are done.
    ///
    /// # Panics
    /// When there is no such program.
    pub fn run(&mut self, program: usize) {
        let shared = &*self.shared;
        assert!(program < shared.programs.len(), "no program {program}");
        if shared.threads == 1 {
            shared.work(program, 0);
            return;
        }
        let _guard = AbortOnPanic;
        shared.program.store(program, Ordering::Release);
        shared.start.advance();
        shared.work(program, 0);
    }

    /// Runs a program on the calling thread alone and lowers `shortest[i]` to the time of its step
    /// `i`.
    ///
    /// # Panics
    /// When there is no such program.
    pub fn time(&mut self, program: usize, shortest: &mut [Duration]) {
        let shared = &*self.shared;
        let mem = Mem { arena: shared.arena.start(), weights: shared.weights.as_ptr() };
        // SAFETY: the program was checked against memory of this size; the team is borrowed
        // exclusively, so its other threads wait for the next run.
        unsafe { shared.programs[program].time(shared.kernels, mem, shortest) }
    }

    /// Part of the arena.
    pub fn view(&self, range: Range<usize>) -> &[f32] {
        self.check(&range);
        // SAFETY: inside the block; threads write only during `run`, which borrows mutably.
        unsafe {
            core::slice::from_raw_parts(self.shared.arena.start().add(range.start), range.len())
        }
    }

    /// Part of the arena, to write.
    pub fn view_mut(&mut self, range: Range<usize>) -> &mut [f32] {
        self.check(&range);
        // SAFETY: as above; the team is borrowed mutably for as long as the slice.
        unsafe {
            core::slice::from_raw_parts_mut(self.shared.arena.start().add(range.start), range.len())
        }
    }

    /// Two parts of the arena that do not overlap, to write.
    ///
    /// # Panics
    /// When they overlap or are not in ascending order.
    pub fn two_views_mut(&mut self, a: Range<usize>, b: Range<usize>) -> (&mut [f32], &mut [f32]) {
        assert!(a.end <= b.start, "{a:?} and {b:?} overlap or are in the wrong order");
        let (start, split) = (a.start, b.start - a.start);
        let (left, right) = self.view_mut(start..b.end).split_at_mut(split);
        (&mut left[..a.len()], right)
    }

    /// Copies within the arena.
    pub fn copy(&mut self, from: Range<usize>, to: usize) {
        self.check(&from);
        let end = to.checked_add(from.len());
        self.check(&(to..end.unwrap_or(usize::MAX)));
        // SAFETY: both inside the block, which nobody else uses now; they may overlap.
        unsafe {
            let start = self.shared.arena.start();
            core::ptr::copy(start.add(from.start), start.add(to), from.len());
        }
    }

    fn check(&self, range: &Range<usize>) {
        let len = self.shared.arena.len();
        assert!(range.start <= range.end && range.end <= len, "{range:?} of an arena of {len}");
    }
}

impl Drop for Team {
    fn drop(&mut self) {
        self.shared.program.store(STOP, Ordering::Release);
        self.shared.start.advance();
        for handle in self.handles.drain(..) {
            // A thread that panicked has ended the process already.
            let _ = handle.join();
        }
    }
}

/// Binds the calling thread to the processor core of this number, modulo how many the thread may
/// use. Does nothing where that is not possible.
#[cfg(target_os = "linux")]
fn pin_to(index: usize) {
    const WORDS: usize = 16;
    unsafe extern "C" {
        fn sched_getaffinity(pid: i32, size: usize, mask: *mut u64) -> i32;
        fn sched_setaffinity(pid: i32, size: usize, mask: *const u64) -> i32;
    }
    let mut mask = [0u64; WORDS];
    let size = core::mem::size_of_val(&mask);
    // SAFETY: both functions get a mask of the size they are told; 0 is the calling thread.
    unsafe {
        if sched_getaffinity(0, size, mask.as_mut_ptr()) != 0 {
            return;
        }
        let allowed: Vec<usize> =
            (0..WORDS * 64).filter(|i| mask[i / 64] >> (i % 64) & 1 == 1).collect();
        if let Some(&core) = allowed.get(index % allowed.len().max(1)) {
            mask = [0; WORDS];
            mask[core / 64] = 1 << (core % 64);
            // Only a wish: without the right to it the thread runs where it likes.
            let _ = sched_setaffinity(0, size, mask.as_ptr());
        }
    }
}

#[cfg(not(target_os = "linux"))]
fn pin_to(_: usize) {}
