//! The engine a person chose, by name, at run time.
//!
//! Grammar: `NAME[:PROVIDER][,KEY[=VALUE]]..`, described in `docs/engines.md`. To add an engine: a
//! variant of [`EngineChoice`] and of [`AnyEngine`], and a line in every `match` of this file.

#[cfg(feature = "native")]
use super::native::{Isa, NativeEngine, NativeOptions};
#[cfg(feature = "ort")]
use super::ort::{OrtEngine, OrtError, OrtLibrary, OrtOptions};
#[cfg(feature = "tract")]
use super::tract::{TractEngine, TractOptions};
use super::{Engine, EngineError, Maps, TemplateInput};
use crate::bundle::Bundle;
use crate::spec::ModelSpec;
use core::fmt;
use core::str::FromStr;

/// Which engine, and how.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum EngineChoice {
    /// Our own engine.
    #[cfg(feature = "native")]
    Native(NativeOptions),
    /// tract.
    #[cfg(feature = "tract")]
    Tract(TractOptions),
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
        #[cfg(feature = "native")]
        {
            Self::Native(NativeOptions::default())
        }
        #[cfg(all(feature = "tract", not(feature = "native")))]
        {
            Self::Tract(TractOptions::default())
        }
        #[cfg(not(any(feature = "native", feature = "tract")))]
        {
            Self::Ort(OrtOptions::default())
        }
    }
}

impl EngineChoice {
    /// Every engine of this build, on the processor.
    pub fn compiled() -> Vec<Self> {
        vec![
            #[cfg(feature = "native")]
            Self::Native(NativeOptions::default()),
            #[cfg(feature = "tract")]
            Self::Tract(TractOptions::default()),
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
            #[cfg(feature = "native")]
            Self::Native(options) => {
                let threads = native_threads(threads).map_err(|reason| ChoiceError {
                    text: Self::Native(options).to_string(),
                    reason,
                })?;
                Ok(Self::Native(NativeOptions { threads, ..options }))
            }
            #[cfg(feature = "tract")]
            Self::Tract(_) if threads == 1 => Ok(self),
            #[cfg(feature = "tract")]
            Self::Tract(_) => Err(ChoiceError {
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
            #[cfg(feature = "native")]
            Self::Native(options) => {
                AnyEngine::Native(Box::new(NativeEngine::with_options(bundle, *options)?))
            }
            #[cfg(feature = "tract")]
            Self::Tract(options) => {
                AnyEngine::Tract(Box::new(TractEngine::with_options(bundle, *options)?))
            }
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
            #[cfg(feature = "native")]
            Self::Native(options) => format!(
                "{self}: our own, pure Rust, compiled in, {} instructions, {} thread(s)",
                options.isa.unwrap_or_else(Isa::best).name(),
                options.threads
            ),
            #[cfg(feature = "tract")]
            Self::Tract(_) => format!("{self}: pure Rust, compiled in, processor, one thread"),
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

/// A number of threads as typed: 0 for one per core.
#[cfg(feature = "native")]
fn native_threads(threads: usize) -> Result<usize, String> {
    const MOST: usize = NativeOptions::MAX_THREADS;
    match threads {
        0 => Ok(std::thread::available_parallelism().map_or(1, usize::from).min(MOST)),
        1..=MOST => Ok(threads),
        _ => Err(format!("{threads} threads; at most {MOST} are possible")),
    }
}

/// Reads `,threads=N,pin,isa=NAME,attention=floats,convolution=direct`.
#[cfg(feature = "native")]
fn native_options(text: &str) -> Result<NativeOptions, String> {
    const KNOWN: &str = "threads=N, pin, isa=NAME, attention=floats and convolution=direct are";
    let mut options = NativeOptions::default();
    if text.starts_with(':') {
        return Err(format!("it has no providers; {KNOWN} possible after a comma"));
    }
    for part in text.split(',').skip(1) {
        match part.split_once('=') {
            Some(("threads", n)) => {
                let n = n.parse().map_err(|_| format!("`{n}` is no number of threads"))?;
                options.threads = native_threads(n)?;
            }
            Some(("isa", name)) => {
                let found = Isa::available().into_iter().find(|isa| isa.name() == name);
                options.isa = Some(found.ok_or_else(|| {
                    let names: Vec<_> = Isa::available().into_iter().map(Isa::name).collect();
                    format!("this processor has {}, not `{name}`", names.join(", "))
                })?);
            }
            Some(("attention", "floats")) => options.float_attention = true,
            Some(("convolution", "direct")) => options.direct_convolution = true,
            None if part == "pin" => options.pin = true,
            _ => return Err(format!("`{part}` is not known; {KNOWN}")),
        }
    }
    Ok(options)
}

/// Reads `,pool=MIB`.
#[cfg(feature = "tract")]
fn tract_options(text: &str) -> Result<TractOptions, String> {
    const KNOWN: &str = "only pool=MIB is";
    let mut options = TractOptions::default();
    if text.starts_with(':') {
        return Err(format!("it has no providers; {KNOWN} possible after a comma"));
    }
    for part in text.split(',').skip(1) {
        let Some(("pool", n)) = part.split_once('=') else {
            return Err(format!("`{part}` is not known; {KNOWN}"));
        };
        options.pool_mib = Some(n.parse().map_err(|_| format!("`{n}` is no number of MiB"))?);
    }
    Ok(options)
}

impl FromStr for EngineChoice {
    type Err = ChoiceError;

    fn from_str(text: &str) -> Result<Self, ChoiceError> {
        let fail = |reason: String| ChoiceError { text: text.into(), reason };
        let (name, rest) = text.split_at(text.find([':', ',']).unwrap_or(text.len()));
        match name {
            #[cfg(feature = "native")]
            "native" => native_options(rest).map(Self::Native).map_err(fail),
            #[cfg(feature = "tract")]
            "tract" => tract_options(rest).map(Self::Tract).map_err(fail),
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
            #[cfg(feature = "native")]
            Self::Native(options) => {
                f.write_str("native")?;
                if options.threads != 1 {
                    write!(f, ",threads={}", options.threads)?;
                }
                if options.pin {
                    f.write_str(",pin")?;
                }
                if let Some(isa) = options.isa {
                    write!(f, ",isa={}", isa.name())?;
                }
                f.write_str(if options.float_attention { ",attention=floats" } else { "" })?;
                f.write_str(if options.direct_convolution { ",convolution=direct" } else { "" })
            }
            #[cfg(feature = "tract")]
            Self::Tract(options) => {
                f.write_str("tract")?;
                options.pool_mib.map_or(Ok(()), |mib| write!(f, ",pool={mib}"))
            }
            #[cfg(feature = "ort")]
            Self::Ort(options) => options.fmt(f),
        }
    }
}

/// An engine chosen at run time. What the choice costs per call is one jump.
#[derive(Debug)]
#[non_exhaustive]
pub enum AnyEngine {
    /// Our own engine.
    #[cfg(feature = "native")]
    Native(Box<NativeEngine>),
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
            #[cfg(feature = "native")]
            Self::Native($engine) => $call,
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
        for text in
            ["", "onnx", "tractor", ":cuda", "ort:gpu", "ort,turbo", "tract:cuda", "native:cuda"]
        {
            let error = text.parse::<EngineChoice>().unwrap_err();
            assert!(error.to_string().contains(&format!("`{text}`")), "{error}");
        }
    }

    #[cfg(feature = "native")]
    #[test]
    fn options_of_the_native_engine_are_read_and_written() {
        for text in [
            "native",
            "native,threads=3",
            "native,threads=2,pin",
            "native,isa=scalar,attention=floats,convolution=direct",
        ] {
            assert_eq!(text.parse::<EngineChoice>().unwrap().to_string(), text);
        }
        let one: EngineChoice = "native".parse().unwrap();
        assert_eq!(one.clone().with_threads(2).unwrap().to_string(), "native,threads=2");
        assert!(one.clone().with_threads(65).is_err());
        assert!(matches!(one.with_threads(0), Ok(EngineChoice::Native(o)) if o.threads > 0));
        for text in ["native,threads=x", "native,isa=abacus", "native,fast", "native,threads=900"] {
            assert!(text.parse::<EngineChoice>().is_err(), "{text}");
        }
    }

    #[cfg(feature = "tract")]
    #[test]
    fn tract_has_one_thread() {
        let tract: EngineChoice = "tract".parse().unwrap();
        for text in ["tract", "tract,pool=64", "tract,pool=0"] {
            assert_eq!(text.parse::<EngineChoice>().unwrap().to_string(), text);
        }
        for text in ["tract,pool", "tract,pool=-1", "tract,fast"] {
            assert!(text.parse::<EngineChoice>().is_err(), "{text}");
        }
        assert_eq!(tract.clone().with_threads(1), Ok(tract.clone()));
        let error = tract.with_threads(2).unwrap_err();
        assert!(error.reason.contains("one thread, 2"), "{error}");
    }
}
