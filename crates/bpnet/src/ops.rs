use burn::backend::{Backend, backend_extension, tensor::FloatTensor};

use crate::cpu::conv::ConvSize;

/// The ops of this crate that have a backward of their own, for the backends that are compiled in.
///
/// Pixels are rows: a picture of C channels is `[H * W, C]`.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Autodiff,
)]
pub(crate) trait BpNetOps: Backend {
    /// Blurs `image` `[H, W, 3]` with `kernel` `[H, W, K * K]`; see [`blur`](crate::blur).
    fn blur(image: FloatTensor<Self>, kernel: FloatTensor<Self>) -> FloatTensor<Self>;

    /// Convolution of `input` `[H * W, in]`, borders padded with zeros, then ReLU if wanted.
    /// `weight` is `[k * k * in, out]` with rows in the order (ky, kx, in), `bias` `[1, out]`.
    fn conv(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        size: ConvSize,
        relu: bool,
    ) -> FloatTensor<Self>;

    /// Instance norm of `input` `[H * W, C]`: zero mean and unit variance per channel.
    fn instance_norm(input: FloatTensor<Self>) -> FloatTensor<Self>;

    /// Softmax of every row of `logits` `[H * W, C]`.
    fn softmax_rows(logits: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// What the backwards need: called from the autodiff backend only, not dispatched. Gradients are
/// computed where they are wanted.
pub(crate) trait BpNetBackwardOps: BpNetOps {
    /// Gradients of image and kernel.
    fn blur_backward(
        image: FloatTensor<Self>,
        kernel: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2];

    /// Gradients of input, weight and bias; `output` where the forward pass ended in ReLU.
    fn conv_backward(
        input: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        output: Option<FloatTensor<Self>>,
        gradient: FloatTensor<Self>,
        size: ConvSize,
        wanted: [bool; 3],
    ) -> [Option<FloatTensor<Self>>; 3];

    /// The normalised input, and the reciprocal of each channel's standard deviation `[1, C]`.
    fn instance_norm_saved(input: FloatTensor<Self>) -> (FloatTensor<Self>, FloatTensor<Self>);

    /// Gradient of the input from what [`Self::instance_norm_saved`] returned.
    fn instance_norm_backward(
        output: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
    ) -> FloatTensor<Self>;

    /// Gradient of the logits.
    fn softmax_rows_backward(
        output: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
}
