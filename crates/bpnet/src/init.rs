//! Random starting values, as a framework draws them.

use burn::tensor::{DType, Device, Tensor, TensorData};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::layers::Layer;

/// Draws parameters: one stream of a seeded generator per parameter, so that the values of one do
/// not depend on the sizes of the others.
pub(crate) struct Initializer<'a> {
    pub(crate) seed: u64,
    pub(crate) device: &'a Device,
    pub(crate) dtype: DType,
}

impl Initializer<'_> {
    /// A layer of `inputs` products per output; its weight is drawn from this stream, its bias from
    /// the next. `scale` is the weight's alone.
    pub(crate) fn layer(&self, stream: u64, inputs: usize, outputs: usize, scale: f64) -> Layer {
        Layer {
            weight: self.uniform(stream, [inputs, outputs], inputs, scale),
            bias: self.uniform(stream + 1, [1, outputs], inputs, 1.0),
        }
    }

    /// Uniform in `±scale / sqrt(fan_in)`, PyTorch's default for weights and biases at scale 1.
    fn uniform(&self, stream: u64, shape: [usize; 2], fan_in: usize, scale: f64) -> Tensor<2> {
        let bound = scale / (fan_in as f64).sqrt();
        let mut rng = self.stream(stream);
        self.parameter(
            (0..shape[0] * shape[1])
                .map(|_| bound * (2.0 * rng.random::<f64>() - 1.0))
                .collect(),
            shape,
        )
    }

    /// Standard normal, by Box and Muller.
    pub(crate) fn normal(&self, stream: u64, shape: [usize; 2]) -> Tensor<2> {
        let mut rng = self.stream(stream);
        self.parameter(
            (0..shape[0] * shape[1])
                .map(|_| {
                    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
                    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
                })
                .collect(),
            shape,
        )
    }

    /// A trainable tensor with these values.
    pub(crate) fn parameter(&self, values: Vec<f64>, shape: [usize; 2]) -> Tensor<2> {
        let tensor = Tensor::from_data(TensorData::new(values, shape), (self.device, self.dtype));
        if self.device.is_autodiff() {
            tensor.require_grad()
        } else {
            tensor
        }
    }

    fn stream(&self, stream: u64) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(stream);
        rng
    }
}
