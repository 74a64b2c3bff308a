//! GPUs, by the kernels of [`crate::cube`].

mod conv;
mod layers;
mod predict;
mod product;

use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{empty, flat, units};

use crate::cpu::composite::{BlurSize, CHANNELS};
use crate::cpu::conv::ConvSize;
use crate::cpu::predict::PredictSize;
use crate::cpu::upsample::UpsampleSize;
use crate::cube::composite::{GATHERED, composite_kernel, field_kernel, image_kernel};
use crate::ops::{BpNetBackwardOps, BpNetOps, PREDICTOR, Predictor};

/// Sizes of a field `[H, W, K * K + 1]`.
fn blur_size(field: &CubeTensor) -> BlurSize {
    let shape = field.meta.shape();
    BlurSize {
        height: shape[0],
        width: shape[1],
        kernel: (shape[2] - 1).isqrt(),
    }
}

pub(super) fn composite(image: CubeTensor, field: CubeTensor) -> CubeTensor {
    let [image, field] = [image, field].map(flat);
    let BlurSize {
        height,
        width,
        kernel,
    } = blur_size(&field);
    let output = empty(&image, [height, width, CHANNELS], DType::F32);
    if height * width == 0 {
        return output;
    }
    let client = image.client.clone();
    let (cubes, dim) = units(&client, height * width);
    composite_kernel::launch(
        &client,
        cubes,
        dim,
        image.into_buffer_arg(),
        field.into_buffer_arg(),
        output.clone().into_buffer_arg(),
        height,
        width,
        kernel,
    );
    output
}

pub(super) fn composite_backward(
    image: CubeTensor,
    field: CubeTensor,
    gradient: CubeTensor,
    [image_wanted, field_wanted]: [bool; 2],
) -> [Option<CubeTensor>; 2] {
    let [image, field, gradient] = [image, field, gradient].map(flat);
    let BlurSize {
        height,
        width,
        kernel,
    } = blur_size(&field);
    let v_image = empty(&image, image.meta.shape(), DType::F32);
    // One element where it is not wanted: nothing is written there.
    let v_field = if field_wanted {
        empty(&image, field.meta.shape(), DType::F32)
    } else {
        empty(&image, [1], DType::F32)
    };
    if height * width > 0 {
        let client = image.client.clone();
        let gathered = empty(&image, [height * width, GATHERED], DType::F32);
        let (cubes, dim) = units(&client, height * width);
        field_kernel::launch(
            &client,
            cubes.clone(),
            dim,
            image.into_buffer_arg(),
            field.clone().into_buffer_arg(),
            gradient.clone().into_buffer_arg(),
            gathered.clone().into_buffer_arg(),
            v_field.clone().into_buffer_arg(),
            height,
            width,
            kernel,
            field_wanted,
        );
        if image_wanted {
            image_kernel::launch(
                &client,
                cubes,
                dim,
                field.into_buffer_arg(),
                gradient.into_buffer_arg(),
                gathered.into_buffer_arg(),
                v_image.clone().into_buffer_arg(),
                height,
                width,
                kernel,
            );
        }
    }
    [
        image_wanted.then_some(v_image),
        field_wanted.then_some(v_field),
    ]
}

type Tensor = CubeTensor;

impl BpNetOps for CubeBackend {
    fn conv(input: Tensor, weight: Tensor, bias: Tensor, size: ConvSize, relu: bool) -> Tensor {
        conv::conv(input, weight, bias, size, relu)
    }

    fn instance_norm(input: Tensor) -> Tensor {
        layers::instance_norm(input).0
    }

    fn predict(predictor: Predictor<Self>, size: PredictSize) -> Tensor {
        predict::predict(predictor, size)
    }

    fn upsample(input: Tensor, size: UpsampleSize) -> Tensor {
        layers::upsample(input, size)
    }

    fn composite(image: Tensor, field: Tensor) -> Tensor {
        composite(image, field)
    }
}

impl BpNetBackwardOps for CubeBackend {
    fn conv_backward(
        input: Tensor,
        weight: Tensor,
        output: Option<Tensor>,
        gradient: Tensor,
        size: ConvSize,
        wanted: [bool; 3],
    ) -> [Option<Tensor>; 3] {
        conv::conv_backward(input, weight, output, gradient, size, wanted)
    }

    fn instance_norm_saved(input: Tensor) -> (Tensor, Tensor) {
        layers::instance_norm(input)
    }

    fn instance_norm_backward(output: Tensor, scale: Tensor, gradient: Tensor) -> Tensor {
        layers::instance_norm_backward(output, scale, gradient)
    }

    fn predict_backward(
        predictor: Predictor<Self>,
        output: Tensor,
        gradient: Tensor,
        size: PredictSize,
        wanted: [bool; PREDICTOR],
    ) -> [Option<Tensor>; PREDICTOR] {
        predict::predict_backward(predictor, output, gradient, size, wanted)
    }

    fn upsample_backward(gradient: Tensor, size: UpsampleSize) -> Tensor {
        layers::upsample_backward(gradient, size)
    }

    fn composite_backward(
        image: Tensor,
        field: Tensor,
        gradient: Tensor,
        wanted: [bool; 2],
    ) -> [Option<Tensor>; 2] {
        composite_backward(image, field, gradient, wanted)
    }
}
