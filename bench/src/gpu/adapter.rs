//! What was run on, and when.

use std::path::Path;
use std::process::Command;
use std::time::{SystemTime, UNIX_EPOCH};

use burn::backend::DispatchDevice;
use cubecl::MemoryScope;
use serde::Serialize;
use trainer::Gpu;

/// A GPU and its limits, with the program's version and the day: what a time is worth nothing without.
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
    /// Year, month and day, UTC.
    pub date: String,
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
            date: date(),
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
            "{} by {} ({driver}), commit {}, {}{warning}\n",
            self.name,
            self.runtime,
            self.commit.as_deref().unwrap_or("unknown"),
            self.date
        )
    }
}

/// Bytes of the device that all pools together use, and that they hold.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Memory {
    /// Bytes in use.
    pub in_use: u64,
    /// Bytes reserved.
    pub reserved: u64,
}

impl Memory {
    /// As it is now; `None` for a device that is none of CubeCL's.
    #[must_use]
    pub fn of(gpu: &Gpu) -> Option<Self> {
        let DispatchDevice::Cube(cube) = gpu.device.as_dispatch() else {
            return None;
        };
        let usage = cube.client().memory_report(MemoryScope::Device).usage();
        Some(Self {
            in_use: usage.bytes_in_use,
            reserved: usage.bytes_reserved,
        })
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

#[expect(
    clippy::disallowed_methods,
    reason = "says when something was timed; nothing that is computed depends on it"
)]
fn date() -> String {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    let days = since.map_or(0, |since| since.as_secs() / 86_400);
    let [year, month, day] = civil(days);
    format!("{year}-{month:02}-{day:02}")
}

/// Year, month and day, so many days after the first of 1970.
fn civil(days: u64) -> [u64; 3] {
    let leap =
        |year: u64| year.is_multiple_of(4) && !year.is_multiple_of(100) || year.is_multiple_of(400);
    let (mut year, mut left) = (1970, days);
    while left >= 365 + u64::from(leap(year)) {
        left -= 365 + u64::from(leap(year));
        year += 1;
    }
    let february = 28 + u64::from(leap(year));
    let mut month = 1;
    for length in [31, february, 31, 30, 31, 30, 31, 31, 30, 31, 30] {
        if left < length {
            break;
        }
        left -= length;
        month += 1;
    }
    [year, month, left + 1]
}

#[cfg(test)]
mod tests {
    #[test]
    fn days_have_the_dates_of_the_calendar() {
        for (days, date) in [
            (0, [1970, 1, 1]),
            (11_016, [2000, 2, 29]),
            (11_322, [2000, 12, 31]),
            (20_454, [2026, 1, 1]),
        ] {
            assert_eq!(super::civil(days), date, "{days} days");
        }
    }
}
