use burn::tensor::{Tensor, activation, module, ops::ConvOptions};

use crate::net::Layer;

/// Channels of the extractor's input: colour, disparity, mask.
pub(crate) const INPUT_CHANNELS: usize = 5;
/// Channels of the scene features.
pub const FEATURE_CHANNELS: usize = 32;

/// Scene features `[H * W, 32]` of `scene` `[H * W, 5]`: 5x5 and 5x5 convolutions of 64 channels, each
/// with ReLU and instance norm, then a linear 3x3 one of 32. Borders are padded with zeros.
pub(crate) fn features(scene: Tensor<2>, size: [usize; 2], layers: &[Layer; 3]) -> Tensor<2> {
    let [first, second, third] = layers;
    let hidden = instance_norm(activation::relu(conv(scene, first, size, 5)));
    let hidden = instance_norm(activation::relu(conv(hidden, second, size, 5)));
    conv(hidden, third, size, 3)
}

/// Zero mean and unit (biased) variance per channel over the image.
fn instance_norm(input: Tensor<2>) -> Tensor<2> {
    let centered = input.clone() - input.mean_dim(0);
    let variance = (centered.clone() * centered.clone()).mean_dim(0);
    centered / (variance + 1e-5).sqrt()
}

/// `kernel x kernel` convolution of `[H * W, in]` to `[H * W, out]`, padded with zeros.
fn conv(input: Tensor<2>, layer: &Layer, [height, width]: [usize; 2], kernel: usize) -> Tensor<2> {
    let [pixels, inputs] = input.dims();
    let [outputs, _] = layer.weight.dims();
    let input = input.swap_dims(0, 1).reshape([1, inputs, height, width]);
    let weight = layer
        .weight
        .clone()
        .reshape([outputs, inputs, kernel, kernel]);
    let half = kernel / 2;
    let output = module::conv2d(
        input,
        weight,
        Some(layer.bias.clone().reshape([outputs])),
        ConvOptions::new([1, 1], [half, half], [1, 1], 1),
    );
    output.reshape([outputs, pixels]).swap_dims(0, 1)
}
