//! BP-Net behind the scene features.

use burn::tensor::{DType, Shape};
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use host::cube::{empty, flat, units};
use host::tensor;

use super::product::{Pixels, Target};
use crate::cpu::predict::{FEATURES, HIDDEN, PredictSize};
use crate::cube::predict::{ENCODING, encoding_kernel, field_kernel, heads_kernel, logits_kernel};
use crate::cube::product::Rows;
use crate::encoding::axis_encoding;
use crate::ops::{PREDICTOR, Predictor};

/// The network, with what its layers take in.
struct Net {
    weights: [CubeTensor; 3],
    /// What the layers take in, and the last hidden layer.
    inputs: [Pixels; 4],
    /// Both heads' weight and bias.
    heads: [CubeTensor; 2],
}

/// Encoding of every pixel, `[H * W, 16]`. (Sines of a GPU may be coarse: they come from main memory.)
fn encoding(size: PredictSize, like: &CubeTensor) -> CubeTensor {
    let axes: Vec<f32> = [size.width, size.height]
        .into_iter()
        .flat_map(|length| axis_encoding(length).into_flattened())
        .collect();
    let length = axes.len();
    let axes = tensor::<f32, CubeBackend>(axes, [length], like);
    let number = size.height * size.width * ENCODING;
    let encoding = empty(like, [size.height * size.width, ENCODING], DType::F32);
    let (cubes, dim) = units(&like.client, number);
    encoding_kernel::launch(
        &like.client,
        cubes,
        dim,
        axes.into_buffer_arg(),
        encoding.clone().into_buffer_arg(),
        size.width,
    );
    encoding
}

impl Net {
    /// Computes the hidden layers.
    fn new(predictor: Predictor<CubeBackend>, size: PredictSize) -> Self {
        let tensors = predictor.into_array().map(flat);
        let [
            features,
            weight0,
            bias0,
            weight1,
            bias1,
            weight2,
            bias2,
            kernel_weight,
            kernel_bias,
            intensity_weight,
            intensity_bias,
        ] = tensors;
        let pixels = |values: CubeTensor, channels: usize, joined: bool| Pixels {
            values,
            joined: joined.then(|| features.clone()),
            rows: Rows {
                kernel: 1,
                channels,
                joined: if joined { FEATURES } else { 0 },
            },
            size: [size.height, size.width],
        };
        let hidden = |input: &Pixels, weight: &CubeTensor, bias: &CubeTensor, joined: bool| {
            pixels(input.layer(weight, bias, HIDDEN, true), HIDDEN, joined)
        };
        let first = pixels(encoding(size, &features), ENCODING, true);
        let second = hidden(&first, &weight0, &bias0, size.shortcut);
        let third = hidden(&second, &weight1, &bias1, size.shortcut);
        let last = hidden(&third, &weight2, &bias2, false);

        let outputs = size.outputs();
        let heads = [HIDDEN, 1].map(|rows| empty(&features, [rows, outputs], DType::F32));
        let client = &features.client;
        let (cubes, dim) = units(client, (HIDDEN + 1) * outputs);
        heads_kernel::launch(
            client,
            cubes,
            dim,
            kernel_weight.into_buffer_arg(),
            kernel_bias.into_buffer_arg(),
            intensity_weight.into_buffer_arg(),
            intensity_bias.into_buffer_arg(),
            heads[0].clone().into_buffer_arg(),
            heads[1].clone().into_buffer_arg(),
            size.entries,
        );
        Self {
            weights: [weight0, weight1, weight2],
            inputs: [first, second, third, last],
            heads,
        }
    }
}

pub(super) fn predict(predictor: Predictor<CubeBackend>, size: PredictSize) -> CubeTensor {
    let (pixels, outputs) = (size.height * size.width, size.outputs());
    if pixels == 0 {
        let shape = [size.height, size.width, outputs];
        return empty(&predictor.features, shape, DType::F32);
    }
    let net = Net::new(predictor, size);
    let [weight, bias] = &net.heads;
    let field = net.inputs[3].layer(weight, bias, outputs, false);
    let client = field.client.clone();
    let (cubes, dim) = units(&client, pixels);
    field_kernel::launch(
        &client,
        cubes,
        dim,
        field.clone().into_buffer_arg(),
        size.entries,
    );
    let shape = Shape::from([size.height, size.width, outputs]);
    CubeTensor::new_contiguous(client, field.device, shape, field.handle, DType::F32)
}

pub(super) fn predict_backward(
    predictor: Predictor<CubeBackend>,
    output: CubeTensor,
    gradient: CubeTensor,
    size: PredictSize,
    wanted: [bool; PREDICTOR],
) -> [Option<CubeTensor>; PREDICTOR] {
    let (pixels, outputs) = (size.height * size.width, size.outputs());
    let net = Net::new(predictor, size);
    let [output, gradient] = [output, gradient].map(flat);
    let v_logits = empty(&output, [pixels, outputs], DType::F32);
    let client = output.client.clone();
    let (cubes, dim) = units(&client, pixels);
    logits_kernel::launch(
        &client,
        cubes,
        dim,
        output.into_buffer_arg(),
        gradient.into_buffer_arg(),
        v_logits.clone().into_buffer_arg(),
        size.entries,
    );
    let shape = [size.height, size.width];
    let of_heads = net.inputs[3].sums(&v_logits, outputs, size.entries);
    let mut upper = Pixels::plain(v_logits, outputs, shape).back(
        &net.heads[0],
        [HIDDEN, 0, HIDDEN],
        Target::Masked(&net.inputs[3].values),
    );
    let mut v_features: Option<CubeTensor> = None;
    let mut of_layers = Vec::with_capacity(3);
    for layer in [2, 1, 0] {
        let (input, weight) = (&net.inputs[layer], &net.weights[layer]);
        let [v_weight, v_bias, _, _] = input.sums(&upper, HIDDEN, HIDDEN);
        of_layers.push([v_weight, v_bias]);
        let above = Pixels::plain(upper.clone(), HIDDEN, shape);
        let taps = input.rows.taps();
        if wanted[0] && input.joined.is_some() {
            let target = v_features.as_ref().map_or(Target::New, Target::Added);
            let channels = [taps, input.rows.channels, FEATURES];
            v_features = Some(above.back(weight, channels, target));
        }
        if layer > 0 {
            upper = above.back(weight, [taps, 0, HIDDEN], Target::Masked(&input.values));
        }
    }
    let layers = of_layers.into_iter().rev().flatten().chain(of_heads);
    let mut all = std::iter::once(v_features).chain(layers.map(Some));
    wanted.map(|wanted| {
        all.next()
            .expect("a gradient for every tensor")
            .filter(|_| wanted)
    })
}
