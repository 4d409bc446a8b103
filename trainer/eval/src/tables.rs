//! [`ReportData`] as Markdown and CSV.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use crate::metrics::{Convention, Figures, Recovery};
use crate::report_data::{GroupData, ProtocolData, ReportData, TrackerData, best, shown};

/// The report as Markdown, figures in per cent; the best of each column is bold (all equal ones, at
/// the precision shown).
pub fn markdown(report: &ReportData) -> String {
    let mut text = format!("# {}, convention {}\n", report.dataset, report.convention);
    for protocol in &report.protocols {
        if let Some(name) = &protocol.protocol {
            let _ = write!(text, "\n## {name}\n");
        }
        overall(&mut text, report.convention, protocol);
        recovery(&mut text, protocol, report.hold);
        grouped(&mut text, report.convention, protocol, "attribute", |t| &t.attributes);
        grouped(&mut text, report.convention, protocol, "switches", |t| &t.switches);
        if !protocol.left_out.is_empty() {
            let n = protocol.left_out.iter().map(|l| &l.sequence).collect::<BTreeSet<_>>().len();
            let _ = write!(text, "\n{n} sequences are in no average:\n\n");
            for l in &protocol.left_out {
                let who = l.tracker.as_ref().map(|t| format!(" ({})", cell(t))).unwrap_or_default();
                let _ = writeln!(text, "- {}{who}: {}", cell(&l.sequence), l.reason);
            }
        }
    }
    text
}

/// A pipe in a name would end its cell.
fn cell(name: &str) -> String {
    name.replace('|', "\\|")
}

fn head(text: &mut String, left: &[&str], right: &[&str]) {
    text.push('\n');
    for name in left.iter().chain(right) {
        let _ = write!(text, "| {name} ");
    }
    text.push_str("|\n");
    text.push_str(&"|---".repeat(left.len()));
    text.push_str(&"|---:".repeat(right.len()));
    text.push_str("|\n");
}

/// Figures of one row, the best bold.
fn values(
    text: &mut String,
    convention: Convention,
    tracker: &str,
    figures: &Figures,
    best: &BTreeMap<&str, Vec<&str>>,
) {
    for (key, _, get) in Figures::columns(convention) {
        let value = shown(get(figures));
        let bold = best.get(key).is_some_and(|names| names.contains(&tracker));
        let _ = if bold { write!(text, "| **{value}** ") } else { write!(text, "| {value} ") };
    }
}

fn headings(convention: Convention) -> Vec<&'static str> {
    Figures::columns(convention).iter().map(|c| c.1).collect()
}

fn overall(text: &mut String, convention: Convention, protocol: &ProtocolData) {
    let with_fps = protocol.trackers.iter().any(|t| t.fps.is_some());
    let mut right = headings(convention);
    right.extend(["sequences", "frames"]);
    if with_fps {
        right.push("fps");
    }
    head(text, &["tracker"], &right);
    let rows: Vec<_> =
        protocol.trackers.iter().map(|t| (t.tracker.as_str(), &t.overall.figures)).collect();
    let best = best(convention, &rows);
    for t in &protocol.trackers {
        let _ = write!(text, "| {} ", cell(&t.tracker));
        values(text, convention, &t.tracker, &t.overall.figures, &best);
        let _ = write!(text, "| {} | {} ", t.sequences.len(), t.overall.figures.scores.frames);
        if with_fps {
            let _ = write!(text, "| {} ", t.fps.map_or("-".into(), |f| format!("{f:.0}")));
        }
        text.push_str("|\n");
    }
}

fn recovery(text: &mut String, protocol: &ProtocolData, hold: usize) {
    if protocol.trackers.iter().all(|t| t.recovery.is_none()) {
        return;
    }
    let _ = write!(
        text,
        "\nRecovery after a sensor switch (IoU at least 0.5 for {hold} frames; times in frames):\n"
    );
    let columns = ["switches", "recovered %", "undisturbed %", "mean", "median"];
    head(text, &["tracker"], &columns);
    for t in &protocol.trackers {
        let _ = write!(text, "| {} ", cell(&t.tracker));
        match &t.recovery {
            Some(r) => {
                let frames = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.1}"));
                let _ = write!(
                    text,
                    "| {} | {} | {} | {} | {} ",
                    r.switches,
                    shown(r.rate),
                    shown(r.undisturbed),
                    frames(r.mean_frames),
                    frames(r.median_frames)
                );
            }
            None => text.push_str("| - | - | - | - | - "),
        }
        text.push_str("|\n");
    }
}

fn grouped(
    text: &mut String,
    convention: Convention,
    protocol: &ProtocolData,
    what: &str,
    groups: fn(&TrackerData) -> &Vec<GroupData>,
) {
    let mut names: Vec<&str> = Vec::new();
    for group in protocol.trackers.iter().flat_map(groups) {
        if !names.contains(&group.group.as_str()) {
            names.push(&group.group);
        }
    }
    if names.is_empty() {
        return;
    }
    let mut right = headings(convention);
    right.push("sequences");
    head(text, &[what, "tracker"], &right);
    for name in names {
        let rows: Vec<(&str, &GroupData)> = protocol
            .trackers
            .iter()
            .filter_map(|t| Some((t.tracker.as_str(), groups(t).iter().find(|g| g.group == name)?)))
            .collect();
        let figures: Vec<_> = rows.iter().map(|(t, g)| (*t, &g.figures)).collect();
        let best = best(convention, &figures);
        for (tracker, group) in rows {
            let _ = write!(text, "| {} | {} ", cell(name), cell(tracker));
            values(text, convention, tracker, &group.figures, &best);
            let _ = writeln!(text, "| {} |", group.sequences);
        }
    }
}

/// The report as CSV, one row per tracker and table entry, figures as fractions with six decimals.
/// `table` is `overall`, `attribute`, `switches` or `sequence`; `best` lists the figures in which
/// this tracker is the best of its group, separated by spaces.
pub fn csv(report: &ReportData) -> String {
    let columns = Figures::columns(report.convention);
    let mut text = String::from("protocol,table,group,tracker,sequences,frames");
    for (key, ..) in &columns {
        let _ = write!(text, ",{key}");
    }
    text.push_str(",switches,recovered,recovery_mean,recovery_median,best\n");
    for protocol in &report.protocols {
        // Rows of one group stand together, so the best of each can be found.
        type Entry<'a> = (&'a str, usize, &'a Figures, Option<Recovery>);
        let mut groups: Vec<((&str, &str), Vec<Entry<'_>>)> = Vec::new();
        let mut add = |key, entry| match groups.iter_mut().find(|(k, _)| *k == key) {
            Some((_, rows)) => rows.push(entry),
            None => groups.push((key, vec![entry])),
        };
        for t in &protocol.trackers {
            let n = t.sequences.len();
            add(("overall", ""), (t.tracker.as_str(), n, &t.overall.figures, t.recovery));
        }
        for t in &protocol.trackers {
            for (table, list) in [("attribute", &t.attributes), ("switches", &t.switches)] {
                for g in list {
                    let entry = (t.tracker.as_str(), g.sequences, &g.figures, g.recovery);
                    add((table, g.group.as_str()), entry);
                }
            }
            for (name, s) in &t.sequences {
                let recovery = Recovery::of(&s.recoveries, report.hold);
                let entry = (t.tracker.as_str(), 1, &s.score.figures, recovery);
                add(("sequence", name.as_str()), entry);
            }
        }
        let name = protocol.protocol.as_deref().unwrap_or_default();
        for ((table, group), rows) in &groups {
            let figures: Vec<_> = rows.iter().map(|r| (r.0, r.2)).collect();
            let best = best(report.convention, &figures);
            for (tracker, sequences, figures, recovery) in rows {
                let _ = write!(
                    text,
                    "{},{table},{},{},{sequences},{}",
                    quoted(name),
                    quoted(group),
                    quoted(tracker),
                    figures.scores.frames
                );
                for (_, _, get) in &columns {
                    let _ = write!(text, ",{:.6}", get(figures));
                }
                match recovery {
                    Some(r) => {
                        let frames = |v: Option<f64>| v.map_or(String::new(), |v| v.to_string());
                        let (mean, median) = (frames(r.mean_frames), frames(r.median_frames));
                        let _ = write!(text, ",{},{},{mean},{median}", r.switches, r.recovered);
                    }
                    None => text.push_str(",,,,"),
                }
                let keys: Vec<&str> =
                    best.iter().filter(|(_, n)| n.contains(tracker)).map(|(k, _)| *k).collect();
                let _ = writeln!(text, ",{}", keys.join(" "));
            }
        }
    }
    text
}

/// A CSV field; quoted where it has to be.
fn quoted(field: &str) -> String {
    if field.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", field.replace('"', "\"\""))
    } else {
        field.to_owned()
    }
}
