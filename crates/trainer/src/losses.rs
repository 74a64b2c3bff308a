//! Losses on tensors. Each is a scalar of shape `[1]` and differentiable in its first tensor; what is
//! selected, trimmed or fitted is decided on detached values.

use crate::cpu::depth::NEAREST;
use crate::ops::{ImageLossOps, TrainerOps};
use burn::backend::Dispatch;
use burn::tensor::Tensor;

pub use crate::cpu::depth::{DisparityFit, fit_disparity};

/// Mean of all entries [R, …], row by row first: a sum over everything at once takes an order that depends on the number of
/// threads from 4,194,304 entries on.
#[must_use]
pub(crate) fn mean<const D: usize>(tensor: Tensor<D>) -> Tensor<1> {
    let shape = tensor.dims();
    let count: usize = shape.iter().product();
    let rows = tensor.reshape([shape[0], count / shape[0].max(1)]);
    sum(rows).div_scalar(count as f64)
}

/// Sum of all entries [R, C], in the same order.
fn sum(tensor: Tensor<2>) -> Tensor<1> {
    tensor.sum_dim(1).sum()
}

/// The image loss of 3D Gaussian Splatting: `(1 - beta) L1 + beta (1 - SSIM)`, with `beta` 0.2 by default.
///
/// `render` and `target` are [H, W, 3]; `target` is data and gets no gradient.
#[must_use]
pub fn photometric(render: Tensor<3>, target: Tensor<3>, beta: f64) -> Tensor<1> {
    l1_and_ssim(render, target, [1.0 - beta, -beta]) + beta
}

/// Mean SSIM of two pictures [H, W, 3]: 11x11 Gaussian window of sigma 1.5, zeros outside the picture, C1 = 0.01²,
/// C2 = 0.03², mean over pixels and channels. Shape `[1]`.
///
/// Differentiable in `a`; `b` is data.
///
/// # Panics
/// Panics if the shapes differ, if there are not three channels, or if the dtypes differ.
#[must_use]
pub fn ssim(a: Tensor<3>, b: &Tensor<3>) -> Tensor<1> {
    l1_and_ssim(a, b.clone(), [0.0, 1.0])
}

/// Mean absolute difference and mean SSIM of two pictures, each times its weight.
fn l1_and_ssim(a: Tensor<3>, b: Tensor<3>, weights: [f64; 2]) -> Tensor<1> {
    assert_eq!(a.dims(), b.dims(), "two pictures of one size");
    assert_eq!(a.dims()[2], 3, "pictures have three channels");
    let _span = tracing::trace_span!("image loss").entered();
    Tensor::from_dispatch(<Dispatch as ImageLossOps>::image_loss(
        a.into_dispatch(),
        b.into_dispatch(),
        weights,
    ))
}

/// L1 between the fine detail of two pictures [H, W, 3], summed over two scales: a pixel less the mean of its four neighbours,
/// one and two pixels away. Shape `[1]`.
///
/// Blur weakens fine detail most, so that what is left of it hardly shows in [`photometric`]; here it counts as much as what
/// is coarse. Differentiable in `render`; pictures too small for a scale have no loss there.
///
/// # Panics
/// Panics if the pictures differ in shape or have other channels than three.
#[must_use]
pub fn detail_loss(render: Tensor<3>, target: Tensor<3>) -> Tensor<1> {
    assert_eq!(render.dims(), target.dims(), "two pictures of one size");
    assert_eq!(render.dims()[2], 3, "pictures have three channels");
    let _span = tracing::trace_span!("detail loss").entered();
    Tensor::from_dispatch(<Dispatch as ImageLossOps>::detail_loss(
        render.into_dispatch(),
        target.into_dispatch(),
    ))
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

/// Huber loss between rendered and given disparity, times the scene size S; shape `[1]`.
///
/// With a difference d it is d² / 2r up to |d| = r, which is `round`, and |d| - r / 2 beyond. As L1, which it is for r = 0 (as in
/// the paper), it pushes a pixel as hard where depth is right as where it is wrong, so that Gaussians shake about a depth that is
/// exact, and what they show with them. (RESULTS.md, "Depth that is exact".)
///
/// `depth` [H, W] is Σ z α T and `alpha` [H, W] is Σ α T of the render, `given` [H, W] the depth of the input (scene units), zero,
/// negative or infinite where it is missing. The rendered depth is depth / alpha with alpha detached, so the gradient
/// goes to `depth` alone. Only pixels with alpha above 0.5 and a given depth count; depths have a floor of
/// 0.05 S. The given disparities are first brought to the rendered ones by [`fit_disparity`]. Zero where no pixel counts.
///
/// # Panics
/// Panics if the sizes do not agree, or the dtypes of `depth` and `alpha`.
#[must_use]
pub fn depth_loss(
    depth: Tensor<2>,
    alpha: &Tensor<2>,
    given: Tensor<2>,
    [scene_size, round]: [f64; 2],
) -> Tensor<1> {
    assert_eq!(depth.dims(), alpha.dims(), "depth and alpha of one render");
    assert_eq!(depth.dims(), given.dims(), "one given depth per pixel");
    let targets = <Dispatch as TrainerOps>::depth_targets(
        depth.clone().inner().into_dispatch(),
        alpha.clone().inner().into_dispatch(),
        given.inner().into_dispatch(),
        scene_size,
    );
    let [per_alpha, wanted, weight] =
        [targets.per_alpha, targets.wanted, targets.weight].map(Tensor::<2>::from_dispatch);
    // Pixels that do not count get the floor's disparity and a weight of zero.
    let nearest = NEAREST * scene_size;
    let rendered = (depth * per_alpha).clamp_min(nearest).recip() * scene_size;
    let difference = (rendered - wanted).abs();
    if round == 0.0 {
        return sum(difference * weight);
    }
    let least = difference.clone().clamp_max(round);
    sum(least.clone() * (difference - least / 2.0) * weight) / round
}

/// Differences of disparity (times S) that count in [`depth_shift_loss`]: larger ones are of depth edges.
const SHIFT_RANGE: f64 = 0.05;

/// Square of the mean difference between the rendered disparity and that of sparse points, times the scene size S; shape `[1]`.
///
/// [`depth_loss`] fits scale and shift of each frame's disparity, and so says nothing about how far away all is. Where frames
/// may be shifted (by the means of their paths, by offsets), pictures hardly say it either: what all disparities have in
/// common is a shift that goes with the camera's place. Sparse points know it well on average.
///
/// `points` [H, W] is their disparity times S ([`point_disparity`]), 0 where there is none. They count where alpha is above 0.5;
/// differences are clamped to 0.05. Zero where none counts.
///
/// # Panics
/// Panics if the sizes do not agree, or the dtypes of `depth` and `alpha`.
#[must_use]
pub fn depth_shift_loss(
    depth: Tensor<2>,
    alpha: &Tensor<2>,
    points: Tensor<2>,
    scene_size: f64,
) -> Tensor<1> {
    let dtype = depth.dtype();
    assert_eq!(depth.dims(), alpha.dims(), "depth and alpha of one render");
    assert_eq!(depth.dims(), points.dims(), "one disparity per pixel");
    let alpha = alpha.clone().detach();
    let counted = points.clone().greater_elem(0.0).float().cast(dtype);
    let counts = counted * alpha.clone().greater_elem(0.5).float().cast(dtype);
    let rendered = (depth / alpha.clamp_min(0.5)).clamp_min(NEAREST * scene_size);
    let difference = rendered.recip().mul_scalar(scene_size) - points;
    let total = sum(difference.clamp(-SHIFT_RANGE, SHIFT_RANGE) * counts.clone());
    (total / sum(counts).clamp_min(1.0)).square()
}

/// What [`depth_shift_loss`] compares with: the disparity of points at a z-depth, times the scene size S; 0 where there is none.
#[must_use]
pub fn point_disparity(points: &[f32], scene_size: f64) -> Vec<f32> {
    let near = NEAREST * scene_size;
    let disparity = |z: &f32| match *z > 0.0 {
        true => (scene_size / f64::from(*z).max(near)) as f32,
        false => 0.0,
    };
    points.iter().map(disparity).collect()
}

/// The band's width in pixels for a picture of this width: 2 at 256, in proportion, at least 1.
#[must_use]
pub fn mask_band(width: usize) -> usize {
    ((width + 64) / 128).max(1)
}

/// Trimmed L1 between the rendered dynamic mask and the given one, both [H, W].
///
/// Pixels within `band` pixels (in rows and columns) of the edge between inside (`target` above 0.5) and outside
/// carry no loss: blurred movers spill over it. Of the others the largest errors are left out, those above the 98 % quantile,
/// inside and outside **each by itself**: a mover under 2 % of the picture would otherwise have no loss.
/// Pixels that are not `valid` (the holes of an unseen view) carry none either.
/// The result is the mean over what is kept; zero where nothing is. Shape `[1]`.
///
/// # Panics
/// Panics if `target` is not [H, W], or `valid` does not have H W entries.
#[must_use]
pub fn mask_loss(
    rendered: Tensor<2>,
    target: Tensor<2>,
    valid: Option<&[bool]>,
    band: usize,
) -> Tensor<1> {
    let shape = rendered.dims();
    assert_eq!(shape, target.dims(), "one target per rendered pixel");
    assert!(
        valid.is_none_or(|valid| valid.len() == shape[0] * shape[1]),
        "one validity per rendered pixel"
    );
    let weight = Tensor::<2>::from_dispatch(<Dispatch as TrainerOps>::mask_weights(
        rendered.clone().inner().into_dispatch(),
        target.clone().inner().into_dispatch(),
        valid,
        band,
    ));
    sum((rendered - target).abs() * weight)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_band_grows_with_the_picture() {
        assert_eq!(
            [32, 128, 256, 512].map(mask_band),
            [1, 1, 2, 4],
            "two pixels at 256"
        );
    }
}
