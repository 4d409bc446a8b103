//! `tsda demo`.

use super::track::{figures_table, speed_line};
use super::{DemoArgs, progress_bar, stop_flag};
use crate::error::{EXIT_OK, HostError};
use crate::frames::FrameSource;
use crate::metrics::segments;
use crate::model;
use crate::render::{Clip, ClipConfig};
use crate::sequence::{ClipFrames, SequenceFolder, Switching};
use crate::track::{BoxesFile, Run, Sink};
use crate::video::{GifVideo, HtmlPage, Strip};
use std::path::Path;
use tsda_runtime::BBox;

/// Files the demo writes.
const BOXES: &str = "boxes.txt";
const GIF: &str = "demo.gif";
const PAGE: &str = "demo.html";
const STRIP: &str = "strip.png";

pub(super) fn run(args: &DemoArgs) -> Result<u8, HostError> {
    let bundle = model::load(args.bundle.as_deref())?;
    let choice = args.engine.choice()?;
    let mut tracker = model::tracker_on(&bundle, &choice)?;
    args.redetect.apply(&mut tracker)?;
    let switching = args.switch_every.map_or(Switching::Middle, |n| Switching::Every(n as usize));
    let (mut source, truth, what) = open(args, switching)?;
    let first = truth.first().copied().flatten().ok_or_else(|| HostError::Init {
        what: what.clone(),
        reason: "the first frame has no known box".into(),
    })?;

    std::fs::create_dir_all(&args.out)
        .map_err(|source| HostError::Create { path: args.out.clone(), source })?;
    let total = source.len_hint();
    let sinks: Vec<Box<dyn Sink>> = vec![
        Box::new(BoxesFile::create(&args.out.join(BOXES))?),
        Box::new(GifVideo::create(&args.out.join(GIF), total)?),
        Box::new(HtmlPage::create(&args.out.join(PAGE))?),
        Box::new(Strip::create(&args.out.join(STRIP))?),
    ];
    println!("clip:   {what}");
    println!("model:  {} on {choice}", bundle.path().display());
    let bar = progress_bar(total, "tracking");
    let run = Run { init: first, init_from: &what, truth: &truth, stop: stop_flag() };
    let steps = run.drive(&mut tracker, source.as_mut(), sinks, |step| {
        bar.inc(1);
        bar.set_message(format!("{} {:.2} {}", step.modality, step.score, step.state));
    });
    bar.finish_and_clear();
    let steps = steps?;

    let parts = segments(&steps, &truth);
    for pair in parts.windows(2) {
        println!(
            "switch: {} -> {} at frame {}",
            pair[0].modality, pair[1].modality, pair[1].frames.start
        );
    }
    println!("speed:  {}", speed_line(&steps));
    print!("{}", figures_table(&steps, &parts, &truth));
    println!(
        "results in {}: {PAGE} (open in a browser), {GIF}, {STRIP}, {BOXES}",
        args.out.display()
    );
    Ok(EXIT_OK)
}

type Opened = (Box<dyn FrameSource>, Vec<Option<BBox>>, String);

fn open(args: &DemoArgs, switching: Switching) -> Result<Opened, HostError> {
    match &args.data {
        Some(folder) => {
            let SequenceFolder { frames, truth, sensors } =
                SequenceFolder::open(folder, switching)?;
            let sensors: Vec<&str> = sensors.iter().map(|s| s.as_str()).collect();
            let what =
                format!("{}, {} frames, {}", shown(folder), truth.len(), sensors.join(" and "));
            Ok((Box::new(frames), truth, what))
        }
        None => {
            let clip = Clip::new(ClipConfig { seed: args.seed, ..ClipConfig::default() });
            let config = clip.config();
            let what = format!(
                "rendered, {} frames of {} x {}, seed {}",
                config.frames, config.width, config.height, config.seed
            );
            let frames = ClipFrames::new(clip, switching);
            let truth = frames.truth();
            Ok((Box::new(frames), truth, what))
        }
    }
}

fn shown(folder: &Path) -> String {
    folder
        .file_name()
        .map_or_else(|| folder.display().to_string(), |n| n.to_string_lossy().into_owned())
}
