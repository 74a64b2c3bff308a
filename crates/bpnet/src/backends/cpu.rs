//! Backends whose tensors lie in main memory share the kernels of [`crate::cpu`].

use std::borrow::Cow;

use burn::backend::{Backend, TensorMetadata as _, tensor::FloatTensor};
use burn::tensor::{DType, Element, Shape, TensorData};

use crate::cpu::Real;
use crate::cpu::composite::{self, BlurSize};
use crate::cpu::conv::{ConvSize, conv};
use crate::cpu::conv_backward::conv_backward;
use crate::cpu::instance_norm;
use crate::cpu::predict::{self, Dense, PredictSize};
use crate::cpu::predict_backward::predict_backward;
use crate::cpu::upsample::{self, UpsampleSize};
use crate::encoding::axis_encoding;
use crate::ops::{BpNetBackwardOps, BpNetOps, PREDICTOR, Predictor};

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
        use burn::backend::ndarray::NdArrayTensor;
        let tensor: &FloatTensor<Self> = tensor;
        // Reading a tensor through Burn copies it, value by value.
        let borrowed: Option<&[T]> = match tensor {
            NdArrayTensor::F32(storage) => storage.view().to_slice().map(bytemuck::cast_slice),
            NdArrayTensor::F64(storage) => storage.view().to_slice().map(bytemuck::cast_slice),
            _ => None,
        };
        if let Some(values) = borrowed {
            return Cow::Borrowed(values);
        }
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

            fn predict(predictor: Predictor<Self>, size: PredictSize) -> FloatTensor<Self> {
                let features = &predictor.features;
                with_float!(features, predict_on(predictor, size))
            }

            fn upsample(input: FloatTensor<Self>, size: UpsampleSize) -> FloatTensor<Self> {
                with_float!(input, upsample_on(input, size))
            }

            fn composite(image: FloatTensor<Self>, field: FloatTensor<Self>) -> FloatTensor<Self> {
                with_float!(image, composite_on(image, field))
            }
        }

        impl BpNetBackwardOps for $backend {
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

            fn predict_backward(
                predictor: Predictor<Self>,
                output: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
                size: PredictSize,
                wanted: [bool; PREDICTOR],
            ) -> [Option<FloatTensor<Self>>; PREDICTOR] {
                with_float!(
                    output,
                    predict_backward_on(predictor, output, gradient, size, wanted)
                )
            }

            fn upsample_backward(
                gradient: FloatTensor<Self>,
                size: UpsampleSize,
            ) -> FloatTensor<Self> {
                with_float!(gradient, upsample_backward_on(gradient, size))
            }

            fn composite_backward(
                image: FloatTensor<Self>,
                field: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
                wanted: [bool; 2],
            ) -> [Option<FloatTensor<Self>>; 2] {
                with_float!(image, composite_backward_on(image, field, gradient, wanted))
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

/// Sizes of a field `[H, W, K * K + 1]`.
fn blur_size<B: Backend>(field: &FloatTensor<B>) -> BlurSize {
    let shape = field.shape();
    BlurSize {
        height: shape[0],
        width: shape[1],
        kernel: (shape[2] - 1).isqrt(),
    }
}

fn composite_on<T: Real + Element, B: HostBackend>(
    mut image: FloatTensor<B>,
    mut field: FloatTensor<B>,
) -> FloatTensor<B> {
    let size = blur_size::<B>(&field);
    let output = composite::composite(
        &B::elements::<T>(&mut image),
        &B::elements::<T>(&mut field),
        size,
    );
    let shape = Shape::from([size.height, size.width, composite::CHANNELS]);
    tensor::<T, B>(output, shape, &image)
}

fn composite_backward_on<T: Real + Element, B: HostBackend>(
    mut image: FloatTensor<B>,
    mut field: FloatTensor<B>,
    mut gradient: FloatTensor<B>,
    wanted: [bool; 2],
) -> [Option<FloatTensor<B>>; 2] {
    let size = blur_size::<B>(&field);
    let [image_gradient, field_gradient] = composite::composite_backward(
        &B::elements::<T>(&mut image),
        &B::elements::<T>(&mut field),
        &B::elements::<T>(&mut gradient),
        size,
        wanted,
    );
    [
        image_gradient.map(|values| tensor::<T, B>(values, image.shape(), &image)),
        field_gradient.map(|values| tensor::<T, B>(values, field.shape(), &image)),
    ]
}

/// Calls `run` with a predictor on slices.
fn with_predictor<T: Real + Element, B: HostBackend, R>(
    tensors: &mut [FloatTensor<B>; PREDICTOR],
    size: PredictSize,
    run: impl FnOnce(&predict::Predictor<'_, T>) -> R,
) -> R {
    let encoding = |length: usize| -> Vec<T> {
        let axis = axis_encoding(length);
        let values = axis.as_flattened().iter();
        values.map(|&v| T::from_f64(f64::from(v))).collect()
    };
    let elements: [Cow<'_, [T]>; PREDICTOR] = tensors.each_mut().map(B::elements::<T>);
    let dense = |layer: usize| Dense {
        weight: &elements[1 + 2 * layer],
        bias: &elements[2 + 2 * layer],
    };
    run(&predict::Predictor {
        size,
        columns: &encoding(size.width),
        rows: &encoding(size.height),
        features: &elements[0],
        base: [dense(0), dense(1), dense(2)],
        kernel: dense(3),
        intensity: dense(4),
    })
}

fn predict_on<T: Real + Element, B: HostBackend>(
    predictor: Predictor<B>,
    size: PredictSize,
) -> FloatTensor<B> {
    let mut tensors = predictor.into_array();
    let output = with_predictor::<T, B, _>(&mut tensors, size, predict::predict);
    let shape = Shape::from([size.height, size.width, size.outputs()]);
    tensor::<T, B>(output, shape, &tensors[0])
}

fn predict_backward_on<T: Real + Element, B: HostBackend>(
    predictor: Predictor<B>,
    mut output: FloatTensor<B>,
    mut gradient: FloatTensor<B>,
    size: PredictSize,
    wanted: [bool; PREDICTOR],
) -> [Option<FloatTensor<B>>; PREDICTOR] {
    let mut tensors = predictor.into_array();
    let gradients = with_predictor::<T, B, _>(&mut tensors, size, |net| {
        predict_backward(
            net,
            &B::elements::<T>(&mut output),
            &B::elements::<T>(&mut gradient),
            wanted[0],
        )
    });
    let layers = gradients.layers.into_iter().flat_map(|(w, b)| [w, b]);
    let mut values = std::iter::once(gradients.features.unwrap_or_default()).chain(layers);
    let mut index = 0;
    tensors.map(|like| {
        let values = values.next().expect("a gradient for every tensor");
        let is_wanted = wanted[index];
        index += 1;
        is_wanted.then(|| tensor::<T, B>(values, like.shape(), &like))
    })
}

fn upsample_on<T: Real + Element, B: HostBackend>(
    mut input: FloatTensor<B>,
    size: UpsampleSize,
) -> FloatTensor<B> {
    let output = upsample::upsample(&B::elements::<T>(&mut input), size);
    let shape = Shape::from([size.to[0], size.to[1], size.channels]);
    tensor::<T, B>(output, shape, &input)
}

fn upsample_backward_on<T: Real + Element, B: HostBackend>(
    mut gradient: FloatTensor<B>,
    size: UpsampleSize,
) -> FloatTensor<B> {
    let input_gradient = upsample::upsample_backward(&B::elements::<T>(&mut gradient), size);
    let shape = Shape::from([size.from[0], size.from[1], size.channels]);
    tensor::<T, B>(input_gradient, shape, &gradient)
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
    let (output, scale) = instance_norm::instance_norm(&B::elements::<T>(&mut input), channels);
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
    let input_gradient = instance_norm::instance_norm_backward(
        &B::elements::<T>(&mut output),
        &B::elements::<T>(&mut scale),
        &B::elements::<T>(&mut gradient),
    );
    tensor::<T, B>(input_gradient, output.shape(), &output)
}
