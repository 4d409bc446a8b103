//! What is close to the machine: the allocator of our programs, its pool, the processor clock,
//! memory-mapped bundles.
//!
//! Besides the kernels of the native engine this folder is the only place of the crate with unsafe
//! code. Each file says why it needs some, and has nothing else in it.
#![allow(unsafe_code)]

mod clock;
mod heap;
mod map;
#[cfg(feature = "pool")]
mod pool;

pub use clock::{peak_rss, process_cpu};
pub use heap::{Counts, Heap, allocations_here, count};
pub use map::Mapping;
#[cfg(feature = "pool")]
pub use pool::{PoolUsage, growing, is_installed, pool_usage, pooled, reserve};
