//! Backends whose tensors lie in main memory share the kernels of [`crate::cpu`].

use std::borrow::Cow;

use burn::backend::{Backend, TensorMetadata as _, tensor::FloatTensor};
use burn::tensor::{DType, Element, Shape, TensorData};

use crate::cpu::Real;
use crate::cpu::blur::{self, BlurSize};
use crate::cpu::conv::{ConvSize, conv};
use crate::cpu::conv_backward::conv_backward;
use crate::cpu::rows;
use crate::ops::{BpNetBackwardOps, BpNetOps};

/// How to get at the elements of a backend's tensors.
trait HostBackend: Backend {
    /// The elements in order; borrowed where they lie so already.
    fn elements<T: Real + Element>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]>;
}

#[cfg(feature = "flex")]
impl HostBackend for burn::backend::Flex {
    fn elements<T: Real + Element>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]> {
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
    fn elements<T: Real + Element>(tensor: &mut FloatTensor<Self>) -> Cow<'_, [T]> {
        let data = burn::tensor::read_sync(
            <Self as burn::backend::ops::FloatTensorOps<Self>>::float_into_data(tensor.clone()),
        )
        .expect("reading main memory cannot fail");
        Cow::Owned(data.into_vec().expect("of the dtype that was matched"))
    }
}

/// Calls `$function::<T, Self>` for the element type T of `$tensor`.
macro_rules! with_float {
    ($tensor:ident, $function:ident($($argument:expr),*)) => {
        match $tensor.dtype() {
            DType::F32 => $function::<f32, Self>($($argument),*),
            DType::F64 => $function::<f64, Self>($($argument),*),
            other => unreachable!("{other:?} is refused before"),
        }
    };
}

macro_rules! host_ops {
    ($backend:ty) => {
        impl BpNetOps for $backend {
            fn blur(image: FloatTensor<Self>, kernel: FloatTensor<Self>) -> FloatTensor<Self> {
                with_float!(image, blur_on(image, kernel))
            }

            fn conv(
                input: FloatTensor<Self>,
                weight: FloatTensor<Self>,
                bias: FloatTensor<Self>,
                size: ConvSize,
                relu: bool,
            ) -> FloatTensor<Self> {
                with_float!(input, conv_on(input, weight, bias, size, relu))
            }

            fn instance_norm(input: FloatTensor<Self>) -> FloatTensor<Self> {
                with_float!(input, instance_norm_on(input)).0
            }

            fn softmax_rows(logits: FloatTensor<Self>) -> FloatTensor<Self> {
                with_float!(logits, softmax_rows_on(logits))
            }
        }

        impl BpNetBackwardOps for $backend {
            fn blur_backward(
                image: FloatTensor<Self>,
                kernel: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
                wanted: [bool; 2],
            ) -> [Option<FloatTensor<Self>>; 2] {
                with_float!(image, blur_backward_on(image, kernel, gradient, wanted))
            }

            fn conv_backward(
                input: FloatTensor<Self>,
                weight: FloatTensor<Self>,
                output: Option<FloatTensor<Self>>,
                gradient: FloatTensor<Self>,
                size: ConvSize,
                wanted: [bool; 3],
            ) -> [Option<FloatTensor<Self>>; 3] {
                with_float!(
                    input,
                    conv_backward_on(input, weight, output, gradient, size, wanted)
                )
            }

            fn instance_norm_saved(
                input: FloatTensor<Self>,
            ) -> (FloatTensor<Self>, FloatTensor<Self>) {
                with_float!(input, instance_norm_on(input))
            }

            fn instance_norm_backward(
                output: FloatTensor<Self>,
                scale: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
            ) -> FloatTensor<Self> {
                with_float!(output, instance_norm_backward_on(output, scale, gradient))
            }

            fn softmax_rows_backward(
                output: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
            ) -> FloatTensor<Self> {
                with_float!(output, softmax_rows_backward_on(output, gradient))
            }
        }
    };
}
#[cfg(feature = "flex")]
host_ops!(burn::backend::Flex);
#[cfg(feature = "ndarray")]
host_ops!(burn::backend::NdArray);

/// A tensor on the device of `like`.
fn tensor<T: Element, B: Backend>(
    values: Vec<T>,
    shape: Shape,
    like: &FloatTensor<B>,
) -> FloatTensor<B> {
    B::float_from_data(TensorData::new(values, shape), &like.device())
}

/// Sizes of a kernel tensor `[H, W, K * K]`.
fn blur_size<B: Backend>(kernel: &FloatTensor<B>) -> BlurSize {
    let shape = kernel.shape();
    BlurSize {
        height: shape[0],
        width: shape[1],
        kernel: shape[2].isqrt(),
    }
}

fn blur_on<T: Real + Element, B: HostBackend>(
    mut image: FloatTensor<B>,
    mut kernel: FloatTensor<B>,
) -> FloatTensor<B> {
    let size = blur_size::<B>(&kernel);
    let output = blur::blur(
        &B::elements::<T>(&mut image),
        &B::elements::<T>(&mut kernel),
        size,
    );
    tensor::<T, B>(output, image.shape(), &image)
}

fn blur_backward_on<T: Real + Element, B: HostBackend>(
    mut image: FloatTensor<B>,
    mut kernel: FloatTensor<B>,
    mut gradient: FloatTensor<B>,
    wanted: [bool; 2],
) -> [Option<FloatTensor<B>>; 2] {
    let size = blur_size::<B>(&kernel);
    let [image_gradient, kernel_gradient] = blur::blur_backward(
        &B::elements::<T>(&mut image),
        &B::elements::<T>(&mut kernel),
        &B::elements::<T>(&mut gradient),
        size,
        wanted,
    );
    [
        image_gradient.map(|values| tensor::<T, B>(values, image.shape(), &image)),
        kernel_gradient.map(|values| tensor::<T, B>(values, kernel.shape(), &image)),
    ]
}

fn conv_on<T: Real + Element, B: HostBackend>(
    mut input: FloatTensor<B>,
    mut weight: FloatTensor<B>,
    mut bias: FloatTensor<B>,
    size: ConvSize,
    relu: bool,
) -> FloatTensor<B> {
    let output = conv(
        &B::elements::<T>(&mut input),
        &B::elements::<T>(&mut weight),
        &B::elements::<T>(&mut bias),
        size,
        relu,
    );
    let shape = Shape::from([size.height * size.width, size.outputs]);
    tensor::<T, B>(output, shape, &input)
}

fn conv_backward_on<T: Real + Element, B: HostBackend>(
    mut input: FloatTensor<B>,
    mut weight: FloatTensor<B>,
    mut output: Option<FloatTensor<B>>,
    mut gradient: FloatTensor<B>,
    size: ConvSize,
    wanted: [bool; 3],
) -> [Option<FloatTensor<B>>; 3] {
    let [input_wanted, weight_wanted, bias_wanted] = wanted;
    let gradients = conv_backward(
        &B::elements::<T>(&mut input),
        &B::elements::<T>(&mut weight),
        output.as_mut().map(B::elements::<T>).as_deref(),
        &B::elements::<T>(&mut gradient),
        size,
        [input_wanted, weight_wanted || bias_wanted],
    );
    let (weight_gradient, bias_gradient) = gradients.weight_and_bias.unzip();
    let bias_shape = Shape::from([1, size.outputs]);
    [
        gradients
            .input
            .map(|values| tensor::<T, B>(values, input.shape(), &input)),
        weight_gradient.map(|values| tensor::<T, B>(values, weight.shape(), &input)),
        bias_gradient.map(|values| tensor::<T, B>(values, bias_shape, &input)),
    ]
}

fn instance_norm_on<T: Real + Element, B: HostBackend>(
    mut input: FloatTensor<B>,
) -> (FloatTensor<B>, FloatTensor<B>) {
    let channels = input.shape()[1];
    let (output, scale) = rows::instance_norm(&B::elements::<T>(&mut input), channels);
    (
        tensor::<T, B>(output, input.shape(), &input),
        tensor::<T, B>(scale, Shape::from([1, channels]), &input),
    )
}

fn instance_norm_backward_on<T: Real + Element, B: HostBackend>(
    mut output: FloatTensor<B>,
    mut scale: FloatTensor<B>,
    mut gradient: FloatTensor<B>,
) -> FloatTensor<B> {
    let input_gradient = rows::instance_norm_backward(
        &B::elements::<T>(&mut output),
        &B::elements::<T>(&mut scale),
        &B::elements::<T>(&mut gradient),
    );
    tensor::<T, B>(input_gradient, output.shape(), &output)
}

fn softmax_rows_on<T: Real + Element, B: HostBackend>(
    mut logits: FloatTensor<B>,
) -> FloatTensor<B> {
    let channels = logits.shape()[1];
    let output = rows::softmax(&B::elements::<T>(&mut logits), channels);
    tensor::<T, B>(output, logits.shape(), &logits)
}

fn softmax_rows_backward_on<T: Real + Element, B: HostBackend>(
    mut output: FloatTensor<B>,
    mut gradient: FloatTensor<B>,
) -> FloatTensor<B> {
    let channels = output.shape()[1];
    let input_gradient = rows::softmax_backward(
        &B::elements::<T>(&mut output),
        &B::elements::<T>(&mut gradient),
        channels,
    );
    tensor::<T, B>(input_gradient, output.shape(), &output)
}
