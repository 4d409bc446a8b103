//! The work itself. This folder is the only place of the crate with unsafe code.
//!
//! Why unsafe: vector instructions, and threads that write disjoint parts of one arena. How it is
//! kept in check: the planner describes every step with plain numbers; [`Program::new`] checks that
//! all a step reads lies inside arena and weights, that all it writes lies inside the arena and
//! apart from what it reads, and that no two elements of a result share a place. What passed can be
//! run without further checks, and everything that passed can be run by the safe [`Team::run`].
//!
//! Kernels are written once over [`simd::Simd`] and compiled for every instruction set; the table
//! [`Kernels`] of the best one is chosen at load. `scalar` is the twin of the others: the property
//! tests compare them with it and it with loops written out, and Miri runs it.
#![allow(unsafe_code)]
// Sums in registers are reached through indices known to the compiler; with iterators they are not
// always.
#![allow(clippy::needless_range_loop)]

mod attention;
mod conv;
mod eight;
mod gemm;
mod loops;
mod matmul;
#[cfg(target_arch = "aarch64")]
mod neon;
mod norms;
mod program;
mod simd;
mod step;
mod table;
mod team;
#[cfg(test)]
mod tests;
mod winograd;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use attention::{Attention, PackKv, ThinAttention};
pub use conv::{Depthwise, Pool};
pub use eight::{Eight, PackKvBytes, Quantise};
pub use gemm::Gemm;
pub use loops::{Copy, Fold, Map, Nest, Zip};
pub use matmul::MatMul;
pub use norms::{LayerNorm, MapNorm, Softmax};
pub use program::Program;
pub use step::Step;
pub use table::{Isa, Kernels};
pub use team::Team;
pub use winograd::{FromPoints, KernelsToPoints, Matrices, POINTS, ToPoints, transform};

/// Where a tensor starts, in floats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// In the arena, which every run writes.
    Arena(usize),
    /// In the weights, which nothing writes.
    Weights(usize),
}

impl Place {
    /// So many floats further on.
    pub const fn beyond(self, floats: usize) -> Self {
        match self {
            Self::Arena(at) => Self::Arena(at + floats),
            Self::Weights(at) => Self::Weights(at + floats),
        }
    }
}

/// Rows of pixels: `h` lines of `w` pixels, each a run of channels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pitch {
    /// Floats from a line to the next.
    pub y: usize,
    /// Floats from a pixel to the next.
    pub x: usize,
}

/// A border of zeros around a map in the arena.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Halo {
    /// Start of the border, which is that of the buffer.
    pub start: usize,
    /// Lines and pixels of the map inside.
    pub size: [usize; 2],
    /// Width of the border on all four sides.
    pub width: usize,
    /// Floats per line, border included.
    pub line: usize,
    /// Floats per pixel.
    pub pixel: usize,
}

impl Halo {
    const fn len(&self) -> usize {
        (self.size[0] + 2 * self.width) * self.line
    }

    /// Writes the zeros.
    ///
    /// # Safety
    /// The border lies inside the arena and nobody else touches it.
    unsafe fn clear(&self, mem: Mem) {
        // SAFETY: passed on.
        unsafe { self.fill(mem, 0) }
    }

    /// Writes this byte everywhere, for maps of bytes.
    ///
    /// # Safety
    /// As for [`Self::clear`].
    unsafe fn fill(&self, mem: Mem, byte: u8) {
        let (side, above) = (self.width * self.pixel, self.width * self.line);
        let below = (self.size[0] + self.width) * self.line;
        // SAFETY: all within `len` floats from the start, which the program has checked.
        unsafe {
            let start = mem.arena.add(self.start);
            start.write_bytes(byte, above);
            start.add(below).write_bytes(byte, above);
            for line in self.width..self.width + self.size[0] {
                let left = start.add(line * self.line);
                left.write_bytes(byte, side);
                left.add(self.line - side).write_bytes(byte, side);
            }
        }
    }
}

/// The memory of a run. Copied to all threads; who writes what is the program's affair.
#[derive(Clone, Copy)]
struct Mem {
    arena: *mut f32,
    weights: *const f32,
}

impl Mem {
    /// Pointer to a place.
    ///
    /// # Safety
    /// The place is inside.
    unsafe fn at(self, place: Place) -> *const f32 {
        // SAFETY: as promised by the caller.
        unsafe {
            match place {
                Place::Arena(at) => self.arena.add(at),
                Place::Weights(at) => self.weights.add(at),
            }
        }
    }
}

/// Which thread of how many.
#[derive(Clone, Copy, Debug)]
struct Part {
    id: usize,
    of: usize,
}

impl Part {
    /// This thread's share of `0..n`.
    const fn of(self, n: usize) -> core::ops::Range<usize> {
        n * self.id / self.of..n * (self.id + 1) / self.of
    }
}
