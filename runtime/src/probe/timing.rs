//! How long an engine takes on this machine, graph by graph.

use super::{crop_input, default_boxes};
use crate::engine::{Engine, EngineError};
use crate::labels::template_maps;
use std::time::Instant;

/// The time of one graph.
#[derive(Clone, Debug, PartialEq)]
pub struct StageTime {
    /// `features`, `template`, `predict1` and so on.
    pub graph: String,
    /// Of all repetitions, the shortest: what the rest of the machine adds is left out.
    pub best_ms: f64,
    /// Of all repetitions, the one in the middle.
    pub median_ms: f64,
}

/// Times every graph, after one call of each that is not counted. Slots and crop are left filled
/// from the recipe.
///
/// # Errors
/// What the engine reported.
pub fn stage_times<E: Engine>(
    engine: &mut E,
    repetitions: usize,
) -> Result<Vec<StageTime>, EngineError> {
    let spec = *engine.spec();
    let slots = usize::from(spec.templates);
    for (slot, bbox) in default_boxes(&spec).iter().enumerate() {
        crop_input(&spec, slot, engine.crop_mut());
        engine.features()?;
        let input = engine.template_input_mut();
        template_maps(&spec, bbox, input.label, input.ltrb);
        engine.write_template(slot)?;
    }
    crop_input(&spec, slots, engine.crop_mut());
    engine.features()?;

    let mut all = Vec::new();
    let mut time = |graph: String, call: &mut dyn FnMut() -> Result<(), EngineError>| {
        call()?;
        let mut ms = Vec::with_capacity(repetitions.max(1));
        for _ in 0..repetitions.max(1) {
            let start = Instant::now();
            call()?;
            ms.push(start.elapsed().as_secs_f64() * 1e3);
        }
        ms.sort_by(f64::total_cmp);
        all.push(StageTime { graph, best_ms: ms[0], median_ms: ms[ms.len() / 2] });
        Ok::<(), EngineError>(())
    };
    time("features".into(), &mut || engine.features())?;
    time("template".into(), &mut || engine.write_template(0))?;
    for filled in 1..=slots {
        time(format!("predict{filled}"), &mut || engine.predict(filled).map(|_| ()))?;
    }
    Ok(all)
}
