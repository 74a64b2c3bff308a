//! The one place where tensors meet slices: a float type, and leaves made from edited values.

use burn::tensor::{DType, Element, Tensor, TensorData};
use pulp::{Simd, WithSimd};
use std::ops::{Add, AddAssign, Div, Mul, Neg, Sub};

/// `f32` or `f64`: what the kernels of this crate compute with.
pub(crate) trait Real:
    Element
    + Default
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
{
    /// The nearest value of this type.
    fn of(value: f64) -> Self;
    /// The value in f64.
    fn wide(self) -> f64;
    /// Square root.
    fn root(self) -> Self;
    /// Magnitude.
    fn magnitude(self) -> Self;
    /// Whether the value is neither infinite nor not a number.
    fn finite(self) -> bool;
}

macro_rules! real {
    ($float:ty) => {
        impl Real for $float {
            #[inline(always)]
            fn of(value: f64) -> Self {
                value as Self
            }
            #[inline(always)]
            fn wide(self) -> f64 {
                f64::from(self)
            }
            #[inline(always)]
            fn root(self) -> Self {
                self.sqrt()
            }
            #[inline(always)]
            fn magnitude(self) -> Self {
                self.abs()
            }
            #[inline(always)]
            fn finite(self) -> bool {
                self.is_finite()
            }
        }
    };
}
real!(f32);
real!(f64);

/// Runs `$body` with the type `$float` set to the one that `$dtype` names.
macro_rules! with_real {
    ($dtype:expr, $float:ident => $body:expr) => {
        match $dtype {
            burn::tensor::DType::F32 => {
                type $float = f32;
                $body
            }
            burn::tensor::DType::F64 => {
                type $float = f64;
                $body
            }
            other => panic!("the trainer computes in f32 or f64, not in {other:?}"),
        }
    };
}
pub(crate) use with_real;

/// Runs `work` with the machine's vectors. (pulp takes closures as they are too, but calls them in a way that is not always
/// inlined, and what is not knows nothing of the vectors.)
pub(crate) fn vectorized<R>(work: impl FnMut() -> R) -> R {
    struct Work<F>(F);
    impl<R, F: FnMut() -> R> WithSimd for Work<F> {
        type Output = R;
        #[inline(always)]
        fn with_simd<S: Simd>(mut self, _: S) -> R {
            (self.0)()
        }
    }
    pulp::Arch::new().dispatch(Work(work))
}

/// The tensor's values, row-major, without a copy where the buffer has no other owner.
///
/// # Panics
/// Panics if `T` is not the tensor's dtype.
pub(crate) fn values<T: Real, const D: usize>(tensor: Tensor<D>) -> Vec<T> {
    tensor
        .inner()
        .into_data()
        .try_into_vec::<T>()
        .expect("the caller chose the type by the tensor's dtype")
}

/// The tensor's values in f64, row-major.
pub(crate) fn wide_values<const D: usize>(tensor: &Tensor<D>) -> Vec<f64> {
    let tensor = tensor.clone();
    match tensor.dtype() {
        DType::F64 => values::<f64, D>(tensor),
        _ => tensor
            .inner()
            .into_data_as::<f64>()
            .try_into_vec::<f64>()
            .expect("converted to f64 just now"),
    }
}

/// A constant of `like`'s shape, device (without autodiff) and dtype.
pub(crate) fn constant_like<T: Real, const D: usize>(
    values: Vec<T>,
    like: &Tensor<D>,
) -> Tensor<D> {
    Tensor::from_data(
        TensorData::new(values, like.dims()),
        (&like.device().inner(), like.dtype()),
    )
}

/// `tensor` as a new leaf that keeps its gradient if `autodiff`, else as it is.
pub(crate) fn leaf(tensor: Tensor<2>, autodiff: bool) -> Tensor<2> {
    if autodiff {
        tensor.autodiff().require_grad()
    } else {
        tensor
    }
}
