//! Tensors of the trainer: constants, leaves, and values on the host.

use burn::tensor::{Device, Tensor, TensorData};

/// The same values without a graph. (`detach` would not do: it keeps a leaf's wish for a gradient.)
pub(crate) fn constant(tensor: &Tensor<2>) -> Tensor<2> {
    Tensor::from_inner(tensor.clone().inner())
}

/// The rows from `start` on; `None` where there are none, since Burn cannot narrow to nothing.
pub(crate) fn rows_from(tensor: &Tensor<2>, start: usize) -> Option<Tensor<2>> {
    let rest = tensor.dims()[0] - start;
    (rest > 0).then(|| tensor.clone().narrow(0, start, rest))
}

/// The values of a tensor on the host, as f32. The device is waited for.
pub(crate) fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    host::read(tensor).iter::<f32>().collect()
}

/// A tensor of host values with the device and dtype of the model.
pub(crate) fn tensor<const D: usize>(
    values: Vec<f32>,
    shape: [usize; D],
    device: &Device,
) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// `tensor` as a new leaf that keeps its gradient if `autodiff`, else as it is.
pub(crate) fn leaf(tensor: Tensor<2>, autodiff: bool) -> Tensor<2> {
    if autodiff {
        tensor.autodiff().require_grad()
    } else {
        tensor
    }
}

/// Puts other values into a row of a table. The device is waited for.
pub(crate) fn set_row(table: &mut Tensor<2>, row: usize, values: &[f32]) {
    let (device, [rows, width]) = (table.device(), table.dims());
    let mut all = host(table.clone());
    all[row * width..(row + 1) * width].copy_from_slice(values);
    *table = tensor(all, [rows, width], &device);
}
