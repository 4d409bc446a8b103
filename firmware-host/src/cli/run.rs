//! `tsda run`: the program on a board.

use super::stop_flag;
use crate::error::{EXIT_NO_PICTURES, EXIT_OK, HostError};
use crate::host::control;
use crate::host::outputs;
use crate::host::plan::Plan;
use crate::host::sys;
use crate::host::{Ending, Host, HostConfig, SourceInfo};
use crate::model;
use crate::redetect::RedetectArgs;
use clap::Args;
use std::io::Write as _;
use std::path::PathBuf;

/// Arguments of `tsda run`.
#[derive(Debug, Args)]
#[command(after_help = "\
Exit codes: 0 ended as asked (end of the files, --frames, a command, SIGTERM or SIGINT), 2 the \
configuration cannot be used, 3 the work failed, 4 no usable picture for give_up_s seconds.")]
pub struct RunArgs {
    /// What to run (docs/board.md)
    #[arg(long, value_name = "HOST.toml")]
    pub config: PathBuf,
    /// End after so many frames, instead of the configuration's `frames`
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
    /// Only check the configuration: model, engine, sources and outputs are opened, nothing runs
    #[arg(long)]
    pub check: bool,
}

pub(super) fn run(args: &RunArgs) -> Result<u8, HostError> {
    // Before there are other threads.
    sys::share_heaps();
    let config = HostConfig::read(&args.config)?;
    let mut plan = Plan::new(&config)?;
    plan.frames = args.frames.or(plan.frames);
    let bundle = model::load(config.model.as_deref().map(|m| config.path(m)).as_deref())?;
    let mut tracker = model::tracker_on(&bundle, &plan.engine)?;
    RedetectArgs { scan_when_lost: config.scan_when_lost, ..RedetectArgs::default() }
        .apply(&mut tracker)?;
    let sources: Vec<SourceInfo> = plan.sensors.iter().map(|s| s.info().clone()).collect();
    let (commands, inbox) = control::channel();
    let zones = outputs::zones(&config)?;
    let outputs = outputs::open(&config, &sources, &commands, zones.as_ref())?;

    if args.check {
        println!("model:   {} on {}", bundle.path().display(), plan.engine);
        for sensor in &plan.sensors {
            let info = sensor.info();
            println!("source:  {}, {}: {}", info.name, info.sensor, sensor.source().describe());
        }
        for output in &outputs {
            println!("output:  {}", output.name());
        }
        for (zone, celsius) in zones.iter().flat_map(|z| z.readings()) {
            println!("zone:    {zone}, {celsius:.1} degrees Celsius");
        }
        match &plan.target {
            Some((i, b)) => println!(
                "target:  {:.1}, {:.1}, {:.1} x {:.1} in {}",
                b.x, b.y, b.w, b.h, sources[*i].name
            ),
            None => println!("target:  none; to be selected by command"),
        }
        println!("ok");
        return Ok(EXIT_OK);
    }

    // The port of an address that left it open, among others.
    for output in outputs.iter().skip(1) {
        let _ = writeln!(std::io::stderr(), "tsda: output: {}", output.name());
    }
    if config.control.stdin {
        control::listen_stdin(commands.clone())?;
    }
    let _socket = match &config.control.socket {
        Some(path) => Some(control::listen_socket(&config.path(path), commands.clone())?),
        None => None,
    };
    // After all other threads were started: they keep their priority.
    outputs::prepare(&config)?;
    let mut host = Host::new(plan, tracker, outputs, inbox).with_zones(zones);
    let summary = host.run(stop_flag())?;
    let _ = write!(std::io::stderr(), "tsda: {summary}");
    Ok(if summary.ending == Ending::NoPictures { EXIT_NO_PICTURES } else { EXIT_OK })
}
