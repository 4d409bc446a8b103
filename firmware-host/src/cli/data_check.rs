//! `tsda data-check`.

use super::{grouped, progress_bar};
use crate::error::{EXIT_CHECK_FAILED, EXIT_OK, HostError};
use clap::Args;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use tsda_eval::dataset::{CheckOptions, CheckReport, Decode, Finding, KINDS, check, scan};

/// Arguments of `tsda data-check`.
#[derive(Debug, Args)]
#[command(after_help = kinds_help())]
pub struct DataCheckArgs {
    /// What to look through; without a split, everything
    #[arg(value_name = "KIND[/OPTION]:PATH[@SPLIT]")]
    pub dataset: String,
    /// Print the whole report as JSON
    #[arg(long)]
    pub json: bool,
    /// Also decode N frames per sequence and sensor, or all; without it, only headers are read
    #[arg(long, value_name = "N|all", value_parser = parse_decode)]
    pub decode: Option<Decode>,
    /// Files looked at at a time [default: one per core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
}

fn parse_decode(text: &str) -> Result<Decode, String> {
    match text {
        "all" => Ok(Decode::All),
        _ => match text.parse() {
            Ok(0) => Ok(Decode::None),
            Ok(n) => Ok(Decode::Some(n)),
            Err(_) => Err("expected a number of frames, or all".into()),
        },
    }
}

fn kinds_help() -> String {
    let mut text = String::from("Kinds:\n");
    for kind in KINDS {
        let options: String = kind.options.iter().map(|o| format!(" [/{o}]")).collect();
        // Writing into a String cannot fail.
        let _ = writeln!(text, "  {:<10} {}{options}", kind.name, kind.about);
    }
    text + "\nExit codes: 0 sound, 1 something is broken, 2 nothing to look at."
}

pub(super) fn run(args: &DataCheckArgs) -> Result<u8, HostError> {
    let scan = scan(&args.dataset)
        .map_err(|e| HostError::Argument { what: "data-check".into(), reason: e.to_string() })?;
    let defaults = CheckOptions::default();
    let options = CheckOptions {
        decode: args.decode.unwrap_or_default(),
        threads: args.threads.map_or(defaults.threads, usize::from),
    };
    let bar = progress_bar(Some(0), "pictures");
    let report = check(&scan, options, &|done, total| {
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    });
    bar.finish_and_clear();
    if args.json {
        let text = serde_json::to_string_pretty(&report)
            .map_err(|e| HostError::Encode { path: "-".into(), reason: e.to_string() })?;
        put(&(text + "\n"))?;
    } else {
        put(&plain(&report))?;
    }
    Ok(if report.is_sound() { EXIT_OK } else { EXIT_CHECK_FAILED })
}

/// Writes to standard output; a reader that has seen enough (`| head`) is no failure.
fn put(text: &str) -> Result<(), HostError> {
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        Err(source) => Err(HostError::Write { path: "standard output".into(), source }),
        Ok(()) => Ok(()),
    }
}

/// Most findings of a kind listed in the text; JSON has them all.
const LISTED: usize = 20;

fn plain(report: &CheckReport) -> String {
    let mut out = String::new();
    let mut row = |name: &str, value: String| {
        if !value.is_empty() {
            let _ = writeln!(out, "{name:<12} {value}");
        }
    };
    let n = |n: usize| grouped(n as u64);
    row("dataset", report.dataset.clone());
    let with = report.modalities.iter().map(|(m, count)| format!("{} {m}", n(*count)));
    let with = with.collect::<Vec<_>>().join(", ");
    row("sequences", format!("{} ({with})", n(report.sequences)));
    row("frames", format!("{} ({} targets)", n(report.frames), n(report.targets)));
    for (modality, count) in &report.annotation {
        row(
            modality,
            format!("{} annotated, of these {} absent", n(count.annotated), n(count.absent)),
        );
    }
    row("absences", format!("in {} sequences", n(report.with_absence)));
    let mut sizes: Vec<_> = report.resolutions.iter().collect();
    sizes.sort_by_key(|r| std::cmp::Reverse(r.pictures));
    let sizes = sizes
        .into_iter()
        .map(|r| format!("{} {} x {} ({})", r.modality, r.width, r.height, n(r.pictures)));
    row("resolution", several(sizes.collect()));
    row("registration", counted(&report.registration));
    row("attributes", counted(&report.attributes));
    row("of frames", counted(&report.frame_attributes));
    row("looked at", format!("{} headers, {} decoded", n(report.headers), n(report.decoded)));
    let broken: Vec<&Finding> = report.broken().collect();
    findings(&mut out, "quirks, dealt with", &report.quirks().collect::<Vec<_>>());
    findings(&mut out, "BROKEN", &broken);
    if broken.is_empty() {
        out.push_str("sound\n");
    }
    out
}

/// A few of a long list, with how many are not shown.
fn several(mut items: Vec<String>) -> String {
    const SHOWN: usize = 8;
    let more = items.len().saturating_sub(SHOWN);
    items.truncate(SHOWN);
    if more > 0 {
        items.push(format!("and {more} more"));
    }
    items.join(", ")
}

fn counted<K: std::fmt::Display>(counts: &BTreeMap<K, usize>) -> String {
    counts.iter().map(|(k, n)| format!("{k} {n}")).collect::<Vec<_>>().join(", ")
}

fn findings(out: &mut String, title: &str, findings: &[&Finding]) {
    if findings.is_empty() {
        return;
    }
    let _ = writeln!(out, "{title} ({}):", findings.len());
    for finding in findings.iter().take(LISTED) {
        let who = finding.sequence.as_deref().map(|s| format!("{s}: ")).unwrap_or_default();
        let _ = writeln!(out, "  {who}{}", finding.what.replace(['\n', '\r'], " "));
    }
    if findings.len() > LISTED {
        let _ = writeln!(out, "  and {} more (--json lists all)", findings.len() - LISTED);
    }
}
