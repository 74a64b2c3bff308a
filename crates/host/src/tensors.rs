//! Backends whose tensors lie in main memory, and the way from their tensors to slices and back.

#![cfg_attr(
    feature = "ndarray",
    expect(
        deprecated,
        reason = "NdArray is kept as a second, independent CPU backend"
    )
)]

use std::borrow::Cow;

use burn::backend::autodiff::{grads::Gradients, ops::Ops};
use burn::backend::{Backend, TensorMetadata as _, tensor::FloatTensor};
use burn::tensor::{Element, Shape, TensorData, read_sync};

use crate::Real;
use crate::read::said;
#[cfg(feature = "cube")]
use crate::read::waiting;

/// The float types that kernels and tensors share.
pub trait HostFloat: Real + Element {}
impl HostFloat for f32 {}
impl HostFloat for f64 {}

/// A backend whose tensors' elements can be had in main memory.
pub trait HostBackend: Backend {
    /// The elements in order; borrowed where they lie so already.
    ///
    /// # Panics
    /// If `T` is not the tensor's dtype.
    fn elements<T: HostFloat>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]>;

    /// The elements in order; without a copy where the buffer has no other owner.
    ///
    /// # Panics
    /// If `T` is not the tensor's dtype.
    fn into_elements<T: HostFloat>(tensor: FloatTensor<Self>) -> Vec<T> {
        copied::<T, Self>(tensor)
    }
}

fn copied<T: HostFloat, B: Backend>(tensor: FloatTensor<B>) -> Vec<T> {
    read_sync(B::float_into_data(tensor))
        .unwrap_or_else(|reason| panic!("the device failed: {}", said(reason)))
        .try_into_vec()
        .expect("of the dtype that was matched")
}

#[cfg(feature = "flex")]
impl HostBackend for burn::backend::Flex {
    fn elements<T: HostFloat>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]> {
        *tensor = tensor.to_contiguous();
        Cow::Borrowed(
            tensor
                .as_slice()
                .expect("contiguous, and of the dtype that was matched"),
        )
    }
}

#[cfg(feature = "ndarray")]
impl HostBackend for burn::backend::NdArray {
    fn elements<T: HostFloat>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]> {
        use burn::backend::ndarray::NdArrayTensor;
        let tensor: &FloatTensor<Self> = tensor;
        assert_eq!(
            tensor.dtype(),
            T::dtype(),
            "elements in the tensor's own dtype"
        );
        // Reading a tensor through Burn copies it, value by value.
        let borrowed: Option<&[T]> = match tensor {
            NdArrayTensor::F32(storage) => storage.view().to_slice().map(bytemuck::cast_slice),
            NdArrayTensor::F64(storage) => storage.view().to_slice().map(bytemuck::cast_slice),
            _ => None,
        };
        match borrowed {
            Some(values) => Cow::Borrowed(values),
            None => Cow::Owned(Self::into_elements(tensor.clone())),
        }
    }
}

/// A copy, and the device is waited for: for results that are a few numbers.
#[cfg(feature = "cube")]
impl HostBackend for burn_cubecl::CubeBackend {
    fn elements<T: HostFloat>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]> {
        Cow::Owned(Self::into_elements(tensor.clone()))
    }

    fn into_elements<T: HostFloat>(tensor: FloatTensor<Self>) -> Vec<T> {
        let _span = waiting();
        copied::<T, Self>(tensor)
    }
}

/// Evaluates `$body` with the type `$float` set to the one that `$dtype` names, f32 or f64.
///
/// # Panics
/// On any other dtype: the functions that users call refuse those before.
#[macro_export]
macro_rules! with_float {
    ($dtype:expr, $float:ident => $body:expr) => {
        match $dtype {
            ::burn::tensor::DType::F32 => {
                type $float = f32;
                $body
            }
            ::burn::tensor::DType::F64 => {
                type $float = f64;
                $body
            }
            other => panic!("kernels compute in f32 or f64, not in {other:?}"),
        }
    };
}

/// A tensor on the device of `like`.
pub fn tensor<T: Element, B: Backend>(
    values: Vec<T>,
    shape: impl Into<Shape>,
    like: &FloatTensor<B>,
) -> FloatTensor<B> {
    B::float_from_data(TensorData::new(values, shape), &like.device())
}

/// The way back of a node: `gradients` makes those of its parents of its state and its own, and is told which are wanted.
/// Each is added to that of its parent, for the parents that are tracked.
pub fn pass_back<B: Backend, S, const N: usize>(
    ops: Ops<S, N>,
    grads: &mut Gradients,
    gradients: impl FnOnce(S, FloatTensor<B>, [bool; N]) -> [Option<FloatTensor<B>>; N],
) {
    let gradient = grads.consume::<B>(&ops.node);
    let parents = ops.parents.map(|parent| parent.map(|node| node.id));
    let wanted = parents.each_ref().map(Option::is_some);
    let gradients = gradients(ops.state, gradient, wanted);
    for (parent, gradient) in parents.into_iter().zip(gradients) {
        if let (Some(parent), Some(gradient)) = (parent, gradient) {
            grads.register::<B>(parent, gradient);
        }
    }
}
