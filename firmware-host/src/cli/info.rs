//! `tsda info`.

use super::{InfoArgs, grouped};
use crate::error::{EXIT_OK, HostError};
use crate::model;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;
use tsda_runtime::bundle::{Bundle, Precision, SectionKind};
use tsda_runtime::engine::AnyEngine;
use tsda_runtime::probe::{StageTime, stage_times};

/// Calls of each graph that are timed.
const REPETITIONS: usize = 15;

pub(super) fn run(args: &InfoArgs) -> Result<u8, HostError> {
    let file = model::load(args.bundle.as_deref())?;
    let bundle = file.bundle()?;
    print!("{}", describe(&file.path().display().to_string(), &bundle));
    if let Some(choice) = &args.engine {
        let start = Instant::now();
        let mut engine = model::engine(&file, &bundle, choice)?;
        let loading = start.elapsed().as_secs_f64() * 1e3;
        let path = file.path();
        let about = choice.describe().map_err(|source| HostError::Engine {
            bundle: path.to_path_buf(),
            source: Box::new(source),
        })?;
        println!("\nengine\n  {about}\n  {:<10} {loading:>9.1} ms", "loading");
        print!("{}", stage_table(path, &mut engine, "  ")?);
        if let AnyEngine::Native(native) = &engine {
            print!("\n{}", native.plan_summary());
        }
        if let Some(pool) = crate::bench::pool() {
            println!("\n  {pool}");
        }
    }
    Ok(EXIT_OK)
}

/// One line per graph: its best and its median time on this machine.
pub(super) fn stage_table(
    path: &Path,
    engine: &mut AnyEngine,
    indent: &str,
) -> Result<String, HostError> {
    let times = stage_times(engine, REPETITIONS).map_err(|source| HostError::Timing {
        bundle: path.to_path_buf(),
        source: Box::new(source),
    })?;
    let mut text = String::new();
    for StageTime { graph, best_ms, median_ms } in times {
        let _ = writeln!(
            text,
            "{indent}{graph:<10} {best_ms:>9.2} ms, median {median_ms:.2} ms of {REPETITIONS}"
        );
    }
    Ok(text)
}

/// Everything the manifest says, for people.
fn describe(path: &str, bundle: &Bundle<'_>) -> String {
    let m = bundle.manifest();
    let mut text = String::new();
    let mut row = |key: &str, value: String| {
        if !value.trim().is_empty() {
            // Writing to a string does not fail.
            let _ = writeln!(text, "{key:<14} {value}");
        }
    };
    row("bundle", path.to_owned());
    row("name", m.name.to_owned());
    row("size", format!("{} bytes", grouped(bundle.bytes().len() as u64)));
    let s = &m.spec;
    let backbone = s.backbone.to_string();
    row("backbone", backbone);
    row(
        "input",
        format!(
            "{0} x {0} pixels, {1} times the target's size; maps {2} x {2}",
            s.crop,
            s.search_factor,
            s.map_side()
        ),
    );
    row(
        "transformer",
        format!(
            "width {}, {} heads, feed-forward {}, {} + {} layers, {} templates",
            s.width, s.heads, s.feed_forward, s.encoder_layers, s.decoder_layers, s.templates
        ),
    );
    if let Some(weights) = bundle.section(SectionKind::Weights) {
        row(
            "weights",
            format!(
                "{} bytes, {} (norms folded in)",
                grouped(weights.len() as u64),
                match &m.precision {
                    None => format!("{} numbers of 32 bits", grouped(weights.len() as u64 / 4)),
                    Some(p) => p.numbers.to_string(),
                }
            ),
        );
    }
    let t = m.trained_on;
    let mut sensors: Vec<&str> = Vec::new();
    for (is, name) in [(t.rgb, "rgb"), (t.thermal, "thermal"), (t.cross_modal, "across both")] {
        if is {
            sensors.push(name);
        }
    }
    row("trained on", sensors.join(", "));
    let p = &m.tracker;
    row(
        "thresholds",
        format!(
            "not found below {}, remembered above {}, lost after {} frames",
            p.not_found, p.write_confidence, p.lost_after
        ),
    );
    if let Some(motion) = m.motion {
        row("motion prior", format!("window {}, size rate {}", motion.window, motion.size_rate));
    }
    if let Some(c) = m.calibration {
        row("calibration", format!("slope {}, bias {}", c.slope, c.bias));
    }
    row("trainer", m.provenance.trainer.to_owned());
    row("steps, seed", format!("{}, {}", m.provenance.steps, m.provenance.seed));
    row("weights crc", format!("{:08x}", m.provenance.weights_crc));
    row("licence", m.licence.to_owned());
    if let Some(p) = &m.precision {
        text.push_str(&narrow(p));
    }
    text.push_str("\nsections\n");
    for s in &m.sections {
        let _ = writeln!(
            text,
            "  {:<16} {:>12} bytes at {:>10}  crc {:08x}",
            s.kind.to_string(),
            grouped(s.length),
            s.offset,
            s.crc
        );
    }
    if !m.figures.is_empty() {
        text.push_str("\nfigures\n");
        for f in &m.figures {
            let _ = writeln!(text, "  {:<40} {:.4}", f.name, f.value);
        }
    }
    for (title, body) in [("data", m.provenance.data), ("card", m.card)] {
        if !body.trim().is_empty() {
            let _ = writeln!(text, "\n{title}\n{}", body.trim_end());
        }
    }
    text
}

/// What is narrower than 32 bits, and what that costs.
fn narrow(p: &Precision<'_>) -> String {
    let mut text = format!("\nprecision\n  {}\n", p.numbers);
    if p.numbers.has_bytes() {
        let _ = writeln!(
            text,
            "  {} products in bytes, {} in floats; ranges from {} frames of {}",
            p.layers, p.kept, p.frames, p.data
        );
    }
    let _ = writeln!(text, "  made of a network of floats, weights crc {:08x}", p.from_crc);
    for l in &p.losses {
        let (name, change) = (l.name, l.after - l.before);
        let _ = writeln!(text, "  {name:<40} {:.4} was {:.4} ({change:+.4})", l.after, l.before);
    }
    text
}
