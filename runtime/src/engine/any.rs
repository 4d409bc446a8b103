//! The engine a person chose, by name, at run time.
//!
//! Grammar: `NAME[:PROVIDER][,KEY[=VALUE]]..`, described in `docs/engines.md`. To add an engine: a
//! variant of [`EngineChoice`] and of [`AnyEngine`], and a line in every `match` of this file.

#[cfg(feature = "ort")]
use super::ort::{OrtEngine, OrtError, OrtLibrary, OrtOptions};
#[cfg(feature = "tract")]
use super::tract::TractEngine;
use super::{Engine, EngineError, Maps, TemplateInput};
use crate::bundle::Bundle;
use crate::spec::ModelSpec;
use core::fmt;
use core::str::FromStr;

/// Which engine, and how.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum EngineChoice {
    /// tract.
    #[cfg(feature = "tract")]
    Tract,
    /// ONNX Runtime.
    #[cfg(feature = "ort")]
    Ort(OrtOptions),
}

/// A name that means no engine of this build.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("engine `{text}`: {reason}")]
pub struct ChoiceError {
    /// What was typed.
    pub text: String,
    /// What is wrong with it and what is possible.
    pub reason: String,
}

/// An engine that could not be made from a bundle.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The engine refuses the bundle.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// ONNX Runtime is missing, or refuses the bundle.
    #[cfg(feature = "ort")]
    #[error(transparent)]
    Ort(#[from] OrtError),
}

impl OpenError {
    /// Is the engine not there on this machine, whatever the bundle?
    pub fn is_absent(&self) -> bool {
        match self {
            Self::Engine(_) => false,
            #[cfg(feature = "ort")]
            Self::Ort(e) => e.is_absent(),
        }
    }

    /// Is it absent, and did nothing on this machine say that it should be there?
    pub fn is_unasked(&self) -> bool {
        match self {
            Self::Engine(_) => false,
            #[cfg(feature = "ort")]
            Self::Ort(e) => e.is_unasked(),
        }
    }
}

/// The engine that programs use when nobody names one.
impl Default for EngineChoice {
    fn default() -> Self {
        #[cfg(feature = "tract")]
        {
            Self::Tract
        }
        #[cfg(not(feature = "tract"))]
        {
            Self::Ort(OrtOptions::default())
        }
    }
}

impl EngineChoice {
    /// Every engine of this build, on the processor.
    pub fn compiled() -> Vec<Self> {
        vec![
            #[cfg(feature = "tract")]
            Self::Tract,
            #[cfg(feature = "ort")]
            Self::Ort(OrtOptions::default()),
        ]
    }

    /// As typed, with this many threads per operation; 0 for one per core.
    ///
    /// # Errors
    /// When the engine cannot do it.
    pub fn with_threads(self, threads: usize) -> Result<Self, ChoiceError> {
        match self {
            #[cfg(feature = "tract")]
            Self::Tract if threads == 1 => Ok(self),
            #[cfg(feature = "tract")]
            Self::Tract => Err(ChoiceError {
                text: self.to_string(),
                reason: format!("it computes on one thread, {threads} were asked for"),
            }),
            #[cfg(feature = "ort")]
            Self::Ort(options) => Ok(Self::Ort(OrtOptions { threads, ..options })),
        }
    }

    /// Builds the engine from a bundle.
    ///
    /// # Errors
    /// When it is not there on this machine, or refuses the bundle.
    pub fn open(&self, bundle: &Bundle<'_>) -> Result<AnyEngine, OpenError> {
        Ok(match self {
            #[cfg(feature = "tract")]
            Self::Tract => AnyEngine::Tract(Box::new(TractEngine::from_bundle(bundle)?)),
            #[cfg(feature = "ort")]
            Self::Ort(options) => {
                AnyEngine::Ort(Box::new(OrtEngine::with_options(bundle, options)?))
            }
        })
    }

    /// What a person wants to know about it: version, library, what it can do.
    ///
    /// # Errors
    /// When it is not there on this machine.
    pub fn describe(&self) -> Result<String, OpenError> {
        Ok(match self {
            #[cfg(feature = "tract")]
            Self::Tract => "tract: pure Rust, compiled in, processor, one thread".into(),
            #[cfg(feature = "ort")]
            Self::Ort(options) => {
                let library = OrtLibrary::get()?;
                format!(
                    "{options}: ONNX Runtime {} with {}, {}",
                    library.version(),
                    library.providers().join(", "),
                    library.path().display()
                )
            }
        })
    }
}

impl FromStr for EngineChoice {
    type Err = ChoiceError;

    fn from_str(text: &str) -> Result<Self, ChoiceError> {
        let fail = |reason: String| ChoiceError { text: text.into(), reason };
        let (name, rest) = text.split_at(text.find([':', ',']).unwrap_or(text.len()));
        match name {
            #[cfg(feature = "tract")]
            "tract" if rest.is_empty() => Ok(Self::Tract),
            #[cfg(feature = "tract")]
            "tract" => Err(fail("tract has no options".into())),
            #[cfg(feature = "ort")]
            "ort" => OrtOptions::parse(rest).map(Self::Ort).map_err(fail),
            _ => {
                let names: Vec<String> = Self::compiled().iter().map(Self::to_string).collect();
                Err(fail(format!("this build has {}", names.join(", "))))
            }
        }
    }
}

/// The written form; [`FromStr`] reads it back.
impl fmt::Display for EngineChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            #[cfg(feature = "tract")]
            Self::Tract => f.write_str("tract"),
            #[cfg(feature = "ort")]
            Self::Ort(options) => options.fmt(f),
        }
    }
}

/// An engine chosen at run time. What the choice costs per call is one jump.
#[derive(Debug)]
#[non_exhaustive]
pub enum AnyEngine {
    /// tract.
    #[cfg(feature = "tract")]
    Tract(Box<TractEngine>),
    /// ONNX Runtime.
    #[cfg(feature = "ort")]
    Ort(Box<OrtEngine>),
}

macro_rules! inner {
    ($any:expr, $engine:ident => $call:expr) => {
        match $any {
            #[cfg(feature = "tract")]
            Self::Tract($engine) => $call,
            #[cfg(feature = "ort")]
            Self::Ort($engine) => $call,
        }
    };
}

impl Engine for AnyEngine {
    fn spec(&self) -> &ModelSpec {
        inner!(self, e => e.spec())
    }

    fn name(&self) -> &'static str {
        inner!(self, e => e.name())
    }

    fn crop_mut(&mut self) -> &mut [f32] {
        inner!(self, e => e.crop_mut())
    }

    fn features(&mut self) -> Result<(), EngineError> {
        inner!(self, e => e.features())
    }

    fn template_input_mut(&mut self) -> TemplateInput<'_> {
        inner!(self, e => e.template_input_mut())
    }

    fn write_template(&mut self, slot: usize) -> Result<(), EngineError> {
        inner!(self, e => e.write_template(slot))
    }

    fn predict(&mut self, filled: usize) -> Result<Maps<'_>, EngineError> {
        inner!(self, e => e.predict(filled))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_engine_of_the_build_is_found_under_its_name() {
        let all = EngineChoice::compiled();
        assert!(all.contains(&EngineChoice::default()));
        for choice in all {
            assert_eq!(choice.to_string().parse(), Ok(choice));
        }
    }

    #[test]
    fn other_names_are_refused() {
        for text in ["", "onnx", "tractor", ":cuda", "ort:gpu", "ort,turbo", "tract:cuda"] {
            let error = text.parse::<EngineChoice>().unwrap_err();
            assert!(error.to_string().contains(&format!("`{text}`")), "{error}");
        }
    }

    #[cfg(feature = "tract")]
    #[test]
    fn tract_has_one_thread() {
        let tract = EngineChoice::Tract;
        assert_eq!(tract.clone().with_threads(1), Ok(tract.clone()));
        let error = tract.with_threads(2).unwrap_err();
        assert!(error.reason.contains("one thread, 2"), "{error}");
    }
}
