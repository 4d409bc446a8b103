//! `tsda-export`: build, narrow, check and unpack bundles, count what they compute, compare back ends with
//! golden figures.
//!
//! Exit codes: 0 done; 1 an engine differs by more than the tolerance; 2 bad input, or an engine
//! that was asked for is not there or fails.

#[path = "golden_cli.rs"]
mod golden;
#[path = "quantize_cli.rs"]
mod quantize_cli;

use anyhow::Context as _;
use clap::{Parser, Subcommand, ValueEnum};
use std::path::PathBuf;
use std::process::ExitCode;
use tsda_export::build::{BuildOptions, build};
use tsda_export::check::check_on;
use tsda_export::macs::{self, MacsReport};
use tsda_export::network;
use tsda_export::quantize::QuantizeOptions;
use tsda_export::unpack::unpack;
use tsda_runtime::bundle::{BundleFile, Numbers, TrainedOn};
use tsda_runtime::engine::EngineChoice;
use tsda_runtime::{ModelSpec, MotionPrior};

/// Turns trained weights into bundles that run on a board, and checks them.
#[derive(Parser)]
#[command(version)]
struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Writes a bundle from trained or imported weights.
    Build {
        /// Weights (safetensors), as `tsda-train fit` and `tsda-train weights-import` write them.
        #[arg(long)]
        weights: PathBuf,
        /// The resolved configuration beside trained weights (TOML). Imported weights need none:
        /// they say which network they are of.
        #[arg(long)]
        config: Option<PathBuf>,
        /// The network the weights have to be of: "tomp101", "tomp50" or "nano".
        #[arg(long, conflicts_with = "config")]
        preset: Option<String>,
        /// Sensors imported weights have seen: "rgb", "thermal", "cross-modal", separated by commas.
        #[arg(long, value_delimiter = ',', conflicts_with = "config")]
        trained_on: Vec<Sensor>,
        /// What the tracker takes the last frame to say about the next one: share of a score that
        /// depends on the distance from where the target was, share of a change of size taken over
        /// at once. Nothing by default, as in the reference.
        #[arg(long, value_name = "WINDOW,SIZE_RATE")]
        motion: Option<MotionPrior>,
        /// Score above which the tracker makes a template of a frame, instead of the
        /// configuration's (imported weights: the reference's 0.9). What is right depends on the
        /// scores the network gives: `tsda eval --remember-above` finds it.
        #[arg(long, value_name = "SCORE")]
        remember_above: Option<f32>,
        /// The bundle to write.
        #[arg(long)]
        out: PathBuf,
        /// Name of the model [default: the file name of --out].
        #[arg(long)]
        name: Option<String>,
        /// Model card (Markdown).
        #[arg(long)]
        card: Option<PathBuf>,
        /// Measured figures (JSON): {"name": number, ..}.
        #[arg(long)]
        figures: Option<PathBuf>,
        /// Data sources and their licences (text, one per line).
        #[arg(long)]
        data_sources: Option<PathBuf>,
        /// Licence of the weights.
        #[arg(long, default_value = "see the model card")]
        licence: String,
        /// Stores weights as 16-bit floats; they are expanded when the bundle is loaded.
        #[arg(long)]
        weights_f16: bool,
    },
    /// Compares every engine compiled in with the outputs of the trainer's network.
    Check {
        /// The bundle.
        bundle: PathBuf,
        /// Largest absolute difference allowed [default: 1e-4, for bundles of 8 bits 5e-2].
        #[arg(long, value_parser = tolerance)]
        tolerance: Option<f32>,
        /// Only this engine: native, tract, ort, ort:cuda, ort:tensorrt (docs/engines.md) [default: every
        /// one of this build that is on the machine].
        #[arg(long)]
        engine: Option<EngineChoice>,
    },
    /// Makes a bundle of 8-bit numbers, or of 16-bit weights, out of one of floats.
    Quantize(quantize_cli::QuantizeArgs),
    /// Compares back ends with golden figures of the network, tensor by tensor.
    Golden(golden::GoldenArgs),
    /// Writes the parts of a bundle as plain files: ONNX graphs, weights, manifest, card.
    Unpack {
        /// The bundle.
        bundle: PathBuf,
        /// The folder to write to; made if it is not there.
        dir: PathBuf,
    },
    /// Counts multiply-accumulates by graph and part of the network, and per frame.
    Macs {
        #[command(flatten)]
        of: Counted,
        /// Prints JSON.
        #[arg(long)]
        json: bool,
    },
}

/// What `tsda-export macs` counts.
#[derive(clap::Args)]
#[group(required = true, multiple = false)]
struct Counted {
    /// The bundle.
    bundle: Option<PathBuf>,
    /// A preset instead of a bundle: nano, pico, pico-v3, tomp50, tomp101.
    #[arg(long)]
    preset: Option<String>,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Sensor {
    /// Visible light.
    Rgb,
    /// Long-wave infrared.
    Thermal,
    /// Templates of one sensor against searches of the other.
    CrossModal,
}

fn tolerance(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(v) if v.is_finite() && v >= 0.0 => Ok(v),
        _ => Err("it must be a finite number, not negative".into()),
    }
}

fn main() -> ExitCode {
    match run(Args::parse().command) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("tsda-export: {}", tsda_runtime::one_line(error.as_ref()));
            ExitCode::from(2)
        }
    }
}

fn run(command: Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::Build {
            weights,
            config,
            preset,
            trained_on,
            motion,
            remember_above,
            out,
            name,
            card,
            figures,
            data_sources,
            licence,
            weights_f16,
        } => {
            let trained_on = TrainedOn {
                rgb: trained_on.contains(&Sensor::Rgb),
                thermal: trained_on.contains(&Sensor::Thermal),
                cross_modal: trained_on.contains(&Sensor::CrossModal),
            };
            let options = BuildOptions {
                weights,
                config,
                preset,
                out,
                name,
                card,
                figures,
                data_sources,
                licence,
                trained_on,
                motion,
                remember_above,
            };
            let report = build(&options)?;
            for (kind, recorded, written) in &report.graphs {
                println!(
                    "{:<14} {recorded:>5} operations recorded, {written:>4} written",
                    kind.to_string()
                );
            }
            println!(
                "{:<14} {:>9} bytes for {} parameters",
                "weights.bin", report.weights, report.parameters
            );
            println!("{}: {} bytes", options.out.display(), report.bundle);
            if weights_f16 {
                let half = QuantizeOptions { numbers: Numbers::Half, ..Default::default() };
                print!("{}", quantize_cli::rewrite(&options.out, &options.out, &half)?);
            }
            Ok(ExitCode::SUCCESS)
        }
        Command::Check { bundle, tolerance, engine } => {
            let file = BundleFile::open(&bundle)?;
            let named = || format!("{}", bundle.display());
            let tolerance = tolerance.unwrap_or(file.bundle()?.manifest().probe_tolerance());
            let report = check_on(&file.bundle()?, engine.as_ref()).with_context(named)?;
            print!("{report}");
            if let Some(unchecked) = report.failure() {
                anyhow::bail!("engine {}: {}", unchecked.engine, unchecked.error);
            }
            let max = report.max();
            if max <= tolerance {
                println!("\nlargest difference {max:.3e}, allowed {tolerance:.3e}: ok");
                return Ok(ExitCode::SUCCESS);
            }
            println!("\nlargest difference {max:.3e}, allowed {tolerance:.3e}: too large");
            Ok(ExitCode::FAILURE)
        }
        Command::Golden(args) => golden::run(&args),
        Command::Quantize(args) => quantize_cli::run(&args),
        Command::Unpack { bundle, dir } => {
            let file = BundleFile::open(&bundle)?;
            for path in unpack(&file.bundle()?, &dir)? {
                println!("{}", path.display());
            }
            Ok(ExitCode::SUCCESS)
        }
        Command::Macs { of, json } => {
            let report = count(&of)?;
            if json {
                println!("{}", serde_json::to_string_pretty(&report)?);
            } else {
                print!("{report}");
            }
            Ok(ExitCode::SUCCESS)
        }
    }
}

fn count(of: &Counted) -> anyhow::Result<MacsReport> {
    if let Some(path) = &of.bundle {
        let file = BundleFile::open(path)?;
        return macs::of_bundle(&file.bundle()?).with_context(|| format!("{}", path.display()));
    }
    let name = of.preset.as_deref().unwrap_or_default();
    let spec = ModelSpec::preset(name).with_context(|| {
        format!("preset `{name}` is not known; nano, pico, pico-v3, tomp50 and tomp101 are")
    })?;
    // Weights do not matter: shapes are all that is counted.
    Ok(macs::of_graphs(&network::graphs(&network::untrained(&spec, 0)?)?))
}
