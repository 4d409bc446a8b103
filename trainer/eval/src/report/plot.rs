//! Charts as inline SVG. Colours are classes of the page's style sheet, so they follow light and
//! dark; every series also has a dash pattern of its own.

use super::html::{Html, at};

/// Colours of the style sheet.
const COLOURS: usize = 8;
/// Dash patterns; five and eight have no common factor, so 40 series differ.
const DASHES: [&str; 5] = ["none", "7 3", "2 3", "9 3 2 3", "12 4"];

/// Class suffix of the colour of series `i`.
pub(super) fn colour(i: usize) -> usize {
    i % COLOURS
}

/// Dash pattern of series `i`.
pub(super) fn dash(i: usize) -> &'static str {
    DASHES[i % DASHES.len()]
}

/// One line of a chart.
#[derive(Clone, Debug)]
pub(super) struct Series<'a> {
    /// Number that gives colour and dashes.
    pub index: usize,
    /// Name in the legend.
    pub name: &'a str,
    /// What the legend says beside the name.
    pub figure: String,
    /// Points, ascending in x.
    pub points: Vec<[f64; 2]>,
}

/// A chart of lines with y from 0 to 1.
#[derive(Clone, Debug)]
pub(super) struct Lines<'a> {
    /// Title of the chart.
    pub title: &'a str,
    /// Below the x axis.
    pub x_label: &'a str,
    /// Last x of the axis; it starts at 0.
    pub x_end: f64,
    /// A value of x that matters, drawn as a dashed line.
    pub mark: Option<f64>,
    /// The lines.
    pub series: Vec<Series<'a>>,
}

const WIDTH: f64 = 380.0;
const HEIGHT: f64 = 270.0;
const LEFT: f64 = 42.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 28.0;
const BOTTOM: f64 = 40.0;

/// Steps of 1, 2 or 5 times a power of ten, at most `most` of them up to `end`.
fn step(end: f64, most: f64) -> f64 {
    let raw = (end / most).max(f64::MIN_POSITIVE);
    let power = 10f64.powf(raw.log10().floor());
    [1.0, 2.0, 5.0]
        .map(|m| m * power)
        .into_iter()
        .find(|s| *s >= raw * 0.999)
        .unwrap_or(10.0 * power)
}

/// A number on an axis of steps `step`.
fn tick(value: f64, step: f64) -> String {
    let decimals = if step >= 1.0 { 0 } else { (-step.log10()).ceil() as usize };
    format!("{value:.decimals$}")
}

/// Opens a picture of this size with title and description for those who cannot see it.
pub(super) fn svg(
    h: &mut Html,
    [width, height]: [f64; 2],
    title: &str,
    about: &str,
    inside: impl FnOnce(&mut Html),
) {
    let view = format!("0 0 {} {}", at(width), at(height));
    let label = if about.is_empty() { title.to_owned() } else { format!("{title}. {about}") };
    h.within("svg", &[("viewBox", &view), ("role", "img"), ("aria-label", &label)], |h| {
        h.element("title", &[], title);
        inside(h);
    });
}

fn label(h: &mut Html, [x, y]: [f64; 2], anchor: &str, class: &str, text: &str) {
    h.element(
        "text",
        &[("x", &at(x)), ("y", &at(y)), ("text-anchor", anchor), ("class", class)],
        text,
    );
}

fn line(h: &mut Html, class: &str, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
    h.empty(
        "line",
        &[("class", class), ("x1", &at(x1)), ("y1", &at(y1)), ("x2", &at(x2)), ("y2", &at(y2))],
    );
}

fn rect(h: &mut Html, class: &str, [x, y, w, hh]: [f64; 4]) {
    h.empty(
        "rect",
        &[("class", class), ("x", &at(x)), ("y", &at(y)), ("width", &at(w)), ("height", &at(hh))],
    );
}

/// A stroke of a series, for legends and table rows.
pub(super) fn key(h: &mut Html, index: usize) {
    h.within(
        "svg",
        &[
            ("class", "key"),
            ("viewBox", "0 0 26 8"),
            ("width", "26"),
            ("height", "8"),
            ("aria-hidden", "true"),
        ],
        |h| {
            let class = format!("s{}", colour(index));
            h.empty(
                "line",
                &[
                    ("class", &class),
                    ("stroke-dasharray", dash(index)),
                    ("x1", "0"),
                    ("y1", "4"),
                    ("x2", "26"),
                    ("y2", "4"),
                ],
            );
        },
    );
}

/// Points of an SVG path.
fn path(points: impl Iterator<Item = [f64; 2]>) -> String {
    let mut d = String::new();
    for (i, [x, y]) in points.enumerate() {
        d.push_str(if i == 0 { "M" } else { "L" });
        d.push_str(&format!("{} {}", at(x), at(y)));
    }
    d
}

fn legend(h: &mut Html, entries: &[Series<'_>]) {
    h.within("ul", &[("class", "legend")], |h| {
        for s in entries {
            h.within("li", &[], |h| {
                key(h, s.index);
                h.element("span", &[], s.name);
                h.element("b", &[], &s.figure);
            });
        }
    });
}

/// Axes with a grid; y runs from 0 to `top` and is written as per cent.
fn axes(h: &mut Html, [low, high]: [f64; 2], x_label: &str, top: f64) {
    let y = |v: f64| HEIGHT - BOTTOM - v / top * (HEIGHT - TOP - BOTTOM);
    let x = |v: f64| LEFT + (v - low) / (high - low) * (WIDTH - LEFT - RIGHT);
    let dy = step(top, 5.0);
    for i in 0..=(top / dy + 1e-6) as usize {
        let v = i as f64 * dy;
        line(h, "grid", [LEFT, y(v)], [WIDTH - RIGHT, y(v)]);
        let text = format!("{} %", tick(100.0 * v, 100.0 * dy));
        label(h, [LEFT - 5.0, y(v) + 4.0], "end", "small", &text);
    }
    let dx = step(high - low, 6.0);
    let first = (low / dx - 1e-6).ceil();
    for i in 0..=((high - first * dx) / dx + 1e-6) as usize {
        let v = (first + i as f64) * dx;
        line(h, "axis", [x(v), y(0.0)], [x(v), y(0.0) + 4.0]);
        label(h, [x(v), y(0.0) + 17.0], "middle", "small", &tick(v, dx));
    }
    line(h, "axis", [LEFT, y(0.0)], [WIDTH - RIGHT, y(0.0)]);
    label(h, [(LEFT + WIDTH - RIGHT) / 2.0, HEIGHT - 6.0], "middle", "", x_label);
}

/// A chart of lines with its legend.
pub(super) fn lines(h: &mut Html, chart: &Lines<'_>) {
    let x_end = if chart.x_end > 0.0 { chart.x_end } else { 1.0 };
    let place = |[x, y]: [f64; 2]| {
        [
            LEFT + (x / x_end).clamp(0.0, 1.0) * (WIDTH - LEFT - RIGHT),
            HEIGHT - BOTTOM - y.clamp(0.0, 1.0) * (HEIGHT - TOP - BOTTOM),
        ]
    };
    let about: Vec<String> =
        chart.series.iter().map(|s| format!("{}: {}", s.name, s.figure)).collect();
    h.within("figure", &[], |h| {
        svg(h, [WIDTH, HEIGHT], chart.title, &about.join("; "), |h| {
            label(h, [LEFT, 16.0], "start", "name", chart.title);
            axes(h, [0.0, x_end], chart.x_label, 1.0);
            if let Some(v) = chart.mark {
                line(h, "mark", place([v, 0.0]), place([v, 1.0]));
            }
            // The first is drawn last, on top.
            for s in chart.series.iter().rev() {
                let class = format!("c s{}", colour(s.index));
                let d = path(s.points.iter().copied().filter(|p| p[1].is_finite()).map(place));
                h.within(
                    "path",
                    &[("class", &class), ("stroke-dasharray", dash(s.index)), ("d", &d)],
                    |h| h.element("title", &[], s.name),
                );
            }
        });
        legend(h, &chart.series);
    });
}

/// One class of a histogram.
#[derive(Clone, Debug)]
pub(super) struct Class<'a> {
    /// Colour.
    pub index: usize,
    /// Name in the legend.
    pub name: &'a str,
    /// Drawn as an outline.
    pub hollow: bool,
    /// What is counted.
    pub values: &'a [f64],
}

/// A histogram with x from `range[0]` to `range[1]`; what lies beyond is in the outermost bins.
#[derive(Clone, Debug)]
pub(super) struct Histogram<'a> {
    /// Title of the chart.
    pub title: &'a str,
    /// Below the x axis.
    pub x_label: &'a str,
    /// Ends of the axis.
    pub range: [f64; 2],
    /// Bins.
    pub bins: usize,
    /// Values of x marked with a line and a word.
    pub marks: &'a [(f64, &'a str)],
    /// Classes, each adding up to 100 %.
    pub classes: Vec<Class<'a>>,
}

/// Share of the values in each of `bins` equal bins of `range`, the outermost open.
pub(super) fn shares(values: &[f64], range: [f64; 2], bins: usize) -> Vec<f64> {
    let mut counts = vec![0usize; bins.max(1)];
    let width = (range[1] - range[0]).max(f64::MIN_POSITIVE);
    for v in values {
        let i = ((v - range[0]) / width * bins as f64).floor().clamp(0.0, bins as f64 - 1.0);
        // NaN becomes 0 in this cast; values are finite where they are read.
        counts[i as usize] += 1;
    }
    counts.iter().map(|n| *n as f64 / values.len().max(1) as f64).collect()
}

/// A histogram with its legend.
pub(super) fn histogram(h: &mut Html, chart: &Histogram<'_>) {
    let shares: Vec<Vec<f64>> =
        chart.classes.iter().map(|c| shares(c.values, chart.range, chart.bins)).collect();
    let top = shares.iter().flatten().copied().fold(0.01, f64::max) * 1.05;
    let [low, high] = chart.range;
    let x = |v: f64| LEFT + ((v - low) / (high - low)).clamp(0.0, 1.0) * (WIDTH - LEFT - RIGHT);
    let y = |v: f64| HEIGHT - BOTTOM - v / top * (HEIGHT - TOP - BOTTOM);
    let about: Vec<String> =
        chart.classes.iter().map(|c| format!("{}: {} frames", c.name, c.values.len())).collect();
    h.within("figure", &[], |h| {
        svg(h, [WIDTH, HEIGHT], chart.title, &about.join("; "), |h| {
            label(h, [LEFT, 16.0], "start", "name", chart.title);
            axes(h, chart.range, chart.x_label, top);
            let width = (WIDTH - LEFT - RIGHT) / chart.bins as f64;
            for (class, shares) in chart.classes.iter().zip(&shares) {
                let c = colour(class.index);
                let style =
                    if class.hollow { format!("f{c} s{c} hollow") } else { format!("f{c}") };
                let (inset, width) =
                    if class.hollow { (1.0, width - 2.0) } else { (1.5, width - 3.0) };
                for (i, share) in shares.iter().enumerate().filter(|(_, s)| **s > 0.0) {
                    let left = LEFT + i as f64 * (WIDTH - LEFT - RIGHT) / chart.bins as f64;
                    rect(h, &style, [left + inset, y(*share), width, y(0.0) - y(*share)]);
                }
            }
            for (v, name) in chart.marks {
                line(h, "mark", [x(*v), y(0.0)], [x(*v), TOP]);
                let (dx, anchor) =
                    if x(*v) > WIDTH * 0.75 { (-3.0, "end") } else { (3.0, "start") };
                label(h, [x(*v) + dx, TOP + 9.0], anchor, "small", name);
            }
        });
        h.within("ul", &[("class", "legend")], |h| {
            for class in &chart.classes {
                let c = colour(class.index);
                let style =
                    if class.hollow { format!("f{c} s{c} hollow") } else { format!("f{c}") };
                h.within("li", &[], |h| {
                    h.within(
                        "svg",
                        &[
                            ("class", "key"),
                            ("viewBox", "0 0 26 10"),
                            ("width", "26"),
                            ("height", "10"),
                            ("aria-hidden", "true"),
                        ],
                        |h| rect(h, &style, [1.0, 1.0, 24.0, 8.0]),
                    );
                    h.element("span", &[], class.name);
                    h.element("b", &[], &format!("{} frames", class.values.len()));
                });
            }
        });
    });
}

/// Values of several series over the same names, in `[0, 1]`.
#[derive(Clone, Debug)]
pub(super) struct Groups<'a> {
    /// Title of the chart.
    pub title: &'a str,
    /// Names of the groups.
    pub names: Vec<&'a str>,
    /// Number and name of each series, and its value per group.
    pub series: Vec<(usize, &'a str, Vec<Option<f64>>)>,
}

impl Groups<'_> {
    fn legend(&self, h: &mut Html) {
        if self.series.len() < 2 {
            return;
        }
        let entries: Vec<Series<'_>> = self
            .series
            .iter()
            .map(|(index, name, _)| Series {
                index: *index,
                name,
                figure: String::new(),
                points: Vec::new(),
            })
            .collect();
        legend(h, &entries);
    }
}

/// Horizontal bars, one block per group.
pub(super) fn bars(h: &mut Html, chart: &Groups<'_>) {
    const BAR: f64 = 13.0;
    const GAP: f64 = 9.0;
    let left = 74.0;
    let block = chart.series.len() as f64 * BAR + GAP;
    let height = TOP + chart.names.len() as f64 * block + 4.0;
    let x = |v: f64| left + v.clamp(0.0, 1.0) * (WIDTH - left - 44.0);
    h.within("figure", &[], |h| {
        svg(h, [WIDTH, height], chart.title, "The values stand in the table.", |h| {
            label(h, [0.0, 16.0], "start", "name", chart.title);
            line(h, "axis", [x(0.0), TOP], [x(0.0), height - GAP / 2.0]);
            for (g, name) in chart.names.iter().enumerate() {
                let top = TOP + g as f64 * block;
                let middle = top + (block - GAP) / 2.0 + 4.0;
                label(h, [left - 6.0, middle], "end", "", name);
                for (k, (index, _, values)) in chart.series.iter().enumerate() {
                    let Some(v) = values.get(g).copied().flatten() else { continue };
                    let y = top + k as f64 * BAR;
                    let class = format!("f{}", colour(*index));
                    rect(h, &class, [x(0.0), y + 1.0, x(v) - x(0.0), BAR - 2.0]);
                    label(
                        h,
                        [x(v) + 4.0, y + BAR - 3.0],
                        "start",
                        "small",
                        &crate::report_data::shown(v),
                    );
                }
            }
        });
        chart.legend(h);
    });
}

/// A radar chart: one spoke per group, the rim is the highest value rounded up to a tenth.
pub(super) fn radar(h: &mut Html, chart: &Groups<'_>) {
    const SIDE: f64 = 380.0;
    const RADIUS: f64 = 130.0;
    let values = || chart.series.iter().flat_map(|s| s.2.iter().flatten());
    let rim = ((values().copied().fold(0.1, f64::max) * 10.0).ceil() / 10.0).min(1.0);
    let n = chart.names.len() as f64;
    let place = |i: usize, v: f64| {
        let angle = std::f64::consts::TAU * i as f64 / n - std::f64::consts::FRAC_PI_2;
        let r = v / rim * RADIUS;
        [SIDE / 2.0 + r * angle.cos(), SIDE / 2.0 + 8.0 + r * angle.sin()]
    };
    h.within("figure", &[], |h| {
        svg(h, [SIDE, SIDE - 30.0], chart.title, "The values stand in the table.", |h| {
            label(h, [0.0, 16.0], "start", "name", chart.title);
            for ring in [0.25, 0.5, 0.75, 1.0] {
                let d = path((0..chart.names.len()).map(|i| place(i, ring * rim))) + "Z";
                h.empty("path", &[("class", "grid"), ("d", &d)]);
            }
            let [cx, _] = place(0, 0.0);
            for ring in [0.5, 1.0] {
                let [_, y] = place(0, ring * rim);
                label(
                    h,
                    [cx + 3.0, y + 11.0],
                    "start",
                    "small",
                    &crate::report_data::shown(ring * rim),
                );
            }
            for (i, name) in chart.names.iter().enumerate() {
                line(h, "grid", place(i, 0.0), place(i, rim));
                let [x, y] = place(i, rim * 1.1);
                let anchor = match x - SIDE / 2.0 {
                    d if d > 8.0 => "start",
                    d if d < -8.0 => "end",
                    _ => "middle",
                };
                label(h, [x, y + 4.0], anchor, "", name);
            }
            for (index, name, values) in chart.series.iter().rev() {
                let c = colour(*index);
                let points = values.iter().enumerate().filter_map(|(i, v)| Some(place(i, (*v)?)));
                let d = path(points) + "Z";
                h.empty("path", &[("class", &format!("area f{c}")), ("d", &d)]);
                h.within(
                    "path",
                    &[("class", &format!("c s{c}")), ("stroke-dasharray", dash(*index)), ("d", &d)],
                    |h| h.element("title", &[], name),
                );
            }
        });
        chart.legend(h);
    });
}

/// Overlap over the frames of one sequence.
#[derive(Clone, Debug)]
pub(super) struct Timeline<'a> {
    /// Title of the picture.
    pub title: &'a str,
    /// Overlap per frame, `None` where the target is absent.
    pub iou: &'a [Option<f64>],
    /// Per frame: is it thermal? Empty where sensors are unknown.
    pub thermal: &'a [bool],
    /// First and one past the last frame of the failure.
    pub failed: [usize; 2],
    /// Frames shown as pictures.
    pub shown: &'a [usize],
}

/// Draws a timeline: background by sensor, the failure shaded, one tick per picture.
pub(super) fn timeline(h: &mut Html, chart: &Timeline<'_>) {
    const W: f64 = 1100.0;
    const H: f64 = 112.0;
    const L: f64 = 42.0;
    const T: f64 = 16.0;
    const B: f64 = 20.0;
    let n = chart.iou.len().max(2) as f64;
    let x = |i: f64| L + i / n * (W - L - 6.0);
    let y = |v: f64| H - B - v * (H - T - B);
    svg(h, [W, H], chart.title, "", |h| {
        // Runs of one sensor.
        let mut start = 0;
        for i in 1..=chart.thermal.len() {
            if i == chart.thermal.len() || chart.thermal[i] != chart.thermal[start] {
                let class = if chart.thermal[start] { "thermal" } else { "rgb" };
                rect(h, class, [x(start as f64), T, x(i as f64) - x(start as f64), H - T - B]);
                start = i;
            }
        }
        let [from, to] = chart.failed.map(|f| x(f as f64));
        rect(h, "failed", [from, T, to - from, H - T - B]);
        for v in [0.0, 0.5, 1.0] {
            line(h, "grid", [L, y(v)], [W - 6.0, y(v)]);
            label(h, [L - 5.0, y(v) + 4.0], "end", "small", &tick(v, 0.5));
        }
        let mut d = String::new();
        let mut pen_up = true;
        for (i, v) in chart.iou.iter().enumerate() {
            match v {
                Some(v) => {
                    d.push_str(if pen_up { "M" } else { "L" });
                    d.push_str(&format!("{} {}", at(x(i as f64 + 0.5)), at(y(v.clamp(0.0, 1.0)))));
                    pen_up = false;
                }
                None => pen_up = true,
            }
        }
        h.empty("path", &[("class", "c s0"), ("d", &d)]);
        for (k, frame) in chart.shown.iter().enumerate() {
            let at_x = x(*frame as f64 + 0.5);
            line(h, "mark", [at_x, T], [at_x, H - B]);
            label(
                h,
                [at_x, T - 4.0],
                "middle",
                "small",
                &char::from(b'a' + (k % 26) as u8).to_string(),
            );
        }
        let dx = step(n, 10.0).max(1.0);
        for i in 0..=(n / dx) as usize {
            let v = i as f64 * dx;
            label(h, [x(v + 0.5), H - 5.0], "middle", "small", &tick(v, dx));
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_have_round_numbers() {
        for (end, most, want) in
            [(1.0, 5.0, 0.2), (50.0, 6.0, 10.0), (0.5, 6.0, 0.1), (3.0, 5.0, 1.0)]
        {
            assert!((step(end, most) - want).abs() < 1e-9, "{end} {most}: {}", step(end, most));
        }
        assert_eq!((tick(0.4, 0.2), tick(20.0, 10.0)), ("0.4".into(), "20".into()));
    }

    #[test]
    fn every_value_is_in_one_bin() {
        let all = shares(&[-1.0, 0.0, 0.49, 0.5, 1.0, 7.0], [0.0, 1.0], 2);
        assert_eq!(all, [0.5, 0.5]);
        assert_eq!(shares(&[], [0.0, 1.0], 2), [0.0, 0.0]);
        assert_eq!(shares(&[3.0], [3.0, 3.0], 1), [1.0]);
    }

    #[test]
    fn forty_series_differ() {
        let looks: std::collections::BTreeSet<_> = (0..40).map(|i| (colour(i), dash(i))).collect();
        assert_eq!(looks.len(), 40);
    }
}
