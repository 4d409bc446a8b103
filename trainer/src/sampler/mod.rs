//! Draws training samples: which sequence, target, frames and sensors (spec 2.1).
//!
//! The paper's modality rule: all templates of a sample come from one sensor, drawn uniformly; the
//! search frame comes from the other one with probability `cross_modal_p`. Videos are sampled
//! causally with a gap; of a still the same picture is used for every crop, and processing moves
//! the crops independently. A share of the samples of registered pairs takes a random textured
//! region as target.

mod pictures;
mod region;

pub use pictures::{FrameRef, PictureCache};

use crate::config::{DataKind, DataSource, SamplerConfig};
use rand::{Rng, RngExt};
use std::sync::Arc;
use tsda_eval::dataset::{
    DatasetError, Picture, Sequence, Split, UnknownSplit,
    pairs::PairsDataset,
    sequences::{SequenceFilter, SequencesDataset},
};
use tsda_runtime::{BBox, Modality};

/// Sequences redrawn before a draw is given up.
const TRIES: usize = 100;
/// Frames a video needs at least.
const MIN_FRAMES: usize = 20;

/// Sources or draws that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SampleError {
    /// A dataset could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A source has nothing to draw from.
    #[error(
        "{path}, split '{split}': no sequence can be used (a still needs a box or \
         sampler.random_region_p > 0, a clip at least {MIN_FRAMES} frames and a target seen in \
         more than {visible} of them)"
    )]
    Empty {
        /// Folder of the source.
        path: std::path::PathBuf,
        /// The split asked for.
        split: String,
        /// Visible frames needed.
        visible: usize,
    },
    /// An unknown split name.
    #[error("{path}: {reason}")]
    Split {
        /// Folder of the source.
        path: std::path::PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// No sample could be drawn.
    #[error("no sample could be drawn in {TRIES} tries; last sequence looked at: {last}")]
    NoSample {
        /// Name of the last sequence tried.
        last: String,
    },
}

/// A frame and the target's box in it, in picture pixels.
#[derive(Clone, Debug)]
pub struct DrawnFrame {
    /// Where it is from.
    pub at: FrameRef,
    /// The target.
    pub bbox: BBox,
    /// The pixels.
    pub picture: Arc<Picture>,
}

/// One sample before processing.
#[derive(Clone, Debug)]
pub struct Drawn {
    /// Name for logs: sequence, target or region, frames, sensors.
    pub id: String,
    /// Template frames, all of one sensor.
    pub templates: Vec<DrawnFrame>,
    /// The frame to search.
    pub search: DrawnFrame,
    /// Is the target a random region?
    pub region: bool,
}

impl Drawn {
    /// Does the search frame come from another sensor than the templates?
    pub fn is_cross(&self) -> bool {
        self.templates.first().is_some_and(|t| t.at.modality != self.search.at.modality)
    }
}

struct Source {
    sequences: Vec<Box<dyn Sequence>>,
    /// Both sensors see the target at the same place.
    registered: bool,
    weight: f64,
    /// Usable sequences with their usable targets (none: for random regions only).
    usable: Vec<(usize, Vec<usize>)>,
    /// Positions in `usable` that have targets.
    with_targets: Vec<usize>,
}

/// Draws samples from all sources of a configuration.
pub struct Sampler {
    config: SamplerConfig,
    sources: Vec<Source>,
    cache: Arc<PictureCache>,
}

impl Sampler {
    /// Opens the sources: the training split, or with `validation` the validation split of every
    /// source that has one.
    ///
    /// # Errors
    /// When a source cannot be read or has nothing to draw from.
    pub fn open(
        sources: &[DataSource],
        config: &SamplerConfig,
        cache: Arc<PictureCache>,
        validation: bool,
    ) -> Result<Self, SampleError> {
        let mut opened = Vec::new();
        for source in sources {
            let name = if validation { &source.validation_split } else { &source.split };
            if validation && name.is_empty() {
                continue;
            }
            let split: Split = name.parse().map_err(|e: UnknownSplit| SampleError::Split {
                path: source.path.clone(),
                reason: e.to_string(),
            })?;
            let sequences: Vec<Box<dyn Sequence>> = match source.kind {
                DataKind::Pairs => boxed(PairsDataset::open(&source.path, split)?.into_pairs()),
                DataKind::Sequences => {
                    let filter = SequenceFilter { split, ..SequenceFilter::default() };
                    boxed(SequencesDataset::open(&source.path, &filter)?.into_sequences())
                }
            };
            let registered = source.kind == DataKind::Pairs;
            opened.push(Source::new(sequences, registered, source.weight, config).ok_or_else(
                || SampleError::Empty {
                    path: source.path.clone(),
                    split: name.clone(),
                    visible: least_visible(config),
                },
            )?);
        }
        Ok(Self { config: config.clone(), sources: opened, cache })
    }

    /// Sampler over sequences that are already open; for tests and other loaders. `None` when none
    /// of them can be used.
    pub fn from_sequences(
        sequences: Vec<Box<dyn Sequence>>,
        registered: bool,
        config: &SamplerConfig,
        cache: Arc<PictureCache>,
    ) -> Option<Self> {
        let source = Source::new(sequences, registered, 1.0, config)?;
        Some(Self { config: config.clone(), sources: vec![source], cache })
    }

    /// Is there anything to draw from?
    pub fn is_empty(&self) -> bool {
        self.sources.is_empty()
    }

    /// Usable sequences over all sources.
    pub fn sequences(&self) -> usize {
        self.sources.iter().map(|s| s.usable.len()).sum()
    }

    /// Draws one sample; depends on the state of `rng` alone.
    ///
    /// # Errors
    /// When a picture cannot be read or nothing suitable is found.
    pub fn draw(&self, rng: &mut impl Rng) -> Result<Drawn, SampleError> {
        let mut last = String::from("none");
        for _ in 0..TRIES {
            let Some(index) = self.draw_source(rng) else { break };
            let source = &self.sources[index];
            let region = source.registered && rng.random_bool(self.config.random_region_p);
            let place = if region || source.with_targets.is_empty() {
                rng.random_range(0..source.usable.len())
            } else {
                source.with_targets[rng.random_range(0..source.with_targets.len())]
            };
            let (sequence, targets) = &source.usable[place];
            last = source.sequences[*sequence].id().to_owned();
            let drawn = if region {
                self.draw_region(index, *sequence, rng)?
            } else if targets.is_empty() {
                None
            } else {
                let target = targets[rng.random_range(0..targets.len())];
                self.draw_target(index, *sequence, target, rng)?
            };
            if let Some(drawn) = drawn {
                return Ok(drawn);
            }
        }
        Err(SampleError::NoSample { last })
    }

    fn draw_source(&self, rng: &mut impl Rng) -> Option<usize> {
        let total: f64 = self.sources.iter().map(|s| s.weight).sum();
        let mut at = rng.random::<f64>() * total;
        for (i, source) in self.sources.iter().enumerate() {
            at -= source.weight;
            if at < 0.0 {
                return Some(i);
            }
        }
        self.sources.len().checked_sub(1)
    }

    /// Sensor of the templates and of the search frame.
    fn draw_modalities(
        &self,
        sequence: &dyn Sequence,
        rng: &mut impl Rng,
    ) -> Option<(Modality, Modality)> {
        let present = sequence.modalities();
        if present.is_empty() {
            return None;
        }
        let template = present[rng.random_range(0..present.len())];
        let cross = rng.random_bool(self.config.cross_modal_p);
        let other = template.other();
        let search = if cross && present.contains(&other) { other } else { template };
        Some((template, search))
    }

    fn frame(
        &self,
        source: usize,
        sequence: usize,
        frame: usize,
        modality: Modality,
        bbox: BBox,
    ) -> Result<DrawnFrame, SampleError> {
        let at = FrameRef { source, sequence, frame, modality };
        let picture = self.cache.get(at, self.sources[source].sequences[sequence].as_ref())?;
        Ok(DrawnFrame { at, bbox, picture })
    }

    fn draw_region(
        &self,
        source: usize,
        sequence: usize,
        rng: &mut impl Rng,
    ) -> Result<Option<Drawn>, SampleError> {
        let clip = self.sources[source].sequences[sequence].as_ref();
        let Some((template, search)) = self.draw_modalities(clip, rng) else { return Ok(None) };
        let frame = rng.random_range(0..clip.frames().max(1));
        let mut pictures = Vec::new();
        for &modality in clip.modalities() {
            pictures.push(self.frame(source, sequence, frame, modality, BBox::default())?);
        }
        let views: Vec<&Picture> = pictures.iter().map(|p| p.picture.as_ref()).collect();
        let Some(bbox) = region::draw(&views, &self.config, rng) else { return Ok(None) };
        let of = |modality| self.frame(source, sequence, frame, modality, bbox);
        let templates =
            (0..self.config.templates).map(|_| of(template)).collect::<Result<Vec<_>, _>>()?;
        let id = format!(
            "{}#region({:.0},{:.0},{:.0},{:.0}) {template}->{search}",
            clip.id(),
            bbox.x,
            bbox.y,
            bbox.w,
            bbox.h
        );
        Ok(Some(Drawn { id, templates, search: of(search)?, region: true }))
    }

    fn draw_target(
        &self,
        source: usize,
        sequence: usize,
        target: usize,
        rng: &mut impl Rng,
    ) -> Result<Option<Drawn>, SampleError> {
        let clip = self.sources[source].sequences[sequence].as_ref();
        let Some((template, search)) = self.draw_modalities(clip, rng) else { return Ok(None) };
        let seen = |frame: usize, modality: Modality| {
            clip.truth(target, frame, modality).filter(|b| self.config.usable(b))
        };
        let frames = if clip.frames() == 1 {
            Some((vec![0; self.config.templates], 0))
        } else {
            draw_causal(
                clip.frames(),
                &self.config,
                |f| seen(f, template).is_some(),
                |f| seen(f, search).is_some(),
                rng,
            )
        };
        let Some((template_frames, search_frame)) = frames else { return Ok(None) };
        let mut templates = Vec::new();
        for &frame in &template_frames {
            let Some(bbox) = seen(frame, template) else { return Ok(None) };
            templates.push(self.frame(source, sequence, frame, template, bbox)?);
        }
        let Some(bbox) = seen(search_frame, search) else { return Ok(None) };
        let id = format!(
            "{}#{target} frames {template_frames:?}->{search_frame} {template}->{search}",
            clip.id()
        );
        let search = self.frame(source, sequence, search_frame, search, bbox)?;
        Ok(Some(Drawn { id, templates, search, region: false }))
    }
}

impl SamplerConfig {
    fn usable(&self, bbox: &BBox) -> bool {
        bbox.is_valid() && bbox.area().sqrt() >= self.min_target
    }
}

/// Visible frames a clip must have more than.
fn least_visible(config: &SamplerConfig) -> usize {
    2 * (config.templates + 1)
}

impl Source {
    fn new(
        sequences: Vec<Box<dyn Sequence>>,
        registered: bool,
        weight: f64,
        config: &SamplerConfig,
    ) -> Option<Self> {
        let regions = registered && config.random_region_p > 0.0;
        let mut usable = Vec::new();
        for (i, sequence) in sequences.iter().enumerate() {
            let frames = sequence.frames();
            let enough = if frames == 1 { 1 } else { least_visible(config) + 1 };
            let targets: Vec<usize> = (0..sequence.targets())
                .filter(|&target| {
                    (frames == 1 || frames >= MIN_FRAMES)
                        && sequence.modalities().iter().any(|&m| {
                            let seen = |f: &usize| {
                                sequence.truth(target, *f, m).is_some_and(|b| config.usable(&b))
                            };
                            (0..frames).filter(seen).take(enough).count() == enough
                        })
                })
                .collect();
            if !targets.is_empty() || regions {
                usable.push((i, targets));
            }
        }
        let with_targets: Vec<usize> =
            (0..usable.len()).filter(|&i| !usable[i].1.is_empty()).collect();
        (!usable.is_empty() && (regions || !with_targets.is_empty())).then_some(Self {
            sequences,
            registered,
            weight,
            usable,
            with_targets,
        })
    }
}

/// Causal frames of a video (spec 2.1): a base template, earlier further templates, a later search
/// frame, all within `gap`, which widens by 5 until every range has a visible frame.
fn draw_causal(
    frames: usize,
    config: &SamplerConfig,
    template_seen: impl Fn(usize) -> bool,
    search_seen: impl Fn(usize) -> bool,
    rng: &mut impl Rng,
) -> Option<(Vec<usize>, usize)> {
    let visible = |range: std::ops::Range<usize>, seen: &dyn Fn(usize) -> bool| -> Vec<usize> {
        range.filter(|f| seen(*f)).collect()
    };
    let bases = visible(1..frames.saturating_sub(1), &template_seen);
    if bases.is_empty() {
        return None;
    }
    let mut extra = 0;
    // Past the length of the clip, widening changes nothing any more; a few draws of other bases
    // are still worth it.
    while extra <= frames + 100 {
        let base = bases[rng.random_range(0..bases.len())];
        let reach = config.gap + extra;
        let earlier = visible(base.saturating_sub(reach)..base, &template_seen);
        let later = visible(base + 1..(base + reach).min(frames), &search_seen);
        if later.is_empty() || (earlier.is_empty() && config.templates > 1) {
            extra += 5;
            continue;
        }
        let mut templates = vec![base];
        for _ in 1..config.templates {
            templates.push(earlier[rng.random_range(0..earlier.len())]);
        }
        return Some((templates, later[rng.random_range(0..later.len())]));
    }
    None
}

fn boxed<S: Sequence + 'static>(items: Vec<S>) -> Vec<Box<dyn Sequence>> {
    items.into_iter().map(|s| Box::new(s) as Box<dyn Sequence>).collect()
}

#[cfg(test)]
mod tests;
