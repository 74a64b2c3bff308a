//! What can be wrong with a blur model or with what it is given.

use burn::tensor::{DType, Tensor};
use host::first_not_finite;
use thiserror::Error;

use crate::limits::{MAX_DOWNSCALE, MAX_KERNEL_SIZE};

/// What can be wrong with a blur model or with what it is given.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum BpNetError {
    /// The kernel's side is even, zero or above [`MAX_KERNEL_SIZE`].
    #[error("kernel size {kernel_size} must be odd and from 1 to {MAX_KERNEL_SIZE}")]
    KernelSize {
        /// The side that was asked for, in pixels.
        kernel_size: usize,
    },
    /// A scale out of its range.
    #[error(
        "features can be computed on a picture 1 to {MAX_DOWNSCALE} times smaller, not {downscale}"
    )]
    Downscale {
        /// What was asked for.
        downscale: usize,
    },
    /// The camera embedding would have no row.
    #[error("the camera embedding needs at least one training frame")]
    NoFrames,
    /// The model computes in f32 or f64 only.
    #[error("{name} is {dtype:?}: the blur model computes in f32 or f64")]
    DType {
        /// Which tensor.
        name: &'static str,
        /// Its element type.
        dtype: DType,
    },
    /// Two tensors that meet in one product differ in their element type.
    #[error("{name} is {found:?} but {expected:?} is needed: cast it first")]
    MixedDType {
        /// Which tensor.
        name: &'static str,
        /// Its element type.
        found: DType,
        /// The element type of what it meets.
        expected: DType,
    },
    /// A frame that has no row in the camera embedding.
    #[error("frame {frame} has no camera embedding: there are {num_frames} training frames")]
    Frame {
        /// Index that was asked for.
        frame: usize,
        /// Rows of the embedding.
        num_frames: usize,
    },
    /// A value is NaN or infinite.
    #[error("{name} holds a value that is not finite at index {row}")]
    NotFinite {
        /// Which tensor.
        name: &'static str,
        /// Where: row of a matrix, pixel (row by row) of a picture.
        row: usize,
    },
    /// A tensor of the wrong shape.
    #[error("{name} has shape {found:?}, expected {expected}")]
    Shape {
        /// Which tensor.
        name: &'static str,
        /// Its shape.
        found: Vec<usize>,
        /// The shape that fits the other inputs, in words.
        expected: String,
    },
}

impl BpNetError {
    /// Refuses a kernel size that the blur op is not made for.
    pub(crate) fn check_kernel_size(kernel_size: usize) -> Result<(), Self> {
        if kernel_size % 2 == 1 && kernel_size <= MAX_KERNEL_SIZE {
            Ok(())
        } else {
            Err(Self::KernelSize { kernel_size })
        }
    }

    /// Refuses element types other than f32 and f64.
    pub(crate) fn check_dtype(name: &'static str, dtype: DType) -> Result<(), Self> {
        match dtype {
            DType::F32 | DType::F64 => Ok(()),
            _ => Err(Self::DType { name, dtype }),
        }
    }

    /// Refuses a tensor whose element type is not the `expected` one.
    pub(crate) fn check_same_dtype(
        name: &'static str,
        found: DType,
        expected: DType,
    ) -> Result<(), Self> {
        if found == expected {
            Ok(())
        } else {
            Err(Self::MixedDType {
                name,
                found,
                expected,
            })
        }
    }

    /// Refuses a tensor [.., `width`] that holds a value which is not finite, and says in which row.
    pub(crate) fn check_finite<const D: usize>(
        name: &'static str,
        tensor: &Tensor<D>,
        width: usize,
    ) -> Result<(), Self> {
        match first_not_finite(tensor) {
            None => Ok(()),
            Some((at, _)) => Err(Self::NotFinite {
                name,
                row: at / width,
            }),
        }
    }

    /// Refuses a shape other than `expected`.
    pub(crate) fn check_shape(
        name: &'static str,
        found: &[usize],
        expected: &[usize],
    ) -> Result<(), Self> {
        if found == expected {
            Ok(())
        } else {
            Err(Self::Shape {
                name,
                found: found.to_vec(),
                expected: format!("{expected:?}"),
            })
        }
    }
}
