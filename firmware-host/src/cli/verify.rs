//! `tsda verify`: does this board compute what the trainer's network computed?

use super::VerifyArgs;
use super::info::stage_table;
use crate::error::{EXIT_CHECK_FAILED, EXIT_OK, HostError, one_line};
use crate::model;
use tsda_runtime::bundle::{BundleFile, SectionKind};
use tsda_runtime::engine::{AnyEngine, EngineChoice};
use tsda_runtime::probe::{self, Probe};

pub(super) fn run(args: &VerifyArgs) -> Result<u8, HostError> {
    if let Some(bad) = args.tolerance.filter(|t| !(t.is_finite() && *t >= 0.0)) {
        return Err(HostError::Argument {
            what: format!("--tolerance {bad}"),
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

    let tolerance = args.tolerance.unwrap_or(bundle.manifest().probe_tolerance());
    println!("{}: maximum absolute differences, tolerance {tolerance:.0e}", file.path().display());
    println!("{:<8} {:>9} {:>12} {:>12} {:>9}", "engine", "templates", "score map", "ltrb map", "");
    let choices = args.engine.clone().map_or_else(EngineChoice::compiled, |choice| vec![choice]);
    let (mut good, mut failed, mut checked) = (true, None, Vec::new());
    let mut times = String::new();
    // One engine that cannot be had must not hide what the others compute.
    for choice in &choices {
        let name = choice.to_string();
        let outcome = model::engine(&file, &bundle, choice).and_then(|mut engine| {
            good &= check(&file, &mut engine, &probe, tolerance)?;
            if !args.no_times {
                times += &stage_table(file.path(), &mut engine, &format!("{name:<8} "))?;
            }
            Ok(())
        });
        match outcome {
            Ok(()) => checked.push(name),
            Err(HostError::Engine { source, .. })
                if args.engine.is_none() && source.is_unasked() =>
            {
                println!("{name:<8} not checked: {source}");
            }
            Err(e) => {
                println!("{name:<8} FAILED: {}", one_line(&e));
                failed = failed.or(Some(e));
            }
        }
    }
    print!("{times}");
    if !good {
        println!("FAILED: an engine does not compute what was trained");
        return Ok(EXIT_CHECK_FAILED);
    }
    match failed {
        Some(e) => Err(e),
        None => {
            println!("{}: ok", checked.join(", "));
            Ok(EXIT_OK)
        }
    }
}

fn check(
    file: &BundleFile,
    engine: &mut AnyEngine,
    probe: &Probe<'_>,
    tolerance: f32,
) -> Result<bool, HostError> {
    use tsda_runtime::Engine as _;
    let name = engine.name();
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
    Ok(good)
}
