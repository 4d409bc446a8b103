//! `tsda trax`.

use crate::engine::EngineArgs;
use crate::error::{EXIT_OK, HostError, one_line};
use crate::model;
use crate::redetect::RedetectArgs;
use crate::trax::{Channels, Connection, End, Options, SensorPolicy, Version, give_up, serve};
use clap::Args;
use std::io::{Write, stderr};
use std::path::PathBuf;

/// Arguments of `tsda trax`.
#[derive(Debug, Args)]
pub struct TraxArgs {
    /// Bundle to track with, instead of the embedded one
    #[arg(long, value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// Pictures asked for with every frame: color, ir or color,ir
    #[arg(long, value_name = "CHANNELS", default_value = "color")]
    pub channels: Channels,
    /// With --channels color,ir, the one to track on: color, ir, auto or switch:N [default: auto]
    #[arg(long, value_name = "POLICY")]
    pub policy: Option<SensorPolicy>,
    /// Version of the protocol to speak; clients follow
    #[arg(long, value_name = "1-4", default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=4))]
    pub trax_version: u8,
    /// What the bundle runs on
    #[command(flatten)]
    pub engine: EngineArgs,
    /// Looking for a lost target
    #[command(flatten)]
    pub redetect: RedetectArgs,
}

pub(super) fn run(args: &TraxArgs) -> Result<u8, HostError> {
    let Connection { input, mut output } = Connection::from_environment()?;
    let prepared = options(args).and_then(|mut options| {
        // Before hello: clients give a tracker little time to answer a frame.
        let bundle = model::load(args.bundle.as_deref())?;
        let mut tracker = model::tracker_on(&bundle, &args.engine.choice()?)?;
        args.redetect.apply(&mut tracker)?;
        options.description = bundle.path().display().to_string();
        Ok((options, tracker))
    });
    let (options, mut tracker) = match prepared {
        Ok(prepared) => prepared,
        Err(e) => {
            // The client waits for hello; the error itself goes to the user either way.
            let _ = give_up(&mut output, &one_line(&e));
            return Err(e);
        }
    };
    let summary = serve(input, output, &mut tracker, &options)?;
    let end = match summary.end {
        End::Quit => "the client ended the session",
        End::EndOfStream => "the client's stream ended",
    };
    // Clients often close our standard error first.
    let _ = writeln!(
        stderr(),
        "tsda: trax: {} targets, {} frames; {end}",
        summary.targets,
        summary.frames
    );
    Ok(EXIT_OK)
}

/// What was typed, when it goes together.
fn options(args: &TraxArgs) -> Result<Options, HostError> {
    let wrong = |what: &str, reason: &str| {
        Err(HostError::Argument { what: what.to_owned(), reason: reason.to_owned() })
    };
    let Some(version) = Version::new(args.trax_version) else {
        return wrong("--trax-version", "1, 2, 3 or 4 is expected");
    };
    if args.channels != Channels::Color && !version.has_channels() {
        return wrong("--channels", "versions 1 and 2 of the protocol only have color pictures");
    }
    if args.policy.is_some() && args.channels != Channels::Both {
        return wrong("--policy", "there is nothing to choose from; add --channels color,ir");
    }
    let policy = args.policy.unwrap_or_default();
    Ok(Options { version, channels: args.channels, policy, ..Options::default() })
}
