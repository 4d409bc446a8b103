//! Where trackers fail: the first long failure of the worst sequences, with pictures around it.

use std::collections::BTreeMap;

use image::codecs::jpeg::JpegEncoder;
use image::imageops::{self, FilterType};
use image::{ExtendedColorType, ImageEncoder as _, RgbImage};
use tsda_runtime::Modality;

use crate::boxes::{self, Layout};
use crate::dataset::{Dataset, DatasetError, Picture, Sequence};
use crate::metrics::Row;
use crate::metrics::score::bbox;
use crate::protocol::{Protocol, start_frame};
use crate::report_data::ProtocolData;
use crate::results::ResultFolder;
use crate::truth::{SequenceTruth, TruthSet};

/// Overlap below which the target counts as lost.
pub const LOST_IOU: f64 = 0.2;
/// Visible frames in a row below [`LOST_IOU`] that make a long failure.
pub const LONG: usize = 10;
/// Pictures of a strip.
pub const PICTURES: usize = 6;
/// Trackers whose boxes are drawn.
pub(super) const DRAWN: usize = 4;

/// How strips are made.
#[derive(Clone, Copy, Debug)]
pub struct StripOptions {
    /// Worst sequences per protocol that get a strip; 0 for none.
    pub worst: usize,
    /// Width of a picture in pixels.
    pub width: u32,
    /// JPEG quality, 1 to 100.
    pub quality: u8,
}

impl Default for StripOptions {
    fn default() -> Self {
        Self { worst: 4, width: 240, quality: 72 }
    }
}

/// A run of frames in which the target is lost. Frames count from the initial one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Failure {
    /// First frame.
    pub start: usize,
    /// One past the last frame.
    pub end: usize,
    /// At least [`LONG`] visible frames below [`LOST_IOU`].
    pub long: bool,
}

/// The first long failure, or else the longest run of visible frames with an IoU below 0.5; `None`
/// when there is no such frame. Absent frames neither count nor end a run.
pub fn first_failure(iou: &[Option<f64>]) -> Option<Failure> {
    let runs = |below: f64| {
        // Start, end and visible frames of each run.
        let mut runs: Vec<(usize, usize, usize)> = Vec::new();
        let mut open = false;
        for (i, v) in iou.iter().enumerate().skip(1) {
            match (v, runs.last_mut()) {
                (Some(v), Some(run)) if *v < below && open => *run = (run.0, i + 1, run.2 + 1),
                (Some(v), _) if *v < below => {
                    runs.push((i, i + 1, 1));
                    open = true;
                }
                (Some(_), _) => open = false,
                (None, _) => {}
            }
        }
        runs
    };
    let long = runs(LOST_IOU).into_iter().find(|r| r.2 >= LONG);
    let longest = || {
        // The first of equal ones.
        runs(0.5).into_iter().rev().max_by_key(|r| r.2)
    };
    long.map(|(start, end, _)| Failure { start, end, long: true })
        .or_else(|| longest().map(|(start, end, _)| Failure { start, end, long: false }))
}

/// Frames to show: the initial one, two before the failure, its first and two later ones.
fn frames_around(failure: Failure, frames: usize) -> Vec<usize> {
    let Failure { start, end, .. } = failure;
    let length = end - start;
    let mut shown = vec![
        0,
        start.saturating_sub(10),
        start.saturating_sub(1),
        start,
        start + (length / 4).clamp(1, 10),
        start + (length - 1).clamp(2, 25),
    ];
    shown.retain(|f| *f < frames);
    shown.sort_unstable();
    shown.dedup();
    shown
}

/// One picture of a strip.
#[derive(Clone, Debug, PartialEq)]
pub struct StripPicture {
    /// Frame, counted from the initial one.
    pub frame: usize,
    /// Its sensor.
    pub modality: Modality,
    /// JPEG file.
    pub jpeg: Vec<u8>,
    /// Part of the frame that is shown: `x, y, w, h` in its pixels.
    pub crop: Row,
    /// Truth, in pixels of the frame.
    pub truth: Option<Row>,
    /// Number of the tracker and its box, in pixels of the frame.
    pub predicted: Vec<(usize, Row)>,
    /// Overlap of the tracker the strip is about.
    pub iou: Option<f64>,
}

/// A failure with its pictures.
#[derive(Clone, Debug, PartialEq)]
pub struct Strip {
    /// Sequence.
    pub sequence: String,
    /// Number of the tracker in [`ProtocolData::trackers`].
    pub tracker: usize,
    /// Where it fails.
    pub failure: Failure,
    /// Overlap per frame.
    pub iou: Vec<Option<f64>>,
    /// Sensor per frame, where known.
    pub modalities: Vec<Modality>,
    /// The pictures, by frame.
    pub pictures: Vec<StripPicture>,
    /// Why pictures are missing.
    pub note: Option<String>,
}

/// What strips are made from.
#[derive(Clone, Copy, Debug)]
pub struct StripSource<'a> {
    /// Pictures.
    pub dataset: &'a Dataset,
    /// Truth the results were scored against.
    pub truth: &'a TruthSet,
    /// Protocol the results were made under.
    pub protocol: Option<Protocol>,
    /// Results, in the order of the trackers.
    pub folders: &'a [ResultFolder],
    /// What the numbers in result files are.
    pub layout: Layout,
}

/// Strips of the sequences in which the first tracker's mean IoU is the lowest, worst first.
/// Sequences without a frame below 0.5 are not among them. Needs the overlap of every frame.
///
/// # Errors
/// When a result file cannot be read. Pictures that cannot be read are said in [`Strip::note`].
pub fn strips(
    source: StripSource<'_>,
    data: &ProtocolData,
    options: StripOptions,
) -> Result<Vec<Strip>, DatasetError> {
    let Some(tracker) = data.trackers.first() else { return Ok(Vec::new()) };
    let mut worst: Vec<_> = tracker
        .sequences
        .iter()
        .filter_map(|(name, s)| Some((name, s, first_failure(&s.iou)?)))
        .collect();
    worst.sort_by(|a, b| {
        let of = |s: &crate::report_data::SequenceData| s.score.figures.scores.mean_iou;
        of(a.1).total_cmp(&of(b.1)).then_with(|| a.0.cmp(b.0))
    });
    let prefixes: Vec<String> = source
        .folders
        .iter()
        .map(|f| f.prefix(source.truth.sequences.iter().map(|s| s.name.as_str())))
        .collect();
    let mut strips = Vec::new();
    for (name, sequence, failure) in worst.into_iter().take(options.worst) {
        let Some(truth) = source.truth.sequences.iter().find(|s| s.name == *name) else { continue };
        let mut predicted = Vec::new();
        for (folder, prefix) in source.folders.iter().zip(&prefixes).take(DRAWN) {
            predicted.push(match folder.files(prefix, name).first() {
                Some(path) => boxes::read(path, source.layout)?,
                None => Vec::new(),
            });
        }
        let recorded = match (source.folders.first(), prefixes.first()) {
            (Some(folder), Some(prefix)) => folder.modalities(prefix, name)?,
            _ => None,
        };
        let mut strip = Strip {
            sequence: name.clone(),
            tracker: 0,
            failure,
            iou: sequence.iou.clone(),
            modalities: recorded.or_else(|| truth.modalities.clone()).unwrap_or_default(),
            pictures: Vec::new(),
            note: None,
        };
        match pictures(source, truth, &predicted, &strip, options) {
            Ok(pictures) => strip.pictures = pictures,
            Err(reason) => strip.note = Some(reason),
        }
        strips.push(strip);
    }
    Ok(strips)
}

/// The sequence behind `name` or `name#target`, and the target.
fn find<'a>(dataset: &'a Dataset, name: &str) -> Option<(&'a dyn Sequence, usize)> {
    let by_id = |id: &str| dataset.sequences.iter().find(|s| s.id() == id).map(AsRef::as_ref);
    by_id(name).map(|s| (s, 0)).or_else(|| {
        let (id, target) = name.rsplit_once('#')?;
        Some((by_id(id)?, target.parse().ok()?))
    })
}

fn pictures(
    source: StripSource<'_>,
    truth: &SequenceTruth,
    predicted: &[Vec<Row>],
    strip: &Strip,
    options: StripOptions,
) -> Result<Vec<StripPicture>, String> {
    let (sequence, target) = find(source.dataset, &truth.name)
        .ok_or_else(|| format!("the dataset has no sequence {}", truth.name))?;
    let start = match source.protocol {
        Some(p) => start_frame(sequence, target, p).unwrap_or(0),
        None => 0,
    };
    let only = sequence.modalities().first().copied().unwrap_or(Modality::Rgb);
    let sensor = |i: usize| strip.modalities.get(i).copied().unwrap_or(only);
    let valid = |row: &Row| bbox(*row).is_valid();

    let mut decoded: Vec<(StripPicture, Picture)> = Vec::new();
    for frame in frames_around(strip.failure, strip.iou.len()) {
        let modality = sensor(frame);
        let picture = sequence.picture(start + frame, modality).map_err(|e| e.to_string())?;
        let shown = StripPicture {
            frame,
            modality,
            jpeg: Vec::new(),
            crop: [0.0; 4],
            truth: truth.visible.get(frame).copied().filter(valid),
            predicted: predicted
                .iter()
                .enumerate()
                .filter_map(|(k, rows)| Some((k, rows.get(frame).copied().filter(valid)?)))
                .collect(),
            iou: strip.iou.get(frame).copied().flatten(),
        };
        decoded.push((shown, picture));
    }

    // One part of the picture per sensor, so that motion is seen as motion.
    let mut parts: BTreeMap<Modality, Row> = BTreeMap::new();
    for (shown, picture) in &decoded {
        let size = [picture.width as f64, picture.height as f64];
        parts.entry(shown.modality).or_insert_with(|| {
            let rows: Vec<Row> = decoded
                .iter()
                .filter(|(s, _)| s.modality == shown.modality)
                .flat_map(|(s, _)| {
                    let mine = s.predicted.iter().filter(|p| p.0 == strip.tracker).map(|p| p.1);
                    s.truth.into_iter().chain(mine)
                })
                .collect();
            part(&rows, size)
        });
    }
    decoded
        .into_iter()
        .map(|(mut shown, picture)| {
            shown.crop = parts.get(&shown.modality).copied().unwrap_or_default();
            shown.jpeg = encode(&picture, shown.crop, options)?;
            Ok(shown)
        })
        .collect()
}

/// The part of a picture that holds all boxes with some room, 4:3 where it fits, in whole pixels.
fn part(rows: &[Row], [width, height]: [f64; 2]) -> Row {
    let full = [0.0, 0.0, width, height];
    // Boxes far outside say nothing about where to look.
    let inside = |r: &&Row| r[0] < width && r[1] < height && r[0] + r[2] > 0.0 && r[1] + r[3] > 0.0;
    let mut edges: Option<Row> = None;
    for r in rows.iter().filter(inside) {
        let [x0, y0] = [r[0].max(0.0), r[1].max(0.0)];
        let [x1, y1] = [(r[0] + r[2]).min(width), (r[1] + r[3]).min(height)];
        edges = Some(edges.map_or([x0, y0, x1, y1], |e| {
            [e[0].min(x0), e[1].min(y0), e[2].max(x1), e[3].max(y1)]
        }));
    }
    let Some([x0, y0, x1, y1]) = edges else { return full };
    let mut w = ((x1 - x0) * 1.4).max(64.0);
    let mut h = ((y1 - y0) * 1.4).max(48.0);
    if w * 3.0 > h * 4.0 {
        h = w * 0.75
    } else {
        w = h / 0.75
    }
    let (w, h) = (w.min(width).round(), h.min(height).round());
    let x = ((x0 + x1 - w) / 2.0).clamp(0.0, width - w).floor();
    let y = ((y0 + y1 - h) / 2.0).clamp(0.0, height - h).floor();
    [x, y, w, h]
}

fn encode(picture: &Picture, crop: Row, options: StripOptions) -> Result<Vec<u8>, String> {
    let [x, y, w, h] = crop.map(|v| v.max(0.0) as u32);
    let [width, height] = [picture.width as u32, picture.height as u32];
    let rgb: Vec<u8> = match picture.channels {
        1 => picture.data.iter().flat_map(|v| [*v; 3]).collect(),
        _ => picture.data.clone(),
    };
    let image = RgbImage::from_raw(width, height, rgb)
        .ok_or_else(|| format!("a picture of {width} x {height} lacks data"))?;
    let cut = imageops::crop_imm(&image, x, y, w.max(1), h.max(1)).to_image();
    let target = options.width.max(16);
    let rows = (u64::from(target) * u64::from(cut.height()) / u64::from(cut.width().max(1))).max(1);
    let rows = u32::try_from(rows).unwrap_or(target).min(4 * target);
    let small = imageops::resize(&cut, target, rows, FilterType::Triangle);
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, options.quality.clamp(1, 100))
        .write_image(small.as_raw(), small.width(), small.height(), ExtendedColorType::Rgb8)
        .map_err(|e| e.to_string())?;
    Ok(jpeg)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `#` held, `.` below 0.5, `_` lost, space absent; the first frame is the initial one.
    fn clip(text: &str) -> Vec<Option<f64>> {
        text.chars()
            .map(|c| match c {
                '#' => Some(0.8),
                '.' => Some(0.4),
                '_' => Some(0.1),
                _ => None,
            })
            .collect()
    }

    #[test]
    fn the_first_long_failure_is_found() {
        let failure = |start, end, long| Some(Failure { start, end, long });
        for (text, want) in [
            ("####", None),
            ("", None),
            ("##.#..#", failure(4, 6, false)),
            ("##..#..#", failure(2, 4, false)),
            ("#___#__________##____________", failure(5, 15, true)),
            // Absent frames neither count nor end it.
            ("#_____  _____#", failure(1, 13, true)),
            ("#_________#", failure(1, 10, false)),
        ] {
            assert_eq!(first_failure(&clip(text)), want, "{text:?}");
        }
    }

    #[test]
    fn frames_lie_around_the_failure() {
        let failure = |start, end| Failure { start, end, long: true };
        assert_eq!(frames_around(failure(50, 90), 100), [0, 40, 49, 50, 60, 75]);
        assert_eq!(frames_around(failure(1, 3), 3), [0, 1, 2]);
        for start in 1..40 {
            for end in start + 1..41 {
                let shown = frames_around(failure(start, end), 41);
                assert!(shown.len() <= PICTURES && shown.contains(&start));
                assert!(shown.iter().all(|f| *f < 41));
            }
        }
    }

    #[test]
    fn parts_hold_the_boxes_and_lie_in_the_picture() {
        let size = [320.0, 240.0];
        for rows in [
            vec![[100.0, 100.0, 20.0, 10.0], [150.0, 90.0, 10.0, 60.0]],
            vec![[-5.0, -5.0, 10.0, 10.0]],
            vec![[0.0, 0.0, 320.0, 240.0]],
            vec![[310.0, 230.0, 30.0, 30.0], [900.0, 0.0, 5.0, 5.0]],
            vec![],
        ] {
            let [x, y, w, h] = part(&rows, size);
            assert!(x >= 0.0 && y >= 0.0 && x + w <= 320.0 && y + h <= 240.0, "{rows:?}");
            for r in rows.iter().filter(|r| r[0] < 320.0) {
                let right = (r[0] + r[2]).min(320.0);
                assert!(r[0].max(0.0) >= x && right <= x + w + 0.5, "{rows:?}: {x} {w}");
            }
        }
        assert_eq!(part(&[], size), [0.0, 0.0, 320.0, 240.0]);
    }

    #[test]
    fn a_picture_that_is_cut_short_is_no_panic() {
        let short = Picture { width: 9, height: 9, channels: 3, data: vec![0; 5] };
        assert!(encode(&short, [0.0, 0.0, 9.0, 9.0], StripOptions::default()).is_err());
        let grey = Picture { width: 9, height: 7, channels: 1, data: vec![7; 63] };
        let jpeg = encode(&grey, [1.0, 1.0, 5.0, 5.0], StripOptions::default()).unwrap();
        let back = image::load_from_memory(&jpeg).unwrap();
        assert_eq!((back.width(), back.height()), (240, 240));
    }
}
