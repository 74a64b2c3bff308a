//! Layers on pictures that are matrices, a row per pixel.

use burn::backend::Dispatch;
use burn::tensor::Tensor;

use crate::cpu::conv::ConvSize;
use crate::cpu::predict::PredictSize;
use crate::cpu::upsample::UpsampleSize;
use crate::ops::{BpNetOps, Predictor};

/// Weight `[k * k * in, out]` with rows in the order (ky, kx, in), and bias `[1, out]`.
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    pub(crate) weight: Tensor<2>,
    pub(crate) bias: Tensor<2>,
}

impl Layer {
    /// The layer without its gradient.
    pub(crate) fn constant(&self) -> Self {
        Self {
            weight: constant(self.weight.clone()),
            bias: constant(self.bias.clone()),
        }
    }
}

/// `kernel x kernel` convolution of `[H * W, in]` to `[H * W, out]`, borders padded with zeros, then ReLU
/// if wanted.
pub(crate) fn conv(
    input: Tensor<2>,
    layer: &Layer,
    [height, width]: [usize; 2],
    kernel: usize,
    relu: bool,
) -> Tensor<2> {
    let size = ConvSize {
        height,
        width,
        inputs: input.dims()[1],
        outputs: layer.weight.dims()[1],
        kernel,
    };
    Tensor::from_dispatch(<Dispatch as BpNetOps>::conv(
        input.into_dispatch(),
        layer.weight.clone().into_dispatch(),
        layer.bias.clone().into_dispatch(),
        size,
        relu,
    ))
}

/// Zero mean and unit (biased) variance per channel over the image.
pub(crate) fn instance_norm(input: Tensor<2>) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as BpNetOps>::instance_norm(input.into_dispatch()))
}

/// Blur kernel and intensity of every pixel, `[H, W, K * K + 1]`.
pub(crate) fn predict(predictor: Predictor<Dispatch>, size: PredictSize) -> Tensor<3> {
    Tensor::from_dispatch(<Dispatch as BpNetOps>::predict(predictor, size))
}

/// Bilinear enlargement of `[h, w, C]` to `[H, W, C]`.
pub(crate) fn upsample(input: Tensor<3>, to: [usize; 2]) -> Tensor<3> {
    let [height, width, channels] = input.dims();
    let size = UpsampleSize {
        from: [height, width],
        to,
        channels,
    };
    Tensor::from_dispatch(<Dispatch as BpNetOps>::upsample(
        input.into_dispatch(),
        size,
    ))
}

/// Logistic function. (Burn's own goes through f32 on some backends, whatever the element type.)
///
/// Below -80, where it is under 1e-34, it stays, so that neither the exponential nor the gradient overflows.
pub(crate) fn sigmoid<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    (x.clamp_min(-80.0).neg().exp() + 1.0).recip()
}

/// The tensor's values without its gradient. (Burn's `detach` alone turns a leaf that requires a
/// gradient into another such leaf, and a graph is built again.)
pub(crate) fn constant<const D: usize>(tensor: Tensor<D>) -> Tensor<D> {
    tensor.detach().set_require_grad(false)
}
