use burn::tensor::{DType, Device, Tensor, TensorData};

use crate::layers::{constant, sigmoid};
use crate::{BpNetError, blur};

/// How every pixel of one frame was blurred, as BP-Net predicts it.
#[derive(Clone, Debug)]
pub struct BlurField {
    /// Blur kernel of each pixel, `[H, W, K * K]`; not negative, sums to 1. Entry `ky * K + kx`
    /// weighs the pixel at `(y + ky - K/2, x + kx - K/2)`.
    pub kernel: Tensor<3>,
    /// Blur intensity m of each pixel, `[H, W]`, from 0 (sharp) to 1.
    pub intensity: Tensor<2>,
}

impl BlurField {
    fn size(&self) -> [usize; 3] {
        self.kernel.dims()
    }
}

/// What the camera saw: `m * blur(image) + (1 - m) * image`, `[H, W, 3]`.
///
/// # Errors
/// [`BpNetError`] when image `[H, W, 3]` and field differ in size, as of [`blur`].
pub fn composite(image: Tensor<3>, field: &BlurField) -> Result<Tensor<3>, BpNetError> {
    let [height, width, _] = field.size();
    BpNetError::check_shape("blur intensity", &field.intensity.dims(), &[height, width])?;
    BpNetError::check_finite("blur intensity", &field.intensity, 1)?;
    let blurred = blur(image.clone(), field.kernel.clone())?;
    let intensity = field.intensity.clone().unsqueeze_dim::<3>(2);
    Ok(image.clone() + (blurred - image) * intensity)
}

/// L_spa, the kernel sparsity loss: mean of `|sigmoid(5 (1 - m)) - k_centre|` over the pixels, m
/// held constant. It pulls the kernel of a pixel that is not blurred to a delta.
#[must_use]
pub fn kernel_center_loss(field: &BlurField) -> Tensor<1> {
    let [_, _, entries] = field.size();
    let center = field
        .kernel
        .clone()
        .narrow(2, entries / 2, 1)
        .squeeze_dim::<2>(2);
    let intensity = constant(field.intensity.clone());
    let target = sigmoid((intensity - 1.0) * -5.0);
    (target - center).abs().mean_dim(1).mean()
}

/// Where the blur moves each pixel's light on average: `m Σ k Δ`, `[H, W, 2]`, in pixels, x before y.
#[must_use]
pub fn centroid(field: &BlurField) -> Tensor<3> {
    let [height, width, entries] = field.size();
    let size = (entries as f64).sqrt().round() as usize;
    let half = (size / 2) as f64;
    let offsets: Vec<f64> = (0..entries)
        .flat_map(|j| [(j % size) as f64 - half, (j / size) as f64 - half])
        .collect();
    let offsets = Tensor::<2>::from_data(
        TensorData::new(offsets, [entries, 2]),
        (&field.kernel.device(), field.kernel.dtype()),
    );
    let mean = field
        .kernel
        .clone()
        .reshape([height * width, entries])
        .matmul(offsets);
    mean.reshape([height, width, 2]) * field.intensity.clone().unsqueeze_dim::<3>(2)
}

/// Means of a centroid map `[H, W, 2]` over the cells of a grid, `[rows * cols, 2]`, row by row.
///
/// Cell i of n covers the pixels from `floor(i L / n)` to `ceil((i + 1) L / n)`, so that it is never
/// empty, whatever the size (adaptive average pooling).
#[must_use]
pub fn cell_means(centroid: Tensor<3>, rows: usize, cols: usize) -> Tensor<2> {
    let [height, width, _] = centroid.dims();
    let (device, dtype) = (centroid.device(), centroid.dtype());
    let by_row = cell_weights(height, rows, &device, dtype)
        .matmul(centroid.reshape([height, width * 2])) // [rows, W * 2]
        .reshape([rows, width, 2])
        .swap_dims(0, 1)
        .reshape([width, rows * 2]);
    cell_weights(width, cols, &device, dtype)
        .matmul(by_row) // [cols, rows * 2]
        .reshape([cols, rows, 2])
        .swap_dims(0, 1)
        .reshape([rows * cols, 2])
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
