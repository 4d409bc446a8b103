//! `training.html`: the curves of a run in one file that needs nothing else, from `log.jsonl`.

use super::FitError;
use crate::align_report::svg::{Axis, escape, put};
use crate::checkpoint::write_atomic;
use crate::config::Experiment;
use serde_json::Value;

const WIDTH: f64 = 440.0;
const HEIGHT: f64 = 250.0;
/// Left, top, right, bottom edge of a plot.
const PLOT: [f64; 4] = [58.0, 30.0, 428.0, 212.0];
/// Points of a line; longer logs are averaged in groups of neighbours.
const POINTS: usize = 400;
/// Okabe-Ito colours, which all kinds of colour vision tell apart.
const COLOURS: [&str; 3] = ["#0072B2", "#D55E00", "#009E73"];
/// Least value of a logarithmic axis.
const TINY: f64 = 1e-12;
const DASHES: [&str; 3] = ["none", "6 3", "2 3"];

/// A chart: title, logarithmic, event, and the lines with the pointers to their numbers.
type Chart = (&'static str, bool, &'static str, &'static [(&'static str, &'static str)]);

/// All charts; those without a number in the log are left out.
const CHARTS: [Chart; 12] = [
    ("Total loss", true, "train", &[("loss", "/loss")]),
    ("Classification loss", true, "train", &[("training", "/cls")]),
    ("Box loss (GIoU)", false, "train", &[("training", "/giou")]),
    (
        "Validation: overlap at the best cell",
        false,
        "validation",
        &[("all", "/all/iou"), ("same sensor", "/same/iou"), ("across sensors", "/cross/iou")],
    ),
    (
        "Validation: share with overlap above 0.5",
        false,
        "validation",
        &[
            ("all", "/all/success"),
            ("same sensor", "/same/success"),
            ("across sensors", "/cross/success"),
        ],
    ),
    (
        "Alignment losses",
        false,
        "train",
        &[("adversarial (BCE)", "/adversarial"), ("contrastive (InfoNCE)", "/contrastive")],
    ),
    (
        "Discriminator accuracy (0.5: chance)",
        false,
        "train",
        &[("accuracy", "/discriminator_accuracy")],
    ),
    (
        "What alignment asks of the descriptors",
        true,
        "train",
        &[("adversarial", "/adversarial_pull"), ("contrastive", "/contrastive_pull")],
    ),
    (
        "Gradient norms",
        true,
        "train",
        &[
            ("network", "/grad_norm"),
            ("discriminator", "/discriminator_grad_norm"),
            ("projection", "/projection_grad_norm"),
        ],
    ),
    ("Learning rate of the head", false, "train", &[("head", "/lr")]),
    ("Samples per second", false, "train", &[("samples/s", "/samples_per_s")]),
    ("Share of the time waiting for data", false, "train", &[("wait", "/data_wait")]),
];

struct Line {
    name: &'static str,
    points: Vec<(f64, f64)>,
}

/// Entries of the run as it went: a resumed run repeats steps after its checkpoint, and what was
/// logged of them before counts no more.
fn entries(log: &str) -> Vec<Value> {
    let mut kept: Vec<Value> = Vec::new();
    for entry in log.lines().filter_map(|l| serde_json::from_str::<Value>(l).ok()) {
        if entry["event"] == "resume" {
            let from = entry["step"].as_u64().unwrap_or(0);
            kept.retain(|e| e["step"].as_u64().is_some_and(|s| s <= from));
        }
        kept.push(entry);
    }
    kept
}

/// Numbers at `pointer` over steps, at most [`POINTS`] of them.
fn line(entries: &[Value], event: &str, name: &'static str, pointer: &str) -> Line {
    let all: Vec<(f64, f64)> = entries
        .iter()
        .filter(|e| e["event"] == event)
        .filter_map(|e| Some((e["step"].as_f64()?, e.pointer(pointer)?.as_f64()?)))
        .collect();
    let group = all.len().div_ceil(POINTS).max(1);
    let points = all
        .chunks(group)
        .map(|c| {
            let n = c.len() as f64;
            let sum = c.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
            (sum.0 / n, sum.1 / n)
        })
        .collect();
    Line { name, points }
}

/// A number for an axis or a legend.
fn short(value: f64) -> String {
    match value.abs() {
        0.0 => "0".into(),
        v if v >= 100.0 => format!("{value:.0}"),
        v if v >= 1.0 => format!("{value:.2}"),
        v if v >= 1e-3 => format!("{value:.4}"),
        _ => format!("{value:.1e}"),
    }
}

/// Ticks of a logarithmic axis: decades, with 2 and 5 between them where there are few.
fn decades(values: impl Iterator<Item = f64>) -> Vec<(f64, String)> {
    let (low, high) = values
        .map(|v| v.max(TINY).log10())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    let between: &[f64] = if high - low < 2.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
    (low.floor() as i32..=high.ceil() as i32)
        .flat_map(|power| between.iter().map(move |m| m * 10f64.powi(power)))
        .map(|v| (v.log10(), v))
        .filter(|(at, _)| (low..=high).contains(at))
        .map(|(at, v)| (at, if v >= 1.0 { format!("{v}") } else { short(v) }))
        .collect()
}

/// One chart; `start` is a step to mark. `None` without any number.
fn chart(
    (title, log, event, series): &Chart,
    entries: &[Value],
    start: Option<u64>,
) -> Option<String> {
    let height = |v: f64| if *log { v.max(TINY).log10() } else { v };
    let lines: Vec<Line> = series
        .iter()
        .map(|(name, pointer)| line(entries, event, name, pointer))
        .filter(|l| !l.points.is_empty())
        .collect();
    let points = || lines.iter().flat_map(|l| &l.points);
    let first = points().next()?;
    // A flat or single line still needs an axis of some length.
    let value = height(first.1);
    let around = [value - 0.02 * value.abs().max(1e-9), value + 0.02 * value.abs().max(1e-9)];
    let ys = points().map(|p| height(p.1)).chain(around);
    let y = Axis::new(ys, [PLOT[3], PLOT[1]]);
    let x = Axis::new(points().map(|p| p.0).chain([first.0 + 1.0]), [PLOT[0], PLOT[2]]);

    let [left, top, right, bottom] = PLOT;
    let mut svg = format!(
        "<figure><svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{0}\">\n\
         <title>{0}</title><text x=\"{left}\" y=\"18\" class=\"name\">{0}</text>\n",
        escape(title)
    );
    let ticks = if *log { decades(points().map(|p| p.1).chain([first.1])) } else { y.ticks() };
    for (value, text) in ticks {
        let at = y.place(value);
        put(
            &mut svg,
            format_args!(
                "<path class=\"grid\" d=\"M{left} {at:.1}H{right}\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>\n",
                left - 5.0,
                at + 4.0
            ),
        );
    }
    for (value, text) in x.ticks() {
        let at = x.place(value);
        put(
            &mut svg,
            format_args!(
                "<path class=\"grid\" d=\"M{at:.1} {top}V{bottom}\"/><text x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>\n",
                bottom + 16.0
            ),
        );
    }
    put(
        &mut svg,
        format_args!(
            "<text x=\"{right}\" y=\"{}\" text-anchor=\"end\">step</text>\n",
            HEIGHT - 6.0
        ),
    );
    if let Some(start) = start.map(|s| x.place(s as f64)).filter(|at| (left..=right).contains(at)) {
        put(&mut svg, format_args!("<path class=\"mark\" d=\"M{start:.1} {top}V{bottom}\"/>\n"));
    }
    for (i, l) in lines.iter().enumerate() {
        let (colour, dash) = (COLOURS[i % COLOURS.len()], DASHES[i % DASHES.len()]);
        let d: String = l
            .points
            .iter()
            .enumerate()
            .map(|(i, p)| {
                let letter = if i == 0 { 'M' } else { 'L' };
                format!("{letter}{:.1} {:.1}", x.place(p.0), y.place(height(p.1)))
            })
            .collect();
        put(
            &mut svg,
            format_args!(
                "<path class=\"line\" stroke=\"{colour}\" stroke-dasharray=\"{dash}\" d=\"{d}\"><title>{}</title></path>\n",
                l.name
            ),
        );
        if let [only] = l.points.as_slice() {
            let (cx, cy) = (x.place(only.0), y.place(height(only.1)));
            put(
                &mut svg,
                format_args!("<circle cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"3\" fill=\"{colour}\"/>\n"),
            );
        }
    }
    svg.push_str("</svg><figcaption>");
    for (i, l) in lines.iter().enumerate() {
        let last = l.points.last().map(|p| short(p.1)).unwrap_or_default();
        put(
            &mut svg,
            format_args!(
                "<span><svg viewBox=\"0 0 26 8\" class=\"key\"><path class=\"line\" stroke=\"{}\" stroke-dasharray=\"{}\" d=\"M0 4H26\"/></svg>{} <b>{last}</b></span> ",
                COLOURS[i % COLOURS.len()],
                DASHES[i % DASHES.len()],
                l.name
            ),
        );
    }
    svg.push_str("</figcaption></figure>\n");
    Some(svg)
}

/// The page of a run from the text of its log.
fn page(experiment: &Experiment, log: &str) -> String {
    let entries = entries(log);
    let start = experiment.align.is_on().then(|| experiment.align_start());
    let charts: String = CHARTS.iter().filter_map(|c| chart(c, &entries, start)).collect();
    let first = entries.iter().find(|e| e["event"] == "start" || e["event"] == "resume");
    let number = |name: &str| first.map_or(String::from("-"), |e| e[name].to_string());
    let done = entries.iter().filter_map(|e| e["step"].as_u64()).max().unwrap_or(0);
    let align = match start {
        Some(step) => format!("{} from step {step} (dashed line)", experiment.align.preset.name()),
        None => format!("{} (no alignment losses)", experiment.align.preset.name()),
    };
    let rows: String = [
        ("Steps", format!("{done} of {}", experiment.total_steps())),
        ("Batch", experiment.run.batch.to_string()),
        ("Seed", experiment.run.seed.to_string()),
        ("Parameters of the network", number("parameters")),
        ("Sequences", number("sequences")),
        ("Alignment", align),
    ]
    .iter()
    .map(|(name, value)| format!("<tr><th>{name}</th><td>{}</td></tr>\n", escape(value)))
    .collect();
    let title = escape(&experiment.run.out.display().to_string());
    include_str!("curves.html")
        .replace("{{title}}", &title)
        .replace("{{rows}}", &rows)
        .replace("{{charts}}", &charts)
}

/// Writes `training.html` beside the run's `log.jsonl`.
pub(super) fn write(experiment: &Experiment) -> Result<(), FitError> {
    let out = &experiment.run.out;
    let path = out.join("log.jsonl");
    let log = std::fs::read_to_string(&path).map_err(|source| FitError::Io {
        action: "read",
        path,
        source,
    })?;
    Ok(write_atomic(&out.join(PAGE), page(experiment, &log).as_bytes())?)
}

/// Name of the page.
pub(super) const PAGE: &str = "training.html";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::AlignPreset;

    fn log(steps: std::ops::Range<u64>) -> String {
        steps
            .map(|s| {
                let loss = 3.0 / (s + 1) as f64;
                format!(
                    "{{\"event\":\"train\",\"step\":{s},\"loss\":{loss},\"cls\":{loss},\"giou\":null,\
                     \"adversarial\":0.69}}\n"
                )
            })
            .collect()
    }

    #[test]
    fn a_resumed_run_is_drawn_as_it_went() {
        let text = log(0..10) + "{\"event\":\"resume\",\"step\":4}\n" + &log(5..8) + "half a li";
        let drawn = line(&entries(&text), "train", "loss", "/loss");
        let steps: Vec<f64> = drawn.points.iter().map(|p| p.0).collect();
        assert_eq!(steps, (0..8).map(f64::from).collect::<Vec<_>>());
        // Long logs are thinned without losing their ends' values.
        let many = line(&entries(&log(0..3000)), "train", "loss", "/loss");
        assert!(many.points.len() <= POINTS);
    }

    #[test]
    fn logarithmic_axes_have_round_ticks() {
        let texts = |values: &[f64]| -> Vec<String> {
            decades(values.iter().copied()).into_iter().map(|(_, t)| t).collect()
        };
        assert_eq!(texts(&[1.9, 6.0]), ["2", "5"]);
        assert_eq!(texts(&[0.03, 9000.0]), ["0.1000", "1", "10", "100", "1000"]);
    }

    #[test]
    fn the_page_has_the_charts_there_are_numbers_for() {
        let mut experiment = Experiment::default();
        experiment.run.out = "a<b".into();
        experiment.align.preset = AlignPreset::PreAfa;
        experiment.align.start_step = Some(2);
        let page = page(&experiment, &log(0..10));
        assert!(page.contains("Total loss") && page.contains("Alignment losses"));
        assert!(page.contains("class=\"mark\"") && page.contains("a&lt;b"));
        assert!(!page.contains("GIoU") && !page.contains("Validation") && !page.contains("{{"));
        assert!(!page.contains("NaN") && !page.contains("inf"));
        assert!(!page.contains("http"), "the page must not load anything");
        // One point, or a line without slope.
        for text in [log(3..4), log(3..4) + &log(3..4)] {
            assert!(!super::page(&experiment, &text).contains("NaN"));
        }
        assert!(super::page(&experiment, "").contains("Steps"));
    }
}
