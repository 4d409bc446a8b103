//! `tsda-train`: trains trackers. See `docs/training.md`.

mod device;

use anyhow::{Context, Result, bail};
use clap::{Parser, Subcommand};
use device::DeviceName;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use tsda_trainer::align_report::{self, AlignOptions, WeightsFrom};
use tsda_trainer::config::{AlignPreset, Experiment};
use tsda_trainer::fit::{self, FitOptions, Outcome};
use tsda_trainer::import::{self, ImportKind, ImportOptions};
use tsda_trainer::processing::contact_sheet;

/// Trains cross-modal trackers.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Train as a configuration says.
    Fit(FitArgs),
    /// Convert weights from elsewhere, checking names and shapes.
    WeightsImport(ImportArgs),
    /// Draw training samples as the network sees them.
    SampleSheet(SheetArgs),
    /// Measure how well the descriptors of both sensors agree. See docs/alignment.md.
    AlignReport(AlignArgs),
}

#[derive(clap::Args)]
struct Source {
    /// The experiment (TOML).
    #[arg(long)]
    config: PathBuf,
    /// Folder of a data source instead of the configuration's, as NAME=DIR (NAME: the entry's
    /// `name`, else its `kind`); just DIR where the configuration has a single source. Repeatable.
    #[arg(long, value_name = "[NAME=]DIR")]
    data: Vec<String>,
    /// Folder that relative paths of the configuration's data sources and weights start from.
    #[arg(long, value_name = "DIR")]
    data_root: Option<PathBuf>,
}

#[derive(clap::Args)]
struct FitArgs {
    #[command(flatten)]
    source: Source,
    /// Go on from the newest complete checkpoint.
    #[arg(long)]
    resume: bool,
    /// Folder to write to instead of the configuration's.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Steps of the whole run (the schedule follows) instead of the configuration's.
    #[arg(long)]
    steps: Option<u64>,
    /// Stop with a checkpoint after this step; the schedule stays that of the whole run.
    #[arg(long)]
    stop_after: Option<u64>,
    /// Backbone weights, or "scratch", instead of the configuration's.
    #[arg(long)]
    backbone: Option<String>,
    /// Seed instead of the configuration's.
    #[arg(long)]
    seed: Option<u64>,
    /// Row of the ablation instead of what [align] says: none, baseline, cm, pre-afa, pre-cfa,
    /// enc-afa, enc-cfa or joint. See docs/alignment.md.
    #[arg(long)]
    align_preset: Option<AlignPreset>,
    /// First step with alignment losses instead of the configuration's.
    #[arg(long)]
    align_start: Option<u64>,
    /// Where to compute.
    #[arg(long, value_enum, default_value_t = DeviceName::Flex)]
    device: DeviceName,
    /// How many devices of that kind share the batches of a step; run.accumulate has to be a
    /// multiple. The CPU is one device, whatever its cores.
    #[arg(long, value_name = "N", default_value_t = 1)]
    devices: usize,
    /// Batches per optimiser step instead of the configuration's.
    #[arg(long, value_name = "N")]
    accumulate: Option<usize>,
}

#[derive(clap::Args)]
struct ImportArgs {
    /// What the input holds: "pytracking" (a ToMP checkpoint), "torchvision-resnet",
    /// "efficientnet-lite0" or "nanotrack" (backbones), "full" (a whole network). Found out when not
    /// given.
    #[arg(long)]
    kind: Option<ImportKind>,
    /// File to read: PyTorch (zip or legacy) or safetensors.
    #[arg(long)]
    input: PathBuf,
    /// File to write: safetensors that say which network they are of.
    #[arg(long)]
    out: PathBuf,
    /// The network the weights have to be of: "tomp101", "tomp50", "nano", ... Found out when not
    /// given; filter size and test-frame embedding always are the file's.
    #[arg(long, conflicts_with = "config")]
    preset: Option<String>,
    /// The experiment whose [model] the weights have to be of.
    #[arg(long)]
    config: Option<PathBuf>,
}

#[derive(clap::Args)]
struct SheetArgs {
    #[command(flatten)]
    source: Source,
    /// PNG file to write.
    #[arg(long)]
    out: PathBuf,
    /// Samples to draw.
    #[arg(long, default_value_t = 16)]
    samples: u64,
    /// First sample of the stream.
    #[arg(long, default_value_t = 0)]
    first: u64,
}

#[derive(clap::Args)]
struct AlignArgs {
    /// The experiment (TOML); network, sampler and processing are taken from it.
    #[arg(long)]
    config: PathBuf,
    /// Weights of the whole network (safetensors or PyTorch). Without this and --checkpoint: what
    /// training by the configuration starts from.
    #[arg(long, conflicts_with = "checkpoint")]
    weights: Option<PathBuf>,
    /// Folder of a run or of one checkpoint.
    #[arg(long)]
    checkpoint: Option<PathBuf>,
    /// Registered pairs, KIND:PATH[@split], for example pairs:DIR@val.
    #[arg(long)]
    data: String,
    /// Folder for align.json, align.html and the pictures.
    #[arg(long)]
    out: PathBuf,
    /// Targets to draw.
    #[arg(long, default_value_t = 200)]
    pairs: usize,
    /// Seed of the drawing.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Targets put through the network at a time.
    #[arg(long, default_value_t = 8)]
    batch: usize,
    /// Where to compute.
    #[arg(long, value_enum, default_value_t = DeviceName::Flex)]
    device: DeviceName,
}

fn main() -> ExitCode {
    tsda_trainer::memory::keep_freed_memory();
    let result = match Cli::parse().command {
        Command::Fit(args) => run_fit(&args),
        Command::WeightsImport(args) => run_import(&args),
        Command::SampleSheet(args) => run_sheet(&args),
        Command::AlignReport(args) => run_align(args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("tsda-train: {}", tsda_runtime::one_line(e.as_ref()));
            ExitCode::from(2)
        }
    }
}

fn load(source: &Source) -> Result<Experiment> {
    let mut experiment = Experiment::load_from(&source.config, source.data_root.as_deref())?;
    let config = source.config.display();
    for text in &source.data {
        let labels: Vec<String> = experiment.data.iter().map(|s| s.label().to_owned()).collect();
        let named = text.split_once('=').and_then(|(name, dir)| {
            let same: Vec<_> = (0..labels.len()).filter(|&i| labels[i] == name).collect();
            (!same.is_empty()).then_some((same, dir))
        });
        let (entry, dir) = match named {
            Some((same, dir)) if same.len() == 1 => (same[0], dir),
            Some((same, _)) => bail!(
                "--data {text}: {} sources of {config} are called so; give them different names \
                 (key `name`)",
                same.len()
            ),
            None if labels.len() == 1 => (0, text.as_str()),
            None => bail!(
                "--data {text}: {config} has {} data sources; say which one: NAME=DIR, NAME one \
                 of {}",
                labels.len(),
                labels.join(", ")
            ),
        };
        experiment.data[entry].path = PathBuf::from(dir);
    }
    Ok(experiment)
}

fn run_fit(args: &FitArgs) -> Result<()> {
    let mut experiment = load(&args.source)?;
    if let Some(out) = &args.out {
        experiment.run.out = out.clone();
    }
    if let Some(steps) = args.steps {
        experiment.run.steps = steps;
    }
    if let Some(backbone) = &args.backbone {
        experiment.init.backbone = backbone.clone();
    }
    if let Some(seed) = args.seed {
        experiment.run.seed = seed;
    }
    if let Some(preset) = args.align_preset {
        experiment.align.select(preset);
    }
    if let Some(step) = args.align_start {
        experiment.align.start_step = Some(step);
    }
    if let Some(count) = args.accumulate {
        experiment.run.accumulate = count;
    }
    experiment.validate().context("command line")?;
    if args.resume {
        args.device.check_resume()?;
    }
    let (device, more_devices) = args.device.open_several(args.devices)?;
    let options = FitOptions {
        resume: args.resume,
        stop_after: args.stop_after,
        stop: stop_on_signal()?,
        device,
        more_devices,
        verbose: true,
    };
    match fit::fit(&experiment, &options)? {
        Outcome::Finished { model, validation } => {
            if let Some(v) = validation {
                println!(
                    "validation IoU: same sensor {:.3}, across sensors {:.3}",
                    v.same.iou, v.cross.iou
                );
            }
            println!("finished: {}", model.display());
        }
        Outcome::Stopped { step } => println!(
            "stopped after step {step}; go on with: tsda-train fit --config {} --out {} --resume",
            args.source.config.display(),
            experiment.run.out.display()
        ),
    }
    Ok(())
}

/// The first Ctrl-C or SIGTERM asks for a stop after the step under way, the second one ends the
/// program at once.
fn stop_on_signal() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    ctrlc::set_handler(move || {
        if flag.swap(true, Ordering::SeqCst) {
            std::process::exit(130);
        }
        eprintln!("stopping after this step (once more: at once, without a checkpoint)");
    })
    .context("cannot watch for Ctrl-C")?;
    Ok(stop)
}

fn run_import(args: &ImportArgs) -> Result<()> {
    let summary = import::run(&ImportOptions {
        kind: args.kind,
        input: args.input.clone(),
        output: args.out.clone(),
        given: import::given(args.preset.as_deref(), args.config.as_deref())?,
    })?;
    println!("{summary}");
    if summary.network.is_some() {
        let out = args.out.display();
        println!("next         tsda-export build --weights {out} --out MODEL.tsda");
    }
    Ok(())
}

fn run_sheet(args: &SheetArgs) -> Result<()> {
    let experiment = load(&args.source)?;
    let spec = experiment.model_spec()?;
    let maker = fit::training_batches(&experiment)?;
    let samples =
        (0..args.samples).map(|i| maker.sample(args.first + i)).collect::<Result<Vec<_>, _>>()?;
    let sheet = contact_sheet(&spec, &samples);
    let mut png = std::io::Cursor::new(Vec::new());
    sheet.write_to(&mut png, image::ImageFormat::Png).context("cannot encode the sheet")?;
    tsda_trainer::checkpoint::write_atomic(Path::new(&args.out), png.get_ref())?;
    for share in maker.sampler().shares() {
        println!(
            "source {}: {} sequences, {:.1} % of the samples ({:.1} % across sensors)",
            share.label,
            share.sequences,
            100.0 * (share.same + share.cross),
            100.0 * share.cross
        );
    }
    for (row, sample) in samples.iter().enumerate() {
        println!("row {row}: {}", sample.id);
    }
    Ok(())
}

fn run_align(args: AlignArgs) -> Result<()> {
    let experiment = Experiment::load(&args.config)?;
    let weights = match (args.weights, args.checkpoint) {
        (Some(file), _) => WeightsFrom::File(file),
        (None, Some(folder)) => WeightsFrom::Run(folder),
        (None, None) => WeightsFrom::Initial,
    };
    let options = AlignOptions {
        weights,
        data: args.data,
        pairs: args.pairs,
        seed: args.seed,
        batch: args.batch,
        device: args.device.open()?,
    };
    let bar = indicatif::ProgressBar::new(args.pairs as u64);
    let found = align_report::run(&experiment, &options, |done| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    found.write(&args.out)?;
    let report = &found.report;
    println!("{}: {} targets of {} pairs", report.weights, report.targets, report.sequences);
    print!("{}", align_report::page::table(report));
    println!("written: {}", args.out.join("align.html").display());
    Ok(())
}
