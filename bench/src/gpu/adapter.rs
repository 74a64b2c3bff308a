//! What was run on.

use std::path::Path;
use std::process::Command;

use serde::Serialize;
use trainer::Gpu;

/// A GPU and its limits, with the program's version: what a time is worth nothing without.
#[derive(Clone, Debug, Serialize)]
pub struct Adapter {
    /// As it names itself.
    pub name: String,
    /// `wgpu` or `cuda`.
    pub runtime: &'static str,
    /// Played by a CPU: its times are no GPU's.
    pub software: bool,
    /// The driver and the interface to it, where they can be asked for.
    pub driver: Option<String>,
    /// Largest buffer, bytes.
    pub largest_buffer: u64,
    /// Memory, bytes, where the device says so.
    pub memory: Option<u64>,
    /// Storage buffers that a kernel may have.
    pub buffers: u32,
    /// Memory that the units of a cube share, bytes.
    pub shared_memory: usize,
    /// Units that a cube may have.
    pub units: u32,
    /// The program's commit, with `-dirty` behind it where files differ from it.
    pub commit: Option<String>,
}

impl Adapter {
    /// Describes a GPU.
    #[must_use]
    pub fn of(gpu: &Gpu) -> Self {
        Self {
            name: gpu.name.clone(),
            runtime: gpu.runtime,
            software: gpu.is_software,
            driver: driver(gpu),
            largest_buffer: gpu.largest_buffer,
            memory: gpu.memory,
            buffers: gpu.buffers,
            shared_memory: gpu.shared_memory,
            units: gpu.units,
            commit: commit(),
        }
    }

    /// One line, with a warning where times mean nothing.
    #[must_use]
    pub fn title(&self) -> String {
        let driver = self.driver.as_deref().unwrap_or("driver unknown");
        let warning = if self.software {
            "\nSOFTWARE: a CPU plays this GPU; its times are never to be taken for a GPU's"
        } else {
            ""
        };
        format!(
            "{} by {} ({driver}), commit {}{warning}\n",
            self.name,
            self.runtime,
            self.commit.as_deref().unwrap_or("unknown"),
        )
    }
}

#[cfg(feature = "wgpu")]
fn driver(gpu: &Gpu) -> Option<String> {
    use cubecl::wgpu::wgpu::{Backends, Instance, InstanceDescriptor};
    if gpu.runtime != "wgpu" {
        return cuda_driver();
    }
    let instance = Instance::new(InstanceDescriptor::new_without_display_handle());
    let adapters = instance.enumerate_adapters(Backends::PRIMARY);
    let adapters = cubecl::future::block_on(adapters).into_iter();
    let mut infos = adapters.map(|adapter| adapter.get_info());
    let info = infos.find(|info| info.name == gpu.name)?;
    Some(format!(
        "{} {}, {}",
        info.driver, info.driver_info, info.backend
    ))
}

#[cfg(not(feature = "wgpu"))]
fn driver(_: &Gpu) -> Option<String> {
    cuda_driver()
}

/// What Linux says of NVIDIA's driver.
fn cuda_driver() -> Option<String> {
    let text = std::fs::read_to_string("/proc/driver/nvidia/version").ok()?;
    Some(text.lines().next()?.trim().to_owned())
}

fn commit() -> Option<String> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let arguments = ["describe", "--always", "--dirty", "--abbrev=40"];
    let git = Command::new("git")
        .current_dir(folder)
        .args(arguments)
        .args(["--exclude", "*"])
        .output()
        .ok()?;
    let text = String::from_utf8(git.stdout).ok()?;
    git.status.success().then(|| text.trim().to_owned())
}
