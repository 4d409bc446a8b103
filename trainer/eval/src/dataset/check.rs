//! Looking through a whole dataset without decoding it: counts, sizes, and what is broken.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use serde::Serialize;
use tsda_runtime::Modality;

use super::{DatasetError, Registration, Scan, Sequence, Severity, parallel, picture_size};

/// Pictures looked at in one go by a thread.
const CHUNK: usize = 256;
/// Most findings of one kind reported per sequence; the rest is counted.
const LISTED: usize = 5;

/// How many frames per sequence and sensor are decoded; of the others only headers are read.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Decode {
    /// Headers only.
    #[default]
    None,
    /// So many, spread evenly.
    Some(usize),
    /// All of them.
    All,
}

impl Decode {
    /// Is frame `i` of `n` one of them?
    fn takes(self, i: usize, n: usize) -> bool {
        match self {
            Self::None => false,
            Self::All => true,
            // Frame i is the first at or behind a multiple of n / k.
            Self::Some(k) => k >= n || (k > 0 && (i * k).div_ceil(n) * n / k == i),
        }
    }
}

/// How to look.
#[derive(Clone, Copy, Debug)]
pub struct CheckOptions {
    /// Frames to decode.
    pub decode: Decode,
    /// Files looked at at a time; 0 counts as 1.
    pub threads: usize,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self { decode: Decode::None, threads: parallel::threads() }
    }
}

/// Frames of one sensor, counted per target.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Annotated {
    /// Frames the annotation speaks of.
    pub annotated: usize,
    /// Of these, frames in which the target cannot be seen.
    pub absent: usize,
}

impl Annotated {
    fn add(&mut self, other: Self) {
        self.annotated += other.annotated;
        self.absent += other.absent;
    }
}

/// One picture size.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Resolution {
    /// `rgb` or `thermal`.
    pub modality: &'static str,
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Pictures of this size.
    pub pictures: usize,
}

/// What was found out about one sequence.
#[derive(Clone, Debug, Serialize)]
pub struct SequenceReport {
    /// Its id.
    pub id: String,
    /// Frames after cutting to the shorter sensor.
    pub frames: usize,
    /// Its sensors.
    pub modalities: Vec<&'static str>,
    /// Its targets.
    pub targets: usize,
    /// Annotated and absent frames by sensor.
    pub annotation: BTreeMap<&'static str, Annotated>,
    /// Its attributes.
    pub attributes: Vec<String>,
}

/// Something worth telling.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// How much it matters.
    pub severity: Severity,
    /// The sequence, where it is about one.
    pub sequence: Option<String>,
    /// What, with the file and, where there is one, the line.
    pub what: String,
}

/// The whole dataset.
#[derive(Clone, Debug, Serialize)]
pub struct CheckReport {
    /// The text it was opened by.
    pub dataset: String,
    /// Sequences that could be read.
    pub sequences: usize,
    /// Sequences and lists that could not.
    pub unreadable: usize,
    /// Frames; a frame of two sensors counts once.
    pub frames: usize,
    /// Targets.
    pub targets: usize,
    /// Sequences by their sensors (`rgb+thermal`, ..).
    pub modalities: BTreeMap<String, usize>,
    /// Annotated and absent frames by sensor, over all targets.
    pub annotation: BTreeMap<&'static str, Annotated>,
    /// Sequences in which the target is absent in some frame.
    pub with_absence: usize,
    /// Picture sizes.
    pub resolutions: Vec<Resolution>,
    /// Sequences by attribute.
    pub attributes: BTreeMap<String, usize>,
    /// Frames by attribute.
    pub frame_attributes: BTreeMap<String, usize>,
    /// Sequences by how their sensors relate (`aligned`, `affine`, `unknown`); pairs only.
    pub registration: BTreeMap<&'static str, usize>,
    /// Pictures whose header was read.
    pub headers: usize,
    /// Pictures decoded.
    pub decoded: usize,
    /// Every finding, broken things first.
    pub findings: Vec<Finding>,
    /// Every sequence.
    pub each: Vec<SequenceReport>,
}

impl CheckReport {
    /// Findings of things that are broken.
    pub fn broken(&self) -> impl Iterator<Item = &Finding> {
        self.findings.iter().filter(|f| f.severity == Severity::Broken)
    }

    /// Findings of things that were dealt with.
    pub fn quirks(&self) -> impl Iterator<Item = &Finding> {
        self.findings.iter().filter(|f| f.severity == Severity::Quirk)
    }

    /// Is nothing broken?
    pub fn is_sound(&self) -> bool {
        self.broken().next().is_none()
    }
}

/// Some pictures of one sensor of one sequence.
struct Part {
    sequence: usize,
    modality: Modality,
    from: usize,
    to: usize,
}

/// What was seen of a [`Part`].
#[derive(Default)]
struct Seen {
    sizes: BTreeMap<(usize, usize), usize>,
    headers: usize,
    decoded: usize,
    broken: Vec<DatasetError>,
}

/// Looks through `scan`. `progress` is told pictures done and in all, now and then, from any
/// thread. Depends on the files alone, not on the number of threads.
pub fn check(
    scan: &Scan,
    options: CheckOptions,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> CheckReport {
    let mut parts = Vec::new();
    for (i, s) in scan.sequences.iter().enumerate() {
        for &modality in s.modalities() {
            for from in (0..s.frames()).step_by(CHUNK) {
                let to = s.frames().min(from + CHUNK);
                parts.push(Part { sequence: i, modality, from, to });
            }
        }
    }
    let total: usize = parts.iter().map(|p| p.to - p.from).sum();
    let done = AtomicUsize::new(0);
    let keys: Vec<(usize, Modality)> = parts.iter().map(|p| (p.sequence, p.modality)).collect();
    let seen = parallel::map(parts, options.threads, |part| {
        let seen = look(scan.sequences[part.sequence].as_ref(), &part, options.decode);
        let n = part.to - part.from;
        progress(done.fetch_add(n, Ordering::Relaxed) + n, total);
        seen
    });
    // Sizes by sequence and sensor; parts of one come one after the other.
    let mut pictures: BTreeMap<(usize, Modality), Seen> = BTreeMap::new();
    for (key, part) in keys.into_iter().zip(seen) {
        let all = pictures.entry(key).or_default();
        for (size, n) in part.sizes {
            *all.sizes.entry(size).or_default() += n;
        }
        all.headers += part.headers;
        all.decoded += part.decoded;
        all.broken.extend(part.broken);
    }
    summarise(scan, &pictures)
}

fn look(sequence: &dyn Sequence, part: &Part, decode: Decode) -> Seen {
    let mut seen = Seen::default();
    for frame in part.from..part.to {
        let path = sequence.picture_path(frame, part.modality);
        let size = match &path {
            Some(path) => {
                seen.headers += 1;
                picture_size(path)
            }
            // Rendered frames: the first stands for all.
            None if frame == 0 => sequence.resolution(part.modality),
            None => continue,
        };
        match size {
            Ok(size) => *seen.sizes.entry(size).or_default() += 1,
            Err(e) => {
                seen.broken.push(e);
                continue;
            }
        }
        if decode.takes(frame, sequence.frames()) {
            seen.decoded += 1;
            if let Err(e) = sequence.picture(frame, part.modality) {
                seen.broken.push(e);
            }
        }
    }
    seen
}

fn summarise(scan: &Scan, pictures: &BTreeMap<(usize, Modality), Seen>) -> CheckReport {
    let mut report = CheckReport {
        dataset: scan.name.clone(),
        sequences: scan.sequences.len(),
        unreadable: scan.broken.len(),
        frames: 0,
        targets: 0,
        modalities: BTreeMap::new(),
        annotation: BTreeMap::new(),
        with_absence: 0,
        resolutions: Vec::new(),
        attributes: BTreeMap::new(),
        frame_attributes: BTreeMap::new(),
        registration: BTreeMap::new(),
        headers: 0,
        decoded: 0,
        findings: Vec::new(),
        each: Vec::new(),
    };
    for e in &scan.broken {
        let what = e.to_string();
        report.findings.push(Finding { severity: Severity::Broken, sequence: None, what });
    }
    let mut sizes: BTreeMap<(Modality, usize, usize), usize> = BTreeMap::new();
    for (i, sequence) in scan.sequences.iter().enumerate() {
        let own = one(sequence.as_ref(), &mut report);
        for &modality in sequence.modalities() {
            let Some(seen) = pictures.get(&(i, modality)) else { continue };
            for (&(width, height), n) in &seen.sizes {
                *sizes.entry((modality, width, height)).or_default() += n;
            }
            report.headers += seen.headers;
            report.decoded += seen.decoded;
            report.findings.extend(of_pictures(sequence.as_ref(), modality, seen));
        }
        report.each.push(own);
    }
    report.resolutions = sizes
        .into_iter()
        .map(|((modality, width, height), pictures)| Resolution {
            modality: modality.as_str(),
            width,
            height,
            pictures,
        })
        .collect();
    // Stable: within a severity, the order of the dataset.
    report.findings.sort_by_key(|f| std::cmp::Reverse(f.severity));
    report
}

/// Counts one sequence into the report.
fn one(sequence: &dyn Sequence, report: &mut CheckReport) -> SequenceReport {
    let frames = sequence.frames();
    let names: Vec<&'static str> = sequence.modalities().iter().map(|m| m.as_str()).collect();
    report.frames += frames;
    report.targets += sequence.targets();
    *report.modalities.entry(names.join("+")).or_default() += 1;
    if names.len() == 2 {
        let kind = match sequence.registration() {
            Registration::Aligned => "aligned",
            Registration::Affine(_) => "affine",
            Registration::Unknown => "unknown",
        };
        *report.registration.entry(kind).or_default() += 1;
    }
    let mut annotation = BTreeMap::new();
    for &modality in sequence.modalities() {
        let mut count = Annotated::default();
        for target in 0..sequence.targets() {
            for frame in 0..frames {
                count.annotated += usize::from(sequence.annotated(target, frame, modality));
                count.absent += usize::from(sequence.absent(target, frame, modality));
            }
        }
        annotation.insert(modality.as_str(), count);
        report.annotation.entry(modality.as_str()).or_default().add(count);
    }
    report.with_absence += usize::from(annotation.values().any(|a| a.absent > 0));
    for attribute in sequence.attributes() {
        *report.attributes.entry(attribute.clone()).or_default() += 1;
    }
    for frame in 0..frames {
        for attribute in sequence.frame_attributes(frame) {
            *report.frame_attributes.entry(attribute.to_owned()).or_default() += 1;
        }
    }
    for note in sequence.notes() {
        report.findings.push(Finding {
            severity: note.severity,
            sequence: Some(sequence.id().to_owned()),
            what: note.to_string(),
        });
    }
    SequenceReport {
        id: sequence.id().to_owned(),
        frames,
        modalities: names,
        targets: sequence.targets(),
        annotation,
        attributes: sequence.attributes().to_vec(),
    }
}

/// Findings about the pictures of one sensor, and about boxes that lie beside them.
fn of_pictures(sequence: &dyn Sequence, modality: Modality, seen: &Seen) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut tell = |severity, what| {
        findings.push(Finding { severity, sequence: Some(sequence.id().to_owned()), what });
    };
    for e in seen.broken.iter().take(LISTED) {
        tell(Severity::Broken, e.to_string());
    }
    if seen.broken.len() > LISTED {
        let more = seen.broken.len() - LISTED;
        tell(Severity::Broken, format!("{more} more broken {modality} pictures"));
    }
    if seen.sizes.len() > 1 {
        let list: Vec<String> =
            seen.sizes.iter().map(|((w, h), n)| format!("{n} of {w} x {h}")).collect();
        let what = format!("{modality} pictures of several sizes: {}", list.join(", "));
        tell(Severity::Broken, what);
    }
    // RGB warped onto the thermal frame is as large as that.
    if let Ok((width, height)) = sequence.resolution(modality) {
        let outside = |target: usize| {
            (0..sequence.frames())
                .filter_map(|f| sequence.truth(target, f, modality).map(|b| (f, b)))
                .filter(|(_, b)| !b.overlaps_image(width, height))
                .map(|(f, _)| f)
                .collect::<Vec<_>>()
        };
        for target in 0..sequence.targets() {
            let frames = outside(target);
            if let Some(first) = frames.first() {
                let n = frames.len();
                let what = format!(
                    "target {target}: {n} {modality} boxes wholly outside the {width} x {height} \
                     picture, the first in frame {first}"
                );
                tell(Severity::Quirk, what);
            }
        }
    }
    findings
}

#[cfg(test)]
#[path = "check_tests.rs"]
mod tests;
