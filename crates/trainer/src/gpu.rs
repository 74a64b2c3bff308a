//! GPUs, and CPUs that play one, that this build's kernels can run on.

use bpnet::HIDDEN_CHANNELS;
use burn::tensor::{Device, Tensor};
use serde::Serialize;

use crate::settings::{BlurKind, Settings};

/// Storage buffers that a kernel takes at most. What CubeCL reports is one less than the adapter has, which wgpu keeps for itself:
/// of WebGPU's eight, seven are left.
const BUFFERS: u32 = 7;
/// Memory that the units of a cube share, in bytes.
const SHARED_MEMORY: usize = 16 << 10;
/// Units of a cube.
const UNITS: u32 = 256;
/// Tiles that a Gaussian overlaps, of a scene that is trained: for an estimate.
const TILES: u64 = 4;
/// Numbers of a Gaussian's partial gradient in a tile, and of a pixel's gradient on its way back.
const PARTIAL: u64 = 9;
const PIXEL: u64 = 6;

/// A table that lies in one buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Table {
    /// What it holds.
    pub name: &'static str,
    /// Its size.
    pub bytes: u64,
}

/// A GPU, or a CPU that plays one.
#[derive(Clone, Debug)]
pub struct Gpu {
    /// As it names itself.
    pub name: String,
    /// What compiles and runs kernels on it: `wgpu` or `cuda`.
    pub runtime: &'static str,
    /// Played by a CPU: right, but slower than the CPU by itself.
    pub is_software: bool,
    /// Largest buffer, in bytes.
    pub largest_buffer: u64,
    /// Memory, in bytes, where the device says so.
    pub memory: Option<u64>,
    /// Storage buffers that a kernel may have.
    pub buffers: u32,
    /// Memory that the units of a cube share, in bytes.
    pub shared_memory: usize,
    /// Units that a cube may have.
    pub units: u32,
    /// What tensors are made on.
    pub device: Device,
}

/// Bytes of a device's memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct MemoryUse {
    /// Held by tensors.
    pub in_use: u64,
    /// Held by the pools that tensors come from.
    pub reserved: u64,
}

/// Why there is no GPU to run on.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NoGpu {
    /// A runtime reaches none.
    #[error(
        "there is no adapter on this machine: install its driver (for wgpu one of Vulkan, Metal or DX12)"
    )]
    Missing,
    /// It cannot run the kernels.
    #[error("{name} is of no use here: {why}")]
    Refused {
        /// As it names itself.
        name: String,
        /// As [`Gpu::refusal`].
        why: String,
    },
}

impl Gpu {
    /// The best that a runtime (`wgpu` or `cuda`) reaches.
    ///
    /// # Errors
    /// There is none, or it cannot run the kernels.
    pub fn best(runtime: &str) -> Result<Self, NoGpu> {
        let mut first = NoGpu::Missing;
        for gpu in Self::found() {
            if gpu.runtime != runtime {
                continue;
            }
            let Some(why) = gpu.refusal() else {
                return Ok(gpu);
            };
            if first == NoGpu::Missing {
                let name = gpu.name;
                first = NoGpu::Refused { name, why };
            }
        }
        Err(first)
    }

    /// All that this build's runtimes reach, GPUs before CPUs that play one; none in a build without a runtime for GPUs. Opens
    /// each of them.
    #[must_use]
    pub fn found() -> Vec<Self> {
        let mut found: Vec<Self> = Vec::new();
        #[cfg(feature = "cuda")]
        found.extend(runtimes::devices("cuda", burn::tensor::DeviceType::Cuda));
        #[cfg(feature = "wgpu")]
        found.extend(runtimes::devices("wgpu", burn::tensor::DeviceType::Wgpu));
        found.sort_by_key(|gpu| gpu.is_software);
        found
    }

    /// What its memory is used for now, by all that runs on it in this program; `None` where nothing can.
    #[must_use]
    pub fn memory_use(&self) -> Option<MemoryUse> {
        #[cfg(feature = "cube")]
        if let burn::backend::DispatchDevice::Cube(cube) = self.device.as_dispatch() {
            let scope = cubecl::MemoryScope::Device;
            let usage = cube.client().memory_report(scope).usage();
            return Some(MemoryUse {
                in_use: usage.bytes_in_use,
                reserved: usage.bytes_reserved,
            });
        }
        None
    }

    /// Why it cannot run the kernels, if it cannot: limits that are too low, or a sum that comes out wrong on it.
    #[must_use]
    pub fn refusal(&self) -> Option<String> {
        let too_few = |what: &str, found: u64, needed: u64| {
            (found < needed).then(|| format!("{what}: {found}, but the kernels need {needed}"))
        };
        too_few(
            "storage buffers a kernel",
            self.buffers.into(),
            BUFFERS.into(),
        )
        .or_else(|| {
            let found = self.shared_memory as u64;
            too_few("bytes of shared memory", found, SHARED_MEMORY as u64)
        })
        .or_else(|| too_few("units a cube", self.units.into(), UNITS.into()))
        .or_else(|| self.wrong_sum())
    }

    /// What comes out wrong where units of a cube add up. CubeCL's SPIR-V (the feature `vulkan`) lays shared memory out wrongly for
    /// drivers without `VK_KHR_workgroup_memory_explicit_layout`, and no driver says so.
    fn wrong_sum(&self) -> Option<String> {
        let values = [1.0, f32::NAN, f32::INFINITY, 2.0];
        let values = Tensor::<1>::from_floats(values, &self.device);
        let why = match host::try_read(host::count_not_finite(&values)) {
            Ok(counts) => match counts.iter::<f64>().sum::<f64>() {
                2.0 => return None,
                found => format!("two are counted as {found}"),
            },
            Err(why) => why,
        };
        Some(format!(
            "what units share is lost: {why} (a driver's mistake, or one without VK_KHR_workgroup_memory_explicit_layout in a build \
             with the feature `vulkan`)"
        ))
    }

    /// The largest table that training makes, about: of so many Gaussians, each in four tiles on average, and frames of so many
    /// pixels. One that is larger than [`Self::largest_buffer`] is refused when it is asked for.
    #[must_use]
    pub fn largest_table(settings: &Settings, gaussians: usize, pixels: usize) -> Table {
        let (gaussians, pixels) = (gaussians as u64, pixels as u64);
        let (exposes, predicts) = match settings.blur.model {
            BlurKind::Off => (false, false),
            BlurKind::Auto | BlurKind::Camera => (true, false),
            BlurKind::Kernels => (false, true),
            BlurKind::Both => (true, true),
        };
        let samples = if exposes {
            settings.camera.most_samples() as u64
        } else {
            1
        };
        let [weights, hidden] = if predicts {
            let weights = settings.blur.kernel_size.pow(2) + 1;
            [weights, HIDDEN_CHANNELS].map(|numbers| numbers as u64)
        } else {
            [0; 2]
        };
        let degree = settings.gaussians.sh_degree as u64;
        let tables = [
            (
                "spherical harmonics",
                gaussians.saturating_mul(3 * (degree + 1).pow(2)),
            ),
            (
                "gradients of the tiles' lists",
                gaussians.saturating_mul(PARTIAL * TILES * samples),
            ),
            ("gradients of the pixels", PIXEL * pixels * samples),
            ("kernels of the pixels", weights * pixels),
            ("layers of BP-Net", hidden * pixels),
        ];
        let tables = tables.map(|(name, numbers)| Table {
            name,
            bytes: numbers.saturating_mul(4),
        });
        tables
            .into_iter()
            .max_by_key(|table| table.bytes)
            .expect("five of them")
    }
}

/// Whether tensors of a device live elsewhere than in main memory.
#[cfg(feature = "cube")]
pub(crate) fn is_gpu(device: &Device) -> bool {
    use burn::backend::DispatchDevice;
    matches!(
        device.clone().inner().as_dispatch(),
        DispatchDevice::Cube(_)
    )
}

/// No device that this build knows is a GPU.
#[cfg(not(feature = "cube"))]
pub(crate) fn is_gpu(_: &Device) -> bool {
    false
}

#[cfg(any(feature = "wgpu", feature = "cuda"))]
mod runtimes {
    use burn::backend::DispatchDevice;
    use burn::tensor::{Device, DeviceType};

    use super::Gpu;

    /// What a runtime reaches.
    pub(super) fn devices(runtime: &'static str, kind: DeviceType) -> impl Iterator<Item = Gpu> {
        let devices = Device::enumerate(kind).into_vec().into_iter();
        devices.filter_map(move |device| open(runtime, device))
    }

    fn open(runtime: &'static str, device: Device) -> Option<Gpu> {
        let DispatchDevice::Cube(cube) = device.as_dispatch() else {
            return None;
        };
        let client = cube.client();
        let properties = client.properties();
        let (hardware, memory) = (&properties.hardware, &properties.memory);
        Some(Gpu {
            name: properties.identity.name.clone(),
            runtime,
            is_software: properties.identity.physical.is_none(),
            largest_buffer: memory.max_page_size.min(splat_core::LARGEST_TABLE),
            memory: memory.max_memory(),
            buffers: hardware.max_bindings,
            shared_memory: hardware.max_shared_memory_size,
            units: hardware.max_units_per_cube,
            device,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{BUFFERS, BlurKind, Gpu, SHARED_MEMORY, Settings, UNITS};
    use burn::tensor::Device;

    #[test]
    fn the_largest_table_is_what_the_settings_ask_for() {
        let mut settings = Settings::default();
        let of = |settings: &Settings, gaussians| {
            let table = Gpu::largest_table(settings, gaussians, 1920 * 1080);
            (table.name, table.bytes)
        };
        settings.blur.model = BlurKind::Off;
        let harmonics = ("spherical harmonics", 4 * 48 * 1_000_000);
        assert_eq!(of(&settings, 1_000_000), harmonics);
        settings.blur.model = BlurKind::Kernels;
        let kernels = ("kernels of the pixels", 4 * 82 * 1920 * 1080);
        assert_eq!(of(&settings, 1_000_000), kernels);
        settings.blur.kernel_size = 5;
        let layers = ("layers of BP-Net", 4 * 64 * 1920 * 1080);
        assert_eq!(of(&settings, 500_000), layers);
        settings.blur.model = BlurKind::Camera;
        let partial = ("gradients of the tiles' lists", 4 * 9 * 4 * 16 * 1_000_000);
        assert_eq!(of(&settings, 1_000_000), partial);
        assert_eq!(of(&settings, usize::MAX).1, u64::MAX, "without a limit");
    }

    #[test]
    fn what_is_too_small_is_named_with_what_is_needed() {
        let enough = Gpu {
            name: "a GPU".to_owned(),
            runtime: "wgpu",
            is_software: false,
            largest_buffer: 128 << 20,
            memory: None,
            buffers: BUFFERS,
            shared_memory: SHARED_MEMORY,
            units: UNITS,
            device: Device::flex(),
        };
        assert_eq!(enough.refusal(), None);
        let [mut buffers, mut memory, mut units] = std::array::from_fn(|_| enough.clone());
        buffers.buffers = 4;
        memory.shared_memory = 8 << 10;
        units.units = 128;
        for (gpu, found, needed) in [
            (buffers, "storage buffers a kernel: 4", "7"),
            (memory, "bytes of shared memory: 8192", "16384"),
            (units, "units a cube: 128", "256"),
        ] {
            let why = gpu.refusal().unwrap_or_default();
            assert!(why.starts_with(found) && why.ends_with(needed), "{why}");
        }
    }
}
