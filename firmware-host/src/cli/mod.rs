//! The command line: what was typed ([`Cli`]) and what it does ([`execute`]).

mod bench;
#[cfg(feature = "eval")]
mod calibrate;
#[cfg(feature = "eval")]
mod compare;
#[cfg(feature = "eval")]
mod data_check;
#[cfg(feature = "eval")]
mod data_write;
mod demo;
#[cfg(feature = "camera")]
mod devices;
#[cfg(feature = "eval")]
mod eval;
mod info;
#[cfg(feature = "eval")]
mod presence;
mod progress;
mod register;
mod render;
mod replay;
#[cfg(feature = "eval")]
mod report;
mod run;
#[cfg(feature = "eval")]
mod score;
mod track;
mod trax;
mod verify;

#[cfg(feature = "eval")]
pub use compare::CompareArgs;
pub use render::RenderArgs;
pub use replay::ReplayArgs;
#[cfg(feature = "eval")]
pub use report::ReportArgs;
#[cfg(feature = "eval")]
pub use score::{LayoutArg, LengthsArg, ScoreArgs};
pub use trax::TraxArgs;

use crate::engine::EngineArgs;
use crate::error::HostError;
use crate::redetect::RedetectArgs;
use clap::{Args, Parser, Subcommand};
use progress::progress_bar;
use std::path::PathBuf;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use tsda_runtime::engine::EngineChoice;

/// Tracks one target through frames of a visible and a thermal camera.
#[derive(Debug, Parser)]
#[command(
    name = "tsda",
    version,
    after_help = "\
Exit codes: 0 done, 1 a check failed, 2 the input cannot be used, 3 the work failed or was interrupted."
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Track through a rendered RGB-thermal clip (or a sequence folder) and show how well it went
    Demo(DemoArgs),
    /// Track through frames: a folder of pictures, a list that mixes sensors, or Y4M video on stdin
    Track(TrackArgs),
    /// Print what a bundle says about itself
    Info(InfoArgs),
    /// Check every engine of this build against the reference outputs stored in the bundle
    Verify(VerifyArgs),
    /// Measure what a frame costs on each engine: time by stage, allocations, memory, load
    Bench(bench::BenchArgs),
    /// Replay scripted runs through the tracker and compare every frame
    Replay(ReplayArgs),
    /// Evaluate a bundle on a dataset under cross-modal protocols
    #[cfg(feature = "eval")]
    Eval(EvalArgs),
    /// Serve the VOT toolkit, or any other TraX client, over standard input and output or a socket
    Trax(TraxArgs),
    /// Write clips drawn by the program as sequences of the VOT toolkit
    #[command(hide = true)]
    Render(RenderArgs),
    /// Look through a dataset: counts, absences, resolutions, attributes, broken files
    #[cfg(feature = "eval")]
    DataCheck(data_check::DataCheckArgs),
    /// Write a dataset, or clips made from stills, as folders that other programs can read
    #[cfg(feature = "eval")]
    DataWrite(data_write::DataWriteArgs),
    /// Score one result file against its truth, by a benchmark's own rules
    #[cfg(feature = "eval")]
    Score(ScoreArgs),
    /// Compare folders of results, of this or any other tracker
    #[cfg(feature = "eval")]
    Compare(CompareArgs),
    /// Write results as one self-contained page: curves, tables, failures in pictures, model card
    #[cfg(feature = "eval")]
    Report(ReportArgs),
    /// Measure whether a tracker knows that its target is gone, and how soon it finds it again
    #[cfg(feature = "eval")]
    Presence(presence::PresenceArgs),
    /// Fit the map from score to probability on labelled sequences and store it in a bundle
    #[cfg(feature = "eval")]
    Calibrate(calibrate::CalibrateArgs),
    /// Run on a board: cameras in, boxes out, as a configuration says
    Run(run::RunArgs),
    /// Estimate where a point of one sensor's picture lies in the other's, from pairs of points
    Register(register::RegisterArgs),
    /// List V4L2 cameras and their formats
    #[cfg(feature = "camera")]
    Devices,
}

/// Arguments of `tsda demo`.
#[derive(Debug, Args)]
pub struct DemoArgs {
    /// Sequence folder with visible/ and infrared/ pictures and box files, instead of the rendered
    /// clip
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Folder for the results, made if needed
    #[arg(long, value_name = "DIR", default_value = "tsda-demo")]
    pub out: PathBuf,
    /// Change the sensor every N frames instead of once in the middle
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub switch_every: Option<u32>,
    /// Bundle to track with, instead of the embedded one
    #[arg(long, value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// Seed of the rendered clip
    #[arg(long, default_value_t = 7, conflicts_with = "data")]
    pub seed: u32,
    /// Where the network runs
    #[command(flatten)]
    pub engine: EngineArgs,
    /// Looking for a lost target
    #[command(flatten)]
    pub redetect: RedetectArgs,
}

/// Arguments of `tsda track`.
#[derive(Debug, Args)]
pub struct TrackArgs {
    /// Folder of pictures, text list (one path per line, optionally TAB rgb|thermal), .y4m file, or
    /// - for Y4M on stdin
    #[arg(long, value_name = "DIR|LIST|-")]
    pub frames: PathBuf,
    /// Bundle to track with, instead of the embedded one
    #[arg(long, value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// Box of the target in the first frame, in pixels; without it, the first line of a box file
    /// beside the frames
    #[arg(long, value_name = "X,Y,W,H", allow_hyphen_values = true)]
    pub init: Option<String>,
    /// Boxes, one line x,y,w,h per frame
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// One JSON object per frame: box, score, state, sensor, time; - for standard output
    #[arg(long, value_name = "FILE|-")]
    pub json: Option<PathBuf>,
    /// Pictures of the result: folder of PNG, .gif, .html page, or .png strip; may be repeated
    #[arg(long, value_name = "DIR|FILE")]
    pub video_out: Vec<PathBuf>,
    /// Known boxes, one line per frame: drawn thin, and compared with at the end
    #[arg(long, value_name = "FILE")]
    pub truth: Option<PathBuf>,
    /// Sensor of a Y4M stream, instead of guessing from its colours
    #[arg(long, value_name = "rgb|thermal", value_parser = parse_modality)]
    pub modality: Option<tsda_runtime::Modality>,
    /// Where the network runs
    #[command(flatten)]
    pub engine: EngineArgs,
    /// Looking for a lost target
    #[command(flatten)]
    pub redetect: RedetectArgs,
}

/// Arguments of `tsda info`.
#[derive(Debug, Args)]
pub struct InfoArgs {
    /// Bundle; without it, the embedded one
    #[arg(value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// Also what this engine is and how long each graph takes on it (docs/engines.md)
    #[arg(long, value_name = "ENGINE")]
    pub engine: Option<EngineChoice>,
}

/// Arguments of `tsda verify`.
#[derive(Debug, Args)]
pub struct VerifyArgs {
    /// Bundle; without it, the embedded one
    #[arg(value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// Largest absolute difference allowed [default: 1e-4, for bundles of 8 bits 5e-2]
    #[arg(long)]
    pub tolerance: Option<f32>,
    /// Only this engine (docs/engines.md) [default: every one of this build that is on the machine]
    #[arg(long, value_name = "ENGINE")]
    pub engine: Option<EngineChoice>,
    /// Do not time the graphs afterwards, which takes minutes under an emulator
    #[arg(long)]
    pub no_times: bool,
}

/// Arguments of `tsda eval`.
#[cfg(feature = "eval")]
#[derive(Debug, Args)]
#[command(after_help = "\
Exit codes: 0 done, 1 done but sequences failed (listed in summary.json), 2 the input cannot be used, 3 \
interrupted, or nothing could be tracked. Finished sequences are kept in any case; the same command \
goes on with the others.")]
pub struct EvalArgs {
    /// Bundle to evaluate, instead of the embedded one
    #[arg(long, value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// lasher:PATH, rgbt234:PATH, .. for benchmarks (`tsda data-check --help` lists all kinds),
    /// pseudo:PATH[@split] for clips made from registered stills
    #[arg(long, value_name = "KIND:PATH[@SPLIT]")]
    pub dataset: String,
    /// rgb2t, t2rgb, switch:N (switch: N = 200), rgb or t; may be repeated [default: rgb2t t2rgb
    /// switch:200; on data of one sensor rgb or t]
    #[arg(long, value_name = "PROTOCOL")]
    pub protocol: Vec<tsda_eval::protocol::Protocol>,
    /// Folder for summary.json, summary.md, report.json and the results, made if needed. Sequences
    /// finished by an earlier run with the same bundle, dataset and engine are taken up
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Throw away what an earlier run left for these trackers and protocols
    #[arg(long)]
    pub fresh: bool,
    /// Also run a static box and template matching
    #[arg(long)]
    pub baselines: bool,
    /// Sequences tracked at a time; figures do not depend on it, frame rates do
    #[arg(long, value_name = "N", visible_alias = "threads", default_value_t = 1)]
    pub jobs: usize,
    /// Rules of report.json and of the tables: tsda, lasher, rgbt234, rgbt210, gtot, otb or got10k
    /// [default: those of the dataset's benchmark, else tsda]
    #[arg(long, value_name = "NAME")]
    pub convention: Option<tsda_eval::metrics::Convention>,
    /// Frames in a row on the target that make a recovery after a sensor switch
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    pub hold: u32,
    /// Where the network runs: native, tract, ort, ort:cuda or ort:tensorrt, with options after commas such
    /// as ort,threads=2 (docs/engines.md)
    #[arg(long, value_name = "ENGINE", default_value_t)]
    pub engine: EngineChoice,
    /// Looking for a lost target
    #[command(flatten)]
    pub redetect: RedetectArgs,
    /// Frames per clip made from stills
    #[arg(long, value_name = "N", default_value_t = 60)]
    pub pseudo_frames: usize,
}

fn parse_modality(text: &str) -> Result<tsda_runtime::Modality, String> {
    match text {
        "rgb" => Ok(tsda_runtime::Modality::Rgb),
        "thermal" => Ok(tsda_runtime::Modality::Thermal),
        _ => Err("expected rgb or thermal".into()),
    }
}

/// Runs a command; answers the exit code.
///
/// # Errors
/// Any failure; [`HostError::exit_code`] has the code for it.
pub fn execute(cli: &Cli) -> Result<u8, HostError> {
    match &cli.command {
        Command::Demo(args) => demo::run(args),
        Command::Track(args) => track::run(args),
        Command::Info(args) => info::run(args),
        Command::Verify(args) => verify::run(args),
        Command::Bench(args) => bench::run(args),
        Command::Replay(args) => replay::run(args),
        #[cfg(feature = "eval")]
        Command::Eval(args) => eval::run(args),
        Command::Trax(args) => trax::run(args),
        Command::Render(args) => render::run(args),
        #[cfg(feature = "eval")]
        Command::DataCheck(args) => data_check::run(args),
        #[cfg(feature = "eval")]
        Command::DataWrite(args) => data_write::run(args),
        #[cfg(feature = "eval")]
        Command::Score(args) => score::run(args),
        #[cfg(feature = "eval")]
        Command::Compare(args) => compare::run(args),
        #[cfg(feature = "eval")]
        Command::Report(args) => report::run(args),
        #[cfg(feature = "eval")]
        Command::Presence(args) => presence::run(args),
        #[cfg(feature = "eval")]
        Command::Calibrate(args) => calibrate::run(args),
        Command::Run(args) => run::run(args),
        Command::Register(args) => register::run(args),
        #[cfg(feature = "camera")]
        Command::Devices => devices::run(),
    }
}

/// A flag that Ctrl-C and SIGTERM set; a second signal ends the program at once.
fn stop_flag() -> &'static AtomicBool {
    static STOP: AtomicBool = AtomicBool::new(false);
    static HANDLER: OnceLock<()> = OnceLock::new();
    HANDLER.get_or_init(|| {
        // Without a handler (two programs fighting over it) Ctrl-C simply ends the program; the
        // temporary names then show what is unfinished.
        let _ = ctrlc::set_handler(|| {
            if STOP.swap(true, Ordering::Relaxed) {
                std::process::exit(i32::from(crate::error::EXIT_RUNTIME));
            }
        });
    });
    &STOP
}

/// `12,345,678`.
fn grouped(n: u64) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (i, c) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(c);
    }
    out
}
