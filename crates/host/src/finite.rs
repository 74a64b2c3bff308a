//! The question that every crate asks of tensors: is all of it a number?

#![cfg_attr(
    feature = "ndarray",
    allow(
        deprecated,
        reason = "NdArray is kept as a second, independent CPU backend"
    )
)]

use burn::backend::{Backend, Dispatch, backend_extension, tensor::FloatTensor};
use burn::tensor::Tensor;

/// Asked of the device, so that a tensor is read back only if the answer is bad.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
)]
pub(crate) trait FiniteOps: Backend {
    /// Number of values that are infinite or not a number.
    fn count_not_finite(values: FloatTensor<Self>) -> usize;
}

/// Position, in row-major order, and value of the first element that is infinite or not a number.
///
/// The device counts them; only if there is one is the tensor (f32 or f64) read back.
#[must_use]
pub fn first_not_finite<const D: usize>(tensor: &Tensor<D>) -> Option<(usize, f64)> {
    let values = tensor.clone().inner();
    if <Dispatch as FiniteOps>::count_not_finite(values.clone().into_dispatch()) == 0 {
        return None;
    }
    let values = values.into_data();
    values
        .iter::<f64>()
        .enumerate()
        .find(|(_, v)| !v.is_finite())
}

#[cfg(any(feature = "flex", feature = "ndarray"))]
mod cpu {
    use burn::backend::tensor::FloatTensor;
    use rayon::prelude::*;

    use super::FiniteOps;
    use crate::{HostBackend as _, Real, with_float};

    /// Values per task.
    const BLOCK: usize = 1 << 14;

    fn count_not_finite<T: Real>(values: &[T]) -> usize {
        // Without a branch per value, so that it runs at memory speed.
        let count = |block: &[T]| -> u32 { block.iter().map(|v| u32::from(!v.is_finite())).sum() };
        values
            .par_chunks(BLOCK)
            .map(|block| count(block) as usize)
            .sum()
    }

    macro_rules! host_ops {
        ($backend:ty) => {
            impl FiniteOps for $backend {
                fn count_not_finite(mut values: FloatTensor<Self>) -> usize {
                    with_float!(values.dtype(), T => count_not_finite(&Self::elements::<T>(&mut values)))
                }
            }
        };
    }
    #[cfg(feature = "flex")]
    host_ops!(burn::backend::Flex);
    #[cfg(feature = "ndarray")]
    host_ops!(burn::backend::NdArray);
}
