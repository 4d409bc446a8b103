//! The part of the page that shows where a tracker fails.

use tsda_runtime::Modality;

use super::ProtocolExtras;
use super::failure::{DRAWN, LONG, LOST_IOU, Strip, StripPicture};
use super::html::{Html, at, base64};
use super::plot::{self, Timeline};
use super::sections::plural;
use crate::report_data::{ProtocolData, shown};

/// Dashes of the boxes in pictures; the truth is solid.
const BOX_DASHES: [&str; DRAWN] = ["6 3", "2 2", "8 2 2 2", "10 5"];

pub(super) fn failures(h: &mut Html, p: &ProtocolData, extra: &ProtocolExtras, strips: &[String]) {
    let Some(first) = p.trackers.first() else { return };
    h.element("h3", &[], &format!("Where {} fails", first.tracker));
    if extra.strips.is_empty() {
        let judged = first.sequences.values().any(|s| !s.iou.is_empty());
        let all_held =
            judged && first.sequences.values().all(|s| super::first_failure(&s.iou).is_none());
        let text = if all_held {
            "In no frame of any sequence does the IoU fall below 0.5."
        } else {
            "Pictures of failures need the dataset, which was not given."
        };
        h.element("p", &[("class", "soft")], text);
        return;
    }
    h.element(
        "p",
        &[("class", "soft")],
        &format!(
            "The sequences with the lowest mean IoU, at the first failure: {LONG} visible frames in a \
             row with an IoU below {LOST_IOU}, or else the longest run below 0.5. Frames count from \
             the one the target was marked in (a). Each sensor shows one part of its picture."
        ),
    );
    h.within("ul", &[("class", "legend row")], |h| {
        let entries = p
            .trackers
            .iter()
            .take(DRAWN)
            .enumerate()
            .map(|(k, t)| (format!("box on{k}"), BOX_DASHES[k], t.tracker.as_str()));
        for (class, dash, name) in
            [("box ontruth".to_owned(), "none", "truth")].into_iter().chain(entries)
        {
            h.within("li", &[], |h| {
                h.within(
                    "svg",
                    &[
                        ("class", "key"),
                        ("viewBox", "0 0 26 14"),
                        ("width", "26"),
                        ("height", "14"),
                        ("aria-hidden", "true"),
                    ],
                    |h| {
                        h.empty(
                            "rect",
                            &[
                                ("class", &class),
                                ("stroke-dasharray", dash),
                                ("x", "2"),
                                ("y", "2"),
                                ("width", "22"),
                                ("height", "10"),
                            ],
                        );
                    },
                );
                h.element("span", &[], name);
            });
        }
        for (class, name) in
            [("rgb", "RGB frames"), ("thermal", "thermal frames"), ("failed", "failure")]
        {
            h.within("li", &[], |h| {
                h.within(
                    "svg",
                    &[
                        ("class", "key"),
                        ("viewBox", "0 0 26 14"),
                        ("width", "26"),
                        ("height", "14"),
                        ("aria-hidden", "true"),
                    ],
                    |h| h.empty("rect", &[("class", class), ("width", "26"), ("height", "14")]),
                );
                h.element("span", &[], name);
            });
        }
    });
    for text in strips {
        h.markup(text);
    }
    if strips.len() < extra.strips.len() {
        let gone = extra.strips.len() - strips.len();
        let text = format!("{} left out to keep the page small.", plural(gone, "more strip"));
        h.element("p", &[("class", "soft")], &text);
    }
}

/// One failure, drawn.
pub(super) fn strip(p: &ProtocolData, strip: &Strip) -> String {
    let mut h = Html::default();
    let data = p.trackers.get(strip.tracker).and_then(|t| t.sequences.get(&strip.sequence));
    h.within("div", &[("class", "strip")], |h| {
        h.element("h4", &[], &strip.sequence);
        let failure = strip.failure;
        let kind = if failure.long { "lost" } else { "longest run below IoU 0.5" };
        let mean = data.map_or(String::new(), |d| {
            let s = &d.score.figures.scores;
            format!("mean IoU {}, SR@0.5 {}; ", shown(s.mean_iou), shown(s.sr50))
        });
        h.element(
            "p",
            &[("class", "soft")],
            &format!(
                "{mean}{kind} from frame {} to {} of {}.",
                failure.start,
                failure.end - 1,
                strip.iou.len()
            ),
        );
        if !strip.pictures.is_empty() {
            h.within("div", &[("class", "pictures")], |h| {
                for (k, picture) in strip.pictures.iter().enumerate() {
                    strip_picture(h, k, picture);
                }
            });
        }
        if let Some(note) = &strip.note {
            h.element("p", &[("class", "soft")], &format!("No pictures: {note}."));
        }
        let thermal: Vec<bool> = strip
            .modalities
            .iter()
            .take(strip.iou.len())
            .map(|m| *m == Modality::Thermal)
            .collect();
        let shown: Vec<usize> = strip.pictures.iter().map(|s| s.frame).collect();
        let title = format!("IoU over the frames of {}", strip.sequence);
        h.within("figure", &[], |h| {
            plot::timeline(
                h,
                &Timeline {
                    title: &title,
                    iou: &strip.iou,
                    thermal: &thermal,
                    failed: [failure.start, failure.end],
                    shown: &shown,
                },
            );
            h.element("figcaption", &[], "IoU by frame; letters mark the pictures above.");
        });
    });
    h.finish()
}

fn strip_picture(h: &mut Html, k: usize, picture: &StripPicture) {
    let letter = char::from(b'a' + (k % 26) as u8);
    let [x, y, w, hh] = picture.crop.map(at);
    let sensor = if picture.modality == Modality::Thermal { "thermal" } else { "RGB" };
    let iou = match (picture.iou, &picture.truth) {
        (Some(v), _) => format!("IoU {v:.2}"),
        (None, _) => "target absent".to_owned(),
    };
    let title = format!("Frame {}, {sensor}, {iou}", picture.frame);
    h.within("figure", &[], |h| {
        h.within(
            "svg",
            &[("viewBox", &format!("{x} {y} {w} {hh}")), ("role", "img"), ("aria-label", &title)],
            |h| {
                h.element("title", &[], &title);
                let uri = format!("data:image/jpeg;base64,{}", base64(&picture.jpeg));
                h.empty(
                    "image",
                    &[
                        ("href", &uri),
                        ("x", &x),
                        ("y", &y),
                        ("width", &w),
                        ("height", &hh),
                        ("preserveAspectRatio", "none"),
                    ],
                );
                let mut draw = |row: &crate::metrics::Row, class: &str, dash: &str| {
                    let [x, y, w, hh] = row.map(at);
                    for (class, dash) in [("halo", "none"), (class, dash)] {
                        h.empty(
                            "rect",
                            &[
                                ("class", class),
                                ("stroke-dasharray", dash),
                                ("x", &x),
                                ("y", &y),
                                ("width", &w),
                                ("height", &hh),
                            ],
                        );
                    }
                };
                if let Some(row) = &picture.truth {
                    draw(row, "box truth", "none");
                }
                for (tracker, row) in picture.predicted.iter().rev() {
                    let k = tracker % DRAWN;
                    draw(row, &format!("box p{k}"), BOX_DASHES[k]);
                }
            },
        );
        h.element(
            "figcaption",
            &[],
            &format!("{letter}: frame {}, {sensor}, {iou}", picture.frame),
        );
    });
}
