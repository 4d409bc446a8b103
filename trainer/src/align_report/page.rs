//! The report for people: a table for the terminal and one self-contained page.

use super::measures::Interval;
use super::svg::escape;
use super::{ProbeStage, Report};

/// Name, figure before and after the encoder, and what the figure of aligned sensors would be.
type Row = (&'static str, [String; 2], &'static str);

fn plain(value: Option<f64>) -> String {
    value.map_or_else(|| "-".into(), |v| format!("{v:.3}"))
}

fn interval(value: Option<Interval>) -> String {
    value.map_or_else(|| "-".into(), |i| format!("{:.3} ({:.3}..{:.3})", i.value, i.low, i.high))
}

fn percent(probe: &ProbeStage) -> String {
    let p = probe.both;
    format!("{:.1} % ({:.1}..{:.1})", 100.0 * p.accuracy, 100.0 * p.low, 100.0 * p.high)
}

fn rows(report: &Report) -> Vec<Row> {
    let stages = [&report.pre, &report.post];
    let row = |name, figure: &dyn Fn(&super::Stage) -> String, aligned| -> Row {
        (name, stages.map(figure), aligned)
    };
    vec![
        row("R (95 %)", &|s| interval(s.measures.r), "1"),
        row("R, RGB to thermal", &|s| plain(s.measures.r_rgb_to_thermal), "1"),
        row("R, thermal to RGB", &|s| plain(s.measures.r_thermal_to_rgb), "1"),
        row("R, not centred", &|s| plain(s.measures.r_uncentred), "1"),
        row("separation", &|s| plain(s.measures.separation), "well below 1"),
        row(
            "cosine, same target, across sensors",
            &|s| plain(Some(s.measures.cosine.cross)),
            "as below",
        ),
        row("cosine, same target, same sensor", &|s| plain(Some(s.measures.cosine.same)), ""),
        row("cosine, other target, same sensor", &|s| plain(s.measures.cosine.other), "near 0"),
        row("modality gap", &|s| plain(s.measures.gap), "0"),
        row("probe accuracy (95 %)", &|s| percent(&s.probe), "50 %"),
    ]
}

/// The figures as aligned text.
pub fn table(report: &Report) -> String {
    let rows = rows(report);
    let head = ("", ["pre-encoder".to_owned(), "post-encoder".to_owned()], "aligned");
    let wide = |cell: &dyn Fn(&Row) -> usize| {
        rows.iter().chain([&head]).map(cell).max().unwrap_or_default()
    };
    let (name, pre, post) =
        (wide(&|r| r.0.len()), wide(&|r| r.1[0].len()), wide(&|r| r.1[1].len()));
    [&head]
        .into_iter()
        .chain(&rows)
        .map(|(n, [a, b], aligned)| {
            let line = format!("{n:name$}  {a:>pre$}  {b:>post$}  {aligned}");
            line.trim_end().to_owned() + "\n"
        })
        .collect()
}

/// The page; `pre` and `post` are SVG pictures.
pub fn html(report: &Report, pre: &str, post: &str) -> String {
    let cells: String = rows(report)
        .iter()
        .map(|(name, [a, b], aligned)| {
            format!("<tr><th>{name}</th><td>{a}</td><td>{b}</td><td>{aligned}</td></tr>\n")
        })
        .collect();
    include_str!("page.html")
        .replace("{{weights}}", &escape(&report.weights))
        .replace("{{data}}", &escape(&report.data))
        .replace("{{targets}}", &report.targets.to_string())
        .replace("{{sequences}}", &report.sequences.to_string())
        .replace("{{seed}}", &report.seed.to_string())
        .replace("{{width}}", &report.width.to_string())
        .replace("{{rows}}", &cells)
        .replace("{{pre}}", pre)
        .replace("{{post}}", post)
}
