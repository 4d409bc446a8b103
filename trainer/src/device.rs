//! `--device` and `--devices`: where a command computes.

use anyhow::{Result, bail};
use burn::tensor::Device;
use clap::ValueEnum;

/// Kinds of devices. Those beside the CPU are cargo features of this program.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum DeviceName {
    /// The CPU.
    Flex,
    /// A GPU through WebGPU/Vulkan (needs the cargo feature `wgpu`).
    Wgpu,
    /// An NVIDIA GPU through CUDA (needs the cargo feature `cuda`).
    Cuda,
}

impl DeviceName {
    /// The default device of the kind.
    ///
    /// # Errors
    /// When the program was built without it, or the machine has none.
    pub fn open(self) -> Result<Device> {
        match self {
            Self::Flex => Ok(Device::flex()),
            Self::Wgpu => wgpu(),
            Self::Cuda => Ok(cuda(1)?.swap_remove(0)),
        }
    }

    /// The first `count` devices of the kind: one, and the others.
    ///
    /// # Errors
    /// As [`Self::open`], and when there are fewer.
    pub fn open_several(self, count: usize) -> Result<(Device, Vec<Device>)> {
        let mut all = match (self, count) {
            (_, 0) => bail!("--devices 0: at least one device has to compute"),
            (_, 1) => vec![self.open()?],
            (Self::Flex, _) => bail!(
                "--devices {count}: the CPU is one device, and uses all cores; give one device, or \
                 raise run.accumulate for larger steps"
            ),
            (Self::Wgpu, _) => several_wgpu(count)?,
            (Self::Cuda, _) => cuda(count)?,
        };
        let first = all.remove(0);
        Ok((first, all))
    }

    /// Checks that a checkpoint can be loaded. burn puts an optimiser's state on its default device
    /// first, the graphics device of a program that has that feature, and panics where there is none.
    ///
    /// # Errors
    /// Says how to make the CPU the default.
    pub fn check_resume(self) -> Result<()> {
        let chosen = std::env::var_os("BURN_DEVICE").is_some();
        if self != Self::Flex || chosen || !cfg!(feature = "wgpu") || cfg!(feature = "cuda") {
            return Ok(());
        }
        match wgpu() {
            Ok(_) => Ok(()),
            Err(_) => bail!(
                "--resume: this program has the feature wgpu, and burn loads a checkpoint by way of a \
                 graphics device, of which there is none; set the environment variable \
                 BURN_DEVICE=flex"
            ),
        }
    }
}

/// The adapter that WebGPU prefers; `CUBECL_WGPU_DEFAULT_DEVICE` chooses another.
#[cfg(feature = "wgpu")]
fn wgpu() -> Result<Device> {
    match Device::wgpu_options().init() {
        Ok(device) => Ok(device),
        Err(e) => bail!(
            "--device wgpu: no usable graphics device ({e}); is a Vulkan driver installed? Mesa's \
             software driver will do for tests"
        ),
    }
}

#[cfg(not(feature = "wgpu"))]
fn wgpu() -> Result<Device> {
    bail!("--device wgpu: this program was built without the feature wgpu")
}

/// The first graphics devices that WebGPU lists.
#[cfg(feature = "wgpu")]
fn several_wgpu(count: usize) -> Result<Vec<Device>> {
    first(burn::tensor::DeviceType::Wgpu, "wgpu", count)
}

#[cfg(not(feature = "wgpu"))]
fn several_wgpu(_: usize) -> Result<Vec<Device>> {
    Ok(vec![wgpu()?])
}

#[cfg(feature = "cuda")]
fn cuda(count: usize) -> Result<Vec<Device>> {
    first(burn::tensor::DeviceType::Cuda, "cuda", count)
}

#[cfg(not(feature = "cuda"))]
fn cuda(_: usize) -> Result<Vec<Device>> {
    bail!("--device cuda: this program was built without the feature cuda")
}

/// The first `count` of the devices burn finds.
#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn first(kind: burn::tensor::DeviceType, name: &str, count: usize) -> Result<Vec<Device>> {
    let mut found = Device::enumerate(kind).into_vec();
    if found.len() < count {
        bail!("--device {name} --devices {count}: this machine has {}", found.len());
    }
    found.truncate(count);
    Ok(found)
}
