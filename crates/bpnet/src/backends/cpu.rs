//! Backends whose tensors lie in main memory share the kernels of [`crate::cpu`].

use std::borrow::Cow;

use burn::backend::{Backend, TensorMetadata as _, tensor::FloatTensor};
use burn::tensor::{DType, Element, TensorData};

use crate::cpu::Real;
use crate::cpu::blur::{self, Size};
use crate::ops::{BlurBackwardOps, BlurOps};

/// How to get at the elements of a backend's tensors.
trait HostBackend: Backend {
    /// The elements in order; borrowed where they lie so already.
    fn elements<T: Real + Element + bytemuck::Pod>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]>;
}

#[cfg(feature = "flex")]
impl HostBackend for burn::backend::Flex {
    fn elements<T: Real + Element + bytemuck::Pod>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]> {
        *tensor = tensor.to_contiguous();
        Cow::Borrowed(
            tensor
                .as_slice()
                .expect("contiguous, and of the dtype that was matched"),
        )
    }
}

#[cfg(feature = "ndarray")]
#[expect(deprecated, reason = "kept as a second, independent CPU backend")]
impl HostBackend for burn::backend::NdArray {
    fn elements<T: Real + Element + bytemuck::Pod>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]> {
        let data = burn::tensor::read_sync(Self::float_into_data(tensor.clone()))
            .expect("reading main memory cannot fail");
        Cow::Owned(data.into_vec().expect("of the dtype that was matched"))
    }
}

/// Calls `$function::<T, B>` for the element type T of `$tensor`.
macro_rules! with_float {
    ($tensor:expr, $function:ident($($argument:expr),* $(,)?)) => {
        match $tensor.dtype() {
            DType::F32 => $function::<f32, Self>($($argument),*),
            DType::F64 => $function::<f64, Self>($($argument),*),
            other => unreachable!("{other:?} is refused by the op"),
        }
    };
}

macro_rules! host_ops {
    ($backend:ty) => {
        impl BlurOps for $backend {
            fn blur(image: FloatTensor<Self>, kernel: FloatTensor<Self>) -> FloatTensor<Self> {
                with_float!(image, blur_on(image, kernel))
            }
        }

        impl BlurBackwardOps for $backend {
            fn blur_backward(
                image: FloatTensor<Self>,
                kernel: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
                wanted: [bool; 2],
            ) -> [Option<FloatTensor<Self>>; 2] {
                with_float!(image, blur_backward_on(image, kernel, gradient, wanted))
            }
        }
    };
}
#[cfg(feature = "flex")]
host_ops!(burn::backend::Flex);
#[cfg(feature = "ndarray")]
host_ops!(burn::backend::NdArray);

fn blur_on<T: Real + Element + bytemuck::Pod, B: HostBackend>(
    mut image: FloatTensor<B>,
    mut kernel: FloatTensor<B>,
) -> FloatTensor<B> {
    let (shape, device, size) = (image.shape(), image.device(), size_of::<B>(&kernel));
    let output = blur::blur(
        &B::elements::<T>(&mut image),
        &B::elements::<T>(&mut kernel),
        size,
    );
    B::float_from_data(TensorData::new(output, shape), &device)
}

fn blur_backward_on<T: Real + Element + bytemuck::Pod, B: HostBackend>(
    mut image: FloatTensor<B>,
    mut kernel: FloatTensor<B>,
    mut gradient: FloatTensor<B>,
    wanted: [bool; 2],
) -> [Option<FloatTensor<B>>; 2] {
    let shapes = [image.shape(), kernel.shape()];
    let (device, size) = (image.device(), size_of::<B>(&kernel));
    let [image, kernel] = blur::blur_backward(
        &B::elements::<T>(&mut image),
        &B::elements::<T>(&mut kernel),
        &B::elements::<T>(&mut gradient),
        size,
        wanted,
    );
    let [image_shape, kernel_shape] = shapes;
    [(image, image_shape), (kernel, kernel_shape)].map(|(values, shape)| {
        values.map(|values| B::float_from_data(TensorData::new(values, shape), &device))
    })
}

/// Sizes of a kernel tensor `[H, W, K * K]`.
fn size_of<B: Backend>(kernel: &FloatTensor<B>) -> Size {
    let shape = kernel.shape();
    Size {
        height: shape[0],
        width: shape[1],
        kernel: shape[2].isqrt(),
    }
}
