//! Draws training samples: which source, sequence, target, frames and sensors (spec 2.1).
//!
//! First it is drawn whether the sample crosses sensors, then the source by weight ([`mix`] keeps
//! both the weights and the cross-modal share), then a sequence of it uniformly. The paper's
//! modality rule: all templates of a sample come from one sensor, drawn uniformly among those the
//! sequence has; the search frame comes from the same one or from the other. Every sensor's own box
//! is used. Videos are sampled causally with a gap; of a still the same picture is used for every
//! crop, and processing moves the crops independently. A share of the samples takes a random
//! textured region of one frame as target, where a source says that its sensors share a grid.

mod causal;
mod mix;
mod pictures;
mod region;
mod source;

pub use pictures::{FrameRef, PictureCache};

use crate::config::{DataSource, SamplerConfig};
use causal::draw_causal;
use mix::Mix;
use rand::{Rng, RngExt};
use source::{Source, Target};
use std::path::PathBuf;
use std::sync::Arc;
use tsda_eval::dataset::{DatasetError, OpenError, Picture, Sequence};
use tsda_runtime::{BBox, Modality};

/// Sources drawn for one sample before the draw is given up.
const TRIES: usize = 10;
/// Sequences of a source drawn before another source is.
const SEQUENCE_TRIES: usize = 20;
/// Frames a video needs at least.
const MIN_FRAMES: usize = 20;

/// Sources or draws that cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SampleError {
    /// A picture could not be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A source could not be opened.
    #[error("{place}: {source}")]
    Open {
        /// Entry of the configuration.
        place: String,
        /// What is wrong.
        source: Box<OpenError>,
    },
    /// A path that is not text.
    #[error("{place}: path {path} is not valid UTF-8; rename the folder")]
    Path {
        /// Entry of the configuration.
        place: String,
        /// The folder.
        path: PathBuf,
    },
    /// A source has nothing to draw from.
    #[error(
        "{place}: {path}, split '{split}'{}: none of its {found} sequences can be used (a still \
         needs a box of at least sampler.min_target, a clip at least {MIN_FRAMES} frames and a \
         target seen in more than {visible} of them; registered material also does with regions = \
         true and sampler.random_region_p > 0)", only_text(.only)
    )]
    Empty {
        /// Entry of the configuration.
        place: String,
        /// Folder of the source.
        path: PathBuf,
        /// The split asked for.
        split: String,
        /// Sequences in the split.
        found: usize,
        /// Texts of which sequence names must contain one.
        only: Vec<String>,
        /// Visible frames needed.
        visible: usize,
    },
    /// Samples across sensors are asked for and no source can give any.
    #[error(
        "sampler.cross_modal_p = {p}, but no target in [[data]] is seen by both sensors ({labels}); \
         add registered RGB-thermal material, or set it to 0 to train within sensors only"
    )]
    NothingCrosses {
        /// Share asked for.
        p: f64,
        /// The sources.
        labels: String,
    },
    /// No sample could be drawn.
    #[error(
        "no sample {} sensors could be drawn in {} tries; last sequence looked at: {last}",
        if *.cross { "across" } else { "within" },
        TRIES * SEQUENCE_TRIES
    )]
    NoSample {
        /// Was it to cross sensors?
        cross: bool,
        /// Name of the last sequence tried.
        last: String,
    },
}

fn only_text(only: &[String]) -> String {
    if only.is_empty() { String::new() } else { format!(", only {only:?}") }
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
    /// Name for logs: source, sequence, target or region, frames, sensors.
    pub id: String,
    /// Template frames, the first of the templates' sensor, the others too unless
    /// `sampler.mixed_templates_p` is set.
    pub templates: Vec<DrawnFrame>,
    /// The frame to search.
    pub search: DrawnFrame,
    /// Is the target a random region?
    pub region: bool,
    /// Target of another sequence, to be pasted beside this one; of the search frame's sensor.
    pub distractor: Option<DrawnFrame>,
    /// Frame of another sequence, part of which is to cover part of the target; of the search
    /// frame's sensor.
    pub occluder: Option<DrawnFrame>,
    /// Is the search crop not to show the target, and how?
    pub absence: Option<Absence>,
}

/// How a search crop comes to show no target.
#[derive(Clone, Debug)]
pub enum Absence {
    /// The crop is cut around this target of another sequence instead; of the search frame's sensor.
    Another(DrawnFrame),
    /// What lies beside the target is copied over it.
    Covered,
}

impl Drawn {
    /// Does the search frame come from another sensor than the templates?
    pub fn is_cross(&self) -> bool {
        self.templates.first().is_some_and(|t| t.at.modality != self.search.at.modality)
    }
}

/// What a source gives to the stream of samples.
#[derive(Clone, Debug, PartialEq)]
pub struct SourceShare {
    /// Its name.
    pub label: String,
    /// Sequences that can be drawn.
    pub sequences: usize,
    /// Its share of all samples, those within one sensor.
    pub same: f64,
    /// Its share of all samples, those across sensors.
    pub cross: f64,
}

/// Draws samples from all sources of a configuration.
pub struct Sampler {
    config: SamplerConfig,
    sources: Vec<Source>,
    mix: Mix,
    cache: Arc<PictureCache>,
}

impl Sampler {
    /// Opens the sources: the training split, or with `validation` the validation split of every
    /// source that has one.
    ///
    /// # Errors
    /// When a source cannot be read or has nothing to draw from, and (in training) when samples
    /// across sensors are asked for and none can give them.
    pub fn open(
        sources: &[DataSource],
        config: &SamplerConfig,
        cache: Arc<PictureCache>,
        validation: bool,
    ) -> Result<Self, SampleError> {
        let mut opened = Vec::new();
        for (i, source) in sources.iter().enumerate() {
            let split = if validation { &source.validation_split } else { &source.split };
            if !(validation && split.is_empty()) {
                opened.push(Source::open(i, source, split, config)?);
            }
        }
        if !validation && config.cross_modal_p > 0.0 && !opened.iter().any(Source::can_cross) {
            let labels: Vec<&str> = opened.iter().map(|s| s.label.as_str()).collect();
            let (p, labels) = (config.cross_modal_p, labels.join(", "));
            return Err(SampleError::NothingCrosses { p, labels });
        }
        let mut sampler = Self::from_sources(opened, config, cache);
        if validation {
            let c = &mut sampler.config;
            (c.distractor_p, c.occluder_p, c.absent_p, c.mixed_templates_p) = (0.0, 0.0, 0.0, 0.0);
        }
        Ok(sampler)
    }

    /// Sampler over sequences that are already open; `registered` allows random regions. `None`
    /// when none of them can be used. Where none has both sensors, nothing crosses.
    pub fn from_sequences(
        sequences: Vec<Box<dyn Sequence>>,
        registered: bool,
        config: &SamplerConfig,
        cache: Arc<PictureCache>,
    ) -> Option<Self> {
        let source = Source::new("sequences", sequences, 1.0, registered, config)?;
        Some(Self::from_sources(vec![source], config, cache))
    }

    fn from_sources(
        sources: Vec<Source>,
        config: &SamplerConfig,
        cache: Arc<PictureCache>,
    ) -> Self {
        let weights: Vec<_> = sources.iter().map(|s| (s.weight, s.can_cross())).collect();
        let mix = Mix::new(&weights, config.cross_modal_p);
        Self { config: config.clone(), sources, mix, cache }
    }

    /// Is there anything to draw from?
    pub fn is_empty(&self) -> bool {
        self.sources.is_empty()
    }

    /// Usable sequences over all sources.
    pub fn sequences(&self) -> usize {
        self.sources.iter().map(|s| s.entries.len()).sum()
    }

    /// What each source gives, in the order of the configuration.
    pub fn shares(&self) -> Vec<SourceShare> {
        let one = |(i, source): (usize, &Source)| {
            let [same, cross] = self.mix.share(i);
            let (label, sequences) = (source.label.clone(), source.entries.len());
            SourceShare { label, sequences, same, cross }
        };
        self.sources.iter().enumerate().map(one).collect()
    }

    /// Draws one sample; depends on the state of `rng` alone.
    ///
    /// # Errors
    /// When a picture cannot be read or nothing suitable is found.
    pub fn draw(&self, rng: &mut impl Rng) -> Result<Drawn, SampleError> {
        let mut last = "none";
        // Drawn once: redrawing it after a failure would favour what is easy to find.
        let cross = self.mix.draw_cross(rng);
        for _ in 0..TRIES {
            let Some(index) = self.mix.draw_source(cross, rng) else { break };
            for _ in 0..SEQUENCE_TRIES {
                let Some((drawn, sequence)) = self.draw_from(index, cross, rng)? else { break };
                if let Some(mut drawn) = drawn {
                    let modality = drawn.search.at.modality;
                    drawn.distractor =
                        self.draw_other(index, sequence, modality, self.config.distractor_p, rng)?;
                    drawn.occluder =
                        self.draw_other(index, sequence, modality, self.config.occluder_p, rng)?;
                    drawn.absence = self.draw_absence(index, sequence, modality, rng)?;
                    return Ok(drawn);
                }
                last = self.sources[index].sequences[sequence].id();
            }
        }
        Err(SampleError::NoSample { cross, last: last.to_owned() })
    }

    /// Draws a sequence of a source and a sample from it, which may not work out; `None` when the
    /// source has nothing of this kind.
    fn draw_from(
        &self,
        index: usize,
        cross: bool,
        rng: &mut impl Rng,
    ) -> Result<Option<(Option<Drawn>, usize)>, SampleError> {
        let source = &self.sources[index];
        let pool = source.pool(cross);
        let wanted = rng.random_bool(self.config.random_region_p);
        let region = !pool.regions.is_empty() && (wanted || pool.targets.is_empty());
        let Some(&place) = pick(if region { &pool.regions } else { &pool.targets }, rng) else {
            return Ok(None);
        };
        let entry = &source.entries[place];
        let drawn = if region {
            self.draw_region(index, entry.sequence, cross, rng)?
        } else {
            let possible: Vec<&Target> =
                entry.targets.iter().filter(|t| !cross || t.seen_by.len() > 1).collect();
            match pick(&possible, rng) {
                Some(target) => self.draw_target(index, entry.sequence, target, cross, rng)?,
                None => None,
            }
        };
        Ok(Some((drawn, entry.sequence)))
    }

    /// With chance `p`, a frame of another sequence than `not` of the source, with a target seen by
    /// `modality`. Of the same sequence it could be the very target, which would have two places.
    fn draw_other(
        &self,
        index: usize,
        not: usize,
        modality: Modality,
        p: f64,
        rng: &mut impl Rng,
    ) -> Result<Option<DrawnFrame>, SampleError> {
        if p <= 0.0 || !rng.random_bool(p) {
            return Ok(None);
        }
        let source = &self.sources[index];
        for _ in 0..SEQUENCE_TRIES {
            let Some(&place) = pick(&source.pool(false).targets, rng) else { break };
            let entry = &source.entries[place];
            let Some(target) = pick(&entry.targets, rng) else { continue };
            if entry.sequence == not {
                continue;
            }
            let clip = source.sequences[entry.sequence].as_ref();
            let frame = rng.random_range(0..clip.frames().max(1));
            let truth = clip.truth(target.index, frame, modality);
            let Some(bbox) = truth.filter(|b| self.config.usable(b)) else { continue };
            let drawn = self.frame(index, entry.sequence, frame, modality, bbox)?;
            if drawn.is_some() {
                return Ok(drawn);
            }
        }
        Ok(None)
    }

    /// With chance `absent_p`, one of the two ways, each as often as the other.
    fn draw_absence(
        &self,
        index: usize,
        sequence: usize,
        modality: Modality,
        rng: &mut impl Rng,
    ) -> Result<Option<Absence>, SampleError> {
        let p = self.config.absent_p;
        if p <= 0.0 || !rng.random_bool(p) {
            return Ok(None);
        }
        let another = self.draw_other(index, sequence, modality, 0.5, rng)?;
        Ok(Some(another.map_or(Absence::Covered, Absence::Another)))
    }

    /// Sensor of every template: the first is `template`'s, the others' may be `search`'s where the
    /// target was found `seen` there.
    fn template_sensors<'a>(
        &'a self,
        (template, search): (Modality, Modality),
        seen: impl Fn(usize) -> bool + 'a,
        rng: &'a mut impl Rng,
    ) -> impl Iterator<Item = Modality> + 'a {
        let p = if template == search { 0.0 } else { self.config.mixed_templates_p };
        (0..self.config.templates).map(move |i| {
            let other = i > 0 && p > 0.0 && rng.random_bool(p) && seen(i);
            if other { search } else { template }
        })
    }

    /// The frame with its picture; `None` when the box lies wholly outside of it.
    fn frame(
        &self,
        source: usize,
        sequence: usize,
        frame: usize,
        modality: Modality,
        bbox: BBox,
    ) -> Result<Option<DrawnFrame>, SampleError> {
        let at = FrameRef { source, sequence, frame, modality };
        let picture = self.cache.get(at, self.sources[source].sequences[sequence].as_ref())?;
        let inside = bbox.overlaps_image(picture.width, picture.height);
        Ok(inside.then_some(DrawnFrame { at, bbox, picture }))
    }

    fn draw_region(
        &self,
        source: usize,
        sequence: usize,
        cross: bool,
        rng: &mut impl Rng,
    ) -> Result<Option<Drawn>, SampleError> {
        let clip = self.sources[source].sequences[sequence].as_ref();
        let Some((template, search)) = draw_sensors(clip.modalities(), cross, rng) else {
            return Ok(None);
        };
        let frame = rng.random_range(0..clip.frames().max(1));
        let picture =
            |modality| self.cache.get(FrameRef { source, sequence, frame, modality }, clip);
        let (first, second) = (picture(template)?, picture(search)?);
        let views = [first.as_ref(), second.as_ref()];
        let views = if cross { &views[..] } else { &views[..1] };
        let Some(bbox) = region::draw(views, &self.config, rng) else { return Ok(None) };
        let of = |modality, picture: &Arc<Picture>| {
            let at = FrameRef { source, sequence, frame, modality };
            DrawnFrame { at, bbox, picture: picture.clone() }
        };
        let id = format!(
            "{}: {}#region({:.0},{:.0},{:.0},{:.0}) frame {frame} {template}->{search}",
            self.sources[source].label,
            clip.id(),
            bbox.x,
            bbox.y,
            bbox.w,
            bbox.h
        );
        let one = |sensor| of(sensor, if sensor == template { &first } else { &second });
        let templates = self.template_sensors((template, search), |_| true, rng).map(one).collect();
        Ok(Some(Drawn {
            id,
            templates,
            search: of(search, &second),
            region: true,
            distractor: None,
            occluder: None,
            absence: None,
        }))
    }

    fn draw_target(
        &self,
        source: usize,
        sequence: usize,
        target: &Target,
        cross: bool,
        rng: &mut impl Rng,
    ) -> Result<Option<Drawn>, SampleError> {
        let clip = self.sources[source].sequences[sequence].as_ref();
        let Some((template, search)) = draw_sensors(&target.seen_by, cross, rng) else {
            return Ok(None);
        };
        let seen = |frame: usize, modality: Modality| {
            clip.truth(target.index, frame, modality).filter(|b| self.config.usable(b))
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
        let id = format!(
            "{}: {}#{} frames {template_frames:?}->{search_frame} {template}->{search}",
            self.sources[source].label,
            clip.id(),
            target.index
        );
        let of = |frame, modality| match seen(frame, modality) {
            Some(bbox) => self.frame(source, sequence, frame, modality, bbox),
            None => Ok(None),
        };
        let mut templates = Vec::with_capacity(template_frames.len());
        let sensors: Vec<Modality> = self
            .template_sensors(
                (template, search),
                |i| seen(template_frames[i], search).is_some(),
                rng,
            )
            .collect();
        for (&frame, sensor) in template_frames.iter().zip(sensors) {
            let Some(drawn) = of(frame, sensor)? else { return Ok(None) };
            templates.push(drawn);
        }
        let Some(search) = of(search_frame, search)? else { return Ok(None) };
        Ok(Some(Drawn {
            id,
            templates,
            search,
            region: false,
            distractor: None,
            occluder: None,
            absence: None,
        }))
    }
}

/// One of `items`, uniformly.
fn pick<'a, T>(items: &'a [T], rng: &mut impl Rng) -> Option<&'a T> {
    if items.is_empty() { None } else { items.get(rng.random_range(0..items.len())) }
}

/// Sensor of the templates, uniform among `sensors`, and of the search frame.
fn draw_sensors(
    sensors: &[Modality],
    cross: bool,
    rng: &mut impl Rng,
) -> Option<(Modality, Modality)> {
    let template = *pick(sensors, rng)?;
    let search = if cross { template.other() } else { template };
    sensors.contains(&search).then_some((template, search))
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

#[cfg(test)]
mod mixed_tests;
#[cfg(test)]
mod tests;
