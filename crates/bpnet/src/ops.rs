//! The seam between tensors and kernels: the ops on a backend's tensors, forward and back.

use burn::backend::{Backend, ExtensionType, backend_extension, tensor::FloatTensor};

use crate::cpu::conv::ConvSize;
use crate::cpu::predict::PredictSize;
use crate::cpu::upsample::UpsampleSize;

/// What BP-Net behind the scene features is made of and sees; see [`BpNetOps::predict`].
#[derive(Clone, Debug, ExtensionType)]
pub(crate) struct Predictor<B: Backend> {
    /// `[H * W, 32]`.
    pub(crate) features: FloatTensor<B>,
    /// `[48, 64]`, rows in the order encoding, features; bias with the embedding's product in it.
    pub(crate) weight0: FloatTensor<B>,
    pub(crate) bias0: FloatTensor<B>,
    /// `[64, 64]`, or `[96, 64]` with the features' rows behind.
    pub(crate) weight1: FloatTensor<B>,
    pub(crate) bias1: FloatTensor<B>,
    pub(crate) weight2: FloatTensor<B>,
    pub(crate) bias2: FloatTensor<B>,
    /// `[64, K * K]`.
    pub(crate) kernel_weight: FloatTensor<B>,
    pub(crate) kernel_bias: FloatTensor<B>,
    /// `[64, 1]`.
    pub(crate) intensity_weight: FloatTensor<B>,
    pub(crate) intensity_bias: FloatTensor<B>,
}

/// Number of tensors of a [`Predictor`].
pub(crate) const PREDICTOR: usize = 11;

impl<B: Backend> Predictor<B> {
    /// All tensors: the features, then weight and bias of every layer.
    pub(crate) fn into_array(self) -> [FloatTensor<B>; PREDICTOR] {
        [
            self.features,
            self.weight0,
            self.bias0,
            self.weight1,
            self.bias1,
            self.weight2,
            self.bias2,
            self.kernel_weight,
            self.kernel_bias,
            self.intensity_weight,
            self.intensity_bias,
        ]
    }
}

/// The ops of this crate that have a backward of their own, for the backends that are compiled in.
///
/// Pixels are rows: a picture of C channels is `[H * W, C]`.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Cube: cfg(feature = "cube"),
    Autodiff,
)]
pub(crate) trait BpNetOps: Backend {
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

    /// Blur kernel and intensity of every pixel, `[H, W, K * K + 1]`.
    fn predict(
        #[extension_type] predictor: Predictor<Self>,
        size: PredictSize,
    ) -> FloatTensor<Self>;

    /// Bilinear enlargement of `input` `[h, w, C]` to `[H, W, C]`.
    fn upsample(input: FloatTensor<Self>, size: UpsampleSize) -> FloatTensor<Self>;

    /// Picture, centroid, centre weight and intensity, `[H, W, 7]`, of `image` `[H, W, 3]` blurred by
    /// `field` `[H, W, K * K + 1]`; see [`composite`](crate::composite).
    fn composite(image: FloatTensor<Self>, field: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// What the backwards need: called from the autodiff backend only, not dispatched. Gradients are
/// computed where they are wanted.
pub(crate) trait BpNetBackwardOps: BpNetOps {
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

    /// Gradients of a predictor's tensors, in the order of [`Predictor::into_array`].
    fn predict_backward(
        predictor: Predictor<Self>,
        output: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        size: PredictSize,
        wanted: [bool; PREDICTOR],
    ) -> [Option<FloatTensor<Self>>; PREDICTOR];

    /// Gradient of the input.
    fn upsample_backward(gradient: FloatTensor<Self>, size: UpsampleSize) -> FloatTensor<Self>;

    /// Gradients of image and field.
    fn composite_backward(
        image: FloatTensor<Self>,
        field: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2];
}
