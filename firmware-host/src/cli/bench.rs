//! `tsda bench`.

use super::{progress_bar, stop_flag};
use crate::bench::nodes;
use crate::bench::run::{Plan, run as measure};
use crate::bench::worker;
use crate::error::{EXIT_OK, HostError};
use crate::output::write_file;
use clap::Args;
use serde::Serialize;
use std::io::{stdin, stdout};
use std::path::{Path, PathBuf};
use tsda_runtime::engine::EngineChoice;

/// Arguments of `tsda bench`.
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// Bundle to measure, instead of the embedded one
    #[arg(long, value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// Engine (docs/engines.md); may be repeated, the first one is what ratios are over [default:
    /// every one of this build]
    #[arg(long, value_name = "ENGINE")]
    pub engine: Vec<EngineChoice>,
    /// Numbers of threads to measure each engine with
    #[arg(long, value_name = "N,..", value_delimiter = ',', default_value = "1",
        value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Vec<u16>,
    /// Frames per engine
    #[arg(long, value_name = "N", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    pub frames: u32,
    /// Write the figures as JSON, to standard output when no file is named
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    pub json: Option<PathBuf>,
    /// Measure every step of the native engine's graphs by itself instead, on one thread; the
    /// shortest of N runs counts
    #[arg(long, value_name = "N", num_args = 0..=1, default_missing_value = "100",
        value_parser = clap::value_parser!(u32).range(1..), conflicts_with_all = ["threads", "frames"])]
    pub nodes: Option<u32>,
    /// Be the process of one engine, for the program itself
    #[arg(long, hide = true, value_name = "ENGINE", conflicts_with_all = ["engine", "threads", "frames", "json"])]
    pub worker: Option<EngineChoice>,
}

pub(super) fn run(args: &BenchArgs) -> Result<u8, HostError> {
    let bundle = args.bundle.as_deref();
    if let Some(choice) = &args.worker {
        worker::serve(bundle, choice, stdin().lock(), stdout().lock())?;
        return Ok(EXIT_OK);
    }
    if let Some(runs) = args.nodes {
        return nodes_table(args, runs as usize);
    }
    let engines =
        if args.engine.is_empty() { EngineChoice::compiled() } else { args.engine.clone() };
    let threads: Vec<usize> = args.threads.iter().map(|&n| n.into()).collect();
    let plan = Plan {
        bundle,
        engines: &engines,
        threads: &threads,
        frames: args.frames as usize,
        stop: stop_flag(),
    };
    let bar = progress_bar(None, "measuring");
    let report = measure(&plan, |round, rounds| {
        bar.set_position(round as u64);
        bar.set_message(format!("of {rounds} rounds"));
    });
    bar.finish_and_clear();
    let report = report?;
    deliver(args.json.as_deref(), &report, &report.table())
}

/// The table, or the figures as JSON, or both.
fn deliver(json: Option<&Path>, figures: &impl Serialize, table: &str) -> Result<u8, HostError> {
    let Some(path) = json else {
        print!("{table}");
        return Ok(EXIT_OK);
    };
    let text = serde_json::to_string_pretty(figures)
        .map_err(|e| HostError::Write { path: path.into(), source: e.into() })?;
    if path == Path::new("-") {
        println!("{text}");
    } else {
        write_file(path, (text + "\n").as_bytes())?;
        print!("{table}");
        println!("\nalso: {}", path.display());
    }
    Ok(EXIT_OK)
}

/// `tsda bench --nodes`.
fn nodes_table(args: &BenchArgs, runs: usize) -> Result<u8, HostError> {
    let choice = match &*args.engine {
        [] => EngineChoice::default(),
        [choice] => choice.clone(),
        _ => {
            let reason = "`--nodes` measures one engine; name one `native` at most".into();
            return Err(HostError::Argument { what: "--engine".into(), reason });
        }
    };
    let report = nodes::measure(args.bundle.as_deref(), &choice, runs)?;
    deliver(args.json.as_deref(), &report, &report.table())
}
