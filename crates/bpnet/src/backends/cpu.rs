//! Backends whose tensors lie in main memory share the kernels of [`crate::cpu`].

use std::borrow::Cow;

use burn::backend::{Backend, TensorMetadata as _, tensor::FloatTensor};
use burn::tensor::Shape;
use host::{HostBackend, HostFloat, tensor, with_float};

use crate::cpu::composite::{self, BlurSize};
use crate::cpu::conv::{ConvSize, conv};
use crate::cpu::conv_backward::conv_backward;
use crate::cpu::instance_norm;
use crate::cpu::predict::{self, Dense, PredictSize};
use crate::cpu::predict_backward::predict_backward;
use crate::cpu::upsample::{self, UpsampleSize};
use crate::encoding::axis_encoding;
use crate::ops::{BpNetBackwardOps, BpNetOps, PREDICTOR, Predictor};

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
                with_float!(input.dtype(), T => conv_on::<T, Self>(input, weight, bias, size, relu))
            }

            fn instance_norm(input: FloatTensor<Self>) -> FloatTensor<Self> {
                with_float!(input.dtype(), T => instance_norm_on::<T, Self>(input)).0
            }

            fn predict(predictor: Predictor<Self>, size: PredictSize) -> FloatTensor<Self> {
                with_float!(predictor.features.dtype(), T => predict_on::<T, Self>(predictor, size))
            }

            fn upsample(input: FloatTensor<Self>, size: UpsampleSize) -> FloatTensor<Self> {
                with_float!(input.dtype(), T => upsample_on::<T, Self>(input, size))
            }

            fn composite(image: FloatTensor<Self>, field: FloatTensor<Self>) -> FloatTensor<Self> {
                with_float!(image.dtype(), T => composite_on::<T, Self>(image, field))
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
                with_float!(input.dtype(), T => conv_backward_on::<T, Self>(input, weight, output, gradient, size, wanted))
            }

            fn instance_norm_saved(
                input: FloatTensor<Self>,
            ) -> (FloatTensor<Self>, FloatTensor<Self>) {
                with_float!(input.dtype(), T => instance_norm_on::<T, Self>(input))
            }

            fn instance_norm_backward(
                output: FloatTensor<Self>,
                scale: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
            ) -> FloatTensor<Self> {
                with_float!(output.dtype(), T => instance_norm_backward_on::<T, Self>(output, scale, gradient))
            }

            fn predict_backward(
                predictor: Predictor<Self>,
                output: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
                size: PredictSize,
                wanted: [bool; PREDICTOR],
            ) -> [Option<FloatTensor<Self>>; PREDICTOR] {
                with_float!(output.dtype(), T => predict_backward_on::<T, Self>(predictor, output, gradient, size, wanted))
            }

            fn upsample_backward(
                gradient: FloatTensor<Self>,
                size: UpsampleSize,
            ) -> FloatTensor<Self> {
                with_float!(gradient.dtype(), T => upsample_backward_on::<T, Self>(gradient, size))
            }

            fn composite_backward(
                image: FloatTensor<Self>,
                field: FloatTensor<Self>,
                gradient: FloatTensor<Self>,
                wanted: [bool; 2],
            ) -> [Option<FloatTensor<Self>>; 2] {
                with_float!(image.dtype(), T => composite_backward_on::<T, Self>(image, field, gradient, wanted))
            }
        }
    };
}
#[cfg(feature = "flex")]
host_ops!(burn::backend::Flex);
#[cfg(feature = "ndarray")]
host_ops!(burn::backend::NdArray);

/// Sizes of a field `[H, W, K * K + 1]`.
fn blur_size<B: Backend>(field: &FloatTensor<B>) -> BlurSize {
    let shape = field.shape();
    BlurSize {
        height: shape[0],
        width: shape[1],
        kernel: (shape[2] - 1).isqrt(),
    }
}

fn composite_on<T: HostFloat, B: HostBackend>(
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

fn composite_backward_on<T: HostFloat, B: HostBackend>(
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
fn with_predictor<T: HostFloat, B: HostBackend, R>(
    tensors: &mut [FloatTensor<B>; PREDICTOR],
    size: PredictSize,
    run: impl FnOnce(&predict::Predictor<'_, T>) -> R,
) -> R {
    let encoding = |length: usize| -> Vec<T> {
        let axis = axis_encoding(length);
        let values = axis.as_flattened().iter();
        values.map(|&v| T::of(f64::from(v))).collect()
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

fn predict_on<T: HostFloat, B: HostBackend>(
    predictor: Predictor<B>,
    size: PredictSize,
) -> FloatTensor<B> {
    let mut tensors = predictor.into_array();
    let output = with_predictor::<T, B, _>(&mut tensors, size, predict::predict);
    let shape = Shape::from([size.height, size.width, size.outputs()]);
    tensor::<T, B>(output, shape, &tensors[0])
}

fn predict_backward_on<T: HostFloat, B: HostBackend>(
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

fn upsample_on<T: HostFloat, B: HostBackend>(
    mut input: FloatTensor<B>,
    size: UpsampleSize,
) -> FloatTensor<B> {
    let output = upsample::upsample(&B::elements::<T>(&mut input), size);
    let shape = Shape::from([size.to[0], size.to[1], size.channels]);
    tensor::<T, B>(output, shape, &input)
}

fn upsample_backward_on<T: HostFloat, B: HostBackend>(
    mut gradient: FloatTensor<B>,
    size: UpsampleSize,
) -> FloatTensor<B> {
    let input_gradient = upsample::upsample_backward(&B::elements::<T>(&mut gradient), size);
    let shape = Shape::from([size.from[0], size.from[1], size.channels]);
    tensor::<T, B>(input_gradient, shape, &gradient)
}

fn conv_on<T: HostFloat, B: HostBackend>(
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

fn conv_backward_on<T: HostFloat, B: HostBackend>(
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

fn instance_norm_on<T: HostFloat, B: HostBackend>(
    mut input: FloatTensor<B>,
) -> (FloatTensor<B>, FloatTensor<B>) {
    let channels = input.shape()[1];
    let (output, scale) = instance_norm::instance_norm(&B::elements::<T>(&mut input), channels);
    (
        tensor::<T, B>(output, input.shape(), &input),
        tensor::<T, B>(scale, Shape::from([1, channels]), &input),
    )
}

fn instance_norm_backward_on<T: HostFloat, B: HostBackend>(
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
