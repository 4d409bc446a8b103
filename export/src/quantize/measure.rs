//! What the tracker loses.

use super::{LossReport, QuantizeError};
use tsda_eval::dataset::{Dataset, Picture};
use tsda_eval::evaluate;
use tsda_eval::evaluate::{Options, can_run};
use tsda_eval::protocol::{Protocol, TrackerError, TrackerUnderTest};
use tsda_eval::summary::ProtocolSummary;
use tsda_runtime::bundle::Bundle;
use tsda_runtime::engine::NativeEngine;
use tsda_runtime::{BBox, Engine, Modality, Tracker};

/// A tracker that follows changes of the picture's size, as the programs do: both sensors are taken
/// to see the same field of view.
pub(super) struct Runner<E: Engine> {
    tracker: Tracker<E>,
    size: (usize, usize),
    last: BBox,
}

impl<E: Engine> Runner<E> {
    pub fn new(tracker: Tracker<E>) -> Self {
        Self { tracker, size: (0, 0), last: BBox::default() }
    }
}

impl<E: Engine> TrackerUnderTest for Runner<E> {
    fn name(&self) -> &str {
        "bundle"
    }

    fn init(&mut self, p: &Picture, bbox: BBox, modality: Modality) -> Result<(), TrackerError> {
        let view = p.view().map_err(TrackerError::new)?;
        self.size = (p.width, p.height);
        self.last = bbox;
        self.tracker.init(&view, bbox, Some(modality)).map_err(TrackerError::new)
    }

    fn update(&mut self, p: &Picture, modality: Modality) -> Result<(BBox, f32), TrackerError> {
        let view = p.view().map_err(TrackerError::new)?;
        let now = (p.width, p.height);
        if now != self.size {
            let (kx, ky) = (now.0 as f32 / self.size.0 as f32, now.1 as f32 / self.size.1 as f32);
            let b = self.last;
            let scaled = BBox::new(b.x * kx, b.y * ky, b.w * kx, b.h * ky);
            self.tracker.set_box(scaled).map_err(TrackerError::new)?;
            self.size = now;
        }
        let track = self.tracker.update(&view, Some(modality)).map_err(TrackerError::new)?;
        self.last = track.bbox;
        Ok((track.bbox, track.score))
    }
}

/// Figures of two bundles on one dataset, under every cross-modal protocol it can be run with.
///
/// # Errors
/// When an engine cannot be built or a sequence cannot be tracked.
pub fn losses(
    pair: [&Bundle<'_>; 2],
    name: &str,
    data: &Dataset,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<LossReport>, QuantizeError> {
    let mut all = Vec::new();
    let usable = Protocol::CROSS_MODAL.into_iter().filter(|p| can_run(data, *p));
    let mut protocols: Vec<Protocol> = usable.collect();
    if protocols.is_empty() {
        protocols
            .extend([Protocol::Rgb, Protocol::Thermal].into_iter().filter(|p| can_run(data, *p)));
    }
    for protocol in protocols {
        let mut means = Vec::with_capacity(2);
        for (bundle, which) in pair.into_iter().zip(["floats", "narrow"]) {
            progress(&format!("measuring on {name}, {protocol}, {which}"));
            let make = || {
                let engine = NativeEngine::from_bundle(bundle).map_err(TrackerError::new)?;
                let manifest = bundle.manifest();
                let mut tracker =
                    Tracker::new(engine, manifest.tracker).map_err(TrackerError::new)?;
                tracker.set_motion_prior(manifest.motion).map_err(TrackerError::new)?;
                Ok(Box::new(Runner::new(tracker)) as Box<dyn TrackerUnderTest>)
            };
            let found = evaluate(data, protocol, &make, Options::default(), &|_| {})?;
            means.push(ProtocolSummary::of(&found).mean);
        }
        let figures = [("SR0.5", 0), ("PR20", 1), ("AUC", 2)];
        for (figure, i) in figures {
            let value = |at: usize| {
                let m = means[at];
                (100.0 * [m.sr50, m.pr20, m.auc][i]) as f32
            };
            let name = format!("{name}, {protocol}, {figure}");
            all.push(LossReport { name, before: value(0), after: value(1) });
        }
    }
    if all.is_empty() {
        let reason = "no protocol can be run on it".into();
        return Err(QuantizeError::Data { data: name.into(), reason });
    }
    Ok(all)
}
