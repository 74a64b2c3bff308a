//! The scene feature extractor f_scene: three layers, as in the paper. Sizes of kernels, width of the output and the instance
//! norm are the reference code's, which does not train it.

use burn::tensor::Tensor;

use crate::layers::{Layer, conv, instance_norm};

/// Channels of the extractor's input: colour, disparity, mask.
pub(crate) const INPUT_CHANNELS: usize = 5;
/// Channels of the scene features.
pub const FEATURE_CHANNELS: usize = 32;

/// Scene features `[H * W, 32]` of `scene` `[H * W, 5]`: 5x5 and 5x5 convolutions of 64 channels, each
/// with ReLU and instance norm (in this order), then a linear 3x3 one of 32. Borders are padded with
/// zeros.
pub(crate) fn features(scene: Tensor<2>, size: [usize; 2], layers: &[Layer; 3]) -> Tensor<2> {
    let [first, second, third] = layers;
    let hidden = instance_norm(conv(scene, first, size, 5, true));
    let hidden = instance_norm(conv(hidden, second, size, 5, true));
    conv(hidden, third, size, 3, false)
}
