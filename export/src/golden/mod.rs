//! Golden parity: does every back end compute what the reference computed?
//!
//! 1. [`folder`] reads a folder of cases ([`figure`] knows what the names mean, [`inputs`] the crops
//!    and boxes they are run with, [`recipe`] the weights of a network that is not shipped).
//! 2. [`backend`] computes the same values on burn, tract and ONNX Runtime ([`graphs`]).
//! 3. [`run`] compares; [`report`] writes lines, JSON and the table of `docs/results/parity.md`.
//!
//! `docs/parity.md` describes the folders.

pub mod backend;
pub mod error;
pub mod figure;
pub mod folder;
pub mod graphs;
pub mod inputs;
pub mod recipe;
pub mod report;

pub use backend::{Backend, EngineKind};
pub use error::GoldenError;
pub use folder::Selection;
pub use report::{Line, Report};

use burn::tensor::Device;
use figure::{Figure, Pass, Place, Scope, difference, peak};
use folder::{Case, Folder};
use inputs::Sequence;
use std::path::PathBuf;
use tsda_runtime::ModelSpec;
use tsda_trainer::import::{self, StateDict};
use tsda_trainer::model::inspect::Mode;
use tsda_trainer::model::{NetOptions, TrackerNet};

/// A network and the back ends computing it.
struct Group {
    spec: ModelSpec,
    net: TrackerNet,
    backends: Vec<Box<dyn Backend>>,
}

/// Compares the cases of a folder on the back ends asked for.
///
/// # Errors
/// When the folder cannot be used or a back end fails; differences are in the report.
pub fn run(selection: &Selection, engines: &[EngineKind]) -> Result<Report, GoldenError> {
    let mut folder = folder::open(selection)?;
    let mut report = Report::new(&selection.preset, &folder.unknown_inputs);
    for (name, off, bound) in &folder.input_checks {
        report.lines.push(Line {
            case: "inputs".into(),
            tensor: name.clone(),
            engine: "recipe",
            shape: Vec::new(),
            difference: *off,
            peak: 0.0,
            tolerance: *bound,
            detail: None,
        });
    }
    let largest = folder.cases.iter().map(|c| c.spec.templates).max().unwrap_or(1);
    let mut groups: Vec<Group> = Vec::new();
    for index in 0..folder.cases.len() {
        let spec = ModelSpec { templates: largest, ..folder.cases[index].spec };
        let case = &folder.cases[index];
        report.unknown.extend(case.unknown.iter().map(|n| (case.name.clone(), n.clone())));
        if case.training > 0 {
            report.training.push((case.name.clone(), case.training));
        }
        report.notes.extend(case.notes.iter().map(|n| format!("{}: {n}", case.name)));
        if case.passes.is_empty() {
            continue;
        }
        let at = match groups.iter().position(|g| g.spec == spec) {
            Some(at) => at,
            None => {
                let net = network(&spec, folder.weights.as_ref())?;
                let mut backends = Vec::new();
                for engine in engines {
                    backends.extend(engine.open(&net)?);
                }
                groups.push(Group { spec, net, backends });
                groups.len() - 1
            }
        };
        if case.open_sequence {
            find_sequence(&mut folder, index, &groups[at].net, &mut report)?;
        }
        compare(&folder.cases[index], &folder.sequences, &mut groups[at].backends, &mut report)?;
    }
    Ok(report)
}

/// Compares back ends with the network as written, on recipe images: for presets and numbers of
/// templates no reference figures exist for.
///
/// # Errors
/// When a back end fails.
pub fn run_without_reference(
    preset: &str,
    spec: &ModelSpec,
    templates: usize,
    engines: &[EngineKind],
) -> Result<Report, GoldenError> {
    let spec = ModelSpec { templates: templates as u8, ..*spec };
    spec.validate()?;
    let net = network(&spec, None)?;
    let sequences = vec![inputs::own(&spec, templates)];
    // Of the two back ends of burn, the first is the network as written.
    let mut written = EngineKind::Burn.open(&net)?;
    let mut backends = Vec::new();
    for engine in engines {
        match engine {
            EngineKind::Burn => backends.extend(written.drain(1..)),
            other => backends.extend(other.open(&net)?),
        }
    }
    let mut report = Report::new(preset, &[]);
    report
        .notes
        .push("no reference figures: compared with burn in the form it is written in".into());
    let mut passes = Vec::new();
    for count in (1..=templates).rev() {
        for mode in [Mode::Parallel { annotated: 1 }, Mode::Single] {
            let pass = Pass { mode, templates: count, sequences: vec![0] };
            let Some(values) = written[0].run(&sequences, &pass)? else { continue };
            let name = match mode {
                Mode::Single => "single",
                Mode::Parallel { .. } => "parallel",
            };
            let mut keys: Vec<&str> = backend::PARTS.to_vec();
            if count == templates && mode != Mode::Single {
                keys.extend(["test.head.feat", "train.head.feat"]);
            }
            let figures = keys.into_iter().filter_map(|key| {
                let reference = values.get(key)?.clone();
                let mut place = Place::parse(key, &spec)?;
                let feature = place.is_feature();
                place.scope = (!feature).then_some(Scope { mode, templates: count });
                let name = if feature { key.into() } else { format!("{name}{count}.{key}") };
                Some(Figure { name, reference, place })
            });
            passes.push((pass, figures.collect()));
        }
    }
    let case = Case {
        name: preset.into(),
        path: PathBuf::new(),
        spec,
        passes,
        notes: Vec::new(),
        unknown: Vec::new(),
        training: 0,
        open_sequence: false,
    };
    compare(&case, &sequences, &mut backends, &mut report)?;
    Ok(report)
}

/// The network of a case: weights from the file, else by recipe.
fn network(
    spec: &ModelSpec,
    weights: Option<&(PathBuf, StateDict)>,
) -> Result<TrackerNet, GoldenError> {
    let net = TrackerNet::new(spec, &NetOptions::default(), &Device::flex())?;
    let failed = |path: PathBuf| move |source| GoldenError::Weights { path, source };
    let Some((path, dict)) = weights else {
        return recipe::fill(net).map_err(failed("the filling recipe".into()));
    };
    let mut dict = dict.clone();
    if !spec.test_embedding {
        // The case was computed without it.
        dict.retain(|name| !name.ends_with("query_embed_test.weight"));
    }
    Ok(import::apply(net, &dict, "").map_err(failed(path.clone()))?.0)
}

/// Finds out on which sequence a case was computed: the one whose search feature or scores are
/// nearest to the figures.
fn find_sequence(
    folder: &mut Folder,
    index: usize,
    net: &TrackerNet,
    report: &mut Report,
) -> Result<(), GoldenError> {
    let mut backends = EngineKind::Burn.open(net)?;
    let Folder { sequences, cases, .. } = folder;
    let case = &mut cases[index];
    let Some((pass, figures)) = case.passes.first_mut() else { return Ok(()) };
    let signs = ["test.head.feat", "scores", "cls_filter", "ltrb"];
    let Some(sign) = signs.iter().find_map(|key| figures.iter().find(|f| f.place.key == *key))
    else {
        return Ok(());
    };
    let mut nearest = (f32::INFINITY, 0);
    for (s, sequence) in sequences.iter().enumerate() {
        if sequence.templates.len() < pass.templates {
            continue;
        }
        let tried = Pass { sequences: vec![s], ..pass.clone() };
        let backend = backends.last_mut();
        let Some(values) = backend.map(|b| b.run(sequences, &tried)).transpose()?.flatten() else {
            continue;
        };
        let part = values
            .get(&sign.place.key)
            .and_then(|value| sign.place.part(value, &sign.reference.shape).ok());
        let off = part.map_or(f32::INFINITY, |p| difference(&p, &sign.reference.values));
        if off < nearest.0 {
            nearest = (off, s);
        }
    }
    pass.sequences = vec![nearest.1];
    let note = format!("{}: on sequence {}, the nearest by {}", case.name, nearest.1, sign.name);
    report.notes.push(note);
    Ok(())
}

/// All figures of a case on all back ends.
fn compare(
    case: &Case,
    sequences: &[Sequence],
    backends: &mut [Box<dyn Backend>],
    report: &mut Report,
) -> Result<(), GoldenError> {
    let mut computed = vec![false; case.places().count()];
    for backend in backends.iter_mut() {
        let mut number = 0;
        for (pass, figures) in &case.passes {
            let values = backend.run(sequences, pass)?;
            for figure in figures {
                let value = values.as_ref().and_then(|v| v.get(&figure.place.key));
                if let Some(value) = value {
                    computed[number] = true;
                    report.lines.push(line(case, figure, backend.name(), value));
                }
                number += 1;
            }
        }
    }
    let left = case.places().zip(&computed).filter(|(_, done)| !**done);
    report.not_computed.extend(left.map(|((_, f), _)| (case.name.clone(), f.name.clone())));
    Ok(())
}

fn line(case: &Case, figure: &Figure, engine: &'static str, value: &import::StateTensor) -> Line {
    let reference = &figure.reference;
    let peak = peak(&reference.values);
    let (off, detail) = match figure.place.part(value, &reference.shape) {
        Ok(part) => (difference(&part, &reference.values), None),
        Err(detail) => (f32::INFINITY, Some(detail)),
    };
    Line {
        case: case.name.clone(),
        tensor: figure.name.clone(),
        engine,
        shape: reference.shape.clone(),
        difference: off,
        peak,
        tolerance: figure.place.tolerance.bound(peak),
        detail,
    }
}
