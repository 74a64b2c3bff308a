//! What the tests that cross crates share: the one list of devices and the f64 gradient check.

mod gradcheck;

pub use gradcheck::{GradLimits, check_gradients};

use burn::tensor::Device;

/// Every backend that is compiled in, by the name `--backend` gives it.
///
/// Each test of tensor code runs on every entry of this list.
#[must_use]
pub fn devices() -> Vec<(&'static str, Device)> {
    vec![
        #[cfg(feature = "flex")]
        ("flex", Device::flex()),
        #[cfg(feature = "ndarray")]
        ("ndarray", ndarray()),
    ]
}

#[cfg(feature = "ndarray")]
#[expect(deprecated, reason = "kept as a second, independent CPU backend")]
fn ndarray() -> Device {
    Device::ndarray()
}
