//! The shared library: which one, what is in it, and what to say when it is not there.

use super::Provider;
use crate::engine::{EngineError, Stage};
use ::ort::environment::Environment;
use ::ort::ep::ExecutionProvider;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Environment variables that name the library, in order.
pub const LIBRARY_VARIABLES: [&str; 2] = ["TSDA_ORT_LIB", "ORT_DYLIB_PATH"];

/// An engine on ONNX Runtime that could not be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[expect(clippy::large_enum_variant, reason = "an engine's message is inside, and errors are rare")]
pub enum OrtError {
    /// There is no usable library.
    #[error(
        "no ONNX Runtime library ({}): {reason}; run scripts/fetch_onnxruntime.sh or install \
         ONNX Runtime 1.17 or newer, and set TSDA_ORT_LIB to its libonnxruntime.so",
        named_by.unwrap_or("the system's")
    )]
    Library {
        /// The variable that named it.
        named_by: Option<&'static str>,
        /// What the loader said.
        reason: String,
    },
    /// The library was built without the execution provider asked for.
    #[error(
        "ONNX Runtime {version} has no {}, only {}; get one that has it, for example with \
         `scripts/fetch_onnxruntime.sh --gpu` ({} also needs {}), and set TSDA_ORT_LIB to it, or \
         choose another engine; the library is {}",
        provider.runtime_name(), available.join(", "), provider.name(), provider.needs(),
        library.display()
    )]
    NoProvider {
        /// The provider asked for.
        provider: Provider,
        /// Providers that are there.
        available: Vec<&'static str>,
        /// The library's version.
        version: String,
        /// The library.
        library: PathBuf,
    },
    /// The execution provider is in the library but cannot be used on this machine.
    #[error(
        "ONNX Runtime {version} cannot start its {}: {reason}; {} needs {} where the loader finds \
         them (LD_LIBRARY_PATH); the library is {}",
        provider.runtime_name(), provider.name(), provider.needs(), library.display()
    )]
    Start {
        /// The provider asked for.
        provider: Provider,
        /// What ONNX Runtime said.
        reason: String,
        /// The library's version.
        version: String,
        /// The library.
        library: PathBuf,
    },
    /// Options that do not go together.
    #[error("engine ort: {0}")]
    Options(String),
    /// The folder for TensorRT's engines cannot be made.
    #[error("cannot make the folder for TensorRT's engines, {}: {reason}", path.display())]
    Cache {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// The graphs cannot be loaded.
    #[error(transparent)]
    Graph(#[from] EngineError),
}

impl OrtError {
    /// Is the engine not there on this machine, whatever the bundle? Then nothing is wrong with
    /// the bundle.
    pub fn is_absent(&self) -> bool {
        matches!(self, Self::Library { .. } | Self::NoProvider { .. } | Self::Start { .. })
    }

    /// Did nobody ask for ONNX Runtime by naming a library, and there is none?
    pub fn is_unasked(&self) -> bool {
        matches!(self, Self::Library { named_by: None, .. })
    }
}

/// The heap-free form; long paths are cut off.
impl From<OrtError> for EngineError {
    fn from(e: OrtError) -> Self {
        match e {
            OrtError::Graph(e) => e,
            e => Self::new(super::NAME, Stage::Load, format_args!("{e}")),
        }
    }
}

/// A loaded ONNX Runtime. There is one per process.
#[derive(Debug)]
pub struct OrtLibrary {
    path: PathBuf,
    version: String,
    providers: Vec<&'static str>,
    pub(super) environment: Environment,
}

impl OrtLibrary {
    /// The process's library: the one that `TSDA_ORT_LIB` names, else `ORT_DYLIB_PATH`, else the
    /// system's. The first call loads it; later calls repeat its answer.
    ///
    /// # Errors
    /// When there is none, it is no ONNX Runtime, or older than 1.17.
    pub fn get() -> Result<&'static Self, OrtError> {
        static LIBRARY: OnceLock<Result<OrtLibrary, OrtError>> = OnceLock::new();
        LIBRARY.get_or_init(Self::load).as_ref().map_err(Clone::clone)
    }

    fn load() -> Result<Self, OrtError> {
        let named = LIBRARY_VARIABLES.into_iter().find_map(|variable| {
            std::env::var_os(variable).filter(|v| !v.is_empty()).map(|v| (variable, v))
        });
        let (named_by, asked) = match named {
            Some((variable, value)) => (Some(variable), PathBuf::from(value)),
            None => {
                let (prefix, suffix) = (std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX);
                (None, format!("{prefix}onnxruntime{suffix}").into())
            }
        };
        let failed = |reason: String| OrtError::Library { named_by, reason };
        // The loader would look for a relative name beside the program first.
        let asked = if named_by.is_some() && asked.is_file() {
            std::path::absolute(&asked).unwrap_or(asked)
        } else {
            asked
        };
        let builder = ::ort::init_from(&asked).map_err(|e| failed(with_cause(&e)))?;
        let environment = builder
            .with_name("tsda")
            .with_telemetry(false)
            .build()
            .map_err(|e| failed(e.to_string()))?;
        let path = loaded_from(&asked);
        let version = version_in(&path).unwrap_or_else(|| "of unknown version".into());
        Ok(Self { path, version, providers: providers(), environment })
    }

    /// The file it came from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its version, `1.22.0`, as far as the file's name tells.
    pub fn version(&self) -> &str {
        &self.version
    }

    /// Its execution providers, by their names inside ONNX Runtime.
    pub fn providers(&self) -> &[&'static str] {
        &self.providers
    }

    /// Has it this one?
    ///
    /// # Errors
    /// A message that says what it has instead.
    pub fn require(&self, provider: Provider) -> Result<(), OrtError> {
        if self.providers.contains(&provider.runtime_name()) {
            return Ok(());
        }
        Err(OrtError::NoProvider {
            provider,
            available: self.providers.clone(),
            version: self.version.clone(),
            library: self.path.clone(),
        })
    }
}

/// The message, and what the system's loader said.
fn with_cause(error: &::ort::LoadDynamicError) -> String {
    use std::error::Error as _;
    let cause = match error {
        ::ort::LoadDynamicError::Dlopen { error, .. } => error.source(),
        _ => None,
    };
    cause.map_or_else(|| error.to_string(), |cause| format!("{error}: {cause}"))
}

/// The real file behind what was asked for: links resolved, the system's search path looked up in
/// this process's own memory map.
fn loaded_from(asked: &Path) -> PathBuf {
    if let Ok(real) = asked.canonicalize() {
        return real;
    }
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap_or_default();
    let mapped = maps.lines().filter_map(|line| line.find('/').map(|at| Path::new(&line[at..])));
    let is_it = |path: &&Path| {
        let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        name.starts_with("libonnxruntime.so")
    };
    mapped.into_iter().find(is_it).unwrap_or(asked).to_owned()
}

/// `1.22.0` of `libonnxruntime.so.1.22.0` or `libonnxruntime.1.22.0.dylib`.
fn version_in(path: &Path) -> Option<String> {
    let name = path.file_name()?.to_str()?;
    let mut parts = name.split('.').skip_while(|p| p.parse::<u32>().is_err());
    let (major, minor) = (parts.next()?, parts.next()?);
    minor.parse::<u32>().ok()?;
    let patch = parts.next().filter(|p| p.parse::<u32>().is_ok()).unwrap_or("0");
    Some(format!("{major}.{minor}.{patch}"))
}

/// Asks the library about every provider known by name.
macro_rules! providers_known_by_name {
    ($($name:literal),+ $(,)?) => {
        fn providers() -> Vec<&'static str> {
            let mut found = Vec::new();
            $({
                struct Named;
                impl ExecutionProvider for Named {
                    const NAME: &'static str = $name;
                    fn register(
                        &self,
                        _: &mut ::ort::session::builder::SessionBuilder,
                    ) -> ::ort::Result<()> {
                        Err(::ort::Error::new("only asked for, never used"))
                    }
                }
                if Named::is_available().unwrap_or(false) {
                    found.push(Named::NAME);
                }
            })+
            found
        }
    };
}

providers_known_by_name!(
    "TensorrtExecutionProvider",
    "NvTensorRTRTXExecutionProvider",
    "CUDAExecutionProvider",
    "MIGraphXExecutionProvider",
    "ROCMExecutionProvider",
    "OpenVINOExecutionProvider",
    "QNNExecutionProvider",
    "CANNExecutionProvider",
    "VitisAIExecutionProvider",
    "RknpuExecutionProvider",
    "NnapiExecutionProvider",
    "VSINPUExecutionProvider",
    "CoreMLExecutionProvider",
    "DmlExecutionProvider",
    "WebGpuExecutionProvider",
    "ACLExecutionProvider",
    "ArmNNExecutionProvider",
    "DnnlExecutionProvider",
    "XnnpackExecutionProvider",
    "AzureExecutionProvider",
    "CPUExecutionProvider",
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_read_from_file_names() {
        for (path, want) in [
            ("/a/libonnxruntime.so.1.32.0", Some("1.32.0")),
            ("/a.1/libonnxruntime.1.20.1.dylib", Some("1.20.1")),
            ("libonnxruntime.so.1.23", Some("1.23.0")),
            ("libonnxruntime.so", None),
            ("libonnxruntime.so.1", None),
            ("onnxruntime.dll", None),
        ] {
            assert_eq!(version_in(Path::new(path)).as_deref(), want, "{path}");
        }
    }

    #[test]
    fn messages_say_what_is_there_and_what_to_do() {
        let error = OrtError::NoProvider {
            provider: Provider::TensorRt,
            available: vec!["CPUExecutionProvider"],
            version: "1.22.0".into(),
            library: "/opt/libonnxruntime.so".into(),
        };
        let text = error.to_string();
        for part in [
            "1.22.0 has no TensorrtExecutionProvider, only CPUExecutionProvider",
            "fetch_onnxruntime.sh --gpu",
            "cuDNN and TensorRT",
            "/opt/libonnxruntime.so",
        ] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(error.is_absent() && !error.is_unasked());
        let missing = OrtError::Library { named_by: None, reason: "gone".into() };
        assert!(missing.is_absent() && missing.is_unasked());
        let short = EngineError::from(missing).to_string();
        assert!(short.contains("no ONNX Runtime library") && short.contains("gone"), "{short}");
    }
}
