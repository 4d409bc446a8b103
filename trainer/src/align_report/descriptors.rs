//! Descriptors of targets seen by both sensors.

use super::AlignError;
use crate::model::TrackerNet;
use crate::processing::{Batch, Processor, Sample, sample_rng};
use crate::sampler::{Drawn, Sampler};
use burn::prelude::*;
use tsda_runtime::Modality;

/// Both sensors, in the order in which arrays are indexed.
pub const SENSORS: [Modality; 2] = [Modality::Rgb, Modality::Thermal];

/// What a crop is used as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Shows the target to look for.
    Template,
    /// Is searched.
    Search,
}

impl Role {
    /// Both, in the order in which arrays are indexed.
    pub const ALL: [Self; 2] = [Self::Template, Self::Search];
}

/// The descriptors of one target at one stage. A target is seen as template and as search crop by
/// both sensors; only the sensor differs between two views of a role, the crop window does not.
#[derive(Clone, Debug, PartialEq)]
pub struct Views {
    /// Sequence the target is from.
    pub group: usize,
    /// `[role][sensor][sensor of the other role]`; before the encoder, where the other crop has no
    /// influence, the last index has one value only.
    values: [[Vec<Vec<f64>>; 2]; 2],
}

impl Views {
    /// Views of a target of sequence `group`, indexed `[role][sensor][sensor of the other role]`,
    /// the last with one or two entries.
    pub fn new(group: usize, values: [[Vec<Vec<f64>>; 2]; 2]) -> Self {
        Self { group, values }
    }

    /// The descriptor of the crop of `sensor` in `role` when the other role's crop is of `partner`
    /// (indices into [`SENSORS`]).
    pub fn at(&self, role: Role, sensor: usize, partner: usize) -> &[f64] {
        let of = &self.values[role as usize][sensor];
        of.get(partner).or(of.first()).map_or(&[], Vec::as_slice)
    }

    /// All descriptors of a role and a sensor.
    pub fn all(&self, role: Role, sensor: usize) -> impl Iterator<Item = &[f64]> {
        self.values[role as usize][sensor].iter().map(Vec::as_slice)
    }

    /// The views with the mean of all targets, sensors and partners taken off, role by role: what
    /// templates and search crops differ by as such (encodings, offset targets) is not the sensor's
    /// doing.
    pub fn centred(targets: &[Self]) -> Vec<Self> {
        let means = Role::ALL.map(|role| {
            mean(targets.iter().flat_map(|t| (0..2).flat_map(move |s| t.all(role, s))))
        });
        let mut centred = targets.to_vec();
        for target in &mut centred {
            for (role, mean) in target.values.iter_mut().zip(&means) {
                for v in role.iter_mut().flatten() {
                    v.iter_mut().zip(mean).for_each(|(v, m)| *v -= m);
                }
            }
        }
        centred
    }
}

/// Mean of vectors of one length; empty for none.
pub fn mean<'a>(vectors: impl Iterator<Item = &'a [f64]>) -> Vec<f64> {
    let (mut sum, mut count) = (Vec::new(), 0usize);
    for v in vectors {
        sum.resize(v.len(), 0.0);
        sum.iter_mut().zip(v).for_each(|(s, v)| *s += v);
        count += 1;
    }
    sum.iter_mut().for_each(|s| *s /= count as f64);
    sum
}

/// Descriptors of the same targets at both stages.
#[derive(Clone, Debug, Default)]
pub struct Descriptors {
    /// Pooled head features, before any encoding.
    pub pre: Vec<Views>,
    /// Pooled encoder outputs.
    pub post: Vec<Views>,
}

/// Draws targets and puts them through the network, `batch` at a time: `on_batch` hears how many are
/// done. Memory grows with the batch and, by a few vectors each, with the targets.
///
/// `sampler` has to draw cross-modal samples of registered stills only.
pub fn collect(
    net: &TrackerNet,
    sampler: &Sampler,
    processor: &Processor,
    plan: Plan<'_>,
    mut on_batch: impl FnMut(usize),
) -> Result<Descriptors, AlignError> {
    let mut found = Descriptors::default();
    let mut done = 0;
    while done < plan.targets {
        let count = plan.batch.clamp(1, plan.targets - done);
        let mut targets = Vec::with_capacity(count);
        for index in done..done + count {
            let mut rng = sample_rng(plan.seed, index as u64);
            let drawn = sampler.draw(&mut rng)?;
            targets.push(Target::new(&drawn, processor, &rng)?);
        }
        describe(net, processor, &targets, plan.device, &mut found)?;
        done += count;
        on_batch(done);
    }
    Ok(found)
}

/// How many targets, and how.
#[derive(Clone, Copy)]
pub struct Plan<'a> {
    /// Targets to draw.
    pub targets: usize,
    /// Targets that are in memory at a time.
    pub batch: usize,
    /// Seed of the drawing.
    pub seed: u64,
    /// Where the network is.
    pub device: &'a Device,
}

/// One target as both sensors show it.
struct Target {
    group: usize,
    /// `[s]`: templates of sensor `s`, search crop of the other one; crop windows are the same.
    samples: [Sample; 2],
}

impl Target {
    /// Both directions of a sample drawn across sensors. The same random stream cuts both, so crop
    /// windows agree.
    fn new(
        drawn: &Drawn,
        processor: &Processor,
        rng: &(impl rand::Rng + Clone),
    ) -> Result<Self, AlignError> {
        let Some(first) = drawn.templates.first().filter(|_| drawn.is_cross()) else {
            return Err(AlignError::NotCross { id: drawn.id.clone() });
        };
        let swapped = Drawn {
            id: drawn.id.clone(),
            templates: vec![drawn.search.clone(); drawn.templates.len()],
            search: first.clone(),
            region: drawn.region,
            distractor: None,
            occluder: None,
            absence: None,
        };
        let [mut a, mut b] =
            [drawn, &swapped].map(|drawn| processor.process(drawn, &mut rng.clone()));
        if first.at.modality != SENSORS[0] {
            std::mem::swap(&mut a, &mut b);
        }
        Ok(Self { group: first.at.sequence, samples: [a, b] })
    }
}

/// Head features and template maps of one direction.
struct Direction {
    templates: Tensor<4>,
    search: Tensor<4>,
    labels: Tensor<3>,
    ltrb: Tensor<4>,
}

fn describe(
    net: &TrackerNet,
    processor: &Processor,
    targets: &[Target],
    device: &Device,
    found: &mut Descriptors,
) -> Result<(), AlignError> {
    let spec = processor.spec();
    let (side, map, b) = (spec.crop_side(), spec.map_side(), targets.len());
    let four =
        |v: Vec<f32>, shape: [usize; 4]| Tensor::<4>::from_data(TensorData::new(v, shape), device);
    // Index: sensor of the templates; the search crops are of the other sensor.
    let [rgb, thermal] = [0, 1].map(|s: usize| {
        let samples: Vec<Sample> = targets.iter().map(|t| t.samples[s].clone()).collect();
        let batch = Batch::new(spec, &samples);
        let n = b * batch.templates;
        Direction {
            templates: net.features(four(batch.template_crops, [n, 3, side, side])),
            search: net.features(four(batch.search_crops, [b, 3, side, side])),
            labels: Tensor::from_data(
                TensorData::new(batch.template_labels, [n, map, map]),
                device,
            ),
            ltrb: four(batch.template_ltrb, [n, 4, map, map]),
        }
    });
    let templates = [&rgb, &thermal];
    let searches = [&thermal.search, &rgb.search];

    let ids: Vec<&str> = targets.iter().map(|t| t.samples[0].id.as_str()).collect();
    let count = |features: &Tensor<4>| features.dims()[0] / b;
    let pre_template =
        templates.map(|t| TrackerNet::pool_features(t.templates.clone(), count(&t.templates)));
    let pre_search = searches.map(|s| TrackerNet::pool_features(s.clone(), 1));
    let read = |t: Tensor<2>| rows(t, &ids);
    let mut pre = Grid::new(b);
    for (s, (template, search)) in pre_template.into_iter().zip(pre_search).enumerate() {
        pre.put(Role::Template, s, read(template)?);
        pre.put(Role::Search, s, read(search)?);
    }
    let mut post = Grid::new(b);
    // Outer loop: sensor of the other role, so that views come in the order of their partner.
    for partner in 0..2 {
        for sensor in 0..2 {
            let encode = |t: &Direction, search: &Tensor<4>| {
                let (labels, ltrb) = (t.labels.clone(), t.ltrb.clone());
                net.pool_encoded(t.templates.clone(), search.clone(), labels, ltrb)
            };
            let (template, _) = encode(templates[sensor], searches[partner]);
            post.put(Role::Template, sensor, read(template)?);
            let (_, search) = encode(templates[partner], searches[sensor]);
            post.put(Role::Search, sensor, read(search)?);
        }
    }
    found.pre.extend(pre.into_views(targets));
    found.post.extend(post.into_views(targets));
    Ok(())
}

/// Descriptors of a batch while they come in: `[target][role][sensor]`, partners in order.
struct Grid(Vec<[[Vec<Vec<f64>>; 2]; 2]>);

impl Grid {
    fn new(targets: usize) -> Self {
        Self(vec![Default::default(); targets])
    }

    fn put(&mut self, role: Role, sensor: usize, rows: Vec<Vec<f64>>) {
        for (views, row) in self.0.iter_mut().zip(rows) {
            views[role as usize][sensor].push(row);
        }
    }

    fn into_views(self, targets: &[Target]) -> impl Iterator<Item = Views> {
        self.0.into_iter().zip(targets).map(|(values, t)| Views::new(t.group, values))
    }
}

/// The rows of a `(B, d)` tensor, finite.
fn rows(tensor: Tensor<2>, ids: &[&str]) -> Result<Vec<Vec<f64>>, AlignError> {
    let d = tensor.dims()[1];
    let data = tensor.try_into_data().map_err(|e| AlignError::Device(format!("{e:?}")))?;
    let values = data.try_to_vec::<f32>().map_err(|e| AlignError::Device(format!("{e:?}")))?;
    values
        .chunks_exact(d)
        .zip(ids)
        .map(|(row, id)| {
            if row.iter().all(|v| v.is_finite()) {
                Ok(row.iter().map(|v| f64::from(*v)).collect())
            } else {
                Err(AlignError::NotFinite { id: (*id).to_owned() })
            }
        })
        .collect()
}
