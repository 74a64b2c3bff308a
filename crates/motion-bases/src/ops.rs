//! The seam between tensors and the kernels: where all moving Gaussians are at several moments, and the loss of the first fit.

use crate::fit_data::FitStep;
use burn::backend::{Backend, backend_extension, tensor::FloatTensor};

/// Ops with a backward of their own.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Cube: cfg(feature = "cube"),
    Autodiff,
)]
pub(crate) trait MotionOps: Backend {
    /// Means `[T, F, 3]` and behind them rotations `[T, F, 3, 3]`, flat.
    ///
    /// `coefficients` are logits, `[F, B]`; `bases` are 6D vectors and translations at the moments, `[B, T, 9]`; `means` are
    /// of the canonical frame, `[F, 3]`.
    fn moved(
        coefficients: FloatTensor<Self>,
        bases: FloatTensor<Self>,
        means: FloatTensor<Self>,
    ) -> FloatTensor<Self>;

    /// The loss of a step of the first fit, `[1]`; `rots` are [B, N * 6], `transls` [B, N * 3], `coefficients` logits [P, B] and
    /// `means` [P, 3].
    fn fit(
        rots: FloatTensor<Self>,
        transls: FloatTensor<Self>,
        coefficients: FloatTensor<Self>,
        means: FloatTensor<Self>,
        step: FitStep,
    ) -> FloatTensor<Self>;
}

/// A loss `[1]`, and its gradients.
pub(crate) type FitSlope<B> = (FloatTensor<B>, [FloatTensor<B>; 4]);

/// What the backward needs: called from the autodiff backend only, not dispatched.
pub(crate) trait MotionBackwardOps: MotionOps {
    /// Gradients of the inputs of [`MotionOps::moved`], in its order; those that are not `wanted` may be missing.
    fn moved_backward(
        inputs: [FloatTensor<Self>; 3],
        gradient: FloatTensor<Self>,
        wanted: [bool; 3],
    ) -> [Option<FloatTensor<Self>>; 3];

    /// [`MotionOps::fit`] with the gradients of its inputs, in its order.
    fn fit_slope(inputs: [FloatTensor<Self>; 4], step: &FitStep) -> FitSlope<Self>;
}
