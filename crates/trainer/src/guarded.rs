//! Work on a device that may fail.

use crate::TrainError;
use burn::tensor::Device;

/// Does something on a device. Where a GPU fails, is lost or has no memory left, Burn panics: that is an error here.
#[cfg(feature = "cube")]
pub(crate) fn guarded<T>(
    device: &Device,
    work: impl FnOnce() -> Result<T, TrainError>,
) -> Result<T, TrainError> {
    use std::panic::{AssertUnwindSafe, catch_unwind};
    if !crate::gpu::is_gpu(device) {
        return work();
    }
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
        Err(TrainError::Device {
            reason: host::said(text.unwrap_or("it does not say why")),
        })
    })
}

/// As it is: main memory does not fail.
#[cfg(not(feature = "cube"))]
pub(crate) fn guarded<T>(
    _: &Device,
    work: impl FnOnce() -> Result<T, TrainError>,
) -> Result<T, TrainError> {
    work()
}
