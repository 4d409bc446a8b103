//! The model card: what a bundle says about itself.

use tsda_runtime::bundle::Manifest;

use super::html::Html;

/// A model card, as data.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ModelCard {
    /// The model's name.
    pub name: String,
    /// Properties: what and value.
    pub rows: Vec<(String, String)>,
    /// Figures stored with the model.
    pub figures: Vec<(String, f32)>,
    /// Data sources, one per line.
    pub data: String,
    /// The card, Markdown.
    pub card: String,
}

impl ModelCard {
    /// The card of a bundle of `bytes` bytes.
    pub fn of(manifest: &Manifest<'_>, bytes: usize) -> Self {
        let s = &manifest.spec;
        let p = &manifest.provenance;
        let backbone = s.backbone.to_string();
        let t = manifest.trained_on;
        let sensors = [(t.rgb, "RGB"), (t.thermal, "thermal"), (t.cross_modal, "across both")];
        let sensors: Vec<&str> = sensors.iter().filter(|s| s.0).map(|s| s.1).collect();
        let rows = [
            ("Size", format!("{:.1} MB", bytes as f64 / 1e6)),
            ("Backbone", backbone),
            (
                "Input",
                format!("{0} x {0} pixels, {1} times the target's size", s.crop, s.search_factor),
            ),
            (
                "Transformer",
                format!(
                    "width {}, {} heads, {} + {} layers, {} templates",
                    s.width, s.heads, s.encoder_layers, s.decoder_layers, s.templates
                ),
            ),
            ("Trained on", sensors.join(", ")),
            (
                "Score calibration",
                manifest.calibration.map_or("none stored".into(), |c| {
                    format!("slope {}, bias {}", c.slope, c.bias)
                }),
            ),
            ("Trainer", p.trainer.to_owned()),
            ("Steps, seed", format!("{}, {}", p.steps, p.seed)),
            ("Weights CRC-32", format!("{:08x}", p.weights_crc)),
            ("Licence", manifest.licence.to_owned()),
        ];
        Self {
            name: manifest.name.to_owned(),
            rows: rows
                .into_iter()
                .filter(|(_, value)| !value.trim().is_empty())
                .map(|(what, value)| (what.to_owned(), value))
                .collect(),
            figures: manifest.figures.iter().map(|f| (f.name.to_owned(), f.value)).collect(),
            data: p.data.to_owned(),
            card: manifest.card.to_owned(),
        }
    }

    pub(super) fn write(&self, h: &mut Html) {
        h.within("div", &[("class", "model")], |h| {
            h.within("div", &[("class", "wide")], |h| {
                h.within("table", &[], |h| {
                    h.element("caption", &[], &format!("The bundle {}", self.name));
                    h.within("tbody", &[], |h| {
                        for (what, value) in &self.rows {
                            row(h, what, value, "l");
                        }
                    });
                });
            });
            if !self.figures.is_empty() {
                h.within("details", &[], |h| {
                    h.element("summary", &[], "Figures stored in the bundle");
                    h.within("table", &[], |h| {
                        h.within("tbody", &[], |h| {
                            for (name, value) in &self.figures {
                                row(h, name, &format!("{value:.4}"), "");
                            }
                        });
                    });
                });
            }
            if !self.data.trim().is_empty() {
                h.within("details", &[], |h| {
                    h.element("summary", &[], "Data sources and licences");
                    h.within("ul", &[], |h| {
                        for source in self.data.lines().filter(|l| !l.trim().is_empty()) {
                            h.element("li", &[], source.trim().trim_start_matches("- "));
                        }
                    });
                });
            }
            markdown(h, &self.card);
        });
    }
}

fn row(h: &mut Html, what: &str, value: &str, class: &str) {
    h.within("tr", &[], |h| {
        h.element("th", &[("scope", "row"), ("class", "l")], what);
        let wrap = if class == "l" { "white-space:normal" } else { "" };
        h.element("td", &[("class", class), ("style", wrap)], value);
    });
}

/// A block of Markdown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Block {
    Heading,
    Bullets,
    Table,
    Text,
}

fn kind(line: &str) -> Block {
    match line {
        l if l.starts_with('#') => Block::Heading,
        l if l.starts_with("- ") || l.starts_with("* ") => Block::Bullets,
        l if l.starts_with('|') => Block::Table,
        _ => Block::Text,
    }
}

/// The Markdown that model cards use: headings, bullets, pipe tables, paragraphs, code and bold.
/// Links stay text: the page loads and points at nothing outside.
fn markdown(h: &mut Html, text: &str) {
    let lines: Vec<&str> = text.lines().collect();
    let mut i = 0;
    while i < lines.len() {
        let line = lines[i].trim();
        if line.is_empty() {
            i += 1;
            continue;
        }
        let block = kind(line);
        let mut end = i + 1;
        if block != Block::Heading {
            while end < lines.len() && !lines[end].trim().is_empty() {
                let next = kind(lines[end].trim());
                // A bullet goes on in the lines below it.
                if next != block && !(block == Block::Bullets && next == Block::Text) {
                    break;
                }
                end += 1;
            }
        }
        let body = &lines[i..end];
        match block {
            Block::Heading => {
                let level = line.chars().take_while(|c| *c == '#').count();
                let tag = if level <= 2 { "h3" } else { "h4" };
                h.within(tag, &[], |h| inline(h, line.trim_start_matches('#').trim()));
            }
            Block::Bullets => bullets(h, body),
            Block::Table => table(h, body),
            Block::Text => {
                h.within("p", &[], |h| inline(h, &joined(body)));
            }
        }
        i = end;
    }
}

fn joined(lines: &[&str]) -> String {
    lines.iter().map(|l| l.trim()).collect::<Vec<_>>().join(" ")
}

fn bullets(h: &mut Html, lines: &[&str]) {
    let mut items: Vec<String> = Vec::new();
    for line in lines.iter().map(|l| l.trim()) {
        match (line.strip_prefix("- ").or(line.strip_prefix("* ")), items.last_mut()) {
            (None, Some(item)) => {
                item.push(' ');
                item.push_str(line);
            }
            (text, _) => items.push(text.unwrap_or(line).to_owned()),
        }
    }
    h.within("ul", &[], |h| {
        for item in &items {
            h.within("li", &[], |h| inline(h, item));
        }
    });
}

fn table(h: &mut Html, lines: &[&str]) {
    let cells = |line: &str| -> Vec<String> {
        line.trim().trim_matches('|').split('|').map(|c| c.trim().to_owned()).collect()
    };
    let rule = |line: &str| line.chars().all(|c| "|-: ".contains(c));
    let align: Vec<bool> = lines
        .get(1)
        .filter(|l| rule(l))
        .map(|l| cells(l).iter().map(|c| c.ends_with(':')).collect())
        .unwrap_or_default();
    let class = |column: usize| if align.get(column).copied().unwrap_or(false) { "" } else { "l" };
    let row = |h: &mut Html, line: &str, head: bool| {
        h.within("tr", &[], |h| {
            for (k, cell) in cells(line).iter().enumerate() {
                let scope: &[(&str, &str)] = if head {
                    &[("scope", "col"), ("class", class(k))]
                } else {
                    &[("class", class(k))]
                };
                h.within(if head { "th" } else { "td" }, scope, |h| inline(h, cell));
            }
        });
    };
    h.within("div", &[("class", "wide")], |h| {
        h.within("table", &[], |h| {
            if let Some(first) = lines.first() {
                h.within("thead", &[], |h| row(h, first, true));
            }
            h.within("tbody", &[], |h| {
                for line in lines.iter().skip(1).filter(|l| !rule(l)) {
                    row(h, line, false);
                }
            });
        });
    });
}

/// `` `code` `` and `**bold**`; what is not closed stays as it is.
fn inline(h: &mut Html, mut text: &str) {
    while let Some(at) = text.find(['`', '*']) {
        let (mark, tag) =
            if text[at..].starts_with('`') { ("`", "code") } else { ("**", "strong") };
        let inside = text[at..].strip_prefix(mark).and_then(|rest| rest.split_once(mark));
        match inside {
            Some((inside, rest)) if !inside.is_empty() => {
                h.text(&text[..at]);
                h.element(tag, &[], inside);
                text = rest;
            }
            _ => {
                h.text(&text[..=at]);
                text = &text[at + 1..];
            }
        }
    }
    h.text(text);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn html(text: &str) -> String {
        let mut h = Html::default();
        markdown(&mut h, text);
        h.finish()
    }

    #[test]
    fn the_markdown_of_cards() {
        for (text, want) in [
            ("# A\n\ntwo\nlines\n", "<h3>A</h3><p>two lines</p>"),
            ("### B", "<h4>B</h4>"),
            ("- a\n  more\n- **b**\n", "<ul><li>a more</li><li><strong>b</strong></li></ul>"),
            ("`x<y` and ** or ` alone", "<p><code>x&lt;y</code> and ** or ` alone</p>"),
            ("[l](javascript:x) <img>", "<p>[l](javascript:x) &lt;img&gt;</p>"),
            (
                "| a | b |\n|---|---:|\n| 1 | 2 |",
                "<div class=\"wide\"><table><thead><tr><th scope=\"col\" class=\"l\">a</th>\
                 <th scope=\"col\" class=\"\">b</th></tr></thead><tbody><tr><td class=\"l\">1</td>\
                 <td class=\"\">2</td></tr></tbody></table></div>",
            ),
            ("", ""),
        ] {
            assert_eq!(html(text), want, "{text:?}");
        }
    }
}
