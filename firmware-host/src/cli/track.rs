//! `tsda track`.

use super::{TrackArgs, progress_bar, stop_flag};
use crate::error::{EXIT_OK, HostError};
use crate::frames::{
    FrameSource, PictureFiles, SourceError, Y4m, find_init, parse_box, read_boxes,
};
use crate::metrics::{Segment, over, segments};
use crate::track::{BoxesFile, JsonLines, Run, Sink, Step};
use crate::{model, video};
use std::fs::File;
use std::io::{BufReader, stdin};
use std::path::Path;
use tsda_runtime::BBox;

pub(super) fn run(args: &TrackArgs) -> Result<u8, HostError> {
    let mut source = open_frames(args)?;
    let (init, from) = first_box(args)?;
    let truth = args.truth.as_deref().map(read_boxes).transpose()?.unwrap_or_default();
    let bundle = model::load(args.bundle.as_deref())?;
    let mut tracker = model::tracker_on(&bundle, &args.engine.choice()?)?;
    args.redetect.apply(&mut tracker)?;

    let total = source.len_hint();
    let mut sinks: Vec<Box<dyn Sink>> = vec![Box::new(BoxesFile::create(&args.out)?)];
    if let Some(path) = &args.json {
        sinks.push(Box::new(JsonLines::create(path)?));
    }
    for path in &args.video_out {
        sinks.push(video::open(path, total)?);
    }
    let bar = progress_bar(total, "tracking");
    let run = Run { init, init_from: &from, truth: &truth, stop: stop_flag() };
    let steps = run.drive(&mut tracker, source.as_mut(), sinks, |step| {
        bar.inc(1);
        bar.set_message(format!("{} {:.2} {}", step.modality, step.score, step.state));
    });
    bar.finish_and_clear();
    let steps = steps?;

    let figures = over(&steps, &truth, 0..steps.len());
    if figures.frames > 0 {
        eprint!("{}", figures_table(&steps, &segments(&steps, &truth), &truth));
    }
    eprintln!("{}", speed_line(&steps));
    if let Some(pool) = crate::bench::pool() {
        eprintln!("{pool}");
    }
    eprintln!("boxes: {}", args.out.display());
    for path in args.json.iter().filter(|p| *p != Path::new("-")).chain(&args.video_out) {
        eprintln!("also:  {}", path.display());
    }
    Ok(EXIT_OK)
}

fn open_frames(args: &TrackArgs) -> Result<Box<dyn FrameSource>, HostError> {
    let path = &args.frames;
    if path == Path::new("-") {
        return Ok(Box::new(Y4m::open(BufReader::new(stdin()), "stdin", args.modality)?));
    }
    if path.is_dir() {
        return Ok(Box::new(PictureFiles::folder(path)?));
    }
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("y4m")) {
        let file =
            File::open(path).map_err(|source| SourceError::Io { path: path.clone(), source })?;
        let name = path.display().to_string();
        return Ok(Box::new(Y4m::open(BufReader::new(file), &name, args.modality)?));
    }
    Ok(Box::new(PictureFiles::list(path)?))
}

/// The first box and where it came from.
fn first_box(args: &TrackArgs) -> Result<(BBox, String), HostError> {
    if let Some(text) = &args.init {
        let what = format!("--init {text}");
        return match parse_box(text) {
            Ok(b) => Ok((b, what)),
            Err(reason) => Err(HostError::Init { what, reason }),
        };
    }
    if args.frames != Path::new("-")
        && let Some((path, b)) = find_init(&args.frames)?
    {
        return Ok((b, path.display().to_string()));
    }
    Err(HostError::Init {
        what: "no first box".into(),
        reason: "pass --init x,y,w,h, or put groundtruth.txt or init.txt beside the frames".into(),
    })
}

/// SR0.5, PR20 and mean IoU by segment and over all.
pub(super) fn figures_table(steps: &[Step], parts: &[Segment], truth: &[Option<BBox>]) -> String {
    let mut text = format!(
        "{:<9} {:>11} {:>8} {:>7} {:>7} {:>9}\n",
        "sensor", "frames", "counted", "SR0.5", "PR20", "mean IoU"
    );
    let mut row = |name: &str, first: usize, last: usize, f: crate::metrics::Figures| {
        text.push_str(&format!(
            "{:<9} {:>11} {:>8} {:>7.3} {:>7.3} {:>9.3}\n",
            name,
            format!("{first}-{last}"),
            f.frames,
            f.sr50,
            f.pr20,
            f.mean_iou
        ));
    };
    for part in parts {
        row(part.modality.as_str(), part.frames.start, part.frames.end - 1, part.figures);
    }
    if parts.len() > 1 {
        row("all", 0, steps.len() - 1, over(steps, truth, 0..steps.len()));
    }
    text
}

/// Frames, median time, rate.
pub(super) fn speed_line(steps: &[Step]) -> String {
    let mut ms: Vec<f32> = steps.iter().skip(1).map(|s| s.ms).collect();
    ms.sort_by(f32::total_cmp);
    let median = ms.get(ms.len() / 2).copied().unwrap_or(0.0);
    let rate = if median > 0.0 { 1000.0 / median } else { 0.0 };
    format!("{} frames, median {median:.1} ms per frame ({rate:.0} frames/s)", steps.len())
}
