//! What the tests that cross crates share: the one list of devices, the f64 gradient check, properties on random input, a tiny
//! scene, scenes of moving bodies and folders of them, a wall, and the cases of docs/NUMERICS.md.

pub mod bodies;
pub mod folder;
mod gradcheck;
pub mod numerics;
pub mod tiny;
pub mod wall;

pub use gradcheck::{GradLimits, GradReport, check_gradients, directional_report};
pub use property::{property, uniform};
pub use trainer::with_causes;

use burn::tensor::{DType, Device, Tensor, TensorData};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write as _;
use std::sync::{Mutex, PoisonError};
use trainer::{Gpu, NoGpu};

/// Every backend that is compiled in, by the name `--backend` gives it.
///
/// Each test of tensor code runs on every entry of this list. The environment variable `LIMPID_BACKENDS`, names with commas
/// between them, leaves the others out.
///
/// # Panics
/// Panics where none is left.
#[must_use]
pub fn devices() -> Vec<(&'static str, Device)> {
    let named = std::env::var("LIMPID_BACKENDS").ok();
    let is_wanted = |name: &str| {
        named
            .as_ref()
            .is_none_or(|named| named.split(',').any(|one| one == name))
    };
    let mut devices = vec![
        #[cfg(feature = "flex")]
        ("flex", Device::flex()),
        #[cfg(feature = "ndarray")]
        ("ndarray", ndarray()),
    ];
    devices.retain(|(name, _)| is_wanted(name));
    let mut has_no_adapter = false;
    for runtime in RUNTIMES.iter().filter(|runtime| is_wanted(runtime)) {
        match gpu(runtime) {
            Ok(gpu) => devices.push((runtime, gpu.device)),
            Err(why) => {
                skipped_once(&format!("{runtime}: {why}"));
                has_no_adapter = true;
            }
        }
    }
    assert!(
        !devices.is_empty() || has_no_adapter,
        "no backend of LIMPID_BACKENDS={} is compiled in",
        named.unwrap_or_default()
    );
    devices
}

/// Those of [`devices`] that compute in `dtype`; which are left out is said once a test.
#[must_use]
pub fn devices_in(dtype: DType) -> Vec<(&'static str, Device)> {
    let mut devices = devices();
    devices.retain(|(name, device)| computes(name, device, dtype));
    devices
}

/// Whether a device computes in `dtype`; where it does not, the test says once that it leaves it out.
#[must_use]
pub fn computes(name: &str, device: &Device, dtype: DType) -> bool {
    let computes = device.supports_dtype(dtype);
    if !computes {
        skipped_once(&format!("{name} does not compute in {dtype:?}"));
    }
    computes
}

/// Those of [`devices`] on which thousands of small operations do not take minutes: not a GPU that a CPU plays.
#[must_use]
pub fn quick_devices() -> Vec<(&'static str, Device)> {
    let mut devices = devices();
    devices.retain(|(name, _)| {
        let is_slow = is_software(name);
        if is_slow {
            skipped_once("too many steps for a GPU that a CPU plays");
        }
        !is_slow
    });
    devices
}

/// Those of [`quick_devices`] but ndarray, which takes three times as long as flex: for what hundreds of steps decide, where
/// backends differ by no more than rounding (`training/devices.rs` holds whole steps together, and other tests their parts).
#[must_use]
pub fn devices_for_long_trainings() -> Vec<(&'static str, Device)> {
    let mut devices = quick_devices();
    devices.retain(|(name, _)| {
        let is_slow = *name == "ndarray";
        if is_slow {
            skipped_once("a long training, which flex and GPUs make");
        }
        !is_slow
    });
    devices
}

/// Whether a backend's device is a GPU that a CPU plays.
fn is_software(name: &str) -> bool {
    RUNTIMES.contains(&name) && gpu(name).is_ok_and(|gpu| gpu.is_software)
}

/// [`skipped`] of the test that runs, once for each reason.
fn skipped_once(why: &str) {
    static SAID: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    let test = test_name();
    let mut said = SAID.lock().unwrap_or_else(PoisonError::into_inner);
    if said.insert(format!("{test}: {why}")) {
        skipped(&test, why);
    }
}

/// The test that runs: the harness names its thread so.
fn test_name() -> String {
    std::thread::current().name().unwrap_or("a test").to_owned()
}

/// Says that a test, or a part of it, could not run and why: on a line of its own past the test harness, which would keep it.
/// `cargo xtask ci` counts these lines.
pub fn skipped(test: &str, why: &str) {
    let line = format!("skipped: {test}: {why}\n");
    std::io::stderr().write_all(line.as_bytes()).ok();
}

#[cfg(feature = "ndarray")]
#[expect(deprecated, reason = "kept as a second, independent CPU backend")]
fn ndarray() -> Device {
    Device::ndarray()
}

/// What reaches GPUs in this build.
const RUNTIMES: &[&str] = &[
    #[cfg(feature = "wgpu")]
    "wgpu",
    #[cfg(feature = "cuda")]
    "cuda",
];

/// The adapter that `--backend` takes for a runtime: a GPU before a CPU that plays one. It is named once.
fn gpu(runtime: &str) -> Result<Gpu, NoGpu> {
    static FOUND: Mutex<BTreeMap<String, Result<Gpu, NoGpu>>> = Mutex::new(BTreeMap::new());
    let mut found = FOUND.lock().unwrap_or_else(PoisonError::into_inner);
    let look = || {
        let found = Gpu::best(runtime);
        if let Ok(gpu) = &found {
            let played = if gpu.is_software {
                ", played by the CPU"
            } else {
                ""
            };
            let line = format!("adapter: {}{played}\n", gpu.name);
            std::io::stderr().write_all(line.as_bytes()).ok();
        }
        found
    };
    let entry = found.entry(runtime.to_owned());
    entry.or_insert_with(look).clone()
}

/// A tensor of these values, rounded to `dtype`.
#[must_use]
pub fn tensor<const D: usize>(
    values: &[f64],
    shape: [usize; D],
    device: &Device,
    dtype: DType,
) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values.to_vec(), shape), (device, dtype))
}

/// A map of these values, with the shape, device and dtype of another.
#[must_use]
pub fn map_like(values: &[f32], like: &Tensor<2>) -> Tensor<2> {
    let data = TensorData::new(values.to_vec(), like.dims());
    Tensor::from_data(data, (&like.device(), like.dtype()))
}

/// A tensor's values, widened.
#[must_use]
pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f64> {
    tensor.into_data().iter::<f64>().collect()
}

/// Numbers in [-1, 1) that look random and are the same everywhere.
#[must_use]
pub fn noise(count: usize, seed: u64) -> Vec<f64> {
    let mut noise = Noise(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) + 1);
    (0..count).map(|_| noise.number()).collect()
}

/// The same, one after the other: Marsaglia's xorshift, by its state, which is not 0.
#[derive(Clone, Debug)]
pub struct Noise(pub u64);

impl Noise {
    /// The next one.
    pub fn number(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

/// Numbers in [0, 1) without a pattern, the same everywhere.
#[must_use]
pub fn unit_noise(count: usize, seed: usize) -> Vec<f64> {
    (0..count)
        .map(|i| ((i * 7919 + seed * 104_729 + i * i * 31) % 10_007) as f64 / 10_007.0)
        .collect()
}

/// As f32 holds them, so that f32 and f64 see the same.
#[must_use]
pub fn rounded(values: &[f64]) -> Vec<f64> {
    values.iter().map(|v| f64::from(*v as f32)).collect()
}

/// The largest of some errors by magnitude, 0 of none; NaN where one is, so that it keeps no bound.
#[must_use]
pub fn largest(errors: impl IntoIterator<Item = f64>) -> f64 {
    // A NaN with a sign would come first.
    let errors = errors.into_iter().map(f64::abs);
    errors.max_by(f64::total_cmp).unwrap_or(0.0)
}

/// Demands that `found` is no further from `expected` than `tolerance`, relative to the largest value.
///
/// # Panics
/// Where it is.
pub fn assert_close(what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{what}: as many values");
    let largest = expected.iter().fold(1e-30_f64, |max, v| max.max(v.abs()));
    for (k, (f, e)) in found.iter().zip(expected).enumerate() {
        let error = (f - e).abs() / largest;
        assert!(
            error <= tolerance,
            "{what}: {f} instead of {e} at {k}, off by {error:e} of {largest:e}"
        );
    }
}

/// Runs `f` where rayon has so many threads.
///
/// # Panics
/// Panics if the system refuses the threads.
pub fn in_pool<T: Send>(threads: usize, f: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("a pool of threads")
        .install(f)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_that_is_no_number_is_the_largest_wherever_it_stands() {
        assert_eq!(largest([]), 0.0);
        assert_eq!(largest([0.5, 2.0, 1.0]), 2.0);
        for nan in [f64::NAN, -f64::NAN] {
            for place in 0..3 {
                let mut errors = [1.0, f64::INFINITY, 0.0];
                errors[place] = nan;
                assert!(largest(errors).is_nan(), "{place}");
            }
        }
    }
}
