//! A checked list of steps, and how a team of threads goes through it.

use super::step::{Spans, Step};
use super::{Kernels, Mem, Part, Place};
use crate::engine::native::sync::Barrier;
use std::time::{Duration, Instant};

/// Work below which a step is done by one thread: less than a few microseconds.
const WORTH_SHARING: usize = 100_000;

/// Steps that were checked against sizes of arena and weights.
#[derive(Debug)]
pub struct Program {
    steps: Box<[Planned]>,
    arena: usize,
    weights: usize,
    threads: usize,
    kernels: &'static Kernels,
}

#[derive(Debug)]
struct Planned {
    step: Step,
    shared: bool,
    /// Whether the threads wait for each other afterwards.
    wait: bool,
}

impl Program {
    /// Checks steps for an arena of `arena` floats, weights of `weights` floats, and a team.
    ///
    /// # Errors
    /// With the index of the first step that would leave its places, and what is wrong with it.
    pub fn new(
        steps: Vec<Step>,
        arena: usize,
        weights: usize,
        threads: usize,
        kernels: &'static Kernels,
    ) -> Result<Self, (usize, &'static str)> {
        for (i, step) in steps.iter().enumerate() {
            let spans = step.spans(kernels, threads);
            check(&spans, arena, weights).map_err(|what| (i, what))?;
        }
        let shared: Vec<bool> =
            steps.iter().map(|s| s.cost().operations >= WORTH_SHARING).collect();
        let steps = steps.into_iter().enumerate().map(|(i, step)| {
            // Steps of one thread need no waiting between them; the team waits after the last one.
            let wait = shared.get(i + 1).is_some_and(|next| shared[i] || *next);
            Planned { step, shared: shared[i], wait }
        });
        Ok(Self { steps: steps.collect(), arena, weights, threads, kernels })
    }

    /// Whether it was checked for these sizes.
    pub(super) fn fits(&self, arena: usize, weights: usize, threads: usize, k: &Kernels) -> bool {
        self.arena <= arena
            && self.weights <= weights
            && self.threads == threads
            && core::ptr::eq(self.kernels, k)
    }

    /// Runs everything on the calling thread alone and lowers `shortest[i]` to the time of step `i`.
    ///
    /// # Safety
    /// As for [`Self::run`]; the other threads of the team are at rest.
    pub(super) unsafe fn time(&self, k: &Kernels, mem: Mem, shortest: &mut [Duration]) {
        for (planned, shortest) in self.steps.iter().zip(shortest) {
            let start = Instant::now();
            // SAFETY: the steps were checked, and run one after the other.
            unsafe { planned.step.run(k, mem, Part { id: 0, of: 1 }) }
            *shortest = start.elapsed().min(*shortest);
        }
    }

    /// One thread's part of everything.
    ///
    /// # Safety
    /// All threads of the team run it together, on memory for which [`Self::fits`] holds and that
    /// nobody else uses.
    pub(super) unsafe fn run(&self, k: &Kernels, mem: Mem, part: Part, barrier: &Barrier) {
        for planned in &self.steps {
            // SAFETY: the steps were checked; each one starts after those before it are done.
            unsafe {
                if planned.shared {
                    planned.step.run(k, mem, part);
                } else if part.id == 0 {
                    planned.step.run(k, mem, Part { id: 0, of: 1 });
                }
            }
            if planned.wait {
                barrier.wait();
            }
        }
    }
}

fn check(spans: &Spans, arena: usize, weights: usize) -> Result<(), &'static str> {
    if let Some(what) = spans.wrong {
        return Err(what);
    }
    let inside =
        |at: usize, len: usize, size: usize| at.checked_add(len).is_some_and(|e| e <= size);
    for &(at, len) in &spans.writes {
        if !inside(at, len, arena) {
            return Err("it writes beyond the arena");
        }
    }
    for &(place, len) in &spans.reads {
        match place {
            Place::Weights(at) if inside(at, len, weights) => {}
            Place::Weights(_) => return Err("it reads beyond the weights"),
            Place::Arena(at) if inside(at, len, arena) => {
                if spans.writes.iter().any(|&(to, n)| at < to + n && to < at + len) {
                    return Err("it writes what it reads");
                }
            }
            Place::Arena(_) => return Err("it reads beyond the arena"),
        }
    }
    Ok(())
}
