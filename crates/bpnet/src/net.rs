//! BP-Net, the paper's blur prediction network: four layers on camera embedding e(i), positional encoding p(x) and scene
//! features f_scene(x), with a softmax for the kernel and a sigmoid for the intensity. Features are joined again behind the
//! first two layers, as the paper says; its code joins the extractor's raw input once.

use burn::tensor::{DType, Device, Tensor};
use host::{all_zero, count_not_finite, product};

use crate::BpNetError;
use crate::cpu::predict::{self, PredictSize};
use crate::encoding::ENCODING_CHANNELS;
use crate::extractor::{FEATURE_CHANNELS, INPUT_CHANNELS, features};
use crate::field::{BlurField, cell_means};
use crate::init::Initializer;
use crate::layers::{Layer, constant, predict, upsample};
use crate::limits::MAX_DOWNSCALE;
use crate::ops::Predictor;

/// Channels of the camera embedding, one row per training frame.
pub const EMBEDDING_CHANNELS: usize = 32;
/// Channels of BP-Net's hidden layers.
pub const HIDDEN_CHANNELS: usize = predict::HIDDEN;

/// What a blur model is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BpNetConfig {
    /// Side K of the blur kernels in pixels; odd, 1 to 15.
    pub kernel_size: usize,
    /// Training frames, each of which gets a camera embedding.
    pub num_frames: usize,
    /// Whether the scene features are joined to the outputs of the first two layers as well.
    pub shortcut: bool,
    /// Features, kernels and intensities are computed on a picture so many times smaller on each side
    /// and interpolated between its pixels; 1 to [`MAX_DOWNSCALE`]. Kernels are in pixels of the whole
    /// picture all the same.
    pub downscale: usize,
    /// How the two heads start.
    pub head: HeadInit,
    /// Seed of all random starting values.
    pub seed: u64,
}

/// How BP-Net's heads start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeadInit {
    /// A mild blur: the kernel's bias is the logits of a Gaussian of sigma 1 px, the intensity's is 0
    /// (m = 0.5), the heads' weights are a tenth of the usual. A delta kernel together with m = 0
    /// would be a saddle, from which neither moves.
    Mild,
    /// Hardly any blur, for pictures whose blur something else explains already: as `Mild`, but the intensity's bias is -3
    /// (m = 0.05).
    Slight,
    /// As a framework initialises any layer.
    Framework,
}

/// Whether the scene feature extractor learns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extractor {
    /// It does.
    Trained,
    /// It stays as it was drawn: no graph is built for it. (So it is in the reference code.)
    Frozen,
}

/// What the blur model looks at. Nothing flows back into it: all three are detached.
#[derive(Clone, Debug)]
pub struct BlurInputs {
    /// Sharp render, `[H, W, 3]`, sRGB.
    pub color: Tensor<3>,
    /// Disparity times the scene size, `[H, W]`, without unit.
    pub disparity: Tensor<2>,
    /// Dynamic mask, `[H, W]`.
    pub mask: Tensor<2>,
}

/// The blur model of a scene: scene feature extractor, camera embedding and blur prediction network.
///
/// The extractor turns colour, disparity and mask into 32 features per pixel. BP-Net is four layers
/// of 1x1 convolutions on camera embedding (32), positional encoding (16) and features (32); the
/// features are joined to the outputs of its first two layers again, and its last layer is the
/// kernel's and the intensity's head.
///
/// All parameters are matrices: weights `[k * k * in, out]` with rows in the order (ky, kx, in), where
/// k = 1 but in the extractor, and biases `[1, out]`.
#[derive(Clone, Debug)]
pub struct BpNet {
    kernel_size: usize,
    shortcut: bool,
    downscale: usize,
    extractor: [Layer; 3],
    embedding: Tensor<2>,
    base: [Layer; 3],
    kernel_head: Layer,
    intensity_head: Layer,
}

impl BpNet {
    /// A blur model with random starting values, drawn from `config.seed` alone.
    ///
    /// On an autodiff device the parameters require gradients.
    ///
    /// # Errors
    /// [`BpNetError`] for an even or too large kernel, no frames, a scale out of its range, or a `dtype`
    /// other than f32 and f64.
    pub fn new(config: &BpNetConfig, device: &Device, dtype: DType) -> Result<Self, BpNetError> {
        BpNetError::check_kernel_size(config.kernel_size)?;
        BpNetError::check_dtype("the blur model's parameters", dtype)?;
        if config.num_frames == 0 {
            return Err(BpNetError::NoFrames);
        }
        if !(1..=MAX_DOWNSCALE).contains(&config.downscale) {
            return Err(BpNetError::Downscale {
                downscale: config.downscale,
            });
        }
        let init = Initializer {
            seed: config.seed,
            device,
            dtype,
        };
        let joined = HIDDEN_CHANNELS + if config.shortcut { FEATURE_CHANNELS } else { 0 };
        let first = EMBEDDING_CHANNELS + ENCODING_CHANNELS + FEATURE_CHANNELS;
        let entries = config.kernel_size * config.kernel_size;
        let (head_scale, intensity) = match config.head {
            HeadInit::Mild => (0.1, Some(0.0)),
            HeadInit::Slight => (0.1, Some(-3.0)),
            HeadInit::Framework => (1.0, None),
        };
        let mut kernel_head = init.layer(12, HIDDEN_CHANNELS, entries, head_scale);
        let mut intensity_head = init.layer(14, HIDDEN_CHANNELS, 1, head_scale);
        if let Some(intensity) = intensity {
            kernel_head.bias = init.parameter(gaussian_logits(config.kernel_size), [1, entries]);
            intensity_head.bias = init.parameter(vec![intensity], [1, 1]);
        }
        Ok(Self {
            kernel_size: config.kernel_size,
            shortcut: config.shortcut,
            downscale: config.downscale,
            extractor: [
                init.layer(0, INPUT_CHANNELS * 25, HIDDEN_CHANNELS, 1.0),
                init.layer(2, HIDDEN_CHANNELS * 25, HIDDEN_CHANNELS, 1.0),
                init.layer(4, HIDDEN_CHANNELS * 9, FEATURE_CHANNELS, 1.0),
            ],
            embedding: init.normal(16, [config.num_frames, EMBEDDING_CHANNELS]),
            base: [
                init.layer(6, first, HIDDEN_CHANNELS, 1.0),
                init.layer(8, joined, HIDDEN_CHANNELS, 1.0),
                init.layer(10, joined, HIDDEN_CHANNELS, 1.0),
            ],
            kernel_head,
            intensity_head,
        })
    }

    /// Side K of the predicted kernels in pixels.
    #[must_use]
    pub fn kernel_size(&self) -> usize {
        self.kernel_size
    }

    /// Training frames with a camera embedding.
    #[must_use]
    pub fn num_frames(&self) -> usize {
        self.embedding.dims()[0]
    }

    /// All parameters with their names, in a fixed order.
    #[must_use]
    pub fn parameters(&self) -> Vec<(&'static str, Tensor<2>)> {
        let [extractor1, extractor2, extractor3] = &self.extractor;
        let [base0, base1, base2] = &self.base;
        let tensors = [
            &extractor1.weight,
            &extractor1.bias,
            &extractor2.weight,
            &extractor2.bias,
            &extractor3.weight,
            &extractor3.bias,
            &self.embedding,
            &base0.weight,
            &base0.bias,
            &base1.weight,
            &base1.bias,
            &base2.weight,
            &base2.bias,
            &self.kernel_head.weight,
            &self.kernel_head.bias,
            &self.intensity_head.weight,
            &self.intensity_head.bias,
        ];
        NAMES.into_iter().zip(tensors.map(Tensor::clone)).collect()
    }

    /// The same parameters to be replaced: after a step of an optimiser, or from a checkpoint. A
    /// replacement keeps the shape and, where it is to be trained, requires a gradient.
    pub fn parameters_mut(&mut self) -> Vec<(&'static str, &mut Tensor<2>)> {
        let [extractor1, extractor2, extractor3] = &mut self.extractor;
        let [base0, base1, base2] = &mut self.base;
        let tensors = [
            &mut extractor1.weight,
            &mut extractor1.bias,
            &mut extractor2.weight,
            &mut extractor2.bias,
            &mut extractor3.weight,
            &mut extractor3.bias,
            &mut self.embedding,
            &mut base0.weight,
            &mut base0.bias,
            &mut base1.weight,
            &mut base1.bias,
            &mut base2.weight,
            &mut base2.bias,
            &mut self.kernel_head.weight,
            &mut self.kernel_head.bias,
            &mut self.intensity_head.weight,
            &mut self.intensity_head.bias,
        ];
        NAMES.into_iter().zip(tensors).collect()
    }

    /// Predicts how `frame` was blurred.
    ///
    /// # Errors
    /// [`BpNetError`] when the inputs disagree in size, are not of the parameters' element type, an input or parameter holds a
    /// value that is not finite, or `frame` has no embedding.
    pub fn forward(
        &self,
        frame: usize,
        inputs: &BlurInputs,
        extractor: Extractor,
    ) -> Result<BlurField, BpNetError> {
        let whole = self.check_inputs(frame, inputs)?;
        self.check_finite(inputs)?;
        Ok(self.field(frame, inputs, extractor, whole))
    }

    /// As [`Self::forward`], but trusts that inputs and parameters are finite: what is not gives a field that is not, or wrong.
    /// For those who look at what comes of it, as training does at losses and gradients; the device is not waited for.
    ///
    /// # Errors
    /// [`BpNetError`] when the inputs disagree in size, are not of the parameters' element type, or `frame` has no embedding.
    pub fn forward_trusted(
        &self,
        frame: usize,
        inputs: &BlurInputs,
        extractor: Extractor,
    ) -> Result<BlurField, BpNetError> {
        let whole = self.check_inputs(frame, inputs)?;
        Ok(self.field(frame, inputs, extractor, whole))
    }

    /// The field of a picture of the height and width `whole`; inputs fit.
    fn field(
        &self,
        frame: usize,
        inputs: &BlurInputs,
        extractor: Extractor,
        whole: [usize; 2],
    ) -> BlurField {
        let [height, width] = whole.map(|side| side.div_ceil(self.downscale));
        let column = |map: &Tensor<2>| constant(map.clone()).unsqueeze_dim::<3>(2);
        let scene = Tensor::cat(
            vec![
                constant(inputs.color.clone()),
                column(&inputs.disparity),
                column(&inputs.mask),
            ],
            2,
        ); // [H, W, 5]
        let scene = if self.downscale == 1 {
            scene.reshape([height * width, INPUT_CHANNELS])
        } else {
            cell_means(scene, height, width)
        };
        let features = match extractor {
            Extractor::Trained => features(scene, [height, width], &self.extractor),
            Extractor::Frozen => {
                let layers = self.extractor.each_ref().map(Layer::constant);
                features(scene, [height, width], &layers)
            }
        };

        // The embedding is the same at every pixel: its product is one row, added like a bias.
        let [first, second, third] = self.base.clone();
        let embedding = self.embedding.clone().narrow(0, frame, 1);
        let of_embedding = first.weight.clone().narrow(0, 0, EMBEDDING_CHANNELS);
        let varying = ENCODING_CHANNELS + FEATURE_CHANNELS;
        let predictor = Predictor {
            features: features.into_dispatch(),
            weight0: first
                .weight
                .narrow(0, EMBEDDING_CHANNELS, varying)
                .into_dispatch(),
            bias0: (product(embedding, of_embedding) + first.bias).into_dispatch(),
            weight1: second.weight.into_dispatch(),
            bias1: second.bias.into_dispatch(),
            weight2: third.weight.into_dispatch(),
            bias2: third.bias.into_dispatch(),
            kernel_weight: self.kernel_head.weight.clone().into_dispatch(),
            kernel_bias: self.kernel_head.bias.clone().into_dispatch(),
            intensity_weight: self.intensity_head.weight.clone().into_dispatch(),
            intensity_bias: self.intensity_head.bias.clone().into_dispatch(),
        };
        let size = PredictSize {
            height,
            width,
            entries: self.kernel_size * self.kernel_size,
            shortcut: self.shortcut,
        };
        let field = predict(predictor, size);
        BlurField::from_values(if self.downscale == 1 {
            field
        } else {
            upsample(field, whole)
        })
    }

    fn check_inputs(&self, frame: usize, inputs: &BlurInputs) -> Result<[usize; 2], BpNetError> {
        let num_frames = self.num_frames();
        if frame >= num_frames {
            return Err(BpNetError::Frame { frame, num_frames });
        }
        let BlurInputs {
            color,
            disparity,
            mask,
        } = inputs;
        let [height, width, _] = color.dims();
        if height * width == 0 {
            return Err(BpNetError::Shape {
                name: "colour",
                found: color.dims().to_vec(),
                expected: "[H, W, 3] with at least one pixel".to_owned(),
            });
        }
        BpNetError::check_shape("colour", &color.dims(), &[height, width, 3])?;
        BpNetError::check_shape("disparity", &disparity.dims(), &[height, width])?;
        BpNetError::check_shape("mask", &mask.dims(), &[height, width])?;
        let dtype = self.embedding.dtype();
        BpNetError::check_same_dtype("colour", color.dtype(), dtype)?;
        BpNetError::check_same_dtype("disparity", disparity.dtype(), dtype)?;
        BpNetError::check_same_dtype("mask", mask.dtype(), dtype)?;
        Ok([height, width])
    }

    fn check_finite(&self, inputs: &BlurInputs) -> Result<(), BpNetError> {
        let BlurInputs {
            color,
            disparity,
            mask,
        } = inputs;
        let parameters = self.parameters();
        let maps = [disparity, mask].map(count_not_finite);
        let weights = parameters
            .iter()
            .map(|(_, tensor)| count_not_finite(tensor));
        let counts = [count_not_finite(color)].into_iter().chain(maps);
        if !all_zero(counts.chain(weights).collect()) {
            BpNetError::check_finite("colour", color, 3)?;
            BpNetError::check_finite("disparity", disparity, 1)?;
            BpNetError::check_finite("mask", mask, 1)?;
            for (name, parameter) in parameters {
                BpNetError::check_finite(name, &parameter, parameter.dims()[1])?;
            }
        }
        Ok(())
    }
}

/// Names of the parameters, in the order of [`BpNet::parameters`].
const NAMES: [&str; 17] = [
    "extractor.conv1.weight",
    "extractor.conv1.bias",
    "extractor.conv2.weight",
    "extractor.conv2.bias",
    "extractor.conv3.weight",
    "extractor.conv3.bias",
    "embedding",
    "base.0.weight",
    "base.0.bias",
    "base.1.weight",
    "base.1.bias",
    "base.2.weight",
    "base.2.bias",
    "head.kernel.weight",
    "head.kernel.bias",
    "head.intensity.weight",
    "head.intensity.bias",
];

/// Logits of a Gaussian of sigma 1 px around the kernel's centre.
fn gaussian_logits(kernel_size: usize) -> Vec<f64> {
    let half = (kernel_size / 2) as f64;
    (0..kernel_size * kernel_size)
        .map(|j| {
            let (x, y) = ((j % kernel_size) as f64, (j / kernel_size) as f64);
            -0.5 * ((x - half).powi(2) + (y - half).powi(2))
        })
        .collect()
}
