//! Convolutions.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{empty, flat, units};

use super::product::{Pixels, Target};
use crate::cpu::conv::ConvSize;
use crate::cube::conv::relu_backward_kernel;
use crate::cube::product::Rows;

/// A picture whose pixels' rows are windows.
fn windows(values: CubeTensor, channels: usize, size: ConvSize) -> Pixels {
    Pixels {
        values,
        joined: None,
        rows: Rows {
            kernel: size.kernel,
            channels,
            joined: 0,
        },
        size: [size.height, size.width],
    }
}

pub(super) fn conv(
    input: CubeTensor,
    weight: CubeTensor,
    bias: CubeTensor,
    size: ConvSize,
    relu: bool,
) -> CubeTensor {
    let [input, weight, bias] = [input, weight, bias].map(flat);
    windows(input, size.inputs, size).layer(&weight, &bias, size.outputs, relu)
}

pub(super) fn conv_backward(
    input: CubeTensor,
    weight: CubeTensor,
    output: Option<CubeTensor>,
    gradient: CubeTensor,
    size: ConvSize,
    [input_wanted, weight_wanted, bias_wanted]: [bool; 3],
) -> [Option<CubeTensor>; 3] {
    let [input, weight, gradient] = [input, weight, gradient].map(flat);
    let gradient = match output {
        Some(output) => masked(gradient, flat(output)),
        None => gradient,
    };
    let v_input = input_wanted.then(|| {
        windows(gradient.clone(), size.outputs, size).back(
            &weight,
            [size.inputs, 0, size.inputs],
            Target::New,
        )
    });
    let (v_weight, v_bias) = (weight_wanted || bias_wanted)
        .then(|| {
            let windows = windows(input, size.inputs, size);
            let [weight, bias, _, _] = windows.sums(&gradient, size.outputs, size.outputs);
            (weight, bias)
        })
        .unzip();
    [v_input, v_weight, v_bias]
}

/// The gradient where ReLU let through.
fn masked(gradient: CubeTensor, output: CubeTensor) -> CubeTensor {
    let masked = empty(&gradient, gradient.meta.shape(), DType::F32);
    let number = gradient.meta.num_elements();
    if number > 0 {
        let client = gradient.client.clone();
        let (cubes, dim) = units(&client, number);
        relu_backward_kernel::launch(
            &client,
            cubes,
            dim,
            gradient.into_buffer_arg(),
            output.into_buffer_arg(),
            masked.clone().into_buffer_arg(),
        );
    }
    masked
}
