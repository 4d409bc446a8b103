//! The parts of the page.

use std::collections::{BTreeMap, BTreeSet};

use super::failure_view::failures;
use super::html::Html;
use super::plot::{self, Class, Groups, Histogram, Lines, Series};
use super::samples::{Samples, quantile};
use super::{ProtocolExtras, ReportData};
use crate::metrics::score::Column;
use crate::metrics::{Convention, Figures};
use crate::protocol::Protocol;
use crate::report_data::{GroupData, ProtocolData, TrackerData, best, shown};

/// Spokes a radar chart can hold legibly.
const SPOKES: std::ops::RangeInclusive<usize> = 3..=24;

/// Name of a protocol in headings, and what it means.
fn protocol_text(name: Option<&str>) -> (String, String) {
    let Some(name) = name else { return ("Results".into(), String::new()) };
    let text = match name.parse() {
        Ok(Protocol::RgbToThermal) => "Marked in an RGB frame, followed in thermal frames.".into(),
        Ok(Protocol::ThermalToRgb) => "Marked in a thermal frame, followed in RGB frames.".into(),
        Ok(Protocol::Switch { every }) => {
            format!("Marked in an RGB frame; then thermal and RGB in turn, {every} frames each.")
        }
        Ok(Protocol::Rgb) => "RGB frames throughout.".into(),
        Ok(Protocol::Thermal) => "Thermal frames throughout.".into(),
        Err(_) => String::new(),
    };
    (format!("Protocol {name}"), text)
}

/// Heading of the figure with this key.
fn heading(convention: Convention, key: &str) -> &'static str {
    Figures::columns(convention).into_iter().find(|c| c.0 == key).map_or("AUC", |c| c.1)
}

pub(super) fn plural(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

pub(super) fn header(h: &mut Html, data: &ReportData, title: &str, card: bool) {
    h.element("h1", &[], title);
    let trackers: BTreeSet<&str> =
        data.protocols.iter().flat_map(|p| &p.trackers).map(|t| t.tracker.as_str()).collect();
    let sequences = data.protocols.iter().map(|p| p.sequences.len()).max().unwrap_or(0);
    h.within("p", &[("class", "soft")], |h| {
        h.text("Dataset ");
        h.element("strong", &[], &data.dataset);
        h.text(&format!(
            ", {}, {}, {}. Figures in per cent by the rules of the convention ",
            plural(sequences, "sequence"),
            plural(trackers.len(), "tracker"),
            plural(data.protocols.len(), "protocol")
        ));
        h.element("strong", &[], data.convention.as_str());
        h.text("; higher is better.");
    });
    h.within("nav", &[("aria-label", "Sections")], |h| {
        h.element("a", &[("href", "#overview")], "Overview");
        for (i, p) in data.protocols.iter().enumerate() {
            let text = p.protocol.as_deref().unwrap_or("results");
            h.element("a", &[("href", &format!("#p{i}"))], text);
        }
        if card {
            h.element("a", &[("href", "#model")], "Model card");
        }
    });
}

pub(super) fn footer(h: &mut Html, data: &ReportData, size: usize, limit: usize) {
    h.element(
        "p",
        &[],
        &format!(
            "One file, {} kB (limit {} kB), no scripts, nothing loaded. Layout version {} of the \
             figures.",
            size.div_ceil(1000),
            limit / 1000,
            data.version
        ),
    );
}

/// A row of a table of figures.
struct FigureRow<'a> {
    /// Number of the tracker, and its name.
    tracker: (usize, &'a str),
    figures: &'a Figures,
    /// Further cells.
    more: Vec<String>,
}

/// A table of figures: rows in groups of which each has its best values marked.
fn figure_table(
    h: &mut Html,
    convention: Convention,
    caption: &str,
    group_heading: Option<&str>,
    more: &[&str],
    groups: &[(String, Vec<FigureRow<'_>>)],
) {
    let columns = Figures::columns(convention);
    h.within("div", &[("class", "wide")], |h| {
        h.within("table", &[], |h| {
            h.element("caption", &[], caption);
            h.within("thead", &[], |h| {
                h.within("tr", &[], |h| {
                    for name in group_heading.into_iter().chain(["tracker"]) {
                        h.element("th", &[("scope", "col"), ("class", "l")], name);
                    }
                    for name in columns.iter().map(|c| c.1).chain(more.iter().copied()) {
                        h.element("th", &[("scope", "col")], name);
                    }
                });
            });
            h.within("tbody", &[], |h| {
                for (name, rows) in groups {
                    let figures: Vec<_> = rows.iter().map(|r| (r.tracker.1, r.figures)).collect();
                    let best = best(convention, &figures);
                    for (k, row) in rows.iter().enumerate() {
                        let first = k == 0 && group_heading.is_some();
                        let class: &[(&str, &str)] = if first { &[("class", "new")] } else { &[] };
                        h.within("tr", class, |h| {
                            if first {
                                h.element(
                                    "th",
                                    &[
                                        ("scope", "rowgroup"),
                                        ("class", "l"),
                                        ("rowspan", &rows.len().to_string()),
                                    ],
                                    name,
                                );
                            }
                            figure_row(h, &columns, row, &best);
                        });
                    }
                }
            });
        });
    });
}

fn figure_row(
    h: &mut Html,
    columns: &[Column],
    row: &FigureRow<'_>,
    best: &BTreeMap<&str, Vec<&str>>,
) {
    h.within("th", &[("scope", "row"), ("class", "l")], |h| {
        plot::key(h, row.tracker.0);
        h.text(row.tracker.1);
    });
    for (key, _, get) in columns {
        let is_best = best.get(key).is_some_and(|names| names.contains(&row.tracker.1));
        let class: &[(&str, &str)] =
            if is_best { &[("class", "best"), ("title", "best")] } else { &[] };
        h.element("td", class, &shown(get(row.figures)));
    }
    for cell in &row.more {
        h.element("td", &[], cell);
    }
}

pub(super) fn overview(h: &mut Html, data: &ReportData) {
    h.within("section", &[("id", "overview")], |h| {
        h.element("h2", &[], "Overview");
        h.within("div", &[("class", "cards")], |h| {
            for p in &data.protocols {
                let Some(first) = p.trackers.first() else { continue };
                h.within("div", &[("class", "card")], |h| {
                    h.element("b", &[], &shown(first.overall.figures.scores.auc));
                    let name = heading(data.convention, "auc");
                    let protocol =
                        p.protocol.as_deref().map(|p| format!(" under {p}")).unwrap_or_default();
                    h.element("span", &[], &format!("{name} of {}{protocol}", first.tracker));
                });
            }
        });
        let with_fps = data.protocols.iter().flat_map(|p| &p.trackers).any(|t| t.fps.is_some());
        let more: &[&str] =
            if with_fps { &["sequences", "frames", "fps"] } else { &["sequences", "frames"] };
        let groups: Vec<(String, Vec<FigureRow<'_>>)> = data
            .protocols
            .iter()
            .map(|p| {
                let rows = p.trackers.iter().enumerate().map(|(i, t)| FigureRow {
                    tracker: (i, &t.tracker),
                    figures: &t.overall.figures,
                    more: overall_cells(t, with_fps),
                });
                (p.protocol.clone().unwrap_or_else(|| "results".into()), rows.collect())
            })
            .collect();
        let caption = "Averages over all sequences. The best of each protocol is marked.";
        figure_table(h, data.convention, caption, Some("protocol"), more, &groups);
    });
}

fn overall_cells(t: &TrackerData, with_fps: bool) -> Vec<String> {
    let mut cells =
        vec![t.sequences.len().to_string(), t.overall.figures.scores.frames.to_string()];
    if with_fps {
        cells.push(t.fps.map_or("–".into(), |f| format!("{f:.0}")));
    }
    cells
}

/// Everything about one protocol.
pub(super) fn protocol(
    h: &mut Html,
    data: &ReportData,
    index: usize,
    extra: &ProtocolExtras,
    strips: &[String],
    with_sequences: bool,
) {
    let p = &data.protocols[index];
    h.within("section", &[("id", &format!("p{index}"))], |h| {
        let (title, about) = protocol_text(p.protocol.as_deref());
        h.element("h2", &[], &title);
        if !about.is_empty() {
            h.element("p", &[], &about);
        }
        curves(h, data, p);
        recovery(h, data, p);
        grouped(h, data.convention, p, "Attributes", "attribute", |t| &t.attributes);
        grouped(h, data.convention, p, "Number of sensor switches", "number of switches", |t| {
            &t.switches
        });
        frames(h, p, &extra.samples);
        failures(h, p, extra, strips);
        if with_sequences {
            h.markup(&sequences(data, p));
        } else {
            h.element(
                "p",
                &[("class", "soft")],
                "The table of single sequences is left out to keep the page small.",
            );
        }
        left_out(h, p);
    });
}

fn curves(h: &mut Html, data: &ReportData, p: &ProtocolData) {
    let convention = data.convention;
    let chart = |h: &mut Html,
                 title,
                 x_label,
                 thresholds: &[f64],
                 column: &str,
                 mark,
                 get: &dyn Fn(&TrackerData) -> Vec<f64>| {
        let figure = Figures::columns(convention).into_iter().find(|c| c.0 == column);
        let series = p
            .trackers
            .iter()
            .enumerate()
            .map(|(index, t)| Series {
                index,
                name: &t.tracker,
                figure: figure.map_or(String::new(), |(_, name, get)| {
                    format!("{name} {}", shown(get(&t.overall.figures)))
                }),
                points: thresholds.iter().copied().zip(get(t)).map(|(x, y)| [x, y]).collect(),
            })
            .collect();
        let x_end = thresholds.last().copied().unwrap_or(1.0);
        plot::lines(h, &Lines { title, x_label, x_end, mark, series });
    };
    let (key, pixels) = if convention == Convention::Gtot { ("pr5", 5.0) } else { ("pr20", 20.0) };
    let t = &data.thresholds;
    h.within("div", &[("class", "charts")], |h| {
        chart(h, "Success", "overlap (IoU) above", &t.success, "auc", None, &|t| {
            t.overall.curves.success.clone()
        });
        chart(
            h,
            "Precision",
            "centre error within, pixels",
            &t.precision,
            key,
            Some(pixels),
            &|t| t.overall.curves.precision.clone(),
        );
        let label = "centre error within, share of the target's size";
        let normalised = &t.normalised_precision;
        chart(h, "Normalised precision", label, normalised, "npr", Some(0.2), &|t| {
            t.overall.curves.normalised_precision.clone()
        });
    });
}

fn recovery(h: &mut Html, data: &ReportData, p: &ProtocolData) {
    if p.trackers.iter().all(|t| t.recovery.is_none()) {
        return;
    }
    h.element("h3", &[], "Recovery after a sensor switch");
    h.element(
        "p",
        &[("class", "soft")],
        &format!(
            "Recovered: IoU at least 0.5 in {} visible frames in a row before the next switch; the \
             time is the number of visible frames before them. Undisturbed: time 0. The median \
             counts switches without recovery as the slowest.",
            data.hold
        ),
    );
    h.within("div", &[("class", "wide")], |h| {
        h.within("table", &[], |h| {
            h.element("caption", &[], "Per tracker; shares in per cent, times in frames");
            h.within("thead", &[], |h| {
                h.within("tr", &[], |h| {
                    h.element("th", &[("scope", "col"), ("class", "l")], "tracker");
                    for name in ["switches", "recovered", "undisturbed", "mean time", "median time"]
                    {
                        h.element("th", &[("scope", "col")], name);
                    }
                });
            });
            h.within("tbody", &[], |h| {
                for (i, t) in p.trackers.iter().enumerate() {
                    let time = |v: Option<f64>| v.map_or("–".into(), |v| format!("{v:.1}"));
                    let cells = t.recovery.as_ref().map_or_else(
                        || vec!["–".to_owned(); 5],
                        |r| {
                            vec![
                                r.switches.to_string(),
                                shown(r.rate),
                                shown(r.undisturbed),
                                time(r.mean_frames),
                                time(r.median_frames),
                            ]
                        },
                    );
                    h.within("tr", &[], |h| {
                        h.within("th", &[("scope", "row"), ("class", "l")], |h| {
                            plot::key(h, i);
                            h.text(&t.tracker);
                        });
                        for cell in &cells {
                            h.element("td", &[], cell);
                        }
                    });
                }
            });
        });
    });
    let times = |t: &TrackerData| -> Vec<Option<usize>> {
        t.sequences.values().flat_map(|s| &s.recoveries).map(|r| r.frames).collect()
    };
    let longest = p.trackers.iter().flat_map(times).flatten().max().unwrap_or(0);
    let series =
        p.trackers.iter().enumerate().filter(|(_, t)| t.recovery.is_some()).map(|(index, t)| {
            let times = times(t);
            let points = (0..=longest.max(1)).map(|x| {
                let by = times.iter().flatten().filter(|v| **v <= x).count();
                [x as f64, by as f64 / times.len().max(1) as f64]
            });
            let rate = t.recovery.map_or(String::new(), |r| format!("{} %", shown(r.rate)));
            Series { index, name: &t.tracker, figure: rate, points: points.collect() }
        });
    let chart = Lines {
        title: "Switches recovered",
        x_label: "within visible frames after the switch",
        x_end: longest.max(1) as f64,
        mark: None,
        series: series.collect(),
    };
    h.within("div", &[("class", "charts")], |h| plot::lines(h, &chart));
}

/// Figures per attribute or number of switches: a chart of AUC and a table.
fn grouped(
    h: &mut Html,
    convention: Convention,
    p: &ProtocolData,
    title: &str,
    what: &str,
    groups: fn(&TrackerData) -> &Vec<GroupData>,
) {
    let mut names: Vec<&str> = Vec::new();
    for group in p.trackers.iter().flat_map(groups) {
        if !names.contains(&group.group.as_str()) {
            names.push(&group.group);
        }
    }
    if names.is_empty() {
        return;
    }
    h.element("h3", &[], title);
    let of = |t: &'_ TrackerData, name: &str| -> Option<f64> {
        let group = groups(t).iter().find(|g| g.group == name)?;
        Some(group.figures.scores.auc)
    };
    let chart_title = format!("{} per {what}", heading(convention, "auc"));
    let chart = Groups {
        title: &chart_title,
        names: names.clone(),
        series: p
            .trackers
            .iter()
            .enumerate()
            .map(|(i, t)| (i, t.tracker.as_str(), names.iter().map(|n| of(t, n)).collect()))
            .collect(),
    };
    // Switches are an order, attributes are not; and a radar of a dozen lines cannot be read.
    let radar = what == "attribute" && SPOKES.contains(&names.len()) && p.trackers.len() <= 8;
    // A chart of one group compares nothing that the table does not.
    if names.len() > 1 {
        h.within("div", &[("class", "charts")], |h| {
            if radar { plot::radar(h, &chart) } else { plot::bars(h, &chart) }
        });
    }
    let rows: Vec<(String, Vec<FigureRow<'_>>)> = names
        .iter()
        .map(|name| {
            let rows = p.trackers.iter().enumerate().filter_map(|(i, t)| {
                let group = groups(t).iter().find(|g| g.group == *name)?;
                Some(FigureRow {
                    tracker: (i, &t.tracker),
                    figures: &group.figures,
                    more: vec![group.sequences.to_string()],
                })
            });
            ((*name).to_owned(), rows.collect())
        })
        .collect();
    let caption = format!("Averages per {what}. The best of each is marked.");
    figure_table(h, convention, &caption, Some(what), &["sequences"], &rows);
}

/// Histograms of scores and times.
fn frames(h: &mut Html, p: &ProtocolData, samples: &[Samples]) {
    const BINS: usize = 25;
    let named = || p.trackers.iter().zip(samples).map(|(t, s)| (t.tracker.as_str(), s));
    h.element("h3", &[], "Scores and times of single frames");
    let any_score = named().any(|(_, s)| s.has_scores());
    let any_time = named().any(|(_, s)| !s.milliseconds.is_empty());
    h.within("div", &[("class", "charts")], |h| {
        for (name, s) in named().filter(|(_, s)| s.has_scores()) {
            let title = format!("Score of {name}");
            let all = || s.right.iter().chain(&s.wrong).chain(&s.absent).copied();
            let low = all().fold(0.0, f64::min);
            let high = all().fold(1.0, f64::max);
            let mut classes = vec![
                Class { index: 0, name: "right (IoU at least 0.5)", hollow: false, values: &s.right },
                Class { index: 1, name: "wrong (less)", hollow: true, values: &s.wrong },
            ];
            if !s.absent.is_empty() {
                classes.push(Class { index: 7, name: "target absent", hollow: true, values: &s.absent });
            }
            h.within("div", &[], |h| {
                let x_label = "score; each class adds up to 100 %";
                let range = [low, high];
                plot::histogram(
                    h,
                    &Histogram { title: &title, x_label, range, bins: BINS, marks: &[], classes },
                );
                let text = s.auroc().map_or_else(
                    || "All boxes are of one class, so the score separates nothing here.".to_owned(),
                    |a| {
                        let share = shown(a);
                        format!("A right box has the higher score than a wrong one in {share} % of pairs (AUROC).")
                    },
                );
                h.element("p", &[("class", "soft")], &text);
            });
        }
        for (i, (name, s)) in named().enumerate() {
            let Some(middle) = quantile(&s.milliseconds, 0.5) else { continue };
            let slow = quantile(&s.milliseconds, 0.95).unwrap_or(middle);
            let most = quantile(&s.milliseconds, 1.0).unwrap_or(slow);
            let end = quantile(&s.milliseconds, 0.99).unwrap_or(slow) * 1.15;
            let title = format!("Time per frame of {name}");
            h.within("div", &[], |h| {
                plot::histogram(
                    h,
                    &Histogram {
                        title: &title,
                        x_label: "milliseconds; slower ones stand in the last bar",
                        range: [0.0, end.max(1e-3)],
                        bins: BINS,
                        marks: &[(middle, "median"), (slow, "95 %")],
                        classes: vec![Class { index: i, name, hollow: false, values: &s.milliseconds }],
                    },
                );
                h.element(
                    "p",
                    &[("class", "soft")],
                    &format!("Median {middle:.1} ms, 95 % within {slow:.1} ms, slowest {most:.1} ms."),
                );
            });
        }
    });
    let missing = match (any_score, any_time) {
        (true, true) => return,
        (false, false) => "No scores and times are",
        (false, true) => "No scores are",
        (true, false) => "No times are",
    };
    let text = format!(
        "{missing} recorded beside these results (SEQUENCE_score.txt, SEQUENCE_time.txt), so there is \
         no histogram of them."
    );
    h.element("p", &[("class", "soft")], &text);
}

/// The table of single sequences, folded; on its own because it may be left out.
pub(super) fn sequences(data: &ReportData, p: &ProtocolData) -> String {
    let mut h = Html::default();
    let groups: Vec<(String, Vec<FigureRow<'_>>)> = p
        .sequences
        .iter()
        .map(|name| {
            let rows = p.trackers.iter().enumerate().filter_map(|(i, t)| {
                let s = t.sequences.get(name)?;
                let figures = &s.score.figures;
                let more = vec![
                    figures.scores.frames.to_string(),
                    s.switches.map_or("–".into(), |n| n.to_string()),
                ];
                Some(FigureRow { tracker: (i, &t.tracker), figures, more })
            });
            (name.clone(), rows.collect())
        })
        .collect();
    h.within("details", &[], |h| {
        h.element("summary", &[], &format!("All {}", plural(groups.len(), "sequence")));
        let caption = "Figures of single sequences. The best of each is marked.";
        let more = ["frames", "switches"];
        figure_table(h, data.convention, caption, Some("sequence"), &more, &groups);
    });
    h.finish()
}

fn left_out(h: &mut Html, p: &ProtocolData) {
    const SHOWN: usize = 50;
    if p.left_out.is_empty() {
        return;
    }
    let n = p.left_out.iter().map(|l| &l.sequence).collect::<BTreeSet<_>>().len();
    h.within("details", &[], |h| {
        let verb = if n == 1 { "is" } else { "are" };
        h.element("summary", &[], &format!("{} {verb} in no average", plural(n, "sequence")));
        h.within("ul", &[], |h| {
            for l in p.left_out.iter().take(SHOWN) {
                let who = l.tracker.as_ref().map(|t| format!(" ({t})")).unwrap_or_default();
                h.element("li", &[], &format!("{}{who}: {}", l.sequence, l.reason));
            }
            if p.left_out.len() > SHOWN {
                h.element("li", &[], &format!("and {} more", p.left_out.len() - SHOWN));
            }
        });
    });
}
