//! `tsda`: track a target through frames of two sensors.

use clap::Parser as _;
use std::io::Write as _;
use std::process::ExitCode;
use tsda_host::cli::{Cli, execute};
use tsda_host::error::one_line;

/// Counts for `tsda bench` and lends tract its pool; otherwise the system's.
#[global_allocator]
static HEAP: tsda_runtime::system::Heap = tsda_runtime::system::Heap;

fn main() -> ExitCode {
    // Usage errors end inside `parse`, with clap's code 2.
    match execute(&Cli::parse()) {
        Ok(code) => ExitCode::from(code),
        Err(e) => {
            // Whoever started this program may have closed the other end; that is no panic.
            let _ = writeln!(std::io::stderr(), "tsda: {}", one_line(&e));
            ExitCode::from(e.exit_code())
        }
    }
}
