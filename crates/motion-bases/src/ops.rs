//! The seam between tensors and the kernel: where all moving Gaussians are at several moments, as one op.

use burn::backend::{Backend, backend_extension, tensor::FloatTensor};

/// The op with a backward of its own.
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
}

/// What the backward needs: called from the autodiff backend only, not dispatched.
pub(crate) trait MotionBackwardOps: MotionOps {
    /// Gradients of the inputs of [`MotionOps::moved`], in its order; those that are not `wanted` may be missing.
    fn moved_backward(
        inputs: [FloatTensor<Self>; 3],
        gradient: FloatTensor<Self>,
        wanted: [bool; 3],
    ) -> [Option<FloatTensor<Self>>; 3];
}
