//! `tsda-export golden`.

use anyhow::{Context as _, bail};
use clap::Args;
use std::path::PathBuf;
use std::process::ExitCode;
use tsda_export::golden::{self, EngineKind, Selection, report};
use tsda_runtime::ModelSpec;
use tsda_runtime::spec::MAX_TEMPLATES;

/// Arguments of `tsda-export golden`.
#[derive(Args)]
pub(crate) struct GoldenArgs {
    /// Folder of cases (docs/parity.md); without it, back ends are compared with burn in the form
    /// the reference is written in, on weights and images by recipe.
    #[arg(long)]
    dir: Option<PathBuf>,
    /// Shape of the network: tomp101, tomp50, nano or small.
    #[arg(long)]
    preset: String,
    /// Back end: burn, wgpu, native, tract, ort or all (of those compiled in); may be repeated.
    #[arg(long, default_value = "all")]
    engine: Vec<String>,
    /// Only this file of figures.
    #[arg(long, requires = "dir")]
    case: Option<PathBuf>,
    /// Most templates, without --dir.
    #[arg(long, conflicts_with = "dir", default_value_t = 2,
          value_parser = clap::value_parser!(u8).range(1..=MAX_TEMPLATES as i64))]
    templates: u8,
    /// Whether the network has the test-frame embedding [default: as the case says].
    #[arg(long, value_name = "yes|no", value_parser = yes_or_no)]
    test_embedding: Option<bool>,
    /// The network's filter size [default: as the case says].
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..))]
    filter_size: Option<u8>,
    /// Succeed in spite of tensors that are not known.
    #[arg(long)]
    allow_unknown: bool,
    /// Everything found, as JSON; - for standard output, which then holds nothing else.
    #[arg(long, value_name = "FILE|-")]
    json: Option<PathBuf>,
    /// Markdown document in which the section of this run is added or replaced.
    #[arg(long, value_name = "FILE.md")]
    report: Option<PathBuf>,
    /// Title of the section [default: preset and folder].
    #[arg(long, requires = "report")]
    title: Option<String>,
}

fn yes_or_no(text: &str) -> Result<bool, String> {
    match text {
        "yes" => Ok(true),
        "no" => Ok(false),
        _ => Err("expected yes or no".into()),
    }
}

/// The back ends asked for.
fn engines(names: &[String]) -> anyhow::Result<Vec<EngineKind>> {
    let mut chosen = Vec::new();
    for name in names {
        if name == "all" {
            for (kind, name, compiled) in EngineKind::ALL {
                if compiled {
                    chosen.push(kind);
                } else {
                    eprintln!(
                        "{name}: not part of this program (cargo feature `{name}`), left out"
                    );
                }
            }
        } else if let Some((kind, ..)) = EngineKind::ALL.iter().find(|(_, n, _)| n == name) {
            chosen.push(*kind);
        } else {
            let known: Vec<&str> = EngineKind::ALL.iter().map(|(_, n, _)| *n).collect();
            bail!("--engine {name}: expected {} or all", known.join(", "));
        }
    }
    Ok(chosen)
}

/// Compares, prints, answers the exit code.
pub(crate) fn run(args: &GoldenArgs) -> anyhow::Result<ExitCode> {
    let Some(mut spec) = ModelSpec::preset(&args.preset) else {
        bail!("--preset {}: expected tomp101, tomp50, nano, pico, pico-v3 or small", args.preset);
    };
    let engines = engines(&args.engine)?;
    let found = match &args.dir {
        Some(dir) => golden::run(
            &Selection {
                dir: dir.clone(),
                preset: args.preset.clone(),
                spec,
                case: args.case.clone(),
                test_embedding: args.test_embedding,
                filter_size: args.filter_size,
            },
            &engines,
        )?,
        None => {
            spec.test_embedding = args.test_embedding.unwrap_or(spec.test_embedding);
            spec.filter_size = args.filter_size.unwrap_or(spec.filter_size);
            golden::run_without_reference(&args.preset, &spec, args.templates.into(), &engines)?
        }
    };
    let to_stdout = args.json.as_ref().is_some_and(|p| p.as_os_str() == "-");
    if let Some(path) = &args.json {
        let text = serde_json::to_string_pretty(&found).context("the report as JSON")?;
        match to_stdout {
            true => println!("{text}"),
            false => tsda_export::files::write(path, text.as_bytes())?,
        }
    }
    if !to_stdout {
        print!("{found}");
    }
    if let Some(path) = &args.report {
        let folder = args.dir.as_ref().and_then(|d| d.file_name());
        let title = args.title.clone().unwrap_or_else(|| match folder {
            Some(folder) => format!("{}, cases of `{}`", args.preset, folder.to_string_lossy()),
            None => format!("{}, up to {} templates, by recipe", args.preset, args.templates),
        });
        let old = match path.exists() {
            true => tsda_export::files::read_text(path)?,
            false => String::new(),
        };
        let text = report::with_section(&old, &title, &found.markdown(&title));
        tsda_export::files::write(path, text.as_bytes())?;
    }
    let passed = found.passed(args.allow_unknown);
    if !to_stdout {
        println!("{}", if passed { "ok" } else { "NOT ok" });
    }
    Ok(if passed { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
