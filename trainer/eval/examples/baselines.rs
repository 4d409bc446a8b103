//! Figures of the baselines, as a Markdown table and one JSON file per tracker and dataset.
//!
//! `cargo run -p tsda-eval --example baselines -- OUT_DIR DATASET..`, where a dataset is a text like
//! `pseudo:../shared/data/pairs@val`.

use std::error::Error;
use std::path::PathBuf;

use tsda_eval::baselines::{MatchOn, StaticBox, TemplateMatcher};
use tsda_eval::protocol::{Protocol, TrackerError, TrackerUnderTest};
use tsda_eval::summary::{Summary, markdown};
use tsda_eval::{Options, dataset, evaluate};

type Make = fn() -> Result<Box<dyn TrackerUnderTest>, TrackerError>;

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let out = PathBuf::from(args.next().ok_or("usage: baselines OUT_DIR DATASET..")?);
    std::fs::create_dir_all(&out)?;
    let trackers: [(&str, Make); 3] = [
        ("static", || Ok(Box::new(StaticBox::default()))),
        ("grey", || Ok(Box::new(TemplateMatcher::new(MatchOn::Grey)))),
        ("gradient", || Ok(Box::new(TemplateMatcher::new(MatchOn::Gradient)))),
    ];
    let options = Options { threads: 2, ..Options::default() };
    let mut summaries = Vec::new();
    for (i, text) in args.enumerate() {
        let data = dataset::open(&text)?;
        for (name, make) in &trackers {
            let mut runs = Vec::new();
            for protocol in Protocol::CROSS_MODAL.into_iter().chain([Protocol::Rgb]) {
                runs.push(evaluate(&data, protocol, make, options, &|p| {
                    if p.done == p.total {
                        eprintln!("{name} {protocol}: {} targets", p.total);
                    }
                })?);
            }
            let summary = Summary::of(&runs)?;
            summary.write_json(&out.join(format!("{name}-{i}.json")))?;
            summaries.push(summary);
        }
    }
    println!("{}", markdown(&summaries));
    Ok(())
}
