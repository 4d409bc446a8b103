//! What a comparison found, for people, for programs and for the documentation.

use serde::Serialize;
use std::fmt::{self, Write as _};

/// One figure on one back end.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Line {
    /// File of the figure, without its extension.
    pub case: String,
    /// Its name.
    pub tensor: String,
    /// The back end.
    pub engine: &'static str,
    /// Shape of the figure.
    pub shape: Vec<usize>,
    /// Largest absolute difference; infinite (null in JSON) where there was no number.
    pub difference: f32,
    /// Largest absolute value of the figure.
    pub peak: f32,
    /// Largest difference allowed.
    pub tolerance: f32,
    /// Why nothing could be compared.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detail: Option<String>,
}

impl Line {
    /// Whether the difference is allowed.
    pub fn ok(&self) -> bool {
        self.difference <= self.tolerance
    }
}

/// What was found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Name of the preset.
    pub preset: String,
    /// Every figure on every back end that computes it.
    pub lines: Vec<Line>,
    /// Tensors that are not known, with their file.
    pub unknown: Vec<(String, String)>,
    /// Known figures that none of the back ends asked for computes.
    pub not_computed: Vec<(String, String)>,
    /// Tensors of training steps, by file; the trainer's tests compare those.
    pub training: Vec<(String, usize)>,
    /// What was decided about the cases.
    pub notes: Vec<String>,
}

impl Report {
    /// An empty report; `unknown` are the names in the inputs that are not known.
    pub fn new(preset: &str, unknown: &[String]) -> Self {
        Self {
            preset: preset.into(),
            lines: Vec::new(),
            unknown: unknown.iter().map(|n| ("inputs".into(), n.clone())).collect(),
            not_computed: Vec::new(),
            training: Vec::new(),
            notes: Vec::new(),
        }
    }

    /// Lines over their tolerance.
    pub fn failures(&self) -> impl Iterator<Item = &Line> {
        self.lines.iter().filter(|l| !l.ok())
    }

    /// Whether something was compared, all of it is within its tolerance and, unless allowed, no
    /// tensor is unknown.
    pub fn passed(&self, allow_unknown: bool) -> bool {
        let compared = self.lines.iter().any(|l| l.engine != "recipe");
        (compared || !self.training.is_empty())
            && self.failures().next().is_none()
            && (allow_unknown || self.unknown.is_empty())
    }

    /// The back ends, in order of appearance.
    pub fn engines(&self) -> Vec<&'static str> {
        let mut engines = Vec::new();
        for line in self.lines.iter().filter(|l| l.engine != "recipe") {
            if !engines.contains(&line.engine) {
                engines.push(line.engine);
            }
        }
        engines
    }

    /// A Markdown section: every tensor, its largest difference per back end over all cases.
    pub fn markdown(&self, title: &str) -> String {
        let engines = self.engines();
        let mut rows: Vec<&str> = Vec::new();
        for line in self.lines.iter().filter(|l| l.engine != "recipe") {
            if !rows.contains(&line.tensor.as_str()) {
                rows.push(&line.tensor);
            }
        }
        let mut text = format!("## {title}\n\n");
        for note in &self.notes {
            let _ = writeln!(text, "* {note}");
        }
        if !self.notes.is_empty() {
            text.push('\n');
        }
        let _ = writeln!(
            text,
            "| tensor | cases | largest value | tolerance | {} |",
            engines.join(" | ")
        );
        let _ = writeln!(text, "|---|---|---|---|{}", "---|".repeat(engines.len()));
        for tensor in rows {
            let all = || self.lines.iter().filter(|l| l.engine != "recipe" && l.tensor == tensor);
            let most = |part: fn(&Line) -> f32| all().map(part).fold(0.0, f32::max);
            let mut cases: Vec<&str> = all().map(|l| l.case.as_str()).collect();
            cases.sort_unstable();
            cases.dedup();
            let bound = all().map(|l| l.tolerance).fold(f32::INFINITY, f32::min);
            let peak = most(|l| l.peak);
            let _ = write!(text, "| `{tensor}` | {} | {peak:.3e} | {bound:.1e} |", cases.len());
            for engine in &engines {
                let own = || all().filter(|l| l.engine == *engine);
                let max = own().map(|l| l.difference).fold(0.0, f32::max);
                let cell = match (own().next(), own().all(Line::ok)) {
                    (None, _) => String::new(),
                    (Some(_), true) => format!("{max:.1e}"),
                    (Some(_), false) => format!("**{max:.1e}**"),
                };
                let _ = write!(text, " {cell} |");
            }
            text.push('\n');
        }
        text
    }
}

/// `document` with the section of this name replaced, or added at its end. Sections stand between
/// two comment lines.
pub fn with_section(document: &str, name: &str, section: &str) -> String {
    let (open, close) = (format!("<!-- golden {name} -->"), format!("<!-- end {name} -->"));
    let block = format!("{open}\n{}\n{close}", section.trim_end());
    match (document.find(&open), document.find(&close)) {
        (Some(start), Some(end)) if start < end => {
            format!("{}{block}{}", &document[..start], &document[end + close.len()..])
        }
        _ if document.trim().is_empty() => format!("# Parity\n\n{block}\n"),
        _ => format!("{}\n\n{block}\n", document.trim_end()),
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for note in &self.notes {
            writeln!(f, "{note}")?;
        }
        let width = |part: &dyn Fn(&Line) -> usize| self.lines.iter().map(part).max().unwrap_or(0);
        let (case, tensor) = (width(&|l| l.case.len()), width(&|l| l.tensor.len()));
        let engine = width(&|l| l.engine.len());
        for l in &self.lines {
            let verdict = if l.ok() { "ok" } else { "FAIL" };
            write!(
                f,
                "{:<case$}  {:<tensor$}  {:<engine$}  max abs diff {:9.3e}  of {:9.3e}  allowed \
                 {:7.1e}  {verdict}",
                l.case, l.tensor, l.engine, l.difference, l.peak, l.tolerance
            )?;
            match &l.detail {
                Some(detail) => writeln!(f, "  {detail}")?,
                None => writeln!(f, "  {:?}", l.shape)?,
            }
        }
        for (case, name) in &self.not_computed {
            writeln!(
                f,
                "{case}  {name}  not computed by the engines asked for; burn computes all"
            )?;
        }
        for (case, count) in &self.training {
            writeln!(
                f,
                "{case}  {count} tensors of a training step: not compared here, but by \
                 `cargo test -p tsda-trainer training_step`"
            )?;
        }
        for (case, name) in &self.unknown {
            writeln!(f, "{case}  {name}  UNKNOWN tensor")?;
        }
        writeln!(f)?;
        for name in self.engines() {
            let lines = || self.lines.iter().filter(|l| l.engine == name);
            // Of its own tolerance: differences of different figures do not compare.
            let worst = lines().max_by(|a, b| share(a).total_cmp(&share(b)));
            if let Some(w) = worst {
                writeln!(
                    f,
                    "{name:<engine$}  {:>4} figures, {} over tolerance; nearest to it {} ({:.3e} of \
                     {:.1e})",
                    lines().count(),
                    lines().filter(|l| !l.ok()).count(),
                    w.tensor,
                    w.difference,
                    w.tolerance
                )?;
            }
        }
        if !self.unknown.is_empty() {
            writeln!(f, "{} unknown tensors", self.unknown.len())?;
        }
        Ok(())
    }
}

fn share(line: &Line) -> f32 {
    if line.tolerance > 0.0 {
        line.difference / line.tolerance
    } else if line.difference > 0.0 {
        f32::INFINITY
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(tensor: &str, engine: &'static str, difference: f32) -> Line {
        Line {
            case: "case_a".into(),
            tensor: tensor.into(),
            engine,
            shape: vec![2],
            difference,
            peak: 1.0,
            tolerance: 2e-5,
            detail: None,
        }
    }

    #[test]
    fn a_report_passes_only_when_something_was_compared_and_nothing_is_off() {
        let mut report = Report::new("small", &[]);
        assert!(!report.passed(true), "nothing compared");
        report.lines.push(line("scores", "burn", 1e-6));
        assert!(report.passed(false));
        report.unknown.push(("case_a".into(), "strange".into()));
        assert!(!report.passed(false) && report.passed(true));
        report.lines.push(line("ltrb", "burn", f32::INFINITY));
        assert!(!report.passed(true));
        let text = report.to_string();
        assert!(text.contains("FAIL") && text.contains("strange  UNKNOWN"), "{text}");
    }

    #[test]
    fn sections_are_replaced_in_place() {
        let mut report = Report::new("small", &[]);
        report.lines.extend([line("scores", "burn", 1e-6), line("scores", "tract", 2e-6)]);
        let section = report.markdown("small");
        assert!(
            section.contains("| `scores` | 1 | 1.000e0 | 2.0e-5 | 1.0e-6 | 2.0e-6 |"),
            "{section}"
        );
        let one = with_section("", "small", "first");
        let two = with_section(&one, "tomp101", "second");
        let three = with_section(&two, "small", "third");
        assert!(three.contains("third") && three.contains("second") && !three.contains("first"));
        assert_eq!(with_section(&three, "small", "third"), three);
    }
}
