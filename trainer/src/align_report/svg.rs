//! The scatter of descriptors along their first two principal components.

use super::descriptors::{Role, Views};
use super::pca::Pca;
use std::fmt::Write as _;

const WIDTH: f64 = 760.0;
const HEIGHT: f64 = 560.0;
/// Left, top, right, bottom edge of the plot.
const PLOT: [f64; 4] = [70.0, 48.0, 740.0, 490.0];
/// Targets drawn, and how many of them with lines; more would only blacken the picture.
const DRAWN: usize = 150;
const JOINED: usize = 40;
/// Blue and vermilion of the Okabe-Ito palette, which all kinds of colour vision tell apart.
const COLOURS: [&str; 2] = ["#0072B2", "#D55E00"];
const NAMES: [&str; 2] = ["RGB", "thermal"];
/// Templates and search crops that are drawn together: template sensor, search sensor.
const PAIRS: [(usize, usize); 2] = [(0, 1), (1, 0)];

/// A descriptor in the plane of the components.
struct Point {
    at: (f64, f64),
    sensor: usize,
    role: Role,
}

/// The picture of one stage: targets in both cross-modal directions. `centred` views and their
/// components.
pub fn scatter(title: &str, centred: &[Views], pca: &Pca) -> String {
    let shown = &centred[..centred.len().min(DRAWN)];
    let place = |v: &[f64]| {
        let p = pca.project(v);
        let at = |i: usize| p.get(i).copied().unwrap_or(0.0);
        (at(0), at(1))
    };
    let point = |views: &Views, role, sensor, partner| Point {
        at: place(views.at(role, sensor, partner)),
        sensor,
        role,
    };
    let pairs: Vec<[Point; 2]> = shown
        .iter()
        .flat_map(|t| {
            PAIRS.map(|(a, b)| [point(t, Role::Template, a, b), point(t, Role::Search, b, a)])
        })
        .collect();
    let axes = [
        Axis::new(pairs.iter().flatten().map(|p| p.at.0), [PLOT[0], PLOT[2]]),
        Axis::new(pairs.iter().flatten().map(|p| p.at.1), [PLOT[3], PLOT[1]]),
    ];
    let at = |(x, y): (f64, f64)| (axes[0].place(x), axes[1].place(y));

    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" \
         width=\"{WIDTH}\" height=\"{HEIGHT}\" font-family=\"sans-serif\" font-size=\"13\" \
         fill=\"#222\">\n<title>{0}</title>\n<rect width=\"{WIDTH}\" height=\"{HEIGHT}\" \
         fill=\"white\"/>\n<text x=\"{1}\" y=\"28\" font-size=\"17\">{0}</text>\n",
        escape(title),
        PLOT[0]
    );
    frame(&mut svg, &axes, pca);
    svg.push_str("<g stroke=\"#666\" stroke-width=\"0.7\" stroke-opacity=\"0.6\">\n");
    for [a, b] in pairs.iter().take(2 * JOINED) {
        let ((x1, y1), (x2, y2)) = (at(a.at), at(b.at));
        put(
            &mut svg,
            format_args!("<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>\n"),
        );
    }
    svg.push_str("</g>\n");
    for point in pairs.iter().flatten() {
        marker(&mut svg, at(point.at), point.sensor, point.role, 4.0);
    }
    for sensor in 0..2 {
        let of: Vec<_> =
            pairs.iter().flatten().filter(|p| p.sensor == sensor).map(|p| p.at).collect();
        let n = of.len().max(1) as f64;
        let centre = of.iter().fold((0.0, 0.0), |s, p| (s.0 + p.0 / n, s.1 + p.1 / n));
        centroid(&mut svg, at(centre), sensor);
    }
    legend(&mut svg, shown.len(), centred.len());
    svg.push_str("</svg>\n");
    svg
}

/// Appends to a text; formatting into a `String` cannot fail.
pub(crate) fn put(svg: &mut String, text: std::fmt::Arguments<'_>) {
    let _ = svg.write_fmt(text);
}

/// A linear scale with some air on both sides.
pub(crate) struct Axis {
    low: f64,
    high: f64,
    pixels: [f64; 2],
}

impl Axis {
    /// A scale for all values between two positions in the picture.
    pub fn new(values: impl Iterator<Item = f64>, pixels: [f64; 2]) -> Self {
        let (low, high) = values
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        let air = ((high - low) * 0.05).max(1e-9);
        Self { low: low - air, high: high + air, pixels }
    }

    /// Position of a value.
    pub fn place(&self, value: f64) -> f64 {
        let share = (value - self.low) / (self.high - self.low);
        self.pixels[0] + share * (self.pixels[1] - self.pixels[0])
    }

    /// Some five round values.
    pub fn ticks(&self) -> Vec<(f64, String)> {
        let rough = (self.high - self.low) / 5.0;
        let power = rough.log10().floor();
        let step = [1.0, 2.0, 5.0, 10.0]
            .map(|m| m * 10f64.powf(power))
            .into_iter()
            .find(|s| *s >= rough * 0.99)
            .unwrap_or(rough);
        let digits = (-step.log10().floor()).max(0.0) as usize;
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step).floor() as i64;
        (first..=last)
            .map(|i| {
                let value = i as f64 * step;
                (value, format!("{value:.digits$}"))
            })
            .collect()
    }
}

fn frame(svg: &mut String, axes: &[Axis; 2], pca: &Pca) {
    let [left, top, right, bottom] = PLOT;
    for (value, text) in axes[0].ticks() {
        let x = axes[0].place(value);
        put(
            svg,
            format_args!(
                "<line x1=\"{x:.1}\" y1=\"{top}\" x2=\"{x:.1}\" y2=\"{bottom}\" stroke=\"#e4e4e4\"/>\
             <text x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>\n",
                bottom + 18.0
            ),
        );
    }
    for (value, text) in axes[1].ticks() {
        let y = axes[1].place(value);
        put(
            svg,
            format_args!(
                "<line x1=\"{left}\" y1=\"{y:.1}\" x2=\"{right}\" y2=\"{y:.1}\" stroke=\"#e4e4e4\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>\n",
                left - 6.0,
                y + 4.5
            ),
        );
    }
    let share = |i: usize| 100.0 * pca.explained.get(i).copied().unwrap_or(0.0);
    let (middle_x, middle_y) = (0.5 * (left + right), 0.5 * (top + bottom));
    put(
        svg,
        format_args!(
            "<rect x=\"{left}\" y=\"{top}\" width=\"{}\" height=\"{}\" fill=\"none\" \
         stroke=\"#888\"/>\n<text x=\"{middle_x}\" y=\"{}\" text-anchor=\"middle\">component 1 \
         ({:.1} % of the variance)</text>\n<text transform=\"translate(20 {middle_y}) \
         rotate(-90)\" text-anchor=\"middle\">component 2 ({:.1} % of the variance)</text>\n",
            right - left,
            bottom - top,
            bottom + 38.0,
            share(0),
            share(1)
        ),
    );
}

/// Templates are discs, search crops hollow triangles.
fn marker(svg: &mut String, (x, y): (f64, f64), sensor: usize, role: Role, r: f64) {
    let colour = COLOURS[sensor];
    match role {
        Role::Template => put(
            svg,
            format_args!(
                "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{r}\" fill=\"{colour}\" \
             fill-opacity=\"0.75\"/>\n"
            ),
        ),
        Role::Search => put(
            svg,
            format_args!(
                "<path d=\"M{x:.1} {:.1}l{:.1} {:.1}h{:.1}z\" fill=\"white\" fill-opacity=\"0.6\" \
             stroke=\"{colour}\" stroke-width=\"1.5\"/>\n",
                y - 1.2 * r,
                1.1 * r,
                2.0 * r,
                -2.2 * r
            ),
        ),
    }
}

/// A cross with a white edge, seen on any crowd.
fn centroid(svg: &mut String, (x, y): (f64, f64), sensor: usize) {
    for (colour, width) in [("white", 7.0), (COLOURS[sensor], 3.5)] {
        put(
            svg,
            format_args!(
                "<path d=\"M{:.1} {y:.1}h18M{x:.1} {:.1}v18\" stroke=\"{colour}\" \
             stroke-width=\"{width}\" stroke-linecap=\"round\"/>\n",
                x - 9.0,
                y - 9.0
            ),
        );
    }
}

fn legend(svg: &mut String, shown: usize, all: usize) {
    let y = HEIGHT - 14.0;
    let mut x = PLOT[0];
    for (sensor, name) in NAMES.iter().enumerate() {
        for (role, word) in Role::ALL.into_iter().zip(["template", "search"]) {
            marker(svg, (x + 4.0, y - 4.0), sensor, role, 4.5);
            put(svg, format_args!("<text x=\"{}\" y=\"{y}\">{name} {word}</text>\n", x + 13.0));
            x += 32.0 + 7.0 * (name.len() + word.len()) as f64;
        }
    }
    put(
        svg,
        format_args!(
            "<text x=\"{}\" y=\"28\" text-anchor=\"end\" fill=\"#666\">{shown} of {all} targets; \
         lines join {}; + centroid</text>\n",
            PLOT[2],
            if shown > JOINED { format!("the pairs of {JOINED}") } else { "pairs".into() }
        ),
    );
}

/// Text for XML and HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
