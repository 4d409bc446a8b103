//! What the tracker loses.

use super::{LossReport, QuantizeError};
use tsda_eval::dataset::Dataset;
use tsda_eval::evaluate::{Options, can_run};
use tsda_eval::protocol::{Protocol, TrackerError, TrackerUnderTest};
use tsda_eval::summary::ProtocolSummary;
use tsda_eval::{RuntimeTracker, evaluate};
use tsda_runtime::Tracker;
use tsda_runtime::bundle::Bundle;
use tsda_runtime::engine::NativeEngine;

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
                let tracker =
                    Tracker::from_manifest(engine, bundle.manifest()).map_err(TrackerError::new)?;
                let under_test = RuntimeTracker::new("bundle", tracker);
                Ok(Box::new(under_test) as Box<dyn TrackerUnderTest>)
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
