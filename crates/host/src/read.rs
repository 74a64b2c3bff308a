//! Values that come back to main memory.

use std::fmt::Display;

use burn::tensor::{Tensor, TensorData};
use tracing::span::EnteredSpan;
use tracing::trace_span;

/// Name of the span in which values come back from a device: all that was launched has to be done first, and nothing new is
/// launched meanwhile. Everything that reads a tensor does it in such a span, so that they can be counted.
pub const WAIT: &str = "wait";

/// Opens a span [`WAIT`].
pub fn waiting() -> EnteredSpan {
    trace_span!(WAIT).entered()
}

/// A tensor's values in main memory. The device is waited for.
///
/// # Errors
/// What the device says where it fails: it is lost, or had no memory for what was launched.
pub fn try_read<const D: usize>(tensor: Tensor<D>) -> Result<TensorData, String> {
    let _span = waiting();
    tensor.try_into_data().map_err(said)
}

/// What a device says of its failure, on one line.
pub fn said(error: impl Display) -> String {
    let text = error.to_string();
    let lines = text.lines().map(str::trim);
    let empty = ["", "Asked at:", "Caused by:", "No backtrace available"];
    let lines: Vec<&str> = lines.filter(|line| !empty.contains(line)).collect();
    lines.join("; ")
}

/// A tensor's values in main memory. The device is waited for.
///
/// # Panics
/// Where the device fails; see [`try_read`].
#[must_use]
pub fn read<const D: usize>(tensor: Tensor<D>) -> TensorData {
    try_read(tensor).unwrap_or_else(|reason| panic!("the device failed: {reason}"))
}
