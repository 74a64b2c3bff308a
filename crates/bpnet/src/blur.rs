use burn::backend::Dispatch;
use burn::tensor::Tensor;

use crate::BpNetError;
use crate::ops::BpNetOps;

/// Largest side of a blur kernel, in pixels.
pub const MAX_KERNEL_SIZE: usize = 15;

/// Blurs `image` `[H, W, 3]` with a kernel of its own at every pixel, `kernel` `[H, W, K * K]`:
///
/// `B(x) = Σ_j k_j(x) I(x + Δ_j) / Σ_j k_j(x)`, over those j for which `x + Δ_j` is inside the image
/// (so that borders do not darken), where `Δ_j = (kx - K/2, ky - K/2)` for `j = ky * K + kx`.
///
/// Both inputs have gradients. A pixel whose weights inside the image sum to less than 1e-12 keeps its
/// colour, and its kernel gets no gradient.
///
/// # Errors
/// [`BpNetError`] when K is not an odd number up to [`MAX_KERNEL_SIZE`], or when the inputs differ
/// in size or element type, or hold a value that is not finite.
pub fn blur(image: Tensor<3>, kernel: Tensor<3>) -> Result<Tensor<3>, BpNetError> {
    let [height, width, entries] = kernel.dims();
    let size = entries.isqrt();
    if size * size != entries {
        return Err(BpNetError::Shape {
            name: "blur kernel",
            found: kernel.dims().to_vec(),
            expected: "[H, W, K * K]".to_owned(),
        });
    }
    BpNetError::check_kernel_size(size)?;
    BpNetError::check_shape("image", &image.dims(), &[height, width, 3])?;
    BpNetError::check_dtype("image", image.dtype())?;
    BpNetError::check_same_dtype("blur kernel", kernel.dtype(), image.dtype())?;
    BpNetError::check_finite("image", &image, 3)?;
    BpNetError::check_finite("blur kernel", &kernel, entries)?;
    Ok(Tensor::from_dispatch(<Dispatch as BpNetOps>::blur(
        image.into_dispatch(),
        kernel.into_dispatch(),
    )))
}
