//! `tsda verify`: does this board compute what the trainer's network computed?

use super::VerifyArgs;
use crate::error::{EXIT_CHECK_FAILED, EXIT_OK, HostError};
use crate::model;
use std::time::Instant;
use tsda_runtime::Engine;
use tsda_runtime::bundle::{BundleFile, SectionKind};
use tsda_runtime::probe::{self, Probe};

pub(super) fn run(args: &VerifyArgs) -> Result<u8, HostError> {
    if !(args.tolerance.is_finite() && args.tolerance >= 0.0) {
        return Err(HostError::Argument {
            what: format!("--tolerance {}", args.tolerance),
            reason: "a number of at least 0 was expected".into(),
        });
    }
    let file = model::load(args.bundle.as_deref())?;
    let bundle = file.bundle()?;
    let section = bundle
        .require(SectionKind::Probe)
        .map_err(|e| HostError::Probe { bundle: file.path().to_path_buf(), source: e.into() })?;
    let probe = Probe::parse(section, &bundle.manifest().spec)
        .map_err(|e| HostError::Probe { bundle: file.path().to_path_buf(), source: e.into() })?;

    println!(
        "{}: maximum absolute differences, tolerance {:.0e}",
        file.path().display(),
        args.tolerance
    );
    println!("{:<8} {:>9} {:>12} {:>12} {:>9}", "engine", "templates", "score map", "ltrb map", "");
    let mut good = true;
    let mut engine = model::engine(&file, &bundle)?;
    good &= check(&file, &mut engine, &probe, args.tolerance)?;
    #[cfg(feature = "ort")]
    {
        let mut engine = model::ort_engine(&file, &bundle)?;
        good &= check(&file, &mut engine, &probe, args.tolerance)?;
    }
    println!(
        "{}",
        if good { "ok" } else { "FAILED: this engine does not compute what was trained" }
    );
    Ok(if good { EXIT_OK } else { EXIT_CHECK_FAILED })
}

fn check<E: Engine>(
    file: &BundleFile,
    engine: &mut E,
    probe: &Probe<'_>,
    tolerance: f32,
) -> Result<bool, HostError> {
    let name = engine.name();
    let start = Instant::now();
    let report = probe::run(engine, probe).map_err(|source| HostError::ProbeRun {
        bundle: file.path().to_path_buf(),
        source: Box::new(source),
    })?;
    let mut good = true;
    for d in &report.diffs {
        // Written so that a difference that is not a number fails.
        let fits = d.scores <= tolerance && d.ltrb <= tolerance;
        good &= fits;
        println!(
            "{name:<8} {:>9} {:>12.2e} {:>12.2e} {:>9}",
            d.templates,
            d.scores,
            d.ltrb,
            if fits { "ok" } else { "TOO LARGE" }
        );
    }
    println!("{name:<8} took {:.0} ms", start.elapsed().as_secs_f64() * 1e3);
    Ok(good)
}
