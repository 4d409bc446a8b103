//! `tsda bench`: what a frame costs on each engine.
//!
//! Every engine runs in a process of its own ([`worker`]), so that memory and load are its own; the
//! parent ([`run`]) lets them take turns round by round, so that whatever else the machine does hits
//! all of them alike. [`report`] has the figures, [`crops`] the crop sampler by itself,
//! [`nodes`] the steps of the native engine.

pub mod crops;
pub mod nodes;
pub mod report;
pub mod run;
pub mod worker;

use serde::{Deserialize, Serialize};

/// Parts of a frame, in order.
pub const STAGES: [&str; 6] = ["crop", "features", "predict", "post", "frame", "template"];
/// Index of the whole frame: crop, features, predict and post. A memory write comes on top.
pub const FRAME: usize = 4;
/// Index of the memory write.
pub const TEMPLATE: usize = 5;

/// Milliseconds of one frame by stage; NaN-free, a stage that did not happen is `None`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// By the clock.
    pub wall: [Option<f64>; 6],
    /// Processor time of all threads.
    pub cpu: [Option<f64>; 6],
}

/// What a worker says about itself once it is loaded.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Loaded {
    /// Name of the bundle's preset.
    pub preset: String,
    /// Instruction set of the kernels, where the engine tells.
    pub isa: Option<String>,
    /// Reading, verifying and compiling, by the clock.
    pub load_ms: f64,
    /// The same in processor time.
    pub load_cpu_ms: f64,
}

/// What happened in one round.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Round {
    /// One per frame.
    pub frames: Vec<Sample>,
    /// Allocations of Rust code.
    pub allocations: u64,
    /// Bytes asked for in them.
    pub bytes: u64,
    /// Those that the system's allocator served.
    pub system: u64,
    /// Peak memory of the process so far, bytes.
    pub peak_rss: Option<u64>,
    /// Pool of the allocator, where this engine uses it.
    pub pool: Option<Pool>,
}

/// The allocator's pool; see `tsda_runtime::system`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Pool {
    /// Bytes it has.
    pub capacity: usize,
    /// Most that were in use.
    pub high_water: usize,
    /// Requests that did not fit.
    pub overflows: u64,
}

/// The pool of this process; `None` when it has none.
pub fn pool() -> Option<Pool> {
    #[cfg(feature = "tract")]
    {
        let tsda_runtime::system::PoolUsage { capacity, high_water, overflows, .. } =
            tsda_runtime::system::pool_usage();
        (capacity > 0).then_some(Pool { capacity, high_water, overflows })
    }
    #[cfg(not(feature = "tract"))]
    None
}

impl core::fmt::Display for Pool {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let mb = |bytes: usize| bytes as f64 / 1e6;
        write!(
            f,
            "pool of {:.1} MB, at most {:.1} MB in use, {} requests did not fit",
            mb(self.capacity),
            mb(self.high_water),
            self.overflows
        )
    }
}

/// What a worker answers, one line of JSON each.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Answer {
    /// It cannot run, and why.
    Unavailable(String),
    /// It is ready for rounds.
    Loaded(Loaded),
    /// A round is done.
    Round(Round),
}
