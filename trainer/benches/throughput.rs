//! Training throughput on a made-up batch, as one line of JSON per network:
//!
//! `cargo bench -p tsda-trainer --bench throughput [-- [nano|tomp50 ..] [--crop N] [--batch N] [--steps N]]`
//!
//! `scripts/torch_throughput.py` measures the same networks in PyTorch.

use anyhow::{Context as _, bail};
use burn::prelude::Device;
use std::path::Path;
use tsda_trainer::config::Experiment;
use tsda_trainer::fit::throughput;

struct Case {
    preset: String,
    crop: u16,
    batch: usize,
    steps: usize,
}

fn cases() -> anyhow::Result<Vec<Case>> {
    let (mut presets, mut crop, mut batch, mut steps) = (Vec::new(), None, None, None);
    // Without `--bench`, this is `cargo test`: see that it runs.
    let mut quick = true;
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut number = || -> anyhow::Result<u16> {
            let value = arguments.next().with_context(|| format!("{argument} needs a number"))?;
            value.parse().with_context(|| format!("{argument} {value}"))
        };
        match argument.as_str() {
            "--bench" => quick = false,
            "--crop" => crop = Some(number()?),
            "--batch" => batch = Some(usize::from(number()?)),
            "--steps" => steps = Some(usize::from(number()?)),
            name if !name.starts_with('-') => presets.push(name.to_owned()),
            other => bail!("unknown option {other}"),
        }
    }
    if quick {
        let preset = "nano".to_owned();
        return Ok(vec![Case { preset, crop: 32, batch: 2, steps: 1 }]);
    }
    if presets.is_empty() {
        presets = vec!["nano".to_owned(), "tomp50".to_owned()];
    }
    let case = |preset: String| {
        let nano = preset == "nano";
        Case {
            crop: crop.unwrap_or(if nano { 160 } else { 144 }),
            batch: batch.unwrap_or(if nano { 8 } else { 4 }),
            steps: steps.unwrap_or(if nano { 30 } else { 5 }),
            preset,
        }
    };
    Ok(presets.into_iter().map(case).collect())
}

fn main() -> anyhow::Result<()> {
    tsda_trainer::memory::keep_freed_memory();
    for Case { preset, crop, batch, steps } in cases()? {
        // The settings of configs/nano.toml that cost time.
        let text = format!(
            "[model]\npreset = \"{preset}\"\ncrop = {crop}\n[[data]]\nkind = \"pairs\"\npath = \"unused\"\n\
             [optim]\nema_decay = 0.998\nclip_norm = 0.0\ndropout = 0.05\nattention_dropout = 0.0\n\
             freeze = \"before_stride16\"\n[init]\nbackbone = \"scratch\"\n\
             [run]\nbatch = {batch}\nsteps = 1000\n"
        );
        let experiment = Experiment::parse(&text, Path::new("benches/throughput.rs"))?;
        let figures = throughput(&experiment, &Device::flex(), 2.min(steps), steps)?;
        let mut line = serde_json::to_value(figures)?;
        if let Some(line) = line.as_object_mut() {
            line.insert("preset".into(), preset.into());
            line.insert("crop".into(), crop.into());
        }
        println!("{line}");
    }
    Ok(())
}
