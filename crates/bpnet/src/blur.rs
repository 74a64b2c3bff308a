//! The blur alone, without an intensity: every pixel a kernel of its own.

use burn::tensor::Tensor;

use crate::{BlurField, BpNetError, composite};

/// Blurs `image` `[H, W, 3]` with a kernel of its own at every pixel, `kernel` `[H, W, K * K]`:
///
/// `B(x) = Σ_j k_j(x) I(x + Δ_j) / Σ_j k_j(x)`, over those j for which `x + Δ_j` is inside the image
/// (so that borders do not darken), where `Δ_j = (kx - K/2, ky - K/2)` for `j = ky * K + kx`.
///
/// Both inputs have gradients. A pixel whose weights inside the image sum to less than 1e-12 keeps its
/// colour, and its kernel gets no gradient.
///
/// # Errors
/// [`BpNetError`] when K is not an odd number up to [`MAX_KERNEL_SIZE`](crate::MAX_KERNEL_SIZE), or when the inputs differ
/// in size or element type, or hold a value that is not finite.
pub fn blur(image: Tensor<3>, kernel: Tensor<3>) -> Result<Tensor<3>, BpNetError> {
    let [height, width, _] = kernel.dims();
    let intensity = Tensor::ones([height, width], (&kernel.device(), kernel.dtype()));
    Ok(composite(image, &BlurField::new(kernel, intensity)?)?.picture())
}
