//! Instance norm and enlargement.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{cubes, empty, flat, units};

use crate::cpu::upsample::UpsampleSize;
use crate::cube::instance_norm::{
    ROWS, Summand, TEAM, channels_kernel, normalize_backward_kernel, normalize_kernel,
    pieces_kernel,
};
use crate::cube::upsample::{upsample_backward_kernel, upsample_kernel};

/// A mean over the rows for each channel, or what [`Summand`] makes of it, `[1, C]`.
fn over_rows(values: &CubeTensor, other: &CubeTensor, summand: Summand) -> CubeTensor {
    let shape = values.meta.shape();
    let (rows, channels) = (shape[0], shape[1]);
    let client = &values.client;
    let number = rows.div_ceil(ROWS);
    let pieces = empty(values, [number, channels], DType::F32);
    let result = empty(values, [1, channels], DType::F32);
    let (count, dim) = units(client, number * channels);
    pieces_kernel::launch(
        client,
        count,
        dim,
        values.clone().into_buffer_arg(),
        other.clone().into_buffer_arg(),
        pieces.clone().into_buffer_arg(),
        channels,
        summand,
    );
    let (count, dim) = cubes(client, channels, TEAM);
    channels_kernel::launch(
        client,
        count,
        dim,
        pieces.into_buffer_arg(),
        result.clone().into_buffer_arg(),
        rows,
        summand,
    );
    result
}

/// The normalised input, and the reciprocals of the standard deviations.
pub(super) fn instance_norm(input: CubeTensor) -> (CubeTensor, CubeTensor) {
    let input = flat(input);
    let output = empty(&input, input.meta.shape(), DType::F32);
    let number = input.meta.num_elements();
    if number == 0 {
        let scale = empty(&input, [1, input.meta.shape()[1]], DType::F32);
        return (output, scale);
    }
    let mean = over_rows(&input, &input, Summand::Value);
    let scale = over_rows(&input, &mean, Summand::Deviation);
    let client = input.client.clone();
    let (count, dim) = units(&client, number);
    normalize_kernel::launch(
        &client,
        count,
        dim,
        input.into_buffer_arg(),
        mean.into_buffer_arg(),
        scale.clone().into_buffer_arg(),
        output.clone().into_buffer_arg(),
    );
    (output, scale)
}

pub(super) fn instance_norm_backward(
    output: CubeTensor,
    scale: CubeTensor,
    gradient: CubeTensor,
) -> CubeTensor {
    let [output, scale, gradient] = [output, scale, gradient].map(flat);
    let v_input = empty(&output, output.meta.shape(), DType::F32);
    let number = output.meta.num_elements();
    if number == 0 {
        return v_input;
    }
    let plain = over_rows(&gradient, &output, Summand::Value);
    let weighted = over_rows(&gradient, &output, Summand::Product);
    let client = output.client.clone();
    let (count, dim) = units(&client, number);
    normalize_backward_kernel::launch(
        &client,
        count,
        dim,
        output.into_buffer_arg(),
        scale.into_buffer_arg(),
        gradient.into_buffer_arg(),
        plain.into_buffer_arg(),
        weighted.into_buffer_arg(),
        v_input.clone().into_buffer_arg(),
    );
    v_input
}

pub(super) fn upsample(input: CubeTensor, size: UpsampleSize) -> CubeTensor {
    let UpsampleSize { from, to, channels } = size;
    let input = flat(input);
    let output = empty(&input, [to[0], to[1], channels], DType::F32);
    let number = output.meta.num_elements();
    if number > 0 {
        let client = input.client.clone();
        let (count, dim) = units(&client, number);
        upsample_kernel::launch(
            &client,
            count,
            dim,
            input.into_buffer_arg(),
            output.clone().into_buffer_arg(),
            from[0],
            from[1],
            to[0],
            to[1],
            channels,
        );
    }
    output
}

pub(super) fn upsample_backward(gradient: CubeTensor, size: UpsampleSize) -> CubeTensor {
    let UpsampleSize { from, to, channels } = size;
    let gradient = flat(gradient);
    let v_input = empty(&gradient, [from[0], from[1], channels], DType::F32);
    let number = v_input.meta.num_elements();
    if number > 0 {
        let client = gradient.client.clone();
        let (count, dim) = units(&client, number);
        upsample_backward_kernel::launch(
            &client,
            count,
            dim,
            gradient.into_buffer_arg(),
            v_input.clone().into_buffer_arg(),
            from[0],
            from[1],
            to[0],
            to[1],
            channels,
        );
    }
    v_input
}
