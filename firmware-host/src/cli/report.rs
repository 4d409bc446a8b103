//! `tsda report`: results as one self-contained page.

use super::compare::{read_attributes, split_name, truth_of, unusable};
use super::score::LayoutArg;
use crate::error::{EXIT_OK, HostError};
use crate::model;
use crate::output::write_file;
use clap::Args;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use tsda_eval::attributes::Attributes;
use tsda_eval::boxes::Layout;
use tsda_eval::compare::{CompareOptions, compare};
use tsda_eval::dataset::Dataset;
use tsda_eval::metrics::Convention;
use tsda_eval::protocol::Protocol;
use tsda_eval::report::{
    ModelCard, ProtocolExtras, ReportOptions, Run, Samples, StripOptions, StripSource, find_runs,
    render, strips,
};
use tsda_eval::report_data::{DataOptions, ReportData};
use tsda_eval::results::ResultFolder;
use tsda_eval::truth::TruthSet;
use tsda_runtime::bundle::BundleFile;

/// Arguments of `tsda report`.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Results: the --out folder of `tsda eval`, or one tracker's folder; may be repeated. Without
    /// --dataset and --gt: a comparison.json of `tsda compare`, or its folder
    #[arg(long, value_name = "DIR[=NAME]", required = true)]
    pub results: Vec<String>,
    /// Dataset with the truth, and the pictures of failures
    #[arg(long, value_name = "KIND:PATH[@SPLIT]", conflicts_with = "gt")]
    pub dataset: Option<String>,
    /// Folder with the truth alone, as for `tsda compare`
    #[arg(long, value_name = "DIR")]
    pub gt: Option<PathBuf>,
    /// Bundle whose model card the page shows
    #[arg(long, value_name = "FILE.tsda")]
    pub bundle: Option<PathBuf>,
    /// The page
    #[arg(long, value_name = "FILE.html")]
    pub out: PathBuf,
    /// Whose rules: tsda, lasher, rgbt234, rgbt210, gtot, otb or got10k
    #[arg(long, value_name = "NAME", default_value = "tsda")]
    pub convention: Convention,
    /// Protocol of results that do not lie in a folder named after one
    #[arg(long, value_name = "PROTOCOL")]
    pub protocol: Option<Protocol>,
    /// Attributes: LasHeR's AttriSeqsTxt, RGBT234's attr_txt, or JSON {"sequence": ["OCC", ..]}
    /// [default: those of the dataset]
    #[arg(long, value_name = "DIR|FILE.json")]
    pub attributes: Option<PathBuf>,
    /// Numbers of the results
    #[arg(long, value_name = "LAYOUT", default_value = "xywh")]
    pub pred_layout: LayoutArg,
    /// Leave out sequences that a tracker lacks, for all trackers, instead of refusing
    #[arg(long)]
    pub partial: bool,
    /// Title of the page
    #[arg(long, value_name = "TEXT", default_value = "")]
    pub title: String,
    /// Worst sequences per protocol shown in pictures
    #[arg(long, value_name = "N", default_value_t = StripOptions::default().worst)]
    pub worst: usize,
    /// Largest page in MB; pictures that do not fit are left out
    #[arg(long, value_name = "MB", default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..))]
    pub max_mb: u16,
}

pub(super) fn run(args: &ReportArgs) -> Result<u8, HostError> {
    let card = args.bundle.as_deref().map(|path| card(&model::load(Some(path))?)).transpose()?;
    let options = ReportOptions {
        title: args.title.clone(),
        max_bytes: usize::from(args.max_mb) * 1_000_000,
    };
    if args.dataset.is_none() && args.gt.is_none() {
        let data = read_comparison(&args.results)?;
        write(&args.out, &data, &[], card.as_ref(), &options)?;
        return Ok(EXIT_OK);
    }
    let attributes = read_attributes(args.attributes.as_deref())?;
    let mut runs = Vec::new();
    for text in &args.results {
        let (path, name) = split_name(text);
        let found = find_runs(Path::new(path), name)
            .map_err(|e| unusable(&format!("--results {text}"), &e))?;
        runs.extend(found.into_iter().map(|r| Run { protocol: r.protocol.or(args.protocol), ..r }));
    }
    let compare = CompareOptions {
        data: DataOptions { convention: args.convention, frames: true, ..DataOptions::default() },
        layout: args.pred_layout.of_result(args.convention, true),
        partial: args.partial,
    };
    let dataset = args
        .dataset
        .as_deref()
        .map(|text| tsda_eval::dataset::open(text).map_err(|e| unusable("--dataset", &e)))
        .transpose()?;
    let truth =
        |protocol| truth_of(dataset.as_ref(), args.gt.as_deref(), args.convention, None, protocol);
    let source = Source {
        dataset: dataset.as_ref(),
        truth: &truth,
        attributes: attributes.as_ref(),
        compare,
        strips: StripOptions { worst: args.worst, ..StripOptions::default() },
    };
    let (data, extras) = collect(&source, runs)?;
    write(&args.out, &data, &extras, card.as_ref(), &options)?;
    Ok(EXIT_OK)
}

/// What results are scored against and how.
struct Source<'a> {
    dataset: Option<&'a Dataset>,
    truth: &'a dyn Fn(Option<Protocol>) -> Result<TruthSet, HostError>,
    attributes: Option<&'a Attributes>,
    compare: CompareOptions,
    strips: StripOptions,
}

/// Scores the runs, one comparison per protocol.
fn collect(
    source: &Source<'_>,
    runs: Vec<Run>,
) -> Result<(ReportData, Vec<ProtocolExtras>), HostError> {
    let of_dataset = source.dataset.map(attributes_of).unwrap_or_default();
    let attributes = source.attributes.unwrap_or(&of_dataset);
    let mut by_protocol: BTreeMap<Option<Protocol>, Vec<ResultFolder>> = BTreeMap::new();
    for run in runs {
        let folder = ResultFolder::open(&run.path, Some(&run.tracker))
            .map_err(|e| unusable("--results", &e))?;
        by_protocol.entry(run.protocol).or_default().push(folder);
    }
    let mut whole: Option<ReportData> = None;
    let mut extras = Vec::new();
    for (protocol, folders) in by_protocol {
        let truth = (source.truth)(protocol)?;
        let data = compare(&truth, &folders, attributes, protocol, source.compare)
            .map_err(|e| unusable("--results", &e))?;
        extras.push(extra(&data, &folders, &truth, protocol, source)?);
        match &mut whole {
            Some(whole) => whole.protocols.extend(data.protocols),
            None => whole = Some(data),
        }
    }
    let data = whole.ok_or_else(|| unusable("--results", &"no results in these folders"))?;
    Ok((data, extras))
}

/// Samples and strips of the one protocol in `data`.
fn extra(
    data: &ReportData,
    folders: &[ResultFolder],
    truth: &TruthSet,
    protocol: Option<Protocol>,
    source: &Source<'_>,
) -> Result<ProtocolExtras, HostError> {
    let Some(protocol_data) = data.protocols.first() else { return Ok(ProtocolExtras::default()) };
    let samples = folders
        .iter()
        .zip(&protocol_data.trackers)
        .map(|(folder, tracker)| Samples::read(folder, tracker))
        .collect::<Result<_, _>>()
        .map_err(|e| unusable("--results", &e))?;
    let strips = match source.dataset {
        Some(dataset) => {
            let layout = source.compare.layout;
            let material = StripSource { dataset, truth, protocol, folders, layout };
            strips(material, protocol_data, source.strips).map_err(|e| unusable("--results", &e))?
        }
        None => Vec::new(),
    };
    Ok(ProtocolExtras { samples, strips })
}

/// `tsda compare --report`: the page of a comparison just made with the overlap of every frame.
#[allow(clippy::too_many_arguments)]
pub(super) fn of_comparison(
    out: &Path,
    data: &ReportData,
    folders: &[ResultFolder],
    truth: &TruthSet,
    dataset: Option<&Dataset>,
    protocol: Option<Protocol>,
    compare: CompareOptions,
) -> Result<(), HostError> {
    let source = Source {
        dataset,
        truth: &|_| Ok(TruthSet::default()),
        attributes: None,
        compare,
        strips: StripOptions::default(),
    };
    let extra = extra(data, folders, truth, protocol, &source)?;
    write(out, data, &[extra], None, &ReportOptions::default())
}

/// `tsda eval`: `report.html` of the boxes in its folder, of these trackers only (names as in the
/// summaries; the folder may hold earlier ones).
pub(super) fn of_evaluation<'a>(
    dataset: &Dataset,
    folder: &Path,
    trackers: impl IntoIterator<Item = &'a str>,
    protocols: &[Protocol],
    options: &DataOptions,
    bundle: &BundleFile,
) -> Result<(), HostError> {
    let runs = find_runs(folder, None).map_err(|e| unusable("--out", &e))?;
    // The bundle's tracker comes first: the page is about it.
    let mut ordered = Vec::new();
    for name in trackers {
        let safe = name.replace(|c: char| !(c.is_ascii_alphanumeric() || "-_.#".contains(c)), "_");
        ordered.extend(
            runs.iter()
                .filter(|r| r.tracker == safe && r.protocol.is_some_and(|p| protocols.contains(&p)))
                .map(|r| Run { tracker: name.to_owned(), ..r.clone() }),
        );
    }
    let source = Source {
        dataset: Some(dataset),
        truth: &|protocol| Ok(TruthSet::of_dataset(dataset, options.convention, protocol)),
        attributes: None,
        compare: CompareOptions {
            data: DataOptions { frames: true, ..*options },
            layout: Layout::Xywh,
            partial: true,
        },
        strips: StripOptions::default(),
    };
    let (data, extras) = collect(&source, ordered)?;
    let card = card(bundle)?;
    let out = folder.join("report.html");
    write(&out, &data, &extras, Some(&card), &ReportOptions::default())
}

fn write(
    out: &Path,
    data: &ReportData,
    extras: &[ProtocolExtras],
    card: Option<&ModelCard>,
    options: &ReportOptions,
) -> Result<(), HostError> {
    let page = render(data, extras, card, options).map_err(|e| unusable("report", &e))?;
    write_file(out, page.as_bytes())?;
    eprintln!("wrote {} ({} kB)", out.display(), page.len().div_ceil(1000));
    Ok(())
}

fn card(file: &BundleFile) -> Result<ModelCard, HostError> {
    let bundle = file.bundle()?;
    Ok(ModelCard::of(bundle.manifest(), bundle.bytes().len()))
}

/// Attributes that the loader found with its sequences.
fn attributes_of(dataset: &Dataset) -> Attributes {
    let mut all = Attributes::default();
    for sequence in &dataset.sequences {
        for attribute in sequence.attributes() {
            all.insert(sequence.id(), attribute);
        }
    }
    all
}

/// Comparisons stored by `tsda compare --out`, of one dataset and convention.
fn read_comparison(paths: &[String]) -> Result<ReportData, HostError> {
    let mut whole: Option<ReportData> = None;
    let mut seen = BTreeSet::new();
    for text in paths {
        let path = Path::new(text);
        let path = if path.is_dir() { path.join("comparison.json") } else { path.to_owned() };
        let what = format!("--results {text}");
        if !path.is_file() {
            let reason = "no comparison.json there: give --dataset or --gt with the truth, or the \
                          --out folder of tsda compare";
            return Err(unusable(&what, &reason));
        }
        let bytes = std::fs::read(&path).map_err(|e| unusable(&what, &e))?;
        let data: ReportData = serde_json::from_slice(&bytes)
            .map_err(|e| unusable(&what, &format!("not a comparison: {e}")))?;
        for protocol in &data.protocols {
            if !seen.insert(protocol.protocol.clone()) {
                let name = protocol.protocol.as_deref().unwrap_or("without a protocol");
                return Err(unusable(&what, &format!("there are two comparisons {name}")));
            }
        }
        match &mut whole {
            Some(first) if first.dataset != data.dataset || first.convention != data.convention => {
                let reason = format!(
                    "of {} by {}, but the first is of {} by {}: one page shows one dataset",
                    data.dataset, data.convention, first.dataset, first.convention
                );
                return Err(unusable(&what, &reason));
            }
            Some(first) => first.protocols.extend(data.protocols),
            None => whole = Some(data),
        }
    }
    whole.ok_or_else(|| unusable("--results", &"nothing given"))
}
