//! Samples put together, still in host memory.

use super::{Crop, Processor, Sample, sample_region, sample_rng};
use crate::sampler::{SampleError, Sampler};
use tsda_runtime::labels::{box_centre, gaussian, ltrb, template_maps};
use tsda_runtime::{BBox, ModelSpec};

/// `B` samples of `T` templates, crop side `S`, map side `F`; all arrays row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// `B`.
    pub size: usize,
    /// `T`.
    pub templates: usize,
    /// Names of the samples.
    pub ids: Vec<String>,
    /// Which samples cross sensors, `(B)`.
    pub cross: Vec<bool>,
    /// Which samples have thermal templates, `(B)`.
    pub thermal: Vec<bool>,
    /// `(B*T, 3, S, S)`, sample by sample.
    pub template_crops: Vec<f32>,
    /// `(B*T, F, F)` Gaussian labels.
    pub template_labels: Vec<f32>,
    /// `(B*T, 4, F, F)` boxes as distances.
    pub template_ltrb: Vec<f32>,
    /// `(B, 3, S, S)`.
    pub search_crops: Vec<f32>,
    /// `(B, F, F)` target of the classification.
    pub search_labels: Vec<f32>,
    /// `(B, 4, F, F)` target of the box regression.
    pub search_ltrb: Vec<f32>,
    /// `(B, F, F)` where the box loss is taken.
    pub region: Vec<bool>,
    /// Which search crops show the target, `(B)`; the others' labels are all background and their
    /// region is empty.
    pub present: Vec<bool>,
    /// Targets in the search crops, crop pixels.
    pub search_boxes: Vec<BBox>,
}

impl Batch {
    /// Puts samples of equally many templates together.
    pub(crate) fn new(spec: &ModelSpec, samples: &[Sample]) -> Self {
        let templates = samples.first().map_or(0, |s| s.templates.len());
        let mut batch = Self {
            size: samples.len(),
            templates,
            ids: samples.iter().map(|s| s.id.clone()).collect(),
            cross: samples.iter().map(|s| s.cross).collect(),
            thermal: samples.iter().map(Sample::is_thermal).collect(),
            template_crops: Vec::with_capacity(samples.len() * templates * spec.crop_len()),
            template_labels: Vec::new(),
            template_ltrb: Vec::new(),
            search_crops: Vec::with_capacity(samples.len() * spec.crop_len()),
            search_labels: Vec::new(),
            search_ltrb: Vec::new(),
            region: Vec::new(),
            present: samples.iter().map(|s| s.present).collect(),
            search_boxes: samples.iter().map(|s| s.search.bbox).collect(),
        };
        let mut label = vec![0.0; spec.cells()];
        let mut edges = vec![0.0; 4 * spec.cells()];
        for sample in samples {
            for Crop { pixels, bbox, .. } in &sample.templates {
                batch.template_crops.extend_from_slice(pixels);
                template_maps(spec, bbox, &mut label, &mut edges);
                batch.template_labels.extend_from_slice(&label);
                batch.template_ltrb.extend_from_slice(&edges);
            }
            let Crop { pixels, bbox, .. } = &sample.search;
            batch.search_crops.extend_from_slice(pixels);
            let sigma = spec.label_sigma_cells();
            gaussian(box_centre(spec, bbox), sigma, spec.map_side(), &mut label);
            ltrb(spec, bbox, &mut edges);
            let mut region = sample_region(spec, bbox);
            if !sample.present {
                label.fill(0.0);
                region.fill(false);
            }
            batch.search_labels.extend_from_slice(&label);
            batch.search_ltrb.extend_from_slice(&edges);
            batch.region.extend(region);
        }
        batch
    }
}

/// Makes the batch of any step, from the seed alone.
pub struct BatchMaker {
    sampler: Sampler,
    processor: Processor,
    seed: u64,
    batch: usize,
}

impl BatchMaker {
    /// Batches of `batch` samples drawn by `sampler` and cropped by `processor`.
    pub fn new(sampler: Sampler, processor: Processor, seed: u64, batch: usize) -> Self {
        Self { sampler, processor, seed, batch }
    }

    /// Where the samples come from.
    pub fn sampler(&self) -> &Sampler {
        &self.sampler
    }

    /// Sample `index` of the endless stream.
    ///
    /// # Errors
    /// When a picture cannot be read or nothing suitable is found.
    pub fn sample(&self, index: u64) -> Result<Sample, SampleError> {
        let mut rng = sample_rng(self.seed, index);
        let drawn = self.sampler.draw(&mut rng)?;
        Ok(self.processor.process(&drawn, &mut rng))
    }

    /// Samples `first .. first + count` as one batch.
    ///
    /// # Errors
    /// When a picture cannot be read or nothing suitable is found.
    pub fn range(&self, first: u64, count: usize) -> Result<Batch, SampleError> {
        let samples =
            (0..count as u64).map(|i| self.sample(first + i)).collect::<Result<Vec<_>, _>>()?;
        Ok(Batch::new(self.processor.spec(), &samples))
    }

    /// The batch of a step.
    ///
    /// # Errors
    /// When a picture cannot be read or nothing suitable is found.
    pub fn step(&self, step: u64) -> Result<Batch, SampleError> {
        self.range(step * self.batch as u64, self.batch)
    }
}
