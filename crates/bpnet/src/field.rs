//! What BP-Net predicts, and the picture that the camera saw by it: B = m (k * I) + (1 - m) I, with the paper's kernels k and
//! blur intensities m. The reference code pads with black; here the weights inside the picture are scaled to sum to 1. And L_spa, the
//! paper's kernel sparsity loss.

use burn::backend::Dispatch;
use burn::tensor::{DType, Device, Tensor, TensorData};

use crate::BpNetError;
use crate::layers::{constant, sigmoid};
use crate::ops::BpNetOps;

/// How every pixel of one frame was blurred: a kernel and an intensity.
#[derive(Clone, Debug)]
pub struct BlurField {
    /// Kernel and intensity, `[H, W, K * K + 1]`.
    values: Tensor<3>,
}

impl BlurField {
    /// A field from kernels `[H, W, K * K]` and intensities `[H, W]`.
    ///
    /// # Errors
    /// [`BpNetError`] when the shapes do not fit, K is not an odd number up to
    /// [`MAX_KERNEL_SIZE`](crate::MAX_KERNEL_SIZE), or the element types differ.
    pub fn new(kernel: Tensor<3>, intensity: Tensor<2>) -> Result<Self, BpNetError> {
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
        BpNetError::check_shape("blur intensity", &intensity.dims(), &[height, width])?;
        BpNetError::check_dtype("blur kernel", kernel.dtype())?;
        BpNetError::check_same_dtype("blur intensity", intensity.dtype(), kernel.dtype())?;
        Ok(Self::from_values(Tensor::cat(
            vec![kernel, intensity.unsqueeze_dim::<3>(2)],
            2,
        )))
    }

    /// A field from kernel and intensity of every pixel, `[H, W, K * K + 1]`.
    pub(crate) fn from_values(values: Tensor<3>) -> Self {
        Self { values }
    }

    /// Blur kernel of each pixel, `[H, W, K * K]`; as BP-Net predicts it not negative, with a sum of 1.
    /// Entry `ky * K + kx` weighs the pixel at `(y + ky - K/2, x + kx - K/2)`.
    #[must_use]
    pub fn kernel(&self) -> Tensor<3> {
        let [_, _, values] = self.values.dims();
        self.values.clone().narrow(2, 0, values - 1)
    }

    /// Blur intensity m of each pixel, `[H, W]`, from 0 (sharp) to 1.
    #[must_use]
    pub fn intensity(&self) -> Tensor<2> {
        let [_, _, values] = self.values.dims();
        self.values.clone().narrow(2, values - 1, 1).squeeze_dim(2)
    }
}

/// What the camera saw, and sums over the kernels that losses want. All of them lead back to the image
/// and to the field.
#[derive(Clone, Debug)]
pub struct Composite {
    /// `[H, W, 7]`.
    values: Tensor<3>,
}

impl Composite {
    /// `m * blur(image) + (1 - m) * image`, `[H, W, 3]`.
    #[must_use]
    pub fn picture(&self) -> Tensor<3> {
        self.values.clone().narrow(2, 0, 3)
    }

    /// Where the blur moves each pixel's light on average: `m Σ k Δ`, `[H, W, 2]`, in pixels, x before y.
    #[must_use]
    pub fn centroid(&self) -> Tensor<3> {
        self.values.clone().narrow(2, 3, 2)
    }

    /// Weight of the pixel itself in its kernel, `[H, W]`.
    #[must_use]
    pub fn center_weight(&self) -> Tensor<2> {
        self.values.clone().narrow(2, 5, 1).squeeze_dim(2)
    }

    /// Blur intensity m of each pixel, `[H, W]`.
    #[must_use]
    pub fn intensity(&self) -> Tensor<2> {
        self.values.clone().narrow(2, 6, 1).squeeze_dim(2)
    }
}

/// Blurs an image [H, W, 3] as a field says.
///
/// # Errors
/// [`BpNetError`] when image and field differ in size or element type, or hold a value that is not finite.
pub fn composite(image: Tensor<3>, field: &BlurField) -> Result<Composite, BpNetError> {
    let composite = composite_trusted(image.clone(), field)?;
    let entries = field.values.dims()[2];
    // What is not finite in the inputs is not finite here, and this is smaller.
    if BpNetError::check_finite("picture", &composite.values, 7).is_err() {
        BpNetError::check_finite("image", &image, 3)?;
        BpNetError::check_finite("blur kernel", &field.kernel(), entries - 1)?;
        BpNetError::check_finite("blur intensity", &field.intensity(), 1)?;
    }
    Ok(composite)
}

/// As [`composite`], but trusts that all values are finite: what is not gives a picture that is not. The device is not waited
/// for.
///
/// # Errors
/// [`BpNetError`] when image and field differ in size or element type.
pub fn composite_trusted(image: Tensor<3>, field: &BlurField) -> Result<Composite, BpNetError> {
    let [height, width, _] = field.values.dims();
    BpNetError::check_shape("image", &image.dims(), &[height, width, 3])?;
    BpNetError::check_dtype("image", image.dtype())?;
    BpNetError::check_same_dtype("blur kernel", field.values.dtype(), image.dtype())?;
    let values = Tensor::from_dispatch(<Dispatch as BpNetOps>::composite(
        image.into_dispatch(),
        field.values.clone().into_dispatch(),
    ));
    Ok(Composite { values })
}

/// L_spa, the kernel sparsity loss: mean of `|sigmoid(5 (1 - m)) - k_centre|` over the pixels, for centre
/// weights and intensities [H, W], m held constant. It pulls the kernel of a pixel that is not blurred to a delta.
#[must_use]
pub fn kernel_center_loss(center_weight: Tensor<2>, intensity: Tensor<2>) -> Tensor<1> {
    let target = sigmoid((constant(intensity) - 1.0) * -5.0);
    (target - center_weight).abs().mean_dim(1).mean()
}

/// Means of a map `[H, W, C]` over the cells of a grid, `[rows * cols, C]`, row by row.
///
/// Cell i of n covers the pixels from `floor(i L / n)` to `ceil((i + 1) L / n)`, so that it is never
/// empty, whatever the size (adaptive average pooling). A GPU with matrix units may round the values that it averages, by 2⁻¹¹.
#[must_use]
#[expect(
    clippy::disallowed_methods,
    reason = "inputs and a gauge, which such rounding does not change in any picture"
)]
pub fn cell_means(map: Tensor<3>, rows: usize, cols: usize) -> Tensor<2> {
    let [height, width, channels] = map.dims();
    let (device, dtype) = (map.device(), map.dtype());
    let by_row = cell_weights(height, rows, &device, dtype)
        .matmul(map.reshape([height, width * channels])) // [rows, W * C]
        .reshape([rows, width, channels])
        .swap_dims(0, 1)
        .reshape([width, rows * channels]);
    cell_weights(width, cols, &device, dtype)
        .matmul(by_row) // [cols, rows * C]
        .reshape([cols, rows, channels])
        .swap_dims(0, 1)
        .reshape([rows * cols, channels])
}

/// The matrix `[cells, length]` that averages an axis over its cells.
fn cell_weights(length: usize, cells: usize, device: &Device, dtype: DType) -> Tensor<2> {
    let mut weights = vec![0.0_f64; cells * length];
    for cell in 0..cells {
        let (start, end) = (cell * length / cells, ((cell + 1) * length).div_ceil(cells));
        weights[cell * length + start..cell * length + end].fill(1.0 / (end - start) as f64);
    }
    Tensor::from_data(TensorData::new(weights, [cells, length]), (device, dtype))
}
