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

use crate::read;

/// Asked of the device, so that a tensor is read back only if the answer is bad.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Cube: cfg(feature = "cube"),
)]
pub(crate) trait FiniteOps: Backend {
    /// Numbers of values that are infinite or not a number, one for each part that the backend counts by itself.
    fn count_not_finite(values: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// Numbers of elements that are infinite or not a number, one for each part that the device counts by itself: on the device,
/// without a graph.
///
/// # Panics
/// Panics if the dtype is neither f32 nor f64; so do the other two.
#[must_use]
pub fn count_not_finite<const D: usize>(tensor: &Tensor<D>) -> Tensor<1> {
    let values = tensor.clone().inner().into_dispatch();
    Tensor::from_dispatch(<Dispatch as FiniteOps>::count_not_finite(values))
}

/// Whether all counts of [`count_not_finite`] are zero: the device is waited for once.
#[must_use]
pub fn all_zero(counts: Vec<Tensor<1>>) -> bool {
    if counts.is_empty() {
        return true;
    }
    let counts = read(Tensor::cat(counts, 0));
    counts.iter::<f64>().all(|count| count == 0.0)
}

/// Position, in row-major order, and value of the first element that is infinite or not a number.
///
/// The tensor is read back if there is one.
#[must_use]
pub fn first_not_finite<const D: usize>(tensor: &Tensor<D>) -> Option<(usize, f64)> {
    if all_zero(vec![count_not_finite(tensor)]) {
        return None;
    }
    let values = read(tensor.clone().inner());
    let mut values = values.iter::<f64>().enumerate();
    values.find(|(_, v)| !v.is_finite())
}

#[cfg(any(feature = "flex", feature = "ndarray"))]
mod cpu {
    use burn::backend::{TensorMetadata, tensor::FloatTensor};
    use rayon::prelude::*;

    use super::FiniteOps;
    use crate::{HostBackend, HostFloat, Real, tensor, with_float};

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

    fn count_on<T: HostFloat, B: HostBackend>(mut values: FloatTensor<B>) -> FloatTensor<B> {
        let count = T::of(count_not_finite(&B::elements::<T>(&mut values)) as f64);
        tensor::<T, B>(vec![count], [1], &values)
    }

    macro_rules! host_ops {
        ($backend:ty) => {
            impl FiniteOps for $backend {
                fn count_not_finite(values: FloatTensor<Self>) -> FloatTensor<Self> {
                    with_float!(TensorMetadata::dtype(&values), T => count_on::<T, Self>(values))
                }
            }
        };
    }
    #[cfg(feature = "flex")]
    host_ops!(burn::backend::Flex);
    #[cfg(feature = "ndarray")]
    host_ops!(burn::backend::NdArray);
}

#[cfg(feature = "cube")]
mod gpu {
    use burn::backend::tensor::FloatTensor;
    use burn::tensor::DType;
    use burn_cubecl::CubeBackend;

    use super::FiniteOps;
    use crate::cube::finite::{TEAM, count_kernel, parts};
    use crate::cube::{cubes, empty, flat};
    use crate::tensor;

    impl FiniteOps for CubeBackend {
        fn count_not_finite(values: FloatTensor<Self>) -> FloatTensor<Self> {
            let values = flat(values);
            let number = values.meta.num_elements();
            if number == 0 {
                return tensor::<f32, Self>(vec![0.0], [1], &values);
            }
            let parts = parts(number);
            let counts = empty(&values, [parts], DType::F32);
            let client = values.client.clone();
            let (count, dim) = cubes(&client, parts, TEAM);
            count_kernel::launch(
                &client,
                count,
                dim,
                values.into_buffer_arg(),
                counts.clone().into_buffer_arg(),
            );
            counts
        }
    }
}

#[cfg(all(test, feature = "flex"))]
mod tests {
    use super::*;
    use burn::tensor::{DType, Device, TensorData};

    #[test]
    fn the_first_that_is_no_number_is_found_wherever_it_lies() {
        let device = Device::flex().autodiff();
        for dtype in [DType::F32, DType::F64] {
            for (at, value) in [
                (0, f64::NAN),
                (70_000, f64::INFINITY),
                (99_999, f64::NEG_INFINITY),
            ] {
                let mut values = vec![1.0; 100_000];
                let tensor = |values: &[f64]| {
                    let data = TensorData::new(values.to_vec(), [1000, 100]);
                    Tensor::<2>::from_data(data, (&device, dtype)).require_grad()
                };
                assert_eq!(first_not_finite(&tensor(&values)), None);
                values[at] = value;
                values[99_999] = f64::NEG_INFINITY;
                let (position, found) = first_not_finite(&tensor(&values)).expect("one");
                assert_eq!(position, at);
                assert!(found.total_cmp(&value).is_eq() || found.is_nan() && value.is_nan());
            }
        }
    }
}
