use burn::backend::{Backend, backend_extension, tensor::FloatTensor};

/// The per-pixel blur, for the backends that are compiled in.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Autodiff,
)]
pub(crate) trait BlurOps: Backend {
    /// Blurs `image` `[H, W, 3]` with `kernel` `[H, W, K * K]`; see [`blur`](crate::blur).
    fn blur(image: FloatTensor<Self>, kernel: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// The blur's backward: called from the autodiff backend only, not dispatched.
pub(crate) trait BlurBackwardOps: Backend {
    /// Gradients of image and kernel, each only where it is wanted.
    fn blur_backward(
        image: FloatTensor<Self>,
        kernel: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2];
}
