//! `tsda eval`.

use super::{EvalArgs, progress_bar};
use crate::error::{EXIT_OK, HostError};
use crate::model;
use crate::output::write_file;
use std::path::Path;
use std::str::FromStr as _;
use tsda_eval::baselines::{MatchOn, StaticBox, TemplateMatcher};
use tsda_eval::dataset::pairs::PairsDataset;
use tsda_eval::dataset::{self, Dataset, Picture, Sequence, Split};
use tsda_eval::protocol::{EvalError, Protocol, TrackerError, TrackerUnderTest};
use tsda_eval::pseudo::{PseudoOptions, clips};
use tsda_eval::summary::{Summary, markdown};
use tsda_eval::{Evaluation, Options, evaluate, otb};
use tsda_runtime::bundle::BundleFile;
use tsda_runtime::engine::{AnyEngine, EngineChoice};
use tsda_runtime::{BBox, Modality, Tracker};

/// A bundle's tracker as the evaluation drives it.
struct BundleTracker {
    name: String,
    tracker: Tracker<AnyEngine>,
    /// Size of the frame before: sensors may differ in resolution.
    size: (usize, usize),
    last: BBox,
}

impl BundleTracker {
    fn new(file: &BundleFile, choice: &EngineChoice) -> Result<Self, HostError> {
        let name = file.bundle()?.manifest().name.to_owned();
        let tracker = model::tracker_on(file, choice)?;
        Ok(Self { name, tracker, size: (0, 0), last: BBox::default() })
    }
}

impl TrackerUnderTest for BundleTracker {
    fn name(&self) -> &str {
        &self.name
    }

    fn init(&mut self, p: &Picture, bbox: BBox, modality: Modality) -> Result<(), TrackerError> {
        let view = p.view().map_err(TrackerError::new)?;
        self.size = (p.width, p.height);
        self.last = bbox;
        self.tracker.init(&view, bbox, Some(modality)).map_err(TrackerError::new)
    }

    fn update(&mut self, p: &Picture, modality: Modality) -> Result<(BBox, f32), TrackerError> {
        let view = p.view().map_err(TrackerError::new)?;
        crate::track::follow_size(&mut self.tracker, self.last, self.size, (p.width, p.height))
            .map_err(TrackerError::new)?;
        self.size = (p.width, p.height);
        let track = self.tracker.update(&view, Some(modality)).map_err(TrackerError::new)?;
        self.last = track.bbox;
        Ok((track.bbox, track.score))
    }
}

type Maker<'a> = Box<dyn Fn() -> Result<Box<dyn TrackerUnderTest>, TrackerError> + Sync + 'a>;

pub(super) fn run(args: &EvalArgs) -> Result<u8, HostError> {
    let bundle = model::load(args.bundle.as_deref())?;
    // An engine that cannot be had should be known before the data are looked at.
    drop(model::engine(&bundle, &bundle.bundle()?, &args.engine)?);
    let data = open(args)?;
    let protocols = if args.protocol.is_empty() {
        Protocol::CROSS_MODAL.to_vec()
    } else {
        args.protocol.clone()
    };
    std::fs::create_dir_all(&args.out)
        .map_err(|source| HostError::Create { path: args.out.clone(), source })?;

    let mut makers: Vec<Maker<'_>> = vec![Box::new(|| {
        let tracker = BundleTracker::new(&bundle, &args.engine).map_err(TrackerError::new)?;
        Ok(Box::new(tracker) as Box<dyn TrackerUnderTest>)
    })];
    if args.baselines {
        makers.push(Box::new(|| Ok(Box::new(StaticBox::default()))));
        makers.push(Box::new(|| Ok(Box::new(TemplateMatcher::new(MatchOn::Grey)))));
        makers.push(Box::new(|| Ok(Box::new(TemplateMatcher::new(MatchOn::Gradient)))));
    }
    let mut summaries = Vec::new();
    for make in &makers {
        let mut runs: Vec<Evaluation> = Vec::new();
        for &protocol in &protocols {
            runs.push(one(&data, protocol, make.as_ref(), args.threads)?);
        }
        write_boxes(&args.out, &runs)?;
        summaries.push(Summary::of(&runs).map_err(|e| HostError::Eval(Box::new(e)))?);
    }
    let table = markdown(&summaries);
    let mut json = serde_json::to_vec_pretty(&summaries).map_err(|e| HostError::Encode {
        path: args.out.join("summary.json"),
        reason: e.to_string(),
    })?;
    json.push(b'\n');
    write_file(&args.out.join("summary.json"), &json)?;
    write_file(&args.out.join("summary.md"), table.as_bytes())?;
    print!("{table}");
    Ok(EXIT_OK)
}

fn one(
    data: &Dataset,
    protocol: Protocol,
    make: &(dyn Fn() -> Result<Box<dyn TrackerUnderTest>, TrackerError> + Sync),
    threads: usize,
) -> Result<Evaluation, HostError> {
    let targets: usize = data.sequences.iter().map(|s| s.targets()).sum();
    let bar = progress_bar(Some(targets), "evaluating");
    let options = Options { threads, ..Options::default() };
    let outcome = evaluate(data, protocol, make, options, &|p| {
        bar.set_length(p.total as u64);
        bar.set_position(p.done as u64);
        bar.set_message(format!("{protocol} {} SR0.5 {:.2}", p.result.label(), p.scores.sr50));
    });
    bar.finish_and_clear();
    outcome.map_err(|e| match e {
        // What the user named does not fit together; the rest happened on the way.
        EvalError::Empty { .. } | EvalError::Dataset(_) => {
            HostError::Argument { what: format!("--dataset {}", data.name), reason: e.to_string() }
        }
        e => HostError::Eval(Box::new(e)),
    })
}

/// `pairs:` is read as `pseudo:`: single stills say nothing about tracking.
fn open(args: &EvalArgs) -> Result<Dataset, HostError> {
    let unusable = |e: &dyn std::fmt::Display| HostError::Argument {
        what: format!("--dataset {}", args.dataset),
        reason: e.to_string(),
    };
    let rest = args.dataset.strip_prefix("pseudo:").or(args.dataset.strip_prefix("pairs:"));
    let Some(rest) = rest else {
        return dataset::open(&args.dataset).map_err(|e| unusable(&e));
    };
    let (path, split) = match rest.rsplit_once('@') {
        Some((path, split)) if !split.contains(['/', '\\']) => {
            (path, Split::from_str(split).map_err(|e| unusable(&e))?)
        }
        _ => (rest, Split::All),
    };
    let pairs = PairsDataset::open(Path::new(path), split).map_err(|e| unusable(&e))?;
    let options = PseudoOptions { frames: args.pseudo_frames, ..PseudoOptions::default() };
    let stills = pairs.pairs().iter().map(|p| p as &dyn Sequence);
    let clips = clips(stills, options).map_err(|e| unusable(&e))?;
    if clips.is_empty() {
        return Err(unusable(&"no target of a size that clips can be made from"));
    }
    let sequences = clips.into_iter().map(|c| Box::new(c) as Box<dyn Sequence>).collect();
    Ok(Dataset { name: format!("pseudo:{rest}"), sequences })
}

/// `<out>/boxes/<tracker>/<protocol>/<sequence>.txt`.
fn write_boxes(out: &Path, runs: &[Evaluation]) -> Result<(), HostError> {
    let safe = |name: &str| {
        name.replace(|c: char| !(c.is_ascii_alphanumeric() || "-_.#".contains(c)), "_")
    };
    for run in runs {
        let folder =
            out.join("boxes").join(safe(&run.tracker)).join(safe(&run.protocol.to_string()));
        std::fs::create_dir_all(&folder)
            .map_err(|source| HostError::Create { path: folder.clone(), source })?;
        for result in &run.results {
            let path = folder.join(format!("{}.txt", safe(&result.label())));
            otb::write(&path, &result.predicted).map_err(|e| HostError::Eval(Box::new(e)))?;
        }
    }
    Ok(())
}
