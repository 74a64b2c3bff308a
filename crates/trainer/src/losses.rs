//! Losses on tensors. Each is a scalar of shape `[1]` and differentiable in its first tensor; what is
//! selected, trimmed or fitted is decided on detached values.

mod depth;
mod mask;
mod ssim;

pub use depth::{DisparityFit, depth_loss, fit_disparity};
pub use mask::{mask_band, mask_loss};
use ssim::l1_and_ssim;
pub use ssim::ssim;
pub(crate) use ssim::{WINDOW_EDGE, ssim_map};

use burn::tensor::Tensor;

/// Mean of all entries [R, …], row by row first: a sum over everything at once takes an order that depends on the number of
/// threads from 4,194,304 entries on.
#[must_use]
pub(crate) fn mean<const D: usize>(tensor: Tensor<D>) -> Tensor<1> {
    let shape = tensor.dims();
    let count: usize = shape.iter().product();
    let rows = tensor.reshape([shape[0], count / shape[0].max(1)]);
    rows.sum_dim(1).sum().div_scalar(count as f64)
}

/// The image loss of 3D Gaussian Splatting: `(1 - beta) L1 + beta (1 - SSIM)`, with `beta` 0.2 by default.
///
/// `render` and `target` are [H, W, 3]; `target` is data and gets no gradient.
#[must_use]
pub fn photometric(render: Tensor<3>, target: Tensor<3>, beta: f64) -> Tensor<1> {
    l1_and_ssim(render, &target, [1.0 - beta, -beta]) + beta
}

/// L1 between the sharp render and the blurry frame after both are averaged over blocks of `factor` x `factor` pixels.
///
/// Both are [H, W, 3]. Rows and columns that fill no block are left out; a picture smaller than one block is averaged whole.
///
/// # Panics
/// Panics if `factor` is zero or the pictures differ in shape.
#[must_use]
pub fn downsample_loss(sharp: Tensor<3>, blurry: Tensor<3>, factor: usize) -> Tensor<1> {
    assert!(factor > 0, "a block has at least one pixel");
    let [height, width, channels] = sharp.dims();
    assert_eq!(
        blurry.dims(),
        [height, width, channels],
        "two pictures of one size"
    );
    let (block_h, block_w) = (factor.min(height), factor.min(width));
    let (rows, columns) = (height / block_h, width / block_w);
    // Averaging is linear: one pass over the difference.
    let blocks = (sharp - blurry)
        .slice([0..rows * block_h, 0..columns * block_w])
        .reshape([rows, block_h, columns, block_w * channels])
        .mean_dim(1)
        .reshape([rows * columns, block_w, channels])
        .mean_dim(1);
    mean(blocks.abs())
}

/// Mean blur intensity, which draws the intensities to "sharp".
#[must_use]
pub fn intensity_penalty<const D: usize>(intensity: Tensor<D>) -> Tensor<1> {
    mean(intensity)
}
