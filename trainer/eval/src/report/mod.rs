//! [`ReportData`] as one self-contained page: no script, nothing loaded from anywhere, charts as
//! inline SVG, pictures as data URIs, light and dark by the reader's preference, fit for print.
//!
//! 1. Score results ([`crate::compare`]) with the overlap of every frame kept.
//! 2. Add what figures do not hold, each part optional: [`Samples`] (scores and times beside the
//!    results), [`strips`] (pictures of failures, needs the dataset), [`ModelCard`].
//! 3. [`render`] the page. It stays below [`ReportOptions::max_bytes`]: pictures are added, worst
//!    sequences of every protocol first, until the room is used, and the page says what is missing.
//!
//! Every text is escaped, and the page's own content security policy forbids loading anything.

mod card;
mod failure;
mod failure_view;
mod html;
mod plot;
mod runs;
mod samples;
mod sections;

pub use card::ModelCard;
pub use failure::{
    Failure, LONG, LOST_IOU, PICTURES, Strip, StripOptions, StripPicture, StripSource,
    first_failure, strips,
};
pub use runs::{Run, find_runs};
pub use samples::Samples;

use crate::report_data::ReportData;
use html::Html;

const STYLE: &str = include_str!("style.css");

/// Nothing is loaded, no script runs.
const POLICY: &str = "default-src 'none'; img-src data:; style-src 'unsafe-inline'";

/// What belongs to one protocol beside its figures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ProtocolExtras {
    /// Frames of each tracker, in the order of the trackers; may be empty.
    pub samples: Vec<Samples>,
    /// Failures, worst first.
    pub strips: Vec<Strip>,
}

/// How the page is made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReportOptions {
    /// Title; empty for one after the dataset.
    pub title: String,
    /// Most bytes of the page.
    pub max_bytes: usize,
}

impl Default for ReportOptions {
    fn default() -> Self {
        Self { title: String::new(), max_bytes: 5_000_000 }
    }
}

/// A page that cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// Even without pictures and tables of sequences the page is too large.
    #[error(
        "the report needs {needed} bytes without any picture, {limit} are allowed: raise the limit or compare fewer trackers"
    )]
    TooLarge {
        /// Bytes of the page without pictures and tables of sequences.
        needed: usize,
        /// Bytes allowed.
        limit: usize,
    },
}

/// The page. `extras` has an entry per protocol of `data`, or fewer.
///
/// # Errors
/// When the page does not fit [`ReportOptions::max_bytes`] even without pictures and tables of
/// sequences.
pub fn render(
    data: &ReportData,
    extras: &[ProtocolExtras],
    card: Option<&ModelCard>,
    options: &ReportOptions,
) -> Result<String, ReportError> {
    // Room for the sentences about what was left out.
    const RESERVE: usize = 2_000;
    let limit = options.max_bytes;
    let bare = page(data, extras, card, options, &Kept::default());
    if bare.len() + RESERVE > limit {
        return Err(ReportError::TooLarge { needed: bare.len() + RESERVE, limit });
    }
    let mut room = limit - bare.len() - RESERVE;
    let mut kept = Kept { sequences: false, strips: vec![Vec::new(); data.protocols.len()] };
    let tables: usize = data.protocols.iter().map(|p| sections::sequences(data, p).len()).sum();
    // Pictures matter more than long tables: these get what is left, but at most a fifth is theirs
    // to lose.
    if tables <= room / 5 {
        kept.sequences = true;
        room -= tables;
    }
    let most = extras.iter().map(|e| e.strips.len()).max().unwrap_or(0);
    for rank in 0..most {
        for (protocol, extra) in extras.iter().enumerate().take(data.protocols.len()) {
            let Some(strip) = extra.strips.get(rank) else { continue };
            let text = failure_view::strip(&data.protocols[protocol], strip);
            if text.len() <= room {
                room -= text.len();
                kept.strips[protocol].push(text);
            }
        }
    }
    if !kept.sequences && tables <= room {
        kept.sequences = true;
    }
    Ok(page(data, extras, card, options, &kept))
}

/// What the size limit lets through.
#[derive(Debug, Default)]
struct Kept {
    /// Tables of sequences.
    sequences: bool,
    /// Strips of each protocol, drawn.
    strips: Vec<Vec<String>>,
}

fn page(
    data: &ReportData,
    extras: &[ProtocolExtras],
    card: Option<&ModelCard>,
    options: &ReportOptions,
    kept: &Kept,
) -> String {
    let title = if options.title.is_empty() {
        format!("Tracking report: {}", data.dataset)
    } else {
        options.title.clone()
    };
    let mut h = Html::default();
    h.markup("<!DOCTYPE html>\n");
    h.within("html", &[("lang", "en")], |h| {
        h.within("head", &[], |h| {
            h.empty("meta", &[("charset", "utf-8")]);
            h.empty("meta", &[("http-equiv", "Content-Security-Policy"), ("content", POLICY)]);
            h.empty(
                "meta",
                &[("name", "viewport"), ("content", "width=device-width, initial-scale=1")],
            );
            h.empty("meta", &[("name", "referrer"), ("content", "no-referrer")]);
            h.element("title", &[], &title);
            h.within("style", &[], |h| h.markup(STYLE));
        });
        h.within("body", &[], |h| {
            h.within("header", &[], |h| sections::header(h, data, &title, card.is_some()));
            h.within("main", &[], |h| {
                sections::overview(h, data);
                let none = ProtocolExtras::default();
                for i in 0..data.protocols.len() {
                    let extra = extras.get(i).unwrap_or(&none);
                    let strips = kept.strips.get(i).map_or(&[][..], Vec::as_slice);
                    sections::protocol(h, data, i, extra, strips, kept.sequences);
                    h.markup("\n");
                }
                if let Some(card) = card {
                    h.within("section", &[("id", "model")], |h| {
                        h.element("h2", &[], "Model card");
                        card.write(h);
                    });
                }
            });
            let size = h.len();
            h.within("footer", &[], |h| sections::footer(h, data, size, options.max_bytes));
        });
    });
    h.markup("\n");
    h.finish()
}

#[cfg(test)]
mod tests;
