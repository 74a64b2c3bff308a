//! Leaves made from edited values.

use burn::tensor::Tensor;

/// `tensor` as a new leaf that keeps its gradient if `autodiff`, else as it is.
pub(crate) fn leaf(tensor: Tensor<2>, autodiff: bool) -> Tensor<2> {
    if autodiff {
        tensor.autodiff().require_grad()
    } else {
        tensor
    }
}
