//! Engines: what runs the three graphs of a network.
//!
//! An engine owns its input and output buffers and the template tokens, so nothing is copied on the
//! way in and nothing is allocated by the tracker. The order of calls for one frame is
//!
//! 1. write the normalised crop into [`Engine::crop_mut`], call [`Engine::features`];
//! 2. call [`Engine::predict`] for the maps (search frames);
//! 3. to remember the frame, fill [`Engine::template_input_mut`] and call
//!    [`Engine::write_template`]: the head feature of the last `features` call becomes the tokens of
//!    that slot.

#[cfg(any(feature = "native", feature = "tract", feature = "ort"))]
pub mod any;
#[cfg(feature = "native")]
pub mod native;
#[cfg(feature = "ort")]
pub mod ort;
#[cfg(feature = "tract")]
pub mod tract;

#[cfg(any(feature = "native", feature = "tract", feature = "ort"))]
pub use any::{AnyEngine, EngineChoice};
#[cfg(feature = "native")]
pub use native::{NativeEngine, NativeOptions};
#[cfg(feature = "tract")]
pub use tract::{TractEngine, TractOptions};

use crate::spec::ModelSpec;

/// The three graphs behind one network, with their buffers.
pub trait Engine {
    /// The network's shape.
    fn spec(&self) -> &ModelSpec;

    /// Short name for logs and reports: `native`, `tract`, `ort`, `ort:cuda`, `burn`.
    fn name(&self) -> &'static str;

    /// Input of the `features` graph: `(3, S, S)`, channels R, G, B, normalised
    /// `(value / 255 - mean) / std`, row-major.
    fn crop_mut(&mut self) -> &mut [f32];

    /// Runs `features` on the crop; the head feature `(1, d, F, F)` stays inside.
    ///
    /// # Errors
    /// What the engine library reported.
    fn features(&mut self) -> Result<(), EngineError>;

    /// Inputs of the `template` graph besides the head feature.
    fn template_input_mut(&mut self) -> TemplateInput<'_>;

    /// Runs `template` on the current head feature and keeps the result in `slot`: template tokens
    /// `(F*F, d)`, or with their first projections beside them `(F*F, 4d)`.
    ///
    /// # Errors
    /// When `slot` is not below `spec().templates`, or what the engine library reported.
    fn write_template(&mut self, slot: usize) -> Result<(), EngineError>;

    /// Runs `predict` on the current head feature against slots `0..filled`.
    ///
    /// # Errors
    /// When `filled` is 0, above `spec().templates` or a slot was never written, or what the engine
    /// library reported.
    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError>;
}

/// Shape of a template slot, as the `template` graph declares its output `tokens`: one row per cell
/// and one or several blocks of the network's width. What the blocks are is the graphs' own affair.
#[cfg(any(feature = "tract", feature = "ort"))]
fn slot_shape(
    engine: &'static str,
    spec: &ModelSpec,
    declared: Option<&[i64]>,
) -> Result<[usize; 2], EngineError> {
    const MOST_BLOCKS: usize = 16;
    let (cells, width) = (spec.cells(), usize::from(spec.width));
    if let Some(&[rows, columns]) = declared
        && let (Ok(rows), Ok(columns)) = (usize::try_from(rows), usize::try_from(columns))
        && rows == cells
        && columns.is_multiple_of(width)
        && (1..=MOST_BLOCKS).contains(&(columns / width))
    {
        return Ok([rows, columns]);
    }
    let detail = format_args!(
        "{}: output `tokens` must be f32 [{cells}, n * {width}] with n from 1 to {MOST_BLOCKS}, \
         found {declared:?}",
        crate::bundle::SectionKind::TemplateOnnx
    );
    Err(EngineError::new(engine, Stage::Load, detail))
}

/// Where a template's label and box go before [`Engine::write_template`].
#[derive(Debug)]
pub struct TemplateInput<'a> {
    /// Gaussian label `(F, F)`, row-major (spec 3.6).
    pub label: &'a mut [f32],
    /// `(4, F, F)`: left, top, right, bottom of every cell in units of the crop side (spec 1.4).
    pub ltrb: &'a mut [f32],
}

/// What `predict` answers.
#[derive(Clone, Copy, Debug)]
pub struct Maps<'a> {
    /// `(F, F)`, unbounded; about 1 on the target, about 0 elsewhere.
    pub scores: &'a [f32],
    /// `(4, F, F)`, positive, units of the crop side.
    pub ltrb: &'a [f32],
}

/// Which part of an engine's work failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Stage {
    /// Reading graphs and weights.
    Load,
    /// The `features` graph.
    Features,
    /// The `template` graph.
    Template,
    /// The `predict` graph.
    Predict,
}

impl core::fmt::Display for Stage {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Load => "loading",
            Self::Features => "features",
            Self::Template => "template",
            Self::Predict => "predict",
        })
    }
}

/// An engine that could not do its work. The message is cut at 255 bytes, so that the type needs no
/// heap.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("engine {engine}, {stage}: {detail}")]
pub struct EngineError {
    /// The engine's name.
    pub engine: &'static str,
    /// What it was doing.
    pub stage: Stage,
    /// What went wrong.
    pub detail: heapless::String<255>,
}

impl EngineError {
    /// An error with a formatted message; what does not fit is cut off.
    pub fn new(engine: &'static str, stage: Stage, detail: core::fmt::Arguments<'_>) -> Self {
        struct Cut(heapless::String<255>);
        impl core::fmt::Write for Cut {
            fn write_str(&mut self, s: &str) -> core::fmt::Result {
                for c in s.chars() {
                    if self.0.push(c).is_err() {
                        break;
                    }
                }
                Ok(())
            }
        }
        let mut cut = Cut(heapless::String::new());
        // `Cut` never fails, and a failing Display implementation only shortens the message.
        let _ = core::fmt::Write::write_fmt(&mut cut, detail);
        Self { engine, stage, detail: cut.0 }
    }
}
