//! One source: its sequences, and what can be drawn from each.

use super::{MIN_FRAMES, SampleError, least_visible};
use crate::config::{DataSource, SamplerConfig};
use tsda_eval::dataset::{self, Registration, Sequence};
use tsda_runtime::Modality;

/// A target and the sensors that see it often enough.
pub(super) struct Target {
    pub index: usize,
    pub seen_by: Vec<Modality>,
}

/// A sequence that can be drawn from.
pub(super) struct Entry {
    /// Its place among the source's sequences.
    pub sequence: usize,
    pub targets: Vec<Target>,
}

/// Places of entries that have something for one kind of draw.
#[derive(Default)]
pub(super) struct Pool {
    /// With annotated targets.
    pub targets: Vec<usize>,
    /// For random regions.
    pub regions: Vec<usize>,
}

impl Pool {
    fn is_empty(&self) -> bool {
        self.targets.is_empty() && self.regions.is_empty()
    }
}

/// Sequences drawn with one weight.
pub(super) struct Source {
    /// For logs.
    pub label: String,
    pub sequences: Vec<Box<dyn Sequence>>,
    pub weight: f64,
    pub entries: Vec<Entry>,
    same: Pool,
    cross: Pool,
}

impl Source {
    /// Opens entry `index` of the configuration; `split` is the one asked for.
    pub fn open(
        index: usize,
        source: &DataSource,
        split: &str,
        config: &SamplerConfig,
    ) -> Result<Self, SampleError> {
        let place = || format!("data.{index} ({})", source.label());
        let Some(path) = source.path.to_str() else {
            return Err(SampleError::Path { place: place(), path: source.path.clone() });
        };
        let opened = dataset::open(&format!("{}:{path}@{split}", source.kind))
            .map_err(|e| SampleError::Open { place: place(), source: Box::new(e) })?;
        let mut sequences = opened.sequences;
        let found = sequences.len();
        let wanted = |id: &str| source.only.iter().any(|part| id.contains(part.as_str()));
        sequences.retain(|s| source.only.is_empty() || wanted(s.id()));
        Self::new(source.label(), sequences, source.weight, source.draws_regions(), config).ok_or(
            SampleError::Empty {
                place: place(),
                path: source.path.clone(),
                split: split.to_owned(),
                found,
                only: source.only.clone(),
                visible: least_visible(config),
            },
        )
    }

    /// `None` when nothing can be drawn from any of the sequences.
    pub fn new(
        label: &str,
        sequences: Vec<Box<dyn Sequence>>,
        weight: f64,
        regions: bool,
        config: &SamplerConfig,
    ) -> Option<Self> {
        let regions = regions && config.random_region_p > 0.0;
        let (mut entries, mut same, mut cross) = (Vec::new(), Pool::default(), Pool::default());
        for (i, sequence) in sequences.iter().enumerate() {
            let sensors = sequence.modalities();
            let targets: Vec<Target> = (0..sequence.targets())
                .map(|index| Target { index, seen_by: seen_by(sequence.as_ref(), index, config) })
                .filter(|target| !target.seen_by.is_empty())
                .collect();
            // The same place in two pictures is the same thing only where they share a grid.
            let single = sensors.len() == 1;
            let one_grid = single || sequence.registration() == Registration::Aligned;
            let for_regions = regions && one_grid && sequence.frames() > 0;
            let place = entries.len();
            if !targets.is_empty() {
                same.targets.push(place);
            }
            if targets.iter().any(|t| t.seen_by.len() > 1) {
                cross.targets.push(place);
            }
            if for_regions {
                same.regions.push(place);
                if !single {
                    cross.regions.push(place);
                }
            }
            if for_regions || !targets.is_empty() {
                entries.push(Entry { sequence: i, targets });
            }
        }
        let label = label.to_owned();
        (!entries.is_empty()).then_some(Self { label, sequences, weight, entries, same, cross })
    }

    /// What samples within one sensor, or across sensors, can be drawn from.
    pub fn pool(&self, cross: bool) -> &Pool {
        if cross { &self.cross } else { &self.same }
    }

    /// Has it anything to draw across sensors?
    pub fn can_cross(&self) -> bool {
        !self.cross.is_empty()
    }
}

/// Sensors that see a target in as many frames as a sample needs (spec 2.1).
fn seen_by(sequence: &dyn Sequence, target: usize, config: &SamplerConfig) -> Vec<Modality> {
    let frames = sequence.frames();
    let enough = if frames == 1 { 1 } else { least_visible(config) + 1 };
    if frames != 1 && frames < MIN_FRAMES {
        return Vec::new();
    }
    let often = |m: &Modality| {
        let seen = |f: &usize| sequence.truth(target, *f, *m).is_some_and(|b| config.usable(&b));
        (0..frames).filter(seen).take(enough).count() == enough
    };
    sequence.modalities().iter().copied().filter(often).collect()
}
