use std::path::Path;

use super::*;
use crate::attributes::Attributes;
use crate::compare::{CompareOptions, compare};
use crate::dataset::{Dataset, DatasetError, Picture, Sequence};
use crate::metrics::Figures;
use crate::protocol::Protocol;
use crate::report_data::{DataOptions, shown};
use crate::results::{ResultFolder, write_otb};
use crate::truth::TruthSet;
use tsda_runtime::{BBox, Modality};

const HOSTILE: &str = "a<script>alert(1)</script>&\"'\u{202e}";
const FRAMES: usize = 60;

/// A target that moves to the right over a gradient; both sensors.
struct Clip(String);

impl Sequence for Clip {
    fn id(&self) -> &str {
        &self.0
    }
    fn frames(&self) -> usize {
        FRAMES
    }
    fn modalities(&self) -> &[Modality] {
        &[Modality::Rgb, Modality::Thermal]
    }
    fn targets(&self) -> usize {
        1
    }
    fn truth(&self, _: usize, frame: usize, _: Modality) -> Option<BBox> {
        (frame != 50).then(|| truth(frame))
    }
    fn picture(&self, frame: usize, modality: Modality) -> Result<Picture, DatasetError> {
        let channels = if modality == Modality::Rgb { 3 } else { 1 };
        let data = (0..160 * 120 * channels).map(|i| (i / 7 + frame) as u8).collect();
        Ok(Picture { width: 160, height: 120, channels, data })
    }
}

fn truth(frame: usize) -> BBox {
    BBox::new(10.0 + frame as f32, 30.0, 24.0, 18.0)
}

/// A dataset of `names`; tracker `good` holds everything, the hostile one stays put from frame 20
/// on. Scores and times lie beside the results of the latter.
struct Workplace {
    dir: tempfile::TempDir,
    dataset: Dataset,
}

impl Workplace {
    fn new(names: &[&str]) -> Self {
        let dir = tempfile::tempdir().unwrap();
        for folder in ["bad", "good"] {
            std::fs::create_dir(dir.path().join(folder)).unwrap();
        }
        for (i, name) in names.iter().enumerate() {
            let stay = |f: usize| truth(f.min(20 + i));
            let file = name.replace(|c: char| !c.is_ascii_alphanumeric(), "_");
            let all = |of: &dyn Fn(usize) -> BBox| (0..FRAMES).map(of).collect::<Vec<_>>();
            write_otb(&dir.path().join("bad"), &file, &all(&stay), None).unwrap();
            write_otb(&dir.path().join("good"), &file, &all(&truth), None).unwrap();
            let scores: String =
                (0..FRAMES).map(|f| format!("{}\n", if f < 30 { 0.9 } else { 0.2 })).collect();
            let times: String =
                (0..FRAMES).map(|f| format!("{}\n", 0.01 + f as f64 / 1e4)).collect();
            write(dir.path(), &format!("bad/{file}_score.txt"), &scores);
            write(dir.path(), &format!("bad/{file}_time.txt"), &times);
        }
        let sequences =
            names.iter().map(|n| Box::new(Clip((*n).to_owned())) as Box<dyn Sequence>).collect();
        Self { dir, dataset: Dataset { name: format!("set {HOSTILE}"), sequences } }
    }

    fn report(&self) -> (ReportData, Vec<ProtocolExtras>) {
        let protocol = Protocol::Switch { every: 20 };
        let options = CompareOptions {
            data: DataOptions { frames: true, ..DataOptions::default() },
            ..CompareOptions::default()
        };
        let truth = TruthSet::of_dataset(&self.dataset, options.data.convention, Some(protocol));
        let folders = [("bad", HOSTILE), ("good", "good")]
            .map(|(f, name)| ResultFolder::open(&self.dir.path().join(f), Some(name)).unwrap());
        let mut attributes = Attributes::default();
        for sequence in &truth.sequences {
            for attribute in ["OCC", "<LI>", "TC"] {
                attributes.insert(&sequence.name, attribute);
            }
        }
        let data = compare(&truth, &folders, &attributes, Some(protocol), options).unwrap();
        let trackers = &data.protocols[0].trackers;
        let samples =
            folders.iter().zip(trackers).map(|(f, t)| Samples::read(f, t).unwrap()).collect();
        let source = StripSource {
            dataset: &self.dataset,
            truth: &truth,
            protocol: Some(protocol),
            folders: &folders,
            layout: options.layout,
        };
        let strips = strips(source, &data.protocols[0], StripOptions::default()).unwrap();
        (data, vec![ProtocolExtras { samples, strips }])
    }
}

fn write(dir: &Path, name: &str, text: &str) {
    std::fs::write(dir.join(name), text).unwrap();
}

fn card() -> ModelCard {
    ModelCard {
        name: HOSTILE.into(),
        rows: vec![("Licence".into(), HOSTILE.into())],
        figures: vec![(HOSTILE.into(), 0.5)],
        data: format!("- {HOSTILE}\n"),
        card: format!("# {HOSTILE}\n\n- {HOSTILE}\n\n| a | b |\n|---|---:|\n| {HOSTILE} | 1 |\n"),
    }
}

/// One element of a page: name, attributes, its text without markup.
#[derive(Debug)]
struct Element {
    name: String,
    attrs: Vec<(String, String)>,
    text: String,
}

impl Element {
    fn attr(&self, name: &str) -> Option<&str> {
        self.attrs.iter().find(|a| a.0 == name).map(|a| a.1.as_str())
    }
}

fn unescape(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = rest.find('&') {
        out.push_str(&rest[..at]);
        let (entity, after) = rest[at + 1..].split_once(';').expect("a closed entity");
        out.push(match entity {
            "amp" => '&',
            "lt" => '<',
            "gt" => '>',
            "quot" => '"',
            "#39" => '\'',
            other => panic!("entity {other}"),
        });
        rest = after;
    }
    out + rest
}

/// Reads a page as XML; panics where it is not well-formed.
fn parse(page: &str) -> Vec<Element> {
    let mut rest = page.strip_prefix("<!DOCTYPE html>\n").expect("a doctype");
    let mut open: Vec<Element> = Vec::new();
    let mut done = Vec::new();
    while let Some(at) = rest.find('<') {
        let text = unescape(&rest[..at]);
        assert!(!text.contains('\u{0}'));
        for element in &mut open {
            element.text.push_str(&text);
        }
        let end = at + rest[at..].find('>').expect("a closed tag");
        let tag = &rest[at + 1..end];
        rest = &rest[end + 1..];
        if let Some(name) = tag.strip_prefix('/') {
            let element = open.pop().expect("something open");
            assert_eq!(element.name, name);
            done.push(element);
            continue;
        }
        let body = tag.strip_suffix('/').unwrap_or(tag);
        let (name, mut attrs) = body.split_once(' ').unwrap_or((body, ""));
        assert!(name.bytes().all(|b| b.is_ascii_alphanumeric()), "<{tag}>");
        let mut element = Element { name: name.to_owned(), attrs: Vec::new(), text: String::new() };
        while !attrs.trim().is_empty() {
            let (key, after) = attrs.trim_start().split_once("=\"").expect("a quoted value");
            let (value, after) = after.split_once('"').expect("a closed value");
            assert!(element.attr(key).is_none(), "{key} twice in <{tag}>");
            element.attrs.push((key.to_owned(), unescape(value)));
            attrs = after;
        }
        if tag.ends_with('/') { done.push(element) } else { open.push(element) }
    }
    assert!(open.is_empty() && rest.trim().is_empty(), "{open:?}");
    done
}

/// Cells of the rows of the table with this start of a caption.
fn rows(page: &str, caption: &str) -> Vec<Vec<String>> {
    let at = page.find(&format!("<caption>{caption}")).expect("the table");
    let table = &page[at..at + page[at..].find("</table>").unwrap()];
    let body = &table[table.find("<tbody>").unwrap() + 7..table.find("</tbody>").unwrap()];
    body.split("</tr>")
        .filter(|r| !r.is_empty())
        .map(|row| {
            let row = format!("<!DOCTYPE html>\n{row}</tr>");
            let cells = parse(&row);
            cells.into_iter().filter(|e| e.name == "td" || e.name == "th").map(|e| e.text).collect()
        })
        .collect()
}

#[test]
fn a_page_is_well_formed_and_holds_nothing_foreign() {
    let place = Workplace::new(&["one", HOSTILE]);
    let (data, extras) = place.report();
    let card = card();
    let page = render(&data, &extras, Some(&card), &ReportOptions::default()).unwrap();
    let elements = parse(&page);
    // No scripts, no event handlers, no addresses but this page's own.
    let forbidden = ["script", "link", "iframe", "object", "embed", "base", "form", "use"];
    for e in &elements {
        assert!(!forbidden.contains(&e.name.as_str()), "{e:?}");
        for (key, value) in &e.attrs {
            assert!(!key.starts_with("on"), "{key}");
            if ["href", "src", "xlink:href", "srcset", "action"].contains(&key.as_str()) {
                let own = value.starts_with('#') || value.starts_with("data:image/jpeg;base64,");
                assert!(own, "{key} {value}");
            }
        }
    }
    for words in ["http://", "https://", "url(", "@import", "\u{202e}"] {
        assert!(!page.contains(words), "{words}");
    }
    let policy = elements.iter().find(|e| e.attr("http-equiv").is_some()).unwrap();
    assert!(policy.attr("content").unwrap().contains("default-src 'none'"));
    // Hostile names come out as text.
    let clean = HOSTILE.replace('\u{202e}', "\u{fffd}");
    let title = elements.iter().find(|e| e.name == "h1").unwrap();
    assert_eq!(title.text, format!("Tracking report: set {clean}"));
    assert!(elements.iter().any(|e| e.name == "h4" && e.text == clean), "name of a sequence");
    // Links lead somewhere, identifiers are unique, pictures and tables have names.
    let ids: Vec<&str> = elements.iter().filter_map(|e| e.attr("id")).collect();
    for e in elements.iter().filter(|e| e.name == "a") {
        assert!(ids.contains(&&e.attr("href").unwrap()[1..]), "{e:?}");
    }
    assert_eq!(ids.len(), ids.iter().collect::<std::collections::BTreeSet<_>>().len());
    for e in elements.iter().filter(|e| e.name == "svg") {
        let named = e.attr("role") == Some("img") && e.attr("aria-label").is_some();
        assert!(named || e.attr("aria-hidden") == Some("true"), "{e:?}");
    }
    assert!(elements.iter().filter(|e| e.name == "th").all(|e| e.attr("scope").is_some()));
    for heading in [
        "Overview",
        "Attributes",
        "Model card",
        "Recovery after a sensor switch",
        "Protocol switch:20",
    ] {
        let found = elements.iter().any(|e| e.name.starts_with('h') && e.text == heading);
        assert!(found, "{heading}");
    }
}

#[test]
fn the_values_are_those_of_the_data() {
    let place = Workplace::new(&["one", "two"]);
    let (data, extras) = place.report();
    let page = render(&data, &extras, None, &ReportOptions::default()).unwrap();
    let protocol = &data.protocols[0];
    let table = rows(&page, "Averages over all sequences");
    assert_eq!(table.len(), 2);
    for (k, (row, tracker)) in table.iter().zip(&protocol.trackers).enumerate() {
        // The first row of a group starts with the group.
        let cells = &row[usize::from(k == 0)..];
        let figures = Figures::columns(data.convention)
            .iter()
            .map(|(_, _, get)| shown(get(&tracker.overall.figures)))
            .collect::<Vec<_>>();
        assert_eq!(cells[1..=figures.len()], figures);
        assert_eq!(cells[figures.len() + 1], tracker.sequences.len().to_string());
    }
    // The good tracker is the best in everything, the other nowhere.
    let best = parse(&page).iter().filter(|e| e.attr("class") == Some("best")).count();
    let columns = Figures::columns(data.convention).len();
    let groups = 1 + protocol.trackers[0].attributes.len() + protocol.trackers[0].switches.len();
    assert_eq!(best, columns * (groups + protocol.sequences.len()));
    let recovery = rows(&page, "Per tracker; shares in per cent");
    let r = protocol.trackers[1].recovery.unwrap();
    assert_eq!(recovery[1][1..4], [r.switches.to_string(), shown(r.rate), shown(r.undisturbed)]);
    assert_eq!(rows(&page, "Figures of single sequences").len(), 4);
    // Curves: as many points as thresholds, ends at the right heights.
    let paths: Vec<String> = parse(&page)
        .iter()
        .filter(|e| e.name == "path" && e.attr("class") == Some("c s0"))
        .filter_map(|e| e.attr("d").map(str::to_owned))
        .collect();
    let points = paths[0].split(['M', 'L']).filter(|p| !p.is_empty()).count();
    assert_eq!(points, data.thresholds.success.len());
    // Samples: right boxes up to where it stays, wrong beyond, one frame absent.
    let s = &extras[0].samples[0];
    assert_eq!(s.right.len() + s.wrong.len() + s.absent.len(), 2 * (FRAMES - 1));
    assert_eq!((s.absent.len(), s.milliseconds.len()), (2, 2 * (FRAMES - 1)));
    assert!(page.contains(&shown(s.auroc().unwrap())) && page.contains("Median"));
    assert_eq!(extras[0].samples[1], Samples::default());
}

#[test]
fn strips_show_the_failure_and_its_boxes() {
    let place = Workplace::new(&["one", "two"]);
    let (data, extras) = place.report();
    let strips = &extras[0].strips;
    // The one that stays put earlier is worse.
    assert_eq!(strips.iter().map(|s| s.sequence.as_str()).collect::<Vec<_>>(), ["one", "two"]);
    let strip = &strips[0];
    assert!(strip.failure.long && strip.note.is_none());
    let start = strip.failure.start;
    assert!(strip.iou[start].unwrap() < LOST_IOU && strip.iou[start - 1].unwrap() >= LOST_IOU);
    assert_eq!(strip.pictures.len(), PICTURES);
    for p in &strip.pictures {
        let back = image::load_from_memory(&p.jpeg).unwrap();
        assert_eq!(back.width(), StripOptions::default().width);
        assert_eq!(p.modality, Protocol::Switch { every: 20 }.modality(p.frame));
        let t = truth(p.frame);
        let shown = p.truth.map(|r| r.map(|v| v as f32));
        assert_eq!(shown, (p.frame != 50).then_some([t.x, t.y, t.w, t.h]));
        assert_eq!(p.predicted.iter().map(|b| b.0).collect::<Vec<_>>(), [0, 1]);
    }
    let page = render(&data, &extras, None, &ReportOptions::default()).unwrap();
    let pictures = parse(&page).iter().filter(|e| e.name == "image").count();
    assert_eq!(pictures, 2 * PICTURES);
}

#[test]
fn the_page_stays_below_its_limit() {
    let place = Workplace::new(&["one", "two", "three"]);
    let (data, extras) = place.report();
    let whole = render(&data, &extras, None, &ReportOptions::default()).unwrap();
    let pictures = |page: &str| page.matches("<image ").count();
    assert_eq!(pictures(&whole), 3 * PICTURES);
    let at = |max_bytes| {
        render(&data, &extras, None, &ReportOptions { max_bytes, ..ReportOptions::default() })
    };
    let strip = failure_view::strip(&data.protocols[0], &extras[0].strips[0]).len();
    let tight = at(whole.len() - strip).unwrap();
    assert!(tight.len() <= whole.len() - strip);
    assert!((1..3 * PICTURES).contains(&pictures(&tight)));
    assert!(tight.contains("left out to keep the page small"));
    parse(&tight);
    let e = at(1_000).unwrap_err().to_string();
    assert!(e.contains("1000 are allowed"), "{e}");
}

#[test]
fn what_is_missing_is_said() {
    let place = Workplace::new(&["one"]);
    let (mut data, _) = place.report();
    let page = render(&data, &[], None, &ReportOptions::default()).unwrap();
    parse(&page);
    assert!(page.contains("No scores and times are recorded beside these results"));
    assert!(page.contains("Pictures of failures need the dataset"));
    assert!(!page.contains("Model card"));
    // Nothing at all is still a page.
    data.protocols.clear();
    parse(&render(&data, &[], None, &ReportOptions::default()).unwrap());
}
