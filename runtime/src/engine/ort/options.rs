//! What to run a bundle with on ONNX Runtime, and its written form on command lines.

use ::ort::ep::{CUDA, ExecutionProviderDispatch, TensorRT};
use ::ort::memory::AllocationDevice;
use ::ort::session::builder::GraphOptimizationLevel;
use std::path::{Path, PathBuf};

/// What computes the nodes of a graph. To add one: a variant here, its lines in this file, and the
/// cargo feature of the `ort` crate that has its options.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Provider {
    /// The processor; in every library.
    #[default]
    Cpu,
    /// NVIDIA GPUs through CUDA and cuDNN.
    Cuda,
    /// NVIDIA GPUs through TensorRT; nodes it does not take go to CUDA, then to the processor.
    TensorRt,
}

impl Provider {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Cpu, Self::Cuda, Self::TensorRt];

    /// Name on command lines.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
        }
    }

    /// Name inside ONNX Runtime.
    pub const fn runtime_name(self) -> &'static str {
        match self {
            Self::Cpu => "CPUExecutionProvider",
            Self::Cuda => "CUDAExecutionProvider",
            Self::TensorRt => "TensorrtExecutionProvider",
        }
    }

    /// What a machine needs for it besides the library.
    pub const fn needs(self) -> &'static str {
        match self {
            Self::Cpu => "nothing else",
            Self::Cuda => "an NVIDIA driver, CUDA and cuDNN",
            Self::TensorRt => "an NVIDIA driver, CUDA, cuDNN and TensorRT",
        }
    }

    /// Name of an engine that runs on it.
    pub(super) const fn engine_name(self) -> &'static str {
        match self {
            Self::Cpu => "ort",
            Self::Cuda => "ort:cuda",
            Self::TensorRt => "ort:tensorrt",
        }
    }

    /// Where its tensors live, when that is not the processor's memory.
    pub(super) fn memory(self) -> Option<AllocationDevice<'static>> {
        match self {
            Self::Cpu => None,
            Self::Cuda | Self::TensorRt => Some(AllocationDevice::CUDA),
        }
    }
}

/// How far ONNX Runtime rewrites a graph before it runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Optimisation {
    /// Not at all.
    Off,
    /// Constants and redundant nodes.
    Basic,
    /// Also fused nodes.
    Extended,
    /// Also memory layouts; what ONNX Runtime does by itself.
    #[default]
    All,
}

impl Optimisation {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Off, Self::Basic, Self::Extended, Self::All];

    /// Name on command lines.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Basic => "basic",
            Self::Extended => "extended",
            Self::All => "all",
        }
    }

    pub(super) const fn level(self) -> GraphOptimizationLevel {
        match self {
            Self::Off => GraphOptimizationLevel::Disable,
            Self::Basic => GraphOptimizationLevel::Level1,
            Self::Extended => GraphOptimizationLevel::Level2,
            Self::All => GraphOptimizationLevel::All,
        }
    }
}

/// How to run a bundle on ONNX Runtime.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OrtOptions {
    /// Threads per operation on the processor; 0 for one per core. Waiting threads sleep: spinning
    /// costs more than it gains on a busy board.
    pub threads: usize,
    /// What computes.
    pub provider: Provider,
    /// Which GPU, counted from 0.
    pub device: u32,
    /// Lets TensorRT compute in 16 bits, but for the norms.
    pub fp16: bool,
    /// Folder in which TensorRT keeps its built engines, each bundle in a folder of its own; without
    /// it every start builds them anew, which takes minutes.
    pub cache: Option<PathBuf>,
    /// How far graphs are rewritten.
    pub optimisation: Optimisation,
}

impl Default for OrtOptions {
    fn default() -> Self {
        Self {
            threads: 1,
            provider: Provider::Cpu,
            device: 0,
            fp16: false,
            cache: None,
            optimisation: Optimisation::All,
        }
    }
}

impl OrtOptions {
    /// Reads `[:PROVIDER][,KEY[=VALUE]]..`, what stands behind `ort` on a command line.
    ///
    /// # Errors
    /// What is wrong and what is possible.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut options = Self::default();
        let mut parts = text.split(',');
        match parts.next().unwrap_or_default() {
            "" => {}
            first => {
                let name = first.strip_prefix(':').unwrap_or(first);
                options.provider = named(&Provider::ALL, Provider::name, "provider", name)?;
            }
        }
        for part in parts {
            let (key, value) = part.split_once('=').unwrap_or((part, ""));
            let number = || {
                value.parse().map_err(|_| format!("{key} is `{value}`, a whole number is needed"))
            };
            match key {
                "threads" => options.threads = number()? as usize,
                "device" => options.device = number()?,
                "fp16" if value.is_empty() => options.fp16 = true,
                "cache" if !value.is_empty() => options.cache = Some(value.into()),
                "opt" => {
                    let all = &Optimisation::ALL;
                    options.optimisation = named(all, Optimisation::name, "opt", value)?;
                }
                _ => {
                    return Err(format!(
                        "`{part}` is none of threads=N, device=N, fp16, cache=DIR, \
                         opt=off|basic|extended|all"
                    ));
                }
            }
        }
        options.check()?;
        Ok(options)
    }

    /// Do the options go together?
    pub(super) fn check(&self) -> Result<(), String> {
        let tensorrt = self.provider == Provider::TensorRt;
        for (given, what) in [(self.fp16, "fp16"), (self.cache.is_some(), "cache")] {
            if given && !tensorrt {
                let name = self.provider.name();
                return Err(format!("{what} is an option of tensorrt, not of {name}"));
            }
        }
        if self.device != 0 && self.provider == Provider::Cpu {
            return Err("device is an option of cuda and tensorrt, not of cpu".into());
        }
        if i32::try_from(self.device).is_err() || i32::try_from(self.threads).is_err() {
            return Err("device and threads must be below 2^31".into());
        }
        Ok(())
    }

    /// What the session is told, in order of preference. `cache` is the bundle's own folder.
    pub(super) fn providers(&self, cache: Option<&Path>) -> Vec<ExecutionProviderDispatch> {
        // `check` has looked at the range.
        let device = self.device as i32;
        let cuda = || CUDA::default().with_device_id(device).build().error_on_failure();
        match self.provider {
            Provider::Cpu => Vec::new(),
            Provider::Cuda => vec![cuda()],
            Provider::TensorRt => {
                let mut trt = TensorRT::default().with_device_id(device);
                if self.fp16 {
                    trt = trt.with_fp16(true).with_layer_norm_fp32_fallback(true);
                }
                if let Some(folder) = cache {
                    let folder = folder.display();
                    trt = trt.with_engine_cache(true).with_engine_cache_path(&folder);
                    trt = trt.with_timing_cache(true).with_timing_cache_path(&folder);
                }
                vec![trt.build().error_on_failure(), cuda()]
            }
        }
    }
}

/// The written form: `ort`, `ort:cuda,device=1`, ..; [`OrtOptions::parse`] reads it back.
impl core::fmt::Display for OrtOptions {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.provider.engine_name())?;
        if self.threads != 1 {
            write!(f, ",threads={}", self.threads)?;
        }
        if self.device != 0 {
            write!(f, ",device={}", self.device)?;
        }
        if self.fp16 {
            f.write_str(",fp16")?;
        }
        if let Some(folder) = &self.cache {
            write!(f, ",cache={}", folder.display())?;
        }
        if self.optimisation != Optimisation::All {
            write!(f, ",opt={}", self.optimisation.name())?;
        }
        Ok(())
    }
}

fn named<T: Copy>(
    all: &[T],
    name_of: fn(T) -> &'static str,
    what: &str,
    name: &str,
) -> Result<T, String> {
    all.iter().copied().find(|&v| name_of(v) == name).ok_or_else(|| {
        let names: Vec<&str> = all.iter().map(|&v| name_of(v)).collect();
        format!("{what} `{name}` is none of {}", names.join(", "))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_written_form_is_read_back() {
        for (text, want) in [
            ("", OrtOptions::default()),
            (
                ":cuda,device=1",
                OrtOptions { provider: Provider::Cuda, device: 1, ..OrtOptions::default() },
            ),
            (
                ",threads=0,opt=basic",
                OrtOptions {
                    threads: 0,
                    optimisation: Optimisation::Basic,
                    ..OrtOptions::default()
                },
            ),
            (
                ":tensorrt,fp16,cache=a/b",
                OrtOptions {
                    provider: Provider::TensorRt,
                    fp16: true,
                    cache: Some("a/b".into()),
                    ..OrtOptions::default()
                },
            ),
        ] {
            let read = OrtOptions::parse(text).unwrap();
            assert_eq!(read, want, "{text}");
            assert_eq!(read.to_string(), format!("ort{text}"));
        }
        assert_eq!(OrtOptions::parse(":cpu"), Ok(OrtOptions::default()));
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (text, parts) in [
            (":gpu", &["`gpu`", "cpu, cuda, tensorrt"][..]),
            (":cuda,device=x", &["device", "`x`"]),
            (":cuda,devise=1", &["`devise=1`", "device=N"]),
            (":cuda,fp16", &["fp16", "tensorrt, not of cuda"]),
            (",cache=d", &["cache", "not of cpu"]),
            (",device=1", &["device", "not of cpu"]),
            (",opt=max", &["`max`", "off, basic, extended, all"]),
            (",threads=-1", &["threads", "`-1`"]),
        ] {
            let error = OrtOptions::parse(text).unwrap_err();
            assert!(parts.iter().all(|p| error.contains(p)), "{text}: {error}");
        }
    }
}
