//! The ops on a backend's tensors. A backend brings [`SplatOps`] and [`SplatBackwardOps`]; what it keeps of a view between
//! the ops is a variant of [`PreparedView`].

use std::fmt::Debug;
use std::sync::Arc;

use burn::backend::{Backend, ExtensionType, backend_extension, tensor::FloatTensor};

use crate::camera::Camera;
use crate::cpu::{Projection, Transfer};
use crate::error::SplatError;
use crate::stages::Stages;

/// Gaussians and the camera's pose, in one float type.
#[derive(Clone, Debug, ExtensionType)]
pub(crate) struct SceneTensors<B: Backend> {
    /// [N, 3].
    pub(crate) means: FloatTensor<B>,
    /// [N, 4].
    pub(crate) quats: FloatTensor<B>,
    /// [F, 3, 3]; of no row where there is none.
    pub(crate) left_rotations: FloatTensor<B>,
    /// [N, 3].
    pub(crate) log_scales: FloatTensor<B>,
    /// [N, 1].
    pub(crate) opacity_logits: FloatTensor<B>,
    /// [N, B * 3].
    pub(crate) sh: FloatTensor<B>,
    /// [3, 4].
    pub(crate) cam_from_world: FloatTensor<B>,
}

/// Number of tensors of a [`SceneTensors`].
const SCENE: usize = 7;
/// Float inputs of [`SplatOps::rasterize`]: those of [`SceneTensors::into_array`], features, screen statistic.
pub(crate) const INPUTS: usize = SCENE + 2;
/// Place of the pose among them.
pub(crate) const POSE: usize = 6;
/// Float inputs of [`SplatOps::expose`]: those of [`SceneTensors::into_array`], of [`MovingTensors::into_array`], screen statistic.
pub(crate) const EXPOSE_INPUTS: usize = SCENE + 4;
/// Place of the samples' poses among them.
pub(crate) const POSES: usize = SCENE;

impl<B: Backend> SceneTensors<B> {
    /// The same scene for a backend around or inside this one; `float` is called in the order of [`Self::into_array`].
    pub(crate) fn map<A: Backend>(
        self,
        mut float: impl FnMut(FloatTensor<B>) -> FloatTensor<A>,
    ) -> SceneTensors<A> {
        SceneTensors {
            means: float(self.means),
            quats: float(self.quats),
            left_rotations: float(self.left_rotations),
            log_scales: float(self.log_scales),
            opacity_logits: float(self.opacity_logits),
            sh: float(self.sh),
            cam_from_world: float(self.cam_from_world),
        }
    }

    /// All tensors, in the order of the inputs of [`SplatOps::rasterize`].
    pub(crate) fn into_array(self) -> [FloatTensor<B>; SCENE] {
        [
            self.means,
            self.quats,
            self.left_rotations,
            self.log_scales,
            self.opacity_logits,
            self.sh,
            self.cam_from_world,
        ]
    }
}

/// What moves while the shutter is open, in each of n samples, in the scene's float type.
#[derive(Clone, Debug, ExtensionType)]
pub(crate) struct MovingTensors<B: Backend> {
    /// [n, 3, 4].
    pub(crate) poses: FloatTensor<B>,
    /// Means of rows [0, F), [n, F, 3].
    pub(crate) means: FloatTensor<B>,
    /// [n, F, 3, 3].
    pub(crate) left_rotations: FloatTensor<B>,
}

impl<B: Backend> MovingTensors<B> {
    /// The same for a backend around or inside this one; `float` is called in the order of [`Self::into_array`].
    pub(crate) fn map<A: Backend>(
        self,
        mut float: impl FnMut(FloatTensor<B>) -> FloatTensor<A>,
    ) -> MovingTensors<A> {
        MovingTensors {
            poses: float(self.poses),
            means: float(self.means),
            left_rotations: float(self.left_rotations),
        }
    }

    /// All tensors, in the order of the inputs of [`SplatOps::expose`].
    pub(crate) fn into_array(self) -> [FloatTensor<B>; 3] {
        [self.poses, self.means, self.left_rotations]
    }
}

/// How a picture is taken: what of an exposure is no tensor.
#[derive(Clone, Debug)]
pub(crate) struct Taking {
    pub(crate) camera: Camera,
    pub(crate) sh_degree: usize,
    pub(crate) transfer: Transfer,
}

/// A view that is projected, sorted and listed by tile, as its backend keeps it.
#[derive(Clone, Debug, ExtensionType)]
pub(crate) enum PreparedView<B: Backend> {
    /// In main memory.
    Host {
        projection: HostProjection,
        /// Radius of every Gaussian in the image, px, `[N]` in f32.
        radii: FloatTensor<B>,
    },
    /// On a GPU.
    #[cfg(feature = "cube")]
    Device {
        tables: Arc<crate::backends::cube::Tables>,
        radii: FloatTensor<B>,
    },
    /// On a GPU, without a Gaussian.
    #[cfg(feature = "cube")]
    Blank {
        camera: Camera,
        radii: FloatTensor<B>,
    },
}

impl<B: Backend> PreparedView<B> {
    /// The same view for a backend around or inside this one.
    pub(crate) fn map<A: Backend>(
        self,
        mut float: impl FnMut(FloatTensor<B>) -> FloatTensor<A>,
    ) -> PreparedView<A> {
        match self {
            Self::Host { projection, radii } => PreparedView::Host {
                projection,
                radii: float(radii),
            },
            #[cfg(feature = "cube")]
            Self::Device { tables, radii } => PreparedView::Device {
                tables,
                radii: float(radii),
            },
            #[cfg(feature = "cube")]
            Self::Blank { camera, radii } => PreparedView::Blank {
                camera,
                radii: float(radii),
            },
        }
    }

    /// Radius of every Gaussian in the image, px, `[N]` in f32.
    pub(crate) fn radii(&self) -> FloatTensor<B> {
        match self {
            Self::Host { radii, .. } => radii.clone(),
            #[cfg(feature = "cube")]
            Self::Device { radii, .. } | Self::Blank { radii, .. } => radii.clone(),
        }
    }

    /// Every Gaussian in the image, and the tiles' lists. A device is waited for.
    pub(crate) fn stages(&self) -> Result<Stages, SplatError> {
        match self {
            Self::Host { projection, .. } => Ok(match projection {
                HostProjection::F32(projection) => projection.stages(),
                HostProjection::F64(projection) => projection.stages(),
            }),
            #[cfg(feature = "cube")]
            Self::Device { tables, .. } => tables.stages(),
            #[cfg(feature = "cube")]
            Self::Blank { camera, .. } => Ok(Stages::blank(camera)),
        }
    }
}

/// A projection in either float type.
#[derive(Clone, Debug)]
pub(crate) enum HostProjection {
    F32(Arc<Projection<f32>>),
    F64(Arc<Projection<f64>>),
}

/// What comes out of [`SplatOps::project`].
#[derive(Clone, Debug, ExtensionType)]
pub(crate) enum Projected<B: Backend> {
    Done(#[extension_type] PreparedView<B>),
    Refused(SplatError),
}

impl<B: Backend> From<Result<PreparedView<B>, SplatError>> for Projected<B> {
    fn from(result: Result<PreparedView<B>, SplatError>) -> Self {
        match result {
            Ok(view) => Self::Done(view),
            Err(error) => Self::Refused(error),
        }
    }
}

/// What comes out of [`SplatOps::rasterize`].
#[derive(Clone, Debug, ExtensionType)]
pub(crate) enum Blended<B: Backend> {
    /// [H, W, 5 + F].
    Done(FloatTensor<B>),
    Refused(SplatError),
}

impl<B: Backend> From<Result<FloatTensor<B>, SplatError>> for Blended<B> {
    fn from(result: Result<FloatTensor<B>, SplatError>) -> Self {
        match result {
            Ok(output) => Self::Done(output),
            Err(error) => Self::Refused(error),
        }
    }
}

/// A picture that was exposed.
#[derive(Clone, Debug, ExtensionType)]
pub(crate) struct Picture<B: Backend> {
    /// [H, W, 3].
    pub(crate) color: FloatTensor<B>,
    /// Largest radius of every Gaussian, px, `[N]` in f32.
    pub(crate) radii: FloatTensor<B>,
}

/// What comes out of [`SplatOps::expose`].
#[derive(Clone, Debug, ExtensionType)]
pub(crate) enum Collected<B: Backend> {
    Done(#[extension_type] Picture<B>),
    Refused(SplatError),
}

impl<B: Backend> From<Result<Picture<B>, SplatError>> for Collected<B> {
    fn from(result: Result<Picture<B>, SplatError>) -> Self {
        match result {
            Ok(picture) => Self::Done(picture),
            Err(error) => Self::Refused(error),
        }
    }
}

/// The ops of this crate, for the backends that are compiled in. Shapes and float types were checked before.
#[backend_extension(
    Flex: cfg(feature = "flex"),
    NdArray: cfg(feature = "ndarray"),
    Cube: cfg(feature = "cube"),
    Autodiff,
)]
pub(crate) trait SplatOps: Backend {
    /// Projects, culls, sorts by depth and lists by tile. Nothing of this is tracked.
    ///
    /// `features` [N, F] are those that will be blended, if they are known already (F = 0 where they are not): a device that has
    /// to be waited for looks at all inputs at once.
    fn project(
        #[extension_type] scene: SceneTensors<Self>,
        features: FloatTensor<Self>,
        camera: Camera,
        sh_degree: usize,
    ) -> Projected<Self>;

    /// Blends a prepared view and `features` [N, F], F may be 0. `scene` and `screen_grad` `[N]` (or empty) are there for
    /// their gradients.
    fn rasterize(
        #[extension_type] view: PreparedView<Self>,
        #[extension_type] scene: SceneTensors<Self>,
        features: FloatTensor<Self>,
        screen_grad: FloatTensor<Self>,
    ) -> Blended<Self>;

    /// Renders from every sample and averages their light. `scene` is that of the middle of the exposure, without left
    /// rotations; `screen_grad` `[N]` (or empty) is there for its gradient.
    fn expose(
        #[extension_type] scene: SceneTensors<Self>,
        #[extension_type] moving: MovingTensors<Self>,
        screen_grad: FloatTensor<Self>,
        taking: Taking,
    ) -> Collected<Self>;
}

/// What the backward needs: called from the autodiff backend only, not dispatched.
pub(crate) trait SplatBackwardOps: SplatOps {
    /// What the forward pass keeps beside its inputs.
    type Saved: Clone + Debug + Send + 'static;

    /// As [`SplatOps::rasterize`], with what the backward needs.
    fn rasterize_saved(
        view: PreparedView<Self>,
        features: FloatTensor<Self>,
    ) -> Result<(FloatTensor<Self>, Self::Saved), SplatError>;

    /// Gradients of the wanted inputs.
    fn rasterize_backward(
        saved: Self::Saved,
        scene: SceneTensors<Self>,
        features: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        wanted: [bool; INPUTS],
    ) -> [Option<FloatTensor<Self>>; INPUTS];

    /// What the forward pass of [`SplatOps::expose`] keeps beside its inputs.
    type SavedExposure: Clone + Debug + Send + 'static;

    /// As [`SplatOps::expose`], with what the backward needs.
    fn expose_saved(
        scene: SceneTensors<Self>,
        moving: MovingTensors<Self>,
        taking: &Taking,
    ) -> Result<(Picture<Self>, Self::SavedExposure), SplatError>;

    /// Gradients of the wanted inputs of [`SplatOps::expose`].
    fn expose_backward(
        saved: Self::SavedExposure,
        scene: SceneTensors<Self>,
        moving: MovingTensors<Self>,
        gradient: FloatTensor<Self>,
        wanted: [bool; EXPOSE_INPUTS],
    ) -> [Option<FloatTensor<Self>>; EXPOSE_INPUTS];
}
