//! Tensors as slices, without a copy where the backend allows.

#[cfg(feature = "flex")]
use burn::backend::{Flex, tensor::FloatTensor};
use burn::tensor::{DType, Element, Tensor, TensorData};

use crate::SplatError;
use crate::cpu::Real;

/// The float types that kernels and tensors share.
pub(crate) trait HostFloat: Real + Element {}
impl HostFloat for f32 {}
impl HostFloat for f64 {}

/// A tensor's values in host memory, contiguous.
#[derive(Clone, Debug)]
pub(crate) enum HostArray {
    /// Shares the tensor's buffer.
    #[cfg(feature = "flex")]
    Flex(FloatTensor<Flex>),
    /// Read from the device.
    Data(TensorData),
}

impl HostArray {
    pub(crate) fn read<const D: usize>(
        name: &'static str,
        tensor: &Tensor<D>,
    ) -> Result<Self, SplatError> {
        let tensor = tensor.clone().inner();
        #[cfg(feature = "flex")]
        if let Ok(flex) = tensor.clone().try_into_primitive::<Flex>() {
            return Ok(Self::Flex(flex.to_contiguous()));
        }
        tensor
            .try_into_data()
            .map(Self::Data)
            .map_err(|error| SplatError::Read {
                tensor: name,
                reason: error.to_string(),
            })
    }

    pub(crate) fn dtype(&self) -> DType {
        match self {
            #[cfg(feature = "flex")]
            Self::Flex(tensor) => tensor.dtype(),
            Self::Data(data) => data.dtype(),
        }
    }

    /// The values; the type must be the one that [`Self::dtype`] says.
    pub(crate) fn as_slice<T: HostFloat>(&self) -> &[T] {
        match self {
            #[cfg(feature = "flex")]
            Self::Flex(tensor) => tensor
                .as_slice()
                .expect("contiguous, and its type was checked"),
            Self::Data(data) => data.as_slice().expect("its type was checked"),
        }
    }
}
