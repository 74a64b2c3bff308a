//! The seam between the trainer's tensors and its kernels.
//!
//! What a view brings along (depth, validity) lies in main memory and comes as slices: a device copies them to itself.

use burn::backend::{Backend, ExtensionType, backend_extension, tensor::FloatTensor};

use crate::cpu::adam::AdamUpdate;

/// A parameter and its moments, all `[N, C]`.
#[derive(Clone, Debug, ExtensionType)]
pub(crate) struct AdamTensors<B: Backend> {
    pub(crate) parameter: FloatTensor<B>,
    pub(crate) moment1: FloatTensor<B>,
    pub(crate) moment2: FloatTensor<B>,
}

/// What a rendered depth is compared with, all `[H, W]`; zero at pixels that do not count.
#[derive(Clone, Debug, ExtensionType)]
pub(crate) struct DepthTargets<B: Backend> {
    /// 1 / alpha.
    pub(crate) per_alpha: FloatTensor<B>,
    /// Given disparity times the scene size, with the estimator's scale and shift taken out.
    pub(crate) wanted: FloatTensor<B>,
    /// 1 / number of pixels that count.
    pub(crate) weight: FloatTensor<B>,
}

/// By how much [`TrainerOps::squared_error`] scales large differences: a power of two, and no product of numbers inside f32
/// falls below it.
pub(crate) const LARGE_SCALE: f32 = 1.0 / (1_u128 << 90) as f32;

/// The ops that no gradient passes through: called with tensors without a graph.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Cube: cfg(feature = "cube"),
)]
pub(crate) trait TrainerOps: Backend {
    /// One step of Adam, in the buffers that have no other owner.
    fn adam(
        #[extension_type] tensors: AdamTensors<Self>,
        gradient: FloatTensor<Self>,
        update: AdamUpdate,
    ) -> AdamTensors<Self>;

    /// Fits the `given` depth to a rendered `depth` and `alpha`, all `[H, W]`.
    fn depth_targets(
        depth: FloatTensor<Self>,
        alpha: FloatTensor<Self>,
        given: FloatTensor<Self>,
        scene_size: f64,
    ) -> DepthTargets<Self>;

    /// Weight of every pixel of the trimmed mask loss, `[H, W]` like `rendered` and `target`: the same for all that are kept,
    /// which sum to 1.
    fn mask_weights(
        rendered: FloatTensor<Self>,
        target: FloatTensor<Self>,
        valid: Option<&[bool]>,
        band: usize,
    ) -> FloatTensor<Self>;

    /// Sums of squared differences of two pictures `[H, W, 3]`, over the `valid` pixels [H, W], `[2]`: of some samples, and of
    /// the others with their differences times [`LARGE_SCALE`], since their squares may lie beyond f32.
    fn squared_error(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        valid: Option<&[bool]>,
    ) -> FloatTensor<Self>;
}

/// The ops with a backward of their own.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Cube: cfg(feature = "cube"),
    Autodiff,
)]
pub(crate) trait ImageLossOps: Backend {
    /// Mean absolute difference and mean SSIM of two pictures `[H, W, 3]`, each times its weight, `[1]`; differentiable in `a`.
    fn image_loss(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        weights: [f64; 2],
    ) -> FloatTensor<Self>;

    /// What the difference of two pictures `[H, W, 3]` has beyond its surroundings, `[1]`; differentiable in `a`.
    fn detail_loss(a: FloatTensor<Self>, b: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// What the backward needs: called from the autodiff backend only, not dispatched.
pub(crate) trait ImageLossBackwardOps: ImageLossOps {
    /// The loss, and its gradient by `a` `[H, W, 3]`: together they cost less than one after the other.
    fn image_loss_and_gradient(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        weights: [f64; 2],
    ) -> (FloatTensor<Self>, FloatTensor<Self>);

    /// The same of [`ImageLossOps::detail_loss`].
    fn detail_loss_and_gradient(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
}
