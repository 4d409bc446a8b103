//! `tsda eval`.

use super::{EvalArgs, progress_bar, stop_flag};
use crate::error::{EXIT_CHECK_FAILED, EXIT_OK, EXIT_RUNTIME, HostError, one_line};
use crate::model;
use crate::output::write_file;
use crate::redetect::RedetectArgs;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use tsda_eval::baselines::{MatchOn, StaticBox, TemplateMatcher};
use tsda_eval::dataset::{self, Dataset, Scan};
use tsda_eval::evaluate::{Extent, Failure, Observer, can_run, never_switches};
use tsda_eval::protocol::{EvalError, Protocol, TrackerError, TrackerUnderTest};
use tsda_eval::pseudo::PseudoOptions;
use tsda_eval::report_data::DataOptions;
use tsda_eval::results::file_stem;
use tsda_eval::run_summary::{RunContext, RunSummary, convention_of, sum_up};
use tsda_eval::store::{ResultStore, RunManifest, STORE_VERSION};
use tsda_eval::summary::markdown;
use tsda_eval::{Options, Progress, RuntimeTracker, evaluate_all, fingerprint, tables};
use tsda_runtime::bundle::BundleFile;
use tsda_runtime::engine::{AnyEngine, EngineChoice};

/// A bundle's tracker as the evaluation drives it.
fn under_test(
    file: &BundleFile,
    choice: &EngineChoice,
    redetect: RedetectArgs,
) -> Result<RuntimeTracker<AnyEngine>, HostError> {
    let name = file.bundle()?.manifest().name.to_owned();
    let mut tracker = model::tracker_on(file, choice)?;
    redetect.apply(&mut tracker)?;
    Ok(RuntimeTracker::new(name, tracker))
}

type Maker<'a> = Box<dyn Fn() -> Result<Box<dyn TrackerUnderTest>, TrackerError> + Sync + 'a>;

/// One tracker to run, and what its results are made with.
struct Entry<'a> {
    name: String,
    model: String,
    engine: String,
    /// Other than the bundle's own settings.
    settings: String,
    make: Maker<'a>,
    /// One per protocol.
    stores: Vec<ResultStore>,
}

impl<'a> Entry<'a> {
    fn baseline<T: TrackerUnderTest + Clone + Sync + 'static>(tracker: T) -> Self {
        Self {
            name: tracker.name().to_owned(),
            model: "built in".into(),
            engine: String::new(),
            settings: String::new(),
            make: Box::new(move || Ok(Box::new(tracker.clone()))),
            stores: Vec::new(),
        }
    }
}

pub(super) fn run(args: &EvalArgs) -> Result<u8, HostError> {
    let bundle = model::load(args.bundle.as_deref())?;
    let parsed = bundle.bundle()?;
    // An engine that cannot be had should be known before the data are looked at.
    drop(model::engine(&bundle, &parsed, &args.engine)?);
    args.redetect.validate()?;
    let (data, broken) = open(args)?;
    let protocols = protocols(args, &data)?;
    for note in protocols.iter().filter_map(|p| never_switches(&data, *p)) {
        eprintln!("tsda: {note}");
    }

    let mut entries = vec![Entry {
        name: parsed.manifest().name.to_owned(),
        model: fingerprint::of_bytes(bundle.bytes()),
        engine: args.engine.to_string(),
        settings: args.redetect.to_string(),
        make: Box::new(|| {
            let tracker =
                under_test(&bundle, &args.engine, args.redetect).map_err(TrackerError::new)?;
            Ok(Box::new(tracker) as Box<dyn TrackerUnderTest>)
        }),
        stores: Vec::new(),
    }];
    if args.baselines {
        entries.push(Entry::baseline(StaticBox::default()));
        entries.push(Entry::baseline(TemplateMatcher::new(MatchOn::Grey)));
        entries.push(Entry::baseline(TemplateMatcher::new(MatchOn::Gradient)));
    }
    let context = RunContext {
        bundle: entries[0].model.clone(),
        engine: entries[0].engine.clone(),
        settings: entries[0].settings.clone(),
        dataset_hash: fingerprint::of_dataset(&data),
        jobs: args.jobs.max(1),
        broken,
    };
    prepare(args, &data, &protocols, &context, &mut entries)?;

    let mut trackers = Vec::new();
    for entry in &entries {
        let mut evaluations = Vec::new();
        for (&protocol, store) in protocols.iter().zip(&entry.stores) {
            let options = Options { threads: args.jobs, ..Options::default() };
            let bar = Bar::new(&entry.name, protocol);
            let outcome =
                evaluate_all(&data, protocol, entry.make.as_ref(), options, Some(store), &bar);
            bar.0.finish_and_clear();
            evaluations.push(outcome.map_err(|e| failed(e, &args.out))?);
        }
        trackers.push(evaluations);
    }

    let convention = args.convention.unwrap_or_else(|| convention_of(&args.dataset));
    let options = DataOptions {
        convention,
        hold: args.hold as usize,
        frames: true,
        ..DataOptions::default()
    };
    let record = |tracker: &str, protocol: &str, label: &str| {
        let entry = entries.iter().find(|e| e.name == tracker)?;
        let i = protocols.iter().position(|p| p.to_string() == protocol)?;
        let store = entry.stores.get(i)?;
        let path = folder(Path::new("boxes"), tracker, protocol);
        // The report is read in browsers too: slashes everywhere.
        let path: Vec<_> = path.iter().map(|p| p.to_string_lossy()).collect();
        Some(format!("{}/{}.json", path.join("/"), store.stem(label)))
    };
    let (summary, report) = sum_up(&data, trackers, options, context, &record)
        .map_err(|e| HostError::Eval(Box::new(e)))?;
    let table = markdown(&summary.summaries());
    write_json(&args.out.join("summary.json"), &summary, true)?;
    write_json(&args.out.join("report.json"), &report, false)?;
    let text = format!("{table}\n{}", tables::markdown(&report));
    write_file(&args.out.join("summary.md"), text.as_bytes())?;
    print!("{table}");
    if summary.any_result() {
        let trackers = entries.iter().map(|e| e.name.as_str());
        super::report::of_evaluation(&data, &args.out, trackers, &protocols, &options, &bundle)?;
    }
    Ok(conclude(&summary, &args.out))
}

/// The exit code, with what went wrong on standard error.
fn conclude(summary: &RunSummary, out: &Path) -> u8 {
    for warning in &summary.warnings {
        eprintln!("tsda: {warning}");
    }
    if summary.failures == 0 {
        return EXIT_OK;
    }
    eprintln!(
        "tsda: {} sequences failed and are in no figure; {} lists them",
        summary.failures,
        out.join("summary.json").display()
    );
    if summary.any_result() { EXIT_CHECK_FAILED } else { EXIT_RUNTIME }
}

fn failed(error: EvalError, out: &Path) -> HostError {
    let text = one_line(&error);
    match error {
        EvalError::Interrupted { .. } => HostError::Eval(
            format!("{text}; they are kept in {}, the same command goes on", out.display()).into(),
        ),
        e => HostError::Eval(Box::new(e)),
    }
}

/// What was asked for, or what fits the data.
fn protocols(args: &EvalArgs, data: &Dataset) -> Result<Vec<Protocol>, HostError> {
    let mut protocols = args.protocol.clone();
    if protocols.is_empty() {
        protocols = Protocol::CROSS_MODAL.into_iter().filter(|p| can_run(data, *p)).collect();
    }
    if protocols.is_empty() {
        protocols =
            [Protocol::Rgb, Protocol::Thermal].into_iter().filter(|p| can_run(data, *p)).collect();
    }
    let mut seen = Vec::new();
    protocols.retain(|p| {
        let new = !seen.contains(p);
        seen.push(*p);
        new
    });
    let unusable = match protocols.iter().find(|p| !can_run(data, **p)) {
        Some(p) => format!("no sequence has the sensors and a first box for protocol {p}"),
        None if protocols.is_empty() => "no sequence has a box to start from".into(),
        None => return Ok(protocols),
    };
    Err(HostError::Argument { what: format!("--dataset {}", data.name), reason: unusable })
}

/// Looks whether results may go where they shall, all before anything is written.
fn prepare(
    args: &EvalArgs,
    data: &Dataset,
    protocols: &[Protocol],
    context: &RunContext,
    entries: &mut [Entry<'_>],
) -> Result<(), HostError> {
    let unusable = |e: tsda_eval::store::StoreError| HostError::Argument {
        what: format!("--out {}", args.out.display()),
        reason: e.to_string(),
    };
    for entry in entries.iter_mut() {
        for protocol in protocols.iter().map(Protocol::to_string) {
            let manifest = RunManifest {
                version: STORE_VERSION,
                program: env!("CARGO_PKG_VERSION").into(),
                tracker: entry.name.clone(),
                model: entry.model.clone(),
                engine: entry.engine.clone(),
                settings: entry.settings.clone(),
                dataset: data.name.clone(),
                dataset_hash: context.dataset_hash.clone(),
                protocol: protocol.clone(),
            };
            let sequences = data.sequences.iter().map(|s| (s.id(), s.targets()));
            let path = folder(&args.out.join("boxes"), &entry.name, &protocol);
            let store =
                ResultStore::plan(path, manifest, sequences, args.fresh).map_err(unusable)?;
            entry.stores.push(store);
        }
    }
    for store in entries.iter().flat_map(|e| &e.stores) {
        store.prepare(args.fresh).map_err(unusable)?;
    }
    Ok(())
}

/// `<boxes>/<tracker>/<protocol>`.
fn folder(boxes: &Path, tracker: &str, protocol: &str) -> PathBuf {
    boxes.join(file_stem(tracker)).join(file_stem(protocol))
}

fn write_json<T: serde::Serialize>(path: &Path, value: &T, pretty: bool) -> Result<(), HostError> {
    let bytes = if pretty { serde_json::to_vec_pretty(value) } else { serde_json::to_vec(value) };
    let mut bytes =
        bytes.map_err(|e| HostError::Encode { path: path.to_owned(), reason: e.to_string() })?;
    bytes.push(b'\n');
    write_file(path, &bytes)
}

/// Shows how far the work is; lines about failures stay.
struct Bar(ProgressBar, Protocol);

impl Bar {
    fn new(tracker: &str, protocol: Protocol) -> Self {
        let bar = progress_bar(Some(0), "evaluating");
        let template =
            "{prefix} [{bar:24}] {msg} | {human_pos}/{human_len} frames, {per_sec} | {eta_precise}";
        if let Ok(style) = ProgressStyle::with_template(template) {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_prefix(format!("{tracker} {protocol}"));
        Self(bar, protocol)
    }
}

impl Observer for Bar {
    fn planned(&self, all: Extent, kept: Extent) {
        self.0.set_length(all.frames as u64);
        self.0.set_position(kept.frames as u64);
        // What is there already took no time.
        self.0.reset_eta();
        self.0.set_message(format!("{}/{} sequences", kept.targets, all.targets));
        if kept.targets > 0 {
            self.0.suspend(|| {
                eprintln!(
                    "tsda: {}: {} of {} sequences taken up from an earlier run",
                    self.1, kept.targets, all.targets
                );
            });
        }
    }

    fn frame(&self) {
        self.0.inc(1);
    }

    fn finished(&self, p: Progress<'_>) {
        self.0.set_message(format!("{}/{} sequences", p.done, p.total));
    }

    fn failed(&self, failure: &Failure) {
        let reason = failure.reason.replace(['\n', '\r'], " ");
        self.0.suspend(|| eprintln!("tsda: {}: {reason}", self.1));
    }

    fn stop(&self) -> bool {
        stop_flag().load(Ordering::Relaxed)
    }
}

/// The dataset, and what in it could not be opened. `pairs:` is read as `pseudo:`: single stills
/// say nothing about tracking.
fn open(args: &EvalArgs) -> Result<(Dataset, Vec<Failure>), HostError> {
    let unusable = |e: &dyn std::fmt::Display| HostError::Argument {
        what: format!("--dataset {}", args.dataset),
        reason: e.to_string(),
    };
    let clips = PseudoOptions { frames: args.pseudo_frames, ..PseudoOptions::default() };
    let text = match args.dataset.strip_prefix("pairs:") {
        Some(rest) => format!("pseudo:{rest}"),
        None => args.dataset.clone(),
    };
    let Scan { name, sequences, broken } =
        dataset::scan_with(&text, clips).map_err(|e| unusable(&e))?;
    if let (Some(first), true) = (broken.first(), sequences.is_empty()) {
        return Err(unusable(first));
    }
    for e in &broken {
        eprintln!("tsda: cannot be opened and is left out: {}", one_line(e));
    }
    let broken = broken.iter().map(Failure::of_dataset).collect();
    Ok((Dataset { name, sequences }, broken))
}
